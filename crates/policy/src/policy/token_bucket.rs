//! Rate limits: a token bucket for samples, and a budget with debt for bytes.
//!
//! Both count in integers and are therefore exact: credit is (rate × elapsed time), summed without rounding,
//! so that nothing drifts, however often or late the caller polls. The bucket admits the same samples as the
//! generic cell rate algorithm (ITU-T I.371): at most `rate × t + burst` tokens in any window of `t` seconds.
//!
//! Why the bucket must hold more than one token, with measurements: docs/decisions/0003-token-bucket.md.

use crate::model::{LaneMode, LaneRates, MonotonicNs};

/// The highest rate of a [`TokenBucket`], in hertz.
pub const MAX_RATE_HZ: f64 = 100_000.0;

/// Every burst includes the credit of this time, 50 ms, so that late wake-ups do not lower the rate.
///
/// Two consecutive wake-ups may be late, that for the token and that for a sample, so this covers 25 ms each.
/// The latest on an idle machine without real-time scheduling was 2.3 ms; ten times that leaves room for a
/// loaded one, and is still only half a sample at 10 Hz.
pub const BURST_WINDOW_NS: u64 = 50_000_000;

/// One token in units of credit. A unit is one nanohertz times one nanosecond, 10⁻¹⁸ of a token: a rate of
/// 0.01 Hz is then exact to 5 × 10⁻⁸, and the credit of 584 years at 100 kHz is below 2 × 10³³,
/// where 3 × 10³⁸ fit.
const TOKEN: u128 = 1_000_000_000_000_000_000;

/// One byte in units of (byte per second) × nanosecond.
const BYTE: i128 = 1_000_000_000;

/// The burst, in tokens, with which a lane reaches `rate_hz`: two tokens plus those that accrue in
/// [`BURST_WINDOW_NS`].
///
/// The lane reaches the rate if the burst is at least 1 + rate × (jitter + 2 × lateness): one token, which
/// the next sample takes, plus those that accrue while the publisher or the consumer is late. The second
/// token covers a jitter of a whole input interval, peak to peak; the rest covers lateness. With wake-ups up
/// to 3 ms late, a burst of one token reaches 9.85 of 10 Hz and 396 of 1,000 Hz, two tokens reach 710 of
/// 1,000 Hz, and one token plus 50 ms reaches 0.483 of 0.5 Hz with that jitter; this burst reaches each of
/// these rates.
pub fn burst_for(rate_hz: f64) -> f64 {
    2.0 + usable_rate(rate_hz) * (BURST_WINDOW_NS as f64 / 1e9)
}

fn usable_rate(rate_hz: f64) -> f64 {
    if rate_hz.is_nan() { 0.0 } else { rate_hz.clamp(0.0, MAX_RATE_HZ) }
}

/// A token bucket: tokens accrue at a rate, up to a burst, and each sample takes one.
#[derive(Clone, Debug)]
pub struct TokenBucket {
    rate_nhz: u64,
    /// The largest credit.
    cap: u128,
    /// The credit at `updated_at`, at most `cap`.
    credit: u128,
    updated_at: MonotonicNs,
}

impl TokenBucket {
    /// A bucket that holds one token, so that the first sample passes immediately and a process that restarts
    /// repeatedly does not send a burst each time.
    ///
    /// `rate_hz` is rounded to nanohertz and limited to 0 to [`MAX_RATE_HZ`]; NaN counts as 0. At rate 0 no
    /// further token accrues. `burst` is in tokens, at least 1; see [`burst_for`].
    pub fn new(rate_hz: f64, burst: f64, now: MonotonicNs) -> Self {
        let mut bucket = Self { rate_nhz: 0, cap: TOKEN, credit: TOKEN, updated_at: now };
        bucket.set_rate(rate_hz, burst, now);
        bucket
    }

    /// A bucket that holds its whole burst.
    pub fn full(rate_hz: f64, burst: f64, now: MonotonicNs) -> Self {
        let mut bucket = Self::new(rate_hz, burst, now);
        bucket.credit = bucket.cap;
        bucket
    }

    /// Accrues at `rate_hz` from `now` on. The credit stays, up to the new `burst`.
    pub fn set_rate(&mut self, rate_hz: f64, burst: f64, now: MonotonicNs) {
        self.settle(now);
        let rate_nhz = usable_rate(rate_hz) * 1e9;
        // A rate above 0 is never rounded to 0, at which no token accrues.
        self.rate_nhz = if rate_nhz > 0.0 { libm::round(rate_nhz).max(1.0) as u64 } else { 0 };
        // `as` saturates, and converts NaN to 0.
        self.cap = ((burst * TOKEN as f64) as u128).max(TOKEN);
        self.credit = self.credit.min(self.cap);
    }

