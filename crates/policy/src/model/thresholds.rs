//! Configured thresholds and counts for the decisions of the control process.

use serde::{Deserialize, Serialize};

/// The thresholds of the classifier (paper, section III-C) for demotion and promotion, with a gap between.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClassifierThresholds {
    /// Loss, 0 to 1, above which a reading calls for demotion.
    pub demote_loss: f64,
    /// Loss, 0 to 1, below which a reading calls for promotion.
    pub promote_loss: f64,
    /// Mean RTT above which a reading calls for demotion.
    pub demote_rtt_ms: f64,
    /// Mean RTT below which a reading calls for promotion.
    pub promote_rtt_ms: f64,
    /// Consecutive readings required for a change; 0 counts as 1.
    pub hysteresis_count: u32,
    /// Whether UNKNOWN is a separate state; otherwise it is shown and treated as CRITICAL.
    pub allow_unknown_state: bool,
}

impl Default for ClassifierThresholds {
    /// The values of the paper.
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

/// The thresholds and counts of the safety supervisor (paper, section III-E). The paper gives no numbers;
/// `policy::SafetySupervisor` explains these defaults.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SafetyRules {
    /// Whether critical lanes forward in DEGRADED even if they themselves have trouble.
    pub preserve_critical_path: bool,
    /// Whether noncritical lanes may be degraded or suspended; EMERGENCY stops them in any case.
    pub allow_noncritical_degrade: bool,
    /// More samples than this waiting in a noncritical lane count as an overflowing queue.
    pub max_noncritical_queue: usize,
    /// Whether overload stops the noncritical lanes first: EMERGENCY is then entered from DEGRADED only.
    pub overload_drop_noncritical_first: bool,
    /// p99 lag from which a reading calls for DEGRADED.
    pub degraded_lag_ms: f64,
    /// p99 lag from which a reading calls for EMERGENCY.
    pub emergency_lag_ms: f64,
    /// Occupancy of a critical lane's queue, 0 to 1, from which a reading calls for DEGRADED.
    pub degraded_queue_occupancy: f64,
    /// Occupancy of a critical lane's queue, 0 to 1, from which a reading calls for EMERGENCY.
    pub emergency_queue_occupancy: f64,
    /// Errors per second of one process from which a reading calls for DEGRADED.
    pub degraded_errors_per_s: f64,
    /// Errors per second of one process from which a reading calls for EMERGENCY.
    pub emergency_errors_per_s: f64,
    /// Time without a turn from which a process counts as silent.
    pub silent_ms: u64,
    /// Silence of a process on the critical path that calls for EMERGENCY; 0 turns that off.
    pub emergency_silent_ms: u64,
    /// Consecutive readings required to enter DEGRADED, and again to enter EMERGENCY; 0 counts as 1.
    pub hysteresis_count: u32,
    /// Consecutive readings required for each step back to NORMAL; 0 counts as 1.
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
