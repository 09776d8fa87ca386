//! Measures the age of samples also where the publisher's clock disagrees with this host's.
//!
//! A single one-way delay cannot distinguish a clock that is behind from a slow link. The change of the delay
//! can: in a queue that keeps the order, source timestamps increase, so that the delay grows no faster than
//! time passes. Source timestamps decrease only when a clock steps.

use crate::model::{AgeBasis, MonotonicNs, WallNs};

const MS: i64 = 1_000_000;

/// A steady delay outside these bounds, measured from the source timestamp, is an offset between the clocks.
/// A true delay is never negative; 50 ms are the tolerance for clocks that NTP synchronizes over Wi-Fi.
const AHEAD_NS: i64 = 50 * MS;
const BEHIND_NS: i64 = 100 * MS;

/// A delay at most this far from the minimum delay is that of a link without a queue.
const NEAR_NS: i64 = 100 * MS;

/// A source timestamp that decreases by more than this shows that a clock was set; less is reordering.
const STEP_NS: i64 = 50 * MS;

/// Delays are steady when they differ by less than `NEAR_NS` for this time and in this many samples.
const STEADY_MS: u64 = 2_000;
const STEADY_SAMPLES: u32 = 5;

/// The minimum delay may increase by 5 ms in 10 s (500 ppm): more than the drift between two crystals and
/// less than the growth of a queue.
const DRIFT_WINDOW_MS: u64 = 10_000;
const DRIFT_NS: i64 = 5 * MS;

/// Compares the clock of one publisher with this host's, sample by sample. It neither waits nor allocates.
#[derive(Clone, Copy, Debug, Default)]
pub struct ClockOffset {
    /// The source timestamp and the arrival of the last sample.
    last: Option<(i64, MonotonicNs)>,
    /// The minimum delay, from the source timestamp to this host's monotonic clock. Only its changes have a
    /// meaning; setting this host's wall clock does not change it.
    base_ns: Option<i64>,
    /// This host's wall clock minus its monotonic clock when `base_ns` was set.
    base_wall_ns: i64,
    drift: Drift,
    candidate: Option<Candidate>,
    /// Whether a clock was set since the last delay near the base, so that the candidate is not a queue.
    was_set: bool,
    is_off: bool,
    offset_ns: i64,
}

/// The minimum delay of the current drift window.
#[derive(Clone, Copy, Debug, Default)]
struct Drift {
    min_ns: i64,
    began_at: MonotonicNs,
}

/// Delays away from the base; their minimum becomes the new base if they are steady.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    min_ns: i64,
    max_ns: i64,
    began_at: MonotonicNs,
    samples: u32,
}

impl ClockOffset {
    /// Returns from which instant to measure the age of a sample that arrives at `now`.
    pub fn observe(&mut self, source: WallNs, now: MonotonicNs, now_wall: WallNs) -> AgeBasis {
        let (source_ns, now_ns) = (signed(source.0), signed(now.0));
        let delay_ns = now_ns.saturating_sub(source_ns);
        let wall_ns = signed(now_wall.0).saturating_sub(now_ns);
        let first = self.last.is_none();
        self.was_set |= self.last.is_some_and(|(last_ns, _)| last_ns.saturating_sub(source_ns) > STEP_NS);
        self.last = Some((source_ns, now));
        if first && agrees(delay_ns.saturating_add(wall_ns), 1) {
            self.set_base(delay_ns, wall_ns, now);
        }
        self.update(delay_ns, wall_ns, now);
        let Some(base_ns) = self.base_ns else { return AgeBasis::SOURCE };
        self.offset_ns = base_ns.saturating_add(wall_ns);
        // After a disagreement the bounds are half as wide, so that the result does not flap.
        self.is_off = !agrees(self.offset_ns, if self.is_off { 2 } else { 1 });
        match self.is_off {
            true => AgeBasis::arrival(delay_ns.saturating_sub(base_ns).max(0).unsigned_abs()),
            false => AgeBasis::SOURCE,
        }
    }

    /// How far the publisher's clock is behind this host's in nanoseconds, negative when it is ahead; `None`
    /// while the clocks agree or there are too few samples.
    pub fn offset_ns(&self) -> Option<i64> {
        self.is_off.then_some(self.offset_ns)
    }

    /// When the last sample arrived.
    pub fn last_at(&self) -> Option<MonotonicNs> {
        self.last.map(|(_, at)| at)
    }

