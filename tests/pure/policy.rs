//! The data-plane policy in virtual time: random publishers, random lateness, random modes. Pure; nothing
//! sleeps.
//!
//! proptest prints the failing case and keeps its seed in `tests/policy.proptest-regressions`.

use std::collections::BTreeMap;

use adaptive_bridge::model::{
    DropPolicy, DropReason, LaneMode, LanePolicy, LaneRates, MonotonicNs, RatePolicy, SampleKey,
    SourceTimestamp, TrafficClass, WallNs,
};
use adaptive_bridge::policy::{
    Allowance, ByteBudget, Decision, LaneQueue, PollOrder, RouteShaper, SampleStamps, SequenceOutcome,
    SequenceTracker, TokenBucket, burst_for, critical_drop, mode_and_source,
};
use proptest::prelude::*;
use proptest::test_runner::FileFailurePersistence;

const SECOND_NS: u64 = 1_000_000_000;
/// The wall clock at instant 0 of the monotonic one.
const WALL_EPOCH_NS: u64 = 1_763_000_000 * SECOND_NS;
/// A timer never wakes earlier than so much after its instant.
const LATE_NS_MIN: u64 = 50_000;
/// The size of every sample of a run.
const SAMPLE_BYTES: u64 = 1_000;
const POLICIES: [DropPolicy; 3] = [DropPolicy::DropOldest, DropPolicy::DropLatest, DropPolicy::DropStale];

fn wall(now: MonotonicNs) -> WallNs {
    WallNs(WALL_EPOCH_NS + now.0)
}

/// splitmix64: the simulations draw too many numbers for proptest's own generator to record each.
#[derive(Clone)]
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, limit: u64) -> u64 {
        if limit == 0 { 0 } else { self.next() % limit }
    }
}

/// A publisher on a timer: sample n is published after n intervals, late by a random part of `jitter_ns`.
struct Publisher {
    input_hz: f64,
    jitter_ns: u64,
    random: Random,
    sequence: u64,
    next_at: u64,
}

impl Publisher {
    fn new(input_hz: f64, jitter_ns: u64, random: Random) -> Self {
        let mut publisher = Self { input_hz, jitter_ns, random, sequence: 0, next_at: 0 };
        publisher.advance();
        publisher
    }

    fn advance(&mut self) {
        let due_ns = (self.sequence as f64 * 1e9 / self.input_hz) as u64;
        self.sequence += 1;
        self.next_at = self.next_at.max(due_ns + self.random.below(self.jitter_ns));
    }
}

/// A publisher, a target, and a consumer that wakes late.
#[derive(Clone, Copy, Debug)]
struct Setup {
    input_hz: f64,
    /// Of the input interval, peak to peak.
    jitter: f64,
    target_hz: f64,
    /// The consumer wakes at most this long after the requested instant, and at least 50 µs after it.
    late_ns_max: u64,
    drop_policy: DropPolicy,
    queue_samples: usize,
    seed: u64,
}

impl Setup {
    fn rates(&self) -> LaneRates {
        let rate = RatePolicy {
            max_rate_hz: self.target_hz,
            max_bytes_per_s: None,
            stale_threshold_ms: 0,
            drop_policy: self.drop_policy,
            queue_samples: self.queue_samples,
        };
        LaneRates { normal: rate, degraded: rate }
    }

    fn publisher(&self, random: Random) -> Publisher {
        Publisher::new(self.input_hz, (self.jitter * 1e9 / self.input_hz) as u64, random)
    }

    /// Virtual time in which the whole burst is less than a third of a percent of the samples.
    fn duration_ns(&self) -> u64 {
        let tokens = 1_000.0_f64.max(300.0 * burst_for(self.target_hz));
        (tokens / self.target_hz.min(self.input_hz) * 1e9) as u64
    }
}

struct Outcome {
    sent_at: Vec<u64>,
    duration_ns: u64,
}

impl Outcome {
    fn rate_hz(&self) -> f64 {
        self.sent_at.len() as f64 / (self.duration_ns as f64 / 1e9)
    }

    /// Samples beyond `rate_hz × t` in the worst window of any length `t`: the burst that was seen.
    fn burst_seen(&self, rate_hz: f64) -> f64 {
        let (mut lowest, mut worst) = (f64::INFINITY, 0.0_f64);
        for (index, &at_ns) in self.sent_at.iter().enumerate() {
            let ahead = index as f64 - rate_hz * (at_ns as f64 / 1e9);
            lowest = lowest.min(ahead);
            worst = worst.max(ahead - lowest + 1.0);
        }
        worst
    }
}

/// The code under test between publisher and wire, which decides what to send.
trait Gate {
    fn offer(&mut self, sequence: u64, stamps: SampleStamps);
    fn poll(&mut self, now: MonotonicNs) -> Decision<u64>;
    /// Samples dropped and samples waiting.
    fn rest(&self) -> u64;
}

