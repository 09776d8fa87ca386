//! Publishers and subscribers on other DDS libraries: the programs of tests/peers, which do not know the
//! bridge. They run during all repetitions of a case; the publisher sends a burst for each.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use super::beds::{Kind, Plan, spawn};
use super::link::{INPUT, OUTPUT, Record, Route};
use super::options::{Case, Options};
use super::system::{FIFO_PRIORITY, Place, Scheduling};

/// How often the files that the peers write are read.
const POLL: Duration = Duration::from_millis(10);

/// How long the subscriber may wait for a missing sample: more than the 3 s between two heartbeats of a
/// writer of Fast DDS, at which it repairs lost fragments.
const REPAIR: Duration = Duration::from_millis(3_500);

/// How long a peer may take to start, to match or to end.
const PATIENCE: Duration = Duration::from_secs(20);

/// Bursts before the first repetition at most, until one arrives whole.
const WARM_UPS: usize = 5;

/// A DDS library with a program of tests/peers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Library {
    Fast,
    Cyclone,
    Rust,
}

impl Library {
    pub const ALL: [Self; 3] = [Self::Fast, Self::Cyclone, Self::Rust];

    pub const fn label(self) -> &'static str {
        match self {
            Self::Fast => "Fast DDS",
            Self::Cyclone => "Cyclone DDS",
            Self::Rust => "RustDDS",
        }
    }

    fn program(self) -> PathBuf {
        let built_by_make = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/build");
        match self {
            Self::Fast => built_by_make.join("fast_peer"),
            Self::Cyclone => built_by_make.join("cyclone_peer"),
            Self::Rust => {
                Path::new(env!("CARGO_BIN_EXE_adaptive-bridge")).with_file_name("examples").join("rust_peer")
            }
        }
    }

    /// How to build the program, if it is not there.
    pub fn missing(self) -> Option<String> {
        let program = self.program();
        let command =
            if self == Self::Rust { "cargo build --release --example rust_peer" } else { "make peers" };
        (!program.exists()).then(|| format!("{} is not built: `{command}`", program.display()))
    }
}

/// A file that a program writes line by line, and how much of it was read.
struct Tail {
    file: File,
    rest: String,
}

impl Tail {
    fn open(path: &Path) -> Result<Self, String> {
        let file = File::open(path).map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Self { file, rest: String::new() })
    }

    /// The lines that were completed since the last call.
    fn lines(&mut self) -> Result<Vec<String>, String> {
        self.file.read_to_string(&mut self.rest).map_err(|error| error.to_string())?;
        let end = self.rest.rfind('\n').map_or(0, |at| at + 1);
        let lines = self.rest[..end].lines().map(str::to_owned).collect();
        self.rest.drain(..end);
        Ok(lines)
    }
}

/// A running peer.
struct Peer {
    child: Child,
    events: Tail,
    /// The rows of its option `--record`.
    rows: Tail,
}

impl Peer {
    fn start(mut command: Command, files: &Path) -> Result<Self, String> {
        let (output, record) = (files.with_extension("json"), files.with_extension("csv"));
        let create = |path: &Path| File::create(path).map_err(|error| format!("{}: {error}", path.display()));
        create(&record)?;
        command.arg("--record").arg(&record).stdin(Stdio::null()).stdout(create(&output)?);
        let child = spawn(&mut command)?;
        Ok(Self { child, events: Tail::open(&output)?, rows: Tail::open(&record)? })
    }

    fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.child.id().cast_signed()), signal);
    }

    /// Waits for an event of that name; events before it are lost.
    fn wait_for(&mut self, name: &str, patience: Duration) -> Result<Value, String> {
        let give_up_at = Instant::now() + patience;
        loop {
            let has_ended = self.child.try_wait().map_err(|error| error.to_string())?;
            let events = self.events.lines()?.into_iter().filter_map(|line| serde_json::from_str(&line).ok());
            for event in events.collect::<Vec<Value>>() {
                if event["event"] == name {
                    return Ok(event);
                }
                if event["event"] == "error" {
                    return Err(format!("a peer failed: {}", event["message"]));
                }
            }
            if let Some(status) = has_ended {
                return Err(format!("a peer ended before its event {name}: {status}"));
            }
            if Instant::now() > give_up_at {
                return Err(format!("a peer has no event {name} within {} s", patience.as_secs()));
            }
            std::thread::sleep(POLL);
        }
    }

    /// Its new rows, whose columns are whole numbers; not the heads of the columns.
    fn new_rows(&mut self) -> Result<Vec<Vec<u64>>, String> {
        let lines = self.rows.lines()?;
        let row = |line: &String| line.split(',').map(|cell| cell.parse().ok()).collect();
        Ok(lines.iter().filter_map(row).collect())
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A burst that was sent.
pub struct Burst {
    /// The samples that the publisher's writer accepted: number, and time of the write.
    pub accepted: HashMap<u64, u64>,
    /// The number of samples that it refused.
    pub refused: u64,
}

/// A publisher and a subscriber of one topic.
pub struct Pair {
    publisher: Peer,
    subscriber: Peer,
    burst_for: Duration,
    /// The time between two samples.
    period: Duration,
}

impl Pair {
    /// Starts both in a domain, where they match each other or what is between them. `files` is the beginning
    /// of the paths of the files that they write.
    pub fn start(
        library: Library,
        case: &Case,
        plan: &Plan,
        domain: u16,
        files: &Path,
        options: &Options,
    ) -> Result<Self, String> {
        let route = Route { index: case.first_route, max_sample_bytes: plan.routes[case.first_route] };
        let program = library.program();
        // Large samples with the depth that ROS 2 has by default. At 1 kHz that would be 10 ms, which a
        // busy machine exceeds.
        let history = if case.rate_hz > 100 { "1000" } else { "10" };
        let command = |role: &str, prefix: &str, stage: usize| {
            let mut command = placed(&program, plan.place(stage, options));
            command.args(["--role", role, "--summary", "--plain", "--history", history]);
            command.args(["--topic", &format!("rt{prefix}{}", route.id()), "--type", route.dds_type()]);
            command.args(["--domain", &domain.to_string(), "--size", &case.bytes.to_string()]);
            command
        };
        let output = if plan.kind == Kind::Direct { INPUT } else { OUTPUT };
        let subscriber = command("sub", output, plan.kind.stages() - 1);
        let mut publisher = command("pub", INPUT, 0);
        publisher.args(["--hold", "--wait-match", "1", "--rate", &case.rate_hz.to_string()]);
        publisher.args(["--burst", &case.samples.to_string()]);
        let name = |role: &str| files.with_file_name(format!("{}-{role}", plan.kind.label()));
        Ok(Self {
            subscriber: Peer::start(subscriber, &name("subscriber"))?,
            publisher: Peer::start(publisher, &name("publisher"))?,
            burst_for: Duration::from_secs_f64(case.samples as f64 / case.rate_hz as f64),
            period: Duration::from_secs_f64(1.0 / case.rate_hz as f64),
        })
    }

    /// Waits until both have matched, and sends bursts until one arrives whole, as relay and bridge match a
    /// little later. Fails if not a single sample arrives.
    pub fn warm_up(&mut self) -> Result<(), String> {
        self.subscriber.wait_for("matched", PATIENCE)?;
        self.publisher.wait_for("matched", PATIENCE)?;
        let mut received = 0;
        for _ in 0..WARM_UPS {
            let burst = self.send()?;
            let records = self.receive(&burst)?;
            received += records.len();
            if records.len() == burst.accepted.len() {
                break;
            }
        }
        if received > 0 { Ok(()) } else { Err("no sample arrives".to_owned()) }
    }

    /// The process ids of both.
    pub fn pids(&self) -> [(&'static str, u32); 2] {
        [("publisher", self.publisher.child.id()), ("subscriber", self.subscriber.child.id())]
    }

    /// Sends a burst; returns a period after its last sample.
    pub fn send(&mut self) -> Result<Burst, String> {
        self.publisher.signal(Signal::SIGUSR1);
        self.publisher.wait_for("paused", self.burst_for + PATIENCE)?;
        std::thread::sleep(self.period);
        let mut burst = Burst { accepted: HashMap::new(), refused: 0 };
        for row in self.publisher.new_rows()? {
            match row[..] {
                [number, written_at, _, 1] => drop(burst.accepted.insert(number, written_at)),
                _ => burst.refused += 1,
            }
        }
        Ok(burst)
    }

    /// The received samples of a burst, in the order of their arrival. Waits until all have arrived or none
    /// has for some seconds.
    pub fn receive(&mut self, burst: &Burst) -> Result<Vec<Record>, String> {
        let mut written = burst.accepted.clone();
        let mut records = Vec::with_capacity(written.len());
        let mut last_at = Instant::now();
        while !written.is_empty() && last_at.elapsed() < REPAIR {
            for row in self.subscriber.new_rows()? {
                let &[number, arrived_at, _] = &row[..] else { continue };
                // A late sample of an earlier burst does not count, nor does a duplicate.
                let Some(written_at) = written.remove(&number) else { continue };
                records.push(Record { number, written_at, arrived_at, ..Record::default() });
                last_at = Instant::now();
            }
            if !written.is_empty() {
                std::thread::sleep(POLL);
            }
        }
        Ok(records)
    }

    /// Ends both; returns the number of samples that arrived with other bytes than were sent.
    pub fn end(mut self) -> Result<u64, String> {
        // The publisher first, which waits until its last samples are acknowledged.
        self.publisher.signal(Signal::SIGTERM);
        self.publisher.wait_for("sent", PATIENCE)?;
        self.subscriber.signal(Signal::SIGTERM);
        let summary = self.subscriber.wait_for("summary", PATIENCE)?;
        summary["bad"].as_u64().ok_or_else(|| format!("the summary of a peer has no `bad`: {summary}"))
    }
}

/// The command that runs a program on a CPU and with a scheduling policy.
fn placed(program: &Path, place: Place) -> Command {
    let mut words: Vec<String> = Vec::new();
    if let Some(cpu) = place.cpu {
        words.extend(["taskset", "--cpu-list"].map(str::to_owned));
        words.push(cpu.to_string());
    }
    if place.scheduling == Scheduling::Fifo {
        words.extend(["chrt", "--fifo"].map(str::to_owned));
        words.push(FIFO_PRIORITY.to_string());
    }
    words.push(program.display().to_string());
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]);
    command
}