    /// The instant of the next token: `now` if the bucket has one, else later; `None` if the rate is 0.
    #[inline]
    pub fn ready_at(&self, now: MonotonicNs) -> Option<MonotonicNs> {
        let missing = TOKEN.saturating_sub(self.credit);
        if missing == 0 {
            return Some(now);
        }
        if self.rate_nhz == 0 {
            return None;
        }
        // At most TOKEN, which fits.
        let wait_ns = missing.div_ceil(u128::from(self.rate_nhz)) as u64;
        Some(self.updated_at.plus_ns(wait_ns).max(now))
    }

    /// Whole tokens in the bucket at `now`.
    pub fn tokens(&self, now: MonotonicNs) -> u64 {
        u64::try_from(self.credit_at(now) / TOKEN).unwrap_or(u64::MAX)
    }

    /// Takes a token if the bucket has one, and returns whether it had.
    #[inline]
    pub fn try_take(&mut self, now: MonotonicNs) -> bool {
        self.settle(now);
        let rest = self.credit.checked_sub(TOKEN);
        self.credit = rest.unwrap_or(self.credit);
        rest.is_some()
    }

    fn credit_at(&self, now: MonotonicNs) -> u128 {
        let accrued = u128::from(now.since(self.updated_at)) * u128::from(self.rate_nhz);
        (self.credit + accrued).min(self.cap)
    }

    /// Updates the credit to `now`; none accrues before `updated_at`, after a clock has stepped back.
    fn settle(&mut self, now: MonotonicNs) {
        self.credit = self.credit_at(now);
        self.updated_at = self.updated_at.max(now);
    }
}

/// A limit of bytes per second, with debt: a sample of any size passes while the balance is not negative, and
/// the debt that it makes delays the next. A sample larger than the bytes of one second therefore still
/// passes, and the long-term rate is exact for samples of any size.
///
/// The balance is limited to the bytes that accrue in [`BURST_WINDOW_NS`] plus the largest sample so far, the
/// same two parts as in [`burst_for`]. In any window of `t` seconds at most `rate × t` bytes, that burst, and
/// one sample of debt pass.
///
/// The caller polls routes that share a budget in turn, see [`PollOrder`](super::PollOrder): otherwise the
/// route polled first takes all of it.
#[derive(Clone, Debug)]
pub struct ByteBudget {
    /// `None` is unlimited.
    bytes_per_s: Option<u64>,
    /// The balance at `updated_at`.
    balance: i128,
    largest: u64,
    updated_at: MonotonicNs,
}

impl ByteBudget {
    /// A budget with an empty balance; `None` is unlimited.
    pub fn new(bytes_per_s: Option<u64>, now: MonotonicNs) -> Self {
        Self { bytes_per_s, balance: 0, largest: 0, updated_at: now }
    }

    /// Accrues at `bytes_per_s` from `now` on. Debt stays, except that `None` (unlimited) cancels it.
    pub fn set_rate(&mut self, bytes_per_s: Option<u64>, now: MonotonicNs) {
        self.settle(now);
        self.bytes_per_s = bytes_per_s;
        self.balance = if bytes_per_s.is_some() { self.balance.min(self.cap()) } else { 0 };
    }

    /// Accrues at the rate of `mode`; in one that forwards nothing at the former rate, to pay off debt.
    pub fn set_mode(&mut self, rates: &LaneRates, mode: LaneMode, now: MonotonicNs) {
        if let Some(rate) = rates.in_mode(mode) {
            self.set_rate(rate.max_bytes_per_s, now);
        }
    }

    /// The instant from which the balance is not negative: `now` or later; `None` in debt at rate 0.
    #[inline]
    pub fn ready_at(&self, now: MonotonicNs) -> Option<MonotonicNs> {
        match self.bytes_per_s {
            None => Some(now),
            Some(_) if self.balance >= 0 => Some(now),
            Some(0) => None,
            Some(rate) => {
                let wait_ns = self.balance.unsigned_abs().div_ceil(u128::from(rate));
                let wait_ns = u64::try_from(wait_ns).unwrap_or(u64::MAX);
                Some(self.updated_at.plus_ns(wait_ns).max(now))
            }
        }
    }

