//! Counts missing samples by their sequence numbers.
//!
//! Ingress numbers the samples of a route 1, 2, 3, … without gaps, also across its restarts. A lane that
//! takes the numbers `a` and then `b` therefore missed exactly `b - a - 1` samples.

/// How the sequence number of a sample relates to those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SequenceOutcome {
    /// The next number, or the first that the lane ever took.
    InOrder,
    /// This many samples before it are missing. The caller knows why: its queue overflowed, no process served
    /// the lane, or an ingress process died.
    AfterGap(u64),
    /// Already accounted for.
    Duplicate,
}

/// The account of one route on one lane: every number in `first()+1 ..= last()` was taken or is missing. It
/// begins at the first sample, so that those published before the lane existed do not count as missing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SequenceTracker {
    first: u64,
    last: u64,
    begun: bool,
}

impl SequenceTracker {
    /// Continues the account of a former process with its `first()` and `last()` (`first_sequence` and
    /// `last_sequence` of the lane's counters; both 0 if it took no sample). Samples published since are
    /// missing until the lane takes them. If `last` is below `first`, the account restarts at `first`.
    pub const fn resume(first: u64, last: u64) -> Self {
        let last = if last < first { first } else { last };
        Self { first, last, begun: last > 0 }
    }

    /// The number before the first one accounted for.
    #[inline]
    pub const fn first(&self) -> u64 {
        self.first
    }

    /// The highest number accounted for.
    #[inline]
    pub const fn last(&self) -> u64 {
        self.last
    }

    /// Accounts for `sequence` and the numbers missing before it. 0, never assigned, counts as a duplicate.
    #[inline]
    pub const fn record(&mut self, sequence: u64) -> SequenceOutcome {
        if sequence <= self.last || sequence == 0 {
            return SequenceOutcome::Duplicate;
        }
        if !self.begun {
            self.begun = true;
            self.first = sequence - 1;
            self.last = sequence;
            return SequenceOutcome::InOrder;
        }
        let missing = sequence - self.last - 1;
        self.last = sequence;
        if missing == 0 { SequenceOutcome::InOrder } else { SequenceOutcome::AfterGap(missing) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_account_begins_at_the_first_sample() {
        let mut tracker = SequenceTracker::default();
        assert_eq!(tracker.record(500), SequenceOutcome::InOrder);
        assert_eq!((tracker.first(), tracker.last()), (499, 500));
        assert_eq!(tracker.record(501), SequenceOutcome::InOrder);
    }

    #[test]
    fn a_gap_counts_only_the_missing_samples() {
        let mut tracker = SequenceTracker::default();
        tracker.record(1);
        assert_eq!(tracker.record(5), SequenceOutcome::AfterGap(3));
        assert_eq!(tracker.record(6), SequenceOutcome::InOrder);
    }

    #[test]
    fn repeated_and_older_numbers_are_duplicates_and_change_nothing() {
        let mut tracker = SequenceTracker::default();
        tracker.record(3);
        let before = tracker;
        for sequence in [3, 2, 1, 0] {
            assert_eq!(tracker.record(sequence), SequenceOutcome::Duplicate);
        }
        assert_eq!(tracker, before);
        assert_eq!(SequenceTracker::default().record(0), SequenceOutcome::Duplicate);
    }

    #[test]
    fn a_resumed_account_counts_the_samples_missed_in_between() {
        let mut tracker = SequenceTracker::resume(10, 40);
        assert_eq!(tracker.record(40), SequenceOutcome::Duplicate);
        assert_eq!(tracker.record(43), SequenceOutcome::AfterGap(2));
        assert_eq!(tracker.first(), 10);
        assert_eq!(SequenceTracker::resume(0, 0).record(7), SequenceOutcome::InOrder);
        assert_eq!(SequenceTracker::resume(9, 4), SequenceTracker::resume(9, 9));
    }

    #[test]
    fn the_largest_number_does_not_overflow() {
        let mut tracker = SequenceTracker::default();
        tracker.record(1);
        assert_eq!(tracker.record(u64::MAX), SequenceOutcome::AfterGap(u64::MAX - 2));
        assert_eq!(tracker.record(u64::MAX), SequenceOutcome::Duplicate);
    }
}
