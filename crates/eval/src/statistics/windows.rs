//! Rates over windows of time, as the paper defines the publisher's (section IV-D).

/// The paper's window, in seconds.
pub const WINDOW_S: f64 = 5.0;

/// The step of the sliding window, in seconds. The paper does not give it; a step of a second separates
/// stalls of one second, and a finer step changes the standard deviation by less than it varies between runs.
const STEP_S: f64 = 1.0;

/// Tolerance for rounding errors at the borders of windows, in seconds.
const BORDER_S: f64 = 1e-6;

/// Mean and population standard deviation of values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The standard deviation.
    pub deviation: f64,
}

impl Spread {
    /// Computes mean and standard deviation of these values; `None` without values.
    pub fn of(values: impl IntoIterator<Item = f64> + Clone) -> Option<Self> {
        let count = values.clone().into_iter().count() as f64;
        if count == 0.0 {
            return None;
        }
        let mean = values.clone().into_iter().sum::<f64>() / count;
        let square = values.into_iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        Some(Self { mean, deviation: square.sqrt() })
    }
}

/// The rates in the positions of a sliding window.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RateOverTime {
    /// The middle of each window in seconds, and the rate in it in Hz.
    pub points: Vec<(f64, f64)>,
}

impl RateOverTime {
    /// Mean and standard deviation over the windows; `None` for a run shorter than a window.
    pub fn spread(&self) -> Option<Spread> {
        Spread::of(self.points.iter().map(|point| point.1))
    }
}

/// Computes the rate of events at `times_s` over windows of [`WINDOW_S`] that slide by a second and lie
/// completely between `from_s` and `to_s`.
///
/// The first window starts half a `period_s` before the first event, if there is one. If windows started at
/// events, it would be chance whether an event at the border falls into one window or the next, and even a
/// perfectly regular publisher would have a standard deviation above 0.
pub fn sliding_rate(times_s: &[f64], from_s: f64, to_s: f64, period_s: f64) -> RateOverTime {
    let mut times: Vec<f64> = times_s.iter().copied().filter(|time| (from_s..to_s).contains(time)).collect();
    times.sort_by(f64::total_cmp);
    // The phase is below one step, so that no second of the run is left out.
    let phase = times.first().map_or(0.0, |first| (first - period_s / 2.0 - from_s).rem_euclid(STEP_S));
    let begin = if phase > STEP_S - BORDER_S { from_s } else { from_s + phase };
    let count_before = |time: f64| times.partition_point(|event| *event < time);
    let points = (0..)
        .map(|step| begin + f64::from(step) * STEP_S)
        .take_while(|start| start + WINDOW_S <= to_s + BORDER_S)
        .map(|start| {
            let events = count_before(start + WINDOW_S) - count_before(start);
            (start + WINDOW_S / 2.0, events as f64 / WINDOW_S)
        })
        .collect();
    RateOverTime { points }
}

