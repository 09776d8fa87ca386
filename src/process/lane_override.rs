//! Lane modes that an operator sets by hand (`adaptive-bridge mode`).

use std::time::Duration;

use super::error::RoleError;
use super::role::lane_index;
use crate::clock;
use crate::config::Settings;
use crate::model::{LaneMode, LanePolicy, MonotonicNs};
use crate::shm::{BridgeShape, ProcessRole, ShmNode, root_of};

/// Overrides the mode of a lane and returns the epoch of the new policy. The override ends after `duration`,
/// or at the next call if that is `None`; a `mode` of `None` ends an override. The lane applies the policy
/// within one sample.
///
/// # Errors
/// There is no such lane, the bridge does not run, or shared memory cannot be opened.
pub fn set_mode(
    settings: &Settings,
    lane: &str,
    mode: Option<LaneMode>,
    duration: Option<Duration>,
) -> Result<u64, RoleError> {
    let index = lane_index(settings, lane)?;
    let node = ShmNode::open(&root_of(settings), &settings.instance, "mode")?;
    let boards = node.boards(&BridgeShape::of(settings))?;
    let serves = boards.health(ProcessRole::Egress(index)).is_some_and(|health| health.pid != 0);
    if !serves {
        return Err(RoleError::NotRunning { instance: settings.instance.to_string(), lane: lane.to_owned() });
    }
    let now = clock::monotonic();
    let expires_at = match (mode, duration) {
        (Some(_), Some(duration)) => {
            now.plus_ns(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX).max(1))
        }
        _ => MonotonicNs(0),
    };
    let policy = boards.policies()?.set(index, now, |former| LanePolicy {
        by_hand: u8::from(mode.is_some()),
        mode_by_hand: mode.unwrap_or_default() as u8,
        expires_at,
        ..former
    });
    Ok(policy.epoch)
}
