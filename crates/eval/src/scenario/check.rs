//! Checks the values of a scenario whose file has been parsed.

use std::collections::BTreeSet;

use super::{Action, Scenario, Variant};
use crate::impairment::Level;

/// Names of hosts, endpoints and processes that remote subscribers must not have.
const RESERVED: [&str; 6] = ["publisher", "bridge", "critical", "switch", "up", "control"];

/// Lists each invalid value with its key.
pub(super) fn problems(scenario: &Scenario) -> Vec<String> {
    let mut found = Vec::new();
    let mut range = |key: &str, value: f64, min: f64, max: f64| {
        if !(min..=max).contains(&value) {
            found.push(format!("{key} is {value}, but must be {min} to {max}"));
        }
    };
    range("duration_s", scenario.duration_s, 1.0, 86_400.0);
    range("quick_s", scenario.quick_s, 1.0, 600.0);
    let workload = &scenario.workload;
    range("workload.routes", workload.routes as f64, 1.0, 64.0);
    range("workload.rate_hz", workload.rate_hz, 0.1, 10_000.0);
    // The first 24 bytes of a payload carry its sequence number and timestamps.
    range("workload.size_bytes", workload.size_bytes as f64, 24.0, 16_777_216.0);
    range("remotes", scenario.remotes.len() as f64, 1.0, 16.0);
    for (at, remote) in scenario.remotes.iter().enumerate() {
        for (key, value) in [
            ("delay_ms", remote.delay_ms),
            ("jitter_ms", remote.jitter_ms),
            ("return_delay_ms", remote.return_delay_ms),
            ("return_jitter_ms", remote.return_jitter_ms),
        ] {
            range(&format!("remotes[{at}].{key}"), value, 0.0, 60_000.0);
        }
        if let Some(cap) = remote.cap_kbit_per_s {
            range(&format!("remotes[{at}].cap_kbit_per_s"), cap as f64, 8.0, 1e7);
        }
    }
    for (at, event) in scenario.events.iter().enumerate() {
        range(&format!("events[{at}].at_s"), event.at_s, 0.0, scenario.duration_s);
    }
    for (at, remote) in scenario.remotes.iter().enumerate() {
        let both = (remote.level != Level::Clean || remote.delay_ms > 0.0 || remote.jitter_ms > 0.0)
            && remote.trace.is_some();
        if both {
            found.push(format!("remotes[{at}].trace excludes level, delay_ms and jitter_ms"));
        }
        let both =
            (remote.return_delay_ms > 0.0 || remote.return_jitter_ms > 0.0) && remote.return_trace.is_some();
        if both {
            found.push(format!("remotes[{at}].return_trace excludes return_delay_ms and return_jitter_ms"));
        }
    }
    if scenario.switches.is_empty() {
        found.push("switches is empty, but must be plain, reassembling, or both".to_owned());
    }
    found.extend(workload_type(scenario));
    found.extend(names(scenario));
    found.extend(events(scenario));
    found
}

fn workload_type(scenario: &Scenario) -> Option<String> {
    let message_type = &scenario.workload.message_type;
    let parts: Vec<&str> = message_type.split('/').collect();
    let word = |part: &&str| !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    let good = parts.len() == 3 && parts[1] == "msg" && parts.iter().all(word);
    (!good).then(|| format!("workload.message_type is '{message_type}', but must be pkg/msg/Name"))
}

fn names(scenario: &Scenario) -> Vec<String> {
    let mut found = Vec::new();
    let mut seen = BTreeSet::new();
    for (at, remote) in scenario.remotes.iter().enumerate() {
        for (key, name) in [("name", &remote.name), ("lane", &remote.lane)] {
            let first = name.chars().next().is_some_and(|c| c.is_ascii_lowercase());
            let all = name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
            if !first || !all || name.len() > 12 {
                found.push(format!(
                    "remotes[{at}].{key} is '{name}', but must be 1 to 12 characters of a-z, 0-9 and _, a \
                     letter first"
                ));
            }
        }
        if RESERVED.contains(&remote.name.as_str()) || !seen.insert(&remote.name) {
            found.push(format!("remotes[{at}].name is '{}', which is already in use", remote.name));
        }
        if remote.lane == "critical" {
            found.push(format!("remotes[{at}].lane is critical, which is reserved for the local subscriber"));
        }
    }
    found
}

fn events(scenario: &Scenario) -> Vec<String> {
    let endpoints: Vec<String> = (0..scenario.workload.routes)
        .flat_map(|route| {
            let remotes = scenario.remotes.iter().map(|remote| remote.name.as_str());
            let names = ["publisher", "critical"].into_iter().chain(remotes);
            names.map(move |name| scenario.endpoint_name(name, route)).collect::<Vec<_>>()
        })
        .collect();
    let bridge = match scenario.variant {
        Variant::Baseline => Vec::new(),
        Variant::Bridge => scenario.bridge_processes(),
    };
    let mut found = Vec::new();
    for (at, event) in scenario.events.iter().enumerate() {
        let known: Vec<&String> = match event.action {
            action if action.is_of_link() => scenario.remotes.iter().map(|remote| &remote.name).collect(),
            // No process restarts the supervisor, `up`.
            Action::Kill => bridge.iter().filter(|name| *name != "up").collect(),
            _ => endpoints.iter().chain(&bridge).collect(),
        };
        if !known.contains(&&event.to) {
            let known: Vec<&str> = known.into_iter().map(String::as_str).collect();
            let (to, action) = (&event.to, event.action.name());
            found.push(if known.is_empty() {
                format!("events[{at}].to is '{to}', but {action} has no possible target in this scenario")
            } else {
                let known = known.join(", ");
                format!("events[{at}].to is '{to}', but the target of {action} must be one of {known}")
            });
        }
    }
    if scenario.events.windows(2).any(|pair| pair[0].at_s > pair[1].at_s) {
        found.push("events must be in the order of at_s".to_owned());
    }
    found
}
