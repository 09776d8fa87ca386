//! Medians over repetitions of a run, and their confidence intervals.

/// The required confidence of an interval.
const CONFIDENCE: f64 = 0.95;

/// The median of a figure over repetitions, and an interval that contains the true median with a known
/// probability.
///
/// The interval is that of order statistics: the median lies between the `k`-th smallest and the `k`-th
/// largest of `n` independent values with the probability `1 - 2 P(Binomial(n, 1/2) < k)`, whatever the
/// distribution. The narrowest of these intervals with a confidence of at least 95 % is used. With fewer than
/// six values there is none; then the interval is from the smallest to the largest value, and `confidence` is
/// its lower confidence: 94 % for five values, 75 % for three, 0 for one. A bootstrap would give narrower
/// intervals of three values, whose real confidence is far below the nominal one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The median.
    pub median: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
    /// The probability that the interval contains the true median, 0 to 1.
    pub confidence: f64,
    /// The smallest value.
    pub min: f64,
    /// The largest value.
    pub max: f64,
    /// The number of values.
    pub count: usize,
}

impl Estimate {
    /// Estimates the median from a figure's values, one for each repetition; `None` without values.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.into_iter().filter(|value| value.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        let count = sorted.len();
        let (&min, &max) = (sorted.first()?, sorted.last()?);
        let median = (sorted[(count - 1) / 2] + sorted[count / 2]) / 2.0;
        let (rank, confidence) = rank(count);
        Some(Self { median, low: sorted[rank], high: sorted[count - 1 - rank], confidence, min, max, count })
    }

    /// Whether the interval's confidence is at least 95 %.
    pub fn is_confident(&self) -> bool {
        self.confidence >= CONFIDENCE
    }
}

/// Returns how many of the smallest and of the largest of `count` values lie outside the interval, and the
/// interval's confidence.
fn rank(count: usize) -> (usize, f64) {
    let n = count as f64;
    // P(Binomial(n, 1/2) = k), from k = 0 on.
    let mut term = 0.5_f64.powf(n);
    let mut below = term;
    let (mut rank, mut confidence) = (0, (1.0 - 2.0 * below).max(0.0));
    for k in 1..=count.saturating_sub(1) / 2 {
        term *= (n - k as f64 + 1.0) / k as f64;
        below += term;
        let narrower = 1.0 - 2.0 * below;
        if narrower < CONFIDENCE {
            break;
        }
        (rank, confidence) = (k, narrower);
    }
    (rank, confidence)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand_distr::Distribution;
    use rand_pcg::Pcg64;

    use super::*;

    #[test]
    fn intervals_match_printed_tables() {
        // Number of values, rank of the lower end counted from 1, confidence in percent (tables of the
        // median's interval in textbooks of nonparametric statistics).
        for (count, expected, percent) in [
            (6, 1, 96.9),
            (7, 1, 98.4),
            (8, 1, 99.2),
            (9, 2, 96.1),
            (10, 2, 97.9),
            (12, 3, 96.1),
            (20, 6, 95.9),
        ] {
            let (rank, confidence) = rank(count);
            assert_eq!((rank + 1, (confidence * 1000.0).round() / 10.0), (expected, percent), "{count}");
        }
    }

    #[test]
    fn fewer_than_six_values_give_their_range_with_its_lower_confidence() {
        for (count, confidence) in [(1, 0.0), (2, 0.5), (3, 0.75), (4, 0.875), (5, 0.9375)] {
            assert_eq!(rank(count), (0, confidence), "{count}");
        }
        let three = Estimate::of([3.0, 1.0, 2.0]).unwrap();
        assert_eq!((three.median, three.low, three.high, three.count), (2.0, 1.0, 3.0, 3));
        assert!(!three.is_confident());
        assert_eq!(Estimate::of([f64::NAN]), None);
        assert_eq!(Estimate::of([1.0, 2.0]).unwrap().median, 1.5);
    }

    #[test]
    fn nine_values_by_hand() {
        let estimate = Estimate::of((1..=9).map(f64::from)).unwrap();
        assert_eq!((estimate.median, estimate.low, estimate.high), (5.0, 2.0, 8.0));
        assert!(estimate.is_confident());
        assert_eq!((estimate.min, estimate.max), (1.0, 9.0));
    }

    /// The interval has its nominal confidence for a distribution that is far from normal.
    #[test]
    fn the_interval_contains_the_median_with_its_nominal_confidence() {
        let mut random = Pcg64::new(7, 11);
        let latency = rand_distr::Exp::new(1.0).unwrap();
        for count in [3, 5, 9] {
            let trials = 20_000;
            let hits = (0..trials)
                .filter(|_| {
                    let estimate = Estimate::of((0..count).map(|_| latency.sample(&mut random))).unwrap();
                    (estimate.low..=estimate.high).contains(&2.0_f64.ln())
                })
                .count();
            let (share, nominal) = (hits as f64 / f64::from(trials), rank(count).1);
            let four_deviations = 4.0 * (nominal * (1.0 - nominal) / f64::from(trials)).sqrt();
            assert!((share - nominal).abs() < four_deviations, "{count}: {share} of {nominal}");
        }
    }

    proptest! {
        #[test]
        fn the_median_is_in_its_interval_and_that_within_the_values(
            values in proptest::collection::vec(-1e3..1e3_f64, 1..60),
        ) {
            let one = Estimate::of(values.iter().copied()).unwrap();
            prop_assert!(one.min <= one.low && one.low <= one.median);
            prop_assert!(one.median <= one.high && one.high <= one.max);
            prop_assert_eq!(one.is_confident(), values.len() >= 6);
        }
    }
}