    /// Updates the base, or the candidate for a new one, with the delay of a sample.
    fn update(&mut self, delay_ns: i64, wall_ns: i64, now: MonotonicNs) {
        if let Some(base_ns) = self.base_ns {
            let is_near = |base_ns: i64| delay_ns.saturating_sub(base_ns).saturating_abs() <= NEAR_NS;
            // The clock of a publisher on this host steps together with the wall clock.
            let stepped_ns = wall_ns.saturating_sub(self.base_wall_ns);
            let moved_ns = base_ns.saturating_sub(stepped_ns);
            if is_near(base_ns) {
                self.update_base(base_ns, delay_ns, wall_ns, now);
                return;
            } else if stepped_ns.saturating_abs() > STEP_NS && is_near(moved_ns) {
                self.set_base(moved_ns, wall_ns, now);
                return;
            }
        }
        let mut candidate = self.candidate.unwrap_or(Candidate::new(delay_ns, now));
        candidate.add(delay_ns, now);
        self.candidate = Some(candidate);
        // If no clock was set, a delay above the base means a late sample.
        let may_be_base = self.was_set || self.base_ns.is_none_or(|base_ns| delay_ns < base_ns);
        if may_be_base && candidate.is_steady(now) {
            self.set_base(candidate.min_ns, wall_ns, now);
        }
    }

    /// Updates the base with the delay of a link without a queue.
    fn update_base(&mut self, base_ns: i64, delay_ns: i64, wall_ns: i64, now: MonotonicNs) {
        self.candidate = None;
        self.was_set = false;
        let mut base_ns = base_ns.min(delay_ns);
        self.drift.min_ns = self.drift.min_ns.min(delay_ns);
        if now.since(self.drift.began_at) >= DRIFT_WINDOW_MS * 1_000_000 {
            base_ns = self.drift.min_ns.clamp(base_ns, base_ns.saturating_add(DRIFT_NS));
            self.drift = Drift { min_ns: delay_ns, began_at: now };
            if wall_ns.saturating_sub(self.base_wall_ns).saturating_abs() <= STEP_NS {
                self.base_wall_ns = wall_ns;
            }
        }
        self.base_ns = Some(base_ns);
    }

    fn set_base(&mut self, base_ns: i64, wall_ns: i64, now: MonotonicNs) {
        self.base_ns = Some(base_ns);
        self.base_wall_ns = wall_ns;
        self.drift = Drift { min_ns: base_ns, began_at: now };
        self.candidate = None;
        self.was_set = false;
    }
}

impl Candidate {
    fn new(delay_ns: i64, now: MonotonicNs) -> Self {
        Self { min_ns: delay_ns, max_ns: delay_ns, began_at: now, samples: 0 }
    }

    /// Adds a delay; starts again if the delays are not steady.
    fn add(&mut self, delay_ns: i64, now: MonotonicNs) {
        let (min_ns, max_ns) = (self.min_ns.min(delay_ns), self.max_ns.max(delay_ns));
        if max_ns.saturating_sub(min_ns) > NEAR_NS {
            *self = Self::new(delay_ns, now);
        } else {
            (self.min_ns, self.max_ns) = (min_ns, max_ns);
        }
        self.samples = self.samples.saturating_add(1);
    }

    fn is_steady(&self, now: MonotonicNs) -> bool {
        self.samples >= STEADY_SAMPLES && now.since(self.began_at) >= STEADY_MS * 1_000_000
    }
}

/// Whether an offset is within the bounds for clocks that agree, both divided by `divisor`.
fn agrees(offset_ns: i64, divisor: i64) -> bool {
    (-AHEAD_NS / divisor..=BEHIND_NS / divisor).contains(&offset_ns)
}

