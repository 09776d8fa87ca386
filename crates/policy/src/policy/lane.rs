//! Decides what a lane does with a sample, from its rate, bytes, staleness and mode.

use super::lane_queue::{Allowance, LaneQueue, SampleStamps};
use super::token_bucket::{ByteBudget, TokenBucket, burst_for};
use crate::model::{
    DropReason, LaneMode, LanePolicy, LaneRates, ModeReason, MonotonicNs, RatePolicy, TrafficClass, WallNs,
};

/// What a noncritical lane does next on one route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision<T> {
    /// Send this sample, whose token and bytes are taken; then poll again, as there may be another.
    Send(T, SampleStamps),
    /// Sleep: nothing can be sent until that instant. Samples that arrive in the meantime may wait in shared
    /// memory, without a wake-up.
    SleepUntil(MonotonicNs),
    /// Wait: none is queued, and the next sample can be sent as soon as it arrives.
    WaitForSample,
    /// The mode forwards nothing: samples are dropped when they are offered, and may wait in shared memory.
    Closed,
}

/// One route on a noncritical lane: a token bucket and a queue, configured by the mode.
///
/// When the caller wakes, it takes all samples out of shared memory, offers them, and polls until the
/// decision is not [`Decision::Send`]. The shaper allocates only on construction and when its rates change.
#[derive(Debug)]
pub struct RouteShaper<T> {
    rates: LaneRates,
    mode: LaneMode,
    bucket: TokenBucket,
    queue: LaneQueue<T>,
}

impl<T> RouteShaper<T> {
    /// A route in normal mode with one token.
    pub fn new(rates: LaneRates, now: MonotonicNs) -> Self {
        let mut shaper = Self {
            rates,
            mode: LaneMode::Normal,
            bucket: TokenBucket::new(0.0, 1.0, now),
            queue: LaneQueue::new(rates.normal.drop_policy, capacity_for(&rates)),
        };
        // The queue is empty, so nothing is dropped.
        shaper.set_mode(LaneMode::Normal, now, |_, _, _| {});
        shaper
    }

    /// The mode that applies.
    pub const fn mode(&self) -> LaneMode {
        self.mode
    }

    /// Samples waiting.
    pub fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Changes the mode from the next sample on. A mode that forwards nothing drops all waiting samples; any
    /// other drops those above the limit of its queue. No tokens accrue while a lane is suspended.
    pub fn set_mode(
        &mut self,
        mode: LaneMode,
        now: MonotonicNs,
        on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) {
        self.mode = mode;
        match self.forwarding() {
            Ok(rate) => {
                self.bucket.set_rate(rate.max_rate_hz, burst_for(rate.max_rate_hz), now);
                self.queue.set_policy(rate.drop_policy, rate.queue_samples, on_drop);
            }
            Err(reason) => {
                self.bucket.set_rate(0.0, 1.0, now);
                self.queue.clear(reason, on_drop);
            }
        }
    }

    /// Applies other rates from the next sample on. Tokens stay, up to the new burst; samples above the limit
    /// of the queue are dropped as in [`RouteShaper::set_mode`].
    pub fn set_rates(
        &mut self,
        rates: LaneRates,
        now: MonotonicNs,
        on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) {
        self.rates = rates;
        self.queue.set_capacity(capacity_for(&rates));
        self.set_mode(self.mode, now, on_drop);
    }

    /// Queues or drops a sample. The caller offers samples in the order of their sequence numbers.
    pub fn offer(
        &mut self,
        item: T,
        stamps: SampleStamps,
        mut on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) {
        match self.forwarding() {
            Ok(_) => self.queue.offer(item, stamps, on_drop),
            Err(reason) => on_drop(item, stamps, reason),
        }
    }

    /// Decides what to do at `now`. `budget` is that of the lane, in the same mode
    /// ([`ByteBudget::set_mode`]); the caller polls the routes that share it in [`PollOrder`].
    pub fn poll(
        &mut self,
        budget: &mut ByteBudget,
        now: MonotonicNs,
        now_wall: WallNs,
        on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) -> Decision<T> {
        let stale_threshold_ms = match self.forwarding() {
            Ok(rate) => rate.stale_threshold_ms,
            Err(_) => return Decision::Closed,
        };
        let ready_at = match (self.bucket.ready_at(now), budget.ready_at(now)) {
            (Some(token_at), Some(bytes_at)) => token_at.max(bytes_at),
            _ => return Decision::Closed,
        };
        if ready_at > now {
            return Decision::SleepUntil(ready_at);
        }
        let allowance = Allowance {
            now,
            now_wall,
            tokens: self.bucket.tokens(now),
            bytes: budget.balance_bytes(now),
            stale_threshold_ms,
        };
        match self.queue.take(&allowance, on_drop) {
            Some((item, stamps)) => {
                let taken = self.bucket.try_take(now) && budget.try_take(stamps.bytes, now);
                debug_assert!(taken, "both were ready");
                Decision::Send(item, stamps)
            }
            None => Decision::WaitForSample,
        }
    }

