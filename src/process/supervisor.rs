//! `up`: runs all processes of a bridge as children of one supervisor, for a terminal or a container.
//!
//! On a robot, systemd supervises the processes. Here the supervisor restarts a child that dies, with a
//! backoff, and prints each line of a child's log with the child's name before it. No child outlives the
//! supervisor: each asks the kernel for SIGTERM when its parent dies, whatever the parent dies of.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, ErrorKind, Read};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, getppid};
use signal_hook::consts::SIGCHLD;
use tracing::{error, info, warn};

use super::in_force::{FOLDER_VARIABLE, InForce};
use super::notify::{Notifier, write_list};
use super::reload::{HangUp, HangUpMeaning, with_hang_up_blocked};
use super::socket_store::{self, SocketStore};
use super::standby::NO_WATCHDOG_VARIABLE;
use super::stop::Stop;
use crate::clock;
use crate::config::{Configuration, Settings, Standby};
use crate::model::{MonotonicNs, TrafficClass};
use crate::policy::{ChildExit, GiveUpReason, HangWatch, RestartBackoff, RestartDecision};
use crate::shm::{RoleLock, ShmError, root_of};
use crate::telemetry::{ProcessReading, Snapshot, Starvation, flush_logs, write_log_line};

/// Interval at which the supervisor checks for requests, and its children if no signal tells that one ended.
const POLL_MS: u64 = 20;

/// The program of this process, also if its file was replaced since.
const OWN_PROGRAM: &str = "/proc/self/exe";

/// Interval of reading the boards, for the progress of the children and the service manager.
const READ_BOARDS_MS: u64 = 250;

/// How long ingress or a critical lane, and how long another child, may make no progress before it is killed
/// and restarted. The service units have the same as `WatchdogSec`.
const HANG_CRITICAL_MS: u64 = 2_000;
const HANG_MS: u64 = 5_000;

/// How long a child that has a standby is not restarted: its start would take CPU time from the take-over,
/// which takes some 10 ms.
const TAKE_OVER_MS: u64 = 200;

const fn hang_ms(class: TrafficClass) -> u64 {
    match class {
        TrafficClass::Critical => HANG_CRITICAL_MS,
        TrafficClass::Noncritical => HANG_MS,
    }
}

/// How long a child may take to complete its first turn before it is killed and restarted. The service units
/// have the same as `TimeoutStartSec`.
const START_MS: u64 = 30_000;

/// How long a child may take to end after SIGTERM; then it is killed, and `up` fails. A process ends within a
/// second of a request to stop, unless it has many endpoints to remove on a loaded machine. Less than the 5 s
/// that the service units give (`TimeoutStopSec`), and than the 10 s of Docker.
const GRACE_MS: u64 = 4_500;

/// Environment variable that `up` sets for its children, to its own process id.
const SUPERVISOR_VARIABLE: &str = "ADAPTIVE_BRIDGE_SUPERVISOR";

/// Why `up` had to end.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// A child could not be started.
    #[error("cannot start {name}: {error}")]
    Start {
        /// Its name.
        name: String,
        /// The operating system's error.
        error: io::Error,
    },
    /// Every child has failed in a way that a restart does not cure.
    #[error("no process of the bridge can be restarted; see the log above for the reason of each")]
    AllGaveUp,
    /// Children did not end in time after SIGTERM and were killed.
    #[error("these processes did not end within {GRACE_MS} ms of SIGTERM and were killed: {}", names.join(", "))]
    Killed {
        /// Their names.
        names: Vec<String>,
    },
    /// The bridge runs already, or the folder of the instance cannot be used.
    #[error(transparent)]
    Shm(#[from] ShmError),
}

/// Makes this process end when `up` ends, if `up` started it. To be called before anything else.
pub fn end_with_supervisor() {
    let Some(supervisor) = std::env::var(SUPERVISOR_VARIABLE).ok().and_then(|pid| pid.parse().ok()) else {
        return;
    };
    if let Err(error) = set_pdeathsig(Signal::SIGTERM) {
        warn!(%error, "this process may outlive its supervisor");
    }
    // The supervisor may have died before the call above.
    if getppid() != Pid::from_raw(supervisor) {
        error!("the supervisor has already ended");
        flush_logs();
        std::process::exit(1);
    }
}

