//! Reload: on SIGHUP a process reads its configuration file again and applies the changes that need no
//! restart.
//!
//! A separate thread waits for the signal, reads and validates the file, and compares it with the
//! configuration in force, so that the data path does not wait. Housekeeping picks up the outcome. The
//! outcome is in the log, on the health board, and in a note beside the role's lock file, which
//! `adaptive-bridge reload` reads.

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
use super::parameter_store::{Load, ParameterStore, read_parameters};
use crate::clock;
use crate::config::{ConfigError, Configuration, Reload, SetParameters, Settings};
use crate::model::{InstanceName, MonotonicNs};
use crate::shm::{InForceFile, InForceShare, RoleHolder, ShmError};
use crate::telemetry;

/// The source of reload requests of a process. To be created before anything else: without its handler,
/// SIGHUP ends the process.
pub struct ReloadRequests {
    request: Request,
    in_force: Option<InForce>,
}

struct Request {
    signals: Signals,
    load: Load,
    terminal: Terminal,
}

impl ReloadRequests {
    /// Handles SIGHUP from now on. `load` reads the configuration as at the start: from the same file, with
    /// the same environment, and with the parameters that were set since.
    ///
    /// # Errors
    /// The operating system refused the signal handler.
    pub fn on_signal(
        load: impl Fn(&SetParameters) -> Result<Configuration, ConfigError> + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let signals = Signals::new([SIGHUP])?;
        unblock()?;
        let request = Request { signals, load: Arc::new(load), terminal: Terminal::detect() };
        Ok(Self { request, in_force: None })
    }

    /// Sets the configuration in force, which the process applies and where it stores each reload.
    pub fn kept_in(self, in_force: InForce) -> Self {
        Self { in_force: Some(in_force), ..self }
    }
}

/// Records SIGHUP for a supervisor, which forwards it to its children. To be created before anything else, as
/// [`ReloadRequests`].
#[derive(Debug)]
pub struct HangUp {
    received: Arc<AtomicBool>,
    terminal: Terminal,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HangUpMeaning {
    Reload,
    /// To stop: the terminal was closed, so that Ctrl-C can no longer stop the bridge.
    Stop,
}

impl HangUp {
    /// Handles SIGHUP from now on.
    ///
    /// # Errors
    /// The operating system refused the signal handler.
    pub fn on_signal() -> io::Result<Self> {
        let received = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGHUP, Arc::clone(&received))?;
        unblock()?;
        Ok(Self { received, terminal: Terminal::detect() })
    }

    /// The request of a SIGHUP received since the last call.
    pub(super) fn take(&self) -> Option<HangUpMeaning> {
        self.received.swap(false, Ordering::AcqRel).then(|| match self.terminal.is_closed() {
            true => HangUpMeaning::Stop,
            false => HangUpMeaning::Reload,
        })
    }
}

/// Unblocks SIGHUP. A supervisor starts its children with SIGHUP blocked ([`with_hang_up_blocked`]), so that
/// a signal sent before the child has its handler stays pending until this call.
fn unblock() -> io::Result<()> {
    Ok(SigSet::from(Signal::SIGHUP).thread_unblock()?)
}

/// Starts a child with SIGHUP blocked, so that the signal does not end it before it has its handler.
pub(super) fn with_hang_up_blocked<T>(start: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
    let signal = SigSet::from(Signal::SIGHUP);
    signal.thread_block()?;
    let started = start();
    signal.thread_unblock()?;
    started
}

/// Whether the log went to a terminal at the start. The kernel sends SIGHUP, too, when that terminal is
/// closed.
#[derive(Clone, Copy, Debug)]
struct Terminal(bool);

impl Terminal {
    fn detect() -> Self {
        Self(io::stderr().is_terminal())
    }

    fn is_closed(self) -> bool {
        self.0 && !io::stderr().is_terminal()
    }
}

/// The reload thread of a process that has no role yet. It has the scheduling with which the process was
/// started, and handles no request until the process has its role.
pub(super) struct WaitingReloads {
    pub in_force: Configuration,
    share: Option<InForceShare>,
    parameters: Option<ParameterStore>,
    request: Request,
    outcomes: Receiver<Outcome>,
    begin: SyncSender<(Request, Reloader, PathBuf)>,
}

