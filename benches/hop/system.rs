//! CPU affinity, scheduling and resource usage of the programs, and the description of the machine.

use std::fs;
use std::io::{ErrorKind, Write as _};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::process::Command;

use adaptive_bridge_measure::hop::Machine;
use clap::ValueEnum;
use nix::errno::Errno;
use nix::libc;
use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::time::{ClockId, ClockNanosleepFlags, clock_nanosleep};
use nix::unistd::Pid;

/// The placement of the programs on CPUs. Stages are the processes that a sample passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Placement {
    /// Each stage on a different CPU than the one before, so that every hand-over crosses CPUs, as that of
    /// the eventfd does: publisher 0, then relay 1 or ingress 1 and egress 0, then the subscriber.
    Alternating,
    /// Publisher and subscriber on CPU 0, relay or all of the bridge on CPU 1.
    Split,
    /// No affinity.
    Free,
}

impl Placement {
    pub const fn label(self) -> &'static str {
        match self {
            Self::Alternating => "alternating",
            Self::Split => "split",
            Self::Free => "free",
        }
    }

    /// The CPU of the publisher (stage 0), of the stages between, and of the subscriber (the last stage).
    pub fn cpu(self, stage: usize, stages: usize) -> Option<usize> {
        match self {
            Self::Alternating => Some(stage % 2),
            Self::Split => Some(usize::from(stage > 0 && stage + 1 < stages)),
            Self::Free => None,
        }
    }
}

/// The scheduling policy of all programs on the path of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Scheduling {
    /// SCHED_OTHER, the default of Linux.
    Other,
    /// SCHED_FIFO with priority 50, so that other programs on the machine do not affect the result.
    Fifo,
}

impl Scheduling {
    pub const fn label(self) -> &'static str {
        match self {
            Self::Other => "other",
            Self::Fifo => "fifo",
        }
    }
}

pub const FIFO_PRIORITY: i32 = 50;

/// The CPU and the scheduling policy of one program, which are passed to it as an argument.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub cpu: Option<usize>,
    pub scheduling: Scheduling,
}

impl Place {
    /// The place of one end (0 or 1) of the eventfd: the CPU with that number, unless the placement is free.
    pub fn of(placement: Placement, scheduling: Scheduling, end: usize) -> Self {
        let cpu = (placement != Placement::Free).then_some(end);
        Self { cpu, scheduling }
    }

    pub fn to_argument(self) -> String {
        let cpu = self.cpu.map_or("any".to_owned(), |cpu| cpu.to_string());
        format!("{cpu}:{}", self.scheduling.label())
    }

    pub fn parse(text: &str) -> Result<Self, String> {
        let (cpu, scheduling) = text.split_once(':').ok_or("a place must be CPU:SCHEDULING")?;
        Ok(Self { cpu: cpu.parse().ok(), scheduling: Scheduling::from_str(scheduling, false)? })
    }

    /// Applies CPU and scheduling to this thread and those that it starts. Prints what the kernel refuses,
    /// because it changes the meaning of the figures.
    pub fn apply(self) {
        if let Some(cpu) = self.cpu {
            let mut set = CpuSet::new();
            let outcome = set.set(cpu).and_then(|()| sched_setaffinity(Pid::from_raw(0), &set));
            if let Err(error) = outcome {
                eprintln!("bench: not pinned to CPU {cpu}: {error}");
            }
        }
        if self.scheduling == Scheduling::Fifo
            && let Err(error) = set_policy(libc::SCHED_FIFO, FIFO_PRIORITY)
        {
            eprintln!("bench: no SCHED_FIFO: {error}");
        }
        let _ = nix::sys::prctl::set_timerslack(1);
    }

    /// With FIFO the memory of the process is locked, as the bridge's is.
    pub fn lock_memory(self) {
        if self.scheduling == Scheduling::Fifo
            && let Err(error) = mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE)
        {
            eprintln!("bench: memory not locked: {error}");
        }
    }
}

/// Takes the lock that a running bench holds: an abstract socket name. It is unique in the network namespace,
/// as the DDS domains are, and unlike a file it has no permissions that keep out other users.
///
/// # Errors
/// Another bench runs. Both would use the same DDS domains and receive each other's samples.
pub fn lock_bench() -> Result<UnixListener, String> {
    let name = SocketAddr::from_abstract_name("adaptive-bridge-bench");
    name.and_then(|name| UnixListener::bind_addr(&name)).map_err(|error| match error.kind() {
        ErrorKind::AddrInUse => "another bench runs; wait until it has ended".to_owned(),
        _ => format!("cannot check whether another bench runs: {error}"),
    })
}

/// Whether this process may use SCHED_FIFO, tried on a thread that ends at once.
pub fn has_fifo() -> bool {
    let tried = std::thread::spawn(|| {
        // SAFETY: as above; it is a thread that does nothing else.
        let outcome = unsafe {
            let mut param: libc::sched_param = std::mem::zeroed();
            param.sched_priority = FIFO_PRIORITY;
            libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param)
        };
        outcome == 0
    });
    tried.join().unwrap_or(false)
}

/// The resource usage of a process: counters of all its threads so far, and its present memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usage {
    pub cpu_ns: u64,
    /// How often a thread went to sleep (`voluntary_ctxt_switches`).
    pub sleeps: u64,
    /// How often a thread was preempted (`nonvoluntary_ctxt_switches`).
    pub preemptions: u64,
    pub rss_kib: u64,
    pub anonymous_kib: u64,
    pub shared_kib: u64,
    pub file_kib: u64,
}

