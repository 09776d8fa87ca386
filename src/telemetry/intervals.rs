//! The rate of a topic and the regularity of its samples, as `tap --hz` shows them.

use std::collections::VecDeque;

use crate::model::{MonotonicNs, SampleHeader};

/// The window in samples, the same as that of `ros2 topic hz`.
const WINDOW_SAMPLES: usize = 10_000;

/// The arrivals of the last samples of a route.
///
/// An arrival is the time at which ingress took the sample. It is in the sample's header, so a delay of the
/// tap does not change the statistics. The rate counts sequence numbers, so samples that the tap itself
/// missed do not lower it.
#[derive(Clone, Debug, Default)]
pub struct Intervals {
    arrivals: VecDeque<(u64, MonotonicNs)>,
}

/// The rate and the intervals of the samples in the window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IntervalStatistics {
    /// Samples per second.
    pub rate_hz: f64,
    /// The shortest interval between two consecutive samples.
    pub min_ms: f64,
    /// The longest interval between two consecutive samples.
    pub max_ms: f64,
    /// The standard deviation of the intervals.
    pub std_ms: f64,
    /// Samples in the window.
    pub samples: usize,
}

impl Intervals {
    /// Adds a sample. A sequence number that is not above the last one comes from a restarted bridge: the
    /// window is cleared first.
    pub fn record(&mut self, header: &SampleHeader) {
        if self.arrivals.back().is_some_and(|&(sequence, _)| sequence >= header.sequence) {
            self.arrivals.clear();
        }
        if self.arrivals.len() == WINDOW_SAMPLES {
            self.arrivals.pop_front();
        }
        self.arrivals.push_back((header.sequence, header.taken_at));
    }

    /// The statistics of the window; `None` while it has no two consecutive samples.
    pub fn statistics(&self) -> Option<IntervalStatistics> {
        let (&(first, began_at), &(last, ended_at)) = (self.arrivals.front()?, self.arrivals.back()?);
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        let (mut min_ms, mut max_ms) = (f64::INFINITY, 0.0_f64);
        for (&(one, at), &(next, next_at)) in self.arrivals.iter().zip(self.arrivals.iter().skip(1)) {
            if next == one + 1 {
                let ms = next_at.since(at) as f64 / 1e6;
                (count, sum, squares) = (count + 1.0, sum + ms, squares + ms * ms);
                (min_ms, max_ms) = (min_ms.min(ms), max_ms.max(ms));
            }
        }
        let span_ns = ended_at.since(began_at);
        if count == 0.0 || span_ns == 0 {
            return None;
        }
        let mean = sum / count;
        Some(IntervalStatistics {
            rate_hz: (last - first) as f64 * 1e9 / span_ns as f64,
            min_ms,
            max_ms,
            // Rounding may make the variance negative when all intervals are equal.
            std_ms: (squares / count - mean * mean).max(0.0).sqrt(),
            samples: self.arrivals.len(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{AgeBasis, Encapsulation, Guid, SampleKey, SourceTimestamp};

    fn sample(sequence: u64, at_ms: u64) -> SampleHeader {
        SampleHeader {
            sequence,
            source_timestamp: SourceTimestamp::NONE,
            taken_at: MonotonicNs(0).plus_ms(at_ms),
            published_at: MonotonicNs(0),
            writer_sequence: 0,
            writer_guid: Guid::default(),
            encapsulation: Encapsulation::CDR_LE,
            age_basis: AgeBasis::SOURCE,
            key: SampleKey::NONE,
        }
    }

    fn statistics_of(samples: &[(u64, u64)]) -> Option<IntervalStatistics> {
        let mut intervals = Intervals::default();
        for &(sequence, at_ms) in samples {
            intervals.record(&sample(sequence, at_ms));
        }
        intervals.statistics()
    }

    #[test]
    fn rate_and_spread_are_those_of_the_arrivals() {
        let found = statistics_of(&[(1, 0), (2, 8), (3, 20), (4, 28), (5, 40)]).unwrap();
        assert_eq!((found.rate_hz, found.min_ms, found.max_ms), (100.0, 8.0, 12.0));
        assert!((found.std_ms - 2.0).abs() < 1e-9, "{found:?}");
        assert_eq!(found.samples, 5);
    }

    #[test]
    fn missed_samples_do_not_lower_the_rate_and_add_no_interval() {
        let found = statistics_of(&[(1, 0), (2, 10), (7, 60), (8, 70)]).unwrap();
        assert_eq!((found.rate_hz, found.min_ms, found.max_ms), (100.0, 10.0, 10.0));
    }

    #[test]
    fn only_the_window_counts() {
        let within = (0..WINDOW_SAMPLES as u64).map(|number| (2 + number, 1_000 + 10 * number));
        let found = statistics_of(&[(1, 0)].into_iter().chain(within).collect::<Vec<_>>()).unwrap();
        assert_eq!((found.rate_hz, found.samples), (100.0, WINDOW_SAMPLES));
    }

    #[test]
    fn a_sequence_number_that_goes_back_clears_the_window() {
        let found = statistics_of(&[(900, 0), (901, 1), (1, 5_000), (2, 5_010)]).unwrap();
        assert_eq!((found.rate_hz, found.samples), (100.0, 2));
    }

    #[test]
    fn one_sample_has_no_rate() {
        assert_eq!(statistics_of(&[]), None);
        assert_eq!(statistics_of(&[(1, 5)]), None);
        assert_eq!(statistics_of(&[(1, 5), (3, 6)]), None);
    }
}
