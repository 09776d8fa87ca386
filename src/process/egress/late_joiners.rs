//! Sends the history of a BEST_EFFORT, TRANSIENT_LOCAL output to late joiners.
//!
//! RTPS sends a late joiner the history that its acknowledgements request, and a BEST_EFFORT reader sends
//! none. So the lane keeps the last samples of such an output itself and writes them again, to the late
//! joiner only.

use std::collections::VecDeque;

use bytes::Bytes;

use crate::model::{Encapsulation, Guid, MonotonicNs, SampleHeader, SampleKey, SourceTimestamp};

/// How long the lane waits after a match before it sends the history. The writer matches a reader before the
/// reader matches the writer, and samples sent in between are lost. Discovery of both directions takes some
/// 100 ms on a local network, but DDS does not signal its end.
const SETTLING_MS: u64 = 1_000;

/// The most late joiners that may wait at once, 24 bytes each. Further ones get no history, which the lane
/// counts and logs.
pub(super) const MAX_WAITING: usize = 4_096;

/// The samples of histories that a lane sends in one turn of its housekeeping, ten times a second, or those
/// of one reader. New samples wait meanwhile: 4,096 readers that join at once get 262,144 samples of 64
/// publishers.
pub(super) const SAMPLES_PER_TURN: usize = 256;

/// The most bytes of samples of several publishers, here and in the history of a RELIABLE writer. The last
/// `depth` samples are kept whatever their size.
pub(super) const MAX_BYTES: usize = 32 << 20;

/// The most samples of several publishers or keys, here and in the history of a RELIABLE writer.
const MAX_SAMPLES: usize = 8_192;

/// How many samples a publisher of a topic with keys has here if it sends no key hashes, so that its keys are
/// not known: then a late joiner gets more than the last `depth` of each. As in the history of a RELIABLE
/// writer.
const DEPTH_OF_UNKNOWN_KEYS: usize = 1_024;

/// A sample of the history, as it was written.
#[derive(Clone, Debug)]
pub(super) struct KeptSample {
    pub publisher: Guid,
    pub payload: Bytes,
    pub encapsulation: Encapsulation,
    pub timestamp: SourceTimestamp,
    pub key: SampleKey,
}

impl KeptSample {
    pub const fn of(payload: Bytes, header: &SampleHeader) -> Self {
        Self {
            publisher: header.writer_guid,
            payload,
            encapsulation: header.encapsulation,
            timestamp: header.source_timestamp,
            key: header.key,
        }
    }
}

/// The history of one output, and the readers that have not received it yet.
#[derive(Debug)]
pub(super) struct LateJoiners {
    depth: usize,
    /// The last `depth` samples of each publisher, and of each of its keys, in the order in which they were
    /// written.
    history: VecDeque<KeptSample>,
    bytes: usize,
    evicted: u64,
    waiting: VecDeque<(Guid, MonotonicNs)>,
}

impl LateJoiners {
    pub fn new(depth: usize) -> Self {
        Self {
            depth: depth.max(1),
            history: VecDeque::with_capacity(depth.max(1)),
            bytes: 0,
            evicted: 0,
            waiting: VecDeque::new(),
        }
    }

    /// Adds a written sample, and removes the oldest one of its publisher and key if these have `depth`
    /// others.
    pub fn keep(&mut self, sample: KeptSample) {
        let key = sample.key.hash();
        let depth = if sample.key.is_keyed() && key.is_none() {
            self.depth.max(DEPTH_OF_UNKNOWN_KEYS)
        } else {
            self.depth
        };
        let mut like_it = self
            .history
            .iter()
            .enumerate()
            .filter(|(_, kept)| kept.publisher == sample.publisher && kept.key.hash() == key);
        if let Some((oldest, _)) = like_it.next()
            && like_it.count() + 1 >= depth
            && let Some(superseded) = self.history.remove(oldest)
        {
            self.bytes -= superseded.payload.len();
        }
        self.bytes += sample.payload.len();
        self.history.push_back(sample);
        while (self.bytes > MAX_BYTES || self.history.len() > MAX_SAMPLES)
            && self.history.len() > self.depth
            && let Some(oldest) = self.history.pop_front()
        {
            self.bytes -= oldest.payload.len();
            self.evicted += 1;
        }
    }

    /// Removes the samples of a publisher.
    pub fn forget(&mut self, publisher: Guid) {
        self.history.retain(|kept| kept.publisher != publisher);
        self.bytes = self.history.iter().map(|kept| kept.payload.len()).sum();
    }

    /// Samples that were removed because there were too many, or too many bytes.
    pub fn evicted(&self) -> u64 {
        self.evicted
    }

    /// Adds a matched reader, which is due after the settling time. Returns whether there was room for it.
    pub fn joined(&mut self, reader: Guid, now: MonotonicNs) -> bool {
        if self.waiting.iter().any(|(waiting, _)| *waiting == reader) {
            return true;
        }
        let has_room = self.waiting.len() < MAX_WAITING;
        if has_room {
            self.waiting.push_back((reader, now.plus_ms(SETTLING_MS)));
        }
        has_room
    }

    pub fn left(&mut self, reader: Guid) {
        self.waiting.retain(|(waiting, _)| *waiting != reader);
    }

