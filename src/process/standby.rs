//! A warm standby: a second process of ingress or of a lane, which has started and waits until the first one
//! ends. Then it takes the role over, without the time that a start takes.
//!
//! Both are the same program with the same arguments; the one that finds the role taken waits. The active
//! process connects to the socket of the standby and sends it duplicates of its own UDP sockets, in which the
//! kernel goes on queueing datagrams when the process ends ([`Successor`](super::successor::Successor)). It
//! keeps the connection open, so that its end wakes the standby.

use std::io;
use std::net::UdpSocket;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{getsockopt, sockopt};
use nix::unistd::Pid;
use tracing::{info, warn};

use super::blocked::{Blocked, BlockedThreads};
use super::error::RoleError;
use super::kept_sockets::{self, Request};
use super::notify::Notifier;
use super::stop::Stop;
use super::successor::{decline, listen_at};
use crate::clock;
use crate::config::Settings;
use crate::model::{MonotonicNs, ProcessHealth, StandbyRecord, TakeOverCause};
use crate::policy::{HangWatch, blocked_limit_ms, hang_limit_ms, may_fence, take_overs_in_a_row};
use crate::shm::{BoardWriter, Boards, ProcessRole, RoleLock, ShmError, root_of};
use crate::telemetry::{Starvation, StatFile};

/// How often, to within [`STOPPED_POLL_MS`], a standby checks for a request to stop, and whether the role is
/// free although no connection told it.
const POLL_MS: u16 = 50;

/// How often a standby checks whether the active process is stopped, or a thread of it is blocked.
const STOPPED_POLL_MS: u16 = 6;

/// How often a standby checks whether the active process makes progress.
const PROGRESS_POLL_MS: u64 = 50;

/// The time without a turn after which the standby looks whether other programs keep the active process from
/// it, which takes some 0.1 ms of CPU time: longer than the 100 ms between two turns without samples.
const STALL_MS: u64 = 110;

/// Environment variable of the children of an `up` that leaves processes alone which make no progress.
pub(super) const NO_WATCHDOG_VARIABLE: &str = "ADAPTIVE_BRIDGE_NO_WATCHDOG";

/// How long a standby tries to take the role after the connection has ended: the kernel closes the files of a
/// process one after the other, within microseconds.
const END_MS: u64 = 100;
/// The same for a standby that was asked to end, and is the last process of the role.
const LAST_END_MS: u64 = 1_000;
const END_POLL: Duration = Duration::from_micros(100);

/// How long a standby that has no sockets of the active process leaves the role to another process, which may
/// have them from its supervisor.
const GIVE_WAY_MS: u64 = 500;

/// How long a standby waits for the place of one that has just taken the role over.
const PLACE_MS: u64 = 5_000;

/// A process that waits for a role.
pub(super) struct Waiting {
    /// Its right to wait, which also lets it write the board.
    lock: RoleLock,
    board: BoardWriter<StandbyRecord>,
    role: ProcessRole,
    boards: Boards,
    routes: usize,
    listener: UnixListener,
    active: Option<Active>,
    /// The sockets of the active process.
    sockets: Vec<UdpSocket>,
    /// Whether the active process has said that its sockets are not to be used by the next one.
    is_taken_back: bool,
    /// Why the active process ends, or has ended.
    cause: TakeOverCause,
    ended_at: MonotonicNs,
    /// Whether it kills an active process that is stopped or hangs.
    fences: bool,
}

/// The active process, as long as it keeps its connection open.
struct Active {
    connection: OwnedFd,
    pid: Pid,
    /// `None` where this process cannot see it.
    stat: Option<StatFile>,
    threads: Option<BlockedThreads>,
    progress: Progress,
    fault: Option<Fault>,
}

/// Why the active process is to be killed.
#[derive(Clone, Copy)]
enum Fault {
    Stopped,
    Blocked(Blocked),
    /// No turn for so many milliseconds.
    NoProgress(u64),
}

/// The turns of the active process.
struct Progress {
    check_at: MonotonicNs,
    /// From its first turn on: a start takes longer.
    watch: Option<HangWatch>,
    starvation: Starvation,
}

impl Progress {
    const fn new() -> Self {
        let starvation = Starvation::new(PROGRESS_POLL_MS);
        Self { check_at: MonotonicNs(0), watch: None, starvation }
    }

