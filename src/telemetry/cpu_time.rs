//! CPU time: the share that the hypervisor gave to other machines (steal), to judge measurements on a shared
//! host, and that of the threads of a process.

/// CPU time of all CPUs since the machine started, in ticks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CpuTime {
    all: u64,
    stolen: u64,
}

impl CpuTime {
    /// Reads the CPU time until now. Without a readable `/proc/stat` all of it is 0.
    pub fn now() -> Self {
        Self::parse(&std::fs::read_to_string("/proc/stat").unwrap_or_default())
    }

    /// The share of the time since `earlier` that the hypervisor gave to other machines while a thread here
    /// was ready to run (steal), in percent, 0 to 100.
    pub fn stolen_percent_since(self, earlier: Self) -> f64 {
        let all = self.all.saturating_sub(earlier.all).max(1);
        100.0 * self.stolen.saturating_sub(earlier.stolen) as f64 / all as f64
    }

    /// Parses the first line of `/proc/stat`, the sum over all CPUs: user, nice, system, idle, iowait, irq,
    /// softirq and steal (proc_stat(5)). The fields after these are included in them.
    fn parse(stat: &str) -> Self {
        let first = stat.lines().next().unwrap_or_default();
        let ticks = first.split_whitespace().skip(1).take(8).filter_map(|word| word.parse::<u64>().ok());
        let ticks: Vec<u64> = ticks.collect();
        Self { all: ticks.iter().sum(), stolen: ticks.get(7).copied().unwrap_or(0) }
    }
}

/// What the threads of a process do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Threads {
    /// The CPU time of all threads, in ns.
    pub cpu_ns: u64,
    /// Whether a thread runs or is ready to run.
    pub ready: bool,
}

impl Threads {
    /// Reads them from `/proc`; none if the process does not exist or is not readable.
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

    #[test]
    fn stolen_time_is_a_share_of_all_time() {
        let earlier = CpuTime::parse("cpu  100 10 50 800 20 5 15 0 7 3\ncpu0 1 2 3 4 5 6 7 8 9 10\n");
        let later = CpuTime::parse("cpu  160 10 50 810 20 5 15 30 7 3\n");
        assert_eq!(later.stolen_percent_since(earlier), 30.0);
        assert_eq!(earlier.stolen_percent_since(earlier), 0.0);
    }

    #[test]
    fn missing_fields_are_no_stolen_time() {
        let empty = CpuTime::parse("");
        assert_eq!(empty.stolen_percent_since(empty), 0.0);
        assert_eq!(CpuTime::parse("cpu  1 2 3").stolen_percent_since(empty), 0.0);
    }
}
