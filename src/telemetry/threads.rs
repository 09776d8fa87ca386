//! What the threads of a process do, and the CPU time that they took.

/// The activity of the threads of a process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Threads {
    /// The CPU time of all threads, in ns.
    pub cpu_ns: u64,
    /// Whether a thread runs or is ready to run.
    pub ready: bool,
}

impl Threads {
    /// Reads the threads of a process from `/proc`; none if the process does not exist or is not readable.
    pub fn of(pid: u64) -> Self {
        let mut threads = Self::default();
        for thread in std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten() {
            let read = |name: &str| std::fs::read_to_string(thread.path().join(name)).unwrap_or_default();
            threads.add(&read("schedstat"), &read("stat"));
        }
        threads
    }

    /// Adds a thread: the first field of its `schedstat` is its CPU time, the first one after the name in
    /// parentheses in `stat` is its state (proc(5)).
    fn add(&mut self, schedstat: &str, stat: &str) {
        let cpu_ns = schedstat.split_whitespace().next().and_then(|word| word.parse::<u64>().ok());
        self.cpu_ns += cpu_ns.unwrap_or(0);
        self.ready |= stat.rsplit_once(')').is_some_and(|(_, fields)| fields.trim_start().starts_with('R'));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_threads_of_a_process_have_a_cpu_time_and_a_state() {
        let mut threads = Threads::default();
        threads.add("100 7 1", "12 (a) R) S 1 2 3");
        assert_eq!(threads, Threads { cpu_ns: 100, ready: false });
        threads.add("23 7 1", "13 (b) R 1 2 3");
        threads.add("", "");
        assert_eq!(threads, Threads { cpu_ns: 123, ready: true });
        // This thread runs.
        let own = Threads::of(std::process::id().into());
        assert!(own.ready && own.cpu_ns > 0, "{own:?}");
        assert_eq!(Threads::of(u64::MAX), Threads::default());
    }
}
