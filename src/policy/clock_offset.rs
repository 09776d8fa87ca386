//! Whether a publisher's clock disagrees with ours, and how late its samples are nevertheless.
//!
//! One-way delays alone can't tell a clock that is behind from a link that is slow. What tells them apart is
//! how the delay changes: a queue in order lets the delay grow no faster than time passes, because the source
//! timestamps behind it still rise. Only a clock that steps lets source timestamps fall.

use crate::model::{AgeBasis, MonotonicNs, WallNs};

const MS: i64 = 1_000_000;

/// A delay beyond these, measured from the source timestamp, is an offset between the clocks if it is steady.
/// No delay is negative; 50 ms are for clocks that NTP keeps together over Wi-Fi.
const AHEAD_NS: i64 = 50 * MS;
const BEHIND_NS: i64 = 100 * MS;

/// Delays within this of the least delay are those of a link without a queue.
const NEAR_NS: i64 = 100 * MS;

/// Source timestamps that fall by more than this show a clock that was set; less is reordering.
const STEP_NS: i64 = 50 * MS;

/// Delays that differ by less than `NEAR_NS` for so long, in so many samples, are steady.
const STEADY_MS: u64 = 2_000;
const STEADY_SAMPLES: u32 = 5;

/// The least delay may rise by 5 ms in 10 s (500 ppm), which is more than two crystals drift apart and less
/// than a queue grows.
const DRIFT_WINDOW_MS: u64 = 10_000;
const DRIFT_NS: i64 = 5 * MS;

/// The clock of one publisher, held against ours sample by sample. It neither waits nor allocates.
#[derive(Clone, Copy, Debug, Default)]
pub struct ClockOffset {
    last: Option<Last>,
    /// The least delay, from the source timestamp to our monotonic clock. Its absolute value means nothing:
    /// our wall clock may be set without a change of it.
    base_ns: Option<i64>,
    /// From our monotonic to our wall clock when `base_ns` was found.
    base_wall_ns: i64,
    drift: Drift,
    candidate: Option<Candidate>,
    /// Whether the candidate began with a clock that was set, so that no queue explains it.
    was_set: bool,
    is_off: bool,
    offset_ns: i64,
}

#[derive(Clone, Copy, Debug)]
struct Last {
    source_ns: i64,
    at: MonotonicNs,
}

/// The least delay of the last seconds, for a base that drifts.
#[derive(Clone, Copy, Debug, Default)]
struct Drift {
    least_ns: i64,
    began_at: MonotonicNs,
}

/// Delays that may become the base.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    least_ns: i64,
    most_ns: i64,
    began_at: MonotonicNs,
    samples: u32,
}

impl ClockOffset {
    /// Takes in the source timestamp of a sample that arrived `now`; says from when its age runs.
    pub fn observe(&mut self, source: WallNs, now: MonotonicNs, now_wall: WallNs) -> AgeBasis {
        let (source_ns, now_ns) = (signed(source.0), signed(now.0));
        let delay_ns = now_ns.saturating_sub(source_ns);
        let wall_ns = signed(now_wall.0).saturating_sub(now_ns);
        let first = self.last.is_none();
        self.was_set |= self.last.is_some_and(|last| last.source_ns.saturating_sub(source_ns) > STEP_NS);
        self.last = Some(Last { source_ns, at: now });
        if first && agrees(delay_ns.saturating_add(wall_ns), 1) {
            self.found(delay_ns, wall_ns, now);
        }
        self.follow(delay_ns, wall_ns, now);
        let Some(base_ns) = self.base_ns else { return AgeBasis::SOURCE };
        self.offset_ns = base_ns.saturating_add(wall_ns);
        // Once off, it agrees again only at half the bounds, so that it does not flap.
        self.is_off = !agrees(self.offset_ns, if self.is_off { 2 } else { 1 });
        match self.is_off {
            true => AgeBasis::arrival(delay_ns.saturating_sub(base_ns).max(0).unsigned_abs()),
            false => AgeBasis::SOURCE,
        }
    }

