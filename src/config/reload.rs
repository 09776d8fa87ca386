//! Reload: which changes of a file a running bridge applies, and which wait for a restart of the whole
//! bridge.
//!
//! [`Settings::reloaded`] keeps what waits; a test compares that with the rows of the keys ([`super::keys`]).
//! Each structure of the settings is destructured here, so that code with a new field compiles only when this
//! module compares it.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::keys::joined;
use super::settings::{
    Classifier, DdsNetwork, Diagnostics, Forwarding, InputQos, Lane, LaneRates, Output, Probes, RatePolicy,
    Route, RoutePattern, Safety, Scheduling, Security, Settings, SharedMemory,
};
use super::shown::{Shown, Value};
use crate::model::{ClassifierThresholds, LaneName, QosProfile, RouteId, SafetyRules, fnv1a};

/// One setting that differs between the configuration in force and a file, with its values as in the file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Change {
    /// Its key path. Routes are named by their id, as in `topics[scan].max_sample_bytes`; settings of
    /// `routing_policy` are listed under the lanes that they change.
    pub key: String,
    /// The value in force; `none` if there is none.
    pub old: String,
    /// The value in the file; `none` if there is none.
    pub new: String,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} -> {}", self.key, self.old, self.new)
    }
}

/// The changes of a reload.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reload {
    /// Changes that are now in force.
    pub changed: Vec<Change>,
    /// Changes that wait for a restart of the whole bridge.
    pub waits: Vec<Change>,
}

impl Settings {
    /// A hash of the settings, without the content of a secret. It is comparable between processes of the
    /// same version of the program.
    pub fn fingerprint(&self) -> u64 {
        fnv1a(format!("{self:?}").as_bytes())
    }

    /// These settings with all changes in `new` that a running bridge can apply, and the list of the changes.
    pub fn reloaded(&self, new: Self) -> (Self, Reload) {
        let old = self.clone();
        let subscribers = new.subscribers.iter().filter_map(|(id, lane)| {
            // A subscriber stays on its lane if the new one exists only after a restart.
            let kept = if self.lane(lane).is_some() { Some(lane) } else { self.subscribers.get(id) };
            kept.map(|lane| (id.clone(), lane.clone()))
        });
        let reloaded = Self {
            instance: old.instance,
            input: old.input,
            node_namespace: old.node_namespace,
            node_name: old.node_name,
            graph_gid_bytes: old.graph_gid_bytes,
            routes: old.routes,
            patterns: old.patterns,
            lanes: self.lanes.iter().map(|lane| reload_lane(lane, &new)).collect(),
            shared_memory: old.shared_memory,
            ingress_scheduling: old.ingress_scheduling,
            ingress_standby: old.ingress_standby,
            control_scheduling: old.control_scheduling,
            probes: Probes {
                request_topic: old.probes.request_topic,
                response_topic: old.probes.response_topic,
                ..new.probes.clone()
            },
            diagnostics: Diagnostics {
                topic: old.diagnostics.topic,
                metrics: old.diagnostics.metrics,
                ..new.diagnostics.clone()
            },
            subscribers: subscribers.collect(),
            ..new.clone()
        };
        let reload = Reload { changed: differences(self, &reloaded), waits: differences(&reloaded, &new) };
        (reloaded, reload)
    }

    /// Every setting with its value, by the key path that a [`Change`] of it has.
    pub(super) fn values(&self) -> Vec<(String, Value)> {
        let mut every = Differences { all: true, found: Vec::new() };
        compare_settings(&mut every, self, self);
        every.found.into_iter().map(|(key, value, _)| (key, value)).collect()
    }
}

/// The lane with the rates in `new`, which are all that a running bridge can change of it.
fn reload_lane(lane: &Lane, new: &Settings) -> Lane {
    let mut reloaded = lane.clone();
    let Some(Lane { forwarding, .. }) = new.lane(&lane.name) else { return reloaded };
    reloaded.forwarding = forwarding.clone();
    // Samples that wait in the lane occupy shared memory, whose size is fixed at the start.
    if reloaded.max_borrowed_in_all() != lane.max_borrowed_in_all()
        && let (Forwarding::Limited(old), Forwarding::Limited(new)) =
            (&lane.forwarding, &mut reloaded.forwarding)
    {
        new.normal.queue_samples = old.normal.queue_samples;
        new.degraded.queue_samples = old.degraded.queue_samples;
    }
    reloaded
}

#[derive(Default)]
struct Differences {
    /// Whether `found` also gets the settings that are equal.
    all: bool,
    /// The key path, the old value and the new one.
    found: Vec<(String, Value, Value)>,
}

impl Differences {
    fn add<T: PartialEq + Shown>(&mut self, key: &str, old: &T, new: &T) {
        if self.all || old != new {
            self.found.push((key.to_owned(), old.value(), new.value()));
        }
    }
}

