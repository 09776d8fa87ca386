//! `status.jsonl` of a run with the bridge: its states and modes over time.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use serde::Deserialize;

use super::super::error::ReportError;
use super::Manifest;
use crate::eval::statistics::Change;

/// What the bridge said of itself during a run.
#[derive(Clone, Debug, Default)]
pub struct BridgeRecord {
    /// States of each subscriber, by its id.
    pub subscribers: Vec<(String, SubscriberRecord)>,
    /// Modes that each lane applied.
    pub lanes: Vec<(String, Vec<Change<String>>)>,
    /// Modes of the safety supervisor.
    pub safety: Vec<Change<String>>,
    /// Bytes of payload that the noncritical lanes have handed to DDS, `(seconds, bytes)`.
    pub noncritical_bytes: Vec<(f64, u64)>,
    /// Lanes of routes whose samples were not all accounted for, forwarded or dropped for a name, at the end.
    pub not_whole: usize,
}

/// What the classifier made of a subscriber.
#[derive(Clone, Debug, Default)]
pub struct SubscriberRecord {
    /// Its states.
    pub states: Vec<Change<String>>,
    /// Changes of its state within the window, by the classifier's own counter.
    pub transitions: u64,
    /// The counter when the window began.
    counted_before: Option<u64>,
}

#[derive(Deserialize)]
struct Line {
    time_ns: u64,
    status: Status,
}

/// What of docs/status-json.md is needed here.
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

/// Reads the file in `folder`; there is none in a baseline.
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
            .map_err(|error| ReportError::content(&path, index + 1, format!("no status: {error}")))?;
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
            // The status is of up to a second after the change, and says how long ago that was.
            let since_s = subscriber.state_since_s.clamp(0.0, 1e9);
            change(&mut record.states, at_s - since_s, subscriber.state);
            if at_s < length_s {
                // Readings before the window tell where the counter began.
                if at_s <= 0.0 || record.counted_before.is_none() {
                    record.counted_before = Some(subscriber.transitions);
                }
                let before = record.counted_before.unwrap_or_default();
                // A control process that was started anew counts from 0.
                record.transitions = subscriber.transitions.saturating_sub(before);
            }
        }
        let lanes = || status.routes.iter().flat_map(|route| &route.lanes);
        let noncritical = lanes().filter(|lane| lane.lane != "critical");
        self.noncritical_bytes.push((at_s, noncritical.map(|lane| lane.forwarded_bytes).sum()));
        self.not_whole = lanes().filter(|lane| !lane.whole).count();
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
        // Never before the change that came first.
        let at_s = changes.last().map_or(at_s, |last| at_s.max(last.at_s));
        changes.push(Change { at_s, to });
    }
}
