//! The delay of packets: its distribution, and the packets in transit.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use adaptive_bridge::model::MonotonicNs;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;

use super::error::ImpairmentError;
use super::random;

/// The largest allowed mean and standard deviation: a minute.
const DELAY_MAX_MS: f64 = 60_000.0;
/// The range of netem's table of the normal distribution, in standard deviations.
const TABLE_END: f64 = 4.0;

/// Normally distributed delays, truncated as netem truncates them: at 0, and at four standard deviations from
/// the mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NormalDelay {
    mean_ms: f64,
    sigma_ms: f64,
}

impl NormalDelay {
    /// No delay.
    pub const NONE: Self = Self { mean_ms: 0.0, sigma_ms: 0.0 };

    /// Creates delays with this mean and standard deviation before truncation, in ms, 0 to 60,000 each.
    ///
    /// # Errors
    /// One of them is out of its range.
    pub fn new(mean_ms: f64, sigma_ms: f64) -> Result<Self, ImpairmentError> {
        for (name, value) in [("delay", mean_ms), ("jitter", sigma_ms)] {
            if !(0.0..=DELAY_MAX_MS).contains(&value) {
                return Err(ImpairmentError::BadParameter {
                    name,
                    value: format!("{value} ms"),
                    allowed: "0 to 60000 ms",
                });
            }
        }
        Ok(Self { mean_ms, sigma_ms })
    }

    /// The mean, in milliseconds.
    pub const fn mean_ms(&self) -> f64 {
        self.mean_ms
    }

    /// The standard deviation, in milliseconds.
    pub const fn sigma_ms(&self) -> f64 {
        self.sigma_ms
    }

    /// Whether every packet passes without delay.
    pub fn is_none(&self) -> bool {
        *self == Self::NONE
    }

    /// Draws the delay of a packet, in nanoseconds.
    fn draw_ns(&self, random: &mut Pcg64) -> u64 {
        let normal: f64 = StandardNormal.sample(random);
        let ms = self.mean_ms + self.sigma_ms * normal.clamp(-TABLE_END, TABLE_END);
        // From float to integer `as` saturates, at 0 here.
        (ms * 1e6).round() as u64
    }
}

/// The packets in transit, each with its release time. A packet may overtake another, as with netem; packets
/// with the same release time keep their order.
#[derive(Clone, Debug)]
pub struct DelayLine {
    delay: NormalDelay,
    random: Pcg64,
    /// Release time, arrival number, packet.
    held: BinaryHeap<Reverse<(MonotonicNs, u64, u32)>>,
    arrived: u64,
}

impl DelayLine {
    /// Creates an empty delay line; the same seed always gives the same delays.
    pub fn new(delay: NormalDelay, seed: u64) -> Self {
        Self { delay, random: random::of_delay(seed), held: BinaryHeap::new(), arrived: 0 }
    }

    /// Changes the delays of packets that arrive from now on; packets in transit keep theirs.
    pub fn set(&mut self, delay: NormalDelay) {
        self.delay = delay;
    }

    /// Adds a packet that arrives at `now`; returns its release time.
    pub fn push(&mut self, packet: u32, now: MonotonicNs) -> MonotonicNs {
        let release = now.plus_ns(self.delay.draw_ns(&mut self.random));
        self.held.push(Reverse((release, self.arrived, packet)));
        self.arrived += 1;
        release
    }

    /// Removes and returns the next packet that is due at `now`.
    pub fn pop_due(&mut self, now: MonotonicNs) -> Option<u32> {
        if self.next_release()? > now {
            return None;
        }
        self.held.pop().map(|Reverse((_, _, packet))| packet)
    }

    /// The next release time; `None` when no packet is in transit.
    pub fn next_release(&self) -> Option<MonotonicNs> {
        self.held.peek().map(|Reverse((release, _, _))| *release)
    }

    /// The number of packets in transit.
    pub fn len(&self) -> usize {
        self.held.len()
    }

    /// Whether no packet is in transit.
    pub fn is_empty(&self) -> bool {
        self.held.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn delays_ms(mean_ms: f64, sigma_ms: f64, packets: u32, seed: u64) -> Vec<f64> {
        let delay = NormalDelay::new(mean_ms, sigma_ms).expect("in range");
        let mut line = DelayLine::new(delay, seed);
        (0..packets).map(|packet| line.push(packet, MonotonicNs(0)).0 as f64 / 1e6).collect()
    }

    fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / n;
        (mean, variance.sqrt())
    }

