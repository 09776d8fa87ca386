//! How long a critical lane that has fallen behind may catch up, and for which readers it waits meanwhile.
//!
//! A lane falls behind when its process restarts or stalls, and when ingress delivers a burst after a stall
//! of its own. All waiting samples at once would overflow the queue of the lane, the sockets of the readers
//! and the history of the writer, so that a RELIABLE reader loses samples without any loss on the network.
//!
//! A lane that stays behind is overloaded. It goes on with the depth of its queue, which bounds the latency.

use alloc::vec::Vec;

use crate::model::{Guid, MonotonicNs, ReaderRecord};

/// How long a lane catches up at most. After a restart its samples wait for the former readers for 1 s of it.
const MAX_CATCH_UP_MS: u64 = 2_000;

/// How many bytes may be on their way to a reader while the lane catches up: half of what a writer retains.
const MAX_UNACKNOWLEDGED_BYTES: u64 = 16 << 20;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    /// The lane takes samples as they are published.
    Level,
    /// The lane has been behind since then.
    Behind(MonotonicNs),
    /// The lane is of a kind that does not catch up.
    Never,
}

/// How one output of a critical lane catches up.
#[derive(Debug)]
pub struct CatchUp {
    state: State,
    most_unacknowledged: u64,
    /// Samples written since the lane fell behind, and the bytes of the largest one.
    written: u64,
    largest_bytes: u64,
    /// The readers that had fallen behind before the lane did.
    slow: Vec<Guid>,
}

