//! Reload: on SIGHUP a role reads its configuration file again and takes over what it can.
//!
//! A thread of its own waits for the signal, reads and checks the file, and finds out what differs: the data
//! path goes on meanwhile. Housekeeping picks up the outcome. What came of it is in the log, on the health
//! board, and in a note beside the role's lock, from which `adaptive-bridge reload` reads it.

use std::fmt;
use std::fs;
use std::io::{self, ErrorKind, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::time::Duration;

use nix::sys::signal::{SigSet, Signal, kill, raise};
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};
use signal_hook::consts::SIGHUP;
use signal_hook::iterator::Signals;
use tracing::{error, info, warn};

use super::in_force::InForce;
use super::notify;
use crate::clock;
use crate::config::{ConfigError, Configuration, Reload, Settings};
use crate::model::{InstanceName, MonotonicNs};
use crate::shm::{InForceFile, InForceShare, RoleHolder, ShmError};
use crate::telemetry;

type Load = Box<dyn FnMut() -> Result<Configuration, ConfigError> + Send>;

/// Requests to reload. To be made before anything else that a role does: without it, SIGHUP ends a process.
#[derive(Default)]
pub struct ReloadRequests {
    request: Option<Request>,
    in_force: Option<InForce>,
}

struct Request {
    signals: Signals,
    load: Load,
    terminal: Terminal,
}

impl ReloadRequests {
    /// The requests that SIGHUP makes from now on. `load` reads the configuration as it was read at the
    /// start: the same file, the same environment.
    ///
    /// # Errors
    /// The operating system refused the signal handler.
    pub fn on_signal(
        load: impl FnMut() -> Result<Configuration, ConfigError> + Send + 'static,
    ) -> io::Result<Self> {
        let signals = Signals::new([SIGHUP])?;
        unblock()?;
        let request = Request { signals, load: Box::new(load), terminal: Terminal::look() };
        Ok(Self { request: Some(request), in_force: None })
    }

    /// These requests, for a process that applies `in_force` and keeps there what it reloads.
    pub fn kept_in(self, in_force: InForce) -> Self {
        Self { in_force: Some(in_force), ..self }
    }

    /// No requests, whatever happens.
    pub fn never() -> Self {
        Self::default()
    }
}

impl fmt::Debug for ReloadRequests {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("ReloadRequests").field(&self.request.is_some()).finish()
    }
}

/// SIGHUP for a supervisor, which passes it on. To be made before anything else, as [`ReloadRequests`].
#[derive(Debug)]
pub struct HangUp {
    came: Arc<AtomicBool>,
    terminal: Terminal,
}

/// What a [`HangUp`] means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HangUpMeaning {
    /// The file is to be read again.
    Reload,
    /// The terminal is gone, and with it the one who would stop us.
    Stop,
}

impl HangUp {
    /// SIGHUP from now on.
    ///
    /// # Errors
    /// The operating system refused the signal handler.
    pub fn on_signal() -> io::Result<Self> {
        let came = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGHUP, Arc::clone(&came))?;
        unblock()?;
        Ok(Self { came, terminal: Terminal::look() })
    }

    /// What came since the last look.
    pub(super) fn take(&self) -> Option<HangUpMeaning> {
        self.came.swap(false, Ordering::AcqRel).then(|| match self.terminal.is_gone() {
            true => HangUpMeaning::Stop,
            false => HangUpMeaning::Reload,
        })
    }
}

/// A supervisor starts its children with SIGHUP blocked ([`with_hang_up_blocked`]): one that comes before the
/// handler is there waits until now.
fn unblock() -> io::Result<()> {
    Ok(SigSet::from(Signal::SIGHUP).thread_unblock()?)
}

/// Starts a child that takes SIGHUP itself: the signal does not end it before it has its handler.
pub(super) fn with_hang_up_blocked<T>(start: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
    let signal = SigSet::from(Signal::SIGHUP);
    signal.thread_block()?;
    let started = start();
    signal.thread_unblock()?;
    started
}

/// Whether the log went to a terminal at the start. SIGHUP is also what the kernel sends when that is closed.
#[derive(Clone, Copy, Debug)]
struct Terminal(bool);

impl Terminal {
    fn look() -> Self {
        Self(io::stderr().is_terminal())
    }

    fn is_gone(self) -> bool {
        self.0 && !io::stderr().is_terminal()
    }
}