/// Puts `configuration`, which was read from `file`, in force, and runs ingress, every lane and control as
/// children until `stop` is requested. Each child gets `arguments` (such as the configuration file) after its
/// own. The supervisor forwards a SIGHUP to its children, each of which validates the file before it applies
/// any change. With `watchdog` it restarts children that make no progress. Lanes that were added to the file
/// after the start are not started.
///
/// # Errors
/// The bridge runs already, the first start of a child failed, or all children gave up.
pub fn up(
    configuration: Configuration,
    file: &Path,
    arguments: &[OsString],
    watchdog: bool,
    hang_up: &HangUp,
    stop: &Stop,
) -> Result<(), SupervisorError> {
    let in_force = InForce::begin(file, configuration)?;
    let settings = &in_force.configuration().settings;
    let root = root_of(settings);
    // The lock file tells another `up` the process id of this one.
    let _lock = RoleLock::acquire(&root, &settings.instance, "up")?;
    let folder = root.join(settings.instance.as_str());
    let mut children = Vec::new();
    let mut add = |role: &str, own: &[&str], class: TrafficClass, standby: Standby| {
        let second = (standby == Standby::Warm).then(|| format!("{role}-2"));
        for name in [Some(role.to_owned()), second].into_iter().flatten() {
            let mut child = Supervised::new(&name, own, arguments, &folder, hang_ms(class));
            if class == TrafficClass::Critical {
                child = child.keep_sockets();
            }
            if standby == Standby::Warm {
                child.role = role.to_owned();
                child.backoff = RestartBackoff::with_standby(clock::monotonic());
            }
            children.push(child);
        }
    };
    add("ingress", &["ingress"], TrafficClass::Critical, settings.ingress_standby);
    for lane in settings.lanes.iter().filter(|lane| lane.is_used()) {
        let own = ["egress", "--lane", lane.name.as_str()];
        add(&format!("egress-{}", lane.name), &own, lane.class(), lane.standby);
    }
    children.push(Supervised::new("control", &["control"], arguments, &folder, HANG_MS));
    children.iter_mut().for_each(|child| child.watchdog = watchdog);
    let mut child_ends = ChildEnds::watch();
    let mut outcome = Ok(());
    for child in &mut children {
        if let Err(error) = child.start() {
            outcome = Err(SupervisorError::Start { name: child.name.clone(), error });
            break;
        }
    }
    let mut report = ManagerReport::new(settings, watchdog);
    while outcome.is_ok() && !stop.is_requested() {
        child_ends.wait();
        match hang_up.take() {
            Some(HangUpMeaning::Reload) => {
                info!("reload: SIGHUP sent to every child");
                children.iter().for_each(|child| child.signal(&[Signal::SIGHUP]));
            }
            Some(HangUpMeaning::Stop) => {
                info!("the terminal was closed; stopping");
                break;
            }
            None => {}
        }
        let now = clock::monotonic();
        for index in 0..children.len() {
            let role = &children[index].role;
            let of_role = children.iter().filter(|child| child.role == *role && child.process.is_some());
            let has_standby = of_role.count() > 1;
            children[index].poll(has_standby, now);
        }
        report.send(&mut children, now);
        if children.iter().all(|child| child.state == State::GaveUp) {
            outcome = Err(SupervisorError::AllGaveUp);
        }
    }
    report.notifier.stopping();
    let killed = stop_all(&mut children);
    if killed.is_empty() { outcome } else { outcome.and(Err(SupervisorError::Killed { names: killed })) }
}

/// Wakes the supervisor when a child ends.
struct ChildEnds(Option<UnixStream>);

impl ChildEnds {
    /// Without the signal, or if it can't be read, the supervisor notices the end at its next check.
    fn watch() -> Self {
        let watch = || -> io::Result<UnixStream> {
            let (woken, waker) = UnixStream::pair()?;
            woken.set_read_timeout(Some(Duration::from_millis(POLL_MS)))?;
            signal_hook::low_level::pipe::register(SIGCHLD, waker)?;
            Ok(woken)
        };
        Self(watch().inspect_err(|error| warn!(%error, "cannot wait for the end of a child process")).ok())
    }

