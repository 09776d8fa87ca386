//! Samples that the DDS library has accepted and not sent yet.
//!
//! The library sends a small sample for local readers on the lane's thread. A sample in fragments, or one for
//! which a socket has no room, waits for the library's own thread. If the lane is killed meanwhile, no reader
//! receives that sample, so a sample counts as forwarded only when it was sent.

use std::collections::VecDeque;

use crate::model::{LaneCounters, MonotonicNs};
use crate::policy::SequenceTracker;

/// The unsent samples of one writer, oldest first.
pub(super) struct UnsentSamples {
    samples: VecDeque<Forwarded>,
    capacity: usize,
    bytes: u64,
}

impl UnsentSamples {
    /// Room for as many samples as the writer's history holds.
    pub fn new(history_samples: usize) -> Self {
        let capacity = history_samples.max(1);
        Self { samples: VecDeque::with_capacity(capacity), capacity, bytes: 0 }
    }

    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// The bytes of all of them together.
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Adds a sample, and returns the oldest one if the history has no room for both: it was evicted unsent.
    pub fn push(&mut self, sample: Forwarded) -> Option<Forwarded> {
        let evicted = if self.samples.len() == self.capacity { self.pop() } else { None };
        self.bytes += sample.bytes;
        self.samples.push_back(sample);
        evicted
    }

    /// Removes the oldest sample if it was sent.
    pub fn pop_sent(&mut self, sent_through: i64) -> Option<Forwarded> {
        if self.samples.front()?.number > sent_through {
            return None;
        }
        self.pop()
    }

    fn pop(&mut self) -> Option<Forwarded> {
        let oldest = self.samples.pop_front();
        self.bytes -= oldest.map_or(0, |sample| sample.bytes);
        oldest
    }

    /// Removes all samples and returns their number.
    pub fn clear(&mut self) -> usize {
        let unsent = self.samples.len();
        self.samples.clear();
        self.bytes = 0;
        unsent
    }
}

/// What the account records of a sample when it is sent.
#[derive(Clone, Copy, Debug)]
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

    fn unsent(number: i64) -> Forwarded {
        Forwarded { number, bytes: 7, by_reference: false, caught_up: false, written_at: MonotonicNs(0) }
    }

    fn numbers(samples: impl IntoIterator<Item = Option<Forwarded>>) -> Vec<Option<i64>> {
        samples.into_iter().map(|sample| sample.map(|sample| sample.number)).collect()
    }

    #[test]
    fn samples_are_removed_when_they_were_sent() {
        let mut samples = UnsentSamples::new(4);
        assert_eq!(numbers((3..=5).map(|number| samples.push(unsent(number)))), [None, None, None]);
        let sent = [2, 4, 4, 4].map(|sent_through| samples.pop_sent(sent_through));
        assert_eq!(numbers(sent), [None, Some(3), Some(4), None]);
        assert_eq!((samples.len(), samples.bytes()), (1, 7));
        assert_eq!((samples.clear(), samples.bytes()), (1, 0));
        assert!(samples.pop_sent(i64::MAX).is_none());
    }

    #[test]
    fn a_full_history_evicts_the_oldest() {
        let mut samples = UnsentSamples::new(2);
        assert_eq!(numbers((1..=3).map(|number| samples.push(unsent(number)))), [None, None, Some(1)]);
        assert_eq!((samples.len(), samples.bytes()), (2, 14));
    }

    #[test]
    fn samples_that_were_sent_are_counted_with_their_bytes() {
        let mut counters = LaneCounters::default();
        for (number, by_reference) in [(4, true), (5, false), (3, true)] {
            let written_at = MonotonicNs(10 * number as u64);
            let sample = Forwarded { by_reference, caught_up: by_reference, written_at, ..unsent(number) };
            count_forwarded(&mut counters, &sample);
        }
        assert_eq!((counters.forwarded, counters.forwarded_bytes), (3, 21));
        assert_eq!((counters.by_reference, counters.caught_up), (2, 2));
        assert_eq!((counters.accounted_number, counters.last_forwarded_at), (5, MonotonicNs(30)));
    }
}
