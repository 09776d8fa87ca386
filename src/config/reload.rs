//! Reload: which changes of a file a running bridge applies, and which wait for a restart of the whole
//! bridge.
//!
//! The row of a key ([`super::keys`]) decides which of the two applies to it. Each structure of the settings
//! is built or destructured here field by field, so that code with a new field compiles only when this module
//! compares it.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::keys::Key;
use super::settings::{
    Classifier, DdsNetwork, Diagnostics, Forwarding, InputQos, Lane, LaneRates, Output, Probes, RatePolicy,
    Route, Safety, Scheduling, Security, Settings, SharedMemory,
};
use super::shown::Shown;
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
        let mut differ = Differ::default();
        let d = &mut differ;
        routes(d, self, &new);
        let lanes = lanes(d, &self.lanes, &new.lanes);
        let settings = Self {
            instance: d.apply("instance", &self.instance, &new.instance),
            input: network(d, "ros", &self.input, &new.input),
            graph_gid_bytes: d.apply("ros.graph_gid_bytes", &self.graph_gid_bytes, &new.graph_gid_bytes),
            routes: self.routes.clone(),
            shared_memory: shared_memory(d, &self.shared_memory, &new.shared_memory),
            policy_hold_ms: in_seconds(d, "policy_hold_s", self.policy_hold_ms, new.policy_hold_ms),
            ingress_scheduling: scheduling(
                d,
                "processes.ingress",
                &self.ingress_scheduling,
                &new.ingress_scheduling,
            ),
            control_scheduling: scheduling(
                d,
                "processes.control",
                &self.control_scheduling,
                &new.control_scheduling,
            ),
            classifier: classifier(d, &self.classifier, &new.classifier),
            probes: probes(d, &self.probes, &new.probes),
            safety: safety(d, &self.safety, &new.safety),
            security: security(d, &self.security, &new.security),
            diagnostics: diagnostics(d, &self.diagnostics, &new.diagnostics),
            overrides: overrides(d, &self.overrides, new.overrides),
            subscribers: subscribers(d, &lanes, &self.subscribers, new.subscribers),
            lanes,
        };
        (settings, differ.0)
    }
}

/// Collects the changes.
#[derive(Default)]
struct Differ(Reload);

impl Differ {
    /// Applies the new value of a setting if the row of its key says so, else keeps the old one.
    fn apply<T: Clone + PartialEq + Shown>(&mut self, key: &str, old: &T, new: &T) -> T {
        let path = key.trim_end_matches(" in DEGRADED");
        match Key::row_of(path).is_some_and(|row| row.reloads) {
            true => self.take(key, old, new.clone()),
            false => self.keep(key, old, new),
        }
    }

    /// Applies the new value of a setting.
    fn take<T: PartialEq + Shown>(&mut self, key: &str, old: &T, new: T) -> T {
        if *old != new {
            self.0.changed.push(Change { key: key.to_owned(), old: old.shown(), new: new.shown() });
        }
        new
    }

    /// Keeps the old value of a setting until the whole bridge is restarted.
    fn keep<T: Clone + PartialEq + Shown>(&mut self, key: &str, old: &T, new: &T) -> T {
        if old != new {
            self.0.waits.push(Change { key: key.to_owned(), old: old.shown(), new: new.shown() });
        }
        old.clone()
    }
}

/// Reloads a setting in milliseconds whose key is in seconds.
fn in_seconds(d: &mut Differ, key: &str, old_ms: u64, new_ms: u64) -> u64 {
    let [old, new] = [old_ms, new_ms].map(|ms| ms as f64 / 1_000.0);
    if d.apply(key, &old, &new) == new { new_ms } else { old_ms }
}

/// Compares the fields of a structure; each has the last part of its key, which is its name if there is none.
macro_rules! apply_each {
    ($d:ident, $of:expr, $old:expr, $new:expr, $type:ident {
        $($field:ident $(: $key:literal)?),+ $(,)?; $($own:ident: $value:expr),* $(,)?
    }) => {
        $type {
            $($field: {
                let name = [$($key,)? stringify!($field)][0];
                $d.apply(&format!("{}.{name}", $of), &$old.$field, &$new.$field)
            },)+
            $($own: $value,)*
        }
    };
}