    /// Waits until a child ends, for [`POLL_MS`] at most.
    fn wait(&mut self) {
        let woken = self.0.as_mut().is_some_and(|woken| match woken.read(&mut [0; 64]) {
            Ok(bytes) => bytes > 0,
            Err(error) => matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
        });
        if !woken {
            #[allow(clippy::disallowed_methods, reason = "the supervisor handles no samples")]
            std::thread::sleep(Duration::from_millis(POLL_MS));
        }
    }
}

/// Reads the boards: kills children that hang, and reports the state of all children to the service
/// manager of `up`, where there is one.
struct ManagerReport<'a> {
    settings: &'a Settings,
    /// Whether to kill children that hang.
    watchdog: bool,
    notifier: Notifier,
    read_at: MonotonicNs,
    last: Option<Snapshot>,
}

impl<'a> ManagerReport<'a> {
    fn new(settings: &'a Settings, watchdog: bool) -> Self {
        Self { settings, watchdog, notifier: Notifier::new(), read_at: MonotonicNs(0), last: None }
    }

    /// Kills children that hang, feeds the watchdog, reports readiness, and sends the status line. `up` is
    /// ready when each child has completed a turn, which is when the child itself is ready. As `up` has no
    /// data path, its watchdog shows that it checks its children; the caller has just done so.
    fn send(&mut self, children: &mut [Supervised], now: MonotonicNs) {
        self.notifier.feed_watchdog(now);
        if now < self.read_at {
            return;
        }
        self.read_at = now.plus_ms(READ_BOARDS_MS);
        let next = match Snapshot::take(&root_of(self.settings), self.settings) {
            Ok(Some(next)) => next,
            // The children have not created the boards yet.
            Ok(None) => {
                if self.watchdog {
                    children.iter_mut().for_each(|child| child.check_start(now));
                }
                return;
            }
            // The boards are of another configuration.
            Err(ShmError::Incompatible { .. }) => return,
            Err(error) => {
                warn!(%error, "cannot read the boards of the bridge");
                return;
            }
        };
        let mut turned = 0;
        for child in &mut *children {
            let reading = next.processes.iter().find(|reading| reading.name == child.role);
            let alive_at = reading.and_then(|ProcessReading { health, standby, .. }| {
                // An active child that has not completed its first turn is still starting.
                if health.turns > 0 && Some(health.pid) == child.pid() {
                    return Some(health.alive_at);
                }
                (Some(standby.pid) == child.pid()).then_some(standby.alive_at)
            });
            turned += usize::from(alive_at.is_some());
            match alive_at {
                _ if !self.watchdog => {}
                Some(alive_at) => child.check_progress(alive_at, now),
                None => child.check_start(now),
            }
        }
        if !self.notifier.is_enabled {
            return;
        }
        if turned == children.len() {
            self.notifier.ready();
        }
        let report = next.report_since(self.last.as_ref().unwrap_or(&next));
        self.notifier.status(now, |line| {
            let running = children.iter().filter(|child| child.state == State::Running).count();
            *line += &format!("{running} of {} processes; in", children.len());
            let rate = |hz: Option<f64>| hz.unwrap_or_default();
            let routes = report.routes.iter();
            write_list(line, "", routes.map(|route| format!("{} {:.1}/s", route.id, rate(route.rate_hz))));
            let lanes = report.lanes.iter().map(|lane| {
                let outputs = report.routes.iter().flat_map(|route| &route.lanes);
                let of_lane = outputs.filter(|output| output.lane == lane.name);
                let per_s: f64 = of_lane.map(|output| rate(output.rate_hz)).sum();
                format!("{} ({}) {per_s:.1}/s", lane.name, lane.mode)
            });
            write_list(line, "; out", lanes);
        });
        self.last = Some(next);
    }
}

/// Sends SIGTERM, waits for `GRACE_MS`, kills the children that still run, and returns their names.
fn stop_all(children: &mut [Supervised]) -> Vec<String> {
    let mut killed = Vec::new();
    for child in children.iter() {
        // Continues a child in SIGSTOP, so that it handles the SIGTERM.
        child.signal(&[Signal::SIGTERM, Signal::SIGCONT]);
    }
    let deadline = clock::monotonic().plus_ms(GRACE_MS);
    while children.iter_mut().any(|child| !child.has_ended()) {
        if clock::monotonic() >= deadline {
            // The condition of the loop has not asked those after the first one that runs.
            for child in children.iter_mut() {
                if child.has_ended() {
                    continue;
                }
                warn!(child = child.name, "did not end in time after SIGTERM; killed");
                killed.push(child.name.clone());
                child.signal(&[Signal::SIGKILL]);
                // A process cannot block SIGKILL, not even in SIGSTOP, so this wait is short.
                if let Some(mut process) = child.process.take() {
                    let _ = process.wait();
                }
            }
            break;
        }
        #[allow(clippy::disallowed_methods, reason = "the supervisor handles no samples")]
        std::thread::sleep(Duration::from_millis(5));
    }
    killed
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Running,
    RestartAt(MonotonicNs),
    GaveUp,
}

