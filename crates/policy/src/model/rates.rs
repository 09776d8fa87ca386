//! The rate policy of a noncritical lane: how much of a route it forwards, and which samples it drops.

use serde::{Deserialize, Serialize};

use super::modes::LaneMode;

/// The rate policy of a noncritical lane, by mode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LaneRates {
    /// In NORMAL mode.
    pub normal: RatePolicy,
    /// In DEGRADED mode.
    pub degraded: RatePolicy,
}

impl LaneRates {
    /// The rate policy of `mode`; `None` when nothing is forwarded in it.
    pub const fn in_mode(&self, mode: LaneMode) -> Option<&RatePolicy> {
        match mode {
            LaneMode::Normal => Some(&self.normal),
            LaneMode::Degraded => Some(&self.degraded),
            LaneMode::Suspended | LaneMode::Stopped => None,
        }
    }
}

/// The rate policy of a noncritical lane in one mode. It applies to each route of the lane separately, except
/// `max_bytes_per_s`, which all routes of the lane share.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RatePolicy {
    /// Samples per second; 0 forwards nothing.
    #[serde(with = "rate_as_text")]
    pub max_rate_hz: f64,
    /// Payload bytes per second over all routes of the lane; `None` is unlimited.
    pub max_bytes_per_s: Option<u64>,
    /// A sample whose age exceeds this is dropped as stale; 0 turns that off.
    pub stale_threshold_ms: u64,
    /// Which samples are dropped when more wait than the rate allows.
    pub drop_policy: DropPolicy,
    /// The most samples of each route that wait in the lane; at least 1.
    pub queue_samples: usize,
}

/// Which samples a noncritical lane drops when more wait than the rate allows (`noncritical_drop_policy`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DropPolicy {
    /// The newest sample is sent; older ones that wait are dropped as superseded.
    DropOldest,
    /// The oldest sample is sent; a new one is dropped when the queue is full.
    DropLatest,
    /// Stale samples are dropped, then the oldest other one is sent; a full queue drops the oldest one.
    DropStale,
}

/// Serializes a rate as text: that of a critical lane is infinite, and JSON has no number for infinity.
mod rate_as_text {
    use alloc::string::String;

    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(rate_hz: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(rate_hz)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}