/// The configuration that a role has in force.
pub(super) struct Reloads {
    in_force: Configuration,
    fingerprint: u64,
    refused: u64,
    outcomes: Option<Receiver<Outcome>>,
    /// Keeps the configuration in force for the processes that start while this one runs.
    _share: Option<InForceShare>,
}

/// What came of one request.
enum Outcome {
    Accepted(Box<Configuration>),
    Refused,
}

/// What [`Reloads::look`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Look {
    /// No request, or none that has been dealt with yet.
    Nothing,
    /// The file is good. The configuration in force is a new one, maybe an equal one; what it refers to, such
    /// as the file of a secret, is to be read again.
    Reloaded,
    /// The file is bad, and nothing has changed.
    Refused,
}

impl Reloads {
    /// Begins to serve the requests. The thread has the scheduling of the one that calls this. `note` is
    /// where each outcome is left.
    pub fn start(requests: ReloadRequests, settings: &Settings, note: Option<PathBuf>) -> io::Result<Self> {
        let (in_force, share) = match requests.in_force.map(InForce::into_parts) {
            Some((configuration, share)) => (configuration, Some(share)),
            None => (settings.clone().into(), None),
        };
        let file = share.as_ref().map(InForceShare::file);
        let outcomes = requests.request.map(|request| {
            // Without room: it is handed over only when housekeeping takes it, and then the note says so.
            let (sender, outcomes) = sync_channel(0);
            let server = Server { present: in_force.clone(), file };
            std::thread::Builder::new()
                .name("reload".to_owned())
                .spawn(move || serve(request, server, &sender, note.as_deref()))
                .map(|_| outcomes)
        });
        let fingerprint = in_force.settings.fingerprint();
        Ok(Self { in_force, fingerprint, refused: 0, outcomes: outcomes.transpose()?, _share: share })
    }

    /// The configuration in force.
    pub fn configuration(&self) -> &Configuration {
        &self.in_force
    }

    /// Tells the settings in force from others.
    pub fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// Requests that were refused.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Takes what has come of a request. Never waits, and allocates nothing while there is none.
    pub fn look(&mut self) -> Look {
        match self.outcomes.as_ref().map(Receiver::try_recv) {
            None | Some(Err(TryRecvError::Empty)) => Look::Nothing,
            Some(Err(TryRecvError::Disconnected)) => {
                error!("reloading has ended; SIGHUP does nothing until this process is restarted");
                self.outcomes = None;
                Look::Nothing
            }
            Some(Ok(Outcome::Refused)) => {
                self.refused += 1;
                Look::Refused
            }
            Some(Ok(Outcome::Accepted(configuration))) => {
                self.fingerprint = configuration.settings.fingerprint();
                self.in_force = *configuration;
                Look::Reloaded
            }
        }
    }
}

/// What the reloading thread knows.
struct Server {
    /// The configuration that this process has in force.
    present: Configuration,
    /// Where the configuration in force of the bridge is kept.
    file: Option<InForceFile>,
}

impl Server {
    /// Puts into force what can be taken over from `new`, and keeps it for the processes that start later.
    fn reload(&mut self, new: Configuration) -> Reload {
        // Another process may have kept a reload already that this one has not seen.
        let kept = self.file.as_ref().and_then(|file| file.read().ok()?);
        let kept = kept.and_then(|bytes| Configuration::decode(&bytes).ok());
        let (bridge, Reload { waits, .. }) = kept.as_ref().unwrap_or(&self.present).reloaded(new);
        if kept.as_ref() != Some(&bridge) {
            self.keep(&bridge);
        }
        let (present, Reload { changed, .. }) = self.present.reloaded(bridge);
        self.present = present;
        Reload { changed, waits }
    }

    fn keep(&self, configuration: &Configuration) {
        let Some(file) = &self.file else { return };
        let encoded = configuration.encode().map_err(io::Error::from);
        match encoded.and_then(|bytes| file.write(&bytes)) {
            // The bridge is being taken down, and its folder is gone.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => error!(%error, "the reload is not kept: a process that restarts does not apply it"),
            Ok(()) => {}
        }
    }
}