    /// Takes `bytes` if the balance is not negative, and returns whether it did.
    #[inline]
    pub fn try_take(&mut self, bytes: u64, now: MonotonicNs) -> bool {
        if self.bytes_per_s.is_none() {
            return true;
        }
        self.settle(now);
        if self.balance < 0 {
            return false;
        }
        self.largest = self.largest.max(bytes);
        self.balance -= i128::from(bytes) * BYTE;
        true
    }

    /// Whole bytes that can be taken at `now` without debt; 0 while in debt.
    pub fn balance_bytes(&self, now: MonotonicNs) -> u64 {
        if self.bytes_per_s.is_none() {
            return u64::MAX;
        }
        u64::try_from(self.balance_at(now).max(0) / BYTE).unwrap_or(u64::MAX)
    }

    fn cap(&self) -> i128 {
        let rate = i128::from(self.bytes_per_s.unwrap_or(0));
        rate * i128::from(BURST_WINDOW_NS) + i128::from(self.largest) * BYTE
    }

    fn balance_at(&self, now: MonotonicNs) -> i128 {
        let rate = u128::from(self.bytes_per_s.unwrap_or(0));
        let accrued = u128::from(now.since(self.updated_at)) * rate;
        let accrued = i128::try_from(accrued).unwrap_or(i128::MAX);
        self.balance.saturating_add(accrued).min(self.cap())
    }

