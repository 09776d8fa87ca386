//! Reads the records of finished runs, described in docs/eval-results.md. Converts times to seconds since the
//! start of the measured window.

mod manifest;
mod status;
mod table;

use std::fs;
use std::path::{Path, PathBuf};

pub use manifest::{Endpoint, LinkOutcome, Manifest, Role};
pub use status::BridgeRecord;

use super::error::ReportError;
use crate::statistics::Reception;

/// The records of a run.
#[derive(Clone, Debug)]
pub struct Run {
    pub manifest: Manifest,
    /// Attempts of each publisher.
    pub published: Vec<Published>,
    /// Receptions of each subscriber.
    pub subscribed: Vec<Subscribed>,
    pub events: Vec<Event>,
    pub wire: Vec<WireReading>,
    pub rtps: Vec<RtpsReading>,
    pub kernel: Vec<KernelReading>,
    pub processes: Vec<ProcessReading>,
    /// `None` without a bridge.
    pub bridge: Option<BridgeRecord>,
}

#[derive(Clone, Debug)]
pub struct Published {
    pub endpoint: Endpoint,
    pub attempts: Vec<Attempt>,
}

#[derive(Clone, Debug)]
pub struct Subscribed {
    pub endpoint: Endpoint,
    /// In the order of arrival.
    pub receptions: Vec<Reception>,
}

/// An attempt to publish.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attempt {
    pub seq: u64,
    pub at_s: f64,
    pub call_ms: f64,
    pub ok: bool,
}

/// An event that the harness recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    pub at_s: f64,
    pub event: String,
    pub subject: String,
}

/// Counters of a port of the switch.
#[derive(Clone, Debug)]
pub struct WireReading {
    pub at_s: f64,
    pub port: String,
    pub to_host_bytes: u64,
}

/// Counters of RTPS messages at the interface of a host.
#[derive(Clone, Debug)]
pub struct RtpsReading {
    pub at_s: f64,
    pub port: String,
    pub direction: String,
    pub fragments: u64,
    pub user_data: u64,
    pub user_heartbeat: u64,
    pub user_acknack: u64,
}

/// Counters of a host's kernel.
#[derive(Clone, Debug)]
pub struct KernelReading {
    pub at_s: f64,
    pub host: String,
    pub fragment_memory_bytes: u64,
    pub reassembly_failed: u64,
    pub udp_buffer_errors: u64,
}

/// CPU time and memory of a process.
#[derive(Clone, Debug)]
pub struct ProcessReading {
    pub at_s: f64,
    pub process: String,
    pub pid: u32,
    pub cpu_ms: f64,
    pub rss_bytes: u64,
}

/// The runs of a folder of results.
pub struct Folder {
    /// Readable runs, sorted by name.
    pub runs: Vec<Run>,
    /// Name and reason of runs that could not be read, and of runs that failed.
    pub unusable: Vec<(String, String)>,
}

impl Folder {
    /// Reads the results in `folder`. A run that cannot be read is listed in `unusable`.
    pub fn read(folder: &Path) -> Result<Self, ReportError> {
        let mut runs = Vec::new();
        let mut unusable = Vec::new();
        for path in folders(&folder.join("runs"))? {
            match Run::read(&path) {
                Ok(run) => runs.push(run),
                Err(error) => unusable.push((name_of(&path), error.to_string())),
            }
        }
        for path in folders(&folder.join("failed"))? {
            let reason = fs::read_to_string(path.join("reason.txt")).unwrap_or_default();
            unusable.push((name_of(&path), format!("failed: {}", reason.trim())));
        }
        if runs.is_empty() && unusable.is_empty() {
            return Err(ReportError::NoRuns { folder: folder.to_owned() });
        }
        Ok(Self { runs, unusable })
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Lists the folders in a folder, sorted by name; empty if the folder does not exist.
fn folders(folder: &Path) -> Result<Vec<PathBuf>, ReportError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(ReportError::file(folder)(error)),
    };
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry.map_err(ReportError::file(folder))?.path();
        if path.is_dir() {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths)
}

