//! The test beds direct, relay and bridge: each is a set of child processes in a DDS domain of its own.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::ops::Range;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use adaptive_bridge::model::{DropCounts, DropReason};
use adaptive_bridge::shm::{Boards, ShmNode, Stage};
use adaptive_bridge_measure::hop::Loss;
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::histogram::Buckets;
use super::link::{self, INPUT, OUTPUT, Record, Route};
use super::options::{Case, Options};
use super::system::{self, FIFO_PRIORITY, Place, Scheduling};

/// The domain of the first bed. Its ports are below the ephemeral range, and the tests do not use it.
pub const FIRST_DOMAIN: u16 = 94;

/// The highest number of beds at a time, in the domains 94 to 99.
const MAX_BEDS: usize = 6;

/// The index of the critical lane, which is the first lane of every bridge.
const CRITICAL: usize = 0;

/// The nice value of noncritical processes. It gives a 46th of the CPU share of nice 0, about the ratio of
/// the CPUWeight values 1000 and 20 of the services' slices.
pub const NONCRITICAL_NICE: &str = "17";

/// The kind of a bed: what is between its publisher and its subscriber.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Direct,
    Relay,
    Bridge,
}

impl Kind {
    pub const ALL: [Self; 3] = [Self::Direct, Self::Relay, Self::Bridge];

    /// The number of processes that a sample passes.
    pub const fn stages(self) -> usize {
        match self {
            Self::Direct => 2,
            Self::Relay => 3,
            Self::Bridge => 4,
        }
    }

    pub const fn label(self) -> &'static str {
        match self {
            Self::Direct => "direct",
            Self::Relay => "relay",
            Self::Bridge => "bridge",
        }
    }
}

/// The configuration of a bed.
#[derive(Clone, Debug)]
pub struct Plan {
    pub kind: Kind,
    pub scheduling: Scheduling,
    /// The largest sample of each route.
    pub routes: Vec<usize>,
    /// The number of noncritical lanes of a bridge, each with all routes.
    pub lanes: usize,
    /// Whether the processes of these lanes run, with a subscriber.
    pub lanes_run: bool,
    /// Whether control runs.
    pub control: bool,
    /// The rate limit of the noncritical lanes.
    pub noncritical_rate_hz: u64,
    /// `queue_depth` of the critical lane; `None` for the default.
    pub queue_depth: Option<usize>,
}

impl Plan {
    /// With kind bridge: ingress and the critical lane in the default configuration; the noncritical lane
    /// does not run.
    pub fn new(kind: Kind, scheduling: Scheduling, routes: &[usize]) -> Self {
        Self {
            kind,
            scheduling,
            routes: routes.to_vec(),
            lanes: 1,
            lanes_run: false,
            control: false,
            noncritical_rate_hz: 10,
            queue_depth: None,
        }
    }

    /// A bridge with all its processes.
    pub fn whole(scheduling: Scheduling, routes: &[usize]) -> Self {
        Self { lanes_run: true, control: true, ..Self::new(Kind::Bridge, scheduling, routes) }
    }

    /// The place of a stage: 0 is the publisher, the last one the subscriber.
    pub fn place(&self, stage: usize, options: &Options) -> Place {
        let cpu = options.placement.cpu(stage, self.kind.stages());
        Place { cpu, scheduling: self.scheduling }
    }

    fn lane_names(&self) -> Vec<String> {
        (0..self.lanes)
            .map(|lane| if lane == 0 { "noncritical".to_owned() } else { format!("lane{lane}") })
            .collect()
    }
}

/// The result of one repetition of one case.
pub struct Run {
    pub kind: Kind,
    /// Samples that the publisher's writer accepted.
    pub accepted: u64,
    /// Samples that the publisher's writer refused.
    pub refused: u64,
    /// The received samples.
    pub records: Vec<Record>,
    /// Received samples whose content differs from the sent content.
    pub damaged: u64,
    /// Samples that the relay's writer refused.
    pub relay_refused: u64,
    /// The CPU time of each process between publisher and subscriber during the run.
    pub cpu_ns: BTreeMap<String, u64>,
    pub bridge: Option<BridgeRun>,
}

