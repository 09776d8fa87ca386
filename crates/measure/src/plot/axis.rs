//! Axes of plots: map values to coordinates, and choose the marks.

/// A linear or logarithmic scale from values to coordinates.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    logarithmic: bool,
    low: f64,
    high: f64,
    /// Coordinate of `low`.
    from: f64,
    /// Coordinate of `high`.
    to: f64,
}

impl Axis {
    /// Creates a linear scale.
    pub fn linear((low, high): (f64, f64), (from, to): (f64, f64)) -> Self {
        Self { logarithmic: false, low, high: if high > low { high } else { low + 1.0 }, from, to }
    }

    /// Creates a logarithmic scale over whole decades that contain both values.
    pub fn decades((low, high): (f64, f64), (from, to): (f64, f64)) -> Self {
        /// The smallest value of a scale: for milliseconds, a hundredth of a microsecond.
        const SMALLEST: f64 = 1e-5;
        let low = 10_f64.powf(low.max(SMALLEST).log10().floor());
        let high = 10_f64.powf(high.max(SMALLEST).log10().ceil()).max(low * 10.0);
        Self { logarithmic: true, low, high, from, to }
    }

    /// The coordinate of a value; a value outside the scale is drawn at the scale's end.
    pub fn at(&self, value: f64) -> f64 {
        let share = if self.logarithmic {
            (value.max(self.low) / self.low).log10() / (self.high / self.low).log10()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        self.from + share.clamp(0.0, 1.0) * (self.to - self.from)
    }

    /// The round values that get a mark, about `most` at most.
    pub fn marks(&self, most: usize) -> Vec<f64> {
        let most = most.max(1) as f64;
        if self.logarithmic {
            let decades = (self.high / self.low).log10().round() as i32;
            let step = (f64::from(decades) / most).ceil().max(1.0) as usize;
            return (0..=decades).step_by(step).map(|decade| self.low * 10_f64.powi(decade)).collect();
        }
        let rough = (self.high - self.low) / most;
        let decade = 10_f64.powf(rough.log10().floor());
        let step =
            [1.0, 2.0, 5.0, 10.0].map(|step| step * decade).into_iter().find(|step| *step >= rough * 0.999);
        let step = step.unwrap_or(decade * 10.0);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step + 1e-9).floor() as i64;
        (first..=last).map(|mark| mark as f64 * step).collect()
    }

    /// The text of a mark.
    pub fn label(value: f64) -> String {
        let magnitude = value.abs();
        if magnitude >= 10_000.0 {
            return format!("{}k", round(value / 1000.0));
        }
        round(value)
    }
}

/// Formats a value with three significant digits, without trailing zeros.
fn round(value: f64) -> String {
    let decimals =
        if value == 0.0 { 0 } else { (2 - value.abs().log10().floor() as i32).clamp(0, 6) as usize };
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn labels(axis: &Axis, most: usize) -> Vec<String> {
        axis.marks(most).into_iter().map(Axis::label).collect()
    }

    #[test]
    fn marks_are_round() {
        assert_eq!(labels(&Axis::linear((0.0, 32.0), (0.0, 1.0)), 4), ["0", "10", "20", "30"]);
        assert_eq!(labels(&Axis::linear((0.0, 240.0), (0.0, 1.0)), 6), ["0", "50", "100", "150", "200"]);
        assert_eq!(labels(&Axis::linear((0.0, 1.0), (0.0, 1.0)), 5), ["0", "0.2", "0.4", "0.6", "0.8", "1"]);
        let decades = Axis::decades((0.3, 15_000.0), (0.0, 100.0));
        assert_eq!(labels(&decades, 8), ["0.1", "1", "10", "100", "1000", "10k", "100k"]);
        assert_eq!(labels(&decades, 3), ["0.1", "10", "1000", "100k"]);
    }

    #[test]
    fn values_map_to_coordinates() {
        let axis = Axis::decades((1.0, 1000.0), (30.0, 0.0));
        assert_eq!(
            [0.0, 1.0, 10.0, 1000.0, 1e9].map(|value| axis.at(value).round()),
            [30.0, 30.0, 20.0, 0.0, 0.0]
        );
        let axis = Axis::linear((0.0, 10.0), (100.0, 200.0));
        assert_eq!([-1.0, 0.0, 2.5, 11.0].map(|value| axis.at(value)), [100.0, 100.0, 125.0, 200.0]);
        // A scale of equal limits is extended.
        assert!(Axis::linear((3.0, 3.0), (0.0, 1.0)).at(3.0).is_finite());
        assert_eq!(Axis::decades((0.0, 0.0), (0.0, 1.0)).at(0.0), 0.0);
    }

    proptest! {
        #[test]
        fn marks_are_within_the_scale_and_few(
            low in -1e4..1e4_f64, extent in 1e-3..1e6_f64, most in 2..10_usize,
        ) {
            let axis = Axis::linear((low, low + extent), (0.0, 1.0));
            let marks = axis.marks(most);
            prop_assert!(marks.len() <= most + 1, "{marks:?}");
            let scale = low - extent * 1e-6..=low + extent * 1.000_001;
            prop_assert!(marks.iter().all(|mark| scale.contains(mark)));
        }
    }
}