    /// Drops every waiting sample for `reason`, such as at shutdown.
    pub fn clear(&mut self, reason: DropReason, on_drop: impl FnMut(T, SampleStamps, DropReason)) {
        self.queue.clear(reason, on_drop);
    }

    /// The rate policy of the mode, or the drop reason if the mode forwards nothing. A rate of 0, by which
    /// configuration files of the original package suspend a lane in a mode, counts as suspended.
    fn forwarding(&self) -> Result<RatePolicy, DropReason> {
        match self.rates.in_mode(self.mode) {
            Some(rate) if rate.max_rate_hz > 0.0 && rate.max_bytes_per_s != Some(0) => Ok(*rate),
            _ if self.mode == LaneMode::Stopped => Err(DropReason::Stopped),
            _ => Err(DropReason::Suspended),
        }
    }
}

/// The queue capacity needed in all modes.
fn capacity_for(rates: &LaneRates) -> usize {
    rates.normal.queue_samples.max(rates.degraded.queue_samples)
}

/// The order in which to poll the routes of a lane that share a [`ByteBudget`]. It starts after the route
/// that sent last: in a fixed order the first route would take all bytes when they do not suffice.
#[derive(Clone, Copy, Debug, Default)]
pub struct PollOrder {
    first: usize,
}

impl PollOrder {
    /// The indices of `routes` routes, in the order in which to poll them now.
    pub fn order(self, routes: usize) -> impl Iterator<Item = usize> {
        let first = if self.first < routes { self.first } else { 0 };
        (first..routes).chain(0..first)
    }

    /// Records that route `index` has sent a sample.
    pub const fn sent(&mut self, index: usize) {
        self.first = index + 1;
    }
}

/// The reason for which a critical lane drops a sample in `mode`; `None` to forward it. Only the stopped mode
/// drops: the degraded and suspended modes limit noncritical lanes in favour of critical ones.
#[inline]
pub const fn critical_drop(mode: LaneMode) -> Option<DropReason> {
    match mode {
        LaneMode::Normal | LaneMode::Degraded | LaneMode::Suspended => None,
        LaneMode::Stopped => Some(DropReason::Stopped),
    }
}