/// Compares fields of two structures. The literal after a field is the last part of its key, which without a
/// literal is the field's name. The fields behind the semicolon are compared elsewhere.
macro_rules! compare {
    ($d:ident, $of:expr, $old:expr, $new:expr, $type:ident {
        $($field:ident $(: $key:literal)?),+; $($other:ident),*
    }) => {{
        let $type { $($field,)+ $($other: _,)* } = &$old;
        $($d.add(&joined($of, [$($key,)? stringify!($field)][0]), $field, &$new.$field);)+
    }};
}

fn differences(old: &Settings, new: &Settings) -> Vec<Change> {
    let mut differences = Differences::default();
    compare_settings(&mut differences, old, new);
    let change =
        |(key, old, new): (String, Value, Value)| Change { key, old: old.to_string(), new: new.to_string() };
    differences.found.into_iter().map(change).collect()
}

fn compare_settings(d: &mut Differences, old: &Settings, new: &Settings) {
    routes(d, old, new);
    let names = |of: &Settings| -> Vec<_> { of.lanes.iter().map(|lane| lane.name.clone()).collect() };
    d.add("lanes", &names(old), &names(new));
    for lane in &old.lanes {
        if let Some(other) = new.lane(&lane.name) {
            compare_lane(d, lane, other);
        }
    }
    compare!(d, "", old, new, Settings {
        instance;
        input, node_namespace, node_name, graph_gid_bytes, routes, patterns, lanes, shared_memory,
        policy_hold_ms, ingress_scheduling, ingress_standby, control_scheduling, classifier, probes, safety,
        security, diagnostics, overrides, subscribers, set_parameters
    });
    compare_network(d, "ros", &old.input, &new.input);
    d.add("ros.namespace", &old.node_namespace, &new.node_namespace);
    d.add("ros.node_name", &old.node_name, &new.node_name);
    d.add("ros.graph_gid_bytes", &old.graph_gid_bytes, &new.graph_gid_bytes);
    compare!(d, "shared_memory", old.shared_memory, new.shared_memory, SharedMemory {
        root_path, max_taps, budget_bytes;
    });
    d.add("policy_hold_s", &seconds(old.policy_hold_ms), &seconds(new.policy_hold_ms));
    compare_scheduling(d, "processes.ingress", &old.ingress_scheduling, &new.ingress_scheduling);
    d.add("processes.ingress.standby", &old.ingress_standby, &new.ingress_standby);
    compare_scheduling(d, "processes.control", &old.control_scheduling, &new.control_scheduling);
    compare_control(d, old, new);
    compare_entries(d, "overrides", &old.overrides, &new.overrides);
    compare_entries(d, "subscribers", &old.subscribers, &new.subscribers);
}

/// A setting in milliseconds whose key is in seconds.
fn seconds(ms: u64) -> f64 {
    ms as f64 / 1_000.0
}

fn compare_network(d: &mut Differences, of: &str, old: &DdsNetwork, new: &DdsNetwork) {
    compare!(d, of, old, new, DdsNetwork { domain_id, interfaces: "networks", static_peers; });
}

fn compare_scheduling(d: &mut Differences, of: &str, old: &Scheduling, new: &Scheduling) {
    let of = &format!("{of}.scheduling");
    let slice_ms = |of: &Scheduling| of.slice_us.map(|us| f64::from(us) / 1_000.0);
    d.add(&format!("{of}.slice_ms"), &slice_ms(old), &slice_ms(new));
    compare!(d, of, old, new, Scheduling { policy, priority, nice, cpus, lock_memory; slice_us });
}

fn routes(d: &mut Differences, old: &Settings, new: &Settings) {
    // The places of a pattern are equal, so the first one stands for all.
    let entries = |of: &Settings| -> Vec<_> {
        let mut entries: Vec<_> = of.routes.iter().map(|route| route.entry.to_string()).collect();
        entries.dedup();
        entries
    };
    d.add("topics", &entries(old), &entries(new));
    for (index, route) in old.routes.iter().enumerate() {
        if index > 0 && old.routes[index - 1].entry == route.entry {
            continue;
        }
        let Some(other_index) = new.routes.iter().position(|other| other.entry == route.entry) else {
            continue;
        };
        let pattern_of = |of: &Settings| of.patterns.iter().find(|one| one.entry == route.entry).cloned();
        if let (Some(pattern), Some(other)) = (pattern_of(old), pattern_of(new)) {
            let RoutePattern { entry: _, input_topic: _, exclude, first_route: _, max_routes } = &pattern;
            d.add(&format!("topics[{}].exclude", route.entry), exclude, &other.exclude);
            d.add(&format!("topics[{}].max_routes", route.entry), max_routes, &other.max_routes);
        }
        compare_route(d, route, &new.routes[other_index]);
        for lane in &old.lanes {
            if let Some(other) = new.lane(&lane.name) {
                let [output, other] = [(lane, index), (other, other_index)]
                    .map(|(lane, route)| lane.outputs.iter().find(|output| output.route == route));
                compare_output(d, &route.entry, &lane.name, output, other);
            }
        }
    }
}

