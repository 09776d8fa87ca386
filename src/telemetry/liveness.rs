//! Determines the state of a bridge process from its health board and from the kernel.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

use serde::Serialize;

use crate::model::{MonotonicNs, ProcessHealth};

/// A process that made a turn this recently runs, even when its process id does not exist here because it
/// runs in another container. Every process makes at least ten turns a second.
const RECENT_MS: u64 = 500;

/// A process that made no turn for this long hangs or gets no CPU time.
const SILENT_MS: u64 = 2_000;

/// The state of a process of the bridge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProcessState {
    /// The process never ran in this bridge.
    NotStarted,
    /// The process exists and makes turns.
    Running,
    /// A signal (SIGSTOP) or a debugger has stopped the process.
    Stopped,
    /// The process exists, but its data path has made no turn for more than 2 s.
    Silent,
    /// The process has shut down normally, on request.
    Ended,
    /// The process was killed or crashed.
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

    /// Whether the process exists, in any state.
    pub const fn exists(self) -> bool {
        matches!(self, Self::Running | Self::Stopped | Self::Silent)
    }

    /// The state at `now`, from the process's last health record and the kernel's state of its process id.
    pub(super) fn read(health: &ProcessHealth, now: MonotonicNs) -> Self {
        Self::of(health, kernel_state(health.pid), now)
    }

    fn of(health: &ProcessHealth, kernel_state: Option<char>, now: MonotonicNs) -> Self {
        let silent_for_ns = now.since(health.alive_at);
        match kernel_state {
            _ if health.pid == 0 => Self::NotStarted,
            _ if health.ended != 0 => Self::Ended,
            Some('T' | 't') => Self::Stopped,
            // A zombie has exited, and its parent has not waited for it yet.
            Some('Z' | 'X') => Self::Dead,
            None if silent_for_ns > RECENT_MS * 1_000_000 => Self::Dead,
            Some(_) if silent_for_ns > SILENT_MS * 1_000_000 => Self::Silent,
            None | Some(_) => Self::Running,
        }
    }
}

/// The state letter of a process (proc_pid_stat(5)); `None` when no process has that id.
fn kernel_state(pid: u64) -> Option<char> {
    state_letter(&fs::read(format!("/proc/{pid}/stat")).ok()?)
}

fn state_letter(stat: &[u8]) -> Option<char> {
    // The command name before it is in parentheses and may contain any character.
    let end_of_name = stat.iter().rposition(|&byte| byte == b')')?;
    stat.get(end_of_name + 2).copied().map(char::from)
}

/// The open file with the state of a process, for checks many times a second.
#[derive(Debug)]
pub struct StatFile(File);

impl StatFile {
    /// Opens the file of a process.
    ///
    /// # Errors
    /// No process has that id.
    pub fn open(pid: i32) -> io::Result<Self> {
        Self::of(&Path::new("/proc").join(pid.to_string()))
    }

    /// Opens the file in the folder of a process or thread.
    pub(super) fn of(folder: &Path) -> io::Result<Self> {
        File::open(folder.join("stat")).map(Self)
    }

    /// Whether SIGSTOP has stopped the process. A debugger stops it in another way.
    pub fn is_stopped(&self) -> bool {
        self.state() == Some('T')
    }

    /// The state letter; `None` when the process has ended.
    pub(super) fn state(&self) -> Option<char> {
        // The name has 64 bytes at most.
        let mut bytes = [0; 128];
        let length = self.0.read_at(&mut bytes, 0).unwrap_or(0);
        state_letter(&bytes[..length])
    }
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
    fn the_state_depends_on_the_kernel_and_the_last_turn() {
        assert_eq!(state(0, None, 0), ProcessState::NotStarted);
        assert_eq!(state(7, Some('S'), 100), ProcessState::Running);
        assert_eq!(state(7, Some('R'), 2_001), ProcessState::Silent);
        assert_eq!(state(7, Some('T'), 0), ProcessState::Stopped);
        assert_eq!(state(7, Some('Z'), 0), ProcessState::Dead);
        assert_eq!(state(7, None, 501), ProcessState::Dead);
    }

    #[test]
    fn a_process_that_shut_down_normally_has_ended_and_is_not_dead() {
        for kernel_state in [None, Some('S'), Some('Z')] {
            let health = ProcessHealth { pid: 7, ended: 1, ..ProcessHealth::default() };
            let state = ProcessState::of(&health, kernel_state, MonotonicNs(u64::MAX));
            assert_eq!((state, state.exists()), (ProcessState::Ended, false));
        }
    }

    #[test]
    fn a_process_of_another_container_runs_while_it_makes_turns() {
        assert_eq!(state(7, None, 500), ProcessState::Running);
    }

    #[test]
    fn only_an_existing_process_has_a_kernel_state() {
        assert!(kernel_state(u64::from(std::process::id())).is_some_and(|state| "RSD".contains(state)));
        assert_eq!(kernel_state(u64::MAX), None);
    }
}