    /// Whether the process with this id and health has made no progress for the limit.
    fn has_hung(&mut self, pid: u64, health: &ProcessHealth, limit_ms: u64, now: MonotonicNs) -> bool {
        if now < self.check_at || health.pid != pid || health.turns == 0 {
            return false;
        }
        self.check_at = now.plus_ms(PROGRESS_POLL_MS);
        let watch = self.watch.get_or_insert_with(|| HangWatch::new(limit_ms, now));
        watch.set_limit_ms(limit_ms);
        let is_stalled = now.since(health.alive_at) >= STALL_MS * 1_000_000;
        let starved = is_stalled && self.starvation.check(pid, now);
        watch.has_hung(health.alive_at, starved, now)
    }
}

impl Active {
    fn of(connection: OwnedFd, role: ProcessRole, boards: &Boards) -> io::Result<Self> {
        // As the process was when it connected, so it is the one that has this end of the connection.
        let pid = Pid::from_raw(getsockopt(&connection, sockopt::PeerCredentials)?.pid());
        let stat = StatFile::open(pid.as_raw());
        if let Err(error) = &stat {
            warn!(
                %pid,
                %error,
                "standby: cannot see whether the active process is stopped, and will not kill it then: it runs in \
                 another container, or ProtectProc of its service hides it"
            );
        }
        let threads = BlockedThreads::of(pid, (role, boards), STOPPED_POLL_MS.into(), clock::monotonic());
        if let (Ok(_), Err(error)) = (&stat, &threads) {
            warn!(%pid, %error, "standby: cannot see the threads of the active process, and notices later if it hangs");
        }
        let (stat, threads) = (stat.ok(), threads.ok());
        Ok(Self { connection, pid, stat, threads, progress: Progress::new(), fault: None })
    }

    /// Checks whether it is stopped, or a thread of it is blocked; `sockets` are its.
    fn check(&mut self, sockets: &[UdpSocket], record: &StandbyRecord) {
        let Some(stat) = &self.stat else { return };
        if stat.is_stopped() {
            self.fault = Some(Fault::Stopped);
        } else if let Some(threads) = &mut self.threads {
            let now = clock::monotonic();
            self.fault = threads.check(sockets, blocked_limit_ms(record, now), now).map(Fault::Blocked);
        }
    }

    /// Checks its progress, with its `health`: after [`check`](Self::check).
    fn check_progress(&mut self, health: Option<ProcessHealth>, limit_ms: u64, now: MonotonicNs) {
        if let (None, Some(_), Some(health)) = (self.fault, &self.stat, health)
            && let Ok(pid) = u64::try_from(self.pid.as_raw())
            && self.progress.has_hung(pid, &health, limit_ms, now)
        {
            self.fault = Some(Fault::NoProgress(limit_ms));
        }
    }
}

/// What a standby has when it takes a role over.
pub(super) struct TakeOver {
    /// Held until the process is up, so that the next standby does not write the board before.
    _lock: RoleLock,
    board: BoardWriter<StandbyRecord>,
    /// The sockets of the former process.
    pub sockets: Vec<UdpSocket>,
    cause: TakeOverCause,
    ended_at: MonotonicNs,
}

/// Takes the place of the standby of the role `name`, once the process that takes the role over, if one does,
/// is up; `None` if `stop` was requested meanwhile.
pub(super) fn take_place(
    settings: &Settings,
    name: &str,
    stop: &Stop,
) -> Result<Option<RoleLock>, RoleError> {
    let (root, instance) = (root_of(settings), &settings.instance);
    let give_up_at = clock::monotonic().plus_ms(PLACE_MS);
    loop {
        match RoleLock::acquire_standby(&root, instance, name) {
            Ok(lock) => return Ok(Some(lock)),
            Err(ShmError::AlreadyServed { .. }) if clock::monotonic() < give_up_at => {}
            // Names the process that serves the role, not the one that waits for it.
            Err(taken @ ShmError::AlreadyServed { .. }) => {
                return Err(RoleLock::acquire(&root, instance, name).err().unwrap_or(taken).into());
            }
            Err(error) => return Err(error.into()),
        }
        if stop.is_requested() {
            return Ok(None);
        }
        pause(Duration::from_millis(POLL_MS.into()));
    }
}