fn compare_route(d: &mut Differences, old: &Route, new: &Route) {
    let of = &format!("topics[{}]", old.entry);
    compare!(d, of, old, new, Route {
        input_topic, message_type, max_sample_bytes, priority, retained_samples; id, entry, input_qos,
        backlog_samples
    });
    let of = &format!("{of}.qos_overrides.input");
    compare!(d, of, old.input_qos, new.input_qos, InputQos {
        reliability, durability, history, deadline_ms;
    });
}

fn compare_output(
    d: &mut Differences,
    id: &RouteId,
    lane: &LaneName,
    old: Option<&Output>,
    new: Option<&Output>,
) {
    // The lanes that serve a route determine the size of its pool in shared memory.
    d.add(&format!("topics[{id}].lanes.{lane}"), &old.is_some(), &new.is_some());
    if let (Some(old), Some(new)) = (old, new) {
        let Output { route: _, topic, qos, latched_qos } = old;
        d.add(&format!("topics[{id}].outputs.{lane}"), topic, &new.topic);
        let of = &format!("topics[{id}].qos_overrides.{lane}");
        compare!(d, of, qos, new.qos, QosProfile {
            reliability, history, lifespan_ms, deadline_ms; durability
        });
        let given = |output: &Output| output.latched_qos.is_none().then_some(output.qos.durability);
        d.add(&format!("{of}.durability"), &given(old), &given(new));
        if let (Some(latched), Some(other)) = (latched_qos, new.latched_qos)
            && qos.history == new.qos.history
        {
            d.add(&format!("{of}.depth"), &latched.history, &other.history);
        }
    }
}

fn compare_lane(d: &mut Differences, old: &Lane, new: &Lane) {
    let of = &format!("lanes.{}", old.name);
    compare!(d, of, old, new, Lane {
        dscp, queue_depth, max_borrowed, by_reference_min_bytes, window_samples, standby;
        name, forwarding, network, outputs, scheduling
    });
    // A lane of the same name has the same class.
    if let (Forwarding::Limited(old), Forwarding::Limited(new)) = (&old.forwarding, &new.forwarding) {
        let LaneRates { normal, degraded } = old;
        compare!(d, of, normal, new.normal, RatePolicy {
            max_rate_hz, max_bytes_per_s, stale_threshold_ms, drop_policy, queue_samples;
        });
        compare!(d, of, degraded, new.degraded, RatePolicy {
            max_rate_hz: "degraded_rate_hz",
            max_bytes_per_s: "degraded_max_bytes_per_s",
            stale_threshold_ms: "degraded_stale_threshold_ms",
            drop_policy: "drop_policy in DEGRADED",
            queue_samples: "queue_samples in DEGRADED";
        });
    }
    compare_network(d, of, &old.network, &new.network);
    compare_scheduling(d, of, &old.scheduling, &new.scheduling);
}

fn compare_control(d: &mut Differences, old: &Settings, new: &Settings) {
    let (of, old_thresholds) = ("classifier", &old.classifier.thresholds);
    compare!(d, of, old_thresholds, new.classifier.thresholds, ClassifierThresholds {
        demote_loss: "demote_loss_threshold", promote_loss: "promote_loss_threshold",
        demote_rtt_ms, promote_rtt_ms, hysteresis_count, allow_unknown_state;
    });
    compare!(d, of, old.classifier, new.classifier, Classifier {
        enabled, subscriber_id, evaluate_rate_hz; thresholds
    });
    compare!(d, "probes", old.probes, new.probes, Probes {
        enabled, rate_hz, rtt_threshold_ms, loss_threshold, jitter_threshold_ms, window_size,
        hysteresis_count, timeout_ms, request_topic, response_topic;
    });
    compare!(d, "safety", old.safety.rules, new.safety.rules, SafetyRules {
        preserve_critical_path, allow_noncritical_degrade, max_noncritical_queue,
        overload_drop_noncritical_first, degraded_lag_ms, emergency_lag_ms, degraded_queue_occupancy,
        emergency_queue_occupancy, degraded_errors_per_s, emergency_errors_per_s, silent_ms,
        emergency_silent_ms, hysteresis_count, recovery_count;
    });
    compare!(d, "safety", old.safety, new.safety, Safety { evaluate_rate_hz; rules });
    compare!(d, "security", old.security, new.security, Security {
        trust_mode, enable_probe_hmac, secret: "hmac_secret", replay_window_ms, max_probe_rate_hz,
        allow_legacy_node_name_overrides;
    });
    let interval_s = |of: &Settings| seconds(of.diagnostics.publish_interval_ms);
    d.add("diagnostics.publish_interval_s", &interval_s(old), &interval_s(new));
    compare!(d, "diagnostics", old.diagnostics, new.diagnostics, Diagnostics {
        enabled, topic, verbosity, metrics; publish_interval_ms
    });
}

fn compare_entries<T: Clone + PartialEq + Shown>(
    d: &mut Differences,
    of: &str,
    old: &BTreeMap<String, T>,
    new: &BTreeMap<String, T>,
) {
    for id in old.keys().chain(new.keys().filter(|id| !old.contains_key(*id))) {
        d.add(&format!("{of}.{id}"), &old.get(id).cloned(), &new.get(id).cloned());
    }
}
