//! Reads the keys of a run's `manifest.json` that the report needs. docs/eval-results.md describes every key.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde::Deserialize;

use super::super::error::ReportError;

/// The format of manifests that this program reads.
const FORMAT: u32 = 1;

/// The manifest of a run: its settings, machine, software, endpoints and links.
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
    /// Whether the data are synthetic, as in tests; the report warns about them.
    #[serde(default)]
    pub synthetic: bool,
}

/// The machine of a run.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub struct Machine {
    pub kernel: String,
    pub cpu: String,
    pub cpus: u32,
    pub memory_bytes: u64,
    pub os: String,
    pub load_before: f64,
    /// `None` in older runs, which did not record it.
    pub stolen_percent: Option<f64>,
}

/// The software of a run.
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
    pub history: String,
    #[serde(default)]
    pub command_line: Vec<String>,
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// The role of an endpoint.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// A publisher, such as a sensor.
    Publisher,
    /// A local subscriber that must not miss samples.
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

/// The final output of a link's process.
#[derive(Clone, Debug, Deserialize)]
pub struct LinkOutcome {
    pub backend: String,
    pub reason: String,
    /// `None` if the back end has no seed.
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
        // Check the format first, so that a newer manifest is not reported as invalid.
        let Format { format } = from_json(&path, &text)?;
        if format != FORMAT {
            let problem = format!(
                "format {format}, but this program reads format {FORMAT}: use the version that recorded it"
            );
            return Err(ReportError::content(&path, 0, problem));
        }
        let manifest: Self = from_json(&path, &text)?;
        if manifest.end_ns <= manifest.begin_ns {
            return Err(ReportError::content(&path, 0, "end_ns is not after begin_ns"));
        }
        // Names of endpoints are used as file names.
        if let Some(bad) = manifest.endpoints.iter().find(|one| one.name.contains(['/', '\0'])) {
            let problem = format!("'{}' is not a valid name of an endpoint", bad.name);
            return Err(ReportError::content(&path, 0, problem));
        }
        Ok(manifest)
    }

    /// Length of the measured window, in seconds.
    pub fn length_s(&self) -> f64 {
        (self.end_ns - self.begin_ns) as f64 / 1e9
    }

    /// Converts a time of the run's files to seconds since the start of the window.
    pub fn seconds(&self, time_ns: u64) -> f64 {
        // Monotonic nanoseconds of a machine that has been up for a month are above 2^51: subtract before the
        // conversion, so that nothing is rounded.
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
        .map_err(|error| ReportError::content(path, error.line(), format!("invalid manifest: {error}")))
}