    fn settle(&mut self, now: MonotonicNs) {
        self.balance = self.balance_at(now);
        self.updated_at = self.updated_at.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    #[test]
    fn the_bucket_starts_with_one_token_and_the_second_comes_one_interval_later() {
        let start = MonotonicNs(7);
        let mut bucket = TokenBucket::new(8.0, 2.0, start);
        assert_eq!(bucket.ready_at(start), Some(start));
        assert!(bucket.try_take(start));
        assert!(!bucket.try_take(start));
        let next = start.plus_ms(125);
        assert_eq!(bucket.ready_at(start), Some(next));
        assert!(!bucket.try_take(MonotonicNs(next.0 - 1)));
        assert!(bucket.try_take(next));
    }

    #[test]
    fn ready_at_is_the_first_instant_at_which_a_token_can_be_taken() {
        for rate_hz in [0.01, 0.3, 1.0, 3.0, 7.77, 999.9, 30_000.0, 100_000.0] {
            let mut bucket = TokenBucket::new(rate_hz, 1.0, MonotonicNs(0));
            let mut now = MonotonicNs(0);
            for _ in 0..100 {
                assert!(bucket.try_take(now), "{rate_hz}");
                now = bucket.ready_at(now).expect("a rate above 0");
                assert!(!bucket.clone().try_take(MonotonicNs(now.0 - 1)), "{rate_hz}");
            }
        }
    }

    #[test]
    fn at_rate_zero_no_further_token_accrues() {
        for rate_hz in [0.0, -1.0, f64::NAN, f64::NEG_INFINITY] {
            let mut bucket = TokenBucket::new(rate_hz, f64::NAN, MonotonicNs(0));
            assert!(bucket.try_take(MonotonicNs(0)));
            assert_eq!(bucket.ready_at(MonotonicNs(u64::MAX)), None, "{rate_hz}");
            assert!(!bucket.try_take(MonotonicNs(u64::MAX)));
        }
    }

    #[test]
    fn tokens_are_limited_to_the_burst() {
        let mut bucket = TokenBucket::new(10.0, 2.5, MonotonicNs(0));
        let late = MonotonicNs(u64::MAX / 2);
        assert_eq!(bucket.tokens(late), 2);
        assert!(bucket.try_take(late) && bucket.try_take(late) && !bucket.try_take(late));
        // The remaining half token shortens the wait by half an interval.
        assert_eq!(bucket.ready_at(late), Some(late.plus_ms(50)));
    }

    #[test]
    fn the_rate_is_exact_over_thirty_days_of_irregular_wake_ups() {
        let mut bucket = TokenBucket::new(7.3, 4.0, MonotonicNs(0));
        let mut taken = 0_u64;
        let (mut now, end) = (MonotonicNs(0), 30 * 86_400 * SECOND);
        let mut late_ns = 1;
        while now.0 <= end {
            assert!(bucket.try_take(now));
            taken += 1;
            late_ns = (late_ns * 48_271) % 2_147_483_647;
            now = bucket.ready_at(now).expect("a rate above 0").plus_ns(late_ns % 3_000_000);
        }
        // 7.3 Hz for 2,592,000 s, plus the first token; the last wake-up may be late.
        assert!(taken.abs_diff(18_921_600 + 1) <= 1, "{taken}");
    }

    #[test]
    fn a_clock_that_steps_back_neither_adds_nor_removes_tokens() {
        let mut bucket = TokenBucket::new(10.0, 2.0, MonotonicNs(0));
        let now = MonotonicNs(10 * SECOND);
        assert!(bucket.try_take(now) && bucket.try_take(now));
        let before = MonotonicNs(5 * SECOND);
        assert!(!bucket.try_take(before));
        assert_eq!(bucket.ready_at(before), Some(now.plus_ms(100)));
        assert!(bucket.try_take(now.plus_ms(100)));
    }

    #[test]
    fn a_new_rate_applies_from_the_change_on() {
        let mut bucket = TokenBucket::new(10.0, 2.0, MonotonicNs(0));
        assert!(bucket.try_take(MonotonicNs(0)));
        // Half a token at 10 Hz, and the other half at 1 Hz.
        let half = MonotonicNs(50_000_000);
        bucket.set_rate(1.0, 2.0, half);
        assert_eq!(bucket.ready_at(half), Some(half.plus_ms(500)));
        bucket.set_rate(0.0, 2.0, half.plus_ms(500));
        assert!(bucket.try_take(half.plus_ms(500)), "accrued before the rate became 0");
        assert_eq!(bucket.ready_at(half.plus_ms(900)), None);
    }

    #[test]
    fn extreme_instants_and_rates_do_not_overflow() {
        let mut bucket = TokenBucket::new(f64::INFINITY, f64::INFINITY, MonotonicNs(0));
        assert!(bucket.try_take(MonotonicNs(u64::MAX)));
        assert!(bucket.tokens(MonotonicNs(u64::MAX)) > 1_000_000);
        let mut budget = ByteBudget::new(Some(u64::MAX), MonotonicNs(0));
        assert!(budget.try_take(u64::MAX, MonotonicNs(u64::MAX)));
        assert!(budget.ready_at(MonotonicNs(u64::MAX)).is_some());
        budget.set_rate(Some(1), MonotonicNs(u64::MAX));
        assert_eq!(budget.ready_at(MonotonicNs(u64::MAX)), Some(MonotonicNs(u64::MAX)));
    }

    #[test]
    fn a_sample_larger_than_the_budget_passes_and_its_debt_delays_the_next() {
        let start = MonotonicNs(0);
        let mut budget = ByteBudget::new(Some(1_000), start);
        assert!(budget.try_take(5_000, start));
        assert!(!budget.try_take(1, start));
        assert_eq!(budget.ready_at(start), Some(MonotonicNs(5 * SECOND)));
        assert!(!budget.try_take(1, MonotonicNs(5 * SECOND - 1)));
        assert!(budget.try_take(1, MonotonicNs(5 * SECOND)));
    }

    #[test]
    fn the_balance_has_the_bytes_of_the_time_passed_up_to_the_burst_and_none_in_debt() {
        let start = MonotonicNs(0);
        let mut budget = ByteBudget::new(Some(1_000), start);
        assert_eq!([0, 10, 50, 5_000].map(|ms| budget.balance_bytes(start.plus_ms(ms))), [0, 10, 50, 50]);
        assert!(budget.try_take(100, start.plus_ms(50)));
        assert_eq!([50, 99, 120].map(|ms| budget.balance_bytes(start.plus_ms(ms))), [0, 0, 20]);
    }

    #[test]
    fn an_unlimited_budget_is_always_ready_and_cancels_debt() {
        let start = MonotonicNs(0);
        let mut budget = ByteBudget::new(Some(1), start);
        assert!(budget.try_take(1_000_000, start));
        budget.set_rate(None, start);
        assert!(budget.try_take(u64::MAX, start));
        assert_eq!(budget.ready_at(start), Some(start));
        assert_eq!(budget.balance_bytes(start), u64::MAX);
        budget.set_rate(Some(1), start);
        assert_eq!(budget.ready_at(start), Some(start));
    }

    #[test]
    fn a_byte_rate_of_zero_is_never_ready_once_in_debt() {
        let mut budget = ByteBudget::new(Some(0), MonotonicNs(0));
        assert!(budget.try_take(1, MonotonicNs(0)));
        assert_eq!(budget.ready_at(MonotonicNs(u64::MAX)), None);
    }
}
