//! Why a lane finds samples missing in its queue.

use crate::config::{DropPolicy, Forwarding};
use crate::model::DropReason;

/// The drop reason of samples that were overwritten in the lane's channel queue. A critical lane was too
/// slow. A noncritical one sleeps until it has a token, and the drop policy decides which samples are lost
/// meanwhile.
pub(super) const fn overwrite_reason(forwarding: &Forwarding) -> DropReason {
    match forwarding {
        Forwarding::Everything => DropReason::QueueOverflow,
        Forwarding::Limited(rates) => match rates.normal.drop_policy {
            DropPolicy::DropOldest => DropReason::Superseded,
            _ => DropReason::QueueFull,
        },
    }
}
