//! Decides when the supervisor restarts a child process that ended.

use crate::model::MonotonicNs;

/// The wait before the second restart in a row. The first is immediate, because most processes die only once
/// and every millisecond without a data-plane process loses samples.
pub const FIRST_BACKOFF_MS: u64 = 100;

/// The longest wait. It limits a child that dies at each start to a few starts a minute, and a child whose
/// cause of failure is gone (such as a network interface that comes up late) runs again within 5 s.
pub const MAX_BACKOFF_MS: u64 = 5_000;

/// A child that ran this long was healthy: the next restart is immediate again. Twice the longest wait, so
/// that a child which dies shortly after each start does not count as healthy.
pub const HEALTHY_RUN_MS: u64 = 10_000;

/// The same for a child with a standby: until it runs again, the other one has no standby, so that the waits
/// of a child that is killed now and then cost samples. Longer than a child that dies at each start runs.
pub const HEALTHY_RUN_WITH_STANDBY_MS: u64 = 1_500;

/// How a child process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildExit {
    /// The child exited with this code.
    Code(i32),
    /// This signal killed the child.
    Signal(i32),
}

/// Why the supervisor does not restart a child: it would end in the same way each time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GiveUpReason {
    /// The child exited with 2: its command line is wrong.
    WrongCommandLine,
    /// The child exited with 78 (`EX_CONFIG`): the configuration is bad.
    BadConfiguration,
}

/// Whether and when to restart a child that ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RestartDecision {
    /// Restart it at that instant, or immediately if it has passed.
    RestartAt(MonotonicNs),
    /// Do not restart it.
    GiveUp(GiveUpReason),
}

/// The restart waits of one child: 0, 100, 200, … 5,000 ms, and again after a run of [`HEALTHY_RUN_MS`], or
/// of [`HEALTHY_RUN_WITH_STANDBY_MS`].
#[derive(Clone, Copy, Debug)]
pub struct RestartBackoff {
    started_at: MonotonicNs,
    healthy_run_ms: u64,
    /// 0 when the next restart is immediate.
    next_wait_ms: u64,
}

impl RestartBackoff {
    /// The waits of a child that is started at `now`.
    pub const fn new(now: MonotonicNs) -> Self {
        Self { started_at: now, healthy_run_ms: HEALTHY_RUN_MS, next_wait_ms: 0 }
    }

    /// The waits of a child with a standby that is started at `now`.
    pub const fn with_standby(now: MonotonicNs) -> Self {
        Self { healthy_run_ms: HEALTHY_RUN_WITH_STANDBY_MS, ..Self::new(now) }
    }

    /// Records that the child was restarted at `now`.
    pub const fn started(&mut self, now: MonotonicNs) {
        self.started_at = now;
    }

    /// Decides about a child that ended at `now` without having been stopped. An exit with 0 counts as any
    /// other; the caller passes a failed start as an exit too.
    pub fn ended(&mut self, exit: ChildExit, now: MonotonicNs) -> RestartDecision {
        match exit {
            ChildExit::Code(2) => return RestartDecision::GiveUp(GiveUpReason::WrongCommandLine),
            ChildExit::Code(78) => return RestartDecision::GiveUp(GiveUpReason::BadConfiguration),
            ChildExit::Code(_) | ChildExit::Signal(_) => {}
        }
        if now.since(self.started_at) >= self.healthy_run_ms * 1_000_000 {
            self.next_wait_ms = 0;
        }
        let wait_ms = self.next_wait_ms;
        self.next_wait_ms = (wait_ms * 2).clamp(FIRST_BACKOFF_MS, MAX_BACKOFF_MS);
        RestartDecision::RestartAt(now.plus_ms(wait_ms))
    }
}

/// The longest step that [`HangWatch`] counts between two checks; of a short limit, a quarter of it. A longer
/// pause is one of the supervisor itself, which was stopped, and with it perhaps its children.
const MAX_STEP_MS: u64 = 500;

/// How many times its limit a child may make no progress while it waits for a CPU. On a machine that is
/// busy with other programs a restart helps nothing and costs samples; but a thread in an endless loop waits
/// for a CPU, too.
const STARVED_LIMITS: u64 = 10;

/// Finds a child process that runs but makes no progress.
#[derive(Clone, Copy, Debug)]
pub struct HangWatch {
    limit_ms: u64,
    alive_at: MonotonicNs,
    checked_at: MonotonicNs,
    stalled_ns: u64,
    starved_ns: u64,
}

impl HangWatch {
    /// A watch of a child that was started at `now` and must show progress every `limit_ms`.
    pub const fn new(limit_ms: u64, now: MonotonicNs) -> Self {
        Self { limit_ms, alive_at: MonotonicNs(0), checked_at: now, stalled_ns: 0, starved_ns: 0 }
    }

    /// Changes the limit.
    pub const fn set_limit_ms(&mut self, limit_ms: u64) {
        self.limit_ms = limit_ms;
    }

    /// Whether the child has made no progress since the last check.
    pub fn is_stalled(&self, alive_at: MonotonicNs) -> bool {
        alive_at == self.alive_at
    }

