//! Late joiners of a BEST_EFFORT, TRANSIENT_LOCAL output.
//!
//! RTPS repairs a late joiner's history by acknowledgements, and a BEST_EFFORT reader sends none. So the lane
//! keeps the last samples of such an output itself and writes them once more, to the late joiner only.

use std::collections::VecDeque;

use bytes::Bytes;

use crate::model::{Encapsulation, Guid, MonotonicNs, SourceTimestamp};

/// The writer learns of a reader before the reader learns of the writer, and what is sent in between is lost.
/// Discovery of both directions takes some 100 ms on a local network; nothing says when it is over.
const SETTLING_MS: u64 = 1_000;

/// Late joiners that may be waiting at once; further ones are served as places become free.
const MAX_WAITING: usize = 64;

/// A sample as it was written.
#[derive(Clone, Debug)]
pub(super) struct Kept {
    pub payload: Bytes,
    pub encapsulation: Encapsulation,
    pub timestamp: SourceTimestamp,
}

/// The history of one output, and who has yet to get it.
#[derive(Debug)]
pub(super) struct LateJoiners {
    depth: usize,
    history: VecDeque<Kept>,
    waiting: VecDeque<(Guid, MonotonicNs)>,
}

impl LateJoiners {
    /// For an output that keeps `depth` samples.
    pub fn new(depth: usize) -> Self {
        Self {
            depth: depth.max(1),
            history: VecDeque::with_capacity(depth.max(1)),
            waiting: VecDeque::with_capacity(MAX_WAITING),
        }
    }

    /// A sample was written.
    pub fn keep(&mut self, sample: Kept) {
        if self.history.len() == self.depth {
            self.history.pop_front();
        }
        self.history.push_back(sample);
    }

    /// A reader was matched.
    pub fn joined(&mut self, reader: Guid, now: MonotonicNs) {
        if self.waiting.len() < MAX_WAITING && !self.waiting.iter().any(|(waiting, _)| *waiting == reader) {
            self.waiting.push_back((reader, now.plus_ms(SETTLING_MS)));
        }
    }

    /// A reader is gone.
    pub fn left(&mut self, reader: Guid) {
        self.waiting.retain(|(waiting, _)| *waiting != reader);
    }

    /// A reader that is to get the history now, and the history.
    pub fn due(&mut self, now: MonotonicNs) -> Option<(Guid, &VecDeque<Kept>)> {
        if self.waiting.front().is_none_or(|(_, at)| now < *at) {
            return None;
        }
        let (reader, _) = self.waiting.pop_front()?;
        Some((reader, &self.history))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(byte: u8) -> Kept {
        Kept {
            payload: Bytes::from(vec![byte]),
            encapsulation: Encapsulation::CDR_LE,
            timestamp: SourceTimestamp(1),
        }
    }

    #[test]
    fn a_late_joiner_gets_the_last_samples_once_and_after_a_while() {
        let mut late = LateJoiners::new(2);
        for byte in 0..5 {
            late.keep(kept(byte));
        }
        let (reader, start) = (Guid([1; 16]), MonotonicNs(0));
        late.joined(reader, start);
        late.joined(reader, start);
        assert!(late.due(start).is_none());
        let later = start.plus_ms(SETTLING_MS);
        let (joiner, history) = late.due(later).unwrap();
        let bytes: Vec<u8> = history.iter().map(|sample| sample.payload[0]).collect();
        assert_eq!((joiner, bytes), (reader, vec![3, 4]));
        assert!(late.due(later).is_none());
    }

    #[test]
    fn one_who_left_gets_nothing_and_many_take_bounded_memory() {
        let mut late = LateJoiners::new(1);
        late.joined(Guid([1; 16]), MonotonicNs(0));
        late.left(Guid([1; 16]));
        assert!(late.due(MonotonicNs(u64::MAX)).is_none());
        for reader in 0..=255 {
            late.joined(Guid([reader; 16]), MonotonicNs(0));
        }
        assert_eq!(late.waiting.len(), MAX_WAITING);
    }
}
