//! The replay of a trace: which of its rows is in force, and the packets that each row lost. Pure: time is an
//! argument.

use adaptive_bridge::model::MonotonicNs;
use serde::Serialize;

use super::gilbert_elliott::GilbertElliott;
use super::link::Counters;
use super::trace::{Trace, TraceRow};

/// Packets counted while a row was in force, over all rounds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RowCounts {
    /// Packets that arrived while the link was on.
    pub judged: u64,
    /// The packets of these that the model lost.
    pub lost: u64,
}

/// The replay of a trace, once or repeatedly. Without repetition the last row stays in force.
#[derive(Clone, Debug)]
pub struct Replay {
    trace: Trace,
    repeat: bool,
    started_at: Option<MonotonicNs>,
    round: u64,
    row: usize,
    /// The link's counters at the last call of [`Self::count`].
    counted: RowCounts,
    counts: Vec<RowCounts>,
}

impl Replay {
    /// Creates a replay that has not started; its first row is in force.
    pub fn new(trace: Trace, repeat: bool) -> Self {
        let counts = vec![RowCounts::default(); trace.rows().len()];
        // The end of a single row is unknown, so there is nothing to repeat.
        let repeat = repeat && trace.length_ns() > 0;
        Self { trace, repeat, started_at: None, round: 0, row: 0, counted: RowCounts::default(), counts }
    }

    /// Starts the replay, unless it has started. It goes on while the link is switched off.
    pub fn start(&mut self, now: MonotonicNs) {
        self.started_at.get_or_insert(now);
    }

    /// Whether the replay has started.
    pub fn has_started(&self) -> bool {
        self.started_at.is_some()
    }

    /// When the next row comes into force; `None` before the start and when the last row stays in force.
    pub fn next_change(&self) -> Option<MonotonicNs> {
        let started_at = self.started_at?;
        let before_ns = self.round.saturating_mul(self.trace.length_ns());
        let in_round_ns = match self.trace.rows().get(self.row + 1) {
            Some(next) => next.at_ns,
            None if self.repeat => self.trace.length_ns(),
            None => return None,
        };
        Some(started_at.plus_ns(before_ns.saturating_add(in_round_ns)))
    }

    /// Advances to the row in force at `now`, which may skip rows, and returns it. Call
    /// [`count`](Self::count) before, for the packets of the previous row.
    pub fn advance(&mut self, now: MonotonicNs) -> &TraceRow {
        if let Some(started_at) = self.started_at {
            let mut since_ns = now.since(started_at);
            if self.repeat {
                self.round = since_ns / self.trace.length_ns();
                since_ns %= self.trace.length_ns();
            }
            // The first row is at 0.
            self.row = self.trace.rows().partition_point(|row| row.at_ns <= since_ns).saturating_sub(1);
        }
        self.current_row()
    }

    /// The row in force.
    pub fn current_row(&self) -> &TraceRow {
        &self.trace.rows()[self.row]
    }

    /// Adds the packets that the link has counted since the last call to the row in force.
    pub fn count(&mut self, counters: &Counters) {
        let counts = &mut self.counts[self.row];
        counts.judged += counters.judged.saturating_sub(self.counted.judged);
        counts.lost += counters.lost.saturating_sub(self.counted.lost);
        self.counted = RowCounts { judged: counters.judged, lost: counters.lost };
    }

    /// The trace.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }

    /// Whether the replay restarts at the end of the trace.
    pub fn is_repeated(&self) -> bool {
        self.repeat
    }

    /// The index of the row in force, from 0.
    pub fn row(&self) -> usize {
        self.row
    }

    /// The number of completed rounds of the trace.
    pub fn round(&self) -> u64 {
        self.round
    }

    /// The packets counted in each row.
    pub fn counts(&self) -> &[RowCounts] {
        &self.counts
    }