/// Answers one request after the other, as long as the role is there to take the outcomes. Requests that come
/// while one is dealt with are one more.
fn serve(
    Request { mut signals, mut load, terminal }: Request,
    mut server: Server,
    outcomes: &SyncSender<Outcome>,
    note: Option<&Path>,
) {
    for _ in signals.forever() {
        if terminal.is_gone() {
            info!("the terminal is gone");
            // As Ctrl-C would have.
            let _ = raise(Signal::SIGTERM);
            return;
        }
        notify::reloading();
        let began_at = clock::monotonic();
        let (outcome, result) = match load() {
            Ok(new) => {
                let file_fingerprint = new.settings.fingerprint();
                let reload = server.reload(new);
                telemetry::set_verbosity(server.present.settings.diagnostics.verbosity);
                log(&reload);
                let outcome = Outcome::Accepted(Box::new(server.present.clone()));
                (outcome, ReloadResult::Accepted { file_fingerprint, reload })
            }
            Err(error) => {
                error!("the configuration file is bad, and nothing is changed:\n{error}");
                (Outcome::Refused, ReloadResult::Refused { problems: error.to_string() })
            }
        };
        if outcomes.send(outcome).is_err() {
            return;
        }
        if let Some(path) = note {
            let note = ReloadNote { pid: std::process::id(), began_at_ns: began_at.0, result };
            if let Err(error) = note.write(path) {
                warn!(path = %path.display(), %error, "what came of the reload is not noted");
            }
        }
    }
}

fn log(reload: &Reload) {
    for change in &reload.changed {
        info!("reloaded: {change}");
    }
    for change in &reload.waits {
        warn!("waits for a restart of the whole bridge: {change}");
    }
    if *reload == Reload::default() {
        info!("reloaded: nothing differs");
    }
}

/// What a role says of its last reload.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct ReloadNote {
    pid: u32,
    began_at_ns: u64,
    result: ReloadResult,
}

/// What came of a reload.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum ReloadResult {
    /// The file was good, and what could be taken over is in force.
    Accepted {
        /// The fingerprint of what the file says, which is that of the settings in force unless something
        /// waits for a restart of the whole bridge.
        file_fingerprint: u64,
        /// What changed, and what did not.
        reload: Reload,
    },
    /// The file was bad, and nothing has changed.
    Refused {
        /// Its problems, a line each.
        problems: String,
    },
}

impl ReloadNote {
    /// The note in that file, if it is about a reload that the process `pid` began at `since` or later.
    fn read(path: &Path, pid: u32, since: MonotonicNs) -> Option<Self> {
        let note: Self = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
        (note.pid == pid && note.began_at_ns >= since.0).then_some(note)
    }

    /// Puts it there in one step, so that nobody reads half a note.
    fn write(&self, path: &Path) -> io::Result<()> {
        let unfinished = path.with_extension("reload-new");
        fs::write(&unfinished, serde_json::to_vec(self)?)?;
        match fs::rename(&unfinished, path) {
            // The bridge is being taken down, and its folder is gone.
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
            outcome => outcome,
        }
    }
}

/// How long [`reload_all`] waits for answers. A role looks ten times a second, and a file is read within
/// milliseconds.
const PATIENCE_MS: u64 = 5_000;

/// One process that was asked to reload.
#[derive(Clone, Debug)]
pub struct ReloadAnswer {
    /// `ingress`, `egress-critical`, …
    pub role: String,
    /// Its process id.
    pub pid: u32,
    /// What came of it; `None` when it did not answer within 5 s, or ended.
    pub result: Option<ReloadResult>,
}

/// Asks every process of the bridge to reload, and waits for the answers; none when the bridge does not run.
/// `root` is the folder of its shared files.
///
/// # Errors
/// It cannot be found out who they are.
pub fn reload_all(root: &Path, instance: &InstanceName) -> Result<Vec<ReloadAnswer>, ShmError> {
    let asked_at = clock::monotonic();
    let holders = RoleHolder::all(root, instance)?;
    let mut answers = Vec::with_capacity(holders.len());
    for RoleHolder { role, pid, .. } in &holders {
        match i32::try_from(*pid).map(|pid| kill(Pid::from_raw(pid), Signal::SIGHUP)) {
            Ok(Ok(())) => {}
            refused => warn!(role, pid, ?refused, "cannot be signalled"),
        }
        answers.push(ReloadAnswer { role: role.clone(), pid: *pid, result: None });
    }
    let give_up_at = asked_at.plus_ms(PATIENCE_MS);
    loop {
        for (answer, holder) in answers.iter_mut().zip(&holders).filter(|(answer, _)| answer.result.is_none())
        {
            answer.result = ReloadNote::read(&holder.note, holder.pid, asked_at).map(|note| note.result);
        }
        if answers.iter().all(|answer| answer.result.is_some()) || clock::monotonic() >= give_up_at {
            return Ok(answers);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}