impl CatchUp {
    /// Of a lane that starts `now`, whose writer retains `window_samples` for readers that lack them. The
    /// former process had these readers.
    pub fn of_critical<'a>(
        window_samples: usize,
        former: impl IntoIterator<Item = &'a ReaderRecord>,
        now: MonotonicNs,
    ) -> Self {
        // The other half is for what a reader has not received of the samples that were sent.
        let most_unacknowledged = window_samples.div_ceil(2) as u64;
        // A lane that caught up when it ended may have waited for a reader that lacks half of them.
        let is_slow =
            |reader: &&ReaderRecord| reader.reliable == 1 && reader.unacknowledged >= window_samples as u64;
        let slow = former.into_iter().filter(is_slow).map(|reader| reader.reader).collect();
        Self { state: State::Behind(now), most_unacknowledged, written: 0, largest_bytes: 0, slow }
    }

    /// Of a lane that takes the freshest samples.
    pub const fn never() -> Self {
        Self {
            state: State::Never,
            most_unacknowledged: u64::MAX,
            written: 0,
            largest_bytes: 0,
            slow: Vec::new(),
        }
    }

    /// Whether the lane waits with the next sample because so many samples, with so many bytes in all, are
    /// unsent: the DDS library would discard the oldest.
    pub const fn is_full(&self, unsent: u64, unsent_bytes: u64) -> bool {
        !matches!(self.state, State::Never)
            && (unsent >= self.most_unacknowledged || unsent_bytes >= MAX_UNACKNOWLEDGED_BYTES)
    }

    /// How many samples a lane takes one after the other before it counts as behind.
    pub const fn burst_samples(&self) -> u64 {
        self.most_unacknowledged.div_ceil(2)
    }

    /// The lane finds itself behind, with these readers. Has no effect before [`end`](Self::end) if it was
    /// behind already.
    pub fn begin(&mut self, readers: impl IntoIterator<Item = ReaderRecord>, now: MonotonicNs) {
        if self.state == State::Level {
            self.state = State::Behind(now);
            (self.written, self.largest_bytes) = (0, 0);
            let is_slow = |reader: &ReaderRecord| self.lacks_too_many(reader);
            self.slow = readers.into_iter().filter(is_slow).map(|reader| reader.reader).collect();
        }
    }

    /// The lane has written one more sample.
    pub fn wrote(&mut self, bytes: u64) {
        self.written = self.written.saturating_add(1);
        self.largest_bytes = self.largest_bytes.max(bytes);
    }

    /// The lane has taken all samples that wait.
    pub fn end(&mut self) {
        if let State::Behind(_) = self.state {
            self.state = State::Level;
            self.slow.clear();
        }
    }

    /// Since when the lane has been behind.
    pub const fn since(&self) -> Option<MonotonicNs> {
        match self.state {
            State::Behind(since) => Some(since),
            State::Level | State::Never => None,
        }
    }

    /// Whether the lane is behind, and has been for a short time only. `now` is read only if it is behind.
    pub fn is_on(&self, now: impl FnOnce() -> MonotonicNs) -> bool {
        matches!(self.state, State::Behind(since) if now() < since.plus_ms(MAX_CATCH_UP_MS))
    }

    /// Whether a lane that catches up waits until this reader has acknowledged more. It does not wait for one
    /// that had fallen behind before: that may be dead. Nor for acknowledgements of what the former process
    /// sent, which a reader repeats some 5 ms after it has matched this one.
    pub fn waits_for(&self, reader: &ReaderRecord) -> bool {
        self.written >= self.most_on_their_way()
            && self.lacks_too_many(reader)
            && !self.slow.contains(&reader.reader)
    }

    fn lacks_too_many(&self, reader: &ReaderRecord) -> bool {
        reader.reliable == 1 && reader.unacknowledged >= self.most_on_their_way()
    }

    fn most_on_their_way(&self) -> u64 {
        self.most_unacknowledged.min((MAX_UNACKNOWLEDGED_BYTES / self.largest_bytes.max(1)).max(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    fn reader(number: u8, unacknowledged: u64) -> ReaderRecord {
        ReaderRecord { reader: Guid([number; 16]), unacknowledged, reliable: 1, ..ReaderRecord::default() }
    }

    fn write(lane: &mut CatchUp, samples: u64, bytes: u64) {
        (0..samples).for_each(|_| lane.wrote(bytes));
    }

    #[test]
    fn a_lane_catches_up_for_two_seconds_at_most() {
        let mut lane = CatchUp::of_critical(256, [], at(500));
        assert!(lane.is_on(|| at(2_499)) && !lane.is_on(|| at(2_500)));
        // It has not taken all samples that wait.
        lane.begin([], at(9_000));
        assert!(!lane.is_on(|| at(9_000)));
        assert_eq!(lane.since(), Some(at(500)));
        lane.end();
        assert_eq!(lane.since(), None);
        assert!(!lane.is_on(|| unreachable!("the clock is not read")));
        lane.begin([], at(9_000));
        assert!(lane.is_on(|| at(10_999)) && !lane.is_on(|| at(11_000)));
    }

    #[test]
    fn a_lane_waits_for_readers_that_had_kept_up() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        assert_eq!(lane.burst_samples(), 64);
        lane.end();
        lane.begin([reader(1, 128), reader(2, 127)], at(10));
        write(&mut lane, 127, 1_000);
        assert!(!lane.waits_for(&reader(2, 256)), "most were sent before");
        write(&mut lane, 1, 1_000);
        let best_effort = ReaderRecord { reliable: 0, ..reader(3, 500) };
        let waits =
            [reader(1, 256), reader(2, 127), reader(2, 128), best_effort].map(|it| lane.waits_for(&it));
        assert_eq!(waits, [false, false, true, false]);
        // It catches up still: the readers of the first time count.
        lane.begin([reader(2, 128)], at(20));
        assert!(lane.waits_for(&reader(2, 128)));
        lane.end();
        lane.begin([reader(1, 0), reader(2, 0)], at(30));
        assert!(!lane.waits_for(&reader(1, 128)));
        write(&mut lane, 128, 1_000);
        assert!(lane.waits_for(&reader(1, 128)));
    }

    #[test]
    fn large_samples_count_by_their_bytes() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        assert!(!lane.is_full(127, MAX_UNACKNOWLEDGED_BYTES - 1));
        assert!(lane.is_full(128, 1) && lane.is_full(1, MAX_UNACKNOWLEDGED_BYTES));
        write(&mut lane, 2, 6 << 20);
        assert!(lane.waits_for(&reader(1, 2)) && !lane.waits_for(&reader(1, 1)));
        write(&mut lane, 1, 64 << 20);
        assert!(lane.waits_for(&reader(1, 1)));
        lane.end();
        lane.begin([], at(10));
        write(&mut lane, 2, 1_000);
        assert!(!lane.waits_for(&reader(1, 2)));
        assert!(!CatchUp::never().is_full(1_000, u64::MAX));
    }

    #[test]
    fn a_lane_that_starts_waits_for_no_reader_that_lacked_a_whole_window() {
        let mut lane = CatchUp::of_critical(256, &[reader(1, 256), reader(2, 255)], at(0));
        write(&mut lane, 128, 1_000);
        assert!(!lane.waits_for(&reader(1, 256)) && lane.waits_for(&reader(2, 256)));
    }

    #[test]
    fn a_window_of_one_sample_is_one_on_its_way() {
        let mut lane = CatchUp::of_critical(1, [], at(0));
        lane.wrote(1_000);
        assert!(lane.is_full(1, 1_000) && !lane.is_full(0, 0));
        assert_eq!(lane.burst_samples(), 1);
        assert!(lane.waits_for(&reader(1, 1)) && !lane.waits_for(&reader(1, 0)));
    }

    #[test]
    fn a_lane_of_the_freshest_samples_never_catches_up() {
        let mut lane = CatchUp::never();
        lane.begin([], at(0));
        lane.end();
        lane.begin([], at(0));
        assert!(!lane.is_on(|| at(0)) && lane.since().is_none() && !lane.waits_for(&reader(1, 500)));
    }
}