/// The gate of the bridge: the shaper of a noncritical lane.
struct Shaper {
    shaper: RouteShaper<u64>,
    budget: ByteBudget,
    dropped: u64,
}

impl Shaper {
    fn new(rates: LaneRates) -> Self {
        let start = MonotonicNs(0);
        let budget = ByteBudget::new(rates.normal.max_bytes_per_s, start);
        Self { shaper: RouteShaper::new(rates, start), budget, dropped: 0 }
    }
}

impl Gate for Shaper {
    fn offer(&mut self, sequence: u64, stamps: SampleStamps) {
        self.shaper.offer(sequence, stamps, |_, _, _| self.dropped += 1);
    }

    fn poll(&mut self, now: MonotonicNs) -> Decision<u64> {
        self.shaper.poll(&mut self.budget, now, wall(now), |_, _, _| self.dropped += 1)
    }

    fn rest(&self) -> u64 {
        self.dropped + self.shaper.waiting() as u64
    }
}

/// A gate like the shaper, but with a given burst.
struct WithBurst {
    bucket: TokenBucket,
    queue: LaneQueue<u64>,
    /// Tokens shown to the queue at once, at most.
    tokens_max: u64,
    dropped: u64,
}

impl WithBurst {
    fn new(setup: &Setup, burst: f64) -> Self {
        Self {
            bucket: TokenBucket::new(setup.target_hz, burst, MonotonicNs(0)),
            queue: LaneQueue::new(setup.drop_policy, setup.queue_samples),
            tokens_max: u64::MAX,
            dropped: 0,
        }
    }
}

impl Gate for WithBurst {
    fn offer(&mut self, sequence: u64, stamps: SampleStamps) {
        self.queue.offer(sequence, stamps, |_, _, _| self.dropped += 1);
    }

    fn poll(&mut self, now: MonotonicNs) -> Decision<u64> {
        let allowance = Allowance {
            now,
            now_wall: wall(now),
            tokens: self.bucket.tokens(now).min(self.tokens_max),
            bytes: u64::MAX,
            stale_threshold_ms: 0,
        };
        if let Some((item, stamps)) = self.queue.take(&allowance, |_, _, _| self.dropped += 1) {
            assert!(self.bucket.try_take(now));
            return Decision::Send(item, stamps);
        }
        match self.bucket.ready_at(now) {
            Some(at) if at > now => Decision::SleepUntil(at),
            Some(_) => Decision::WaitForSample,
            None => Decision::Closed,
        }
    }

    fn rest(&self) -> u64 {
        self.dropped + self.queue.len() as u64
    }
}

/// The loop that a lane's process runs: wake, take everything out of shared memory, offer, send, sleep.
fn run(setup: &Setup, gate: &mut impl Gate) -> Outcome {
    let mut random = Random(setup.seed);
    let mut publisher = setup.publisher(random.clone());
    let duration_ns = setup.duration_ns();
    let mut outcome = Outcome { sent_at: Vec::new(), duration_ns };
    let (mut now, mut offered, mut last_sent) = (MonotonicNs(0), 0_u64, 0);
    while now.0 < duration_ns {
        while publisher.next_at <= now.0 {
            let taken_at = MonotonicNs(publisher.next_at);
            let source_timestamp = SourceTimestamp::from_wall(wall(taken_at));
            let stamps = SampleStamps {
                sequence: publisher.sequence,
                source_timestamp,
                taken_at,
                bytes: SAMPLE_BYTES,
                key: SampleKey::NONE,
            };
            gate.offer(publisher.sequence, stamps);
            offered += 1;
            publisher.advance();
        }
        let wake_at = loop {
            match gate.poll(now) {
                Decision::Send(item, _) => {
                    assert!(item > last_sent, "{item} after {last_sent}");
                    last_sent = item;
                    outcome.sent_at.push(now.0);
                }
                Decision::SleepUntil(at) => break at.0,
                Decision::WaitForSample => break publisher.next_at,
                Decision::Closed => panic!("a rate above 0 is never closed"),
            }
        };
        let late_ns = LATE_NS_MIN + random.below(setup.late_ns_max - LATE_NS_MIN);
        now = MonotonicNs(wake_at.max(now.0) + late_ns);
    }
    assert_eq!(offered, outcome.sent_at.len() as u64 + gate.rest(), "{setup:?}");
    outcome
}

fn run_lane(setup: &Setup) -> Outcome {
    run(setup, &mut Shaper::new(setup.rates()))
}