impl Run {
    /// Reads the run in `folder`.
    pub fn read(folder: &Path) -> Result<Self, ReportError> {
        let manifest = Manifest::read(folder)?;
        let seconds = |time_ns: u64| manifest.seconds(time_ns);
        let (mut published, mut subscribed) = (Vec::new(), Vec::new());
        for endpoint in &manifest.endpoints {
            let path = folder.join(format!("{}.csv", endpoint.name));
            let endpoint = endpoint.clone();
            if endpoint.role == Role::Publisher {
                let attempts = table::read(&path, ["seq", "time_ns", "call_ns", "ok"], |row| {
                    let (at_s, call_ms) = (seconds(row.number(1)?), row.number::<f64>(2)? / 1e6);
                    Ok(Attempt { seq: row.number(0)?, at_s, call_ms, ok: row.text(3) == "1" })
                })?;
                published.push(Published { endpoint, attempts });
            } else {
                let receptions = table::read(&path, ["seq", "time_ns", "latency_ns"], |row| {
                    let (at_s, latency_ms) = (seconds(row.number(1)?), row.number::<f64>(2)? / 1e6);
                    Ok(Reception { seq: row.number(0)?, at_s, latency_ms })
                })?;
                subscribed.push(Subscribed { endpoint, receptions });
            }
        }
        let events = table::read(&folder.join("events.csv"), ["time_ns", "event", "subject"], |row| {
            let at_s = seconds(row.number(0)?);
            Ok(Event { at_s, event: row.text(1).to_owned(), subject: row.text(2).to_owned() })
        })?;
        let wire =
            table::read_if_exists(&folder.join("wire.csv"), ["time_ns", "port", "to_host_bytes"], |row| {
                let (at_s, port) = (seconds(row.number(0)?), row.text(1).to_owned());
                Ok(WireReading { at_s, port, to_host_bytes: row.number(2)? })
            })?;
        let rtps = table::read_if_exists(
            &folder.join("rtps.csv"),
            ["time_ns", "port", "direction", "fragments", "user_data", "user_heartbeat", "user_acknack"],
            |row| {
                Ok(RtpsReading {
                    at_s: seconds(row.number(0)?),
                    port: row.text(1).to_owned(),
                    direction: row.text(2).to_owned(),
                    fragments: row.number(3)?,
                    user_data: row.number(4)?,
                    user_heartbeat: row.number(5)?,
                    user_acknack: row.number(6)?,
                })
            },
        )?;
        let kernel = table::read_if_exists(
            &folder.join("kernel.csv"),
            ["time_ns", "host", "fragment_memory_bytes", "reassembly_failed", "udp_buffer_errors"],
            |row| {
                Ok(KernelReading {
                    at_s: seconds(row.number(0)?),
                    host: row.text(1).to_owned(),
                    fragment_memory_bytes: row.number(2)?,
                    reassembly_failed: row.number(3)?,
                    udp_buffer_errors: row.number(4)?,
                })
            },
        )?;
        let processes = table::read_if_exists(
            &folder.join("processes.csv"),
            ["time_ns", "process", "pid", "cpu_ms", "rss_bytes"],
            |row| {
                Ok(ProcessReading {
                    at_s: seconds(row.number(0)?),
                    process: row.text(1).to_owned(),
                    pid: row.number(2)?,
                    cpu_ms: row.number(3)?,
                    rss_bytes: row.number(4)?,
                })
            },
        )?;
        let bridge = status::read(folder, &manifest)?;
        Ok(Self { published, subscribed, events, wire, rtps, kernel, processes, bridge, manifest })
    }

    /// Subscribers of a role.
    pub fn of_role(&self, role: Role) -> impl Iterator<Item = &Subscribed> {
        self.subscribed.iter().filter(move |one| one.endpoint.role == role)
    }

    /// Length of the measured window, in seconds.
    pub fn length_s(&self) -> f64 {
        self.manifest.length_s()
    }

    /// Toggles of links, `(seconds, whether impaired)`; switching several links at the same time is one
    /// toggle.
    pub fn toggles(&self) -> Vec<(f64, bool)> {
        /// Events closer than this are simultaneous: the harness switches the links of a host one after the
        /// other.
        const AT_ONCE_S: f64 = 1.0;
        let mut toggles: Vec<(f64, bool)> = Vec::new();
        for event in &self.events {
            let impaired = match event.event.as_str() {
                "link_down" => true,
                // A link without loss and delay, which is only ever cut, is clean when it is on.
                "link_on" => self.is_lossy(),
                "link_off" => false,
                _ => continue,
            };
            let again = |&(at_s, known): &(f64, bool)| known == impaired && event.at_s - at_s < AT_ONCE_S;
            if !toggles.last().is_some_and(again) {
                toggles.push((event.at_s, impaired));
            }
        }
        toggles
    }

    /// Whether links lose or delay packets while they are on.
    pub fn is_lossy(&self) -> bool {
        let outcomes = self.manifest.links.iter().filter_map(|link| link.impairment.as_ref());
        outcomes.into_iter().any(|link| link.loss_expected > 0.0 || link.delay_ms > 0.0)
    }

    /// Spans of time in which a link was impaired, `(from, to)` in seconds within the window.
    pub fn impaired_spans(&self) -> Vec<(f64, f64)> {
        let mut spans = Vec::new();
        let mut since = None;
        for (at_s, impaired) in self.toggles() {
            let at_s = at_s.clamp(0.0, self.length_s());
            match (impaired, since) {
                (true, None) => since = Some(at_s),
                (false, Some(from)) => {
                    spans.push((from, at_s));
                    since = None;
                }
                _ => {}
            }
        }
        spans.extend(since.map(|from| (from, self.length_s())));
        spans.retain(|(from, to)| to > from);
        spans
    }
}
