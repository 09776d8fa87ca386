//! Instants, with one type for each of the three clocks, so that they cannot be confused.

use serde::{Deserialize, Serialize};

/// An instant of `CLOCK_MONOTONIC`, in nanoseconds.
///
/// Unlike `std::time::Instant` it can be stored in shared memory and written as a literal in a test. It is
/// comparable only between processes of one host since one boot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[repr(transparent)]
pub struct MonotonicNs(pub u64);

impl MonotonicNs {
    /// Nanoseconds from `earlier` to `self`; 0 when `earlier` is the later one.
    #[inline]
    pub const fn since(self, earlier: Self) -> u64 {
        self.0.saturating_sub(earlier.0)
    }

    /// The instant `ns` nanoseconds later.
    #[inline]
    pub const fn plus_ns(self, ns: u64) -> Self {
        Self(self.0.saturating_add(ns))
    }

    /// The instant `ms` milliseconds later.
    #[inline]
    pub const fn plus_ms(self, ms: u64) -> Self {
        self.plus_ns(ms.saturating_mul(1_000_000))
    }
}

/// An instant of `CLOCK_REALTIME`, in nanoseconds since the Unix epoch. It may step backwards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[repr(transparent)]
pub struct WallNs(pub u64);

impl WallNs {
    /// Nanoseconds from `earlier` to `self`; 0 when `earlier` is the later one.
    #[inline]
    pub const fn since(self, earlier: Self) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// A DDS source timestamp exactly as RTPS carries it (`Time_t`, RTPS 2.5 clause 9.3.2.1): whole seconds of
/// the Unix epoch in the upper 32 bits and 2⁻³² fractions of a second in the lower ones.
///
/// Kept in this form and not in nanoseconds, so that the timestamp is forwarded bit for bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub struct SourceTimestamp(pub u64);

impl SourceTimestamp {
    /// No source timestamp (`TIME_INVALID` or no `INFO_TS` submessage).
    pub const NONE: Self = Self(0);

    /// The instant as nanoseconds since the Unix epoch, rounded down; `None` for [`Self::NONE`].
    #[inline]
    pub const fn to_wall(self) -> Option<WallNs> {
        if self.0 == 0 {
            return None;
        }
        let seconds = self.0 >> 32;
        let nanos = ((self.0 & 0xffff_ffff) * 1_000_000_000) >> 32;
        Some(WallNs(seconds * 1_000_000_000 + nanos))
    }

    /// The nearest timestamp that is not before `wall`, so that a round trip through
    /// [`to_wall`](Self::to_wall) gives `wall` back. Seconds beyond 2106 wrap, as `Time_t` does.
    #[inline]
    pub const fn from_wall(wall: WallNs) -> Self {
        let seconds = (wall.0 / 1_000_000_000) & 0xffff_ffff;
        let nanos = wall.0 % 1_000_000_000;
        let fraction = (nanos << 32).div_ceil(1_000_000_000);
        Self((seconds << 32) + fraction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_never_underflow() {
        assert_eq!(MonotonicNs(5).since(MonotonicNs(9)), 0);
        assert_eq!(MonotonicNs(9).since(MonotonicNs(5)), 4);
        assert_eq!(WallNs(5).since(WallNs(9)), 0);
        assert_eq!(MonotonicNs(u64::MAX).plus_ms(1), MonotonicNs(u64::MAX));
    }

    #[test]
    fn a_source_timestamp_converts_to_nanoseconds_and_back_exactly() {
        for nanos in [0, 1, 2, 499_999_999, 500_000_000, 999_999_998, 999_999_999] {
            let wall = WallNs(1_763_000_000_000_000_000 + nanos);
            assert_eq!(SourceTimestamp::from_wall(wall).to_wall(), Some(wall));
        }
        assert_eq!(SourceTimestamp::NONE.to_wall(), None);
    }
}
