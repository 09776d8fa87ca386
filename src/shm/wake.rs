//! Wakes a lane by a futex in the memory of the boards.
//!
//! A lane has a count of wakes, and a flag that is set while it sleeps. A waker increments the count, and
//! calls the kernel only if the flag is set. The lane sets the flag, reads the count again, and sleeps only
//! if the count has not changed. Both sides write before they read, sequentially consistent, so at least one
//! of them sees the write of the other: no wake is lost. There is no descriptor and no buffer that could fill
//! up while a lane is stopped. `docs/decisions/0004-shared-memory.md` has the measurements.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use nix::errno::Errno;
use nix::libc;

use super::segment::Segment;
use crate::clock;

/// Why [`LaneSleeper::sleep`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// There was a wake since the last return, or a signal interrupted the sleep.
    Woken,
    /// The sleep timed out without a wake.
    TimedOut,
}

/// The wake count and the sleep flag of a lane, on their own cache line.
#[derive(Clone, Debug)]
struct WakeWords {
    segment: Arc<Segment>,
    at: usize,
}

impl WakeWords {
    /// The number of wakes so far; the futex.
    fn wake_count(&self) -> &AtomicU32 {
        self.segment.half(self.at)
    }

    /// 1 while the lane sleeps, else 0.
    fn is_sleeping(&self) -> &AtomicU32 {
        self.segment.half(self.at + 1)
    }
}

/// Wakes one lane. Any process or thread may hold any number of wakers.
#[derive(Clone, Debug)]
pub struct LaneWaker {
    words: WakeWords,
}

impl LaneWaker {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        Self { words: WakeWords { segment, at } }
    }

    /// Wakes the lane. Never blocks, even while the lane's process is stopped. Several wakes before the lane
    /// checks for them are one. Calls the kernel only if the lane sleeps.
    pub fn wake(&self) {
        self.words.wake_count().fetch_add(1, Ordering::SeqCst);
        if self.words.is_sleeping().load(Ordering::SeqCst) != 0 {
            futex_wake(self.words.wake_count());
        }
    }
}

/// Sleeps until its lane is woken. Each lane has one.
#[derive(Debug)]
pub struct LaneSleeper {
    words: WakeWords,
    /// The wake count at the last check.
    seen_count: u32,
}

impl LaneSleeper {
    pub(super) fn new(segment: Arc<Segment>, at: usize) -> Self {
        let words = WakeWords { segment, at };
        // There may have been wakes for an earlier process, so the first sleep returns at once.
        let seen_count = words.wake_count().load(Ordering::SeqCst).wrapping_sub(1);
        Self { words, seen_count }
    }

    /// Sleeps until a wake, or for `timeout` at most. Returns at once if there was a wake since the last
    /// return, and at the first call in a lane process. A signal also ends the sleep.
    pub fn sleep(&mut self, timeout: Duration) -> Woken {
        if self.take_wake() {
            return Woken::Woken;
        }
        let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX);
        let deadline = clock::monotonic().plus_ns(timeout_ns);
        self.words.is_sleeping().store(1, Ordering::SeqCst);
        let woken = loop {
            if self.take_wake() {
                break Woken::Woken;
            }
            let left_ns = deadline.since(clock::monotonic());
            if left_ns == 0 {
                break Woken::TimedOut;
            }
            // The kernel compares the count again, and sleeps only if it is still `seen_count`. It returns
            // without a new wake when a waker calls it for one that the lane has seen already.
            if futex_wait(self.words.wake_count(), self.seen_count, left_ns) == Err(Errno::EINTR) {
                self.take_wake();
                break Woken::Woken;
            }
        };
        self.words.is_sleeping().store(0, Ordering::Relaxed);
        woken
    }

    /// Returns whether there was a wake since the last call.
    fn take_wake(&mut self) -> bool {
        let count = self.words.wake_count().load(Ordering::SeqCst);
        let woken = count != self.seen_count;
        self.seen_count = count;
        woken
    }
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
