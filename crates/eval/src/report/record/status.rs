//! Reads `status.jsonl` of a run with the bridge: states and modes over time.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use serde::Deserialize;

use super::super::error::ReportError;
use super::Manifest;
use crate::statistics::Change;

/// The bridge's status over a run.
#[derive(Clone, Debug, Default)]
pub struct BridgeRecord {
    /// The record of each subscriber, by its id.
    pub subscribers: Vec<(String, SubscriberRecord)>,
    /// Modes that each lane applied.
    pub lanes: Vec<(String, Vec<Change<String>>)>,
    /// Modes of the safety supervisor.
    pub safety: Vec<Change<String>>,
    /// Bytes of payload that the noncritical lanes have published, `(seconds, bytes)`.
    pub noncritical_bytes: Vec<(f64, u64)>,
    /// Lanes of routes with samples that were neither forwarded nor counted under a drop reason at the end.
    pub unaccounted_lanes: usize,
}

/// The classifier's states of a subscriber.
#[derive(Clone, Debug, Default)]
pub struct SubscriberRecord {
    /// The states over time.
    pub states: Vec<Change<String>>,
    /// Transitions within the window, by the classifier's own counter.
    pub transitions: u64,
    /// The classifier's counter at the start of the window.
    counted_before: Option<u64>,
}

#[derive(Deserialize)]
struct Line {
    time_ns: u64,
    status: Status,
}

/// The keys of the status (docs/status-json.md) that the report needs.
#[derive(Deserialize)]
struct Status {
    #[serde(default)]
    safety: Option<Safety>,
    #[serde(default)]
    lanes: Vec<Lane>,
    #[serde(default)]
    subscribers: Vec<Subscriber>,
    #[serde(default)]
    routes: Vec<Route>,
}

#[derive(Deserialize)]
struct Safety {
    mode: String,
}

#[derive(Deserialize)]
struct Lane {
    name: String,
    applied_mode: Option<String>,
}

#[derive(Deserialize)]
struct Subscriber {
    id: String,
    state: String,
    state_since_s: f64,
    transitions: u64,
}

#[derive(Deserialize)]
struct Route {
    lanes: Vec<RouteLane>,
}

#[derive(Deserialize)]
struct RouteLane {
    lane: String,
    forwarded_bytes: u64,
    whole: bool,
}

/// Reads the file in `folder`; returns `None` if it does not exist, as in a baseline.
pub fn read(folder: &Path, manifest: &Manifest) -> Result<Option<BridgeRecord>, ReportError> {
    let path = folder.join("status.jsonl");
    let text = match fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(ReportError::file(&path)(error)),
    };
    let mut record = BridgeRecord::default();
    for (index, line) in text.lines().enumerate() {
        let Line { time_ns, status } = serde_json::from_str(line)
            .map_err(|error| ReportError::content(&path, index + 1, format!("invalid status: {error}")))?;
        record.add(manifest.seconds(time_ns), manifest.length_s(), status);
    }
    Ok(Some(record))
}

impl BridgeRecord {
    fn add(&mut self, at_s: f64, length_s: f64, status: Status) {
        if let Some(safety) = status.safety {
            change(&mut self.safety, at_s, safety.mode);
        }
        for lane in status.lanes {
            if let Some(mode) = lane.applied_mode {
                change(entry(&mut self.lanes, &lane.name), at_s, mode);
            }
        }
        for subscriber in status.subscribers {
            let record = entry(&mut self.subscribers, &subscriber.id);
            // The status is up to a second later than the transition, and gives the time since then.
            let since_s = subscriber.state_since_s.clamp(0.0, 1e9);
            change(&mut record.states, at_s - since_s, subscriber.state);
            if at_s < length_s {
                // The last reading before the window gives the counter's initial value.
                if at_s <= 0.0 || record.counted_before.is_none() {
                    record.counted_before = Some(subscriber.transitions);
                }
                let before = record.counted_before.unwrap_or_default();
                // A restarted control process counts from 0.
                record.transitions = subscriber.transitions.saturating_sub(before);
            }
        }
        let lanes = || status.routes.iter().flat_map(|route| &route.lanes);
        let noncritical = lanes().filter(|lane| lane.lane != "critical");
        self.noncritical_bytes.push((at_s, noncritical.map(|lane| lane.forwarded_bytes).sum()));
        self.unaccounted_lanes = lanes().filter(|lane| !lane.whole).count();
    }
}

fn entry<'a, T: Default>(list: &'a mut Vec<(String, T)>, name: &str) -> &'a mut T {
    let at = list.iter().position(|(known, _)| known == name).unwrap_or_else(|| {
        list.push((name.to_owned(), T::default()));
        list.len() - 1
    });
    &mut list[at].1
}

fn change(changes: &mut Vec<Change<String>>, at_s: f64, to: String) {
    if changes.last().is_none_or(|last| last.to != to) {
        // The times of changes must ascend.
        let at_s = changes.last().map_or(at_s, |last| at_s.max(last.at_s));
        changes.push(Change { at_s, to });
    }
}