/// The mode that a lane applies, from its policy on the policy board, and its reason, which is never
/// [`ModeReason::Held`]:
///
/// - the override by hand, until it expires;
/// - else control's mode, while control confirms it at least every `policy_hold_ms`;
/// - else the safe default, which is normal for a critical lane and degraded for a noncritical one; normal if
///   control has never run;
/// - in each case at least the safety floor, while control confirms it.
///
/// A stop by control therefore ends when control dies, and an override cannot lift an emergency.
#[inline]
pub fn mode_and_source(
    policy: &LanePolicy,
    class: TrafficClass,
    now: MonotonicNs,
    policy_hold_ms: u64,
) -> (LaneMode, ModeReason) {
    // An undefined number, which only a foreign process can write, counts as normal.
    let mode_of = |number| LaneMode::from_u8(number).unwrap_or_default();
    let confirmed = policy.is_confirmed(now, policy_hold_ms);
    let (mode, source) = if policy.is_overridden(now) {
        (mode_of(policy.mode_by_hand), ModeReason::ByHand)
    } else if policy.written_at.0 == 0 {
        (LaneMode::Normal, ModeReason::Default)
    } else if confirmed {
        (mode_of(policy.mode), ModeReason::Control)
    } else if class == TrafficClass::Critical {
        (LaneMode::Normal, ModeReason::Expired)
    } else {
        (LaneMode::Degraded, ModeReason::Expired)
    };
    let floor = mode_of(policy.safety_floor);
    if confirmed && floor as u8 > mode as u8 { (floor, ModeReason::Safety) } else { (mode, source) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{DropPolicy, SampleKey, SourceTimestamp};

    fn effective_mode(
        policy: &LanePolicy,
        class: TrafficClass,
        now: MonotonicNs,
        policy_hold_ms: u64,
    ) -> LaneMode {
        mode_and_source(policy, class, now, policy_hold_ms).0
    }

    const RATES: LaneRates = LaneRates {
        normal: RatePolicy {
            max_rate_hz: 10.0,
            max_bytes_per_s: None,
            stale_threshold_ms: 200,
            drop_policy: DropPolicy::DropOldest,
            queue_samples: 5,
        },
        degraded: RatePolicy {
            max_rate_hz: 4.0,
            max_bytes_per_s: Some(1_000),
            stale_threshold_ms: 100,
            drop_policy: DropPolicy::DropStale,
            queue_samples: 2,
        },
    };

    fn at_ms(ms: u64) -> MonotonicNs {
        MonotonicNs(ms * 1_000_000)
    }

    fn stamps(sequence: u64, taken_at: MonotonicNs) -> SampleStamps {
        let key = SampleKey::NONE;
        SampleStamps { sequence, source_timestamp: SourceTimestamp::NONE, taken_at, bytes: 100, key }
    }

    /// A route, its budget, and the dropped samples; each item is its sequence number.
    struct Bench {
        shaper: RouteShaper<u64>,
        budget: ByteBudget,
        dropped: Vec<(u64, DropReason)>,
    }

    impl Bench {
        fn new(rates: LaneRates) -> Self {
            let budget = ByteBudget::new(rates.normal.max_bytes_per_s, at_ms(0));
            Self { shaper: RouteShaper::new(rates, at_ms(0)), budget, dropped: Vec::new() }
        }

        fn offer(&mut self, sequence: u64, ms: u64) {
            let dropped = &mut self.dropped;
            self.shaper.offer(sequence, stamps(sequence, at_ms(ms)), |item, _, reason| {
                dropped.push((item, reason));
            });
        }

        fn poll(&mut self, ms: u64) -> Decision<u64> {
            let dropped = &mut self.dropped;
            self.shaper.poll(&mut self.budget, at_ms(ms), WallNs(0), |item, _, reason| {
                dropped.push((item, reason));
            })
        }

        fn set_mode(&mut self, mode: LaneMode, ms: u64) {
            let dropped = &mut self.dropped;
            self.budget.set_mode(&RATES, mode, at_ms(ms));
            self.shaper.set_mode(mode, at_ms(ms), |item, _, reason| dropped.push((item, reason)));
        }

        fn set_rates(&mut self, rates: LaneRates, ms: u64) {
            let dropped = &mut self.dropped;
            self.shaper.set_rates(rates, at_ms(ms), |item, _, reason| dropped.push((item, reason)));
        }
    }

    fn sent(decision: Decision<u64>) -> Option<u64> {
        match decision {
            Decision::Send(item, _) => Some(item),
            _ => None,
        }
    }

    #[test]
    fn the_lane_waits_for_a_sample_then_sleeps_until_the_next_token() {
        let mut bench = Bench::new(RATES);
        assert_eq!(bench.poll(0), Decision::WaitForSample);
        bench.offer(1, 7);
        assert_eq!(sent(bench.poll(7)), Some(1));
        assert_eq!(bench.poll(7), Decision::SleepUntil(at_ms(100)), "credit accrued in the first 7 ms");
    }

    #[test]
    fn without_a_token_the_lane_sleeps_even_when_samples_wait() {
        let mut bench = Bench::new(RATES);
        bench.offer(1, 0);
        assert_eq!(sent(bench.poll(0)), Some(1));
        assert_eq!(bench.poll(0), Decision::SleepUntil(at_ms(100)));
        bench.offer(2, 30);
        bench.offer(3, 60);
        assert_eq!(bench.poll(99), Decision::SleepUntil(at_ms(100)));
        assert_eq!(sent(bench.poll(100)), Some(3));
        assert_eq!(bench.dropped, [(2, DropReason::Superseded)]);
    }

    #[test]
    fn a_stale_sample_takes_no_token() {
        let mut bench = Bench::new(RATES);
        bench.offer(1, 0);
        assert_eq!(bench.poll(201), Decision::WaitForSample);
        assert_eq!(bench.dropped, [(1, DropReason::Stale)]);
        bench.offer(2, 201);
        assert_eq!(sent(bench.poll(201)), Some(2));
    }

    #[test]
    fn a_lane_in_byte_debt_sleeps_until_it_is_paid_off() {
        let mut bench = Bench::new(RATES);
        bench.set_mode(LaneMode::Degraded, 0);
        let big = SampleStamps { bytes: 3_000, ..stamps(1, at_ms(0)) };
        bench.shaper.offer(1, big, |_, _, _| {});
        assert_eq!(sent(bench.poll(0)), Some(1));
        bench.offer(2, 1_000);
        assert_eq!(bench.poll(1_000), Decision::SleepUntil(at_ms(3_000)));
    }

    #[test]
    fn suspended_and_stopped_drop_waiting_and_offered_samples() {
        for (mode, reason) in
            [(LaneMode::Suspended, DropReason::Suspended), (LaneMode::Stopped, DropReason::Stopped)]
        {
            let mut bench = Bench::new(RATES);
            bench.offer(1, 0);
            bench.set_mode(mode, 1);
            bench.offer(2, 2);
            assert_eq!(bench.poll(2), Decision::Closed);
            assert_eq!(bench.dropped, [(1, reason), (2, reason)]);
            assert_eq!(bench.shaper.waiting(), 0);
        }
    }

    #[test]
    fn no_tokens_accrue_while_a_lane_is_suspended() {
        let mut bench = Bench::new(RATES);
        bench.offer(1, 0);
        assert_eq!(sent(bench.poll(0)), Some(1));
        bench.set_mode(LaneMode::Suspended, 0);
        bench.set_mode(LaneMode::Normal, 60_000);
        assert_eq!(bench.poll(60_000), Decision::SleepUntil(at_ms(60_100)));
    }

    #[test]
    fn a_new_mode_applies_its_rate_queue_and_threshold() {
        let mut bench = Bench::new(RATES);
        for sequence in 1..=5 {
            bench.offer(sequence, 0);
        }
        bench.set_mode(LaneMode::Degraded, 0);
        assert_eq!(bench.shaper.waiting(), 2);
        assert_eq!(sent(bench.poll(0)), Some(4));
        assert_eq!(bench.poll(0), Decision::SleepUntil(at_ms(250)), "4 Hz");
        assert_eq!(bench.poll(250), Decision::WaitForSample);
        let reasons: Vec<_> = bench.dropped.iter().map(|&(_, reason)| reason).collect();
        let full = DropReason::QueueFull;
        assert_eq!(reasons, [full, full, full, DropReason::Stale]);
    }

    #[test]
    fn other_rates_apply_immediately_and_keep_waiting_samples() {
        let mut bench = Bench::new(RATES);
        bench.offer(1, 0);
        assert_eq!(sent(bench.poll(0)), Some(1));
        for sequence in 2..=5 {
            bench.offer(sequence, 10);
        }
        assert_eq!(bench.poll(10), Decision::SleepUntil(at_ms(100)));
        let faster = RatePolicy { max_rate_hz: 20.0, queue_samples: 8, ..RATES.normal };
        bench.set_rates(LaneRates { normal: faster, ..RATES }, 10);
        assert_eq!((bench.shaper.waiting(), bench.dropped.len()), (4, 0));
        // 0.1 tokens accrued in 10 ms at 10 Hz; the other 0.9 accrue in 45 ms at 20 Hz.
        assert_eq!(bench.poll(50), Decision::SleepUntil(at_ms(55)));
        for sequence in 6..=9 {
            bench.offer(sequence, 50);
        }
        assert_eq!((bench.shaper.waiting(), bench.dropped.len()), (8, 0), "the queue is larger");
        assert_eq!(sent(bench.poll(55)), Some(9));
    }

    #[test]
    fn a_smaller_queue_drops_samples_with_a_reason_and_a_suspended_lane_stays_closed() {
        let mut bench = Bench::new(RATES);
        for sequence in 1..=5 {
            bench.offer(sequence, 0);
        }
        let small = RatePolicy { queue_samples: 2, drop_policy: DropPolicy::DropStale, ..RATES.normal };
        let rates = LaneRates { normal: small, degraded: small };
        bench.set_rates(rates, 0);
        let full = DropReason::QueueFull;
        assert_eq!(bench.dropped, [(1, full), (2, full), (3, full)]);
        assert_eq!(bench.shaper.waiting(), 2);
        bench.set_mode(LaneMode::Suspended, 0);
        bench.set_rates(RATES, 0);
        assert_eq!(bench.poll(1_000), Decision::Closed);
        bench.set_mode(LaneMode::Normal, 1_000);
        for sequence in 6..=11 {
            bench.offer(sequence, 1_000);
        }
        assert_eq!(bench.shaper.waiting(), 5, "the queue is as large as before");
    }

    #[test]
    fn a_rate_of_zero_in_a_mode_suspends_the_lane_in_it() {
        for closed in [
            RatePolicy { max_rate_hz: 0.0, ..RATES.normal },
            RatePolicy { max_rate_hz: f64::NAN, ..RATES.normal },
            RatePolicy { max_bytes_per_s: Some(0), ..RATES.normal },
        ] {
            let mut bench = Bench::new(LaneRates { normal: closed, ..RATES });
            bench.offer(1, 0);
            assert_eq!(bench.poll(0), Decision::Closed);
            assert_eq!(bench.dropped, [(1, DropReason::Suspended)]);
        }
    }

    #[test]
    fn clearing_drops_waiting_samples_for_the_given_reason() {
        let mut bench = Bench::new(RATES);
        bench.offer(1, 0);
        let dropped = &mut bench.dropped;
        bench.shaper.clear(DropReason::Shutdown, |item, _, reason| dropped.push((item, reason)));
        assert_eq!(bench.dropped, [(1, DropReason::Shutdown)]);
    }

    #[test]
    fn the_order_starts_after_the_route_that_sent_last() {
        let mut turns = PollOrder::default();
        assert_eq!(turns.order(3).collect::<Vec<_>>(), [0, 1, 2]);
        turns.sent(0);
        assert_eq!(turns.order(3).collect::<Vec<_>>(), [1, 2, 0]);
        turns.sent(2);
        assert_eq!(turns.order(3).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(turns.order(0).count(), 0);
    }

    #[test]
    fn a_critical_sample_is_forwarded_in_every_mode_except_stopped() {
        for mode in [LaneMode::Normal, LaneMode::Degraded, LaneMode::Suspended] {
            assert_eq!(critical_drop(mode), None);
        }
        assert_eq!(critical_drop(LaneMode::Stopped), Some(DropReason::Stopped));
    }

    #[test]
    fn the_mode_of_control_applies_while_control_confirms_it() {
        let policy = LanePolicy {
            epoch: 4,
            written_at: at_ms(1_000),
            mode: LaneMode::Stopped as u8,
            ..LanePolicy::default()
        };
        let effective = |class, ms| effective_mode(&policy, class, at_ms(ms), 2_000);
        for ms in [0, 1_000, 3_000] {
            assert_eq!(effective(TrafficClass::Critical, ms), LaneMode::Stopped);
        }
        assert_eq!(effective(TrafficClass::Critical, 3_001), LaneMode::Normal);
        assert_eq!(effective(TrafficClass::Noncritical, 3_001), LaneMode::Degraded);
    }

    #[test]
    fn an_override_applies_until_it_expires_and_then_the_mode_of_control() {
        let mut policy = LanePolicy {
            epoch: 1,
            written_at: at_ms(4_000),
            expires_at: at_ms(5_000),
            mode: LaneMode::Degraded as u8,
            mode_by_hand: LaneMode::Suspended as u8,
            by_hand: 1,
            ..LanePolicy::default()
        };
        let class = TrafficClass::Noncritical;
        assert_eq!(effective_mode(&policy, class, at_ms(4_999), 2_000), LaneMode::Suspended);
        assert_eq!(effective_mode(&policy, class, at_ms(5_000), 2_000), LaneMode::Degraded);
        policy.expires_at = at_ms(0);
        assert_eq!(effective_mode(&policy, class, MonotonicNs(u64::MAX), 0), LaneMode::Suspended);
    }

    #[test]
    fn the_safety_floor_outranks_an_override_while_control_confirms_it() {
        let policy = LanePolicy {
            epoch: 1,
            written_at: at_ms(1_000),
            safety_floor: LaneMode::Stopped as u8,
            mode_by_hand: LaneMode::Normal as u8,
            by_hand: 1,
            ..LanePolicy::default()
        };
        for class in [TrafficClass::Critical, TrafficClass::Noncritical] {
            assert_eq!(effective_mode(&policy, class, at_ms(3_000), 2_000), LaneMode::Stopped);
            assert_eq!(effective_mode(&policy, class, at_ms(3_001), 2_000), LaneMode::Normal);
        }
    }

    #[test]
    fn the_safety_floor_is_the_reason_only_of_a_mode_that_it_changes() {
        let of = |mode: LaneMode, floor: LaneMode| {
            let written_at = at_ms(1_000);
            let (mode, safety_floor) = (mode as u8, floor as u8);
            let policy = LanePolicy { epoch: 1, written_at, mode, safety_floor, ..LanePolicy::default() };
            mode_and_source(&policy, TrafficClass::Noncritical, at_ms(2_000), 2_000)
        };
        use LaneMode::{Degraded, Normal, Suspended};
        assert_eq!(of(Normal, Suspended), (Suspended, ModeReason::Safety));
        assert_eq!(of(Suspended, Suspended), (Suspended, ModeReason::Control));
        assert_eq!(of(Suspended, Degraded), (Suspended, ModeReason::Control));
    }

    #[test]
    fn without_a_policy_every_lane_is_normal() {
        for class in [TrafficClass::Critical, TrafficClass::Noncritical] {
            assert_eq!(effective_mode(&LanePolicy::default(), class, at_ms(9), 1), LaneMode::Normal);
        }
    }
}
