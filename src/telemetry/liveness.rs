//! Whether a process that shows its health is still there, and whether it turns.

use std::fs;

use serde::Serialize;

use crate::model::{MonotonicNs, ProcessHealth};

/// Roles turn at least ten times a second. One that turned this recently is there, even where its process id
/// means nothing to us because it runs in another container.
const RECENT_MS: u64 = 500;

/// A role that did not turn for so long hangs, or gets no CPU.
const SILENT_MS: u64 = 2_000;

/// The state of a process of the bridge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessState {
    /// It never ran in this bridge.
    NotStarted,
    /// It is there and turns.
    Running,
    /// It is stopped by a signal (SIGSTOP), or by a debugger.
    Stopped,
    /// It is there and its data path has not turned for more than 2 s.
    Silent,
    /// It has ended in good order, because it was told to.
    Ended,
    /// It is gone without a word.
    Dead,
}

impl ProcessState {
    /// The name that `status` shows.
    pub const fn label(self) -> &'static str {
        match self {
            Self::NotStarted => "not started",
            Self::Running => "running",
            Self::Stopped => "stopped",
            Self::Silent => "silent",
            Self::Ended => "ended",
            Self::Dead => "dead",
        }
    }

    /// Whether there is such a process, whatever it does.
    pub const fn exists(self) -> bool {
        matches!(self, Self::Running | Self::Stopped | Self::Silent)
    }

    /// The state, of what the process showed last and of what the kernel says of it at `now`.
    pub(super) fn look(health: &ProcessHealth, now: MonotonicNs) -> Self {
        Self::of(health, kernel_state(health.pid), now)
    }

    fn of(health: &ProcessHealth, kernel_state: Option<char>, now: MonotonicNs) -> Self {
        let silent_for_ns = now.since(health.alive_at);
        match kernel_state {
            _ if health.pid == 0 => Self::NotStarted,
            _ if health.ended != 0 => Self::Ended,
            Some('T' | 't') => Self::Stopped,
            // A zombie has ended, and its parent has not looked.
            Some('Z' | 'X') => Self::Dead,
            None if silent_for_ns > RECENT_MS * 1_000_000 => Self::Dead,
            Some(_) if silent_for_ns > SILENT_MS * 1_000_000 => Self::Silent,
            None | Some(_) => Self::Running,
        }
    }
}

/// The state letter of a process (proc_pid_stat(5)); `None` when there is none of that number.
fn kernel_state(pid: u64) -> Option<char> {
    let stat = fs::read(format!("/proc/{pid}/stat")).ok()?;
    // The name before it is in parentheses, and may have any character in it.
    let end_of_name = stat.iter().rposition(|&byte| byte == b')')?;
    stat.get(end_of_name + 2).copied().map(char::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(pid: u64, kernel_state: Option<char>, silent_for_ms: u64) -> ProcessState {
        let alive_at = MonotonicNs(1_000_000_000);
        let health = ProcessHealth { pid, alive_at, ..ProcessHealth::default() };
        ProcessState::of(&health, kernel_state, alive_at.plus_ms(silent_for_ms))
    }

    #[test]
    fn a_process_is_what_the_kernel_and_its_own_turns_say() {
        assert_eq!(state(0, None, 0), ProcessState::NotStarted);
        assert_eq!(state(7, Some('S'), 100), ProcessState::Running);
        assert_eq!(state(7, Some('R'), 2_001), ProcessState::Silent);
        assert_eq!(state(7, Some('T'), 0), ProcessState::Stopped);
        assert_eq!(state(7, Some('Z'), 0), ProcessState::Dead);
        assert_eq!(state(7, None, 501), ProcessState::Dead);
    }

    #[test]
    fn a_process_that_said_goodbye_has_ended_and_is_not_dead() {
        for kernel_state in [None, Some('S'), Some('Z')] {
            let health = ProcessHealth { pid: 7, ended: 1, ..ProcessHealth::default() };
            let state = ProcessState::of(&health, kernel_state, MonotonicNs(u64::MAX));
            assert_eq!((state, state.exists()), (ProcessState::Ended, false));
        }
    }

    #[test]
    fn a_process_of_another_container_runs_while_it_turns() {
        assert_eq!(state(7, None, 500), ProcessState::Running);
    }

    #[test]
    fn the_kernel_knows_us_and_nobody_of_a_number_that_no_process_has() {
        assert!(kernel_state(u64::from(std::process::id())).is_some_and(|state| "RSD".contains(state)));
        assert_eq!(kernel_state(u64::MAX), None);
    }
}
