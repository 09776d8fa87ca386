//! Applies the configured scheduling (CPUs, nice value, time slice, policy, memory locking) to this process.

use nix::errno::Errno;
use nix::libc;
use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::unistd::Pid;
use tracing::{debug, info, warn};

use crate::config::{Scheduling, SchedulingPolicy};

/// Environment variable with the FIFO priority of a process for which the configuration names no policy; its
/// service unit sets it.
const DEFAULT_VARIABLE: &str = "ADAPTIVE_BRIDGE_FIFO_PRIORITY";

/// The highest nice value.
const LOWEST_PRIORITY: u8 = 19;

/// Applies `scheduling` to this process and the threads that it starts from now on. A setting that the system
/// refuses is only a warning, which names the permission it needs: a bridge with the wrong priority is better
/// than none.
pub(super) fn apply(scheduling: &Scheduling) {
    if !scheduling.cpus.is_empty() {
        match set_affinity(&scheduling.cpus) {
            Ok(()) => info!(cpus = ?scheduling.cpus, "CPUs set"),
            Err(error) => {
                warn!(cpus = ?scheduling.cpus, %error, "CPUs not set: use CPUs that this machine has")
            }
        }
    }
    // A nice value higher than the configured one was set on purpose by the parent, and to lower it needs a
    // privilege.
    if scheduling.nice > 0 && i32::from(scheduling.nice) > current_nice() {
        match set_nice(scheduling.nice) {
            Ok(()) => info!(nice = scheduling.nice, "nice value set"),
            Err(error) => warn!(nice = scheduling.nice, %error, "nice value not set"),
        }
    }
    if let Some(slice_us) = scheduling.slice_us.filter(|_| scheduling.policy == SchedulingPolicy::Other) {
        match set_slice(slice_us) {
            Ok(Some(granted_us)) if granted_us == u64::from(slice_us) => info!(slice_us, "time slice set"),
            Ok(Some(_)) => info!(slice_us, "time slice not set: Linux grants them since 6.12"),
            Ok(None) => debug!("no time slice: the process was started with another scheduling policy"),
            Err(error) => {
                warn!(slice_us, %error, "time slice not set: the process must be allowed sched_setattr")
            }
        }
    }
    let (policy, name, priority) = match scheduling.policy {
        SchedulingPolicy::Other => (libc::SCHED_FIFO, "fifo", default_priority()),
        SchedulingPolicy::Fifo => (libc::SCHED_FIFO, "fifo", Some(scheduling.priority)),
        SchedulingPolicy::RoundRobin => (libc::SCHED_RR, "rr", Some(scheduling.priority)),
    };
    if let Some(priority) = priority {
        match set_policy(policy, priority) {
            Ok(()) => info!(policy = name, priority, "scheduling policy set"),
            Err(error) => warn!(
                policy = name,
                priority,
                %error,
                "scheduling policy not set: the process needs CAP_SYS_NICE or an RLIMIT_RTPRIO of at least \
                 the priority, and with RT_GROUP_SCHED a control group that has real-time runtime"
            ),
        }
    }
    if scheduling.lock_memory {
        match lock_memory() {
            Ok(()) => info!("memory locked"),
            Err(error) => {
                warn!(%error, "memory not locked: the process needs CAP_IPC_LOCK or a larger RLIMIT_MEMLOCK");
            }
        }
    }
}

/// Locks the present memory of the process, and what it maps later as soon as that is touched. Without
/// `MCL_ONFAULT` the kernel would allocate each pool completely, for samples of the largest size.
fn lock_memory() -> nix::Result<()> {
    mlockall(MlockAllFlags::MCL_CURRENT)?;
    let on_fault = MlockAllFlags::from_bits_retain(libc::MCL_ONFAULT);
    mlockall(MlockAllFlags::MCL_FUTURE | on_fault)
}

