//! Latencies: of the window, and since the bridge started.

use crate::model::LatencyHistogram;

/// The latency of a stage within the window. Values are upper edges of buckets: at most 6.3 % too large.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct Latency {
    pub(crate) count: u64,
    pub(crate) p50_us: Option<f64>,
    pub(crate) p99_us: Option<f64>,
    pub(crate) max_us: Option<f64>,
    /// All latencies since the bridge started, for the metrics page; not part of the JSON.
    #[serde(skip)]
    pub(crate) total: LatencyTotal,
}

/// All latencies of a stage since the bridge started, in buckets that double in width.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatencyTotal {
    /// For each of [`Self::EDGES_NS`], the number of latencies below it.
    pub(crate) below: [u64; Self::EDGES_NS.len()],
    /// The number of all latencies.
    pub(crate) count: u64,
    /// The sum of the middles of the buckets: the error is at most 3.2 % from 1 µs to 137 s.
    pub(crate) sum_ns: u128,
}

impl LatencyTotal {
    /// The bucket edges: 16 µs to 17 s, each twice the one before. They are also bucket edges of
    /// [`LatencyHistogram`], so the counts are exact.
    pub const EDGES_NS: [u64; 21] = {
        let mut edges = [1 << 14; 21];
        let mut at = 1;
        while at < edges.len() {
            edges[at] = edges[at - 1] * 2;
            at += 1;
        }
        edges
    };

    fn of(histogram: &LatencyHistogram) -> Self {
        let mut total = Self::default();
        let mut lower_ns = 1_024;
        let mut place = 0;
        for (upper_ns, count) in histogram.buckets() {
            while place < total.below.len() && Self::EDGES_NS[place] < upper_ns {
                total.below[place] = total.count;
                place += 1;
            }
            // The counts come from shared memory and may have any value.
            total.count = total.count.saturating_add(count);
            total.sum_ns += u128::from(count) * u128::from(u64::midpoint(lower_ns, upper_ns));
            lower_ns = upper_ns;
        }
        for below in &mut total.below[place..] {
            *below = total.count;
        }
        total
    }
}

impl Latency {
    /// The latency between two readings of a histogram; without an earlier reading it is empty.
    pub(super) fn of(now: &LatencyHistogram, before: Option<&LatencyHistogram>) -> Self {
        let window = before.map_or_else(LatencyHistogram::default, |before| now.since(before));
        let us = |quantile| window.quantile_ns(quantile).map(|ns| ns as f64 / 1e3);
        Self {
            count: window.count(),
            p50_us: us(0.5),
            p99_us: us(0.99),
            max_us: us(1.0),
            total: LatencyTotal::of(now),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_latencies_including_the_maximum_are_of_the_window() {
        let mut histogram = LatencyHistogram::default();
        histogram.record(90_000_000);
        let before = histogram;
        for _ in 0..100 {
            histogram.record(100_000);
        }
        let found = Latency::of(&histogram, Some(&before));
        assert_eq!((found.count, found.total.count), (100, 101));
        for us in [found.p50_us, found.p99_us, found.max_us] {
            assert!(us.is_some_and(|us| (100.0..=106.3).contains(&us)), "{us:?}");
        }
        assert_eq!(Latency::of(&histogram, None).p50_us, None);
    }

    #[test]
    fn the_total_has_exact_counts_at_its_edges_and_the_sum() {
        let mut histogram = LatencyHistogram::default();
        let mut sum_ns = 0.0;
        for (latency_ns, count) in
            [(500, 1), ((1 << 14) - 1, 2), (1 << 14, 4), (1 << 20, 8), ((1 << 34) - 1, 16), (1 << 34, 32)]
        {
            for _ in 0..count {
                histogram.record(latency_ns);
                sum_ns += latency_ns as f64;
            }
        }
        let total = LatencyTotal::of(&histogram);
        assert_eq!(total.count, 63);
        let below = |edge_ns: u64| {
            let place = LatencyTotal::EDGES_NS.iter().position(|edge| *edge == edge_ns);
            place.map(|place| total.below[place])
        };
        assert_eq!([1 << 14, 1 << 15, 1 << 20, 1 << 21].map(below), [Some(3), Some(7), Some(7), Some(15)]);
        assert_eq!([1 << 33, 1 << 34].map(below), [Some(15), Some(31)]);
        assert!(total.below.is_sorted());
        let error = (total.sum_ns as f64 / sum_ns - 1.0).abs();
        assert!(error < 0.032, "{error}");
        assert_eq!(LatencyTotal::of(&LatencyHistogram::default()), LatencyTotal::default());
    }
}
