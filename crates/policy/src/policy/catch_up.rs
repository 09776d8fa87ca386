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

/// What counts of the time between two turns of a lane, which are 100 ms apart at most while it runs. In the
/// rest its process was stopped, or did not get the CPU: it has not caught up then.
const MAX_TURN_MS: u64 = 200;

/// How many bytes may be on their way to a reader while the lane catches up: half of what a writer retains.
const MAX_UNACKNOWLEDGED_BYTES: u64 = 16 << 20;

/// How many bytes of samples a lane takes one after the other before it counts as behind.
const BURST_BYTES: u64 = MAX_UNACKNOWLEDGED_BYTES / 2;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    /// The lane takes samples as they are published.
    Level,
    /// The lane has been behind since then, and has run so long until its last turn.
    Behind { since: MonotonicNs, ran_ns: u64, turn_at: MonotonicNs },
    /// The lane is of a kind that does not catch up.
    Never,
}

impl State {
    const fn behind(now: MonotonicNs) -> Self {
        Self::Behind { since: now, ran_ns: 0, turn_at: now }
    }
}

/// Samples that a lane has taken one after the other.
#[derive(Clone, Copy, Default, Debug)]
struct Burst {
    samples: u64,
    bytes: u64,
    largest_bytes: u64,
}

/// How one output of a critical lane catches up.
#[derive(Debug)]
pub struct CatchUp {
    state: State,
    most_unacknowledged: u64,
    /// What was taken since the lane was level with an empty queue.
    burst: Burst,
    /// Samples written since the lane fell behind, and the bytes of the largest one.
    written: u64,
    largest_bytes: u64,
    /// The readers that had fallen behind before the lane did, or for which it has waited as long as it may.
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
        let is_slow = |reader: &&ReaderRecord| lacks(reader, window_samples as u64);
        let slow = former.into_iter().filter(is_slow).map(|reader| reader.reader).collect();
        Self { state: State::behind(now), most_unacknowledged, slow, ..Self::never() }
    }

    /// Of a lane that takes the freshest samples.
    pub const fn never() -> Self {
        Self {
            state: State::Never,
            most_unacknowledged: u64::MAX,
            burst: Burst { samples: 0, bytes: 0, largest_bytes: 0 },
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

    /// The lane takes one more sample before its queue is empty. Returns whether it is behind: it has taken
    /// so many, or two or more with so many bytes, that there are more of them than one late sample.
    pub fn takes(&mut self, bytes: u64) -> bool {
        self.burst.samples += 1;
        self.burst.bytes = self.burst.bytes.saturating_add(bytes);
        self.burst.largest_bytes = self.burst.largest_bytes.max(bytes);
        self.burst.samples >= self.most_unacknowledged.div_ceil(2)
            || (self.burst.samples > 1 && self.burst.bytes >= BURST_BYTES)
    }

    /// The lane finds itself behind, with these readers. Has no effect before [`end`](Self::end) if it was
    /// behind already.
    pub fn begin(&mut self, readers: impl IntoIterator<Item = ReaderRecord>, now: MonotonicNs) {
        if self.state == State::Level {
            self.state = State::behind(now);
            // The last one that was taken is not written yet.
            self.written = self.burst.samples.saturating_sub(1);
            self.largest_bytes = self.burst.largest_bytes;
            // Two images may be on their way to a reader that keeps up when the process stops.
            let most = self.most_samples(2 * MAX_UNACKNOWLEDGED_BYTES, 2);
            let is_slow = |reader: &ReaderRecord| {
                lacks(reader, most)
                    || (lacks(reader, self.most_on_their_way()) && self.slow.contains(&reader.reader))
            };
            self.slow = readers.into_iter().filter(is_slow).map(|reader| reader.reader).collect();
        }
    }

    /// The lane has written one more sample.
    pub fn wrote(&mut self, bytes: u64) {
        self.written = self.written.saturating_add(1);
        self.largest_bytes = self.largest_bytes.max(bytes);
    }

    /// The lane has taken all samples that wait, and [waits for](Self::waits_for) none of its readers, which
    /// are these.
    pub fn end(&mut self, readers: impl IntoIterator<Item = ReaderRecord>) {
        self.burst = Burst::default();
        if let State::Behind { .. } = self.state {
            self.slow.clear();
            if !self.is_on() {
                // Or each burst would hold up the others for 2 s.
                let most = self.most_on_their_way();
                let lacking = readers.into_iter().filter(|reader| lacks(reader, most));
                self.slow.extend(lacking.map(|reader| reader.reader));
            }
            self.state = State::Level;
        }
    }

    /// Since when the lane has been behind.
    pub const fn since(&self) -> Option<MonotonicNs> {
        match self.state {
            State::Behind { since, .. } => Some(since),
            State::Level | State::Never => None,
        }
    }

    /// The lane runs, and looks for samples. `now` is read only if it is behind.
    pub fn turn(&mut self, now: impl FnOnce() -> MonotonicNs) {
        if let State::Behind { ran_ns, turn_at, .. } = &mut self.state {
            let now = now();
            *ran_ns += now.since(*turn_at).min(MAX_TURN_MS * 1_000_000);
            *turn_at = now;
        }
    }

    /// Whether the lane is behind, and has run for a short time only since then.
    pub const fn is_on(&self) -> bool {
        matches!(self.state, State::Behind { ran_ns, .. } if ran_ns < MAX_CATCH_UP_MS * 1_000_000)
    }

    /// Whether a lane that catches up waits until this reader has acknowledged more. It does not wait for one
    /// that had fallen behind before: that may be dead. Nor for acknowledgements of what the former process
    /// sent, which a reader repeats some 5 ms after it has matched this one.
    pub fn waits_for(&self, reader: &ReaderRecord) -> bool {
        let most = self.most_on_their_way();
        self.written >= most && lacks(reader, most) && !self.slow.contains(&reader.reader)
    }

    fn most_on_their_way(&self) -> u64 {
        self.most_samples(MAX_UNACKNOWLEDGED_BYTES, 1)
    }

    /// How many of the largest samples are so many bytes, but not fewer than `least`.
    fn most_samples(&self, bytes: u64, least: u64) -> u64 {
        self.most_unacknowledged.min((bytes / self.largest_bytes.max(1)).max(least))
    }
}

/// Whether the writer owes a reader so many samples.
const fn lacks(reader: &ReaderRecord, samples: u64) -> bool {
    reader.reliable == 1 && reader.unacknowledged >= samples
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

    /// Whether the lane still catches up after turns until then, each 100 ms.
    fn is_on_at(lane: &mut CatchUp, turns: core::ops::RangeInclusive<u64>) -> bool {
        let last = *turns.end();
        turns.step_by(100).chain([last]).for_each(|ms| lane.turn(|| at(ms)));
        lane.is_on()
    }

    #[test]
    fn a_lane_catches_up_for_two_seconds_at_most() {
        let mut lane = CatchUp::of_critical(256, [], at(500));
        assert!(is_on_at(&mut lane, 500..=2_499));
        assert!(!is_on_at(&mut lane, 2_500..=2_500));
        // It has not taken all samples that wait.
        lane.begin([], at(9_000));
        assert!(!is_on_at(&mut lane, 9_000..=9_000));
        assert_eq!(lane.since(), Some(at(500)));
        lane.end([]);
        assert_eq!(lane.since(), None);
        lane.turn(|| unreachable!("the clock is not read"));
        assert!(!lane.is_on());
        lane.begin([], at(9_000));
        assert!(is_on_at(&mut lane, 9_000..=10_999));
        assert!(!is_on_at(&mut lane, 11_000..=11_000));
    }

    #[test]
    fn a_lane_does_not_catch_up_while_its_process_is_stopped() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        assert!(is_on_at(&mut lane, 0..=1_000));
        // Of the 10 s until the next turn, 0.2 s count.
        assert!(is_on_at(&mut lane, 11_000..=11_799));
        assert!(!is_on_at(&mut lane, 11_800..=11_800));
    }

    #[test]
    fn a_lane_waits_for_readers_that_had_kept_up() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        lane.end([]);
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
        lane.end([]);
        lane.begin([reader(1, 0), reader(2, 0)], at(30));
        assert!(!lane.waits_for(&reader(1, 128)));
        write(&mut lane, 128, 1_000);
        assert!(lane.waits_for(&reader(1, 128)));
    }

    #[test]
    fn a_lane_is_behind_after_many_samples_or_bytes_in_a_row() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        lane.end([]);
        for (bytes, samples) in [(1_000, 64), (BURST_BYTES / 2 - 1, 3), (BURST_BYTES / 2, 2), (64 << 20, 2)] {
            let taken = (1..=64).find(|_| lane.takes(bytes));
            assert_eq!(taken, Some(samples), "{bytes}");
            lane.end([]);
        }
        // All but the last one are written, so that the lane waits at once for a reader that lacks them.
        (0..3).for_each(|_| assert!(!lane.takes(BURST_BYTES / 4)));
        assert!(lane.takes(BURST_BYTES / 4));
        lane.begin([reader(1, 15), reader(2, 16)], at(10));
        assert!(!lane.waits_for(&reader(1, 8)));
        write(&mut lane, 5, BURST_BYTES / 4);
        assert!(lane.waits_for(&reader(1, 8)) && !lane.waits_for(&reader(1, 7)));
        assert!(!lane.waits_for(&reader(2, 16)), "it lacked all that the writer retains");
        lane.end([]);
        // One sample on its way says nothing of a reader, however large it is.
        (0..2).for_each(|_| _ = lane.takes(64 << 20));
        lane.begin([reader(1, 1), reader(2, 2)], at(20));
        assert!(lane.waits_for(&reader(1, 1)) && !lane.waits_for(&reader(2, 1)));
    }

    #[test]
    fn a_lane_waits_once_for_a_reader_that_does_not_catch_up() {
        let mut lane = CatchUp::of_critical(256, [], at(0));
        write(&mut lane, 128, 1_000);
        assert!(lane.waits_for(&reader(1, 128)));
        assert!(!is_on_at(&mut lane, 0..=2_000));
        lane.end([reader(1, 128), reader(2, 127)]);
        let begin = |lane: &mut CatchUp, unacknowledged| {
            lane.begin([reader(1, unacknowledged), reader(2, 127)], at(3_000));
            write(lane, 128, 1_000);
            [1, 2].map(|number| lane.waits_for(&reader(number, 128)))
        };
        assert_eq!(begin(&mut lane, 127), [true, true], "it has caught up since then");
        assert!(!is_on_at(&mut lane, 3_000..=5_000));
        lane.end([reader(1, 128), reader(2, 127)]);
        // Large samples, of which it lacks fewer than a writer retains.
        (0..4).for_each(|_| _ = lane.takes(4 << 20));
        lane.begin([reader(1, 4), reader(2, 4), reader(3, 8)], at(6_000));
        write(&mut lane, 4, 4 << 20);
        assert_eq!([1, 2, 3].map(|number| lane.waits_for(&reader(number, 4))), [false, true, false]);
        assert!(is_on_at(&mut lane, 6_000..=6_100));
        lane.end([reader(1, 4)]);
        (0..4).for_each(|_| _ = lane.takes(4 << 20));
        lane.begin([reader(1, 4)], at(7_000));
        write(&mut lane, 4, 4 << 20);
        assert!(lane.waits_for(&reader(1, 4)), "the lane has caught up in time");
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
        lane.end([]);
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
        assert!(lane.takes(1_000));
        assert!(lane.waits_for(&reader(1, 1)) && !lane.waits_for(&reader(1, 0)));
    }

    #[test]
    fn a_lane_of_the_freshest_samples_never_catches_up() {
        let mut lane = CatchUp::never();
        lane.begin([], at(0));
        lane.end([]);
        lane.begin([], at(0));
        lane.turn(|| unreachable!("the clock is not read"));
        assert!(!lane.is_on() && lane.since().is_none() && !lane.waits_for(&reader(1, 500)));
    }
}
