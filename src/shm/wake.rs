//! How ingress wakes a lane: a futex in the boards' memory.
//!
//! A count of wakes, and a flag that says whether the lane sleeps. A wake counts, and calls the kernel only
//! if the flag is up; a lane puts the flag up, looks at the count once more, and sleeps only if nothing came.
//! Both sides write before they read, sequentially consistent, so one of them sees the other: no wake is
//! lost. No descriptor and no buffer is involved that could fill up while a lane is stopped.
//! `docs/decisions/0004-shared-memory.md` has the measurements.
//!
//! A lane that sleeps on another CPU than ingress runs on can be told a moment ahead, and gets up while the
//! sample is still being received: `docs/decisions/0006-hand-overs.md`, `docs/decisions/0013-lookout.md`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::errno::Errno;
use nix::libc;
use nix::sched::sched_getcpu;

use super::segment::Segment;
use crate::clock;
use crate::model::MonotonicNs;

/// How long a lane stays up for a wake that was announced: the first at least, about what a sleep and getting
/// up again take, and the second at most. What it waits for is one copy of the sample, the last 64 KiB of a
/// large one, or the receiving thread's getting up: far less than the second, as a rule. A sample that takes
/// longer wakes the lane as if nothing had been announced.
const ANNOUNCED_NS: [u64; 2] = [50_000, 200_000];

/// Between these it stays up for one part in so many of the time that it slept before. At 1 kHz what it waits
/// for is 37 µs away in the median, so most wakes come within 56 and the long waits are left out.
const SLEPT_SHARE: u64 = 16;

/// How long a lane that slept for so long stays up for a wake that was announced.
fn stays_up_ns(slept_ns: u64) -> u64 {
    let [at_least, at_most] = ANNOUNCED_NS;
    (slept_ns / SLEPT_SHARE).clamp(at_least, at_most)
}

/// Why a [`LaneSleeper`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// There was a wake since the last return, or a signal came.
    Woken,
    /// A wake was announced, and the next sleep stays up for it. Who goes through its work meanwhile, though
    /// there is none, has the code and the data at hand when there is. A wake that the lane has seen before
    /// the kernel was called for it looks like this, too.
    Announced,
    /// The time is over and nobody woke the lane.
    TimedOut,
}

/// The two words of a lane, on a cache line of their own.
#[derive(Clone, Debug)]
struct WakeWords {
    segment: Arc<Segment>,
    at: usize,
}

impl WakeWords {
    fn wakes(&self) -> &AtomicU32 {
        self.segment.half(self.at)
    }

    /// 0 while the lane is up, else one more than the number of the CPU that it sleeps on.
    fn asleep(&self) -> &AtomicU32 {
        self.segment.half(self.at + 1)
    }
}

/// Wakes one lane; any process or thread may hold any number of them.
#[derive(Clone, Debug)]
pub struct LaneWaker {
    words: WakeWords,
}

impl LaneWaker {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        Self { words: WakeWords { segment, at } }
    }

    /// Says that a wake is about to come from `cpu`, as [`this_cpu`] has it, so that a lane that sleeps on
    /// another one gets up meanwhile. On that CPU it could only get in the way. Nothing has to follow.
    pub fn announce(&self, cpu: u32) {
        let sleeps_on = self.words.asleep().load(Ordering::Relaxed);
        if sleeps_on != 0 && sleeps_on != cpu {
            futex_wake(self.words.wakes());
        }
    }

    /// Wakes the lane. Never blocks, also while the lane is stopped; several wakes before the lane looks are
    /// one. Calls the kernel only if the lane sleeps.
    pub fn wake(&self) {
        self.words.wakes().fetch_add(1, Ordering::SeqCst);
        if self.words.asleep().load(Ordering::SeqCst) != 0 {
            futex_wake(self.words.wakes());
        }
    }
}