impl Run {
    /// The row of this run in the loss table: received, lost, disordered and damaged samples.
    pub fn loss(&self, case: &Case, scheduling: Scheduling) -> Loss {
        let mut numbers: Vec<u64> = self.records.iter().map(|record| record.number).collect();
        let disordered = numbers.windows(2).filter(|pair| pair[1] <= pair[0]).count() as u64;
        numbers.sort_unstable();
        numbers.dedup();
        let received = numbers.len() as u64;
        Loss {
            scheduling: scheduling.label().to_owned(),
            rate_hz: case.rate_hz,
            bytes: case.bytes,
            program: self.kind.label().to_owned(),
            accepted: self.accepted,
            refused: self.refused,
            received,
            lost: self.accepted.saturating_sub(received),
            disordered,
            damaged: self.damaged,
            drops: self.drops(),
            whole: self.bridge.as_ref().map(|bridge| bridge.whole),
        }
    }

    /// The number of samples that were sent and not received.
    pub fn missing(&self) -> u64 {
        (self.accepted + self.refused).saturating_sub(self.records.len() as u64)
    }

    /// The samples that relay or bridge did not forward, by process and reason.
    pub fn drops(&self) -> BTreeMap<String, u64> {
        let mut drops = BTreeMap::from([("relay window_full".to_owned(), self.relay_refused)]);
        if let Some(bridge) = &self.bridge {
            drops.extend(bridge.drops.iter().cloned());
            drops.insert("ingress lost_upstream".to_owned(), bridge.lost_upstream);
            drops.insert("critical reader_overrun".to_owned(), bridge.reader_overrun);
        }
        drops.retain(|_, count| *count > 0);
        drops
    }

    /// The known reasons of missing samples: drops, and refusals of the publisher's writer.
    pub fn reasons(&self) -> BTreeMap<String, u64> {
        let mut reasons = self.drops();
        if self.refused > 0 {
            reasons.insert("refused by the publisher's own writer".to_owned(), self.refused);
        }
        reasons
    }
}

/// Adds counts by name to `sum`.
pub fn add_up(sum: &mut BTreeMap<String, u64>, more: BTreeMap<String, u64>) {
    for (name, count) in more {
        *sum.entry(name).or_default() += count;
    }
}

/// The counters of the bridge's boards for one run.
pub struct BridgeRun {
    pub lost_upstream: u64,
    /// Forwarded samples that left the critical lane's history before the subscriber had them.
    pub reader_overrun: u64,
    pub forwarded: u64,
    /// Samples that the lane forwarded without a copy out of shared memory.
    pub by_reference: u64,
    /// Samples that ingress assembled in shared memory, without a copy into it.
    pub in_place: u64,
    /// Drops of ingress and of the critical lane, by process and reason.
    pub drops: Vec<(String, u64)>,
    /// Whether every sample is accounted for: `received = forwarded + every named drop`.
    pub whole: bool,
    /// The time from ingress publishing a sample to the lane taking it.
    pub shm: Buckets,
    /// The time that the lane needs to hand a sample to its DDS writer.
    pub hand_over: Buckets,
    /// Samples that the first noncritical lane forwarded.
    pub noncritical_forwarded: u64,
}

/// How a program ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// It leaves DDS, because its commands end.
    Normal,
    /// SIGKILL.
    Killed,
}

