//! The list of all configuration keys, used to find unknown keys, to suggest similar ones and to test the
//! documentation.

use std::collections::HashMap;

use super::problem::{Place, Problem, Problems, did_you_mean, shown};
use super::yaml::{Content, Entry, Node};

/// The path of every key. `[]` is an item of a list; a name in angle brackets is a name that the user
/// chooses.
pub const KEYS: &[&str] = &[
    "instance",
    "ros.domain_id",
    "ros.networks",
    "ros.graph_gid_bytes",
    "topics[].id",
    "topics[].input_topic",
    "topics[].message_type",
    "topics[].lanes",
    "topics[].critical_output",
    "topics[].noncritical_output",
    "topics[].outputs.<lane>",
    "topics[].max_sample_bytes",
    "topics[].retained_samples",
    "topics[].qos_overrides.input.reliability",
    "topics[].qos_overrides.input.history",
    "topics[].qos_overrides.input.depth",
    "topics[].qos_overrides.input.durability",
    "topics[].qos_overrides.input.deadline_ms",
    "topics[].qos_overrides.<lane>.reliability",
    "topics[].qos_overrides.<lane>.history",
    "topics[].qos_overrides.<lane>.depth",
    "topics[].qos_overrides.<lane>.durability",
    "topics[].qos_overrides.<lane>.lifespan_ms",
    "topics[].qos_overrides.<lane>.deadline_ms",
    "qos_profiles.<profile>.reliability",
    "qos_profiles.<profile>.history",
    "qos_profiles.<profile>.depth",
    "qos_profiles.<profile>.durability",
    "qos_profiles.<profile>.lifespan_ms",
    "qos_profiles.<profile>.deadline_ms",
    "topic_qos_profiles.<topic>.<lane>",
    "lanes.<lane>.domain_id",
    "lanes.<lane>.networks",
    "lanes.<lane>.qos",
    "lanes.<lane>.qos.reliability",
    "lanes.<lane>.qos.history",
    "lanes.<lane>.qos.depth",
    "lanes.<lane>.qos.durability",
    "lanes.<lane>.qos.lifespan_ms",
    "lanes.<lane>.qos.deadline_ms",
    "lanes.<lane>.queue_depth",
    "lanes.<lane>.max_borrowed",
    "lanes.<lane>.by_reference_min_bytes",
    "lanes.<lane>.window_samples",
    "lanes.<lane>.max_rate_hz",
    "lanes.<lane>.degraded_rate_hz",
    "lanes.<lane>.max_bytes_per_s",
    "lanes.<lane>.degraded_max_bytes_per_s",
    "lanes.<lane>.stale_threshold_ms",
    "lanes.<lane>.degraded_stale_threshold_ms",
    "lanes.<lane>.drop_policy",
    "lanes.<lane>.queue_samples",
    "lanes.<lane>.scheduling.policy",
    "lanes.<lane>.scheduling.priority",
    "lanes.<lane>.scheduling.nice",
    "lanes.<lane>.scheduling.slice_ms",
    "lanes.<lane>.scheduling.cpus",
    "lanes.<lane>.scheduling.lock_memory",
    "processes.ingress.scheduling.policy",
    "processes.ingress.scheduling.priority",
    "processes.ingress.scheduling.nice",
    "processes.ingress.scheduling.slice_ms",
    "processes.ingress.scheduling.cpus",
    "processes.ingress.scheduling.lock_memory",
    "processes.control.scheduling.policy",
    "processes.control.scheduling.priority",
    "processes.control.scheduling.nice",
    "processes.control.scheduling.slice_ms",
    "processes.control.scheduling.cpus",
    "processes.control.scheduling.lock_memory",
    "shared_memory.root_path",
    "shared_memory.max_sample_bytes",
    "shared_memory.max_taps",
    "policy_hold_s",
    "subscribers.<subscriber>",
    "subscribers.<subscriber>.lane",
    "overrides.<subscriber>",
    "classifier.enabled",
    "classifier.subscriber_id",
    "classifier.evaluate_rate_hz",
    "classifier.demote_loss_threshold",
    "classifier.promote_loss_threshold",
    "classifier.demote_rtt_ms",
    "classifier.promote_rtt_ms",
    "classifier.hysteresis_count",
    "classifier.allow_unknown_state",
    "probes.enabled",
    "probes.rate_hz",
    "probes.rtt_threshold_ms",
    "probes.loss_threshold",
    "probes.jitter_threshold_ms",
    "probes.window_size",
    "probes.hysteresis_count",
    "probes.timeout_ms",
    "probes.request_topic",
    "probes.response_topic",
    "routing_policy.critical_always_forward",
    "routing_policy.noncritical_enabled",
    "routing_policy.noncritical_max_rate_hz",
    "routing_policy.noncritical_drop_policy",
    "routing_policy.stale_threshold_ms",
    "routing_policy.modes.<mode>.noncritical_max_rate_hz",
    "routing_policy.modes.<mode>.noncritical_depth",
    "routing_policy.modes.<mode>.noncritical_drop_policy",
    "routing_policy.modes.<mode>.stale_threshold_ms",
    "routing_policy.modes.<mode>.max_noncritical_queue",
    "safety.preserve_critical_path",
    "safety.allow_noncritical_degrade",
    "safety.max_noncritical_queue",
    "safety.overload_drop_noncritical_first",
    "safety.evaluate_rate_hz",
    "safety.degraded_lag_ms",
    "safety.emergency_lag_ms",
    "safety.degraded_queue_occupancy",
    "safety.emergency_queue_occupancy",
    "safety.degraded_errors_per_s",
    "safety.emergency_errors_per_s",
    "safety.silent_ms",
    "safety.emergency_silent_ms",
    "safety.hysteresis_count",
    "safety.recovery_count",
    "security.trust_mode",
    "security.allow_legacy_node_name_overrides",
    "security.enable_probe_hmac",
    "security.max_probe_rate_hz",
    "security.hmac_secret",
    "security.hmac_secret_file",
    "security.hmac_secret_env",
    "security.replay_window_ms",
    "diagnostics.enabled",
    "diagnostics.publish_interval_s",
    "diagnostics.topic",
    "diagnostics.verbosity",
    "diagnostics.metrics",
];

