//! Quantiles, medians with their confidence interval, and growth.

use super::repetitions::Estimate;

/// The quantile of unsorted values by nearest rank; `NaN` without values.
pub fn quantile(values: &[f64], quantile: f64) -> f64 {
    let sorted = sorted(values);
    if sorted.is_empty() {
        return f64::NAN;
    }
    // The small subtraction corrects products such as 0.999 * 1,000, which is 999.0000000000001 in binary.
    let rank = (quantile * sorted.len() as f64 - 1e-9).ceil().max(1.0) as usize;
    sorted[rank.min(sorted.len()) - 1]
}

/// The median: the middle value, or the mean of the two middle ones; `NaN` without values.
pub fn median(values: &[f64]) -> f64 {
    let sorted = sorted(values);
    if sorted.is_empty() {
        return f64::NAN;
    }
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { f64::midpoint(sorted[middle - 1], sorted[middle]) }
}

/// The 95 % confidence interval of the median of the distribution that the values are drawn from, which is
/// that of [`Estimate`]. `None` with fewer than six values, which are not enough.
pub fn median_interval(values: &[f64]) -> Option<(f64, f64)> {
    let estimate = Estimate::of(values.iter().copied()).filter(Estimate::is_confident)?;
    Some((estimate.low, estimate.high))
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|value| !value.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    sorted
}

/// The growth of a value per unit of time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Growth {
    /// The median of the slopes between all pairs of points (Theil and Sen), which outliers do not move.
    pub slope: f64,
    /// The lower end of the slope's 95 % confidence interval (Sen, 1968).
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

/// The growth of a value per unit of time. Uses at most 500 points, evenly chosen. `None` with fewer than
/// three points.
pub fn growth(points: &[(f64, f64)]) -> Option<Growth> {
    const MAX_POINTS: usize = 500;
    let step = points.len().div_ceil(MAX_POINTS).max(1);
    let points: Vec<(f64, f64)> = points.iter().copied().step_by(step).collect();
    if points.len() < 3 {
        return None;
    }
    let slopes: Vec<f64> = points
        .iter()
        .enumerate()
        .flat_map(|(index, one)| points[index + 1..].iter().map(move |other| (one, other)))
        .filter(|(one, other)| other.0 > one.0)
        .map(|(one, other)| (other.1 - one.1) / (other.0 - one.0))
        .collect();
    let slopes = sorted(&slopes);
    let (first, last) = (*slopes.first()?, *slopes.last()?);
    // Kendall's statistic of points without a trend has this variance; 1.96 standard deviations of it are the
    // distance of the interval's ranks.
    let count = points.len() as f64;
    let distance = 1.96 * (count * (count - 1.0) * (2.0 * count + 5.0) / 18.0).sqrt();
    let middle = slopes.len() as f64 / 2.0;
    let at = |rank: f64| if rank < 0.0 { None } else { slopes.get(rank as usize).copied() };
    Some(Growth {
        slope: median(&slopes),
        low: at((middle - distance / 2.0).floor() - 1.0).unwrap_or(first),
        high: at((middle + distance / 2.0).floor()).unwrap_or(last),
    })
}
