//! The test beds: direct, relay and bridge, each a set of child processes on a DDS domain of its own.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use adaptive_bridge::model::{DropCounts, DropReason, IngressCounters, LaneCounters, LatencyHistogram};
use adaptive_bridge::shm::{Boards, Stage};
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::link::{self, INPUT, OUTPUT, Record, Route};
use super::system::{self, FIFO_PRIORITY, Place, Scheduling};
use super::{Case, Options};

/// Domains of the three beds: below the ephemeral ports, and none that the tests use.
const DOMAINS: [(Kind, u16); 3] = [(Kind::Direct, 95), (Kind::Relay, 96), (Kind::Bridge, 97)];

/// The critical lane is the first one of every bridge.
const CRITICAL: usize = 0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Direct,
    Relay,
    Bridge,
}

impl Kind {
    pub const ALL: [Self; 3] = [Self::Direct, Self::Relay, Self::Bridge];

    pub const fn label(self) -> &'static str {
        match self {
            Self::Direct => "direct",
            Self::Relay => "relay",
            Self::Bridge => "bridge",
        }
    }
}

/// What one repetition of one case gave.
pub struct Run {
    pub kind: Kind,
    pub accepted: u64,
    /// Refused by the publisher's own writer.
    pub refused: u64,
    pub records: Vec<Record>,
    /// Samples whose content was not what was sent.
    pub damaged: u64,
    /// Refused by the relay's writer.
    pub relay_refused: u64,
    /// What relay or bridge, all processes together, had of the CPUs meanwhile.
    pub cpu_ns: u64,
    pub bridge: Option<BridgeRun>,
}

/// What the bridge counted meanwhile.
pub struct BridgeRun {
    pub received: u64,
    pub lost_upstream: u64,
    pub forwarded: u64,
    pub by_reference: u64,
    /// Drops by ingress and by the critical lane, by name.
    pub drops: Vec<(String, u64)>,
    /// `received = forwarded + every named drop`.
    pub whole: bool,
    /// From ingress' publishing to the lane having taken the sample.
    pub shm: LatencyHistogram,
    /// What the lane takes to hand a sample to its DDS writer.
    pub hand_over: LatencyHistogram,
}

/// A program of ours that takes orders.
struct Program {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Program {
    fn start(role: &str, domain: u16, place: Place, more: &[&str]) -> Result<Self, String> {
        let executable = std::env::current_exe().map_err(|error| error.to_string())?;
        let mut command = Command::new(executable);
        command.arg(role).arg(domain.to_string()).arg(place.to_argument()).args(more);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = spawn(&mut command)?;
        let (Some(orders), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(format!("{role} has no pipes"));
        };
        Ok(Self { child, orders, answers: BufReader::new(answers) })
    }

    fn order(&mut self, line: &str) -> Result<(), String> {
        writeln!(self.orders, "{line}").map_err(|error| format!("a program of the bench died: {error}"))
    }

    fn answer(&mut self) -> Result<String, String> {
        let mut line = String::new();
        match self.answers.read_line(&mut line) {
            Ok(0) => Err("a program of the bench ended unasked; see above".to_owned()),
            Ok(_) => Ok(line.trim_end().to_owned()),
            Err(error) => Err(error.to_string()),
        }
    }