/// A child process, with its command line and its restarts.
struct Supervised {
    /// The name of its role, and a number if it is the second process of the role.
    name: String,
    role: String,
    arguments: Vec<OsString>,
    folder: PathBuf,
    process: Option<Child>,
    backoff: RestartBackoff,
    state: State,
    /// Whether it is killed when it makes no progress.
    watchdog: bool,
    /// How long it may make no progress.
    hang_ms: u64,
    hang_watch: HangWatch,
    start_watch: HangWatch,
    starvation: Starvation,
    /// The sockets that its next process inherits.
    sockets: Option<SocketStore>,
}

impl Supervised {
    fn new(name: &str, own: &[&str], common: &[OsString], folder: &Path, hang_ms: u64) -> Self {
        let now = clock::monotonic();
        let mut arguments: Vec<OsString> = own.iter().map(OsString::from).collect();
        arguments.extend_from_slice(common);
        Self {
            name: name.to_owned(),
            role: name.to_owned(),
            arguments,
            folder: folder.to_owned(),
            process: None,
            backoff: RestartBackoff::new(now),
            state: State::Running,
            watchdog: true,
            hang_ms,
            hang_watch: HangWatch::new(hang_ms, now),
            start_watch: HangWatch::new(START_MS, now),
            starvation: Starvation::new(READ_BOARDS_MS),
            sockets: None,
        }
    }

    /// Keeps the sockets that the child stores, for its next process.
    fn keep_sockets(mut self) -> Self {
        let opened = SocketStore::open();
        let warn = |error: &io::Error| warn!(child = self.name, %error, "cannot keep sockets of this child");
        self.sockets = opened.inspect_err(warn).ok();
        self
    }

    fn start(&mut self) -> io::Result<()> {
        let program = std::env::current_exe()?;
        // The file may have been replaced since `up` was started, as by an upgrade. Another version may not
        // share the boards with the children that run.
        let identity = |path: &Path| path.metadata().map(|file| (file.dev(), file.ino())).ok();
        let is_same = identity(&program) == identity(Path::new(OWN_PROGRAM));
        let mut command = Command::new(if is_same { &program } else { Path::new(OWN_PROGRAM) });
        // A copy of the program may have the name of an executable of the original package.
        command.arg0(program.with_file_name("adaptive-bridge"));
        if !self.watchdog {
            command.env(NO_WATCHDOG_VARIABLE, "1");
        }
        command.args(&self.arguments).env(SUPERVISOR_VARIABLE, std::process::id().to_string());
        command.env(FOLDER_VARIABLE, &self.folder);
        // The service manager supervises this process only.
        for variable in ["WATCHDOG_PID", "WATCHDOG_USEC"] {
            command.env_remove(variable);
        }
        command.stdin(Stdio::null()).stderr(Stdio::piped());
        let mut process = with_hang_up_blocked(|| socket_store::spawn(&mut command, self.sockets.as_ref()))?;
        if let Some(log) = process.stderr.take() {
            let name = self.name.clone();
            std::thread::spawn(move || forward_log(&name, log));
        }
        info!(child = self.name, pid = process.id(), "started");
        self.process = Some(process);
        self.state = State::Running;
        let now = clock::monotonic();
        self.hang_watch = HangWatch::new(self.hang_ms, now);
        self.start_watch = HangWatch::new(START_MS, now);
        self.starvation = Starvation::new(READ_BOARDS_MS);
        Ok(())
    }

    fn pid(&self) -> Option<u64> {
        self.process.as_ref().map(|process| u64::from(process.id()))
    }