fn setup(input_hz: f64, target_hz: f64) -> Setup {
    Setup {
        input_hz,
        jitter: 0.1,
        target_hz,
        late_ns_max: 3_000_000,
        drop_policy: DropPolicy::DropOldest,
        queue_samples: 50,
        seed: 1,
    }
}

fn within(achieved: f64, expected: f64, share: f64) -> bool {
    (achieved - expected).abs() <= expected * share
}

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        failure_persistence: Some(Box::new(FileFailurePersistence::WithSource("proptest-regressions"))),
        ..ProptestConfig::default()
    }
}

/// The same share of cases for each factor of ten.
fn log_uniform(low: f64, high: f64) -> impl Strategy<Value = f64> {
    (low.ln()..high.ln()).prop_map(f64::exp)
}

fn drop_policy() -> impl Strategy<Value = DropPolicy> {
    prop::sample::select(POLICIES.as_slice())
}

/// Input rates and targets of which every third pair is nearly equal: there a lost token is a lost sample.
fn rates_hz() -> impl Strategy<Value = (f64, f64)> {
    let target_hz = || log_uniform(0.5, 1_000.0);
    prop_oneof![
        2 => (log_uniform(1.0, 5_000.0), target_hz()),
        1 => (1.0..1.02_f64, target_hz()).prop_map(|(ratio, target_hz)| (target_hz * ratio, target_hz)),
    ]
}

fn any_setup() -> impl Strategy<Value = Setup> {
    (rates_hz(), 0.0..1.0, LATE_NS_MIN + 1..3_000_000_u64, drop_policy(), 8..64_usize, any::<u64>()).prop_map(
        |((input_hz, target_hz), jitter, late_ns_max, drop_policy, queue_samples, seed)| Setup {
            input_hz,
            jitter,
            target_hz,
            late_ns_max,
            drop_policy,
            queue_samples,
            seed,
        },
    )
}

/// A simple throttle, for comparison: a sample passes if an interval has elapsed since the last one that
/// passed.
struct IntervalGate {
    interval_ns: u64,
    passed_at: Option<u64>,
    passed: Option<(u64, SampleStamps)>,
    dropped: u64,
}

impl Gate for IntervalGate {
    fn offer(&mut self, sequence: u64, stamps: SampleStamps) {
        if self.passed_at.is_some_and(|at| stamps.taken_at.0 < at + self.interval_ns) {
            self.dropped += 1;
        } else {
            self.passed_at = Some(stamps.taken_at.0);
            self.passed = Some((sequence, stamps));
        }
    }

    fn poll(&mut self, _: MonotonicNs) -> Decision<u64> {
        self.passed.take().map_or(Decision::WaitForSample, |(item, stamps)| Decision::Send(item, stamps))
    }

    fn rest(&self) -> u64 {
        self.dropped
    }
}

#[test]
fn ten_hertz_throttled_to_eight_gives_eight() {
    for drop_policy in POLICIES {
        let setup = Setup { drop_policy, ..setup(10.0, 8.0) };
        let achieved_hz = run_lane(&setup).rate_hz();
        assert!(within(achieved_hz, 8.0, 0.01), "{drop_policy:?}: {achieved_hz} Hz");
    }
}

/// Shows that the test above can fail: a simple throttle gives 5 Hz in the same run.
#[test]
fn ten_hertz_throttled_to_eight_by_an_interval_gate_gives_five() {
    let mut gate = IntervalGate { interval_ns: 125_000_000, passed_at: None, passed: None, dropped: 0 };
    let achieved_hz = run(&setup(10.0, 8.0), &mut gate).rate_hz();
    assert!(within(achieved_hz, 5.0, 0.01), "{achieved_hz} Hz");
}

#[test]
fn the_default_rates_are_met_from_a_laser_scanner_of_thirty_hertz() {
    for target_hz in [10.0, 3.0] {
        let achieved_hz = run_lane(&setup(30.0, target_hz)).rate_hz();
        assert!(within(achieved_hz, target_hz, 0.01), "{achieved_hz} Hz");
    }
}

