//! A trace that is played: which of its rows is on, and what was really lost in each. Pure: time is an
//! argument.

use serde::Serialize;

use super::gilbert_elliott::GilbertElliott;
use super::link::Counters;
use super::trace::{Trace, TraceRow};
use crate::model::MonotonicNs;

/// What happened while a row was on, in all rounds together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RowCounts {
    /// Packets that arrived while the link was on.
    pub judged: u64,
    /// Lost of them by the model.
    pub lost: u64,
}

/// A trace that is played from the moment it is begun, once or again and again. The last row of one that is
/// not repeated stays on.
#[derive(Clone, Debug)]
pub struct Replay {
    trace: Trace,
    repeat: bool,
    begun: Option<MonotonicNs>,
    round: u64,
    row: usize,
    counted: RowCounts,
    counts: Vec<RowCounts>,
}

impl Replay {
    /// One that waits to be begun, with its first row on.
    pub fn new(trace: Trace, repeat: bool) -> Self {
        let counts = vec![RowCounts::default(); trace.rows().len()];
        // A single row has no end that it could be repeated after.
        let repeat = repeat && trace.length_ns() > 0;
        Self { trace, repeat, begun: None, round: 0, row: 0, counted: RowCounts::default(), counts }
    }

    /// Begins it, unless it has begun: a link that is switched off for a while misses that part.
    pub fn begin(&mut self, now: MonotonicNs) {
        self.begun.get_or_insert(now);
    }

    /// Whether it has begun.
    pub fn has_begun(&self) -> bool {
        self.begun.is_some()
    }

    /// When another row is on; `None` before it is begun and when the last row stays on.
    pub fn next_change(&self) -> Option<MonotonicNs> {
        let begun = self.begun?;
        let before_ns = self.round.saturating_mul(self.trace.length_ns());
        let in_round_ns = match self.trace.rows().get(self.row + 1) {
            Some(next) => next.at_ns,
            None if self.repeat => self.trace.length_ns(),
            None => return None,
        };
        Some(begun.plus_ns(before_ns.saturating_add(in_round_ns)))
    }

    /// Goes to the row that is on at `now`, of which there may have been others meanwhile. First
    /// [`count`](Self::count) what happened in the one before.
    pub fn advance(&mut self, now: MonotonicNs) -> &TraceRow {
        if let Some(begun) = self.begun {
            let mut since_ns = now.since(begun);
            if self.repeat {
                self.round = since_ns / self.trace.length_ns();
                since_ns %= self.trace.length_ns();
            }
            // The first row is at 0.
            self.row = self.trace.rows().partition_point(|row| row.at_ns <= since_ns).saturating_sub(1);
        }
        self.now()
    }

    /// The row that is on.
    pub fn now(&self) -> &TraceRow {
        &self.trace.rows()[self.row]
    }

    /// Gives to the row that is on what the link has counted since this was called last.
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

    /// Whether it begins anew at its end.
    pub fn repeats(&self) -> bool {
        self.repeat
    }

    /// Which row is on, from 0.
    pub fn row(&self) -> usize {
        self.row
    }

    /// How often the trace has been played to its end.
    pub fn round(&self) -> u64 {
        self.round
    }

    /// What was counted, row by row.
    pub fn counts(&self) -> &[RowCounts] {
        &self.counts
    }

    /// How many packets the trace loses on average of those that came, and the standard error of that: each
    /// by the row it came in, and independent of all others.
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

    /// Packets at the same distance through a link that follows a trace; yields which were lost, and when
    /// each of the others was released.
    fn play(replay: &mut Replay, seed: u64, packets: u32, gap_us: u64) -> (Vec<u32>, Vec<MonotonicNs>) {
        let TraceRow { loss, delay, .. } = *replay.now();
        let mut link = Link::new(&Impairment { loss, delay, seed });
        let mut lost = Vec::new();
        // Without a delay a packet is released when it comes.
        let mut released: Vec<MonotonicNs> =
            (0..packets).map(|packet| at_ms(0).plus_ns(u64::from(packet) * gap_us * 1_000)).collect();
        let mut now = at_ms(0);
        replay.begin(now);
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
    fn rows_are_on_from_their_time_to_the_next_and_the_last_stays() {
        let mut once = replay(TEXT, false);
        assert_eq!((once.next_change(), once.row(), once.has_begun()), (None, 0, false));
        assert_eq!(once.advance(at_ms(9_000)).at_ns, 0, "it has not begun");
        once.begin(at_ms(0));
        once.begin(at_ms(500));
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
    fn a_repeated_trace_begins_anew_after_its_last_row() {
        let mut repeated = replay(TEXT, true);
        repeated.begin(at_ms(0));
        repeated.advance(at_ms(3_999));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (3, 0, Some(at_ms(4_000))));
        repeated.advance(at_ms(4_000));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (0, 1, Some(at_ms(5_000))));
        // Who was asleep for rounds goes on where it would be.
        repeated.advance(at_ms(41_500));
        assert_eq!((repeated.row(), repeated.round(), repeated.next_change()), (1, 10, Some(at_ms(42_000))));
        let mut one = replay("time_s,loss,delay_ms\n0,0.5,0\n", true);
        one.begin(at_ms(0));
        one.advance(at_ms(99_999));
        assert_eq!((one.next_change(), one.repeats(), one.round()), (None, false, 0));
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
        // The same numbers are drawn whatever the rows say: a row of more loss loses the same and more.
        let more = TEXT.replace("1,0.3,20,5", "1,0.6,0,0");
        let (less, more) = (lost(7).0, play(&mut replay(&more, false), 7, 4_000, 1_000).0);
        assert!(less.iter().all(|packet| more.contains(packet)) && less.len() < more.len());
    }

    proptest! {
        #[test]
        fn whatever_the_steps_the_row_is_that_of_the_time_and_every_packet_is_in_one(
            gaps_ms in proptest::collection::vec((0..3_000_u64, 0..50_u64), 1..60),
            repeat: bool,
        ) {
            let mut replay = replay(TEXT, repeat);
            replay.begin(at_ms(0));
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
