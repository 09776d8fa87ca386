//! Drop reasons: a closed list, so that every sample that ingress takes is accounted for.

use super::counts::{Counts, reasons};
use super::modes::TrafficClass;

reasons! {
    /// Why a sample was dropped. Code that drops samples for a new reason adds that reason here.
    DropReason:
    // Of ingress.
    TooLarge = "too_large", "larger than the route's max_sample_bytes; raise it",
    PoolExhausted = "pool_exhausted", "no free slot in shared memory; raise queue_depth",
    /// What is left of the budget is kept for other routes, or there is none.
    OverBudget = "over_budget",
        "shared_memory.budget_bytes is used up, or the rest is kept for other routes; raise it",
    /// The route holds as much of the budget as one route may.
    OverQuota = "over_quota",
        "the route holds as much of shared_memory.budget_bytes as one route may, as when a lane is stopped; \
         raise it",
    ShmFull = "shm_full", "/dev/shm is full or gives no memory; enlarge it",
    Malformed = "malformed", "an encapsulation that DDS does not define, or an undecodable payload",
    // Of each lane.
    /// A gap in the route's sequence numbers, left by an ingress process that died between numbering a
    /// sample and publishing it.
    IngressDied = "ingress_died", "an ingress process died before it published them",
    /// Overwritten in the lane's shared-memory queue before the lane took it.
    QueueOverflow = "queue_overflow", "the lane took them too slowly; raise its queue_depth",
    LaneDown = "lane_down", "published while no process served the lane, or held by one that was killed",
    NoWriter = "no_writer", "the message type is not known yet",
    NoReader = "no_reader", "no subscriber was matched, or not again yet after a restart of the lane",
    WriteFailed = "write_failed", "the DDS library refused them",
    // Of noncritical lanes.
    Stale = "stale", "older than stale_threshold_ms; are the clocks synchronized?",
    /// A newer sample was waiting when the rate allowed the next one.
    Superseded = "superseded", "a newer one replaced them",
    QueueFull = "queue_full", "the lane's queue was full",
    Suspended = "suspended", "the lane is suspended",
    // Of each lane.
    Stopped = "stopped", "forwarding is stopped",
    Shutdown = "shutdown", "still waiting when the lane shut down",
}

impl DropReason {
    /// Whether a lane of this class drops samples for this reason in normal operation. Such drops are
    /// counted, but not logged and no problem: the lane's mode and the number of its readers show the cause.
    pub const fn is_expected(self, class: TrafficClass) -> bool {
        match self {
            Self::Stopped | Self::NoReader => true,
            Self::Superseded | Self::QueueFull | Self::Suspended => {
                matches!(class, TrafficClass::Noncritical)
            }
            _ => false,
        }
    }
}

/// Counts of dropped samples by reason.
pub type DropCounts = Counts<DropReason, { DropReason::COUNT }>;

#[cfg(test)]
mod tests {
    use super::*;
    use DropReason::{NoReader, QueueFull, Stopped, Superseded, Suspended};

    #[test]
    fn a_critical_lane_expects_fewer_drops_than_a_noncritical_one() {
        let expected = |class| -> Vec<DropReason> {
            DropReason::ALL.iter().copied().filter(|reason| reason.is_expected(class)).collect()
        };
        assert_eq!(expected(TrafficClass::Critical), [NoReader, Stopped]);
        assert_eq!(
            expected(TrafficClass::Noncritical),
            [NoReader, Superseded, QueueFull, Suspended, Stopped]
        );
    }
}