/// The table of docs/decisions/0003-token-bucket.md; `--nocapture` prints it.
#[test]
fn a_burst_of_one_token_misses_the_rate_and_the_chosen_burst_meets_it() {
    println!(
        "input→target, jitter: burst 1, 1 + 50 ms, 2, 2 + 50 ms; the last with one sample for each wake-up"
    );
    let cases = [
        (0.51, 0.5, 1.0),
        (3.06, 3.0, 1.0),
        (10.0, 8.0, 0.1),
        (30.0, 10.0, 0.1),
        (30.0, 29.0, 0.1),
        (100.0, 100.0, 1.0),
        (1_000.0, 999.0, 1.0),
        (5_000.0, 1_000.0, 0.1),
    ];
    for (input_hz, target_hz, jitter) in cases {
        let setup = Setup { jitter, ..setup(input_hz, target_hz) };
        let with = |burst: f64| run(&setup, &mut WithBurst::new(&setup, burst)).rate_hz();
        let chosen = with(burst_for(target_hz));
        let mut one_each = WithBurst { tokens_max: 1, ..WithBurst::new(&setup, burst_for(target_hz)) };
        let one_each = run(&setup, &mut one_each).rate_hz();
        let (one, window, two) = (with(1.0), with(1.0 + target_hz * 0.05), with(2.0));
        println!(
            "{input_hz}→{target_hz}, {jitter}: {one:.3}, {window:.3}, {two:.3}, {chosen:.3}; {one_each:.3}"
        );
        assert!(!within(one, target_hz, 0.01), "{setup:?}: {one} Hz");
        assert!(within(chosen, target_hz, 0.01), "{setup:?}: {chosen} Hz");
    }
}

proptest! {
    #![proptest_config(config(400))]

    #[test]
    fn a_lane_meets_its_rate_and_never_exceeds_its_arrival_curve(setup in any_setup()) {
        let outcome = run_lane(&setup);
        let expected_hz = setup.target_hz.min(setup.input_hz);
        let achieved_hz = outcome.rate_hz();
        prop_assert!(within(achieved_hz, expected_hz, 0.01), "{achieved_hz} Hz of {expected_hz}");
        let (seen, burst) = (outcome.burst_seen(setup.target_hz), burst_for(setup.target_hz));
        prop_assert!(seen <= burst + 1e-3, "a burst of {seen}, allowed {burst}");
    }

    #[test]
    fn a_lane_limited_by_bytes_meets_its_rate(setup in any_setup()) {
        let bytes_per_s = (setup.target_hz * SAMPLE_BYTES as f64).round();
        let mut rates = setup.rates();
        rates.normal.max_rate_hz = 100_000.0;
        rates.normal.max_bytes_per_s = Some(bytes_per_s as u64);
        let expected_hz = setup.input_hz.min(bytes_per_s / SAMPLE_BYTES as f64);
        let achieved_hz = run(&setup, &mut Shaper::new(rates)).rate_hz();
        prop_assert!(within(achieved_hz, expected_hz, 0.01), "{achieved_hz} Hz of {expected_hz}");
    }

    #[test]
    fn any_burst_that_covers_one_token_jitter_and_lateness_meets_the_rate(
        setup in any_setup(),
        more in prop_oneof![Just(0.0), 0.0..100.0_f64],
    ) {
        // Two wake-ups are late one after the other: that for the token, then that for a sample.
        let slack_s = 2.0 * setup.late_ns_max as f64 / 1e9 + setup.jitter / setup.input_hz;
        let burst = 1.0 + setup.target_hz * slack_s + more;
        let outcome = run(&setup, &mut WithBurst::new(&setup, burst));
        let expected_hz = setup.target_hz.min(setup.input_hz);
        // A large burst may be spent within the run.
        let allowed = 0.01 + burst / (setup.duration_ns() as f64 / 1e9) / expected_hz;
        let achieved_hz = outcome.rate_hz();
        prop_assert!(within(achieved_hz, expected_hz, allowed), "{achieved_hz} Hz of {expected_hz}");
    }
}

