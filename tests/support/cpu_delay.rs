//! Measures for how long the hypervisor, firmware or the kernel kept a CPU from its thread of highest
//! priority.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::model::MonotonicNs;
use nix::errno::Errno;
use nix::libc;
use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::unistd::Pid;

/// Two CPUs that this process may run on.
pub fn two_cpus() -> Option<[usize; 2]> {
    let allowed = sched_getaffinity(Pid::from_raw(0)).unwrap();
    let mut cpus = (0..CpuSet::count()).filter(|cpu| allowed.is_set(*cpu).unwrap());
    Some([cpus.next()?, cpus.next()?])
}

/// How long the thread of each CPU sleeps. A shorter period would keep the CPU from its deeper idle states.
const PERIOD: Duration = Duration::from_millis(2);

/// The shortest delay that counts; an ordinary wake-up takes less.
const MIN_DELAY_NS: u64 = 1_000_000;

/// Delays within this time are added up, because a queue that filled up in one of them is hardly empty before
/// the next.
const WINDOW_NS: u64 = 100_000_000;

/// A time in which a CPU did not run its thread of the highest priority, which was due.
#[derive(Clone, Copy, Debug)]
pub struct CpuDelay {
    /// The number of the CPU.
    pub cpu: usize,
    /// When the thread ran.
    pub until: MonotonicNs,
    /// How long it had been due, in ns.
    pub ns: u64,
}

impl CpuDelay {
    /// How much of it lies between these times, in ns.
    pub fn ns_between(&self, from: MonotonicNs, to: MonotonicNs) -> u64 {
        self.until.0.min(to.0).saturating_sub((self.until.0 - self.ns).max(from.0))
    }
}

/// Measures the delays of each CPU with a thread that sleeps and compares its wake-up with the due time. The
/// threads end with the monitor.
pub struct CpuDelayMonitor(Arc<Mutex<Vec<CpuDelay>>>);

impl CpuDelayMonitor {
    pub fn start() -> Self {
        let allowed = sched_getaffinity(Pid::from_raw(0)).unwrap_or_else(|_| CpuSet::new());
        let delays = Arc::default();
        for cpu in (0..CpuSet::count()).filter(|&cpu| allowed.is_set(cpu).unwrap_or(false)) {
            let delays = Arc::downgrade(&delays);
            std::thread::spawn(move || measure(cpu, &delays));
        }
        Self(delays)
    }

    /// The delays of all CPUs since the last call, each CPU's in their order.
    pub fn take(&self) -> Vec<CpuDelay> {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The longest delay of any CPU within 100 ms since the last call, in ms.
    pub fn take_max_ms(&self) -> f64 {
        let (mut recent, mut max_ns) = (VecDeque::<CpuDelay>::new(), 0);
        for delay in self.take() {
            recent.push_back(delay);
            recent.retain(|earlier| delay.until.since(earlier.until) <= WINDOW_NS);
            let of_cpu = recent.iter().filter(|earlier| earlier.cpu == delay.cpu);
            max_ns = max_ns.max(of_cpu.map(|earlier| earlier.ns).sum());
        }
        max_ns as f64 / 1e6
    }
}

fn measure(cpu: usize, delays: &Weak<Mutex<Vec<CpuDelay>>>) {
    run_with_highest_priority_on(cpu);
    while delays.strong_count() > 0 {
        let due = clock::monotonic().0 + PERIOD.as_nanos() as u64;
        std::thread::sleep(PERIOD);
        let now = clock::monotonic();
        let ns = now.0.saturating_sub(due);
        if ns >= MIN_DELAY_NS
            && let Some(delays) = delays.upgrade()
        {
            let delay = CpuDelay { cpu, until: now, ns };
            delays.lock().unwrap_or_else(PoisonError::into_inner).push(delay);
        }
    }
}

fn run_with_highest_priority_on(cpu: usize) {
    let mut set = CpuSet::new();
    if let Err(error) = set.set(cpu).and_then(|()| sched_setaffinity(Pid::from_raw(0), &set)) {
        eprintln!("not pinned to CPU {cpu}, whose delays are not known: {error}");
    }
    // SAFETY: `sched_param` is plain data for which all zeroes are valid, and the call only reads it.
    let outcome = unsafe {
        let mut param: libc::sched_param = std::mem::zeroed();
        param.sched_priority = 99;
        libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param)
    };
    if let Err(error) = Errno::result(outcome) {
        eprintln!("no SCHED_FIFO: {error}; the delays of CPU {cpu} include those by other threads on it");
    }
}