impl WaitingReloads {
    /// Starts the thread, with the scheduling of the calling one.
    pub fn start(requests: ReloadRequests, settings: &Settings) -> io::Result<Self> {
        let (in_force, share) = match requests.in_force {
            Some(InForce { configuration, share }) => (configuration, Some(share)),
            None => (settings.clone().into(), None),
        };
        let (request, file) = (requests.request, share.as_ref().map(InForceShare::file));
        let parameters = file.map(|file| ParameterStore::new(Arc::clone(&request.load), file));
        // Of capacity 0: the thread writes the note only after housekeeping has taken the outcome.
        let (sender, outcomes) = sync_channel(0);
        let (begin, begun) = sync_channel::<(Request, Reloader, PathBuf)>(1);
        let thread = std::thread::Builder::new().name("reload".to_owned());
        #[allow(clippy::disallowed_methods, reason = "this thread handles no samples")]
        thread.spawn(move || {
            // An error is the end of a process that got no role.
            if let Ok((request, reloader, note)) = begun.recv() {
                serve(request, reloader, &sender, &note);
            }
        })?;
        Ok(Self { in_force, share, parameters, request, outcomes, begin })
    }

    /// Discards the requests that have come so far: they were for the process that this one waits for, and
    /// the file may have been edited since. To be called periodically: those since the last call are handled
    /// after [`begin`](Self::begin), as the former process may have ended before it handled them.
    pub fn discard_requests(&mut self) {
        self.request.signals.pending().for_each(drop);
    }

    /// Reads what the other processes have put in force since this one was started.
    pub fn refresh(&mut self) {
        let Some(share) = &self.share else { return };
        let stored = share.file().read().ok().flatten();
        if let Some(stored) = stored.and_then(|bytes| Configuration::decode(&bytes).ok()) {
            self.in_force = self.in_force.reloaded(stored).0;
        }
    }

    /// Handles requests from now on. Outcomes go to the file `note`.
    pub fn begin(self, note: PathBuf) -> Reloads {
        let file = self.share.as_ref().map(InForceShare::file);
        // The thread waits for this message.
        let reloader = Reloader { current: self.in_force.clone(), file };
        let _ = self.begin.send((self.request, reloader, note));
        Reloads {
            in_force: self.in_force,
            refused: 0,
            outcomes: Some(self.outcomes),
            parameters: self.parameters,
            _share: self.share,
        }
    }
}

/// The configuration in force of this process, updated by reloads.
pub(super) struct Reloads {
    pub in_force: Configuration,
    /// The number of requests that were refused because the file was invalid.
    pub refused: u64,
    outcomes: Option<Receiver<Outcome>>,
    /// Sets parameters of the whole bridge; `None` for a process that reads no file.
    pub parameters: Option<ParameterStore>,
    /// Keeps the configuration in force for processes that start while this one runs.
    _share: Option<InForceShare>,
}

/// The configuration in force after a request; `None` if the file was invalid, and nothing has changed.
type Outcome = Option<Box<Configuration>>;

impl Reloads {
    /// Takes the outcome of a request, puts its configuration in force, and returns whether the file was
    /// valid; `None` if no reload has completed since the last call. Even if a valid file has not changed,
    /// the files that it refers to, such as that of a secret, are to be read again. Never waits, and
    /// allocates nothing while there is no outcome.
    pub fn poll(&mut self) -> Option<bool> {
        match self.outcomes.as_ref()?.try_recv() {
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                error!("the reload thread has ended; SIGHUP does nothing until this process is restarted");
                self.outcomes = None;
                None
            }
            Ok(None) => {
                self.refused += 1;
                Some(false)
            }
            Ok(Some(configuration)) => {
                self.in_force = *configuration;
                Some(true)
            }
        }
    }
}

/// Applies reloads to the configuration in force, on the reload thread.
struct Reloader {
    current: Configuration,
    /// The file with the configuration in force of the bridge.
    file: Option<InForceFile>,
}