proptest! {
    #![proptest_config(config(500))]

    #[test]
    fn a_token_bucket_passes_in_no_window_more_than_rate_times_time_and_burst(
        rate_hz in log_uniform(0.01, 100_000.0),
        burst in 1.0..50.0_f64,
        steps in prop::collection::vec((0.0..4.0_f64, 1..8_u32), 1..400),
    ) {
        let mut bucket = TokenBucket::new(rate_hz, burst, MonotonicNs(0));
        let (mut now, mut outcome) = (0, Outcome { sent_at: Vec::new(), duration_ns: 0 });
        for (intervals, tries) in steps {
            now += (intervals * 1e9 / rate_hz) as u64;
            for _ in 0..tries {
                let ready = bucket.ready_at(MonotonicNs(now)) == Some(MonotonicNs(now));
                let taken = bucket.try_take(MonotonicNs(now));
                prop_assert_eq!(taken, ready);
                if taken {
                    outcome.sent_at.push(now);
                }
            }
        }
        let seen = outcome.burst_seen(rate_hz);
        prop_assert!(seen <= burst + 1e-3, "a burst of {seen}, allowed {burst}");
    }

    #[test]
    fn bytes_keep_their_rate_whatever_the_sizes(
        bytes_per_s in log_uniform(100.0, 1e8),
        sizes in prop::collection::vec(1..1_000_000_u64, 1..20),
        late_ns_max in 1..3_000_000_u64,
        seed in any::<u64>(),
    ) {
        let rate = bytes_per_s as u64;
        let mut random = Random(seed);
        let mut budget = ByteBudget::new(Some(rate), MonotonicNs(0));
        let (mut now, mut passed) = (MonotonicNs(0), 0_u128);
        // At most 20,000 samples a second, so that the run stays short.
        let smallest = rate / 20_000;
        let largest = u128::from(smallest + sizes.iter().max().expect("at least one"));
        let mut sizes = sizes.iter().map(|size| smallest + size).cycle();
        for _ in 0..500 {
            let accrued = u128::from(rate) * u128::from(now.0) / u128::from(SECOND_NS);
            // When a sample may pass, all that passed is paid for, and nothing was lost while the consumer
            // slept.
            prop_assert!(passed <= accrued, "{passed} bytes of {accrued}");
            prop_assert!(passed + u128::from(rate) * 3 / 1_000 + 1 >= accrued, "{passed} bytes of {accrued}");
            while budget.ready_at(now) == Some(now) {
                let bytes = sizes.next().expect("a cycle");
                prop_assert!(budget.try_take(bytes, now));
                passed += u128::from(bytes);
            }
            prop_assert!(passed <= accrued + largest);
            let ready_at = budget.ready_at(now).expect("a rate above 0");
            prop_assert!(!budget.try_take(1, MonotonicNs(ready_at.0 - 1)));
            now = ready_at.plus_ns(random.below(late_ns_max));
        }
    }

    #[test]
    fn after_a_pause_no_more_bytes_pass_at_once_than_the_burst_and_one_sample(
        rate in 1..10_000_000_u64,
        sizes in prop::collection::vec(1..100_000_u64, 1..50),
        pause_s in 1..100_000_u64,
    ) {
        let mut budget = ByteBudget::new(Some(rate), MonotonicNs(0));
        let mut now = MonotonicNs(0);
        for &bytes in &sizes {
            now = budget.ready_at(now).expect("a rate above 0");
            prop_assert!(budget.try_take(bytes, now));
        }
        now = now.plus_ns(pause_s * SECOND_NS);
        let largest = *sizes.iter().max().expect("at least one");
        let mut at_once = 0;
        for &bytes in sizes.iter().cycle() {
            if !budget.try_take(bytes, now) {
                break;
            }
            at_once += bytes;
        }
        prop_assert!(at_once <= rate / 20 + 1 + 2 * largest, "{at_once} bytes");
    }

    #[test]
    fn a_lane_that_keeps_the_freshest_sends_in_order_what_its_tokens_allow(
        ages_ms in prop::collection::vec(0..400_u64, 1..12),
        tokens in 1..6_u64,
    ) {
        let now = MonotonicNs(SECOND_NS);
        let mut queue = LaneQueue::new(DropPolicy::DropOldest, 12);
        for (sequence, &age_ms) in (1..).zip(&ages_ms) {
            queue.offer(sequence, aged(sequence, now, age_ms), |_: u64, _, _| {});
        }
        let fresh: Vec<u64> = (1..).zip(&ages_ms).filter(|&(_, &age)| age <= 200).map(|(n, _)| n).collect();
        let expected = &fresh[fresh.len().saturating_sub(tokens as usize)..];
        let mut sent = Vec::new();
        for left in (1..=tokens).rev() {
            let taken = queue.take(&allowance(now, left), |_, _, _| {});
            sent.extend(taken.map(|(item, _)| item));
        }
        prop_assert_eq!(sent.as_slice(), expected);
    }

    #[test]
    fn first_in_first_out_keeps_order_and_drops_only_when_the_queue_is_full(
        ops in prop::collection::vec(any::<bool>(), 1..200),
        capacity in 1..8_usize,
    ) {
        let now = MonotonicNs(SECOND_NS);
        let mut queue = LaneQueue::new(DropPolicy::DropLatest, capacity);
        let mut expected = std::collections::VecDeque::new();
        let mut sequence = 0_u64;
        for offer in ops {
            if offer {
                sequence += 1;
                let mut refused = None;
                queue.offer(sequence, aged(sequence, now, 0), |item, _, reason| {
                    refused = Some((item, reason));
                });
                if expected.len() < capacity {
                    expected.push_back(sequence);
                    prop_assert_eq!(refused, None);
                } else {
                    prop_assert_eq!(refused, Some((sequence, DropReason::QueueFull)));
                }
            } else {
                let taken = queue.take(&allowance(now, 1), |_, _, _| {});
                prop_assert_eq!(taken.map(|(item, _)| item), expected.pop_front());
            }
        }
    }

    #[test]
    fn drop_stale_sends_the_oldest_fresh_sample_and_leaves_no_stale_one(
        ages_ms in prop::collection::vec(0..400_u64, 1..12),
    ) {
        let now = MonotonicNs(SECOND_NS);
        let mut queue = LaneQueue::new(DropPolicy::DropStale, 12);
        for (sequence, &age_ms) in (1..).zip(&ages_ms) {
            queue.offer(sequence, aged(sequence, now, age_ms), |_: u64, _, _| {});
        }
        let fresh: Vec<u64> = (1..).zip(&ages_ms).filter(|&(_, &age)| age <= 200).map(|(n, _)| n).collect();
        let mut stale = 0;
        let taken = queue.take(&allowance(now, 1), |_, _, reason| {
            assert_eq!(reason, DropReason::Stale);
            stale += 1;
        });
        prop_assert_eq!(taken.map(|(item, _)| item), fresh.first().copied());
        prop_assert_eq!(stale, ages_ms.len() - fresh.len());
        prop_assert_eq!(queue.len(), fresh.len().saturating_sub(1));
    }
}

