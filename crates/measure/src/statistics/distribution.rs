//! Quantiles and the cumulative distribution of measured values.

/// A distribution of measured values, kept in ascending order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Distribution {
    sorted: Vec<f64>,
}

impl Distribution {
    /// Creates a distribution of these values; ignores values that are not finite.
    pub fn new(values: impl IntoIterator<Item = f64>) -> Self {
        let mut sorted: Vec<f64> = values.into_iter().filter(|value| value.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        Self { sorted }
    }

    /// The number of values.
    pub fn count(&self) -> usize {
        self.sorted.len()
    }

    /// The values, ascending.
    pub fn values(&self) -> &[f64] {
        &self.sorted
    }

    /// The quantile `q`, 0 to 1, with linear interpolation between values (type 7 of Hyndman and Fan, the
    /// default of numpy and R). `None` without values.
    pub fn quantile(&self, q: f64) -> Option<f64> {
        let last = self.sorted.len().checked_sub(1)?;
        let at = q.clamp(0.0, 1.0) * last as f64;
        let below = at.floor() as usize;
        let (low, high) = (self.sorted[below.min(last)], self.sorted[(below + 1).min(last)]);
        Some(low + (high - low) * (at - below as f64))
    }

    /// The largest value; `None` without values.
    pub fn max(&self) -> Option<f64> {
        self.sorted.last().copied()
    }

    /// The arithmetic mean; `None` without values.
    pub fn mean(&self) -> Option<f64> {
        (!self.sorted.is_empty()).then(|| self.sorted.iter().sum::<f64>() / self.sorted.len() as f64)
    }

    /// The number of values above `limit`.
    pub fn above(&self, limit: f64) -> usize {
        self.sorted.len() - self.sorted.partition_point(|value| *value <= limit)
    }

    /// The empirical cumulative distribution as points (value, share of values up to it), for a plot: at most
    /// `points` + 1, evenly spaced by share, the smallest and the largest value among them.
    pub fn curve(&self, points: usize) -> Vec<(f64, f64)> {
        let count = self.sorted.len();
        let Some(last) = count.checked_sub(1) else { return Vec::new() };
        let points = points.clamp(1, last.max(1));
        let mut curve: Vec<(f64, f64)> = (0..=points)
            .map(|point| {
                let rank = point * last / points;
                (self.sorted[rank], (rank + 1) as f64 / count as f64)
            })
            .collect();
        curve.dedup();
        curve
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn quantiles_match_those_calculated_by_hand() {
        let values = Distribution::new([40.0, 10.0, 30.0, 20.0]);
        for (q, expected) in [(0.0, 10.0), (0.5, 25.0), (0.25, 17.5), (0.95, 38.5), (1.0, 40.0)] {
            assert_eq!(values.quantile(q), Some(expected), "{q}");
        }
        assert_eq!(values.max(), Some(40.0));
        assert_eq!(values.mean(), Some(25.0));
        assert_eq!(values.above(20.0), 2);
        assert_eq!(values.above(40.0), 0);
        let one = Distribution::new([7.0]);
        assert_eq!((one.quantile(0.0), one.quantile(0.99), one.mean()), (Some(7.0), Some(7.0), Some(7.0)));
    }

    #[test]
    fn median_and_tail_of_one_to_a_thousand() {
        let values = Distribution::new((1..=1001).map(f64::from));
        assert_eq!(values.quantile(0.5), Some(501.0));
        assert_eq!(values.quantile(0.95), Some(951.0));
        assert_eq!(values.quantile(0.99), Some(991.0));
    }

    #[test]
    fn values_that_are_not_finite_are_ignored_and_an_empty_distribution_has_no_quantile() {
        let none = Distribution::new([f64::NAN, f64::INFINITY]);
        assert_eq!((none.count(), none.quantile(0.5), none.mean(), none.max()), (0, None, None, None));
        assert!(none.curve(10).is_empty());
    }

    #[test]
    fn the_curve_ends_at_the_largest_value_with_a_share_of_one() {
        let values = Distribution::new([4.0, 1.0, 3.0, 2.0]);
        assert_eq!(values.curve(10), [(1.0, 0.25), (2.0, 0.5), (3.0, 0.75), (4.0, 1.0)]);
        assert_eq!(Distribution::new([5.0]).curve(10), [(5.0, 1.0)]);
        let many = Distribution::new((0..10_000).map(f64::from)).curve(100);
        assert_eq!(many.len(), 101);
        assert_eq!((many[0], many[100]), ((0.0, 0.0001), (9_999.0, 1.0)));
    }

    proptest! {
        #[test]
        fn quantiles_rise_and_stay_among_the_values(
            values in proptest::collection::vec(-1e6..1e6_f64, 1..200),
            a in 0.0..=1.0_f64,
            b in 0.0..=1.0_f64,
        ) {
            let values = Distribution::new(values);
            let [low, high] = [a.min(b), a.max(b)].map(|q| values.quantile(q).unwrap());
            prop_assert!(low <= high);
            prop_assert!(values.quantile(0.0).unwrap() <= low && high <= values.max().unwrap());
            // At most the share 1 - q of the values is above the quantile q.
            let above = values.above(high) as f64;
            prop_assert!(above <= (1.0 - a.max(b)) * (values.count() - 1) as f64 + 1.0);
        }

        #[test]
        fn a_curve_rises_in_both_directions(
            values in proptest::collection::vec(0.0..1e3_f64, 0..300), points in 0..50_usize,
        ) {
            let count = values.len();
            let curve = Distribution::new(values).curve(points);
            prop_assert!(curve.len() <= points.max(1) + 1);
            prop_assert_eq!(curve.is_empty(), count == 0);
            prop_assert!(curve.windows(2).all(|pair| pair[0].0 <= pair[1].0 && pair[0].1 < pair[1].1));
            prop_assert!(curve.last().is_none_or(|point| point.1 == 1.0));
        }
    }
}
