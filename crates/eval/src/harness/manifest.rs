//! `manifest.json`, the description of a run. docs/eval-results.md describes every key.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use super::machine::{Machine, Software};
use crate::bed::BedKind;
use crate::impairment::{Level, Reading};
use crate::scenario::{Switch, Variant};

/// The version of the format. It increases when a key is renamed or its meaning changes.
pub(super) const FORMAT: u32 = 1;

/// The manifest of a run.
#[derive(Debug, Serialize)]
pub(super) struct Manifest<'a> {
    pub format: u32,
    pub run: &'a str,
    pub scenario: &'a str,
    pub title: &'a str,
    pub variant: Variant,
    pub level: Level,
    pub library: &'static str,
    pub reading: Option<Reading>,
    pub bed: BedKind,
    pub switch: Switch,
    pub quick: bool,
    pub repetition: u32,
    pub seed: u64,
    pub duration_s: f64,
    pub settle_s: f64,
    pub begin_ns: u64,
    pub end_ns: u64,
    pub begin_unix_ms: u64,
    pub classifier: Option<bool>,
    pub machine: &'a Machine,
    pub software: Software,
    pub command_line: Vec<String>,
    pub pins: BTreeMap<String, String>,
    pub endpoints: Vec<EndpointEntry>,
    pub links: Vec<LinkEntry>,
    pub ports: Vec<PortEntry>,
    pub problems: Vec<String>,
}

/// The entry of a publisher or subscriber.
#[derive(Clone, Debug, Serialize)]
pub(super) struct EndpointEntry {
    pub name: String,
    pub role: &'static str,
    pub route: usize,
    pub host: String,
    pub lane: Option<String>,
    pub topic: String,
    pub rate_hz: f64,
    pub size_bytes: u64,
    pub reliability: &'static str,
    pub history: &'static str,
    pub library: &'static str,
    pub command_line: Vec<String>,
    pub environment: BTreeMap<String, String>,
    pub summary: Option<Value>,
}

/// The entry of an impaired link.
#[derive(Clone, Debug, Serialize)]
pub(super) struct LinkEntry {
    pub name: String,
    pub direction: &'static str,
    pub host: String,
    pub source: String,
    pub before_switch: bool,
    pub cap_kbit_per_s: Option<u64>,
    pub impairment: Option<Value>,
}

/// The entry of a port of the switch.
#[derive(Clone, Debug, Serialize)]
pub(super) struct PortEntry {
    pub host: String,
    pub mtu: Option<u64>,
}
