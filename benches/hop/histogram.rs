//! Sums and quantiles of the latency histograms on the bridge's boards.

use std::collections::BTreeMap;

use adaptive_bridge::model::LatencyHistogram;
use adaptive_bridge_measure::hop::Quantiles;

/// The sum of one or more histograms: the count of each bucket by its upper bound in nanoseconds.
#[derive(Clone, Debug, Default)]
pub struct Buckets(BTreeMap<u64, u64>);

impl Buckets {
    pub fn add(&mut self, histogram: &LatencyHistogram) {
        for (upper_ns, count) in histogram.buckets() {
            *self.0.entry(upper_ns).or_default() += count;
        }
    }

    pub fn merge(&mut self, other: &Self) {
        for (upper_ns, count) in &other.0 {
            *self.0.entry(*upper_ns).or_default() += count;
        }
    }

    pub fn since(&self, before: &Self) -> Self {
        let earlier = |upper_ns: &u64| before.0.get(upper_ns).copied().unwrap_or_default();
        Self(self.0.iter().map(|(upper, count)| (*upper, count.saturating_sub(earlier(upper)))).collect())
    }

    /// A quantile in µs, interpolated within its bucket, whose width is 1/16 of its value.
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        let total: u64 = self.0.values().sum();
        let rank = quantile * total as f64;
        let (mut seen, mut lower_ns) = (0.0, 0.0);
        for (&upper_ns, &count) in &self.0 {
            let count = count as f64;
            if count > 0.0 && seen + count >= rank {
                let share = ((rank - seen) / count).clamp(0.0, 1.0);
                return (lower_ns + (upper_ns as f64 - lower_ns) * share) / 1_000.0;
            }
            seen += count;
            lower_ns = upper_ns as f64;
        }
        f64::NAN
    }

    pub fn quantiles(&self) -> Quantiles {
        let samples: u64 = self.0.values().sum();
        let of = |quantile: f64, least: u64| (samples >= least).then(|| self.quantile_us(quantile));
        Quantiles {
            samples,
            p50_us: of(0.5, 1),
            p99_us: of(0.99, 100),
            p999_us: of(0.999, 1_000),
            max_us: of(1.0, 1),
        }
    }
}