fn signed(ns: u64) -> i64 {
    i64::try_from(ns).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const EPOCH_MS: i64 = 1_763_000_000_000;

    /// Simulates a publisher and a bridge in virtual time.
    #[derive(Default)]
    struct Simulation {
        clock: ClockOffset,
        /// How far the wall clock of the bridge's host is ahead of the true time.
        host_ms: i64,
        /// How far the publisher's clock is ahead of the true time.
        publisher_ms: i64,
    }

    impl Simulation {
        fn of(publisher_ms: i64) -> Self {
            Self { publisher_ms, ..Self::default() }
        }

        /// Delivers a sample written at `at_ms` after `delay_ms`; returns its age on arrival in milliseconds.
        fn sample(&mut self, at_ms: i64, delay_ms: i64) -> i64 {
            let ns = |ms: i64| ms.unsigned_abs() * 1_000_000;
            let source = WallNs(ns(EPOCH_MS + at_ms + self.publisher_ms));
            let arrival_ms = at_ms + delay_ms;
            let now_wall = WallNs(ns(EPOCH_MS + arrival_ms + self.host_ms));
            match self.clock.observe(source, MonotonicNs(ns(1_000 + arrival_ms)), now_wall).late_ns() {
                Some(late_ns) => i64::try_from(late_ns).unwrap() / MS,
                None => i64::try_from(now_wall.since(source)).unwrap() / MS,
            }
        }

        /// Delivers samples at 50 Hz from `from_ms` to `to_ms`; returns the age of the last.
        fn run(&mut self, from_ms: i64, to_ms: i64, delay_ms: impl Fn(i64) -> i64) -> i64 {
            let times = (from_ms..to_ms).step_by(20);
            times.fold(0, |_, at_ms| self.sample(at_ms, delay_ms(at_ms)))
        }
    }

    #[test]
    fn a_steady_offset_is_subtracted_from_the_age() {
        for publisher_ms in [-3_600_000, -5_000, -150, 5_000, 3_600_000] {
            let mut simulation = Simulation::of(publisher_ms);
            let age_ms = simulation.run(0, 3_000, |at_ms| 2 + at_ms / 20 % 5);
            assert!(age_ms <= 6, "{publisher_ms}: {age_ms}");
            let offset_ms = simulation.clock.offset_ns().unwrap() / MS;
            assert!((offset_ms + publisher_ms).abs() <= 10, "{publisher_ms}: {offset_ms}");
        }
    }

    #[test]
    fn clocks_that_agree_have_no_offset() {
        for publisher_ms in [-60, -10, 0, 10, 40] {
            let mut simulation = Simulation::of(publisher_ms);
            simulation.run(0, 60_000, |at_ms| 2 + at_ms / 20 % 7);
            assert_eq!(simulation.clock.offset_ns(), None, "{publisher_ms}");
        }
    }

    #[test]
    fn a_queue_on_the_link_is_no_offset_and_its_samples_are_late() {
        let mut simulation = Simulation::default();
        simulation.run(0, 5_000, |_| 2);
        // The queue grows to 3 s, stays there for a minute, and drains.
        assert_eq!(simulation.run(5_000, 15_000, |at_ms| 2 + (at_ms - 5_000) * 3 / 10), 2 + 9_980 * 3 / 10);
        assert_eq!(simulation.run(15_000, 75_000, |_| 3_002), 3_002);
        assert_eq!(simulation.clock.offset_ns(), None);
        assert_eq!(
            simulation.run(75_000, 80_000, |at_ms| 3_002 - (at_ms - 75_000) * 3 / 5),
            3_002 - 4_980 * 3 / 5
        );
        assert_eq!(simulation.run(80_000, 81_000, |_| 2), 2);
    }

    #[test]
    fn a_burst_of_old_samples_is_late() {
        let mut simulation = Simulation::default();
        simulation.run(0, 5_000, |_| 2);
        // After an outage of 10 s, all samples written during it arrive together.
        for at_ms in (5_000..15_000).step_by(20) {
            let age_ms = simulation.sample(at_ms, 15_000 - at_ms);
            assert_eq!(age_ms, 15_000 - at_ms);
        }
        assert_eq!(simulation.run(15_000, 20_000, |_| 2), 2);
        assert_eq!(simulation.clock.offset_ns(), None);
    }

    #[test]
    fn a_late_sample_of_a_publisher_with_an_offset_is_late() {
        for publisher_ms in [-5_000, 5_000] {
            let mut simulation = Simulation::of(publisher_ms);
            simulation.run(0, 5_000, |_| 2);
            assert_eq!(simulation.sample(5_000, 702), 700);
            assert_eq!(simulation.run(5_720, 6_000, |_| 2), 0);
        }
    }

    #[test]
    fn the_offset_follows_a_clock_that_is_set() {
        for (before_ms, after_ms) in [(0, -5_000), (0, 5_000), (-5_000, 0), (5_000, 0), (5_000, -5_000)] {
            let mut simulation = Simulation::of(before_ms);
            simulation.run(0, 10_000, |_| 2);
            simulation.publisher_ms = after_ms;
            let age_ms = simulation.run(10_000, 13_000, |_| 2);
            assert!(age_ms <= 2, "{before_ms} to {after_ms}: {age_ms}");
            assert_eq!(simulation.clock.offset_ns().is_some(), after_ms != 0, "{before_ms} to {after_ms}");
        }
    }

    #[test]
    fn the_clock_of_this_host_may_be_set() {
        for step_ms in [-5_000, 5_000] {
            // Without the publisher's: the clocks disagree then.
            let mut simulation = Simulation::default();
            simulation.run(0, 10_000, |_| 2);
            simulation.host_ms = step_ms;
            assert_eq!(simulation.sample(10_000, 2), 0);
            assert_eq!(simulation.clock.offset_ns(), Some((step_ms + 2) * MS));
            // Together with that of a publisher on the same host: no sample is late because of it.
            let mut simulation = Simulation::default();
            simulation.run(0, 10_000, |_| 2);
            (simulation.host_ms, simulation.publisher_ms) = (step_ms, step_ms);
            assert_eq!(simulation.sample(10_000, 2), 2);
            assert_eq!(simulation.clock.offset_ns(), None);
        }
    }

    #[test]
    fn a_late_sample_is_late_also_after_the_clock_of_this_host_was_set_or_slewed() {
        let mut simulation = Simulation::default();
        simulation.run(0, 10_000, |_| 2);
        simulation.host_ms = -5_000;
        assert_eq!(simulation.sample(10_000, 702), 700);
        // By less than a step in each drift window, and by more than one in total.
        let mut simulation = Simulation::default();
        for (from_ms, to_ms, host_ms) in [(0, 5_000, 0), (5_000, 15_000, -30), (15_000, 16_000, -60)] {
            simulation.host_ms = host_ms;
            simulation.run(from_ms, to_ms, |_| 2);
        }
        assert_eq!(simulation.sample(16_000, 152), 150);
    }

    #[test]
    fn delays_that_vary_widely_show_no_offset() {
        let mut simulation = Simulation::of(5_000);
        simulation.run(0, 10_000, |at_ms| if at_ms / 20 % 2 == 0 { 2 } else { 150 });
        assert_eq!(simulation.clock.offset_ns(), None);
    }

    #[test]
    fn the_offset_follows_clocks_that_drift_apart() {
        // For an hour, up to 1.44 s behind, without a step between two samples.
        for ppm in [100, 400] {
            let mut simulation = Simulation::default();
            for at_ms in (0..3_600_000).step_by(100) {
                simulation.publisher_ms = -at_ms * ppm / 1_000_000;
                let age_ms = simulation.sample(at_ms, 2);
                assert!(age_ms <= 110, "{ppm} ppm, {at_ms}: {age_ms}");
            }
            assert!(simulation.clock.offset_ns().is_some());
        }
    }

    #[test]
    fn a_base_takes_both_a_number_of_samples_and_a_time() {
        let mut simulation = Simulation::of(5_000);
        for number in 0..i64::from(STEADY_SAMPLES) + 5 {
            simulation.sample(number, 2);
        }
        assert_eq!(simulation.clock.offset_ns(), None, "many samples within milliseconds");
        let mut simulation = Simulation::of(5_000);
        let steady_ms = i64::try_from(STEADY_MS).unwrap();
        simulation.sample(0, 2);
        simulation.sample(steady_ms + 1, 2);
        assert_eq!(simulation.clock.offset_ns(), None, "two samples");
        let last = simulation.clock.last_at();
        assert_eq!(last, Some(MonotonicNs((1_000 + STEADY_MS + 3) * 1_000_000)));
    }

    #[test]
    fn after_a_disagreement_the_clocks_agree_again_within_half_the_bounds_only() {
        for (after_ms, is_off) in [(40, true), (10, false), (-80, true), (-30, false)] {
            let mut simulation = Simulation::of(5_000);
            simulation.run(0, 5_000, |_| 2);
            simulation.publisher_ms = after_ms;
            simulation.run(5_000, 9_000, |_| 2);
            assert_eq!(simulation.clock.offset_ns().is_some(), is_off, "{after_ms}");
        }
    }

    proptest! {
        #[test]
        fn any_offset_with_jitter_is_found_and_any_late_sample_is_late(
            publisher_ms in prop_oneof![-100_000i64..-200, 100i64..100_000],
            jitter in prop::collection::vec(0i64..60, 200),
            late_ms in 300i64..20_000,
        ) {
            let mut simulation = Simulation::of(publisher_ms);
            for (number, jitter_ms) in jitter.iter().enumerate() {
                simulation.sample(number as i64 * 20, 2 + jitter_ms);
            }
            let offset_ms = simulation.clock.offset_ns().map(|offset_ns| offset_ns / MS);
            let is_close = |found: i64| (found + publisher_ms).abs() <= 70;
            prop_assert!(offset_ms.is_some_and(is_close), "{:?}", offset_ms);
            let age_ms = simulation.sample(4_000, late_ms);
            prop_assert!((age_ms - late_ms).abs() <= 70, "{} for {}", age_ms, late_ms);
        }

        #[test]
        fn extreme_timestamps_do_not_panic(
            samples in prop::collection::vec((any::<u64>(), any::<u64>(), any::<u64>()), 0..50),
        ) {
            let mut clock = ClockOffset::default();
            for (source, now, wall) in samples {
                clock.observe(WallNs(source), MonotonicNs(now), WallNs(wall));
            }
        }
    }
}
