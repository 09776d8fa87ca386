//! The trace files of a scenario's links.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{Remote, Scenario};
use crate::impairment::Trace;

/// A scenario's reference to a trace file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceFile {
    /// Path of the file, relative to the scenario's folder.
    pub file: PathBuf,
    /// Whether the trace restarts at its end instead of staying in its last row.
    #[serde(default)]
    pub repeat: bool,
    /// The file's text when the scenario was read, so that all runs of a matrix use the same trace.
    #[serde(skip)]
    pub text: String,
}

impl TraceFile {
    /// Reads and checks the file.
    fn read(&mut self, folder: &Path) -> Result<(), String> {
        let path = folder.join(&self.file);
        let (_, text) = Trace::load(&path).map_err(|error| error.to_string())?;
        self.text = text;
        Ok(())
    }
}

/// Direction of a link: packets to the remote subscriber.
pub const FORWARD: &str = "forward";
/// Direction of a link: packets from the remote subscriber.
pub const RETURN: &str = "return";

impl Remote {
    /// The trace of a direction, `forward` or `return`.
    pub fn trace_of(&self, direction: &str) -> Option<&TraceFile> {
        if direction == FORWARD { self.trace.as_ref() } else { self.return_trace.as_ref() }
    }

    /// The file name in the results of the trace of a direction.
    pub fn trace_name(&self, direction: &str) -> String {
        format!("trace-{}-{direction}.csv", self.name)
    }
}

impl Scenario {
    /// All traces, with their file names in the results.
    pub fn traces(&self) -> impl Iterator<Item = (String, &TraceFile)> {
        let directions = self.remotes.iter().flat_map(|remote| [FORWARD, RETURN].map(|it| (remote, it)));
        directions.filter_map(|(remote, direction)| {
            Some((remote.trace_name(direction), remote.trace_of(direction)?))
        })
    }

    /// Reads the files of all traces; returns their mistakes.
    pub(super) fn read_traces(&mut self, folder: &Path) -> Vec<String> {
        let files = self.remotes.iter_mut().flat_map(|remote| [&mut remote.trace, &mut remote.return_trace]);
        files.flatten().filter_map(|file| file.read(folder).err()).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;
    use std::fs;

    use super::*;

    const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/scenarios");

    #[test]
    fn the_path_is_relative_to_the_scenario_and_the_text_is_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let rows = "time_s,loss,delay_ms\n0,0.5,1\n";
        fs::create_dir(folder.path().join("links")).expect("a folder");
        fs::write(folder.path().join("links/a.csv"), rows).expect("written");
        let path = folder.path().join("mine.yaml");
        let text = "title: a\nvariant: bridge\nduration_s: 10\nremotes:\n  - name: slow\n    \
                    return_trace: {file: links/a.csv}\n";
        fs::write(&path, text).expect("written");
        let scenario = Scenario::load(&path).unwrap_or_else(|error| panic!("{error}"));
        fs::remove_file(folder.path().join("links/a.csv")).expect("removed");
        let traces: Vec<_> = scenario.traces().map(|(name, trace)| (name, trace.text.clone())).collect();
        assert_eq!(traces, [("trace-slow-return.csv".to_owned(), rows.to_owned())]);
        let slow = &scenario.remotes[0];
        assert!(slow.is_impaired_back() && !slow.is_impaired());
        assert!(slow.trace_of(FORWARD).is_none() && slow.trace_of(RETURN).is_some_and(|it| !it.repeat));
        let error = Scenario::load(&path).expect_err("the trace was removed").to_string();
        assert!(error.contains("mine.yaml") && error.contains("links/a.csv: No such file"), "{error}");
    }

    #[test]
    fn the_drive_trace_follows_its_formula() {
        let scenario = Scenario::load(&Path::new(FOLDER).join("bridge_drive.yaml")).expect("a scenario");
        let text = &scenario.remotes[0].trace.as_ref().expect("a trace").text;
        let rows: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).skip(1).collect();
        let of_formula = (0..120).map(|t| {
            let distance_m = 5.0 + 85.0 * (PI * f64::from(t) / 120.0).sin().powi(2);
            let signal_db = 70.0 - 30.0 * distance_m.log10();
            let loss = 1.0 / (1.0 + ((signal_db - 12.0) / 2.0).exp());
            format!("{t},{loss:.4},{:.1},{:.1}", 2.0 + 40.0 * loss, 1.0 + 10.0 * loss)
        });
        assert_eq!(rows, of_formula.collect::<Vec<_>>());
        // The window contains the trace twice.
        let trace = Trace::parse(text).unwrap_or_else(|problems| panic!("{problems:?}"));
        assert_eq!((trace.length_ns(), scenario.duration_s), (120_000_000_000, 240.0));
    }
}
