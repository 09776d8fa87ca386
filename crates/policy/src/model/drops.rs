//! Drop reasons: a closed list, so that every sample that ingress takes is accounted for.

use core::fmt;

macro_rules! drop_reasons {
    ($($(#[doc = $doc:literal])+ $variant:ident = $label:literal,)+) => {
        /// Why a sample was dropped. Code that drops samples for a new reason adds that reason here.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(u8)]
        pub enum DropReason {
            $($(#[doc = $doc])+ $variant,)+
        }

        impl DropReason {
            /// Every reason, in the order of its index.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)+];

            /// The number of reasons.
            pub const COUNT: usize = Self::ALL.len();

            /// The label in logs, `status` and metrics.
            pub const fn label(self) -> &'static str {
                match self {
                    $(Self::$variant => $label,)+
                }
            }
        }
    };
}

drop_reasons! {
    /// Ingress: larger than the route's `max_sample_bytes`.
    TooLarge = "too_large",
    /// Ingress: no free slot in the route's shared-memory pool.
    PoolExhausted = "pool_exhausted",
    /// Ingress: an encapsulation that DDS does not define, or a payload the DDS library could not decode.
    Malformed = "malformed",
    /// Lane: a gap in the route's sequence numbers, left by an ingress process that died between numbering a
    /// sample and publishing it.
    IngressDied = "ingress_died",
    /// Lane: overwritten in the lane's shared-memory queue before the lane took it.
    QueueOverflow = "queue_overflow",
    /// Lane: published while no process served the lane, or held by a process that was killed.
    LaneDown = "lane_down",
    /// Lane: there is no DDS writer because the message type of the route is not known yet.
    NoWriter = "no_writer",
    /// Lane: written while no reader was matched, or, after a restart of the lane, while a reader that had
    /// been matched before was not matched again.
    NoReader = "no_reader",
    /// Lane: the DDS library refused the sample for another reason.
    WriteFailed = "write_failed",
    /// Noncritical lane: older than the stale threshold.
    Stale = "stale",
    /// Noncritical lane: a newer sample was waiting when the rate allowed the next one.
    Superseded = "superseded",
    /// Noncritical lane: the lane's queue was full.
    QueueFull = "queue_full",
    /// Noncritical lane: the lane is suspended.
    Suspended = "suspended",
    /// Any lane: forwarding is stopped (emergency).
    Stopped = "stopped",
    /// Any lane: still waiting when the process shut down.
    Shutdown = "shutdown",
}

impl DropReason {
    /// A text for users: why the samples were dropped and, where there is one, the remedy.
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::TooLarge => "larger than the route's max_sample_bytes; raise it",
            Self::PoolExhausted => "no free slot in shared memory; raise queue_depth",
            Self::Malformed => "an encapsulation that DDS does not define, or an undecodable payload",
            Self::IngressDied => "an ingress process died before it published them",
            Self::QueueOverflow => "the lane took them too slowly; raise its queue_depth",
            Self::LaneDown => "published while no process served the lane, or held by one that was killed",
            Self::NoWriter => "the message type is not known yet",
            Self::NoReader => "no subscriber was matched, or not again yet after a restart of the lane",
            Self::WriteFailed => "the DDS library refused them",
            Self::Stale => "older than stale_threshold_ms; are the clocks synchronized?",
            Self::Superseded => "a newer one replaced them",
            Self::QueueFull => "the lane's queue was full",
            Self::Suspended => "the lane is suspended",
            Self::Stopped => "forwarding is stopped",
            Self::Shutdown => "still waiting when the lane shut down",
        }
    }
}

impl fmt::Display for DropReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// Counts of dropped samples by reason. Sums saturate: the counts come from shared memory, where any process
/// of the same user could have written any number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct DropCounts([u64; DropReason::COUNT]);

impl DropCounts {
    /// Counts `n` more drops for `reason`.
    #[inline]
    pub fn add(&mut self, reason: DropReason, n: u64) {
        let count = &mut self.0[reason as usize];
        *count = count.saturating_add(n);
    }

    /// Drops for `reason`.
    #[inline]
    pub const fn get(&self, reason: DropReason) -> u64 {
        self.0[reason as usize]
    }

    /// Drops for all reasons together.
    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |total, count| total.saturating_add(*count))
    }

    /// The reasons that occurred, with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (DropReason, u64)> + '_ {
        DropReason::ALL.iter().map(|&reason| (reason, self.get(reason))).filter(|&(_, n)| n > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_its_own_index_and_label() {
        for (index, reason) in DropReason::ALL.iter().enumerate() {
            assert_eq!(*reason as usize, index);
            let same = DropReason::ALL.iter().filter(|other| other.label() == reason.label());
            assert_eq!(same.count(), 1, "{reason}");
        }
    }

    #[test]
    fn counts_are_summed_by_reason() {
        let mut counts = DropCounts::default();
        counts.add(DropReason::Stale, 2);
        counts.add(DropReason::TooLarge, 1);
        counts.add(DropReason::Stale, 3);
        assert_eq!(counts.get(DropReason::Stale), 5);
        assert_eq!(counts.total(), 6);
        let listed: Vec<_> = counts.iter().collect();
        assert_eq!(listed, [(DropReason::TooLarge, 1), (DropReason::Stale, 5)]);
    }
}