impl Usage {
    pub fn of(pid: u32) -> Self {
        let read = |path: String| fs::read_to_string(path).unwrap_or_default();
        let memory = read(format!("/proc/{pid}/status"));
        let mut usage = Self {
            cpu_ns: cpu_ns(pid),
            rss_kib: field(&memory, "VmRSS:"),
            anonymous_kib: field(&memory, "RssAnon:"),
            shared_kib: field(&memory, "RssShmem:"),
            file_kib: field(&memory, "RssFile:"),
            ..Self::default()
        };
        for task in fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten() {
            let status = fs::read_to_string(task.path().join("status")).unwrap_or_default();
            usage.sleeps += field(&status, "voluntary_ctxt_switches:");
            usage.preemptions += field(&status, "nonvoluntary_ctxt_switches:");
        }
        usage
    }
}

/// The number that follows a name in a file of /proc; 0 without one.
fn field(text: &str, name: &str) -> u64 {
    let value =
        text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next()?.parse().ok());
    value.unwrap_or(0)
}

/// The number of open files of a process.
pub fn descriptors(pid: u32) -> usize {
    fs::read_dir(format!("/proc/{pid}/fd")).map_or(0, Iterator::count)
}

/// The CPU time of all threads of a process in nanoseconds (the first number of their schedstat).
pub fn cpu_ns(pid: u32) -> u64 {
    let Ok(tasks) = fs::read_dir(format!("/proc/{pid}/task")) else { return 0 };
    tasks
        .flatten()
        .filter_map(|task| fs::read_to_string(task.path().join("schedstat")).ok())
        .filter_map(|text| text.split(' ').next()?.parse::<u64>().ok())
        .sum()
}

/// Keeps idle CPUs from sleeping until the returned file is dropped (the kernel's CPU latency QoS).
pub fn keep_cpus_awake() -> Result<fs::File, String> {
    const FILE: &str = "/dev/cpu_dma_latency";
    const LATENCY_US: i32 = 0;
    let asked = fs::File::options().write(true).open(FILE).and_then(|mut file| {
        file.write_all(&LATENCY_US.to_ne_bytes())?;
        Ok(file)
    });
    asked.map_err(|error| {
        format!("--awake: {FILE}: {error}; run as root and outside of a container, or without --awake")
    })
}

fn set_policy(policy: libc::c_int, priority: libc::c_int) -> nix::Result<()> {
    // SAFETY: `sched_param` is plain data for which all zeroes are valid, and the call only reads it.
    let outcome = unsafe {
        let mut param: libc::sched_param = std::mem::zeroed();
        param.sched_priority = priority;
        libc::sched_setscheduler(0, policy, &raw const param)
    };
    Errno::result(outcome).map(drop)
}

/// Sets the time slice that `config/default.yaml` gives a noncritical lane, 10 ms, for this thread and those
/// that it starts.
pub fn set_noncritical_time_slice() -> Result<(), String> {
    // SAFETY: `sched_attr` is plain data for which all zeroes are valid. The first call writes no more than
    // the length that it is given, the second only reads.
    let outcome = unsafe {
        let mut attributes: libc::sched_attr = std::mem::zeroed();
        let length = size_of::<libc::sched_attr>();
        let got = libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attributes, length, 0);
        Errno::result(got).and_then(|_| {
            attributes.sched_runtime = 10_000_000;
            Errno::result(libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0))
        })
    };
    outcome.map(drop).map_err(|error| format!("cannot set the time slice: {error}"))
}

/// Sleeps until an instant of CLOCK_MONOTONIC.
pub fn sleep_until(instant_ns: u64) {
    let until = libc::timespec {
        tv_sec: (instant_ns / 1_000_000_000) as i64,
        tv_nsec: (instant_ns % 1_000_000_000) as i64,
    };
    while let Err(Errno::EINTR) =
        clock_nanosleep(ClockId::CLOCK_MONOTONIC, ClockNanosleepFlags::TIMER_ABSTIME, &until.into())
    {}
}

/// Describes the machine, commit and command of this run.
pub fn machine() -> Machine {
    let read = |path: &str| fs::read_to_string(path).map(|text| text.trim().to_owned()).unwrap_or_default();
    let cpu = read("/proc/cpuinfo")
        .lines()
        .find_map(|line| {
            line.strip_prefix("model name")?.split(':').nth(1).map(|name| name.trim().to_owned())
        })
        .unwrap_or_default();
    let git = |arguments: &[&str]| {
        let output =
            Command::new("git").args(arguments).output().ok().filter(|output| output.status.success());
        output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default()
    };
    let changed = !git(&["status", "--porcelain", "--untracked-files=no"]).is_empty();
    Machine {
        cpu,
        cpus: std::thread::available_parallelism().map_or(0, usize::from),
        kernel: read("/proc/sys/kernel/osrelease"),
        commit: git(&["rev-parse", "--short=12", "HEAD"]) + if changed { " with changes" } else { "" },
        command: std::iter::once("cargo bench --".to_owned())
            .chain(std::env::args().skip(1).filter(|argument| argument != "--bench"))
            .collect::<Vec<_>>()
            .join(" "),
        load_average: read("/proc/loadavg"),
        rmem_max: read("/proc/sys/net/core/rmem_max"),
    }
}