    /// Compares when the child last made progress, by its own account, with the last check. Returns whether
    /// it has made none for the limit, in the time that the supervisor itself was running. While the child is
    /// `starved`, a thread of it is ready to run and gets little CPU time, up to ten times the limit more.
    pub fn has_hung(&mut self, alive_at: MonotonicNs, starved: bool, now: MonotonicNs) -> bool {
        let limit_ns = self.limit_ms * 1_000_000;
        let step_ns = now.since(self.checked_at).min(MAX_STEP_MS * 1_000_000).min(limit_ns / 4);
        self.checked_at = now;
        if !self.is_stalled(alive_at) {
            self.alive_at = alive_at;
            (self.stalled_ns, self.starved_ns) = (0, 0);
        } else if starved && self.starved_ns < STARVED_LIMITS * limit_ns {
            self.starved_ns += step_ns;
        } else {
            self.stalled_ns += step_ns;
        }
        self.stalled_ns >= limit_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: ChildExit = ChildExit::Signal(9);

    /// The wait after a run of `run_ms`; advances `now` to the restart.
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
    fn the_first_restart_is_immediate_and_the_waits_double_up_to_five_seconds() {
        let mut now = MonotonicNs(3);
        let mut backoff = RestartBackoff::new(now);
        let waits: Vec<_> = (0..9).map(|_| wait_ms(&mut backoff, &mut now, 20)).collect();
        assert_eq!(waits, [0, 100, 200, 400, 800, 1_600, 3_200, 5_000, 5_000]);
    }

    #[test]
    fn a_good_run_resets_the_waits_and_a_shorter_one_does_not() {
        let mut now = MonotonicNs(0);
        let mut backoff = RestartBackoff::new(now);
        for _ in 0..5 {
            wait_ms(&mut backoff, &mut now, 1);
        }
        assert_eq!(wait_ms(&mut backoff, &mut now, HEALTHY_RUN_MS - 1), 1_600);
        assert_eq!(wait_ms(&mut backoff, &mut now, HEALTHY_RUN_MS), 0);
        assert_eq!(wait_ms(&mut backoff, &mut now, 1), 100);
    }

    #[test]
    fn a_child_with_a_standby_needs_a_shorter_good_run() {
        let mut now = MonotonicNs(0);
        let mut backoff = RestartBackoff::with_standby(now);
        let waits = [1, HEALTHY_RUN_WITH_STANDBY_MS - 1, HEALTHY_RUN_WITH_STANDBY_MS, 1];
        assert_eq!(waits.map(|run_ms| wait_ms(&mut backoff, &mut now, run_ms)), [0, 100, 0, 100]);
    }

    #[test]
    fn a_child_with_a_wrong_command_line_or_configuration_is_not_restarted() {
        let mut backoff = RestartBackoff::new(MonotonicNs(0));
        for (code, reason) in [(2, GiveUpReason::WrongCommandLine), (78, GiveUpReason::BadConfiguration)] {
            let decision = backoff.ended(ChildExit::Code(code), MonotonicNs(9));
            assert_eq!(decision, RestartDecision::GiveUp(reason));
        }
    }

    #[test]
    fn a_child_with_any_other_exit_is_restarted() {
        for exit in [ChildExit::Code(0), ChildExit::Code(1), ChildExit::Signal(2), ChildExit::Signal(78)] {
            let mut backoff = RestartBackoff::new(MonotonicNs(0));
            assert_eq!(
                backoff.ended(exit, MonotonicNs(9)),
                RestartDecision::RestartAt(MonotonicNs(9)),
                "{exit:?}"
            );
        }
    }

    #[test]
    fn a_child_hangs_when_it_makes_no_progress_for_the_limit() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let mut watch = HangWatch::new(2_000, at(0));
        for ms in (250..60_000).step_by(250) {
            assert!(!watch.has_hung(at(ms - 100), false, at(ms)), "a turn each 250 ms");
        }
        for ms in (60_000..61_750).step_by(250) {
            assert!(!watch.has_hung(at(59_650), false, at(ms)), "{ms}");
        }
        assert!(watch.has_hung(at(59_650), false, at(61_750)));
    }

    #[test]
    fn a_pause_of_the_supervisor_is_not_a_hang_of_its_children() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let mut watch = HangWatch::new(2_000, at(0));
        assert!(!watch.has_hung(at(200), false, at(250)));
        assert!(!watch.has_hung(at(200), false, at(3_600_250)), "an hour in SIGSTOP counts as 500 ms");
        assert!(!watch.has_hung(at(3_600_300), false, at(3_600_500)));

        // With a short limit, no pause by itself reaches it.
        watch.set_limit_ms(400);
        let hung_at =
            (1..10).find(|hour| watch.has_hung(at(3_600_300), false, at(3_600_500 + hour * 3_600_000)));
        assert_eq!(hung_at, Some(4));
    }

    #[test]
    fn a_changed_limit_holds_from_the_next_check_on() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let mut watch = HangWatch::new(2_000, at(0));
        assert!(!watch.has_hung(at(50), false, at(100)));
        watch.set_limit_ms(400);
        let hung_ms = (150..5_000).step_by(50).find(|ms| watch.has_hung(at(50), false, at(*ms)));
        assert_eq!(hung_ms, Some(500));
    }

    #[test]
    fn a_child_that_waits_for_a_cpu_has_ten_times_the_limit_more() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let checks = |starved: fn(u64) -> bool| {
            let mut watch = HangWatch::new(2_000, at(0));
            assert!(!watch.has_hung(at(100), true, at(250)));
            (500..60_000).step_by(250).find(|ms| watch.has_hung(at(100), starved(*ms), at(*ms))).unwrap()
        };
        assert_eq!(checks(|_| false), 2_250);
        assert_eq!(checks(|ms| ms <= 10_250), 12_250, "10 s of waiting for a CPU do not count");
        assert_eq!(checks(|_| true), 22_250);
    }
}