    /// The expected number of lost packets, given the packets that arrived in each row, and its standard
    /// error. Losses of packets are independent.
    pub fn lost_expected(&self) -> (f64, f64) {
        let sum = |of: fn(&GilbertElliott, f64) -> f64| {
            let rows = self.trace.rows().iter().zip(&self.counts);
            rows.map(|(row, counts)| of(&row.loss, counts.judged as f64)).sum::<f64>()
        };
        let mean = sum(|model, judged| judged * model.stationary_loss());
        let variance =
            sum(|model, judged| judged * model.stationary_loss() * (1.0 - model.stationary_loss()));
        (mean, variance.sqrt())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::link::{Arrival, Fate, Impairment, Link};
    use super::*;

    const TEXT: &str = "time_s,loss,delay_ms,jitter_ms\n0,0,1,0\n1,0.3,20,5\n2,1,0,0\n3,0.05,40,0\n";

    fn replay(text: &str, repeat: bool) -> Replay {
        Replay::new(Trace::parse(text).unwrap_or_else(|problems| panic!("{problems:?}")), repeat)
    }

    const fn at_ms(ms: u64) -> MonotonicNs {
        MonotonicNs(7_000_000_000).plus_ms(ms)
    }

    /// Sends packets at equal intervals through a link that follows a trace; returns the lost packets, and
    /// the release time of each.
    fn play(replay: &mut Replay, seed: u64, packets: u32, gap_us: u64) -> (Vec<u32>, Vec<MonotonicNs>) {
        let TraceRow { loss, delay, .. } = *replay.current_row();
        let mut link = Link::new(&Impairment { loss, delay, seed });
        let mut lost = Vec::new();
        // Without a delay a packet is released at its arrival.
        let mut released: Vec<MonotonicNs> =
            (0..packets).map(|packet| at_ms(0).plus_ns(u64::from(packet) * gap_us * 1_000)).collect();
        let mut now = at_ms(0);
        replay.start(now);
        let mut release = |link: &mut Link, now: MonotonicNs| {
            while let Some(due) = link.next_release().filter(|due| *due <= now) {
                let packet = link.pop_due(due).expect("it is due");
                released[packet as usize] = due;
            }
        };
        for packet in 0..packets {
            release(&mut link, now);
            if replay.next_change().is_some_and(|change| change <= now) {
                replay.count(&link.counters());
                let TraceRow { loss, delay, .. } = *replay.advance(now);
                link.set(loss, delay);
            }
            if link.arrive(Arrival { packet, bytes: 100, fragment: false }, now) == Fate::Drop {
                lost.push(packet);
            }
            now = now.plus_ns(gap_us * 1_000);
        }
        release(&mut link, MonotonicNs(u64::MAX));
        replay.count(&link.counters());
        (lost, released)
    }

    #[test]
    fn a_row_is_in_force_until_the_next_and_the_last_one_stays() {
        let mut once = replay(TEXT, false);
        assert_eq!((once.next_change(), once.row(), once.has_started()), (None, 0, false));
        assert_eq!(once.advance(at_ms(9_000)).at_ns, 0, "it has not started");
        once.start(at_ms(0));
        once.start(at_ms(500));
        let mut seen = Vec::new();
        while let Some(change) = once.next_change() {
            once.advance(MonotonicNs(change.0 - 1));
            let before = once.row();
            once.advance(change);
            seen.push((change, before, once.row()));
        }
        assert_eq!(seen, [(at_ms(1_000), 0, 1), (at_ms(2_000), 1, 2), (at_ms(3_000), 2, 3)]);
        once.advance(at_ms(3_600_000));
        assert_eq!((once.row(), once.round(), once.next_change()), (3, 0, None));
    }

    #[test]
    fn a_repeated_trace_restarts_after_its_last_row() {
        let mut repeated = replay(TEXT, true);
        repeated.start(at_ms(0));
        repeated.advance(at_ms(3_999));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (3, 0, Some(at_ms(4_000))));
        repeated.advance(at_ms(4_000));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (0, 1, Some(at_ms(5_000))));
        // A process that slept for several rounds goes on in the row of the present time.
        repeated.advance(at_ms(41_500));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (1, 10, Some(at_ms(42_000))));
        let mut one = replay("time_s,loss,delay_ms\n0,0.5,0\n", true);
        one.start(at_ms(0));
        one.advance(at_ms(99_999));
        assert_eq!((one.next_change(), one.is_repeated(), one.round()), (None, false, 0));
    }

    #[test]
    fn each_row_loses_its_share_and_takes_its_time() {
        // 10,000 packets a row, twice.
        let mut replay = replay(TEXT, true);
        let (lost, released) = play(&mut replay, 5, 80_000, 100);
        for (at, (row, counts)) in replay.trace().rows().iter().zip(replay.counts()).enumerate() {
            assert_eq!(counts.judged, 20_000, "row {at}");
            let (share, expected) = (counts.lost as f64 / 20_000.0, row.loss.stationary_loss());
            let tolerance = 5.0 * row.loss.loss_standard_error(20_000);
            let off = (share - expected).abs();
            assert!(off <= tolerance, "row {at}: {share}, not {expected}");
            let in_row = |packet: &u32| (packet / 10_000) as usize % 4 == at;
            assert_eq!(lost.iter().filter(|packet| in_row(packet)).count() as u64, counts.lost);
            let passed = (0..80_000).filter(|packet| in_row(packet) && lost.binary_search(packet).is_err());
            let delays: Vec<f64> = passed
                .map(|packet| {
                    released[packet as usize].since(at_ms(0)) as f64 / 1e6 - f64::from(packet) / 10.0
                })
                .collect();
            let mean = delays.iter().sum::<f64>() / delays.len().max(1) as f64;
            // Row 2 loses everything. Five standard errors of 10,000 delays with a deviation of 5 ms.
            assert!(at == 2 || (mean - row.delay.mean_ms()).abs() < 0.25, "row {at}: {mean} ms");
        }
        let (expected, error) = replay.lost_expected();
        assert!((expected - 20_000.0 * 1.35).abs() < 1e-6, "{expected}");
        assert!((error - (20_000.0 * (0.3 * 0.7 + 0.05 * 0.95_f64)).sqrt()).abs() < 1e-6, "{error}");
        assert!((lost.len() as f64 - expected).abs() <= 5.0 * error);
    }

    #[test]
    fn the_seed_and_the_rows_decide_which_packets_are_lost() {
        let lost = |seed| play(&mut replay(TEXT, false), seed, 4_000, 1_000);
        assert_eq!(lost(7), lost(7));
        assert_ne!(lost(7).0, lost(8).0);
        // The random numbers do not depend on the rows: a row with more loss loses the same packets and more.
        let more = TEXT.replace("1,0.3,20,5", "1,0.6,0,0");
        let (less, more) = (lost(7).0, play(&mut replay(&more, false), 7, 4_000, 1_000).0);
        assert!(less.iter().all(|packet| more.contains(packet)) && less.len() < more.len());
    }

    proptest! {
        #[test]
        fn the_row_depends_on_the_time_only_and_every_packet_is_counted_in_a_row(
            gaps_ms in proptest::collection::vec((0..3_000_u64, 0..50_u64), 1..60),
            repeat: bool,
        ) {
            let mut replay = replay(TEXT, repeat);
            replay.start(at_ms(0));
            let (mut ms, mut judged) = (0, 0);
            for (gap_ms, packets) in gaps_ms {
                ms += gap_ms;
                let counters = Counters { judged, lost: judged / 2, ..Counters::default() };
                replay.count(&counters);
                replay.advance(at_ms(ms));
                let second = (ms / 1_000) as usize;
                prop_assert_eq!(replay.row(), if repeat { second % 4 } else { second.min(3) });
                prop_assert!(replay.next_change().is_none_or(|change| change > at_ms(ms)));
                judged += packets;
            }
            let counters = Counters { judged, lost: judged / 2, ..Counters::default() };
            replay.count(&counters);
            let sums = replay.counts().iter().fold((0, 0), |sum, it| (sum.0 + it.judged, sum.1 + it.lost));
            prop_assert_eq!(sums, (judged, judged / 2));
        }
    }
}
