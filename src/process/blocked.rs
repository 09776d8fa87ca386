//! Finds a thread of the active process that sleeps although it has work, within 12 to 24 ms. The turns of
//! the process show it only after 500 ms.

use std::fmt;
use std::io;
use std::net::UdpSocket;
use std::os::fd::AsFd;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::unistd::Pid;

use crate::dds::EVENT_LOOP_THREAD;
use crate::model::MonotonicNs;
use crate::policy::BlockedWatch;
use crate::shm::{Boards, LaneObserver, ProcessRole};
use crate::telemetry::{ThreadFiles, may_go_on};

/// How long the active process is up at least: one that continues the participant of a killed one leaves
/// datagrams in its sockets for up to 100 ms.
const SETTLED_MS: u64 = 1_000;

/// A thread that is blocked.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Blocked {
    /// That of the data path of a lane: a sample waits, or it is in a turn.
    Main,
    /// The event loop of the DDS library: a datagram waits in a socket.
    EventLoop,
}

impl fmt::Display for Blocked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Main => "its main thread sleeps although samples wait or a turn is not complete",
            Self::EventLoop => "its event loop sleeps although datagrams wait",
        })
    }
}

/// The threads without which the active process forwards nothing.
pub(super) struct BlockedThreads {
    pid: u64,
    settled_at: MonotonicNs,
    /// Only of a lane: the main thread of ingress forwards nothing.
    main: Option<(ThreadFiles, BlockedWatch, LaneObserver)>,
    event_loop: (ThreadFiles, BlockedWatch),
}

impl BlockedThreads {
    /// Of the process `pid`, which is checked each `interval_ms` from `now` on.
    ///
    /// # Errors
    /// The process has ended, or the kernel does not show its threads.
    pub fn of(
        pid: Pid,
        (role, boards): (ProcessRole, &Boards),
        interval_ms: u64,
        now: MonotonicNs,
    ) -> io::Result<Self> {
        let watch = BlockedWatch::new(interval_ms);
        let main = match role {
            ProcessRole::Egress(lane) => {
                Some((ThreadFiles::open(pid.as_raw())?, watch, boards.observer(lane)))
            }
            _ => None,
        };
        let pid = u64::try_from(pid.as_raw()).map_err(io::Error::other)?;
        let event_loop = (ThreadFiles::open_named(pid, EVENT_LOOP_THREAD)?, watch);
        Ok(Self { pid, settled_at: now.plus_ms(SETTLED_MS), main, event_loop })
    }

    /// The first thread that has had work for `limit_ms` and has not run. `sockets` are those of the process.
    pub fn check(&mut self, sockets: &[UdpSocket], limit_ms: u64, now: MonotonicNs) -> Option<Blocked> {
        let mut blocked = None;
        if let Some((thread, watch, lane)) = &mut self.main {
            let has_work = lane.has_work();
            let has_run = has_work && thread.has_run();
            if has_run {
                lane.note_ran();
            }
            if watch.is_blocked(has_work, has_run, limit_ms, now) {
                blocked = Some(Blocked::Main);
            }
        }
        let (thread, watch) = &mut self.event_loop;
        let has_work = is_any_readable(sockets);
        let has_run = has_work && thread.has_run();
        if watch.is_blocked(has_work, has_run, limit_ms, now) {
            blocked = blocked.or(Some(Blocked::EventLoop));
        }
        // It may wait for another thread, which works or waits for a CPU.
        blocked.filter(|_| now >= self.settled_at && !may_go_on(self.pid))
    }
}

/// Whether a datagram waits in one of the sockets.
fn is_any_readable(sockets: &[UdpSocket]) -> bool {
    let mut polled: Vec<_> =
        sockets.iter().map(|socket| PollFd::new(socket.as_fd(), PollFlags::POLLIN)).collect();
    let ready = poll(&mut polled, PollTimeout::ZERO);
    // Not one that has only an error.
    let is_readable =
        |one: &PollFd<'_>| one.revents().is_some_and(|events| events.contains(PollFlags::POLLIN));
    ready.is_ok_and(|ready| ready > 0) && polled.iter().any(is_readable)
}

