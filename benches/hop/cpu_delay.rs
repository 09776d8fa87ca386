//! Measures how long the hypervisor, firmware or the kernel kept a CPU from its thread of highest priority.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use adaptive_bridge::clock;
use nix::sched::{CpuSet, sched_getaffinity};
use nix::unistd::Pid;

use super::system::{self, sleep_until};

/// How long the thread of each CPU sleeps. A shorter period would keep the CPU from its deeper idle states.
const PERIOD_NS: u64 = 2_000_000;

/// The shortest delay that counts; an ordinary wake-up takes less.
const MIN_DELAY_NS: u64 = 1_000_000;

/// Delays within this time are added up, because a queue that filled up in one of them is hardly empty before
/// the next.
const WINDOW_NS: u64 = 100_000_000;

/// Measures the delays of each CPU with a thread that sleeps and compares its wake-up with the due time. The
/// threads end with the process.
pub struct CpuDelayMonitor {
    max_ns: Vec<Arc<AtomicU64>>,
}

impl CpuDelayMonitor {
    pub fn start() -> Self {
        let allowed = sched_getaffinity(Pid::from_raw(0)).unwrap_or_else(|_| CpuSet::new());
        let cpus = (0..CpuSet::count()).filter(|&cpu| allowed.is_set(cpu).unwrap_or(false));
        let max_ns = cpus.map(|cpu| {
            let max_ns = Arc::new(AtomicU64::new(0));
            let shared = Arc::clone(&max_ns);
            std::thread::spawn(move || measure(cpu, &shared));
            max_ns
        });
        Self { max_ns: max_ns.collect() }
    }

    /// The longest delay of any CPU within 100 ms since the last call, in ms.
    pub fn take_max_ms(&self) -> f64 {
        let max_ns = self.max_ns.iter().map(|max_ns| max_ns.swap(0, Ordering::Relaxed)).max();
        max_ns.unwrap_or(0) as f64 / 1e6
    }
}

fn measure(cpu: usize, max_ns: &AtomicU64) {
    system::run_with_highest_priority_on(cpu);
    let mut late = VecDeque::with_capacity((WINDOW_NS / PERIOD_NS) as usize + 1);
    loop {
        let due = clock::monotonic().0 + PERIOD_NS;
        sleep_until(due);
        let now = clock::monotonic().0;
        if now - due >= MIN_DELAY_NS {
            late.push_back((now, now - due));
        }
        while late.front().is_some_and(|(at, _)| now - at > WINDOW_NS) {
            late.pop_front();
        }
        max_ns.fetch_max(late.iter().map(|(_, late_ns)| late_ns).sum(), Ordering::Relaxed);
    }
}
