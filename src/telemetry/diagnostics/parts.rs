//! The parts of the bridge that have a status of their own, with message and level without problems.

use serde::Serialize;
use serde_json::Value;

use super::Level;
use crate::model::{Counts, Reason};
use crate::telemetry::liveness::ProcessState;
use crate::telemetry::report::{LaneReport, ProcessReport, Report, RouteReport, SubscriberReport};

/// A part of the bridge with its own diagnostic status.
pub(super) struct Part {
    /// Its name, as in [`Problem::about`](crate::telemetry::Problem).
    pub(super) name: String,
    /// Its level when no problem is about it.
    pub(super) level: Level,
    /// Its message when no problem is about it.
    pub(super) message: String,
    /// Its keys and values.
    pub(super) values: Vec<(String, String)>,
}

/// All parts, in the same order in each report.
pub(super) fn of(report: &Report) -> Vec<Part> {
    let mut parts = vec![bridge(report)];
    for name in ["ingress", "control"] {
        parts.extend(report.processes.iter().find(|process| process.reading.name == name).map(process));
    }
    parts.push(safety(report));
    parts.extend(report.lanes.iter().map(|one| lane(one, report)));
    parts.extend(report.routes.iter().map(route));
    parts.push(probes(report));
    parts.extend(report.subscribers.iter().map(subscriber));
    parts.push(network(report));
    parts.push(intruders(report));
    parts
}

fn part(name: impl Into<String>, message: String, values: Vec<(String, String)>) -> Part {
    Part { name: name.into(), level: Level::Ok, message, values }
}

fn bridge(report: &Report) -> Part {
    let values = vec![
        ("instance".to_owned(), report.instance.clone()),
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("problems".to_owned(), report.problems.len().to_string()),
        ("window_ms".to_owned(), number(report.window_ms)),
    ];
    part("bridge", format!("{} lanes, {} routes", report.lanes.len(), report.routes.len()), values)
}

fn process(process: &ProcessReport) -> Part {
    part(&*process.reading.name, process.reading.state.label().to_owned(), flat(process))
}

fn safety(report: &Report) -> Part {
    part("safety", report.safety.mode.to_owned(), flat(&report.safety))
}

fn lane(lane: &LaneReport, report: &Report) -> Part {
    let mut values = flat(lane);
    let name = format!("egress-{}", lane.name);
    let process = report.processes.iter().find(|process| process.reading.name == name);
    let is_up = process.is_some_and(|process| process.reading.state == ProcessState::Running);
    if let Some(process) = process {
        put(&mut values, "process", process, &[]);
    }
    let message = format!("{} ({}): {}", lane.mode, lane.mode_reason, lane.mode_detail);
    let level = if is_up { Level::Ok } else { Level::Stale };
    Part { name: format!("lane {}", lane.name), level, message, values }
}

fn route(route: &RouteReport) -> Part {
    let mut values = Vec::new();
    put(&mut values, "", route, &["lanes", "drops", "drops_in_window"]);
    put_counts(&mut values, "drops", &route.counters.drops);
    for output in &route.lanes {
        put(&mut values, &output.lane, output, &["drops", "drops_in_window"]);
        put_counts(&mut values, &format!("{}.drops", output.lane), &output.counters.drops);
    }
    let message = match route.rate_hz {
        Some(rate_hz) => format!("{} Hz from {} publishers", number(rate_hz), route.counters.writers),
        None => format!("{} publishers", route.counters.writers),
    };
    part(format!("route {}", route.id), message, values)
}

fn probes(report: &Report) -> Part {
    let message = format!("{} sent, {} answered", report.probes.sent, report.probes.accepted);
    let mut values = Vec::new();
    put(&mut values, "", &report.probes, &["refused", "refused_in_window"]);
    put_counts(&mut values, "refused", &report.probes.refused);
    part("probes", message, values)
}

fn subscriber(subscriber: &SubscriberReport) -> Part {
    let forced = if subscriber.forced { ", forced" } else { "" };
    let message = format!("{}{forced}: {}", subscriber.state, subscriber.figures());
    part(format!("subscriber {}", subscriber.id), message, flat(subscriber))
}