fn network(d: &mut Differ, of: &str, old: &DdsNetwork, new: &DdsNetwork) -> DdsNetwork {
    apply_each!(d, of, old, new, DdsNetwork { domain_id, interfaces: "networks"; })
}

fn shared_memory(d: &mut Differ, old: &SharedMemory, new: &SharedMemory) -> SharedMemory {
    apply_each!(d, "shared_memory", old, new, SharedMemory { root_path, max_taps; })
}

fn scheduling(d: &mut Differ, of: &str, old: &Scheduling, new: &Scheduling) -> Scheduling {
    let of = format!("{of}.scheduling");
    let slice_ms = |of: &Scheduling| of.slice_us.map(|us| f64::from(us) / 1_000.0);
    let applied = d.apply(&format!("{of}.slice_ms"), &slice_ms(old), &slice_ms(new));
    let slice = if applied == slice_ms(new) { new.slice_us } else { old.slice_us };
    apply_each!(d, of, old, new, Scheduling { policy, priority, nice, cpus, lock_memory; slice_us: slice })
}

/// Compares the routes, which stay as they are.
fn routes(d: &mut Differ, old: &Settings, new: &Settings) {
    let ids = |settings: &Settings| -> Vec<String> {
        settings.routes.iter().map(|route| route.id.to_string()).collect()
    };
    d.keep("topics", &ids(old), &ids(new));
    for (index, route) in old.routes.iter().enumerate() {
        let same_id = |other: &&Route| other.id == route.id;
        if let Some(other) = new.routes.iter().find(same_id) {
            compare_route(d, route, other);
            for lane in &old.lanes {
                if let Some(other_lane) = new.lane(&lane.name) {
                    let output = lane.outputs.iter().find(|output| output.route == index);
                    let other = output_of(new, other_lane, &route.id);
                    compare_output(d, &route.id, &lane.name, output, other);
                }
            }
        }
    }
}

fn output_of<'a>(settings: &Settings, lane: &'a Lane, id: &RouteId) -> Option<&'a Output> {
    lane.outputs.iter().find(|output| settings.routes.get(output.route).is_some_and(|route| route.id == *id))
}

fn compare_route(d: &mut Differ, old: &Route, new: &Route) {
    let Route { id, input_topic, message_type, input_qos, max_sample_bytes, retained_samples } = old;
    let key = |name: &str| format!("topics[{id}].{name}");
    d.keep(&key("input_topic"), input_topic, &new.input_topic);
    d.keep(&key("message_type"), message_type, &new.message_type);
    d.keep(&key("max_sample_bytes"), max_sample_bytes, &new.max_sample_bytes);
    d.keep(&key("retained_samples"), retained_samples, &new.retained_samples);
    let InputQos { reliability, durability, history, deadline_ms } = input_qos;
    let key = |name: &str| format!("topics[{id}].qos_overrides.input.{name}");
    d.keep(&key("reliability"), reliability, &new.input_qos.reliability);
    d.keep(&key("durability"), durability, &new.input_qos.durability);
    d.keep(&key("history"), history, &new.input_qos.history);
    d.keep(&key("deadline_ms"), deadline_ms, &new.input_qos.deadline_ms);
}

fn compare_output(d: &mut Differ, id: &RouteId, lane: &LaneName, old: Option<&Output>, new: Option<&Output>) {
    let (Some(old), Some(new)) = (old, new) else {
        // The lanes that serve a route determine the size of its pool in shared memory.
        let key = format!("topics[{id}].lanes.{lane}");
        d.keep(&key, &old.is_some(), &new.is_some());
        return;
    };
    let Output { route: _, topic, qos } = old;
    d.keep(&format!("topics[{id}].outputs.{lane}"), topic, &new.topic);
    let QosProfile { reliability, history, durability, lifespan_ms, deadline_ms } = qos;
    let key = |name: &str| format!("topics[{id}].qos_overrides.{lane}.{name}");
    d.keep(&key("reliability"), reliability, &new.qos.reliability);
    d.keep(&key("history"), history, &new.qos.history);
    d.keep(&key("durability"), durability, &new.qos.durability);
    d.keep(&key("lifespan_ms"), lifespan_ms, &new.qos.lifespan_ms);
    d.keep(&key("deadline_ms"), deadline_ms, &new.qos.deadline_ms);
}