/// The time-weighted mean, from `from_s` to `to_s`, of a quantity that keeps each value of `(time, value)`
/// until the next; `None` when no value applies to that time.
pub fn mean_level(points: &[(f64, f64)], from_s: f64, to_s: f64) -> Option<f64> {
    let (mut sum, mut known_s) = (0.0, 0.0);
    for (index, (time, value)) in points.iter().enumerate() {
        let until = points.get(index + 1).map_or(to_s, |next| next.0);
        let held = until.min(to_s) - time.max(from_s);
        if held > 0.0 {
            sum += value * held;
            known_s += held;
        }
    }
    (known_s > 0.0).then(|| sum / known_s)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn regular(rate_hz: f64, from_s: f64, to_s: f64) -> Vec<f64> {
        let times = (0..).map(|event| from_s + f64::from(event) / rate_hz);
        times.take_while(|time| *time < to_s).collect()
    }

    #[test]
    fn a_regular_publisher_has_its_rate_without_deviation() {
        let rate = sliding_rate(&regular(30.0, 0.01, 120.0), 0.0, 120.0, 1.0 / 30.0);
        let spread = rate.spread().unwrap();
        assert!((spread.mean - 30.0).abs() < 1e-9, "{spread:?}");
        assert!(spread.deviation < 1e-9, "{spread:?}");
        assert!(rate.points.len() >= 115, "{}", rate.points.len());
    }

    #[test]
    fn a_stall_lowers_the_rate_of_the_windows_that_contain_it() {
        // 10 Hz for 5 s, nothing for 5 s, 10 Hz for 5 s.
        let mut times = regular(10.0, 0.05, 5.0);
        times.extend(regular(10.0, 10.05, 15.0));
        let rate = sliding_rate(&times, 0.0, 15.0, 0.1);
        let rates: Vec<f64> = rate.points.iter().map(|point| point.1).collect();
        assert_eq!(rates, [10.0, 8.0, 6.0, 4.0, 2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(rate.points[0].0, 2.5);
        let spread = rate.spread().unwrap();
        // Mean 60 / 11; mean of squares 440 / 11.
        assert!((spread.mean - 60.0 / 11.0).abs() < 1e-12);
        assert!((spread.deviation - (40.0 - (60.0_f64 / 11.0).powi(2)).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn silence_counts_and_a_run_shorter_than_a_window_has_no_rate() {
        assert_eq!(sliding_rate(&[], 0.0, 10.0, 0.1).spread(), Some(Spread { mean: 0.0, deviation: 0.0 }));
        assert_eq!(sliding_rate(&[1.0, 2.0], 0.0, 4.9, 1.0).spread(), None);
        // Events outside of the run are ignored.
        let rate = sliding_rate(&[-1.0, 2.5, 11.0], 0.0, 5.0, 5.0);
        assert_eq!(rate.points, [(2.5, 0.2)]);
    }

    #[test]
    fn a_level_is_weighted_by_its_duration() {
        let points = [(0.0, 10.0), (4.0, 3.0), (8.0, 10.0)];
        assert_eq!(mean_level(&points, 0.0, 10.0), Some((40.0 + 12.0 + 20.0) / 10.0));
        assert_eq!(mean_level(&points, 4.0, 8.0), Some(3.0));
        assert_eq!(mean_level(&points, 6.0, 9.0), Some((6.0 + 10.0) / 3.0));
        assert_eq!(mean_level(&points[1..], 0.0, 4.0), None);
        assert_eq!(mean_level(&[], 0.0, 4.0), None);
    }

    proptest! {
        #[test]
        fn a_regular_publisher_has_no_deviation_at_any_phase_and_rate(
            rate_hz in 1_u32..=200, phase in 0.0..1.0_f64, to_s in 6.0..40.0_f64,
        ) {
            let rate_hz = f64::from(rate_hz);
            let times = regular(rate_hz, phase / rate_hz, to_s);
            let spread = sliding_rate(&times, 0.0, to_s, 1.0 / rate_hz).spread().unwrap();
            // The last window may end less than a period after the last event.
            prop_assert!(spread.deviation <= 0.1, "{spread:?}");
            prop_assert!((spread.mean - rate_hz).abs() <= 0.2, "{spread:?}");
        }

        #[test]
        fn rates_are_in_order_and_at_most_those_of_all_events(
            times in proptest::collection::vec(0.0..60.0_f64, 0..400), to_s in 1.0..60.0_f64,
        ) {
            let rate = sliding_rate(&times, 0.0, to_s, 0.1);
            for pair in rate.points.windows(2) {
                prop_assert!((pair[1].0 - pair[0].0 - 1.0).abs() < 1e-9);
            }
            for (middle, hz) in &rate.points {
                prop_assert!(*hz >= 0.0 && hz * WINDOW_S <= times.len() as f64 + 1e-9);
                prop_assert!(*middle >= WINDOW_S / 2.0 && middle + WINDOW_S / 2.0 <= to_s + 1e-6);
            }
        }
    }
}
