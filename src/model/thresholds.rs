//! What the control plane's decisions go by: thresholds and counts, as the configuration has them.

use serde::{Deserialize, Serialize};

/// The two sets of thresholds of the classifier (paper, section III-C), with a gap between them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassifierThresholds {
    /// Loss, 0 to 1, above which a reading speaks for demotion.
    pub demote_loss: f64,
    /// Loss, 0 to 1, below which a reading speaks for promotion.
    pub promote_loss: f64,
    /// Mean RTT above which a reading speaks for demotion.
    pub demote_rtt_ms: f64,
    /// Mean RTT below which a reading speaks for promotion.
    pub promote_rtt_ms: f64,
    /// Consecutive readings that it takes; 0 counts as 1.
    pub hysteresis_count: u32,
    /// Whether UNKNOWN is a state of its own; otherwise it is shown and treated as CRITICAL.
    pub allow_unknown_state: bool,
}

impl Default for ClassifierThresholds {
    /// Those of the paper.
    fn default() -> Self {
        Self {
            demote_loss: 0.015,
            promote_loss: 0.005,
            demote_rtt_ms: 50.0,
            promote_rtt_ms: 35.0,
            hysteresis_count: 3,
            allow_unknown_state: true,
        }
    }
}

/// What the safety supervisor goes by (paper, section III-E). The paper gives no numbers: the defaults are
/// ours, and `policy::SafetySupervisor` says why.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SafetyRules {
    /// Whether the critical path is preserved in DEGRADED; otherwise it stops there too, unless the trouble
    /// is of noncritical lanes alone.
    pub preserve_critical_path: bool,
    /// Whether noncritical lanes may be degraded or suspended at all; EMERGENCY stops them all the same.
    pub allow_noncritical_degrade: bool,
    /// More samples than these waiting in a noncritical lane count as an overflowing queue.
    pub max_noncritical_queue: usize,
    /// Whether overload takes the noncritical lanes first: EMERGENCY is then entered from DEGRADED only.
    pub overload_drop_noncritical_first: bool,
    /// p99 lag at which a reading speaks for DEGRADED.
    pub degraded_lag_ms: f64,
    /// p99 lag at which a reading speaks for EMERGENCY.
    pub emergency_lag_ms: f64,
    /// Share of a critical lane's queue, 0 to 1, at which a reading speaks for DEGRADED.
    pub degraded_queue_occupancy: f64,
    /// Share of a critical lane's queue, 0 to 1, at which a reading speaks for EMERGENCY.
    pub emergency_queue_occupancy: f64,
    /// Errors per second of one process at which a reading speaks for DEGRADED.
    pub degraded_errors_per_s: f64,
    /// Errors per second of one process at which a reading speaks for EMERGENCY.
    pub emergency_errors_per_s: f64,
    /// A process that has not turned for so long is silent.
    pub silent_ms: u64,
    /// Silence of a process on the critical path that speaks for EMERGENCY; 0 never does.
    pub emergency_silent_ms: u64,
    /// Consecutive readings that the way up takes; 0 counts as 1.
    pub hysteresis_count: u32,
    /// Consecutive readings that each step of the way back takes; 0 counts as 1.
    pub recovery_count: u32,
}

impl Default for SafetyRules {
    fn default() -> Self {
        Self {
            preserve_critical_path: true,
            allow_noncritical_degrade: true,
            max_noncritical_queue: 50,
            overload_drop_noncritical_first: true,
            degraded_lag_ms: 500.0,
            emergency_lag_ms: 2_000.0,
            degraded_queue_occupancy: 0.75,
            emergency_queue_occupancy: 0.95,
            degraded_errors_per_s: 5.0,
            emergency_errors_per_s: 100.0,
            silent_ms: 2_000,
            emergency_silent_ms: 30_000,
            hysteresis_count: 3,
            recovery_count: 10,
        }
    }
}