fn lanes(d: &mut Differ, old: &[Lane], new: &[Lane]) -> Vec<Lane> {
    let names = |lanes: &[Lane]| -> Vec<LaneName> { lanes.iter().map(|lane| lane.name.clone()).collect() };
    d.keep("lanes", &names(old), &names(new));
    let reloaded = old.iter().map(|lane| match new.iter().find(|other| other.name == lane.name) {
        Some(other) => reload_lane(d, lane, other),
        None => lane.clone(),
    });
    reloaded.collect()
}

fn reload_lane(d: &mut Differ, old: &Lane, new: &Lane) -> Lane {
    let of = format!("lanes.{}", old.name);
    apply_each!(
        d,
        of,
        old,
        new,
        Lane {
            queue_depth, max_borrowed, by_reference_min_bytes, window_samples;
            name: old.name.clone(),
            forwarding: forwarding(d, old, new),
            network: network(d, &of, &old.network, &new.network),
            outputs: old.outputs.clone(),
            scheduling: scheduling(d, &of, &old.scheduling, &new.scheduling),
        }
    )
}

fn forwarding(d: &mut Differ, old: &Lane, new: &Lane) -> Forwarding {
    // A lane of the same name has the same class.
    let (Forwarding::Limited(old_rates), Forwarding::Limited(new_rates)) = (&old.forwarding, &new.forwarding)
    else {
        return old.forwarding.clone();
    };
    // Samples that wait in the lane occupy shared memory, whose size is fixed at the start.
    let would_borrow = Lane { forwarding: new.forwarding.clone(), ..old.clone() }.max_borrowed_in_all();
    let has_room = would_borrow == old.max_borrowed_in_all();
    let LaneRates { normal, degraded } = old_rates;
    Forwarding::Limited(LaneRates {
        normal: rate_policy(d, &old.name, ["", ""], has_room, normal, new_rates.normal),
        degraded: rate_policy(
            d,
            &old.name,
            ["degraded_", " in DEGRADED"],
            has_room,
            degraded,
            new_rates.degraded,
        ),
    })
}

/// Reloads the rates of one mode. `mode` has the prefix of keys that exist for each mode, and the suffix that
/// distinguishes keys which apply to both.
fn rate_policy(
    d: &mut Differ,
    lane: &LaneName,
    mode: [&str; 2],
    has_room: bool,
    old: &RatePolicy,
    new: RatePolicy,
) -> RatePolicy {
    let [prefix, suffix] = mode;
    let key = |name: &str| format!("lanes.{lane}.{prefix}{name}");
    let common_key = |name: &str| format!("lanes.{lane}.{name}{suffix}");
    let rate_key = if prefix.is_empty() { key("max_rate_hz") } else { key("rate_hz") };
    RatePolicy {
        max_rate_hz: d.apply(&rate_key, &old.max_rate_hz, &new.max_rate_hz),
        max_bytes_per_s: d.apply(&key("max_bytes_per_s"), &old.max_bytes_per_s, &new.max_bytes_per_s),
        stale_threshold_ms: d.apply(
            &key("stale_threshold_ms"),
            &old.stale_threshold_ms,
            &new.stale_threshold_ms,
        ),
        drop_policy: d.apply(&common_key("drop_policy"), &old.drop_policy, &new.drop_policy),
        queue_samples: if has_room {
            d.apply(&common_key("queue_samples"), &old.queue_samples, &new.queue_samples)
        } else {
            d.keep(&common_key("queue_samples"), &old.queue_samples, &new.queue_samples)
        },
    }
}

