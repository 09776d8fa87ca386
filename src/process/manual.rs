//! What an operator sets by hand.

use super::role::{RoleError, lane_index, root};
use crate::clock;
use crate::config::Settings;
use crate::model::{LaneMode, LanePolicy, MonotonicNs};
use crate::shm::{BridgeShape, ProcessRole, ShmNode};

/// Puts a lane into `mode` until another is set, and returns the epoch of that policy. The lane applies it
/// within one sample.
///
/// # Errors
/// There is no such lane, the bridge does not run, or shared memory cannot be had.
pub fn set_mode(settings: &Settings, lane: &str, mode: LaneMode) -> Result<u64, RoleError> {
    let index = lane_index(settings, lane)?;
    let node = ShmNode::open(&root(settings), &settings.instance, "mode")?;
    let boards = node.boards(&BridgeShape::of(settings))?;
    let serves = boards.health(ProcessRole::Egress(index)).is_some_and(|health| health.pid != 0);
    if !serves {
        return Err(RoleError::NotRunning { instance: settings.instance.to_string(), lane: lane.to_owned() });
    }
    let policy = boards.set_policy(index, |former| LanePolicy {
        mode: mode as u8,
        by_hand: 1,
        written_at: clock::monotonic(),
        expires_at: MonotonicNs(0),
        ..former
    })?;
    Ok(policy.epoch)
}
