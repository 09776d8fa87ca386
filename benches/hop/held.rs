//! For how long a CPU was kept from the most urgent of threads: by a hypervisor, firmware or the kernel.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use adaptive_bridge::clock;
use nix::sched::{CpuSet, sched_getaffinity};
use nix::unistd::Pid;

use super::system::{self, sleep_until};

/// How often each CPU is looked at. More often would keep it from its deeper sleeps.
const PERIOD_NS: u64 = 2_000_000;

/// Less is what a wake-up takes.
const LEAST_NS: u64 = 1_000_000;

/// Delays that end within this time are counted together: a queue that filled up in one of them has hardly
/// been emptied before the next.
const WINDOW_NS: u64 = 100_000_000;

/// A thread on each CPU that sleeps, and looks how much too late it got up. It ends with the process.
pub struct HeldUp {
    most_ns: Vec<Arc<AtomicU64>>,
}

impl HeldUp {
    pub fn watch() -> Self {
        let allowed = sched_getaffinity(Pid::from_raw(0)).unwrap_or_else(|_| CpuSet::new());
        let cpus = (0..CpuSet::count()).filter(|&cpu| allowed.is_set(cpu).unwrap_or(false));
        let most_ns = cpus.map(|cpu| {
            let most_ns = Arc::new(AtomicU64::new(0));
            let shared = Arc::clone(&most_ns);
            std::thread::spawn(move || look(cpu, &shared));
            most_ns
        });
        Self { most_ns: most_ns.collect() }
    }

    /// The most that any CPU was held up for within 100 ms since the last call, ms.
    pub fn take_ms(&self) -> f64 {
        let most_ns = self.most_ns.iter().map(|most_ns| most_ns.swap(0, Ordering::Relaxed)).max();
        most_ns.unwrap_or(0) as f64 / 1e6
    }
}

fn look(cpu: usize, most_ns: &AtomicU64) {
    system::most_urgent_on(cpu);
    let mut late = VecDeque::with_capacity((WINDOW_NS / PERIOD_NS) as usize + 1);
    loop {
        let due = clock::monotonic().0 + PERIOD_NS;
        sleep_until(due);
        let now = clock::monotonic().0;
        if now - due >= LEAST_NS {
            late.push_back((now, now - due));
        }
        while late.front().is_some_and(|(at, _)| now - at > WINDOW_NS) {
            late.pop_front();
        }
        most_ns.fetch_max(late.iter().map(|(_, late_ns)| late_ns).sum(), Ordering::Relaxed);
    }
}