fn classifier(d: &mut Differ, old: &Classifier, new: &Classifier) -> Classifier {
    let reloaded = apply_each!(
        d,
        "classifier",
        old.thresholds,
        new.thresholds,
        ClassifierThresholds {
            demote_loss: "demote_loss_threshold",
            promote_loss: "promote_loss_threshold",
            demote_rtt_ms,
            promote_rtt_ms,
            hysteresis_count,
            allow_unknown_state;
        }
    );
    apply_each!(
        d,
        "classifier",
        old,
        new,
        Classifier { enabled, subscriber_id, evaluate_rate_hz; thresholds: reloaded }
    )
}

fn probes(d: &mut Differ, old: &Probes, new: &Probes) -> Probes {
    apply_each!(
        d,
        "probes",
        old,
        new,
        Probes {
            enabled,
            rate_hz,
            rtt_threshold_ms,
            loss_threshold,
            jitter_threshold_ms,
            window_size,
            hysteresis_count,
            timeout_ms,
            request_topic,
            response_topic;
        }
    )
}

fn safety(d: &mut Differ, old: &Safety, new: &Safety) -> Safety {
    let reloaded = apply_each!(
        d,
        "safety",
        old.rules,
        new.rules,
        SafetyRules {
            preserve_critical_path,
            allow_noncritical_degrade,
            max_noncritical_queue,
            overload_drop_noncritical_first,
            degraded_lag_ms,
            emergency_lag_ms,
            degraded_queue_occupancy,
            emergency_queue_occupancy,
            degraded_errors_per_s,
            emergency_errors_per_s,
            silent_ms,
            emergency_silent_ms,
            hysteresis_count,
            recovery_count;
        }
    );
    apply_each!(d, "safety", old, new, Safety { evaluate_rate_hz; rules: reloaded })
}

fn security(d: &mut Differ, old: &Security, new: &Security) -> Security {
    apply_each!(
        d,
        "security",
        old,
        new,
        Security {
            trust_mode,
            enable_probe_hmac,
            secret: "hmac_secret",
            replay_window_ms,
            max_probe_rate_hz,
            allow_legacy_node_name_overrides;
        }
    )
}

fn diagnostics(d: &mut Differ, old: &Diagnostics, new: &Diagnostics) -> Diagnostics {
    let interval = [old.publish_interval_ms, new.publish_interval_ms];
    let interval_ms = in_seconds(d, "diagnostics.publish_interval_s", interval[0], interval[1]);
    apply_each!(
        d,
        "diagnostics",
        old,
        new,
        Diagnostics { enabled, topic, verbosity, metrics; publish_interval_ms: interval_ms }
    )
}

type BySubscriber<T> = BTreeMap<String, T>;

fn overrides<T: Clone + PartialEq + Shown>(
    d: &mut Differ,
    old: &BySubscriber<T>,
    new: BySubscriber<T>,
) -> BySubscriber<T> {
    compare_entries(d, "overrides", old, &new);
    new
}

/// Reloads the lanes of the subscribers. A subscriber stays on its lane if the new one exists only after a
/// restart.
fn subscribers(
    d: &mut Differ,
    lanes: &[Lane],
    old: &BySubscriber<LaneName>,
    new: BySubscriber<LaneName>,
) -> BySubscriber<LaneName> {
    let mut reloaded = BTreeMap::new();
    for (id, lane) in new {
        if lanes.iter().any(|existing| existing.name == lane) {
            reloaded.insert(id, lane);
        } else {
            let old_lane = old.get(&id).cloned();
            let kept = d.keep(&format!("subscribers.{id}"), &old_lane, &Some(lane));
            reloaded.extend(kept.map(|lane| (id, lane)));
        }
    }
    compare_entries(d, "subscribers", old, &reloaded);
    reloaded
}

fn compare_entries<T: Clone + PartialEq + Shown>(
    d: &mut Differ,
    of: &str,
    old: &BySubscriber<T>,
    new: &BySubscriber<T>,
) {
    for id in old.keys().chain(new.keys().filter(|id| !old.contains_key(*id))) {
        d.take(&format!("{of}.{id}"), &old.get(id).cloned(), new.get(id).cloned());
    }
}
