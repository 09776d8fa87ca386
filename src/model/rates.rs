//! How much of a route a noncritical lane forwards, and what gives way.

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

/// The rate policy of a noncritical lane in one mode. It applies to each route of the lane by itself, but for
/// `max_bytes_per_s`, which all routes of the lane share.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RatePolicy {
    /// Samples per second; 0 forwards nothing.
    #[serde(with = "rate_as_text")]
    pub max_rate_hz: f64,
    /// Payload bytes per second over all routes of the lane; `None` is unlimited.
    pub max_bytes_per_s: Option<u64>,
    /// A sample older than this by its source timestamp is dropped; 0 never.
    pub stale_threshold_ms: u64,
    /// What gives way when more samples wait than tokens come.
    pub drop_policy: DropPolicy,
    /// Samples that may wait in the lane, for each route; at least 1.
    pub queue_samples: usize,
}

/// What gives way when more samples wait than tokens come (`noncritical_drop_policy`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum DropPolicy {
    /// The freshest sample is sent; older ones that wait are superseded.
    DropOldest,
    /// The oldest sample is sent; a new one that finds the queue full is dropped.
    DropLatest,
    /// Stale samples are dropped, then the oldest fresh one is sent; the oldest gives way when the queue is
    /// full.
    DropStale,
}

/// A rate as text: that of a critical lane is infinite, which JSON has no number for.
mod rate_as_text {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(rate_hz: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(rate_hz)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}