fn aged(sequence: u64, now: MonotonicNs, age_ms: u64) -> SampleStamps {
    let taken_at = MonotonicNs(now.0 - age_ms * 1_000_000);
    SampleStamps {
        sequence,
        source_timestamp: SourceTimestamp::from_wall(wall(taken_at)),
        taken_at,
        bytes: 1,
        key: SampleKey::NONE,
    }
}

fn allowance(now: MonotonicNs, tokens: u64) -> Allowance {
    Allowance { now, now_wall: wall(now), tokens, bytes: u64::MAX, stale_threshold_ms: 200 }
}

/// What happens to a lane.
#[derive(Clone, Debug)]
enum Event {
    Pass {
        ms: u64,
    },
    /// `source_age_ms` may be negative: a publisher whose clock is ahead. `None`: no source timestamp.
    Offer {
        source_age_ms: Option<i64>,
        bytes: u64,
    },
    Poll,
    Mode(LaneMode),
    /// The wall clock is set.
    WallStep {
        ms: i64,
    },
    Clear,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        6 => (0..120_u64).prop_map(|ms| Event::Pass { ms }),
        10 => (prop::option::weighted(0.8, -300..600_i64), 0..5_000_u64)
            .prop_map(|(source_age_ms, bytes)| Event::Offer { source_age_ms, bytes }),
        10 => Just(Event::Poll),
        1 => prop::sample::select(LaneMode::ALL.as_slice()).prop_map(Event::Mode),
        1 => (-1_000..1_000_i64).prop_map(|ms| Event::WallStep { ms }),
        1 => Just(Event::Clear),
    ]
}

fn rate_policy() -> impl Strategy<Value = RatePolicy> {
    (
        prop_oneof![9 => log_uniform(0.5, 200.0), 1 => Just(0.0)],
        prop::option::of(0..100_000_u64),
        prop_oneof![Just(0), 1..400_u64],
        drop_policy(),
        0..8_usize,
    )
        .prop_map(|(max_rate_hz, max_bytes_per_s, stale_threshold_ms, drop_policy, queue_samples)| {
            RatePolicy { max_rate_hz, max_bytes_per_s, stale_threshold_ms, drop_policy, queue_samples }
        })
}

/// Each offered sample ends exactly once.
#[derive(Default)]
struct Ledger {
    offered: u64,
    ends: BTreeMap<u64, Option<DropReason>>,
}

impl Ledger {
    fn end(&mut self, sequence: u64, reason: Option<DropReason>) {
        assert!(sequence >= 1 && sequence <= self.offered, "{sequence} was never offered");
        assert_eq!(self.ends.insert(sequence, reason), None, "{sequence} ended twice");
    }
}