impl Waiting {
    /// Begins to wait for the role `name`; `lock` is the place of its standby.
    pub fn open(
        settings: &Settings,
        lock: RoleLock,
        (role, name): (ProcessRole, &str),
        boards: &Boards,
    ) -> io::Result<Self> {
        let listener = listen_at(&lock.standby_socket())?;
        // Its supervisor may keep sockets of a time when this process, or the one before, had the role.
        drop(kept_sockets::inherited());
        kept_sockets::forget();
        // Only now, as the one before has written the board until it gave up its place.
        let mut board = boards.standby_writer(role);
        board.update(|board| board.pid = std::process::id().into());
        info!(role = name, "standby: waits until the process that serves the role ends");
        Ok(Self {
            lock,
            board,
            role,
            boards: boards.clone(),
            routes: settings.routes.len(),
            listener,
            active: None,
            sockets: Vec::new(),
            is_taken_back: false,
            cause: TakeOverCause::Ended,
            ended_at: MonotonicNs(0),
            fences: std::env::var_os(NO_WATCHDOG_VARIABLE).is_none(),
        })
    }

    /// Waits until the role is free, and takes it; `None` if `stop` was requested meanwhile. If the active
    /// process has handed over just before, it takes the role all the same, to say goodbye. Calls `prepare`
    /// at first, and about every 50 ms.
    pub fn wait(
        &mut self,
        settings: &Settings,
        name: &str,
        stop: &Stop,
        prepare: &mut dyn FnMut(),
    ) -> Result<Option<RoleLock>, RoleError> {
        let mut notifier = Notifier::new();
        notifier.ready();
        let mut free_since = None;
        let mut report_at = MonotonicNs(0);
        loop {
            let is_stopping = stop.is_requested();
            let now = clock::monotonic();
            if now >= report_at {
                report_at = now.plus_ms(POLL_MS.into());
                self.board.update(|board| board.alive_at = now);
                notifier.feed_watchdog(now);
                notifier.status(now, |line| *line += "standby");
                prepare();
            }
            let was_connected = self.active.is_some();
            self.receive()?;
            let is_heir = self.cause == TakeOverCause::HandedOver
                || (self.active.is_none() && !self.sockets.is_empty());
            if is_stopping && !is_heir && self.has_declined() {
                break;
            }
            if self.active.is_some() {
                self.fence(name);
                continue;
            }
            self.ended_at = clock::monotonic();
            let end_ms = if is_stopping { LAST_END_MS } else { END_MS };
            let ends_now = was_connected || self.cause == TakeOverCause::HandedOver;
            let try_until = if ends_now { self.ended_at.plus_ms(end_ms) } else { self.ended_at };
            let Some(lock) = self.take(settings, name, try_until)? else {
                if is_stopping {
                    break;
                }
                free_since = None;
                continue;
            };
            let since = *free_since.get_or_insert(self.ended_at);
            let has_sockets = !self.sockets.is_empty() || self.is_taken_back;
            if has_sockets || self.ended_at.since(since) > GIVE_WAY_MS * 1_000_000 {
                info!(role = name, sockets = self.sockets.len(), "standby: takes the role over");
                // From here on it is a process that starts, also for the watchdogs.
                notifier.allow_start();
                self.board.update(|board| board.pid = 0);
                return Ok(Some(lock));
            }
        }
        self.board.update(|board| board.pid = 0);
        Ok(None)
    }

    /// Waits for a connection, or for a message of the one that there is, until other work is due.
    fn receive(&mut self) -> io::Result<()> {
        let checks = self.fences && self.active.as_ref().is_some_and(|active| active.stat.is_some());
        let timeout_ms = if checks { STOPPED_POLL_MS } else { POLL_MS };
        let mut waited_ms = 0;
        loop {
            let source =
                self.active.as_ref().map_or(self.listener.as_fd(), |active| active.connection.as_fd());
            match poll(&mut [PollFd::new(source, PollFlags::POLLIN)], PollTimeout::from(timeout_ms)) {
                Ok(0) => waited_ms += timeout_ms,
                Err(nix::Error::EINTR) => return Ok(()),
                Err(error) => return Err(error.into()),
                Ok(_) => break,
            }
            // Nothing but this check is done so often: it takes 30 to 100 µs of CPU time, most to wake up.
            if let Some(active) = self.active.as_mut().filter(|_| checks) {
                active.check(&self.sockets, self.board.get());
            }
            if waited_ms >= POLL_MS || self.active.as_ref().is_some_and(|active| active.fault.is_some()) {
                return Ok(());
            }
        }
        let Some(active) = &self.active else {
            match self.listener.accept().and_then(|(connection, _)| self.open_active(connection.into())) {
                Ok(active) => (self.active, self.cause) = (Some(active), TakeOverCause::Ended),
                Err(error) => warn!(%error, "standby: a connection of the active process failed"),
            }
            return Ok(());
        };
        let request = kept_sockets::receive(&active.connection);
        self.heed(request);
        Ok(())
    }

