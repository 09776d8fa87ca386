//! Quantiles, medians, and whether something grows.

/// The quantile of unsorted values, by nearest rank; `NaN` of none.
pub fn quantile(values: &[f64], quantile: f64) -> f64 {
    let sorted = sorted(values);
    if sorted.is_empty() {
        return f64::NAN;
    }
    // A share such as 0.999 of 1,000 is 999, not the 999.0000000000001 that it is in binary.
    let rank = (quantile * sorted.len() as f64 - 1e-9).ceil().max(1.0) as usize;
    sorted[rank.min(sorted.len()) - 1]
}

/// The middle value, or the mean of the two middle ones.
pub fn median(values: &[f64]) -> f64 {
    let sorted = sorted(values);
    if sorted.is_empty() {
        return f64::NAN;
    }
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { f64::midpoint(sorted[middle - 1], sorted[middle]) }
}

/// Where the median lies of what the values are drawn from, with a certainty of 95 %: between two of the
/// values. The binomial distribution tells which ones, whatever theirs is. `None` of fewer than six, which
/// can't tell.
pub fn median_interval(values: &[f64]) -> Option<(f64, f64)> {
    let sorted = sorted(values);
    // How likely it is that no more than `below` of the values are less than the median.
    let (mut below, mut chance) = (0, 0.5_f64.powi(i32::try_from(sorted.len()).ok()?));
    let mut total = chance;
    while 2.0 * total <= 0.05 {
        chance *= (sorted.len() - below) as f64 / (below + 1) as f64;
        below += 1;
        total += chance;
    }
    let first = below.checked_sub(1)?;
    Some((sorted[first], sorted[sorted.len() - 1 - first]))
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|value| !value.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    sorted
}

/// How much a value grows for each unit of time: the median of the slopes between all pairs of points (Theil
/// and Sen), which a few outliers do not move. At most 500 points are looked at, evenly chosen. `None` of
/// fewer than three points.
pub fn growth(points: &[(f64, f64)]) -> Option<f64> {
    const MOST: usize = 500;
    let step = points.len().div_ceil(MOST).max(1);
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
    (!slopes.is_empty()).then(|| median(&slopes))
}
