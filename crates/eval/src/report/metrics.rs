//! The figures that the CSV files contain, in the order of their columns.

use super::measures::Measures;
use super::paper;

/// A figure of a run.
pub struct Metric {
    /// The name of its column, with the unit.
    pub key: &'static str,
    pub of: fn(&Measures) -> Option<f64>,
}

const fn metric(key: &'static str, of: fn(&Measures) -> Option<f64>) -> Metric {
    Metric { key, of }
}

/// All figures. Keys may be added; a renamed key needs an entry in the changelog.
pub const METRICS: [Metric; 36] = [
    metric("critical_p50_ms", |one| one.critical_ms.quantile(0.50)),
    metric("critical_p95_ms", |one| one.critical_ms.quantile(0.95)),
    metric("critical_p99_ms", |one| one.critical_ms.quantile(0.99)),
    metric("critical_max_ms", |one| one.critical_ms.max()),
    metric("critical_samples", |one| Some(one.critical.samples as f64)),
    metric("critical_lost", |one| Some(one.critical.lost as f64)),
    metric("critical_late", |one| Some(one.critical.late as f64)),
    metric("critical_repeated", |one| Some(one.critical.repeated as f64)),
    metric("critical_reordered", |one| Some(one.critical.reordered as f64)),
    metric("critical_gap_ms", |one| one.critical_gap_ms),
    metric("publisher_rate_hz", |one| one.rate_hz),
    metric("publisher_rate_std_hz", |one| one.rate_std_hz),
    metric("publish_attempts", |one| Some(one.attempts as f64)),
    metric("publish_failed", |one| Some(one.failed as f64)),
    metric("publish_blocked", |one| Some(one.blocked as f64)),
    metric("publish_call_p99_ms", |one| one.call_ms.quantile(0.99)),
    metric("publish_call_max_ms", |one| one.call_ms.max()),
    metric("history_outstanding_max", |one| one.outstanding_max.map(|held| held as f64)),
    metric("noncritical_p50_ms", |one| one.noncritical_ms.quantile(0.50)),
    metric("noncritical_p95_ms", |one| one.noncritical_ms.quantile(0.95)),
    metric("noncritical_rate_hz", |one| one.noncritical_hz),
    metric("noncritical_lane_impaired_bytes_per_s", |one| one.lane_impaired_bytes_per_s),
    metric("noncritical_wire_bytes_per_s", |one| one.wire_bytes_per_s),
    metric("noncritical_wire_impaired_bytes_per_s", |one| one.wire_impaired_bytes_per_s),
    metric("noncritical_fragments", |one| one.fragments_to_remote.map(|count| count as f64)),
    metric("noncritical_heartbeats", |one| one.heartbeats.map(|count| count as f64)),
    metric("noncritical_acknacks", |one| one.acknacks.map(|count| count as f64)),
    metric("switch_fragment_memory_max_bytes", |one| one.fragment_memory_max_bytes.map(|bytes| bytes as f64)),
    metric("switch_reassembly_failed", |one| one.reassembly_failed.map(|count| count as f64)),
    metric("udp_buffer_errors", |one| one.udp_buffer_errors.map(|count| count as f64)),
    metric("classifier_transitions", |one| one.transitions.map(|count| count as f64)),
    metric("demote_max_s", |one| one.slowest_reaction_s(true)),
    metric("promote_max_s", |one| one.slowest_reaction_s(false)),
    metric("degraded_share", |one| one.degraded_share),
    metric("bridge_cpu_percent", |one| one.bridge_usage().map(|usage| usage.cpu_percent)),
    metric("bridge_rss_bytes", |one| one.bridge_usage().map(|usage| usage.rss_max_bytes as f64)),
];

/// The paper's value of a figure; `None` if the paper does not have it.
pub fn paper_value(scenario: &str, library: &str, key: &str) -> Option<f64> {
    let cross = paper::TABLE_IV.iter().find(|row| row.scenario == scenario);
    match (library, key) {
        ("fast", "critical_p99_ms") => cross.map(|row| row.fast_p99_ms),
        ("cyclone", "critical_p99_ms") => cross.map(|row| row.cyclone_p99_ms),
        ("cyclone", "publisher_rate_hz") => cross.map(|row| row.rate_hz),
        ("fast", _) => {
            let row = paper::row(scenario)?;
            match key {
                "critical_p50_ms" => Some(row.p50_ms),
                "critical_p95_ms" => Some(row.p95_ms),
                "publisher_rate_hz" => Some(row.rate_hz),
                "publisher_rate_std_hz" => Some(row.rate_std_hz),
                "classifier_transitions" => row.transitions.map(|count| count as f64),
                _ => None,
            }
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_values_are_found_by_table_and_library() {
        assert_eq!(paper_value("baseline_strong", "fast", "critical_p95_ms"), Some(15_043.0));
        assert_eq!(paper_value("bridge_toggle", "fast", "classifier_transitions"), Some(9.0));
        assert_eq!(paper_value("bridge_mild", "cyclone", "critical_p99_ms"), Some(1.9));
        // The paper has no Table II for Cyclone DDS, and no figures for RustDDS.
        assert_eq!(paper_value("baseline_strong", "cyclone", "critical_p95_ms"), None);
        assert_eq!(paper_value("bridge_mild", "rust", "critical_p99_ms"), None);
    }

    #[test]
    fn keys_are_unique() {
        let mut keys: Vec<&str> = METRICS.iter().map(|metric| metric.key).collect();
        keys.sort_unstable();
        keys.dedup();
        assert_eq!(keys.len(), METRICS.len());
    }
}