    fn open_active(&self, connection: OwnedFd) -> io::Result<Active> {
        Active::of(connection, self.role, &self.boards)
    }

    /// Applies a message of the active process; `None` if its connection has failed.
    fn heed(&mut self, request: Option<Request>) {
        match request {
            Some(Request::Store(sockets)) => (self.sockets, self.is_taken_back) = (sockets, false),
            Some(Request::Forget) => {
                self.sockets.clear();
                self.is_taken_back = true;
            }
            Some(Request::Stopping) => self.cause = TakeOverCause::HandedOver,
            Some(Request::Unknown) | None => self.active = None,
        }
    }

    /// Tells the active process that this one takes nothing over any more; false if it has handed over.
    fn has_declined(&mut self) -> bool {
        decline(&self.listener);
        loop {
            if let Some(active) = &self.active {
                decline(&active.connection);
            }
            while let Some(active) = &self.active {
                let request = kept_sockets::receive(&active.connection);
                self.heed(request);
            }
            // A connection that it has not accepted yet.
            let Ok((connection, _)) = self.listener.accept() else { break };
            self.active = self.open_active(connection.into()).ok();
        }
        self.cause != TakeOverCause::HandedOver
    }

    /// Kills the active process if a signal has stopped it or if it makes no progress: continued later, it
    /// would be a second speaker with the same identity.
    fn fence(&mut self, name: &str) {
        let Some(active) = self.active.as_mut().filter(|_| self.fences) else { return };
        let (now, record) = (clock::monotonic(), self.board.get());
        active.check_progress(self.boards.health(self.role), hang_limit_ms(record, self.routes, now), now);
        let Some(fault) = active.fault.take() else { return };
        if !may_fence(record.taken_over_at, now) {
            return;
        }
        let pid = active.pid.as_raw();
        let cause = match fault {
            Fault::Stopped => {
                warn!(role = name, pid, "standby: kills the active process, which is stopped");
                TakeOverCause::Stopped
            }
            Fault::Blocked(blocked) => {
                warn!(role = name, pid, "standby: kills the active process: {blocked}");
                TakeOverCause::Hung
            }
            Fault::NoProgress(limit_ms) => {
                warn!(role = name, pid, "standby: kills the active process: no progress for {limit_ms} ms");
                TakeOverCause::Hung
            }
        };
        match kill(active.pid, Signal::SIGKILL) {
            // One that was asked to end, and takes long to do so, has handed over.
            Ok(()) if self.cause == TakeOverCause::HandedOver => {}
            Ok(()) => self.cause = cause,
            Err(error) => warn!(role = name, %error, "standby: cannot kill the active process"),
        }
    }

    /// Takes the role if it becomes free until then; tries at least once.
    fn take(
        &self,
        settings: &Settings,
        name: &str,
        until: MonotonicNs,
    ) -> Result<Option<RoleLock>, RoleError> {
        loop {
            match RoleLock::acquire(&root_of(settings), &settings.instance, name) {
                Ok(lock) => return Ok(Some(lock)),
                Err(ShmError::AlreadyServed { .. }) => {}
                Err(error) => return Err(error.into()),
            }
            if clock::monotonic() >= until {
                return Ok(None);
            }
            pause(END_POLL);
        }
    }

    pub fn take_over(self) -> TakeOver {
        let Self { lock, board, sockets, cause, ended_at, .. } = self;
        TakeOver { _lock: lock, board, sockets, cause, ended_at }
    }
}

impl TakeOver {
    /// Records that the process is up; then another one may wait for the role.
    pub fn complete(mut self) {
        let now = clock::monotonic();
        let (cause, took_ns) = (self.cause, now.since(self.ended_at));
        self.board.update(|board| {
            *board = StandbyRecord {
                take_overs: board.take_overs + 1,
                taken_over_at: now,
                took_ns,
                in_a_row: take_overs_in_a_row(board, cause, now),
                cause: cause as u8,
                ..StandbyRecord::default()
            };
        });
        Notifier::new().end_start();
        info!(%cause, took_ms = took_ns as f64 / 1e6, "standby: has taken the role over");
    }
}

#[allow(clippy::disallowed_methods, reason = "a standby handles no samples")]
fn pause(time: Duration) {
    std::thread::sleep(time);
}