/// Sleeps until its lane is woken; one for each lane.
#[derive(Debug)]
pub struct LaneSleeper {
    words: WakeWords,
    seen: u32,
    /// Whether the last announcement was followed by a wake in time. After one that was not, the lane stays
    /// up for no other until a wake has come: a flood of samples that come to nothing does not keep it busy.
    trusts: bool,
    /// Until when the lane stays up for a wake that was announced.
    up_until: Option<MonotonicNs>,
}

impl LaneSleeper {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        let words = WakeWords { segment, at };
        // What came before is unknown, so the first sleep ends at once.
        let seen = words.wakes().load(Ordering::SeqCst).wrapping_sub(1);
        Self { words, seen, trusts: true, up_until: None }
    }

    /// Sleeps until a wake, or for `timeout` at most. A wake that came since the last return ends it at once;
    /// so does the first sleep of a new lane process, and a signal.
    pub fn sleep(&mut self, timeout: Duration) -> Woken {
        let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX);
        let began = clock::monotonic();
        let deadline = began.plus_ns(timeout_ns);
        let woken = self.look() || self.stay_up(deadline);
        self.up_until = None;
        if woken {
            self.trusts = true;
            return Woken::Woken;
        }
        let woken = loop {
            let left_ns = deadline.since(clock::monotonic());
            if left_ns == 0 {
                break Woken::TimedOut;
            }
            self.words.asleep().store(this_cpu(), Ordering::SeqCst);
            if self.look() {
                break Woken::Woken;
            }
            // The kernel looks at the count once more, and sleeps only if it is still the one that we saw.
            let outcome = futex_wait(self.words.wakes(), self.seen, left_ns);
            if self.look() || outcome == Err(Errno::EINTR) {
                break Woken::Woken;
            }
            if outcome.is_ok() && std::mem::take(&mut self.trusts) {
                let now = clock::monotonic();
                self.up_until = Some(now.plus_ns(stays_up_ns(now.since(began))));
                break Woken::Announced;
            }
        };
        self.words.asleep().store(0, Ordering::Relaxed);
        self.trusts |= woken == Woken::Woken;
        woken
    }

    /// Stays up for a wake that was announced, until `deadline` at most; whether it came.
    fn stay_up(&mut self, deadline: MonotonicNs) -> bool {
        let Some(up_until) = self.up_until else {
            return false;
        };
        while clock::monotonic() < up_until.min(deadline) {
            if self.look() {
                return true;
            }
            std::hint::spin_loop();
        }
        false
    }

    /// Whether there was a wake since the last look.
    fn look(&mut self) -> bool {
        let wakes = self.words.wakes().load(Ordering::SeqCst);
        let woken = wakes != self.seen;
        self.seen = wakes;
        woken
    }
}

/// One more than the number of the CPU that this thread runs on.
pub fn this_cpu() -> u32 {
    let cpu = sched_getcpu().ok().and_then(|cpu| u32::try_from(cpu).ok());
    // Without an answer all CPUs count as one, and nothing is announced.
    cpu.map_or(1, |cpu| cpu.saturating_add(1))
}

fn futex_wait(word: &AtomicU32, expected: u32, timeout_ns: u64) -> Result<(), Errno> {
    // A futex that other processes use, so without FUTEX_PRIVATE_FLAG; a relative timeout runs on
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
    // SAFETY: the kernel uses the address of the word only. It cannot fail on a word that is mapped.
    unsafe { libc::syscall(libc::SYS_futex, word.as_ptr(), libc::FUTEX_WAKE, 1) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lane_waits_for_no_longer_than_pays() {
        assert_eq!(stays_up_ns(0), 50_000);
        assert_eq!(stays_up_ns(200_000), 50_000, "at 5 kHz");
        assert_eq!(stays_up_ns(900_000), 56_250, "at 1 kHz");
        assert_eq!(stays_up_ns(10_000_000), 200_000, "at 100 Hz");
        assert_eq!(stays_up_ns(u64::MAX), 200_000);
    }
}
