//! The machine and the software of a run.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use adaptive_bridge_measure::cpu_time::CpuTime;
use serde::Serialize;

/// Properties and load of the machine.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Machine {
    pub kernel: String,
    pub os: String,
    pub cpu: String,
    pub cpus: usize,
    pub memory_bytes: u64,
    pub load_before: f64,
    pub stolen_percent: f64,
    #[serde(skip)]
    read_at: CpuTime,
}

impl Machine {
    /// Reads the properties of this machine and its current load.
    pub fn read() -> Self {
        let text = |path: &str| fs::read_to_string(path).unwrap_or_default();
        let load = text("/proc/loadavg");
        let memory = field(&text("/proc/meminfo"), "MemTotal", ':');
        let kib: u64 = memory.split_whitespace().next().and_then(|kib| kib.parse().ok()).unwrap_or(0);
        Self {
            kernel: text("/proc/sys/kernel/osrelease").trim().to_owned(),
            os: field(&text("/etc/os-release"), "PRETTY_NAME", '=').trim_matches('"').to_owned(),
            cpu: field(&text("/proc/cpuinfo"), "model name", ':'),
            cpus: std::thread::available_parallelism().map_or(0, Into::into),
            memory_bytes: kib * 1_024,
            load_before: load.split_whitespace().next().and_then(|load| load.parse().ok()).unwrap_or(0.0),
            stolen_percent: 0.0,
            read_at: CpuTime::parse(&text("/proc/stat")),
        }
    }

    /// Adds the CPU time that the hypervisor took since the first reading.
    pub fn read_again(self) -> Self {
        let now = CpuTime::parse(&fs::read_to_string("/proc/stat").unwrap_or_default());
        Self { stolen_percent: now.stolen_percent_since(self.read_at), ..self }
    }
}

/// Finds the value of a name in a text with a name, a separator and a value on each line; empty if not found.
fn field(text: &str, name: &str, separator: char) -> String {
    let mut pairs = text.lines().filter_map(|line| line.split_once(separator));
    pairs.find(|(key, _)| key.trim() == name).map(|(_, value)| value.trim().to_owned()).unwrap_or_default()
}

/// Versions of the programs of a run.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Software {
    pub version: &'static str,
    pub commit: Option<String>,
    pub modified: bool,
    pub bridge: Option<String>,
    pub peer: Option<String>,
}

impl Software {
    /// Reads the versions of the harness, of the checkout in which it runs, and of the bridge.
    pub fn read(bridge: Option<&Path>) -> Self {
        let commit = stdout_of(Command::new("git").args(["rev-parse", "HEAD"]));
        let changes = stdout_of(Command::new("git").args(["status", "--porcelain", "--untracked-files=no"]));
        Self {
            version: env!("CARGO_PKG_VERSION"),
            modified: changes.is_some_and(|changes| !changes.is_empty()),
            commit,
            bridge: bridge.and_then(|bridge| stdout_of(Command::new(bridge).arg("--version"))),
            peer: None,
        }
    }
}

/// Runs a program; returns its stdout if it succeeds.
fn stdout_of(command: &mut Command) -> Option<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_found_by_its_name() {
        assert_eq!(field("A=1\nPRETTY_NAME=\"Debian\"\n", "PRETTY_NAME", '='), "\"Debian\"");
        assert_eq!(field("MemTotal:  16 kB\nMemFree: 1 kB\n", "MemTotal", ':'), "16 kB");
        assert_eq!(field("", "MemTotal", ':'), "");
    }
}
