//! Whether other programs keep the threads of a process from running.

use crate::model::MonotonicNs;

/// A thread of a process at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Thread {
    id: u64,
    cpu_ns: u64,
    /// Whether it runs, is ready to run, or waits for a disk, as it does for a page of memory.
    ready: bool,
}

impl Thread {
    /// The first field of `schedstat` is the CPU time, the first one after the name in parentheses in `stat`
    /// is the state (proc(5)).
    fn parse(id: u64, schedstat: &str, stat: &str) -> Option<Self> {
        let cpu_ns = schedstat.split_whitespace().next()?.parse().ok()?;
        let (_, fields) = stat.rsplit_once(')')?;
        Some(Self { id, cpu_ns, ready: fields.trim_start().starts_with(['R', 'D']) })
    }

    /// Reads the threads of a process from `/proc`; none if the process does not exist or is not readable.
    fn all(pid: u64) -> Vec<Self> {
        let folders = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
        let read = |folder: std::fs::DirEntry| {
            let id = folder.file_name().to_str()?.parse().ok()?;
            let file = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap_or_default();
            Self::parse(id, &file("schedstat"), &file("stat"))
        };
        folders.filter_map(read).collect()
    }
}

/// Whether a process that makes no progress is kept from it by other programs.
#[derive(Clone, Debug)]
pub struct Starvation {
    interval_ms: u64,
    last: Vec<Thread>,
    checked_at: MonotonicNs,
}

impl Starvation {
    /// For checks that are `interval_ms` apart while the process makes no progress.
    pub const fn new(interval_ms: u64) -> Self {
        Self { interval_ms, last: Vec::new(), checked_at: MonotonicNs(0) }
    }

    /// Whether a thread of the process was ready to run at the last check and is now, and got less than half
    /// of a CPU between them: the machine is busy with other programs, or waits for a disk. True also at the
    /// first check of a stall, and at a late one, which cannot tell.
    pub fn check(&mut self, pid: u64, now: MonotonicNs) -> bool {
        self.compare(Thread::all(pid), now)
    }

    fn compare(&mut self, threads: Vec<Thread>, now: MonotonicNs) -> bool {
        let elapsed_ns = now.since(std::mem::replace(&mut self.checked_at, now));
        let last = std::mem::replace(&mut self.last, threads);
        // A check that is older than two intervals belongs to an earlier stall, or this process was starved
        // as well.
        if last.is_empty() || elapsed_ns >= 2 * self.interval_ms * 1_000_000 {
            return true;
        }
        self.last.iter().filter(|thread| thread.ready).any(|thread| {
            let before = last.iter().find(|before| before.id == thread.id && before.ready);
            before.is_some_and(|before| thread.cpu_ns.saturating_sub(before.cpu_ns) < elapsed_ns / 2)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_starves_if_a_thread_is_ready_and_gets_less_than_half_a_cpu() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        let threads = |cpu_ms: [u64; 2], ready: [bool; 2]| {
            let thread =
                |id: usize| Thread { id: id as u64, cpu_ns: cpu_ms[id] * 1_000_000, ready: ready[id] };
            [0, 1].map(thread).to_vec()
        };
        let mut starvation = Starvation::new(100);
        let mut check = |ms, cpu_ms, ready| starvation.compare(threads(cpu_ms, ready), at(ms));
        assert!(check(1_000, [0, 0], [true, false]), "nothing to compare with");
        assert!(check(1_100, [49, 0], [true, false]));
        assert!(!check(1_200, [99, 0], [true, true]), "it runs");
        assert!(check(1_300, [199, 49], [true, true]), "one runs, one does not");
        assert!(!check(1_400, [199, 49], [false, false]), "it waits");
        assert!(!check(1_500, [199, 49], [true, true]), "it waited at the last check");
        assert!(check(1_700, [399, 249], [true, true]), "the check is late");
    }

    #[test]
    fn a_thread_has_a_cpu_time_and_a_state() {
        let thread = |stat| Thread::parse(7, "100 7 1", stat);
        assert_eq!(thread("12 (a) R) S 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: false }));
        assert_eq!(thread("13 (b) R 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: true }));
        assert_eq!(thread("13 (b) D 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: true }));
        assert_eq!(Thread::parse(7, "", ""), None);
        // This thread runs, and has had CPU time that may not be counted yet. The main thread has had some.
        let own = Thread::all(std::process::id().into());
        assert!(
            own.iter().any(|thread| thread.ready) && own.iter().any(|thread| thread.cpu_ns > 0),
            "{own:?}"
        );
        assert_eq!(Thread::all(u64::MAX), []);
    }
}
