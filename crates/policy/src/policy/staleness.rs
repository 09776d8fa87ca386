//! The age of a sample, and whether the sample is stale.

use crate::model::{MonotonicNs, SourceTimestamp, WallNs};

/// The age of a sample in nanoseconds: since its source timestamp, or, without one, since `taken_at`. 0 when
/// that instant is in the future, because a clock stepped back or the publisher's clock is ahead.
#[inline]
pub fn age_ns(
    source_timestamp: SourceTimestamp,
    taken_at: MonotonicNs,
    now: MonotonicNs,
    now_wall: WallNs,
) -> u64 {
    match source_timestamp.to_wall() {
        Some(source) => now_wall.since(source),
        None => now.since(taken_at),
    }
}

/// Whether a sample of that age is older than `threshold_ms`; a threshold of 0 is never exceeded.
#[inline]
pub const fn is_stale(age_ns: u64, threshold_ms: u64) -> bool {
    threshold_ms != 0 && age_ns > threshold_ms.saturating_mul(1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    const EPOCH: WallNs = WallNs(1_763_000_000_000_000_000);

    fn later(ms: u64) -> WallNs {
        WallNs(EPOCH.0 + ms * 1_000_000)
    }

    #[test]
    fn the_age_is_measured_from_the_source_timestamp() {
        let source = SourceTimestamp::from_wall(EPOCH);
        assert_eq!(age_ns(source, MonotonicNs(0), MonotonicNs(u64::MAX), later(201)), 201_000_000);
    }

    #[test]
    fn without_a_source_timestamp_the_age_is_measured_from_the_arrival() {
        let age = age_ns(SourceTimestamp::NONE, MonotonicNs(5), MonotonicNs(12), later(9));
        assert_eq!(age, 7);
    }

    #[test]
    fn a_sample_from_the_future_has_age_zero() {
        let ahead = SourceTimestamp::from_wall(later(5_000));
        assert_eq!(age_ns(ahead, MonotonicNs(0), MonotonicNs(0), EPOCH), 0);
        assert_eq!(age_ns(SourceTimestamp::NONE, MonotonicNs(9), MonotonicNs(3), EPOCH), 0);
    }

    #[test]
    fn a_sample_is_stale_beyond_the_threshold_and_not_at_it() {
        assert!(!is_stale(200_000_000, 200));
        assert!(is_stale(200_000_001, 200));
        assert!(!is_stale(u64::MAX, u64::MAX));
    }

    #[test]
    fn a_threshold_of_zero_is_never_exceeded() {
        assert!(!is_stale(u64::MAX, 0));
    }
}