/// Applies the scheduling of the early waker thread, which only wakes lanes and runs on their CPUs. With a
/// fair policy it never preempts a running program: the lane that it wakes would only wait, and a publisher
/// that is preempted while it sends cost 20 µs of CPU more for each sample. Returns whether the thread is
/// on `cpus`; it must not run on the CPUs of ingress.
pub(super) fn apply_to_early_waker(cpus: &[usize]) -> bool {
    if let Err(error) = set_affinity(cpus) {
        warn!(?cpus, %error, "no early waker, because its CPUs cannot be set: critical lanes wake up later");
        return false;
    }
    if scheduling_attributes().is_ok_and(|attributes| attributes.sched_policy == libc::SCHED_OTHER as u32)
        && let Err(error) = set_policy(libc::SCHED_BATCH, 0)
    {
        debug!(%error, "the early waker may preempt a running program");
    }
    true
}

/// Makes the calling thread, which has the scheduling of its process, run only when the CPUs have nothing
/// else to do: with a fair policy that never preempts, and the lowest priority. It stays on the CPUs of the
/// process.
pub(super) fn apply_to_background() {
    // The nice value of the calling thread alone: on Linux each thread has its own.
    let outcome = set_policy(libc::SCHED_BATCH, 0).and_then(|()| set_nice(LOWEST_PRIORITY));
    if let Err(error) = outcome {
        warn!(%error, "a thread in the background has the scheduling of its process");
    }
}

/// The priority in [`DEFAULT_VARIABLE`]; `None` if that is unset, empty or not 1 to 99.
fn default_priority() -> Option<u8> {
    let text = std::env::var(DEFAULT_VARIABLE).ok().filter(|text| !text.is_empty())?;
    let priority = text.parse().ok().filter(|priority| (1..=99).contains(priority));
    if priority.is_none() {
        warn!("{DEFAULT_VARIABLE} is {text:?} and must be 1 to 99; no scheduling policy is set");
    }
    priority
}

fn set_affinity(cpus: &[usize]) -> nix::Result<()> {
    let mut set = CpuSet::new();
    for &cpu in cpus {
        set.set(cpu)?;
    }
    sched_setaffinity(Pid::from_raw(0), &set)
}

/// The nice value of this process.
fn current_nice() -> i32 {
    // SAFETY: the call takes two numbers and returns one. nix has no wrapper for it. It returns -1 on
    // error, which is also a nice value, and below each value that can be configured.
    unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) }
}

fn set_nice(nice: u8) -> nix::Result<()> {
    // SAFETY: the call takes numbers only. nix has no wrapper for it.
    let outcome = unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, libc::c_int::from(nice)) };
    Errno::result(outcome).map(drop)
}

/// Requests a time slice from the fair scheduler and returns the granted one in microseconds; `None` if this
/// process was started with another scheduling policy.
fn set_slice(slice_us: u32) -> nix::Result<Option<u64>> {
    let mut attributes = scheduling_attributes()?;
    let fair = [libc::SCHED_OTHER, libc::SCHED_BATCH].map(|policy| policy as u32);
    if !fair.contains(&attributes.sched_policy) {
        return Ok(None);
    }
    attributes.sched_runtime = u64::from(slice_us) * 1_000;
    // SAFETY: the call only reads the structure, whose `size` is its own. nix and libc have no wrapper.
    Errno::result(unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) })?;
    Ok(Some(scheduling_attributes()?.sched_runtime / 1_000))
}

fn scheduling_attributes() -> nix::Result<libc::sched_attr> {
    // SAFETY: `sched_attr` is plain data for which all zeroes are valid, and the call writes no more than the
    // length that it is given. nix and libc have no wrapper for it.
    unsafe {
        let mut attributes: libc::sched_attr = std::mem::zeroed();
        let length = size_of::<libc::sched_attr>();
        Errno::result(libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attributes, length, 0))?;
        Ok(attributes)
    }
}

fn set_policy(policy: libc::c_int, priority: u8) -> nix::Result<()> {
    // SAFETY: `sched_param` is plain data for which all zeroes are valid, and the call only reads it. nix has
    // no wrapper for this call.
    let outcome = unsafe {
        let mut param: libc::sched_param = std::mem::zeroed();
        param.sched_priority = libc::c_int::from(priority);
        libc::sched_setscheduler(0, policy, &param)
    };
    Errno::result(outcome).map(drop)
}
