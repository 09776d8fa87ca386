//! Received, lost, late, repeated and reordered samples of a numbered stream.

use std::collections::{HashMap, HashSet};

/// A sample that a subscriber received.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reception {
    /// Time of the reception, in seconds.
    pub at_s: f64,
    /// The sequence number that the publisher gave the sample.
    pub seq: u64,
    /// From the source timestamp to the reception, in milliseconds.
    pub latency_ms: f64,
}

/// Counts of the samples that a subscriber received and missed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Received {
    /// Received samples, each counted once.
    pub samples: usize,
    /// Samples that the writer accepted and the subscriber never received.
    pub lost: usize,
    /// Receptions of samples that had been received before.
    pub repeated: usize,
    /// Samples received after a later one.
    pub reordered: usize,
    /// Samples received more than `late_ms` after their source timestamp.
    pub late: usize,
}

/// Compares `receptions`, in their order of arrival, with the sequence numbers that the writer accepted.
pub fn received(written: impl IntoIterator<Item = u64>, receptions: &[Reception], late_ms: f64) -> Received {
    let mut seen = HashSet::with_capacity(receptions.len());
    let mut found = Received::default();
    let mut newest = None;
    for reception in receptions {
        if !seen.insert(reception.seq) {
            found.repeated += 1;
            continue;
        }
        found.samples += 1;
        found.reordered += usize::from(newest > Some(reception.seq));
        found.late += usize::from(reception.latency_ms > late_ms);
        newest = newest.max(Some(reception.seq));
    }
    found.lost = written.into_iter().filter(|seq| !seen.contains(seq)).count();
    found
}

/// The longest time without an event from `from_s` to `to_s`, in seconds, including the times before the
/// first and after the last event.
pub fn longest_silence_s(times_s: impl IntoIterator<Item = f64>, from_s: f64, to_s: f64) -> f64 {
    let mut times: Vec<f64> = times_s.into_iter().filter(|time| (from_s..=to_s).contains(time)).collect();
    times.push(to_s);
    times.sort_by(f64::total_cmp);
    let mut before = from_s;
    let mut longest: f64 = 0.0;
    for time in times {
        longest = longest.max(time - before);
        before = time;
    }
    longest
}

/// The number of samples that are outstanding for a subscriber at each of the ascending times `at_s`: those
/// of `written`, `(time in seconds, sequence number)` in order, from the first missing one on. A RELIABLE
/// writer with KEEP_ALL history has to retain at least these for the subscriber.
pub fn outstanding(written: &[(f64, u64)], receptions: &[Reception], at_s: &[f64]) -> Vec<usize> {
    let mut arrivals: HashMap<u64, f64> = HashMap::with_capacity(receptions.len());
    for reception in receptions {
        let first = arrivals.entry(reception.seq).or_insert(reception.at_s);
        *first = first.min(reception.at_s);
    }
    let mut all_until = f64::NEG_INFINITY;
    let in_order_at: Vec<f64> = written
        .iter()
        .map(|(_, seq)| {
            all_until = all_until.max(arrivals.get(seq).copied().unwrap_or(f64::INFINITY));
            all_until
        })
        .collect();
    at_s.iter()
        .map(|time| {
            let written_before = written.partition_point(|(written_at, _)| written_at <= time);
            written_before.saturating_sub(in_order_at.partition_point(|arrived| arrived <= time))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn reception(seq: u64, latency_ms: f64) -> Reception {
        Reception { at_s: 0.0, seq, latency_ms }
    }

    #[test]
    fn lost_late_repeated_and_reordered_samples_are_counted_separately() {
        let receptions = [
            reception(1, 1.0),
            reception(3, 40.0),
            reception(2, 90.0),
            reception(3, 95.0),
            reception(5, 33.0),
            reception(9, 1.0),
        ];
        let found = received(1..=6, &receptions, 33.3);
        // 4 and 6 did not arrive; 9 is not in `written` but counts as received.
        assert_eq!(found, Received { samples: 5, lost: 2, repeated: 1, reordered: 1, late: 2 });
        assert_eq!(received([], &[], 1.0), Received::default());
        assert_eq!(received([0, 1], &[], 1.0).lost, 2);
    }

    #[test]
    fn silence_includes_both_ends_of_the_window() {
        assert_eq!(longest_silence_s([1.0, 2.0, 5.0], 0.0, 6.0), 3.0);
        assert_eq!(longest_silence_s([5.0, 4.0], 0.0, 6.0), 4.0);
        assert_eq!(longest_silence_s([1.0], 0.0, 6.0), 5.0);
        assert_eq!(longest_silence_s([], 0.0, 6.0), 6.0);
        assert_eq!(longest_silence_s([-1.0, 9.0], 0.0, 6.0), 6.0);
    }

    #[test]
    fn outstanding_samples_start_at_the_first_missing_one() {
        let written = [(1.0, 1), (2.0, 2), (3.0, 3), (4.0, 4)];
        let at = |at_s, seq| Reception { at_s, seq, latency_ms: 0.0 };
        let receptions = [at(1.5, 1), at(3.5, 3), at(4.5, 2), at(4.6, 3)];
        let found = outstanding(&written, &receptions, &[0.0, 1.0, 1.5, 2.0, 3.6, 4.0, 4.5, 9.0]);
        // 3 arrives before 2 and waits for it; 4 never arrives.
        assert_eq!(found, [0, 1, 0, 1, 2, 3, 1, 1]);
        assert_eq!(outstanding(&[], &receptions, &[1.0]), [0]);
    }

    proptest! {
        #[test]
        fn every_written_sample_is_received_or_lost(
            written in 0_u64..100, arrived in proptest::collection::vec(0_u64..100, 0..200),
        ) {
            let arrived: Vec<Reception> =
                arrived.into_iter().filter(|seq| *seq < written).map(|seq| reception(seq, 1.0)).collect();
            let found = received(0..written, &arrived, 0.5);
            prop_assert_eq!((found.samples + found.lost) as u64, written);
            prop_assert_eq!(found.samples + found.repeated, arrived.len());
            prop_assert_eq!(found.late, found.samples);
            prop_assert!(found.reordered < found.samples.max(1));
        }

        #[test]
        fn silence_is_at_least_the_mean_gap(times in proptest::collection::vec(0.0..10.0_f64, 0..50)) {
            let mean = 10.0 / (times.len() + 1) as f64;
            let longest = longest_silence_s(times, 0.0, 10.0);
            prop_assert!((mean - 1e-9..=10.0).contains(&longest));
        }
    }
}