#[cfg(test)]
mod tests {
    use std::process::{Child, Command};
    use std::time::Duration;

    use super::super::test_role::{SCAN, open, wait_until};
    use super::*;

    /// Set in the child process of the test.
    const CHILD_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_BLOCKED";
    const INTERVAL_MS: u64 = 6;

    /// A process whose threads sleep, one of which has the name of the event loop.
    struct Sleeping(Child);

    impl Sleeping {
        fn start() -> Self {
            let name = "process::blocked::tests::a_thread_that_sleeps_although_it_has_work_is_found";
            let mut child = Command::new(std::env::current_exe().unwrap());
            child.args(["--exact", name]).env(CHILD_VARIABLE, "1");
            Self(child.spawn().unwrap())
        }

        fn pid(&self) -> Pid {
            Pid::from_raw(self.0.id().cast_signed())
        }

        /// Its threads, once it has them.
        fn threads(&self, role: ProcessRole, boards: &Boards, now: MonotonicNs) -> BlockedThreads {
            let of = || BlockedThreads::of(self.pid(), (role, boards), INTERVAL_MS, now);
            wait_until("the threads of the child", || of().is_ok());
            of().unwrap()
        }
    }

    impl Drop for Sleeping {
        fn drop(&mut self) {
            self.0.kill().unwrap();
            self.0.wait().unwrap();
        }
    }

    #[test]
    fn a_thread_that_sleeps_although_it_has_work_is_found() {
        if std::env::var_os(CHILD_VARIABLE).is_some() {
            let event_loop = std::thread::Builder::new().name(EVENT_LOOP_THREAD.into());
            event_loop.spawn(|| std::thread::sleep(Duration::from_secs(600))).unwrap().join().unwrap();
            return;
        }
        let (_folder, role, _) = open(ProcessRole::Egress(0), "blocked", 0, SCAN);
        let child = Sleeping::start();
        let mut now = MonotonicNs(0).plus_ms(60_000);
        let mut check = |threads: &mut BlockedThreads, sockets: &[UdpSocket]| {
            now = now.plus_ms(INTERVAL_MS);
            threads.check(sockets, 2 * INTERVAL_MS, now)
        };

        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = socket.local_addr().unwrap();
        let sockets = [UdpSocket::bind("127.0.0.1:0").unwrap(), socket];
        let mut ingress = child.threads(ProcessRole::Ingress, &role.boards, MonotonicNs(0));
        assert!((0..100).all(|_| check(&mut ingress, &sockets).is_none()), "no datagram waits");
        sockets[0].send_to(&[0; 8], address).unwrap();
        wait_until("the event loop is blocked", || check(&mut ingress, &sockets) == Some(Blocked::EventLoop));
        let mut later = child.threads(ProcessRole::Ingress, &role.boards, MonotonicNs(u64::MAX / 2));
        assert!((0..100).all(|_| check(&mut later, &sockets).is_none()), "it has just started");

        let mut lane = child.threads(ProcessRole::Egress(0), &role.boards, MonotonicNs(0));
        let waker = role.boards.waker(0);
        let mut sleeper = role.boards.sleeper(0);
        // The first sleep returns at once.
        sleeper.sleep(Duration::from_secs(600));
        std::thread::scope(|scope| {
            let sleeps = scope.spawn(move || sleeper.sleep(Duration::from_secs(600)));
            let observer = || {
                let mut observer = role.boards.observer(0);
                observer.note_ran();
                observer
            };
            wait_until("the lane sleeps", || !observer().has_work());
            let mut idle = || (0..100).all(|_| check(&mut lane, &[]).is_none());
            // Before, it was awake.
            wait_until("no sample waits", &mut idle);
            assert!(idle());
            waker.wake();
            sleeps.join().unwrap();
        });
        wait_until("the lane is blocked", || check(&mut lane, &[]) == Some(Blocked::Main));
    }
}