fn network(report: &Report) -> Part {
    let values = report.absences.iter().map(|absence| {
        let name = absence.name.clone().or_else(|| absence.host.clone()).unwrap_or_default();
        let state = if absence.back_s.is_some() { "was away" } else { "away" };
        (name, format!("{state} for {} s: {}", number(absence.away_s), absence.detail))
    });
    part("network", "no interface and no peer is away".to_owned(), values.collect())
}

fn intruders(report: &Report) -> Part {
    let mut values = vec![
        ("intruders".to_owned(), report.intruders.len().to_string()),
        ("intruders_seen".to_owned(), report.intruders_seen.to_string()),
    ];
    for intruder in &report.intruders {
        let node = intruder.node.as_deref().unwrap_or("a node of unknown name");
        values.push((intruder.topic.clone(), format!("{node} on {}: {}", intruder.host, intruder.remedy)));
    }
    part("intruders", "no remote subscriber bypasses the bridge".to_owned(), values)
}

fn flat(value: &impl Serialize) -> Vec<(String, String)> {
    let mut values = Vec::new();
    put(&mut values, "", value, &[]);
    values
}

/// Adds the leaves of a value by their paths, without the fields `omitted`.
fn put(values: &mut Vec<(String, String)>, path: &str, value: &impl Serialize, omitted: &[&str]) {
    // Serializing the types of the report does not fail.
    if let Ok(mut value) = serde_json::to_value(value) {
        if let Value::Object(fields) = &mut value {
            fields.retain(|name, _| !omitted.contains(&name.as_str()));
        }
        flatten(path, &value, values);
    }
}

/// Adds the counts other than 0, but not those of the window: a monitor sees the change between messages.
fn put_counts<R: Reason, const N: usize>(
    values: &mut Vec<(String, String)>,
    path: &str,
    counts: &Counts<R, N>,
) {
    values.extend(counts.iter().map(|(reason, count)| (format!("{path}.{reason}"), count.to_string())));
}

/// Collects the leaves of a JSON value by their paths.
fn flatten(path: &str, value: &Value, values: &mut Vec<(String, String)>) {
    let text = match value {
        Value::Object(fields) => {
            for (key, field) in fields {
                let below = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                flatten(&below, field, values);
            }
            return;
        }
        Value::Array(items) => items.iter().filter_map(Value::as_str).collect::<Vec<_>>().join(", "),
        Value::Null => "unknown".to_owned(),
        Value::Bool(flag) => if *flag { "yes" } else { "no" }.to_owned(),
        Value::Number(count) if !count.is_f64() => count.to_string(),
        Value::Number(figure) => figure.as_f64().map_or_else(|| figure.to_string(), number),
        Value::String(text) => text.clone(),
    };
    values.push((path.to_owned(), text));
}

/// A number with at most three decimals, without trailing zeros.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{DropCounts, DropReason};

    #[test]
    fn numbers_are_short() {
        for (value, text) in [(10.0, "10"), (9.9996, "10"), (0.015, "0.015"), (100.0, "100"), (0.0, "0")] {
            assert_eq!(number(value), text);
        }
    }

    #[test]
    fn leaves_are_named_by_their_path() {
        let json = serde_json::json!({
            "drops": {"stale": 3, "stopped": 0}, "drops_in_window": {"stale": 1}, "rtt": null, "up": true,
            "dds_in": {"p50_us": 12.5}, "warnings": ["rtt", "loss"], "count": 0
        });
        let mut drops = DropCounts::default();
        drops.add(DropReason::Stale, 3);
        let mut found = Vec::new();
        put(&mut found, "", &json, &["drops", "drops_in_window"]);
        put_counts(&mut found, "drops", &drops);
        found.sort();
        let expected = [
            ("count", "0"),
            ("dds_in.p50_us", "12.5"),
            ("drops.stale", "3"),
            ("rtt", "unknown"),
            ("up", "yes"),
            ("warnings", "rtt, loss"),
        ];
        assert_eq!(found, expected.map(|(key, value)| (key.to_owned(), value.to_owned())));
    }
}