proptest! {
    #![proptest_config(config(1_000))]

    #[test]
    fn every_sample_is_sent_or_dropped_for_a_reason_that_holds_or_waits(
        normal in rate_policy(),
        degraded in rate_policy(),
        events in prop::collection::vec(event(), 1..400),
    ) {
        let rates = LaneRates { normal, degraded };
        let mut now = MonotonicNs(10 * SECOND_NS);
        let mut now_wall = wall(now);
        let mut budget = ByteBudget::new(normal.max_bytes_per_s, now);
        let mut shaper = RouteShaper::new(rates, now);
        let mut ledger = Ledger::default();
        let mut last_sent = 0;
        for event in events {
            let mode = shaper.mode();
            let rate = rates.in_mode(mode).filter(|r| r.max_rate_hz > 0.0 && r.max_bytes_per_s != Some(0));
            match event {
                Event::Pass { ms } => {
                    now = now.plus_ms(ms);
                    now_wall = WallNs(now_wall.0 + ms * 1_000_000);
                }
                Event::WallStep { ms } => now_wall = WallNs(now_wall.0.saturating_add_signed(ms * 1_000_000)),
                Event::Offer { source_age_ms, bytes } => {
                    ledger.offered += 1;
                    let source_timestamp = source_age_ms.map_or(SourceTimestamp::NONE, |age_ms| {
                        let source_ns = now_wall.0.saturating_add_signed(-age_ms * 1_000_000);
 SourceTimestamp::from_wall(WallNs(source_ns))
                    });
                    let sequence = ledger.offered;
                    let key = SampleKey::NONE;
                    let stamps = SampleStamps { sequence, source_timestamp, taken_at: now, bytes, key };
                    shaper.offer(ledger.offered, stamps, |item, _, reason| {
                        let expected = match (rate, mode) {
                            (None, LaneMode::Stopped) => DropReason::Stopped,
                            (None, _) => DropReason::Suspended,
                            (Some(r), _) if r.drop_policy == DropPolicy::DropOldest => DropReason::Superseded,
                            (Some(_), _) => DropReason::QueueFull,
                        };
                        assert_eq!(reason, expected);
                        ledger.end(item, Some(reason));
                    });
                }
                Event::Poll => {
                    let age_ns = |stamps: &SampleStamps| match stamps.source_timestamp.to_wall() {
                        Some(source) => now_wall.0.saturating_sub(source.0),
                        None => now.0 - stamps.taken_at.0,
                    };
                    let threshold_ns = rate.map_or(0, |r| r.stale_threshold_ms * 1_000_000);
                    let waiting = shaper.waiting();
                    let mut drops = 0;
                    let decision = shaper.poll(&mut budget, now, now_wall, |item, stamps, reason| {
                        drops += 1;
                        match reason {
                            DropReason::Stale => assert!(threshold_ns > 0 && age_ns(&stamps) > threshold_ns),
                            DropReason::Superseded => {
                                assert_eq!(rate.map(|r| r.drop_policy), Some(DropPolicy::DropOldest));
                            }
                            other => panic!("{other} while polling"),
                        }
                        ledger.end(item, Some(reason));
                    });
                    match decision {
                        Decision::Send(item, stamps) => {
                            prop_assert_eq!(item, stamps.sequence);
                            prop_assert!(threshold_ns == 0 || age_ns(&stamps) <= threshold_ns);
                            prop_assert!(item > last_sent, "{} after {}", item, last_sent);
                            last_sent = item;
                            ledger.end(item, None);
                        }
                        Decision::SleepUntil(at) => {
                            prop_assert!(at > now);
                            prop_assert_eq!((drops, shaper.waiting()), (0, waiting));
                        }
                        Decision::WaitForSample => prop_assert_eq!(shaper.waiting(), 0),
                        Decision::Closed => {
                            prop_assert!(rate.is_none());
                            prop_assert_eq!(shaper.waiting(), 0);
                        }
                    }
                }
                Event::Mode(mode) => {
                    budget.set_mode(&rates, mode, now);
                    shaper.set_mode(mode, now, |item, _, reason| ledger.end(item, Some(reason)));
                    prop_assert_eq!(shaper.mode(), mode);
                }
                Event::Clear => {
                    shaper.clear(DropReason::Shutdown, |item, _, reason| ledger.end(item, Some(reason)));
                    prop_assert_eq!(shaper.waiting(), 0);
                }
            }
            prop_assert_eq!(ledger.offered, ledger.ends.len() as u64 + shaper.waiting() as u64);
            let limit = rates.in_mode(shaper.mode()).map_or(0, |r| r.queue_samples.max(1));
            prop_assert!(shaper.waiting() <= limit);
        }
    }

    #[test]
    fn the_lane_mode_follows_override_control_and_safety_until_they_expire(
        written_at in 0..100_000_u64,
        expires_at in 0..100_000_u64,
        mode in 0..6_u8,
        safety_floor in 0..6_u8,
        mode_by_hand in 0..6_u8,
        by_hand in 0..2_u8,
        now in 0..100_000_u64,
        hold in 0..100_u64,
    ) {
        let (ms, hold_ms) = (1_000_000, hold);
        let policy = LanePolicy {
            epoch: 1,
            written_at: MonotonicNs(written_at * ms / 100),
            expires_at: MonotonicNs(expires_at * ms / 100),
            mode,
            safety_floor,
            by_hand,
            mode_by_hand,
            ..LanePolicy::default()
        };
        let now = MonotonicNs(now * ms / 100);
        let mode_of = |number| LaneMode::from_u8(number).unwrap_or(LaneMode::Normal);
        let confirmed = written_at != 0 && now <= policy.written_at.plus_ms(hold_ms);
        let cases =
            [(TrafficClass::Critical, LaneMode::Normal), (TrafficClass::Noncritical, LaneMode::Degraded)];
        for (class, safe) in cases {
            let (effective, _) = mode_and_source(&policy, class, now, hold_ms);
            let requested = if by_hand == 1 && (expires_at == 0 || now < policy.expires_at) {
                mode_of(mode_by_hand)
            } else if confirmed {
                mode_of(mode)
            } else if written_at == 0 {
                LaneMode::Normal
            } else {
                safe
            };
            let floor = if confirmed { mode_of(safety_floor) } else { LaneMode::Normal };
            prop_assert_eq!(effective as u8, (requested as u8).max(floor as u8));
            // Without control only a manual override stops a critical lane for longer than the hold.
            if by_hand == 0 && !confirmed && class == TrafficClass::Critical {
                prop_assert_eq!(critical_drop(effective), None);
            }
        }
    }

    #[test]
    fn received_and_missing_samples_of_a_route_add_up_to_its_sequence_numbers(
        jumps in prop::collection::vec(-3..20_i64, 1..200),
        begin in 1..1_000_u64,
        restart_at in 0..200_usize,
    ) {
        let mut tracker = SequenceTracker::default();
        let (mut sequence, mut seen, mut missing) = (begin, 0, 0);
        let mut highest = 0;
        for (index, jump) in jumps.into_iter().enumerate() {
            if index == restart_at {
                tracker = SequenceTracker::resume(tracker.first(), tracker.last());
            }
            sequence = sequence.saturating_add_signed(jump);
            match tracker.record(sequence) {
                SequenceOutcome::InOrder => seen += 1,
                SequenceOutcome::AfterGap(lost) => {
                    prop_assert!(lost > 0);
                    missing += lost;
                    seen += 1;
                }
                SequenceOutcome::Duplicate => prop_assert!(sequence <= highest || sequence == 0),
            }
            highest = highest.max(sequence);
            prop_assert_eq!(tracker.last(), highest);
            prop_assert_eq!(tracker.last() - tracker.first(), seen + missing);
        }
    }
}

