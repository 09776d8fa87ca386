//! Drop reasons: a closed list, so that every sample that ingress takes is accounted for.

use super::counts::{Counts, reasons};
use super::modes::TrafficClass;

reasons! {
    /// Why a sample was dropped. Code that drops samples for a new reason adds that reason here.
    DropReason:
    /// Ingress: larger than the route's `max_sample_bytes`.
    TooLarge = "too_large", "larger than the route's max_sample_bytes; raise it",
    /// Ingress: no free slot in the route's shared-memory pool.
    PoolExhausted = "pool_exhausted", "no free slot in shared memory; raise queue_depth",
    /// Ingress: an encapsulation that DDS does not define, or a payload the DDS library could not decode.
    Malformed = "malformed", "an encapsulation that DDS does not define, or an undecodable payload",
    /// Lane: a gap in the route's sequence numbers, left by an ingress process that died between numbering a
    /// sample and publishing it.
    IngressDied = "ingress_died", "an ingress process died before it published them",
    /// Lane: overwritten in the lane's shared-memory queue before the lane took it.
    QueueOverflow = "queue_overflow", "the lane took them too slowly; raise its queue_depth",
    /// Lane: published while no process served the lane, or held by a process that was killed.
    LaneDown = "lane_down", "published while no process served the lane, or held by one that was killed",
    /// Lane: there is no DDS writer because the message type of the route is not known yet.
    NoWriter = "no_writer", "the message type is not known yet",
    /// Lane: written while no reader was matched, or, after a restart of the lane, while a reader that had
    /// been matched before was not matched again.
    NoReader = "no_reader", "no subscriber was matched, or not again yet after a restart of the lane",
    /// Lane: the DDS library refused the sample for another reason.
    WriteFailed = "write_failed", "the DDS library refused them",
    /// Noncritical lane: older than the stale threshold.
    Stale = "stale", "older than stale_threshold_ms; are the clocks synchronized?",
    /// Noncritical lane: a newer sample was waiting when the rate allowed the next one.
    Superseded = "superseded", "a newer one replaced them",
    /// Noncritical lane: the lane's queue was full.
    QueueFull = "queue_full", "the lane's queue was full",
    /// Noncritical lane: the lane is suspended.
    Suspended = "suspended", "the lane is suspended",
    /// Any lane: forwarding is stopped (emergency).
    Stopped = "stopped", "forwarding is stopped",
    /// Any lane: still waiting when the process shut down.
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
