//! `manifest.json` of a run: what of it the report needs. docs/eval-results.md describes every key.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde::Deserialize;

use super::super::error::ReportError;

/// The only format there is.
const FORMAT: u32 = 1;

/// What was run, where, and with what.
#[derive(Clone, Debug, Deserialize)]
pub struct Manifest {
    pub run: String,
    pub scenario: String,
    pub title: String,
    pub variant: String,
    pub level: String,
    pub library: String,
    pub reading: Option<String>,
    pub bed: String,
    pub switch: String,
    pub quick: bool,
    pub repetition: u32,
    pub duration_s: f64,
    pub begin_ns: u64,
    pub end_ns: u64,
    pub begin_unix_ms: u64,
    pub classifier: Option<bool>,
    pub machine: Machine,
    pub software: Software,
    pub command_line: Vec<String>,
    pub endpoints: Vec<Endpoint>,
    #[serde(default)]
    pub links: Vec<LinkRecord>,
    #[serde(default)]
    pub problems: Vec<String>,
    /// Set in data that no harness recorded, as in tests: the report says so wherever it says anything.
    #[serde(default)]
    pub synthetic: bool,
}

/// Where it ran.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub struct Machine {
    pub kernel: String,
    pub cpu: String,
    pub cpus: u32,
    pub memory_bytes: u64,
    pub os: String,
    pub load_before: f64,
    /// None in runs of before it was recorded.
    pub stolen_percent: Option<f64>,
}

/// What it ran with.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub struct Software {
    pub version: String,
    pub commit: Option<String>,
    pub modified: bool,
    pub bridge: Option<String>,
    pub peer: String,
}

/// A publisher or a subscriber.
#[derive(Clone, Debug, Deserialize)]
pub struct Endpoint {
    pub name: String,
    pub role: Role,
    pub route: u32,
    pub host: String,
    pub lane: Option<String>,
    pub rate_hz: f64,
    #[serde(default)]
    pub command_line: Vec<String>,
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// What an endpoint is to the robot.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// The sensor.
    Publisher,
    /// The local subscriber that must not miss anything.
    Critical,
    /// A remote subscriber.
    Slow,
}

/// An impaired link.
#[derive(Clone, Debug, Deserialize)]
pub struct LinkRecord {
    #[serde(default)]
    pub name: String,
    pub direction: String,
    #[serde(default)]
    pub before_switch: bool,
    pub impairment: Option<LinkOutcome>,
}

/// What a link said at its end.
#[derive(Clone, Debug, Deserialize)]
pub struct LinkOutcome {
    pub backend: String,
    pub reason: String,
    /// None where the back end takes none.
    pub seed: Option<u64>,
    pub delay_ms: f64,
    pub judged: u64,
    pub lost: u64,
    pub loss_expected: f64,
    pub loss_standard_error: Option<f64>,
    pub trace: Option<TraceRecord>,
}

/// The trace that a link followed.
#[derive(Clone, Debug, Deserialize)]
pub struct TraceRecord {
    pub file: String,
}

impl Manifest {
    /// Reads the manifest of the run in `folder`.
    pub fn read(folder: &Path) -> Result<Self, ReportError> {
        let path = folder.join("manifest.json");
        let text = fs::read_to_string(&path).map_err(ReportError::file(&path))?;
        // The format first, so that a newer one is not taken for a broken one.
        let Format { format } = from_json(&path, &text)?;
        if format != FORMAT {
            let problem = format!("format {format}, and this program knows {FORMAT}: use the one of the run");
            return Err(ReportError::content(&path, 0, problem));
        }
        let manifest: Self = from_json(&path, &text)?;
        if manifest.end_ns <= manifest.begin_ns {
            return Err(ReportError::content(&path, 0, "end_ns is not after begin_ns"));
        }
        // Names become those of files.
        if let Some(bad) = manifest.endpoints.iter().find(|one| one.name.contains(['/', '\0'])) {
            return Err(ReportError::content(&path, 0, format!("'{}' is no name of an endpoint", bad.name)));
        }
        Ok(manifest)
    }

    /// Length of the measured window, in seconds.
    pub fn length_s(&self) -> f64 {
        (self.end_ns - self.begin_ns) as f64 / 1e9
    }

    /// A time of the run's files in seconds since the window began.
    pub fn seconds(&self, time_ns: u64) -> f64 {
        // Monotonic nanoseconds of a machine that has been up for a month are above 2^51: the difference is
        // taken before the conversion, so that none is rounded.
        if time_ns >= self.begin_ns {
            (time_ns - self.begin_ns) as f64 / 1e9
        } else {
            -((self.begin_ns - time_ns) as f64) / 1e9
        }
    }
}

#[derive(Deserialize)]
struct Format {
    format: u32,
}

fn from_json<'a, T: Deserialize<'a>>(path: &Path, text: &'a str) -> Result<T, ReportError> {
    serde_json::from_str(text)
        .map_err(|error| ReportError::content(path, error.line(), format!("no manifest: {error}")))
}
