//! Latencies, of the window and of all time.

use crate::model::LatencyHistogram;

/// A latency within the window; at most 6.3 % too large, for it is the upper edge of a bucket.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct Latency {
    /// Samples measured.
    pub count: u64,
    /// Median.
    pub p50_us: Option<f64>,
    /// 99th percentile.
    pub p99_us: Option<f64>,
    /// The largest.
    pub max_us: Option<f64>,
    /// All that was ever measured, for the metrics page. No part of the JSON.
    #[serde(skip)]
    pub total: LatencyTotal,
}

/// All latencies of a stage since the bridge came up, in buckets that double.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatencyTotal {
    /// For each of [`Self::EDGES_NS`], the latencies below it.
    pub below: [u64; Self::EDGES_NS.len()],
    /// All of them.
    pub count: u64,
    /// Their sum, each taken as the middle of its bucket: 3.2 % off at most within 1 µs to 137 s.
    pub sum_ns: u128,
}

impl LatencyTotal {
    /// 16 µs to 17 s, each twice the one before. They are edges of [`LatencyHistogram`]'s buckets, too, so
    /// that the counts are exact.
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
            // The counts are read from shared memory and may be any.
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
    /// Of two readings of a histogram; without the former one there is no window.
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
    fn latencies_are_those_of_the_window_also_the_largest() {
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
    fn the_total_counts_exactly_at_its_edges_and_knows_the_sum() {
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