impl Reloader {
    /// Puts in force what `new` changes without a restart, and stores it for processes that start later.
    fn reload(&mut self, new: Configuration) -> Reload {
        // Another process may have stored a reload that this one has not applied yet.
        let stored = self.file.as_ref().and_then(|file| file.read().ok()?);
        let stored = stored.and_then(|bytes| Configuration::decode(&bytes).ok());
        let (bridge, Reload { waits, .. }) = stored.as_ref().unwrap_or(&self.current).reloaded(new);
        if stored.as_ref() != Some(&bridge) {
            self.store(&bridge);
        }
        let (current, Reload { changed, .. }) = self.current.reloaded(bridge);
        self.current = current;
        Reload { changed, waits }
    }

    /// The parameters that were set; those in force if they cannot be read.
    fn set_parameters(&self) -> SetParameters {
        let read = self.file.as_ref().map_or_else(|| Ok(SetParameters::new()), read_parameters);
        read.unwrap_or_else(|error| {
            warn!(%error, "cannot read the parameters that were set; those in force stay");
            self.current.settings.set_parameters.clone()
        })
    }

    fn store(&self, configuration: &Configuration) {
        let Some(file) = &self.file else { return };
        let encoded = configuration.encode().map_err(io::Error::from);
        match encoded.and_then(|bytes| file.write(&bytes)) {
            // The bridge is shutting down and has removed its folder.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => {
                error!(%error, "cannot store the reload: a process that restarts will not apply it")
            }
            Ok(()) => {}
        }
    }
}

/// Handles reload requests one by one until the receiver of the outcomes is dropped. Signals received while
/// one is handled make one further request.
fn serve(
    Request { mut signals, load, terminal }: Request,
    mut reloader: Reloader,
    outcomes: &SyncSender<Outcome>,
    note: &Path,
) {
    for _ in signals.forever() {
        if terminal.is_closed() {
            info!("the terminal was closed; stopping");
            // Stops the process as Ctrl-C does.
            let _ = raise(Signal::SIGTERM);
            return;
        }
        notify::reloading();
        let began_at = clock::monotonic();
        let (outcome, result) = match load(&reloader.set_parameters()) {
            Ok(new) => {
                let file_fingerprint = new.settings.fingerprint();
                let reload = reloader.reload(new);
                telemetry::set_verbosity(reloader.current.settings.diagnostics.verbosity);
                log(&reload);
                let outcome = Some(Box::new(reloader.current.clone()));
                (outcome, ReloadResult::Accepted { file_fingerprint, reload })
            }
            Err(error) => {
                error!("the configuration file is bad, and nothing is changed:\n{error}");
                (None, ReloadResult::Refused { problems: error.to_string() })
            }
        };
        if outcomes.send(outcome).is_err() {
            return;
        }
        let written = ReloadNote { pid: std::process::id(), began_at_ns: began_at.0, result }.write(note);
        if let Err(error) = written {
            warn!(
                path = %note.display(),
                %error,
                "cannot write the outcome of the reload for `adaptive-bridge reload`"
            );
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
        info!("reloaded: no setting has changed");
    }
}

/// The outcome of the last reload of a process, in the file beside the lock of its role.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct ReloadNote {
    pid: u32,
    began_at_ns: u64,
    result: ReloadResult,
}

/// The outcome of a reload.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum ReloadResult {
    /// The file was valid; its changes that need no restart are in force.
    Accepted {
        /// The fingerprint of the settings in the file. It equals that of the settings in force unless a
        /// change waits for a restart of the whole bridge.
        file_fingerprint: u64,
        /// The changes that were applied, and those that wait for a restart.
        reload: Reload,
    },
    /// The file was invalid, and nothing has changed.
    Refused {
        /// The problems of the file, one per line.
        problems: String,
    },
}

impl ReloadNote {
    /// Reads the note, if it is of a reload that the process `pid` began at `since` or later.
    fn read(path: &Path, pid: u32, since: MonotonicNs) -> Option<Self> {
        let note: Self = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
        (note.pid == pid && note.began_at_ns >= since.0).then_some(note)
    }

