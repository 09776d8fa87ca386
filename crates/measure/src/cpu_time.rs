//! The share of CPU time that the hypervisor gave to other machines (steal), to judge measurements on a
//! shared host.

/// CPU time of all CPUs since the machine started, in ticks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CpuTime {
    all: u64,
    stolen: u64,
}

impl CpuTime {
    /// The share of the time since `earlier` that the hypervisor gave to other machines while a thread here
    /// was ready to run (steal), in percent, 0 to 100.
    pub fn stolen_percent_since(self, earlier: Self) -> f64 {
        let all = self.all.saturating_sub(earlier.all).max(1);
        100.0 * self.stolen.saturating_sub(earlier.stolen) as f64 / all as f64
    }

    /// Parses the first line of `/proc/stat`, the sum over all CPUs: user, nice, system, idle, iowait, irq,
    /// softirq and steal (proc_stat(5)). The fields after these are included in them. An
    /// empty text is no time.
    pub fn parse(stat: &str) -> Self {
        let first = stat.lines().next().unwrap_or_default();
        let ticks = first.split_whitespace().skip(1).take(8).filter_map(|word| word.parse::<u64>().ok());
        let ticks: Vec<u64> = ticks.collect();
        Self { all: ticks.iter().sum(), stolen: ticks.get(7).copied().unwrap_or(0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