    #[test]
    fn delays_have_the_mean_and_deviation_of_the_truncated_distribution() {
        // N(20, 10) with what is below 0 at 0: mean 20 Φ(2) + 10 φ(2) = 20.085, and from
        // E[X²] = 500 Φ(2) + 200 φ(2) the deviation is 9.778. Four deviations take less than 0.01 from both.
        for (mean, sigma, expected_mean, expected_sigma) in
            [(20.0, 10.0, 20.085, 9.778), (100.0, 5.0, 100.0, 5.0), (20.0, 0.0, 20.0, 0.0)]
        {
            let (seen_mean, seen_sigma) = mean_and_deviation(&delays_ms(mean, sigma, 100_000, 3));
            // Five standard errors of a mean over 100,000, and twice that, at least 0.01.
            let tolerance = 0.01 + 5.0 * sigma / 100_000_f64.sqrt();
            assert!((seen_mean - expected_mean).abs() <= tolerance, "{seen_mean}");
            assert!((seen_sigma - expected_sigma).abs() <= tolerance, "{seen_sigma}");
        }
    }

    #[test]
    fn delays_are_truncated_at_zero_and_at_four_deviations() {
        let delays = delays_ms(10.0, 10.0, 200_000, 5);
        assert!(delays.iter().all(|delay| (0.0..=50.0).contains(delay)));
        // Φ(−1) is 15.9 %.
        let at_once = delays.iter().filter(|delay| **delay == 0.0).count();
        assert!((30_500..33_000).contains(&at_once), "{at_once}");
    }

    #[test]
    fn a_delay_out_of_range_is_refused() {
        for (mean, sigma) in [(-1.0, 0.0), (0.0, -1.0), (f64::NAN, 0.0), (60_001.0, 0.0)] {
            assert!(NormalDelay::new(mean, sigma).is_err(), "{mean} {sigma}");
        }
    }

    proptest! {
        #[test]
        fn each_packet_leaves_once_at_its_release_time(
            gaps_us in proptest::collection::vec(0..5_000_u64, 1..200),
            sigma_ms in 0.0..20.0,
            seed: u64,
        ) {
            let delay = NormalDelay::new(10.0, sigma_ms).expect("in range");
            let mut line = DelayLine::new(delay, seed);
            let mut now = MonotonicNs(0);
            let mut releases = Vec::new();
            let mut left = Vec::new();
            for (packet, gap_us) in gaps_us.iter().enumerate() {
                now = now.plus_ns(gap_us * 1_000);
                while let Some(packet) = line.pop_due(now) {
                    left.push(packet);
                }
                releases.push(line.push(packet as u32, now));
                prop_assert_eq!(line.len(), releases.len() - left.len());
            }
            // Each remaining packet leaves at its release time, and not one nanosecond earlier.
            while let Some(release) = line.next_release() {
                if release.0 > now.0 {
                    prop_assert_eq!(line.pop_due(MonotonicNs(release.0 - 1)), None);
                }
                now = now.max(release);
                left.extend(line.pop_due(now));
            }
            prop_assert!(line.is_empty());
            prop_assert_eq!(left.len(), releases.len());
            let mut seen = left.clone();
            seen.sort_unstable();
            prop_assert!(seen.iter().enumerate().all(|(at, packet)| at == *packet as usize));
            if sigma_ms == 0.0 {
                prop_assert_eq!(left, seen);
            }
        }
    }

    #[test]
    fn a_line_without_jitter_keeps_the_order() {
        let mut line = DelayLine::new(NormalDelay::new(5.0, 0.0).expect("in range"), 1);
        for packet in 0..100 {
            line.push(packet, MonotonicNs(7));
        }
        assert_eq!(line.pop_due(MonotonicNs(7).plus_ns(4_999_999)), None);
        let left: Vec<u32> = std::iter::from_fn(|| line.pop_due(MonotonicNs(7).plus_ms(5))).collect();
        assert_eq!(left, (0..100).collect::<Vec<_>>());
    }
}
