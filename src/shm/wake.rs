//! Wakes a lane by a futex in the memory of the boards.
//!
//! A lane has a count of wakes, and a flag that is set while it sleeps. A waker increments the count, and
//! calls the kernel only if the flag is set. The lane sets the flag, reads the count again, and sleeps only
//! if the count has not changed. Both sides write before they read, sequentially consistent, so at least one
//! of them sees the write of the other: no wake is lost. There is no descriptor and no buffer that could fill
//! up while a lane is stopped. `docs/decisions/0004-shared-memory.md` has the measurements.
//!
//! Ingress can wake a lane early that sleeps on another CPU: the lane then leaves its sleep while the sample
//! is still being received (`docs/decisions/0006-hand-overs.md` and `0013-early-waker.md`).

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::errno::Errno;
use nix::libc;
use nix::sched::sched_getcpu;

use super::segment::Segment;
use crate::clock;
use crate::model::MonotonicNs;

/// The shortest and the longest time for which a lane spins for the wake after an early one. The shortest is
/// about the time that a sleep and a wake-up take. The lane waits for one copy of the sample, for the last
/// 64 KiB of a large one, or for the wake-up of the receiving thread, which normally take far less than the
/// longest time. A later wake is like one without an early wake.
const SPIN_LIMITS_NS: [u64; 2] = [50_000, 200_000];

/// Between these limits a lane spins for the time that it slept before, divided by this number. At 1 kHz that
/// is 56 µs, within which most wakes happen: the median is 37 µs after the early wake.
const SLEEP_PER_SPIN: u64 = 16;

/// The time for which a lane spins for the wake after an early one, after a sleep of `slept_ns`.
fn spin_ns(slept_ns: u64) -> u64 {
    let [at_least, at_most] = SPIN_LIMITS_NS;
    (slept_ns / SLEEP_PER_SPIN).clamp(at_least, at_most)
}

/// Why [`LaneSleeper::sleep`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// There was a wake since the last return, or a signal interrupted the sleep.
    Woken,
    /// The lane was woken early; the next sleep spins until the wake. A lane that runs one turn in between,
    /// although it has no work, has code and data in the CPU's caches when the sample arrives. Also returned
    /// after a wake that the lane had already seen when the waker called the kernel.
    Early,
    /// The sleep timed out without a wake.
    TimedOut,
}

/// Wakes a lane by its wake count and sleep flag, which have a cache line of their own. Any process or thread
/// may hold any number of wakers.
#[derive(Clone, Debug)]
pub struct LaneWaker {
    segment: Arc<Segment>,
    at: usize,
}

impl LaneWaker {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        Self { segment, at }
    }

    /// The number of wakes so far; the futex.
    fn wake_count(&self) -> &AtomicU32 {
        self.segment.half(self.at)
    }

    /// 0 while the lane is awake, else one more than the number of the CPU on which it sleeps.
    fn sleeping_cpu(&self) -> &AtomicU32 {
        self.segment.half(self.at + 1)
    }

    /// How often the board of a partial sample has changed.
    fn progress_count(&self) -> &AtomicU32 {
        self.segment.half(self.at + 2)
    }

    /// Wakes the lane because the board of a partial sample has changed.
    pub fn wake_for_progress(&self) {
        // Before the wake: a lane that was woken sees it.
        self.progress_count().fetch_add(1, Ordering::Release);
        self.wake();
    }

    /// Wakes the lane early if it sleeps on another CPU than `cpu`, a number from [`this_cpu`], on which the
    /// caller expects to call [`wake`](Self::wake) soon. A lane on the same CPU is not affected, because it
    /// would only delay the wake. A wake need not follow.
    pub fn wake_early(&self, cpu: u32) {
        let sleeping_cpu = self.sleeping_cpu().load(Ordering::Relaxed);
        if sleeping_cpu != 0 && sleeping_cpu != cpu {
            futex_wake(self.wake_count());
        }
    }

    /// Wakes the lane. Never blocks, even while the lane's process is stopped. Several wakes before the lane
    /// checks for them are one. Calls the kernel only if the lane sleeps.
    pub fn wake(&self) {
        self.wake_count().fetch_add(1, Ordering::SeqCst);
        if self.sleeping_cpu().load(Ordering::SeqCst) != 0 {
            futex_wake(self.wake_count());
        }
    }
}

/// Sleeps until its lane is woken. Each lane has one.
#[derive(Debug)]
pub struct LaneSleeper {
    words: LaneWaker,
    /// The wake count at the last check.
    seen_count: u32,
    /// Whether a wake followed the last early wake in time. After one without, the lane ignores early wakes
    /// until the next wake, so that samples that are never forwarded do not keep it busy.
    trusts_early_wakes: bool,
    /// The time until which the next sleep spins for the wake after an early one.
    spin_until: Option<MonotonicNs>,
}