#[test]
fn bytes_throttle_ten_hertz_to_eight_as_tokens_do() {
    let setup = setup(10.0, 1_000.0);
    let mut rates = setup.rates();
    rates.normal.max_bytes_per_s = Some(8_000);
    let achieved_hz = run(&setup, &mut Shaper::new(rates)).rate_hz();
    assert!(within(achieved_hz, 8.0, 0.01), "{achieved_hz} Hz");
}

#[test]
fn the_freshest_sample_is_sent_also_when_bytes_and_not_tokens_are_scarce() {
    let setup = setup(200.0, 1_000.0);
    let mut rates = setup.rates();
    rates.normal.max_bytes_per_s = Some(5_000);
    let start = MonotonicNs(0);
    let mut shaper = RouteShaper::new(rates, start);
    let mut budget = ByteBudget::new(rates.normal.max_bytes_per_s, start);
    let mut sent = Vec::new();
    // 200 Hz of 1,000 bytes into 5,000 bytes a second: one sample in forty.
    for sequence in 1..=2_000_u64 {
        let now = MonotonicNs(sequence * 5_000_000);
        let stamps = SampleStamps { bytes: 1_000, ..aged(sequence, now, 0) };
        shaper.offer(sequence, stamps, |_, _, _| {});
        while let Decision::Send(item, _) = shaper.poll(&mut budget, now, wall(now), |_, _, _| {}) {
            assert_eq!(item, sequence);
            sent.push(item);
        }
    }
    // Five a second for ten seconds, and the one that made the first debt.
    assert_eq!(sent.len(), 51);
}

#[test]
fn routes_that_share_a_byte_budget_share_it_fairly() {
    let rates = Setup { queue_samples: 4, ..setup(100.0, 50.0) }.rates();
    let start = MonotonicNs(0);
    let mut budget = ByteBudget::new(Some(20_000), start);
    let mut shapers: Vec<_> = (0..3).map(|_| RouteShaper::new(rates, start)).collect();
    let mut turns = PollOrder::default();
    let mut sent = [0_u64; 3];
    // Each route alone would take the 20 samples of 1,000 bytes that the budget has for a second.
    for sequence in 1..=60_000_u64 {
        let now = MonotonicNs(sequence * 10_000_000);
        for shaper in &mut shapers {
            let stamps = SampleStamps { bytes: 1_000, ..aged(sequence, now, 0) };
            shaper.offer(sequence, stamps, |_, _, _| {});
        }
        for index in turns.order(3) {
            while let Decision::Send(..) = shapers[index].poll(&mut budget, now, wall(now), |_, _, _| {}) {
                sent[index] += 1;
                turns.sent(index);
            }
        }
    }
    let total: u64 = sent.iter().sum();
    assert!(within(total as f64, 12_000.0, 0.01), "{total}");
    for share in sent {
        assert!(within(share as f64, 4_000.0, 0.02), "{sent:?}");
    }
}