    /// The numbers of an answer that begins with `word`.
    fn numbers(&mut self, word: &str) -> Result<Vec<u64>, String> {
        let answer = self.answer()?;
        let mut words = answer.split(' ');
        if words.next() != Some(word) {
            return Err(format!("not an answer: {answer}"));
        }
        Ok(words.filter_map(|number| number.parse().ok()).collect())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Starts a child that does not outlive this process.
fn spawn(command: &mut Command) -> Result<Child, String> {
    for variable in
        ["ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS"]
    {
        command.env_remove(variable);
    }
    // SAFETY: prctl is async-signal-safe, and nothing else is done between fork and exec.
    unsafe {
        command.pre_exec(|| set_pdeathsig(Signal::SIGKILL).map_err(std::io::Error::from));
    }
    command.spawn().map_err(|error| format!("{:?}: {error}", command.get_program()))
}

/// One of direct, relay, bridge.
pub struct Bed {
    kind: Kind,
    publisher: Program,
    subscriber: Program,
    relay: Option<Program>,
    bridge: Option<Bridge>,
    next_number: u64,
}

struct Bridge {
    processes: Vec<Child>,
    boards: Boards,
    folder: PathBuf,
}

impl Bridge {
    fn check(&mut self) -> Result<(), String> {
        for process in &mut self.processes {
            if let Ok(Some(status)) = process.try_wait() {
                return Err(format!("a process of the bridge ended unasked: {status}"));
            }
        }
        Ok(())
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        // Asked to, the last of them removes their shared memory, 250 MB of it; one that is killed can't.
        for process in &self.processes {
            let _ = kill(Pid::from_raw(process.id().cast_signed()), Signal::SIGTERM);
        }
        let give_up_at = Instant::now() + Duration::from_secs(5);
        for process in &mut self.processes {
            while matches!(process.try_wait(), Ok(None)) && Instant::now() < give_up_at {
                std::thread::sleep(Duration::from_millis(10));
            }
            let _ = process.kill();
            let _ = process.wait();
        }
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// All beds, up for the whole run.
pub struct Beds(Vec<Bed>);

impl Beds {
    pub fn start(options: &Options) -> Result<Self, String> {
        let mut beds = Vec::new();
        for (kind, domain) in DOMAINS {
            eprintln!("starting {}", kind.label());
            beds.push(Bed::start(kind, domain, options)?);
        }
        // Discovery goes on for a while after the endpoints have found each other.
        std::thread::sleep(Duration::from_secs(2));
        Ok(Self(beds))
    }

    pub fn all(&mut self) -> impl Iterator<Item = &mut Bed> {
        self.0.iter_mut()
    }
}

impl Bed {
    fn start(kind: Kind, domain: u16, options: &Options) -> Result<Self, String> {
        let stages = match kind {
            Kind::Direct => 2,
            Kind::Relay => 3,
            Kind::Bridge => 4,
        };
        let place =
            |stage| Place { cpu: options.placement.cpu(stage, stages), scheduling: options.scheduling };
        let (mut relay, mut bridge, mut config) = (None, None, None);
        match kind {
            Kind::Direct => {}
            Kind::Relay => {
                let mut program = Program::start("__relay", domain, place(1), &[])?;
                program.numbers("ready")?;
                relay = Some(program);
            }
            Kind::Bridge => {
                let (started, path) = start_bridge(domain, place(1), place(2), &options.bridge)?;
                bridge = Some(started);
                config = Some(path);
            }
        }
        let prefix = if kind == Kind::Direct { INPUT } else { OUTPUT };
        let mut more = vec![prefix];
        let path = config.map(|path| path.to_string_lossy().into_owned());
        more.extend(path.as_deref());
        let mut subscriber = Program::start("__subscriber", domain, place(stages - 1), &more)?;
        subscriber.numbers("ready")?;
        let mut publisher = Program::start("__publisher", domain, place(0), &[])?;
        publisher.numbers("ready")?;
        let mut bed = Self { kind, publisher, subscriber, relay, bridge, next_number: 0 };
        for route in Route::ALL {
            bed.warm_up(route)?;
        }
        Ok(bed)
    }

    pub fn name(&self) -> &'static str {
        self.kind.label()
    }

    /// Sends until everything arrives: the writers in the middle are matched a little later than the first
    /// one.
    fn warm_up(&mut self, route: Route) -> Result<(), String> {
        let case = Case { name: "warm-up", route, rate_hz: 50, bytes: 2_948, samples: 25 };
        for _ in 0..20 {
            let run = self.measure(&case)?;
            if run.records.len() == case.samples {
                return Ok(());
            }
        }
        Err(format!("{}: samples of {} do not arrive", self.kind.label(), route.id()))
    }

    /// CPU time of what is between publisher and subscriber so far, in nanoseconds.
    fn cpu_ns(&self) -> u64 {
        let relay = self.relay.iter().map(|relay| relay.child.id());
        let bridge = self.bridge.iter().flat_map(|bridge| bridge.processes.iter().map(Child::id));
        relay.chain(bridge).map(system::cpu_ns).sum()
    }

    pub fn measure(&mut self, case: &Case) -> Result<Run, String> {
        let route = Route::ALL.iter().position(|route| *route == case.route).unwrap_or(0);
        if let Some(bridge) = &mut self.bridge {
            bridge.check()?;
        }
        let before = self.bridge.as_ref().map(|bridge| Counted::read(&bridge.boards, route));
        self.subscriber.order("begin")?;
        std::thread::sleep(Duration::from_millis(150));
        let cpu_before_ns = self.cpu_ns();
        self.publisher.order(&format!(
            "send {} {} {} {} {}",
            case.route.id(),
            case.rate_hz,
            case.samples,
            case.bytes,
            self.next_number
        ))?;
        let sent = self.publisher.numbers("sent")?;
        let cpu_ns = self.cpu_ns().saturating_sub(cpu_before_ns);
        let [accepted, refused] = sent[..] else { return Err("the publisher does not say".to_owned()) };
        // A RELIABLE writer repairs within a heartbeat period, a second at most.
        self.subscriber.order(&format!("end {accepted} 3000"))?;
        let head = self.subscriber.numbers("samples")?;
        let [count, damaged] = head[..] else { return Err("the subscriber does not say".to_owned()) };
        let mut records = Vec::with_capacity(count as usize);
        for _ in 0..count {
            let line = self.subscriber.answer()?;
            let mut words = line.split(' ').filter_map(|word| word.parse().ok());
            let mut word = || words.next().unwrap_or(0);
            let record = Record {
                number: word(),
                due_at: word(),
                written_at: word(),
                arrived_at: word(),
                taken_at: word(),
                handed_at: word(),
            };
            // What came late from the repetition before is not of this one.
            if record.number >= self.next_number {
                records.push(record);
            }
        }
        self.next_number += case.samples as u64;
        let relay_refused = match &mut self.relay {
            Some(relay) => {
                relay.order("refused")?;
                relay.numbers("refused")?.first().copied().unwrap_or(0)
            }
            None => 0,
        };
        let bridge = match (&self.bridge, before) {
            (Some(bridge), Some(before)) => Some(Counted::read(&bridge.boards, route).since(&before)),
            _ => None,
        };
        Ok(Run { kind: self.kind, accepted, refused, records, damaged, relay_refused, cpu_ns, bridge })
    }
}

/// The shipped binary: ingress and the critical egress, each with its place.
fn start_bridge(
    domain: u16,
    ingress: Place,
    egress: Place,
    executable: &Path,
) -> Result<(Bridge, PathBuf), String> {
    let folder = std::env::temp_dir().join(format!("adaptive-bridge-bench-{}", std::process::id()));
    fs::create_dir_all(&folder).map_err(|error| error.to_string())?;
    let path = folder.join("bridge.yaml");
    fs::write(&path, configuration(domain, &folder, ingress, egress)).map_err(|error| error.to_string())?;
    let mut processes = Vec::new();
    for role in [&["ingress"][..], &["egress", "--lane", "critical"]] {
        let mut command = Command::new(executable);
        command.args(role).arg("--config").arg(&path).stdin(Stdio::null()).stdout(Stdio::null());
        if std::env::var_os("RUST_LOG").is_none() {
            command.env("RUST_LOG", "warn");
        }
        processes.push(spawn(&mut command)?);
    }
    std::thread::sleep(Duration::from_millis(500));
    let boards = link::boards(&path)?;
    Ok((Bridge { processes, boards, folder }, path))
}

fn configuration(domain: u16, folder: &Path, ingress: Place, egress: Place) -> String {
    let scheduling = |place: Place| {
        let cpus = place.cpu.map_or(String::new(), |cpu| cpu.to_string());
        let policy = match place.scheduling {
            Scheduling::Other => "policy: other, priority: 0".to_owned(),
            Scheduling::Fifo => format!("policy: fifo, priority: {FIFO_PRIORITY}"),
        };
        format!("{{{policy}, cpus: [{cpus}]}}")
    };
    let mut text = format!(
        "instance: bench\nros:\n  domain_id: {domain}\nshared_memory:\n  root_path: {}\nprocesses:\n  ingress:\n    \
         scheduling: {}\nlanes:\n  critical:\n    scheduling: {}\ntopics:\n",
        folder.display(),
        scheduling(ingress),
        scheduling(egress)
    );
    for route in Route::ALL {
        let id = route.id();
        text.push_str(&format!(
            "  - id: {id}\n    input_topic: {INPUT}{id}\n    critical_output: {OUTPUT}{id}\n    message_type: {}\n    \
             max_sample_bytes: {}\n",
            route.message_type(),
            route.max_sample_bytes()
        ));
    }
    text
}

/// The counters and latencies of one route at one instant.
struct Counted {
    ingress: IngressCounters,
    lane: LaneCounters,
    shm: LatencyHistogram,
    hand_over: LatencyHistogram,
}

impl Counted {
    fn read(boards: &Boards, route: usize) -> Self {
        Self {
            ingress: boards.ingress(route).unwrap_or_default(),
            lane: boards.lane(CRITICAL, route).unwrap_or_default(),
            shm: boards.histogram(Stage::Shm(CRITICAL), route),
            hand_over: boards.histogram(Stage::DdsOut(CRITICAL), route),
        }
    }

    fn since(&self, before: &Self) -> BridgeRun {
        let mut drops = Vec::new();
        let mut add = |process: &str, after: &DropCounts, before: &DropCounts| {
            for &reason in DropReason::ALL {
                let count = after.get(reason).saturating_sub(before.get(reason));
                if count > 0 {
                    drops.push((format!("{process} {}", reason.label()), count));
                }
            }
        };
        add("ingress", &self.ingress.drops, &before.ingress.drops);
        add("critical", &self.lane.drops, &before.lane.drops);
        BridgeRun {
            received: self.ingress.received - before.ingress.received,
            lost_upstream: self.ingress.lost_upstream - before.ingress.lost_upstream,
            forwarded: self.lane.forwarded - before.lane.forwarded,
            by_reference: self.lane.by_reference - before.lane.by_reference,
            drops,
            whole: self.lane.is_whole(),
            shm: self.shm.since(&before.shm),
            hand_over: self.hand_over.since(&before.hand_over),
        }
    }
}