/// A process of this binary that reads commands from its stdin and answers on its stdout.
pub struct Program {
    child: Child,
    /// `None` once the program is to end.
    commands: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Program {
    pub fn start(role: &str, domain: u16, place: Place, more: &[&str]) -> Result<Self, String> {
        let executable = std::env::current_exe().map_err(|error| error.to_string())?;
        // Noncritical programs get the nice value of noncritical lanes.
        let mut command = program(&executable, ["__drain", "__spinner"].contains(&role));
        command.arg(role).arg(domain.to_string()).arg(place.to_argument()).args(more);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = spawn(&mut command)?;
        let (commands, Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(format!("{role} has no pipes"));
        };
        Ok(Self { child, commands, answers: BufReader::new(answers) })
    }

    /// Starts a program that uses every CPU fully until it is dropped, with the scheduling of a noncritical
    /// lane.
    pub fn spinner() -> Result<Self, String> {
        let anywhere = Place { cpu: None, scheduling: Scheduling::Other };
        let mut program = Self::start("__spinner", 0, anywhere, &[])?;
        program.numbers("ready")?;
        Ok(program)
    }

    pub fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.child.id().cast_signed()), signal);
    }

    /// Ends the program, and waits for its end.
    fn end(&mut self, ending: Ending) -> Result<(), String> {
        match ending {
            Ending::Normal => self.commands = None,
            Ending::Killed => self.signal(Signal::SIGKILL),
        }
        self.child.wait().map(drop).map_err(|error| error.to_string())
    }

    fn send(&mut self, command: &str) -> Result<(), String> {
        let commands = self.commands.as_mut().ok_or("a program of the bench has ended")?;
        writeln!(commands, "{command}").map_err(|error| format!("a program of the bench exited: {error}"))
    }

    fn answer(&mut self) -> Result<String, String> {
        let mut line = String::new();
        match self.answers.read_line(&mut line) {
            Ok(0) => Err("a program of the bench exited unexpectedly; its error is above".to_owned()),
            Ok(_) => Ok(line.trim_end().to_owned()),
            Err(error) => Err(error.to_string()),
        }
    }

    /// Reads an answer that begins with `word` and returns its numbers.
    pub fn numbers(&mut self, word: &str) -> Result<Vec<u64>, String> {
        let answer = self.answer()?;
        let mut words = answer.split(' ');
        if words.next() != Some(word) {
            return Err(format!("expected an answer that begins with {word}: {answer}"));
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

/// The command that runs an executable, with the noncritical nice value if it is noncritical.
fn program(executable: &Path, is_noncritical: bool) -> Command {
    if !is_noncritical {
        return Command::new(executable);
    }
    let mut command = Command::new("nice");
    command.args(["-n", NONCRITICAL_NICE]).arg(executable);
    command
}

/// Starts a child that the kernel kills when this process ends.
pub fn spawn(command: &mut Command) -> Result<Child, String> {
    for variable in [
        "ROS_DOMAIN_ID",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_LOCALHOST_ONLY",
        "ROS_STATIC_PEERS",
        "ADAPTIVE_BRIDGE_FIFO_PRIORITY",
    ] {
        command.env_remove(variable);
    }
    // SAFETY: prctl is async-signal-safe, and nothing else is done between fork and exec.
    unsafe {
        command.pre_exec(|| set_pdeathsig(Signal::SIGKILL).map_err(std::io::Error::from));
    }
    command.spawn().map_err(|error| format!("{:?}: {error}", command.get_program()))
}

/// What the publisher and the subscriber of a bed are started with.
struct Peers {
    domain: u16,
    routes: String,
    /// The prefix of the topics that the subscriber reads.
    prefix: &'static str,
    /// The configuration of the bridge, from whose boards the subscriber reads.
    config: Option<String>,
    publisher_place: Place,
    subscriber_place: Place,
}

impl Peers {
    fn start(&self) -> Result<(Program, Program), String> {
        let mut more = vec![self.routes.as_str(), self.prefix];
        more.extend(self.config.as_deref());
        let mut subscriber = Program::start("__subscriber", self.domain, self.subscriber_place, &more)?;
        subscriber.numbers("ready")?;
        let mut publisher =
            Program::start("__publisher", self.domain, self.publisher_place, &[&self.routes])?;
        publisher.numbers("ready")?;
        Ok((publisher, subscriber))
    }
}

/// What runs between publisher and subscriber: nothing, the relay or a bridge.
pub struct Middle {
    kind: Kind,
    relay: Option<Program>,
    pub bridge: Option<Bridge>,
}

impl Middle {
    /// Starts it in a domain.
    pub fn start(plan: &Plan, domain: u16, options: &Options) -> Result<Self, String> {
        eprintln!(
            "starting {}, {} routes, scheduling {}",
            plan.kind.label(),
            plan.routes.len(),
            plan.scheduling.label()
        );
        let mut middle = Self { kind: plan.kind, relay: None, bridge: None };
        match plan.kind {
            Kind::Direct => {}
            Kind::Relay => {
                let routes = Route::to_argument(&Route::all(&plan.routes));
                let mut program = Program::start("__relay", domain, plan.place(1, options), &[&routes])?;
                program.numbers("ready")?;
                middle.relay = Some(program);
            }
            Kind::Bridge => {
                let places = [1, 2].map(|stage| plan.place(stage, options));
                middle.bridge = Some(Bridge::start(domain, plan, places, &options.bridge)?);
            }
        }
        Ok(middle)
    }

    /// Names and process ids of its processes.
    pub fn processes(&self) -> Vec<(String, u32)> {
        let relay = self.relay.iter().map(|relay| ("relay".to_owned(), relay.child.id()));
        let bridge = self.bridge.iter().flat_map(|bridge| &bridge.processes);
        relay.chain(bridge.map(|process| (process.role.clone(), process.child.id()))).collect()
    }

    /// The CPU time of each of its processes so far.
    pub fn cpu_ns(&self) -> BTreeMap<String, u64> {
        self.processes().into_iter().map(|(name, pid)| (name, system::cpu_ns(pid))).collect()
    }

    /// The counters of some routes before a run, to pass to `finish`. Fails when a process of the bridge has
    /// ended.
    pub fn begin(&mut self, routes: &Range<usize>) -> Result<Option<Counters>, String> {
        let Some(bridge) = &mut self.bridge else { return Ok(None) };
        bridge.check()?;
        Ok(Some(Counters::read(&bridge.boards, routes.clone())))
    }

    /// The counters since `begin`, and the samples that the relay's writer has refused.
    pub fn finish(
        &mut self,
        routes: &Range<usize>,
        before: Option<Counters>,
    ) -> Result<(Option<BridgeRun>, u64), String> {
        let relay_refused = match &mut self.relay {
            Some(relay) => {
                relay.send("refused")?;
                relay.numbers("refused")?.first().copied().unwrap_or(0)
            }
            None => 0,
        };
        let bridge = match (&self.bridge, before) {
            (Some(bridge), Some(before)) => {
                Some(Counters::read(&bridge.boards, routes.clone()).since(&before))
            }
            _ => None,
        };
        Ok((bridge, relay_refused))
    }
}

/// A running bed: publisher, subscriber, and what is between them.
pub struct Bed {
    routes: usize,
    peers: Peers,
    publisher: Program,
    subscriber: Program,
    /// The subscriber of the noncritical lanes.
    _drain: Option<Program>,
    pub middle: Middle,
    next_number: u64,
}

/// A running bridge.
pub struct Bridge {
    processes: Vec<Process>,
    boards: Boards,
    _node: ShmNode,
    folder: PathBuf,
    config: PathBuf,
    executable: PathBuf,
    domain: u16,
    plan: Plan,
    places: [Place; 2],
}

/// A process of a bridge, with its role.
pub struct Process {
    pub role: String,
    pub child: Child,
}

impl Process {
    fn start(executable: &Path, role: &str, config: &Path) -> Result<Self, String> {
        let mut command = program(executable, !["ingress", "critical", "control"].contains(&role));
        match role {
            "ingress" | "control" => command.arg(role),
            lane => command.args(["egress", "--lane", lane]),
        };
        command.arg("--config").arg(config).stdin(Stdio::null()).stdout(Stdio::null());
        if std::env::var_os("RUST_LOG").is_none() {
            command.env("RUST_LOG", "error");
        }
        Ok(Self { role: role.to_owned(), child: spawn(&mut command)? })
    }

    pub fn signal(&self, signal: Signal) {
        let _ = kill(Pid::from_raw(self.child.id().cast_signed()), signal);
    }
}

impl Bridge {
    fn start(domain: u16, plan: &Plan, places: [Place; 2], executable: &Path) -> Result<Self, String> {
        let name = format!("adaptive-bridge-bench-{}-{domain}", std::process::id());
        let folder = std::env::temp_dir().join(name);
        fs::create_dir_all(&folder).map_err(|error| error.to_string())?;
        let config = folder.join("bridge.yaml");
        let text = configuration(domain, &folder, plan, places);
        fs::write(&config, text).map_err(|error| error.to_string())?;
        let mut roles = vec!["ingress".to_owned(), "critical".to_owned()];
        if plan.lanes_run {
            roles.extend(plan.lane_names());
        }
        if plan.control {
            roles.push("control".to_owned());
        }
        let mut processes = Vec::new();
        for role in roles {
            processes.push(Process::start(executable, &role, &config)?);
        }
        // Ingress creates the pools, which takes some ms for each route of some MB.
        std::thread::sleep(Duration::from_millis(700));
        let (boards, _node) = link::boards(&config)?;
        let executable = executable.to_owned();
        Ok(Self { processes, boards, _node, folder, config, executable, domain, plan: plan.clone(), places })
    }

    fn check(&mut self) -> Result<(), String> {
        for process in &mut self.processes {
            if let Ok(Some(status)) = process.child.try_wait() {
                return Err(format!("{} of the bridge exited unexpectedly: {status}", process.role));
            }
        }
        Ok(())
    }

    /// Removes the process of a role, for a caller that kills and restarts it.
    pub fn take(&mut self, role: &str) -> Option<Process> {
        let at = self.processes.iter().position(|process| process.role == role)?;
        Some(self.processes.remove(at))
    }

    /// Adds a process again that was removed with `take`.
    pub fn put_back(&mut self, process: Process) {
        self.processes.push(process);
    }

    /// A function that starts a process of a role, for another thread.
    pub fn starter(&self, role: &str) -> impl Fn() -> Result<Process, String> + Send + use<> {
        let (executable, role, config) = (self.executable.clone(), role.to_owned(), self.config.clone());
        move || Process::start(&executable, &role, &config)
    }

    pub fn signal(&self, role: &str, signal: Signal) {
        for process in self.processes.iter().filter(|process| process.role == role) {
            process.signal(signal);
        }
    }

    /// Sets the rate limit of the noncritical lanes by changing the configuration file and reloading it.
    pub fn set_noncritical_rate(&mut self, rate_hz: u64) -> Result<(), String> {
        self.plan.noncritical_rate_hz = rate_hz;
        let text = configuration(self.domain, &self.folder, &self.plan, self.places);
        fs::write(&self.config, text).map_err(|error| error.to_string())?;
        let mut command = Command::new(&self.executable);
        let output = command.arg("reload").arg("--config").arg(&self.config).output();
        let output = output.map_err(|error| error.to_string())?;
        if output.status.success() {
            return Ok(());
        }
        Err(format!("reload: {}", String::from_utf8_lossy(&output.stderr).trim()))
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        // SIGTERM first: the last process that exits removes the shared memory, up to 1 GB; a killed one
        // cannot.
        for process in &self.processes {
            process.signal(Signal::SIGCONT);
            process.signal(Signal::SIGTERM);
        }
        let give_up_at = Instant::now() + Duration::from_secs(5);
        for process in &mut self.processes {
            while matches!(process.child.try_wait(), Ok(None)) && Instant::now() < give_up_at {
                std::thread::sleep(Duration::from_millis(10));
            }
            let _ = process.child.kill();
            let _ = process.child.wait();
        }
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// Beds that run at the same time.
pub struct Beds(pub Vec<Bed>);

impl Beds {
    pub fn start(plans: &[Plan], options: &Options) -> Result<Self, String> {
        assert!(plans.len() <= MAX_BEDS, "each bed needs a domain");
        let mut beds = Vec::new();
        for (plan, domain) in plans.iter().zip(FIRST_DOMAIN..) {
            beds.push(Bed::start(plan, domain, options)?);
        }
        // Discovery traffic continues for some time after the endpoints have matched.
        std::thread::sleep(Duration::from_secs(2));
        Ok(Self(beds))
    }

    /// Starts direct, relay and bridge with these routes.
    pub fn three(scheduling: Scheduling, routes: &[usize], options: &Options) -> Result<Self, String> {
        Self::three_with_queues(None, scheduling, routes, options)
    }

    /// Starts direct, relay and bridge with a `queue_depth` of the critical lane.
    pub fn three_with_queues(
        queue_depth: Option<usize>,
        scheduling: Scheduling,
        routes: &[usize],
        options: &Options,
    ) -> Result<Self, String> {
        let plan = |kind| Plan { queue_depth, ..Plan::new(kind, scheduling, routes) };
        Self::start(&Kind::ALL.map(plan), options)
    }
}

impl Bed {
    fn start(plan: &Plan, domain: u16, options: &Options) -> Result<Self, String> {
        let kind = plan.kind;
        let all = Route::all(&plan.routes);
        let routes = Route::to_argument(&all);
        let middle = Middle::start(plan, domain, options)?;
        let config = middle.bridge.as_ref().map(|bridge| bridge.config.to_string_lossy().into_owned());
        let mut drain = None;
        if plan.lanes_run && plan.lanes > 0 {
            let prefixes: Vec<String> =
                plan.lane_names().iter().map(|lane| format!("/bench/{lane}/")).collect();
            let anywhere = Place { cpu: None, scheduling: Scheduling::Other };
            let mut program = Program::start("__drain", domain, anywhere, &[&routes, &prefixes.join(",")])?;
            program.numbers("ready")?;
            drain = Some(program);
        }
        let peers = Peers {
            domain,
            routes,
            prefix: if kind == Kind::Direct { INPUT } else { OUTPUT },
            config,
            publisher_place: plan.place(0, options),
            subscriber_place: plan.place(plan.kind.stages() - 1, options),
        };
        let (publisher, subscriber) = peers.start()?;
        let routes = all.len();
        let mut bed = Self { routes, peers, publisher, subscriber, _drain: drain, middle, next_number: 0 };
        bed.warm_up()?;
        Ok(bed)
    }

    /// Ends publisher and subscriber, and starts others.
    pub fn restart_peers(&mut self, ending: Ending) -> Result<(), String> {
        for peer in [&mut self.publisher, &mut self.subscriber] {
            peer.end(ending)?;
        }
        (self.publisher, self.subscriber) = self.peers.start()?;
        self.warm_up()
    }

    /// Starts another subscriber of the bridge's critical lane.
    pub fn second_subscriber(&self) -> Result<Program, String> {
        let bridge = self.middle.bridge.as_ref().ok_or("no bridge")?;
        let routes = Route::to_argument(&Route::all(&bridge.plan.routes));
        let config = bridge.config.to_string_lossy();
        let anywhere = Place { cpu: None, scheduling: Scheduling::Other };
        let mut subscriber =
            Program::start("__subscriber", bridge.domain, anywhere, &[&routes, OUTPUT, &config])?;
        subscriber.numbers("ready")?;
        Ok(subscriber)
    }

    pub fn name(&self) -> &'static str {
        self.kind().label()
    }

    pub fn kind(&self) -> Kind {
        self.middle.kind
    }

    /// Sends samples until a run loses none, because the writers of relay or bridge match their readers a
    /// little later than the publisher does.
    fn warm_up(&mut self) -> Result<(), String> {
        let routes = self.routes;
        let case = Case { rate_hz: 100, bytes: 64, samples: 25.max(2 * routes), first_route: 0, routes };
        for _ in 0..20 {
            let run = self.measure_with_timeout(&case, 500)?;
            if run.records.len() == case.samples {
                return Ok(());
            }
        }
        Err(format!("{}: samples do not arrive", self.name()))
    }

    /// Names and process ids of publisher, subscriber and the processes between them.
    pub fn processes(&self) -> Vec<(String, u32)> {
        let program = |name: &str, program: &Program| (name.to_owned(), program.child.id());
        let mut all = vec![program("publisher", &self.publisher), program("subscriber", &self.subscriber)];
        all.extend(self.middle.processes());
        all
    }

    /// Sends the samples of a case and returns the result.
    pub fn measure(&mut self, case: &Case) -> Result<Run, String> {
        // A RELIABLE writer retransmits within a heartbeat period, at most a second.
        self.measure_with_timeout(case, 3_000)
    }

    /// As `measure`; the subscriber stops waiting for missing samples when none has arrived for `timeout_ms`.
    pub fn measure_with_timeout(&mut self, case: &Case, timeout_ms: u64) -> Result<Run, String> {
        let routes = case.first_route..case.first_route + case.routes;
        let before = self.middle.begin(&routes)?;
        self.subscriber.send("begin")?;
        std::thread::sleep(Duration::from_millis(150));
        let cpu_before = self.middle.cpu_ns();
        self.publisher.send(&format!(
            "send {} {} {} {} {} {}",
            case.first_route, case.routes, case.rate_hz, case.samples, case.bytes, self.next_number
        ))?;
        let sent = self.publisher.numbers("sent")?;
        let earlier = |name: &String| cpu_before.get(name).copied().unwrap_or_default();
        let cpu_ns = self.middle.cpu_ns().into_iter();
        let cpu_ns = cpu_ns.map(|(name, ns)| (name.clone(), ns.saturating_sub(earlier(&name)))).collect();
        let [accepted, refused] = sent[..] else { return Err(format!("answer of the publisher: {sent:?}")) };
        self.subscriber.send(&format!("end {accepted} {timeout_ms}"))?;
        let head = self.subscriber.numbers("samples")?;
        let [count, damaged] = head[..] else { return Err(format!("answer of the subscriber: {head:?}")) };
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
            // A late sample of the previous repetition does not count.
            if record.number >= self.next_number {
                records.push(record);
            }
        }
        self.next_number += case.samples as u64;
        let (bridge, relay_refused) = self.middle.finish(&routes, before)?;
        Ok(Run { kind: self.kind(), accepted, refused, records, damaged, relay_refused, cpu_ns, bridge })
    }
}

/// The configuration file of the bridge of a plan.
fn configuration(domain: u16, folder: &Path, plan: &Plan, [ingress, egress]: [Place; 2]) -> String {
    let scheduling = |place: Place| {
        let cpus = place.cpu.map_or(String::new(), |cpu| cpu.to_string());
        let policy = match place.scheduling {
            Scheduling::Other => "policy: other, priority: 0, lock_memory: false".to_owned(),
            Scheduling::Fifo => format!("policy: fifo, priority: {FIFO_PRIORITY}, lock_memory: true"),
        };
        format!("{{{policy}, cpus: [{cpus}]}}")
    };
    let mut text = format!(
        "instance: bench\nros:\n  domain_id: {domain}\nshared_memory:\n  root_path: {}\nprocesses:\n  ingress:\n    \
         scheduling: {}\nlanes:\n  critical:\n    scheduling: {}\n",
        folder.display(),
        scheduling(ingress),
        scheduling(egress),
    );
    if let Some(depth) = plan.queue_depth {
        text.push_str(&format!("    queue_depth: {depth}\n"));
    }
    let (lanes, rate_hz) = (plan.lane_names(), plan.noncritical_rate_hz);
    for lane in &lanes {
        text.push_str(&format!("  {lane}:\n    max_rate_hz: {rate_hz}\n    degraded_rate_hz: {rate_hz}\n"));
    }
    let on = std::iter::once("critical").chain(lanes.iter().map(String::as_str)).collect::<Vec<_>>();
    text.push_str("topics:\n");
    for route in Route::all(&plan.routes) {
        let id = route.id();
        text.push_str(&format!(
            "  - id: {id}\n    input_topic: {INPUT}{id}\n    message_type: {}\n    max_sample_bytes: {}\n    \
             lanes: [{}]\n    outputs:\n      critical: {OUTPUT}{id}\n",
            route.message_type(),
            route.max_sample_bytes,
            on.join(", ")
        ));
        for lane in &lanes {
            text.push_str(&format!("      {lane}: /bench/{lane}/{id}\n"));
        }
    }
    text
}

/// The counters and latencies of some routes, read from the boards at one instant.
pub struct Counters {
    lost_upstream: u64,
    reader_overrun: u64,
    forwarded: u64,
    by_reference: u64,
    in_place: u64,
    noncritical_forwarded: u64,
    drops: BTreeMap<String, u64>,
    whole: bool,
    shm: Buckets,
    hand_over: Buckets,
}

impl Counters {
    fn read(boards: &Boards, routes: Range<usize>) -> Self {
        let mut counters = Self {
            lost_upstream: 0,
            reader_overrun: 0,
            forwarded: 0,
            by_reference: 0,
            in_place: 0,
            noncritical_forwarded: 0,
            drops: BTreeMap::new(),
            whole: true,
            shm: Buckets::default(),
            hand_over: Buckets::default(),
        };
        for route in routes {
            let ingress = boards.ingress(route).unwrap_or_default();
            let lane = boards.lane(CRITICAL, route).unwrap_or_default();
            counters.lost_upstream += ingress.lost_upstream;
            counters.reader_overrun += lane.reader_overrun;
            counters.forwarded += lane.forwarded;
            counters.by_reference += lane.by_reference;
            counters.in_place += ingress.in_place;
            counters.noncritical_forwarded += noncritical(boards, route);
            counters.whole &= lane.is_accounted_for();
            counters.shm.add(&boards.histogram(Stage::Shm(CRITICAL), route));
            counters.hand_over.add(&boards.histogram(Stage::DdsOut(CRITICAL), route));
            let mut add = |process: &str, drops: &DropCounts| {
                for &reason in DropReason::ALL {
                    *counters.drops.entry(format!("{process} {}", reason.label())).or_default() +=
                        drops.get(reason);
                }
            };
            add("ingress", &ingress.drops);
            add("critical", &lane.drops);
        }
        counters
    }

    fn since(&self, before: &Self) -> BridgeRun {
        let earlier = |name: &String| before.drops.get(name).copied().unwrap_or_default();
        let drops =
            self.drops.iter().map(|(name, count)| (name.clone(), count.saturating_sub(earlier(name))));
        BridgeRun {
            lost_upstream: self.lost_upstream - before.lost_upstream,
            reader_overrun: self.reader_overrun.saturating_sub(before.reader_overrun),
            forwarded: self.forwarded - before.forwarded,
            by_reference: self.by_reference - before.by_reference,
            in_place: self.in_place - before.in_place,
            drops: drops.filter(|(_, count)| *count > 0).collect(),
            whole: self.whole,
            shm: self.shm.since(&before.shm),
            hand_over: self.hand_over.since(&before.hand_over),
            noncritical_forwarded: self.noncritical_forwarded.saturating_sub(before.noncritical_forwarded),
        }
    }
}

/// The samples that the first noncritical lane has forwarded; 0 without one.
fn noncritical(boards: &Boards, route: usize) -> u64 {
    boards.lane(CRITICAL + 1, route).map_or(0, |lane| lane.forwarded)
}