    /// How far the publisher's clock is behind ours in nanoseconds, negative when it is ahead; `None` while
    /// the clocks agree or too little is known.
    pub fn offset_ns(&self) -> Option<i64> {
        self.is_off.then_some(self.offset_ns)
    }

    /// When the last sample arrived.
    pub fn last_at(&self) -> Option<MonotonicNs> {
        self.last.map(|last| last.at)
    }

    fn follow(&mut self, delay_ns: i64, wall_ns: i64, now: MonotonicNs) {
        if let Some(base_ns) = self.base_ns {
            let is_near = |base_ns: i64| delay_ns.saturating_sub(base_ns).saturating_abs() <= NEAR_NS;
            // A publisher that shares our wall clock steps with it.
            let stepped_ns = wall_ns.saturating_sub(self.base_wall_ns);
            let moved_ns = base_ns.saturating_sub(stepped_ns);
            if is_near(base_ns) {
                self.near(base_ns, delay_ns, wall_ns, now);
                return;
            } else if stepped_ns.saturating_abs() > STEP_NS && is_near(moved_ns) {
                self.found(moved_ns, wall_ns, now);
                return;
            }
        }
        let mut candidate = self.candidate.unwrap_or(Candidate::new(delay_ns, now));
        candidate.add(delay_ns, now);
        self.candidate = Some(candidate);
        // A delay above the base that no set clock explains is a late sample's.
        let may_be_base = self.was_set || self.base_ns.is_none_or(|base_ns| delay_ns < base_ns);
        if may_be_base && candidate.is_steady(now) {
            self.found(candidate.least_ns, wall_ns, now);
        }
    }

    /// A delay of a link without a queue.
    fn near(&mut self, base_ns: i64, delay_ns: i64, wall_ns: i64, now: MonotonicNs) {
        self.candidate = None;
        self.was_set = false;
        let mut base_ns = base_ns.min(delay_ns);
        self.drift.least_ns = self.drift.least_ns.min(delay_ns);
        if now.since(self.drift.began_at) >= DRIFT_WINDOW_MS * 1_000_000 {
            base_ns = self.drift.least_ns.clamp(base_ns, base_ns.saturating_add(DRIFT_NS));
            self.drift = Drift { least_ns: delay_ns, began_at: now };
            if wall_ns.saturating_sub(self.base_wall_ns).saturating_abs() <= STEP_NS {
                self.base_wall_ns = wall_ns;
            }
        }
        self.base_ns = Some(base_ns);
    }

    fn found(&mut self, base_ns: i64, wall_ns: i64, now: MonotonicNs) {
        self.base_ns = Some(base_ns);
        self.base_wall_ns = wall_ns;
        self.drift = Drift { least_ns: base_ns, began_at: now };
        self.candidate = None;
        self.was_set = false;
    }
}

impl Candidate {
    fn new(delay_ns: i64, now: MonotonicNs) -> Self {
        Self { least_ns: delay_ns, most_ns: delay_ns, began_at: now, samples: 0 }
    }

    /// Begins again where the delays are not steady.
    fn add(&mut self, delay_ns: i64, now: MonotonicNs) {
        let (least_ns, most_ns) = (self.least_ns.min(delay_ns), self.most_ns.max(delay_ns));
        if most_ns.saturating_sub(least_ns) > NEAR_NS {
            *self = Self::new(delay_ns, now);
        } else {
            (self.least_ns, self.most_ns) = (least_ns, most_ns);
        }
        self.samples = self.samples.saturating_add(1);
    }

    fn is_steady(&self, now: MonotonicNs) -> bool {
        self.samples >= STEADY_SAMPLES && now.since(self.began_at) >= STEADY_MS * 1_000_000
    }
}

/// Whether clocks with that least delay between them agree, within the bounds divided by `by`.
fn agrees(offset_ns: i64, by: i64) -> bool {
    (-AHEAD_NS / by..=BEHIND_NS / by).contains(&offset_ns)
}

