//! An impaired link at a host, as `adaptive-bridge-eval impair` makes it.

use std::path::Path;

use nix::sys::signal::Signal;
use serde_json::Value;

use super::netns::Host;
use super::process::Process;

/// The binary.
pub fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_adaptive-bridge-eval"))
}

/// What a host receives from another is lost and delayed, until this is dropped or ended. Declare it after
/// the [`Net`](super::netns::Net).
pub struct Impairment {
    process: Process,
    /// Lines of output that have been read.
    read: usize,
}

impl Impairment {
    /// Impairs what `host` receives from `source`, by NFQUEUE, and waits until it does. Arguments such as
    /// `--level strong --reading as-run --delay-ms 20 --jitter-ms 10 --seed 7 --state off`. Several links at
    /// one host take a `--queue` each.
    pub fn start(host: &Host, source: &Host, arguments: &str) -> Self {
        let mut command = host.command(program());
        command.args(["impair", "--json", "--backend", "nfqueue", "--source", &source.address().to_string()]);
        command.args(arguments.split_whitespace());
        let name = format!("impair {arguments} at {}", host.name());
        let process = Process::spawn_fed(&name, command);
        let mut impairment = Self { process, read: 0 };
        impairment.wait_for("ready");
        impairment
    }

    /// Loses and delays packets, as at the start; yields the counters.
    pub fn on(&mut self) -> Value {
        self.command("on", "changed")
    }

    /// Lets all packets pass; yields the counters.
    pub fn off(&mut self) -> Value {
        self.command("off", "changed")
    }

    /// Loses every packet; yields the counters.
    pub fn down(&mut self) -> Value {
        self.command("down", "changed")
    }

    /// What it has done so far: `seen`, `lost`, `passed`, … (docs/eval-json.md).
    pub fn counters(&mut self) -> Value {
        self.command("counters", "counters")
    }

    /// Waits until it has seen so many packets and none is on its way; yields the counters.
    pub fn wait_seen(&mut self, packets: u64) -> Value {
        super::wait_for(format!("{packets} packets seen, and none on its way"), || {
            let counters = self.counters();
            (counters["seen"].as_u64() >= Some(packets) && counters["held"] == 0).then_some(counters)
        })
    }

    /// Ends it as a user does (SIGTERM); yields the last counters.
    pub fn end(mut self) -> Value {
        let status = self.process.terminate();
        assert!(status.success(), "impair ended with {status}\n{}", self.process.log());
        self.wait_for("ended")
    }

    /// Stops it (SIGSTOP), or lets it go on (SIGCONT).
    pub fn signal(&self, signal: Signal) {
        self.process.signal(signal);
    }

    /// Kills it (SIGKILL), so that it can't clean up.
    pub fn kill9(mut self) {
        self.process.kill9();
    }

    /// What it wrote to stderr.
    pub fn log(&self) -> String {
        self.process.log()
    }

    fn command(&mut self, command: &str, event: &str) -> Value {
        self.process.feed(format!("{command}\n").as_bytes());
        self.wait_for(event)
    }

    fn wait_for(&mut self, event: &str) -> Value {
        let find = |line: &str| {
            let value: Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
            (value["event"] == event).then_some(value)
        };
        let (value, read) = self.process.wait_for_line(event, self.read, find);
        self.read = read;
        value
    }
}
