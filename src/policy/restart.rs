//! When a supervised child process is started again.

use crate::model::MonotonicNs;

/// The wait before the second restart in a row. The first is at once, because most deaths are single ones and
/// every millisecond of a data-plane process that is down loses samples.
pub const FIRST_BACKOFF_MS: u64 = 100;

/// The longest wait. A child that dies at each start then costs a few starts a minute and no more, and one
/// whose trouble is over (a network interface that comes up late, say) is back within 5 s.
pub const MAX_BACKOFF_MS: u64 = 5_000;

/// A child that ran this long was well: the next restart is at once again. Twice the longest wait, so that a
/// child which dies a little after each start is not taken for a healthy one.
pub const GOOD_RUN_MS: u64 = 10_000;

/// How a child ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildExit {
    /// It exited with this code.
    Code(i32),
    /// This signal killed it.
    Signal(i32),
}

/// Why a child is not started again: it would end the same way each time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GiveUpReason {
    /// It exited with 2: wrong command line.
    WrongCommandLine,
    /// It exited with 78 (`EX_CONFIG`): bad configuration.
    BadConfiguration,
}

/// What to do about a child that ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RestartDecision {
    /// Start it again then, or at once if that has passed.
    RestartAt(MonotonicNs),
    /// Leave it.
    GiveUp(GiveUpReason),
}

/// The restarts of one child: the first at once, then after 100, 200, 400, … 5,000 ms, and from the beginning
/// after a run of [`GOOD_RUN_MS`].
#[derive(Clone, Copy, Debug)]
pub struct RestartBackoff {
    started_at: MonotonicNs,
    /// 0: the next restart is at once.
    next_wait_ms: u64,
}

impl RestartBackoff {
    /// For a child that is started at `now`.
    pub const fn new(now: MonotonicNs) -> Self {
        Self { started_at: now, next_wait_ms: 0 }
    }

    /// The child was started again at `now`.
    pub const fn started(&mut self, now: MonotonicNs) {
        self.started_at = now;
    }

    /// The child ended at `now`, unasked; an exit with 0 counts as any other. A start that failed is reported
    /// as an exit too.
    pub fn ended(&mut self, exit: ChildExit, now: MonotonicNs) -> RestartDecision {
        match exit {
            ChildExit::Code(2) => return RestartDecision::GiveUp(GiveUpReason::WrongCommandLine),
            ChildExit::Code(78) => return RestartDecision::GiveUp(GiveUpReason::BadConfiguration),
            ChildExit::Code(_) | ChildExit::Signal(_) => {}
        }
        if now.since(self.started_at) >= GOOD_RUN_MS * 1_000_000 {
            self.next_wait_ms = 0;
        }
        let wait_ms = self.next_wait_ms;
        self.next_wait_ms = (wait_ms * 2).clamp(FIRST_BACKOFF_MS, MAX_BACKOFF_MS);
        RestartDecision::RestartAt(now.plus_ms(wait_ms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: ChildExit = ChildExit::Signal(9);

    /// The wait that follows a run of `run_ms`, and the instant of the restart.
    fn wait_ms(backoff: &mut RestartBackoff, now: &mut MonotonicNs, run_ms: u64) -> u64 {
        *now = now.plus_ms(run_ms);
        match backoff.ended(KILLED, *now) {
            RestartDecision::RestartAt(at) => {
                let wait_ns = at.since(*now);
                *now = at;
                backoff.started(at);
                wait_ns / 1_000_000
            }
            RestartDecision::GiveUp(reason) => panic!("{reason:?}"),
        }
    }

    #[test]
    fn the_first_restart_is_at_once_and_the_waits_double_up_to_five_seconds() {
        let mut now = MonotonicNs(3);
        let mut backoff = RestartBackoff::new(now);
        let waits: Vec<_> = (0..9).map(|_| wait_ms(&mut backoff, &mut now, 20)).collect();
        assert_eq!(waits, [0, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000]);
    }

    #[test]
    fn a_good_run_begins_anew_and_a_shorter_one_does_not() {
        let mut now = MonotonicNs(0);
        let mut backoff = RestartBackoff::new(now);
        for _ in 0..5 {
            wait_ms(&mut backoff, &mut now, 1);
        }
        assert_eq!(wait_ms(&mut backoff, &mut now, GOOD_RUN_MS - 1), 1_600);
        assert_eq!(wait_ms(&mut backoff, &mut now, GOOD_RUN_MS), 0);
        assert_eq!(wait_ms(&mut backoff, &mut now, 1), 100);
    }

    #[test]
    fn a_child_that_would_fail_again_is_left() {
        let mut backoff = RestartBackoff::new(MonotonicNs(0));
        for (code, reason) in [(2, GiveUpReason::WrongCommandLine), (78, GiveUpReason::BadConfiguration)] {
            let decision = backoff.ended(ChildExit::Code(code), MonotonicNs(9));
            assert_eq!(decision, RestartDecision::GiveUp(reason));
        }
    }

    #[test]
    fn any_other_end_is_followed_by_a_restart() {
        for exit in [ChildExit::Code(0), ChildExit::Code(1), ChildExit::Signal(2), ChildExit::Signal(78)] {
            let mut backoff = RestartBackoff::new(MonotonicNs(0));
            assert_eq!(
                backoff.ended(exit, MonotonicNs(9)),
                RestartDecision::RestartAt(MonotonicNs(9)),
                "{exit:?}"
            );
        }
    }
}