impl LaneSleeper {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        let words = LaneWaker::new(segment, at);
        // There may have been wakes for an earlier process, so the first sleep returns at once.
        let seen_count = words.wake_count().load(Ordering::SeqCst).wrapping_sub(1);
        Self { words, seen_count, trusts_early_wakes: true, spin_until: None }
    }

    /// The number of wakes so far. While it is the same, no sample has arrived.
    pub fn wakes(&self) -> u32 {
        self.words.wake_count().load(Ordering::Acquire)
    }

    /// How often a board of a partial sample has changed.
    pub fn progress(&self) -> u32 {
        self.words.progress_count().load(Ordering::Acquire)
    }

    /// Sleeps until a wake, or for `timeout` at most. Returns at once if there was a wake since the last
    /// return, and at the first call in a lane process. A signal also ends the sleep.
    pub fn sleep(&mut self, timeout: Duration) -> Woken {
        let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX);
        let began = clock::monotonic();
        let deadline = began.plus_ns(timeout_ns);
        let woken = self.take_wake() || self.spin(deadline);
        self.spin_until = None;
        if woken {
            self.trusts_early_wakes = true;
            return Woken::Woken;
        }
        let woken = loop {
            let left_ns = deadline.since(clock::monotonic());
            if left_ns == 0 {
                break Woken::TimedOut;
            }
            self.words.sleeping_cpu().store(this_cpu(), Ordering::SeqCst);
            if self.take_wake() {
                break Woken::Woken;
            }
            // The kernel compares the count again, and sleeps only if it is still `seen_count`.
            let outcome = futex_wait(self.words.wake_count(), self.seen_count, left_ns);
            if self.take_wake() || outcome == Err(Errno::EINTR) {
                break Woken::Woken;
            }
            if outcome.is_ok() && std::mem::take(&mut self.trusts_early_wakes) {
                let now = clock::monotonic();
                self.spin_until = Some(now.plus_ns(spin_ns(now.since(began))));
                break Woken::Early;
            }
        };
        self.words.sleeping_cpu().store(0, Ordering::Relaxed);
        self.trusts_early_wakes |= woken == Woken::Woken;
        woken
    }

    /// Spins for the wake after an early one, until `deadline` at most, and returns whether there was one.
    fn spin(&mut self, deadline: MonotonicNs) -> bool {
        let Some(spin_until) = self.spin_until else {
            return false;
        };
        while clock::monotonic() < spin_until.min(deadline) {
            if self.take_wake() {
                return true;
            }
            std::hint::spin_loop();
        }
        false
    }

    /// Returns whether there was a wake since the last call.
    fn take_wake(&mut self) -> bool {
        let count = self.words.wake_count().load(Ordering::SeqCst);
        let woken = count != self.seen_count;
        self.seen_count = count;
        woken
    }
}

/// Shows to another process whether a lane has work.
#[derive(Debug)]
pub struct LaneObserver {
    words: LaneWaker,
    /// The wake count when the lane had last run.
    seen_count: u32,
}

impl LaneObserver {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        let words = LaneWaker::new(segment, at);
        let seen_count = words.wake_count().load(Ordering::Relaxed);
        Self { words, seen_count }
    }

    /// Notes that the lane has run: it has seen the wakes so far.
    pub fn note_ran(&mut self) {
        self.seen_count = self.words.wake_count().load(Ordering::Relaxed);
    }

    /// Whether there was a wake since the lane has run, or it is not in [`LaneSleeper::sleep`].
    pub fn has_work(&self) -> bool {
        let is_awake = self.words.sleeping_cpu().load(Ordering::Relaxed) == 0;
        is_awake || self.words.wake_count().load(Ordering::Relaxed) != self.seen_count
    }
}

/// One more than the number of the CPU that this thread runs on.
pub fn this_cpu() -> u32 {
    let cpu = sched_getcpu().ok().and_then(|cpu| u32::try_from(cpu).ok());
    // If the number is unknown, all CPUs count as the same one, and early wakes have no effect.
    cpu.map_or(1, |cpu| cpu.saturating_add(1))
}

fn futex_wait(word: &AtomicU32, expected: u32, timeout_ns: u64) -> Result<(), Errno> {
    // Without FUTEX_PRIVATE_FLAG, because other processes use the futex. A relative timeout is measured by
    // CLOCK_MONOTONIC.
    let timeout = libc::timespec {
        tv_sec: i64::try_from(timeout_ns / 1_000_000_000).unwrap_or(i64::MAX),
        tv_nsec: (timeout_ns % 1_000_000_000).cast_signed(),
    };
    // SAFETY: the word and the timeout live until the call returns, and the kernel writes to neither.
    let result = unsafe {
        libc::syscall(libc::SYS_futex, word.as_ptr(), libc::FUTEX_WAIT, expected, &raw const timeout)
    };
    Errno::result(result).map(drop)
}

fn futex_wake(word: &AtomicU32) {
    // SAFETY: the kernel uses only the address of the word. The call cannot fail for a mapped word.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), libc::FUTEX_WAKE, 1) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spin_time_is_a_sixteenth_of_the_sleep_within_limits() {
        assert_eq!(spin_ns(0), 50_000);
        assert_eq!(spin_ns(200_000), 50_000, "at 5 kHz");
        assert_eq!(spin_ns(900_000), 56_250, "at 1 kHz");
        assert_eq!(spin_ns(10_000_000), 200_000, "at 100 Hz");
        assert_eq!(spin_ns(u64::MAX), 200_000);
    }
}