    /// Notices the end of the child, and restarts it when its backoff is over; with a standby, not before
    /// that has taken the role over.
    fn poll(&mut self, has_standby: bool, now: MonotonicNs) {
        if self.state == State::Running {
            let ended = self.process.as_mut().map(Child::try_wait);
            // After the line above, so that a socket that the child stored just before its end is kept.
            if let Some(sockets) = &mut self.sockets {
                sockets.receive();
            }
            match ended {
                Some(Ok(Some(status))) => {
                    self.process = None;
                    let exit = exit_of(status);
                    warn!(child = self.name, ?exit, "ended unexpectedly");
                    self.ended(exit, now);
                    if has_standby && let State::RestartAt(at) = &mut self.state {
                        *at = MonotonicNs(at.0.max(now.plus_ms(TAKE_OVER_MS).0));
                    }
                }
                Some(Err(error)) => {
                    error!(child = self.name, %error, "cannot read the state of the child process");
                }
                Some(Ok(None)) | None => {}
            }
        }
        if let State::RestartAt(at) = self.state
            && now >= at
        {
            self.backoff.started(now);
            if let Err(error) = self.start() {
                error!(child = self.name, %error, "restart failed");
                // Counts as a child that fails at once.
                self.ended(ChildExit::Code(1), now);
            }
        }
    }

    /// Kills the child if it has made no progress since `alive_at` for too long; `poll` then restarts it.
    fn check_progress(&mut self, alive_at: MonotonicNs, now: MonotonicNs) {
        let starved = self.hang_watch.is_stalled(alive_at) && self.is_starved(now);
        if self.hang_watch.has_hung(alive_at, starved, now) {
            error!(child = self.name, "no progress for {} ms; killed, to be restarted", self.hang_ms);
            self.signal(&[Signal::SIGKILL]);
        }
    }

    /// Whether other programs keep the child from making progress.
    fn is_starved(&mut self, now: MonotonicNs) -> bool {
        self.pid().is_some_and(|pid| self.starvation.check(pid, now))
    }

    /// Kills the child if it runs and has not completed its first turn for too long.
    fn check_start(&mut self, now: MonotonicNs) {
        let starved = self.is_starved(now);
        // Progress at 0: the child has made none at all.
        if self.state == State::Running && self.start_watch.has_hung(MonotonicNs(0), starved, now) {
            error!(child = self.name, "no first turn within {START_MS} ms; killed, to be restarted");
            self.signal(&[Signal::SIGKILL]);
        }
    }

    fn ended(&mut self, exit: ChildExit, now: MonotonicNs) {
        self.state = match self.backoff.ended(exit, now) {
            RestartDecision::RestartAt(at) => State::RestartAt(at),
            RestartDecision::GiveUp(reason) => {
                let why = match reason {
                    GiveUpReason::WrongCommandLine => "its command line is wrong",
                    GiveUpReason::BadConfiguration => "the configuration is bad",
                };
                error!(child = self.name, "not restarted: {why}");
                State::GaveUp
            }
        };
        // After an orderly end the next process is another participant; without a restart there is none.
        if let Some(sockets) = &mut self.sockets
            && (exit == ChildExit::Code(0) || self.state == State::GaveUp)
        {
            sockets.close();
        }
    }

    /// Sends the signals. A child in SIGSTOP handles them when it is continued; SIGKILL ends it at once.
    fn signal(&self, signals: &[Signal]) {
        if let Some(process) = &self.process
            && let Ok(pid) = i32::try_from(process.id())
        {
            for &signal in signals {
                let _ = kill(Pid::from_raw(pid), signal);
            }
        }
    }

    fn has_ended(&mut self) -> bool {
        self.process.take_if(|process| !matches!(process.try_wait(), Ok(None)));
        self.process.is_none()
    }
}

fn exit_of(status: ExitStatus) -> ChildExit {
    let by_signal = || status.signal().map(ChildExit::Signal);
    status.code().map(ChildExit::Code).or_else(by_signal).unwrap_or(ChildExit::Code(1))
}

/// Copies each line of a child's log to this process's log, with the child's name before it. Each line is one
/// write, so that lines of several children do not mix.
fn forward_log(name: &str, log: impl io::Read) {
    for line in BufReader::new(log).split(b'\n').map_while(Result::ok) {
        let line = [format!("[{name}] ").as_bytes(), &line, b"\n"].concat();
        // A closed stderr leaves no place to report the failure.
        let _ = write_log_line(&line);
    }
}
