//! Impairment of a link at a host, by `adaptive-bridge-eval impair`.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use nix::sys::signal::Signal;
use serde_json::Value;

use super::netns::Host;
use super::process::Process;

/// The path of the `adaptive-bridge-eval` binary.
pub fn program() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| super::built("adaptive-bridge-eval"));
    &PROGRAM
}

/// Loses and delays packets that a host receives from another, until it is dropped or ended. Declare it after
/// the [`Net`](super::netns::Net).
pub struct Impairment {
    process: Process,
    /// The number of output lines that have been read.
    lines_read: usize,
}

impl Impairment {
    /// Impairs what `host` receives from `source`, by NFQUEUE, and waits until it is ready. Arguments are
    /// such as `--level strong --reading as-run --delay-ms 20 --jitter-ms 10 --seed 7 --state off`. Each of
    /// several links at one host needs a different `--queue`.
    pub fn start(host: &Host, source: &Host, arguments: &str) -> Self {
        let mut command = host.command(program());
        command.args(["impair", "--json", "--backend", "nfqueue", "--source", &source.address().to_string()]);
        command.args(arguments.split_whitespace());
        let name = format!("impair {arguments} at {}", host.name());
        let process = Process::spawn_with_stdin(&name, command);
        let mut impairment = Self { process, lines_read: 0 };
        impairment.wait_for("ready");
        impairment
    }

    /// Loses and delays packets from now on; returns the counters.
    pub fn on(&mut self) -> Value {
        self.command("on", "changed")
    }

    /// Lets all packets pass; returns the counters.
    pub fn off(&mut self) -> Value {
        self.command("off", "changed")
    }

    /// Loses every packet; returns the counters.
    pub fn down(&mut self) -> Value {
        self.command("down", "changed")
    }

    /// The counters `seen`, `lost`, `passed`, … (docs/eval-json.md).
    pub fn counters(&mut self) -> Value {
        self.command("counters", "counters")
    }

    /// Waits until it has seen so many packets and holds none back; returns the counters.
    pub fn wait_seen(&mut self, packets: u64) -> Value {
        super::wait_for(format!("{packets} packets seen, and none held back"), || {
            let counters = self.counters();
            (counters["seen"].as_u64() >= Some(packets) && counters["held"] == 0).then_some(counters)
        })
    }

    /// Ends it with SIGTERM; returns the last counters.
    pub fn end(mut self) -> Value {
        let status = self.process.terminate();
        assert!(status.success(), "impair ended with {status}\n{}", self.process.log());
        self.wait_for("ended")
    }

    /// Ends it. It must have lost no packet beyond those that it was to lose.
    pub fn end_without_overflow(self) {
        let counters = self.end();
        assert_eq!([&counters["overflowed"], &counters["kernel_dropped"]], [0, 0], "{counters}");
    }

    /// Sends it a signal, such as SIGSTOP or SIGCONT.
    pub fn signal(&self, signal: Signal) {
        self.process.signal(signal);
    }

    /// Kills it (SIGKILL), so that it cannot clean up.
    pub fn kill9(mut self) {
        self.process.kill9();
    }

    /// Its output on stderr so far.
    pub fn log(&self) -> String {
        self.process.log()
    }

    fn command(&mut self, command: &str, event: &str) -> Value {
        self.process.write_stdin(format!("{command}\n").as_bytes());
        self.wait_for(event)
    }

    fn wait_for(&mut self, event: &str) -> Value {
        let find = |line: &str| {
            let value: Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
            (value["event"] == event).then_some(value)
        };
        let (value, lines_read) = self.process.wait_for_line(event, self.lines_read, find);
        self.lines_read = lines_read;
        value
    }
}