    /// Writes the note by renaming a new file, so that no reader sees half a note.
    fn write(&self, path: &Path) -> io::Result<()> {
        let unfinished = path.with_extension("reload-new");
        fs::write(&unfinished, serde_json::to_vec(self)?)?;
        match fs::rename(&unfinished, path) {
            // The bridge is shutting down and has removed its folder.
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
            outcome => outcome,
        }
    }
}

/// How long [`reload_all`] waits for answers. A process picks up the outcome within 100 ms, and reads the
/// file within milliseconds.
const ANSWER_TIMEOUT_MS: u64 = 5_000;

/// The answer of one process to a reload request.
#[derive(Clone, Debug)]
pub struct ReloadAnswer {
    /// `ingress`, `egress-critical`, …
    pub role: String,
    /// Its process id.
    pub pid: u32,
    /// The outcome; `None` if the process did not answer within 5 s, or ended.
    pub result: Option<ReloadResult>,
}

/// Sends SIGHUP to every process of the bridge.
pub(super) fn request_reload(root: &Path, instance: &InstanceName) -> Result<Vec<RoleHolder>, ShmError> {
    let holders = RoleHolder::all(root, instance)?;
    for RoleHolder { role, pid, .. } in &holders {
        match i32::try_from(*pid).map(|pid| kill(Pid::from_raw(pid), Signal::SIGHUP)) {
            Ok(Ok(())) => {}
            refused => warn!(role, pid, ?refused, "cannot send SIGHUP"),
        }
    }
    Ok(holders)
}

/// Sends SIGHUP to every process of the bridge and waits for the answers. Returns an empty list if the bridge
/// does not run. `root` is the folder of its shared files.
///
/// # Errors
/// The processes of the bridge cannot be listed.
pub fn reload_all(root: &Path, instance: &InstanceName) -> Result<Vec<ReloadAnswer>, ShmError> {
    let asked_at = clock::monotonic();
    let holders = request_reload(root, instance)?;
    let unanswered = |RoleHolder { role, pid, .. }: &RoleHolder| ReloadAnswer {
        role: role.clone(),
        pid: *pid,
        result: None,
    };
    let mut answers: Vec<_> = holders.iter().map(unanswered).collect();
    let give_up_at = asked_at.plus_ms(ANSWER_TIMEOUT_MS);
    loop {
        for (answer, holder) in answers.iter_mut().zip(&holders).filter(|(answer, _)| answer.result.is_none())
        {
            answer.result = ReloadNote::read(&holder.note, holder.pid, asked_at).map(|note| note.result);
        }
        if answers.iter().all(|answer| answer.result.is_some()) || clock::monotonic() >= give_up_at {
            return Ok(answers);
        }
        #[allow(clippy::disallowed_methods, reason = "a reload is asked for outside the data path")]
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use super::super::test_role::{SCAN, wait_until};
    use super::*;
    use crate::config;

    #[test]
    fn a_take_over_handles_the_requests_since_the_last_ones_that_were_discarded() {
        let settings = config::parse(SCAN, "f.yaml", &|_| None).unwrap();
        let folder = tempfile::tempdir().unwrap();
        // A process that waits, and how often it has read the file.
        let waiting = || {
            let (read, reads) = (settings.clone(), Arc::new(AtomicUsize::new(0)));
            let count = Arc::clone(&reads);
            let requests = ReloadRequests::on_signal(move |_| {
                count.fetch_add(1, Ordering::Relaxed);
                Ok(read.clone().into())
            });
            (WaitingReloads::start(requests.unwrap(), &settings).unwrap(), reads)
        };
        let begin = |mut waiting: WaitingReloads| {
            waiting.refresh();
            waiting.begin(folder.path().join("note"))
        };

        let (mut process, reads) = waiting();
        raise(Signal::SIGHUP).unwrap();
        process.discard_requests();
        let mut reloads = begin(process);
        std::thread::sleep(Duration::from_millis(200));
        assert_eq!((reads.load(Ordering::Relaxed), reloads.poll()), (0, None));

        let (mut process, reads) = waiting();
        process.discard_requests();
        raise(Signal::SIGHUP).unwrap();
        let mut reloads = begin(process);
        wait_until("the request is handled", || reloads.poll() == Some(true));
        assert_eq!(reads.load(Ordering::Relaxed), 1);
    }
}