/// Reports every unknown key and every repeated key of the file.
pub(super) fn check(root: &Node, problems: &Problems) {
    walk(root, Some(""), "", problems);
}

/// Checks a value and all below it. `pattern` is its path as in [`KEYS`]; `None` below an unknown key.
fn walk(node: &Node, pattern: Option<&str>, path: &str, problems: &Problems) {
    match &node.content {
        Content::Scalar { .. } => {}
        Content::List(items) => {
            let pattern = pattern.map(|pattern| format!("{pattern}[]"));
            for (index, item) in items.iter().enumerate() {
                walk(item, pattern.as_deref(), &format!("{path}[{index}]"), problems);
            }
        }
        Content::Map(entries) => {
            let known = pattern.map(names_below).unwrap_or_default();
            let mut first_lines: HashMap<&str, usize> = HashMap::new();
            for entry in entries {
                let path = joined(path, &shown_key(path, &entry.key));
                if let Some(first_line) = first_lines.get(entry.key.as_str()) {
                    problems.report(Problem {
                        place: Place::Line(entry.line),
                        key: path.clone(),
                        value: None,
                        allowed: format!("must be given only once; line {first_line} already has it"),
                        hint: None,
                    });
                }
                first_lines.entry(&entry.key).or_insert(entry.line);
                let name = match known.iter().find(|&&name| name == entry.key) {
                    Some(name) => Some(*name),
                    None => known.iter().find(|name| name.starts_with('<')).copied(),
                };
                // A mapping at a key that has no keys below it is a value of the wrong type, which its reader
                // reports.
                if name.is_none() && !known.is_empty() {
                    problems.report(unknown(entry, &path, &known, problems));
                }
                let below = name.map(|name| joined(pattern.unwrap_or_default(), name));
                walk(&entry.value, below.as_deref(), &path, problems);
            }
        }
    }
}

fn unknown(entry: &Entry, path: &str, known: &[&str], problems: &Problems) -> Problem {
    // Without a similar key here, a key that exists elsewhere is probably misplaced.
    let hint = problems.hint(&entry.key, known).or_else(|| {
        let elsewhere = KEYS.iter().find(|key| key.rsplit('.').next() == Some(&entry.key));
        elsewhere.map(|key| did_you_mean(key))
    });
    let allowed = match hint {
        Some(_) => "must be a known key".to_owned(),
        None => format!("must be a known key: {}", known.join(", ")),
    };
    Problem { place: Place::Line(entry.line), key: path.to_owned(), value: None, allowed, hint }
}

/// The names allowed directly below a path of [`KEYS`], in the order of that list.
fn names_below(pattern: &str) -> Vec<&'static str> {
    let mut names: Vec<&'static str> = Vec::new();
    for key in KEYS {
        let rest = match pattern {
            "" => Some(*key),
            _ => key.strip_prefix(pattern).and_then(|rest| rest.strip_prefix('.')),
        };
        let Some(rest) = rest else { continue };
        let name = &rest[..rest.find(['.', '[']).unwrap_or(rest.len())];
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// A key for a message. `{hmac_secret:abc}`, without a space, is a key that contains the secret, so that a
/// key below `security` is cut at the first separator.
fn shown_key(path: &str, key: &str) -> String {
    let end = if path == "security" { key.find([':', '=', ' ']) } else { None };
    shown(&key[..end.unwrap_or(key.len())])
}

/// The path of `name` below `path`.
pub(super) fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}
