//! Samples that the DDS library has accepted and not sent yet.
//!
//! The library sends a small sample for local readers on the lane's thread. A sample in fragments, or one for
//! which a socket has no room, waits for the library's own thread. If the lane is killed meanwhile, no reader
//! receives that sample, so a sample counts as forwarded only when it was sent.

use std::collections::VecDeque;

use crate::model::{LaneCounters, MonotonicNs};
use crate::policy::SequenceTracker;

/// A sample that waits to be sent, with what its account needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unsent<T> {
    /// Its RTPS sequence number.
    pub sequence: i64,
    pub account: T,
}

/// The unsent samples of one writer, oldest first.
pub(super) struct UnsentSamples<T> {
    samples: VecDeque<Unsent<T>>,
    capacity: usize,
}

impl<T> UnsentSamples<T> {
    /// Room for as many samples as the writer's history holds.
    pub fn new(history_samples: usize) -> Self {
        let capacity = history_samples.max(1);
        Self { samples: VecDeque::with_capacity(capacity), capacity }
    }

    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Adds a sample, and returns the oldest one if the history has no room for both: it was evicted unsent.
    pub fn push(&mut self, sample: Unsent<T>) -> Option<T> {
        let evicted = if self.samples.len() == self.capacity { self.samples.pop_front() } else { None };
        self.samples.push_back(sample);
        evicted.map(|old| old.account)
    }

    /// Removes the oldest sample if it was sent.
    pub fn pop_sent(&mut self, sent_through: i64) -> Option<T> {
        if self.samples.front()?.sequence > sent_through {
            return None;
        }
        self.samples.pop_front().map(|sent| sent.account)
    }

    /// Removes all samples and returns their number.
    pub fn clear(&mut self) -> usize {
        let unsent = self.samples.len();
        self.samples.clear();
        unsent
    }
}

/// What the account records of a sample when it is sent.
pub(super) struct Forwarded {
    /// Its RTPS sequence number.
    pub number: i64,
    pub bytes: u64,
    pub by_reference: bool,
    pub caught_up: bool,
    pub written_at: MonotonicNs,
}

/// Counts a sample that was sent.
pub(super) fn count_forwarded(counters: &mut LaneCounters, sample: &Forwarded) {
    counters.forwarded += 1;
    counters.accounted_number = counters.accounted_number.max(sample.number);
    counters.forwarded_bytes += sample.bytes;
    counters.by_reference += u64::from(sample.by_reference);
    counters.caught_up += u64::from(sample.caught_up);
    counters.last_forwarded_at = sample.written_at;
}

/// Records the sequence numbers that are accounted for, up to the last sample taken.
pub(super) fn record_sequence(counters: &mut LaneCounters, tracker: &SequenceTracker) {
    counters.first_sequence = tracker.first();
    counters.last_sequence = tracker.last();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unsent(sequence: i64) -> Unsent<i64> {
        Unsent { sequence, account: sequence * 10 }
    }

    #[test]
    fn samples_are_removed_when_they_were_sent() {
        let mut samples = UnsentSamples::new(4);
        for sequence in 3..=5 {
            assert_eq!(samples.push(unsent(sequence)), None);
        }
        assert_eq!(samples.pop_sent(2), None);
        assert_eq!(samples.pop_sent(4), Some(30));
        assert_eq!(samples.pop_sent(4), Some(40));
        assert_eq!(samples.pop_sent(4), None);
        assert_eq!(samples.len(), 1);
        assert_eq!(samples.clear(), 1);
        assert_eq!(samples.pop_sent(i64::MAX), None);
    }

    #[test]
    fn a_full_history_evicts_the_oldest() {
        let mut samples = UnsentSamples::new(2);
        assert_eq!((samples.push(unsent(1)), samples.push(unsent(2))), (None, None));
        assert_eq!(samples.push(unsent(3)), Some(10));
        assert_eq!(samples.len(), 2);
    }
}
