//! Reads the operating system's clocks. No other module of the library does.

use nix::time::{ClockId, clock_gettime};

use crate::model::{MonotonicNs, WallNs};

/// Reads `CLOCK_MONOTONIC`.
pub fn monotonic() -> MonotonicNs {
    MonotonicNs(read(ClockId::CLOCK_MONOTONIC))
}

/// Reads `CLOCK_REALTIME`.
pub fn wall() -> WallNs {
    WallNs(read(ClockId::CLOCK_REALTIME))
}

/// Reads `CLOCK_THREAD_CPUTIME_ID`: the CPU time that the calling thread has used, in nanoseconds. It stands
/// still while the process is stopped.
pub fn thread_cpu_ns() -> u64 {
    read(ClockId::CLOCK_THREAD_CPUTIME_ID)
}

/// Reads a clock in nanoseconds. Linux has these clocks since 2.6, and none is negative on a machine whose
/// date is after 1970; a failure would return 0.
#[allow(clippy::disallowed_methods, reason = "the place that reads them")]
fn read(clock: ClockId) -> u64 {
    match clock_gettime(clock) {
        Ok(time) => {
            let seconds = u64::try_from(time.tv_sec()).unwrap_or(0);
            let nanos = u64::try_from(time.tv_nsec()).unwrap_or(0);
            seconds * 1_000_000_000 + nanos
        }
        Err(_) => 0,
    }
}