    /// Removes and returns the next reader that is due, with the history to send to it, unless the turn has
    /// no samples left. `left` is their number, [`SAMPLES_PER_TURN`] at first.
    pub fn next_due(&mut self, now: MonotonicNs, left: &mut usize) -> Option<(Guid, &VecDeque<KeptSample>)> {
        if *left == 0 || self.waiting.front().is_none_or(|(_, at)| now < *at) {
            return None;
        }
        let (reader, _) = self.waiting.pop_front()?;
        *left = left.saturating_sub(self.history.len());
        Some((reader, &self.history))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::KeyedPayload;

    fn kept(byte: u8) -> KeptSample {
        KeptSample {
            publisher: Guid::default(),
            payload: Bytes::from(vec![byte]),
            encapsulation: Encapsulation::CDR_LE,
            timestamp: SourceTimestamp(1),
            key: SampleKey::NONE,
        }
    }

    #[test]
    fn a_late_joiner_gets_the_history_once_after_the_settling_time() {
        let mut late = LateJoiners::new(2);
        for byte in 0..5 {
            late.keep(kept(byte));
        }
        let (reader, start) = (Guid([1; 16]), MonotonicNs(0));
        late.joined(reader, start);
        late.joined(reader, start);
        assert!(late.next_due(start, &mut { SAMPLES_PER_TURN }).is_none());
        let later = start.plus_ms(SETTLING_MS);
        let (joiner, history) = late.next_due(later, &mut { SAMPLES_PER_TURN }).unwrap();
        let bytes: Vec<u8> = history.iter().map(|sample| sample.payload[0]).collect();
        assert_eq!((joiner, bytes), (reader, vec![3, 4]));
        assert!(late.next_due(later, &mut { SAMPLES_PER_TURN }).is_none());
    }

    #[test]
    fn readers_that_join_at_once_are_served_over_several_turns() {
        let mut late = LateJoiners::new(100);
        for byte in 0..100 {
            late.keep(kept(byte));
        }
        for number in 0..7 {
            late.joined(Guid([number; 16]), MonotonicNs(0));
        }
        let later = MonotonicNs(0).plus_ms(SETTLING_MS);
        let mut served = || {
            let mut left = SAMPLES_PER_TURN;
            std::iter::from_fn(|| late.next_due(later, &mut left).map(|(_, history)| history.len())).count()
        };
        assert_eq!([served(), served(), served(), served()], [3, 3, 1, 0]);
    }

    fn history(late: &LateJoiners) -> Vec<u8> {
        late.history.iter().map(|sample| sample.payload[0]).collect()
    }

    #[test]
    fn each_publisher_has_its_own_last_samples() {
        let mut late = LateJoiners::new(2);
        let of = |publisher: u8, byte: u8| KeptSample { publisher: Guid([publisher; 16]), ..kept(byte) };
        for (publisher, byte) in [(1, 0), (2, 1), (2, 2), (2, 3), (1, 4), (3, 5), (2, 6)] {
            late.keep(of(publisher, byte));
        }
        assert_eq!(history(&late), [0, 3, 4, 5, 6]);
        late.forget(Guid([2; 16]));
        assert_eq!(history(&late), [0, 4, 5]);
        assert_eq!((late.bytes, late.evicted()), (3, 0));
    }

    #[test]
    fn each_key_has_its_own_last_samples() {
        let mut late = LateJoiners::new(2);
        let of = |hash: Option<u8>, byte: u8| KeptSample {
            key: SampleKey::new(hash.map(|hash| [hash; 16]), 0, KeyedPayload::Data),
            ..kept(byte)
        };
        for (hash, byte) in [(1, 0), (2, 1), (2, 2), (2, 3), (1, 4)] {
            late.keep(of(Some(hash), byte));
        }
        assert_eq!(history(&late), [0, 2, 3, 4]);
        // Without a hash the keys are not known.
        for byte in 0..2_000 {
            late.keep(of(None, byte as u8));
        }
        assert_eq!(late.history.len(), 4 + DEPTH_OF_UNKNOWN_KEYS);
        for hash in 0..2 * MAX_SAMPLES {
            let hash = (hash as u128).to_le_bytes();
            late.keep(KeptSample { key: SampleKey::new(Some(hash), 0, KeyedPayload::Data), ..kept(0) });
        }
        assert_eq!(late.history.len(), MAX_SAMPLES);
    }

    #[test]
    fn the_bytes_of_several_publishers_are_bounded_and_the_last_samples_are_kept() {
        let large = |publisher: u8, bytes: usize| KeptSample {
            publisher: Guid([publisher; 16]),
            payload: Bytes::from(vec![publisher; bytes]),
            ..kept(0)
        };
        let mut late = LateJoiners::new(1);
        for publisher in 0..40 {
            late.keep(large(publisher, 1 << 20));
        }
        assert_eq!((history(&late).len(), late.evicted()), (32, 8));
        late.keep(large(50, MAX_BYTES + 1));
        assert_eq!((history(&late), late.evicted()), (vec![50], 40));
    }

    #[test]
    fn a_reader_that_left_gets_no_history_and_the_waiting_list_is_bounded() {
        let mut late = LateJoiners::new(1);
        late.joined(Guid([1; 16]), MonotonicNs(0));
        late.left(Guid([1; 16]));
        assert!(late.next_due(MonotonicNs(u64::MAX), &mut { SAMPLES_PER_TURN }).is_none());
        let reader = |number: usize| Guid((number as u128).to_be_bytes());
        for number in 0..MAX_WAITING {
            assert!(late.joined(reader(number), MonotonicNs(0)), "{number}");
        }
        assert!(!late.joined(reader(MAX_WAITING), MonotonicNs(0)));
        assert!(late.joined(reader(7), MonotonicNs(0)), "it waits already");
        for number in 0..MAX_WAITING {
            assert_eq!(
                late.next_due(MonotonicNs(u64::MAX), &mut { SAMPLES_PER_TURN }).unwrap().0,
                reader(number)
            );
        }
        assert!(late.next_due(MonotonicNs(u64::MAX), &mut { SAMPLES_PER_TURN }).is_none());
    }
}
