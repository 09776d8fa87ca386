//! Reads the rates, stale thresholds and queues of noncritical lanes, from `routing_policy` and from each
//! lane.

use super::field::Field;
use super::settings::{DropPolicy, LaneRates, RatePolicy};

/// The paper's rate in DEGRADED (section III-D).
const DEGRADED_RATE_HZ: f64 = 3.0;

/// The default queue of a noncritical lane: the depth of the paper's writer, and fewer samples in DEGRADED.
const NORMAL_DEPTH: u64 = 5;
const DEGRADED_DEPTH: u64 = 2;

const MODES: &[&str] = &["normal", "degraded", "disabled", "emergency", "failure"];

/// The keys that a critical lane must not have.
const RATE_KEYS: &[&str] = &[
    "max_rate_hz",
    "degraded_rate_hz",
    "max_bytes_per_s",
    "degraded_max_bytes_per_s",
    "stale_threshold_ms",
    "degraded_stale_threshold_ms",
    "drop_policy",
    "queue_samples",
];

/// Reports a rate that the file gives for a critical lane, because it would have no effect: the lane forwards
/// every sample.
pub(super) fn refuse_rates(lane: &Field<'_>) {
    for key in RATE_KEYS {
        let rate = lane.get(key);
        if rate.is_given() {
            rate.report::<()>("must not be given: the critical lane forwards every sample");
        }
    }
}

/// The section `routing_policy`: the defaults of all noncritical lanes.
pub(super) struct RoutingPolicy {
    enabled: bool,
    normal_rate_hz: f64,
    degraded_rate_hz: Option<f64>,
    normal_stale_ms: u64,
    degraded_stale_ms: Option<u64>,
    normal_queue: Queue,
    degraded_queue: Queue,
}

struct Queue {
    drop_policy: DropPolicy,
    samples: usize,
}

impl RoutingPolicy {
    /// Reads the section. `max_noncritical_queue` bounds the queue where a mode does not.
    pub fn read(root: &Field<'_>, max_noncritical_queue: u64) -> Self {
        let section = root.section("routing_policy");
        let forward = section.get("critical_always_forward");
        if forward.flag() == Some(false) {
            forward.report::<()>("must be true: a critical lane forwards in every mode but emergency");
        }
        let rate_hz = section.get("noncritical_max_rate_hz").decimal_or_default();
        let stale_ms = section.get("stale_threshold_ms").count_or_default();
        let drop_policy = section.get("noncritical_drop_policy").choice_or_default();

        let modes = section.section("modes");
        for (name, mode) in modes.entries() {
            match name {
                "normal" | "degraded" => {}
                _ if MODES.contains(&name) => check_closed_mode(&mode),
                _ => mode.report_unknown_key("a mode", name, MODES),
            }
        }
        let queue = |mode: &Field<'_>, default: u64| {
            let cap = mode.get("max_noncritical_queue").count().unwrap_or(max_noncritical_queue);
            let depth = mode.get("noncritical_depth").count().unwrap_or(default);
            Queue {
                drop_policy: mode.get("noncritical_drop_policy").choice().unwrap_or(drop_policy),
                // At least one sample waits: the one that the next token sends.
                samples: usize::try_from(depth.min(cap).max(1)).unwrap_or(1),
            }
        };
        let (normal, degraded) = (modes.section("normal"), modes.section("degraded"));
        let mode_rate_hz = |mode: &Field<'_>| mode.get("noncritical_max_rate_hz").decimal();
        let mode_stale_ms = |mode: &Field<'_>| mode.get("stale_threshold_ms").count();
        Self {
            enabled: section.get("noncritical_enabled").flag_or_default(),
            normal_rate_hz: mode_rate_hz(&normal).unwrap_or(rate_hz),
            degraded_rate_hz: mode_rate_hz(&degraded),
            normal_stale_ms: mode_stale_ms(&normal).unwrap_or(stale_ms),
            degraded_stale_ms: mode_stale_ms(&degraded),
            normal_queue: queue(&normal, NORMAL_DEPTH),
            degraded_queue: queue(&degraded, DEGRADED_DEPTH),
        }
    }

    /// The rates of one noncritical lane: its own, else the defaults of the mode.
    pub fn lane_rates(&self, lane: &Field<'_>) -> LaneRates {
        let rate_hz = |key: &str| lane.get(key).decimal();
        let bytes_per_s = |key: &str| lane.get(key).count();
        let stale_ms = |key: &str| lane.get(key).count();

        let normal_rate_hz = rate_hz("max_rate_hz").unwrap_or(self.normal_rate_hz);
        // A lane with a normal rate below 3 Hz does not become faster in DEGRADED.
        let degraded_rate_hz = rate_hz("degraded_rate_hz")
            .or(self.degraded_rate_hz)
            .unwrap_or_else(|| DEGRADED_RATE_HZ.min(normal_rate_hz));
        let normal_stale_ms = stale_ms("stale_threshold_ms").unwrap_or(self.normal_stale_ms);
        let degraded_stale_ms =
            stale_ms("degraded_stale_threshold_ms").or(self.degraded_stale_ms).unwrap_or(normal_stale_ms);
        let normal_bytes_per_s = bytes_per_s("max_bytes_per_s");
        let degraded_bytes_per_s = bytes_per_s("degraded_max_bytes_per_s").or(normal_bytes_per_s);

        let drop_policy = lane.get("drop_policy").choice();
        let queue_samples = lane.get("queue_samples").count::<usize>();
        let policy = |queue: &Queue, max_rate_hz, max_bytes_per_s, stale_threshold_ms| RatePolicy {
            max_rate_hz: if self.enabled { max_rate_hz } else { 0.0 },
            max_bytes_per_s,
            stale_threshold_ms,
            drop_policy: drop_policy.unwrap_or(queue.drop_policy),
            queue_samples: queue_samples.unwrap_or(queue.samples),
        };
        LaneRates {
            normal: policy(&self.normal_queue, normal_rate_hz, normal_bytes_per_s, normal_stale_ms),
            degraded: policy(&self.degraded_queue, degraded_rate_hz, degraded_bytes_per_s, degraded_stale_ms),
        }
    }
}

/// Checks a mode in which noncritical lanes forward nothing. Its values have no effect.
fn check_closed_mode(mode: &Field<'_>) {
    mode.entries();
    let rate = mode.get("noncritical_max_rate_hz");
    rate.whole_where("must be 0: noncritical lanes forward nothing in this mode", |rate| rate == 0);
    mode.get("noncritical_depth").count::<u64>();
    mode.get("noncritical_drop_policy").choice::<DropPolicy>();
    mode.get("stale_threshold_ms").count::<u64>();
    mode.get("max_noncritical_queue").count::<u64>();
}