fn signed(ns: u64) -> i64 {
    i64::try_from(ns).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const EPOCH_MS: i64 = 1_763_000_000_000;

    /// A publisher and a bridge in virtual time, in milliseconds.
    #[derive(Default)]
    struct Bed {
        clock: ClockOffset,
        /// What our wall clock shows beyond the true time.
        ours_ms: i64,
        /// What the publisher's clock shows beyond the true time.
        theirs_ms: i64,
    }

    impl Bed {
        fn of(theirs_ms: i64) -> Self {
            Self { theirs_ms, ..Self::default() }
        }

        /// A sample written at `at_ms` that takes `delay_ms` to arrive; its age on arrival in milliseconds.
        fn sample(&mut self, at_ms: i64, delay_ms: i64) -> i64 {
            let ns = |ms: i64| ms.unsigned_abs() * 1_000_000;
            let source = WallNs(ns(EPOCH_MS + at_ms + self.theirs_ms));
            let arrival_ms = at_ms + delay_ms;
            let now_wall = WallNs(ns(EPOCH_MS + arrival_ms + self.ours_ms));
            match self.clock.observe(source, MonotonicNs(ns(1_000 + arrival_ms)), now_wall).late_ns() {
                Some(late_ns) => i64::try_from(late_ns).unwrap() / MS,
                None => i64::try_from(now_wall.since(source)).unwrap() / MS,
            }
        }

        /// Samples at 50 Hz from `from_ms` to `to_ms` with that delay; the age of the last.
        fn run(&mut self, from_ms: i64, to_ms: i64, delay_ms: impl Fn(i64) -> i64) -> i64 {
            let times = (from_ms..to_ms).step_by(20);
            times.fold(0, |_, at_ms| self.sample(at_ms, delay_ms(at_ms)))
        }
    }

    #[test]
    fn a_steady_offset_is_taken_out_of_the_age() {
        for theirs_ms in [-3_600_000, -5_000, -150, 5_000, 3_600_000] {
            let mut bed = Bed::of(theirs_ms);
            let age_ms = bed.run(0, 3_000, |at_ms| 2 + at_ms / 20 % 5);
            assert!(age_ms <= 6, "{theirs_ms}: {age_ms}");
            let offset_ms = bed.clock.offset_ns().unwrap() / MS;
            assert!((offset_ms + theirs_ms).abs() <= 10, "{theirs_ms}: {offset_ms}");
        }
    }

    #[test]
    fn clocks_that_agree_are_left_alone() {
        for theirs_ms in [-60, -10, 0, 10, 40] {
            let mut bed = Bed::of(theirs_ms);
            bed.run(0, 60_000, |at_ms| 2 + at_ms / 20 % 7);
            assert_eq!(bed.clock.offset_ns(), None, "{theirs_ms}");
        }
    }

    #[test]
    fn a_link_that_queues_is_no_offset_and_its_samples_are_late() {
        let mut bed = Bed::default();
        bed.run(0, 5_000, |_| 2);
        // The queue grows to 3 s, stays there for a minute, and drains.
        assert_eq!(bed.run(5_000, 15_000, |at_ms| 2 + (at_ms - 5_000) * 3 / 10), 2 + 9_980 * 3 / 10);
        assert_eq!(bed.run(15_000, 75_000, |_| 3_002), 3_002);
        assert_eq!(bed.clock.offset_ns(), None);
        assert_eq!(bed.run(75_000, 80_000, |at_ms| 3_002 - (at_ms - 75_000) * 3 / 5), 3_002 - 4_980 * 3 / 5);
        assert_eq!(bed.run(80_000, 81_000, |_| 2), 2);
    }

    #[test]
    fn a_burst_of_old_samples_is_late() {
        let mut bed = Bed::default();
        bed.run(0, 5_000, |_| 2);
        // An outage of 10 s, then everything that was written meanwhile at once.
        for at_ms in (5_000..15_000).step_by(20) {
            let age_ms = bed.sample(at_ms, 15_000 - at_ms);
            assert_eq!(age_ms, 15_000 - at_ms);
        }
        assert_eq!(bed.run(15_000, 20_000, |_| 2), 2);
        assert_eq!(bed.clock.offset_ns(), None);
    }

    #[test]
    fn a_late_sample_of_a_publisher_with_an_offset_is_late() {
        for theirs_ms in [-5_000, 5_000] {
            let mut bed = Bed::of(theirs_ms);
            bed.run(0, 5_000, |_| 2);
            assert_eq!(bed.sample(5_000, 702), 700);
            assert_eq!(bed.run(5_720, 6_000, |_| 2), 0);
        }
    }

    #[test]
    fn a_clock_that_is_set_is_followed() {
        for (before_ms, after_ms) in [(0, -5_000), (0, 5_000), (-5_000, 0), (5_000, 0), (5_000, -5_000)] {
            let mut bed = Bed::of(before_ms);
            bed.run(0, 10_000, |_| 2);
            bed.theirs_ms = after_ms;
            let age_ms = bed.run(10_000, 13_000, |_| 2);
            assert!(age_ms <= 2, "{before_ms} to {after_ms}: {age_ms}");
            assert_eq!(bed.clock.offset_ns().is_some(), after_ms != 0, "{before_ms} to {after_ms}");
        }
    }

    #[test]
    fn our_own_clock_may_be_set() {
        for step_ms in [-5_000, 5_000] {
            // Alone: the publisher is then off.
            let mut bed = Bed::default();
            bed.run(0, 10_000, |_| 2);
            bed.ours_ms = step_ms;
            assert_eq!(bed.sample(10_000, 2), 0);
            assert_eq!(bed.clock.offset_ns(), Some((step_ms + 2) * MS));
            // With that of a publisher on the same host: no sample is late for it.
            let mut bed = Bed::default();
            bed.run(0, 10_000, |_| 2);
            (bed.ours_ms, bed.theirs_ms) = (step_ms, step_ms);
            assert_eq!(bed.sample(10_000, 2), 2);
            assert_eq!(bed.clock.offset_ns(), None);
        }
    }

    #[test]
    fn clocks_that_drift_apart_are_followed() {
        // 100 ppm behind, for an hour: 360 ms, which no drop of a single sample shows.
        let mut bed = Bed::default();
        for at_ms in (0..3_600_000).step_by(100) {
            bed.theirs_ms = -at_ms / 10_000;
            let age_ms = bed.sample(at_ms, 2);
            assert!(age_ms <= 110, "{at_ms}: {age_ms}");
        }
        assert!(bed.clock.offset_ns().is_some());
    }

    proptest! {
        #[test]
        fn any_offset_with_jitter_is_found_and_any_late_sample_stays_late(
            theirs_ms in prop_oneof![-100_000i64..-200, 100i64..100_000],
            jitter in prop::collection::vec(0i64..60, 200),
            late_ms in 300i64..20_000,
        ) {
            let mut bed = Bed::of(theirs_ms);
            for (number, jitter_ms) in jitter.iter().enumerate() {
                bed.sample(number as i64 * 20, 2 + jitter_ms);
            }
            let offset_ms = bed.clock.offset_ns().map(|offset_ns| offset_ns / MS);
            prop_assert!(offset_ms.is_some_and(|found| (found + theirs_ms).abs() <= 70), "{:?}", offset_ms);
            let age_ms = bed.sample(4_000, late_ms);
            prop_assert!((age_ms - late_ms).abs() <= 70, "{} for {}", age_ms, late_ms);
        }

        #[test]
        fn no_timestamps_make_it_panic(
            samples in prop::collection::vec((any::<u64>(), any::<u64>(), any::<u64>()), 0..50),
        ) {
            let mut clock = ClockOffset::default();
            for (source, now, wall) in samples {
                clock.observe(WallNs(source), MonotonicNs(now), WallNs(wall));
            }
        }
    }
}
