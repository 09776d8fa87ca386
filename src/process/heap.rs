//! Returns memory that was freed to the kernel.
//!
//! The allocator keeps freed memory for later use. What the DDS library knows of a participant is thousands of
//! small blocks, and those of participants that are gone lie between blocks that stay in use. With 9,500
//! participants that came and went, 100 at a time, the memory in use grew by 0.2 MiB, and that of the
//! process by up to 2.4 MiB.

use nix::libc;
use tracing::debug;

use crate::model::MonotonicNs;

/// How long after a participant has gone its memory is returned: the DDS library frees the last of it after
/// up to 5 s. Later ones are included, so that this is also the shortest interval.
const DELAY_MS: u64 = 10_000;

/// The size from which the allocator returns a freed block at once: its default, which it otherwise raises to
/// that of the largest block freed. The DDS library receives into blocks of 256 KiB, and needs more of them
/// than ever before when a hundred participants join together.
#[cfg(target_env = "gnu")]
const RETURNED_BYTES: libc::c_int = 128 << 10;

/// When to return memory: some time after a participant has gone. A process without such changes never
/// pays for it: 0.1 to 0.4 ms, in which other threads wait if they allocate more than their caches have.
#[derive(Default)]
pub(super) struct FreedMemory {
    participants_gone: u64,
    due: Option<MonotonicNs>,
}

impl FreedMemory {
    /// Whether to return memory now. `participants_gone` is the number of those that have gone since the
    /// process began.
    pub fn is_due(&mut self, participants_gone: u64, now: MonotonicNs) -> bool {
        if participants_gone != self.participants_gone {
            self.participants_gone = participants_gone;
            self.due.get_or_insert(now.plus_ms(DELAY_MS));
        }
        self.due.take_if(|due| now >= *due).is_some()
    }
}

/// Makes the allocator return large blocks to the kernel when they are freed.
#[cfg(target_env = "gnu")]
pub(super) fn return_large_blocks() {
    // SAFETY: the call takes two numbers, and changes which blocks the allocator maps on their own. It may
    // be called at any time and by any thread.
    let is_set = unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, RETURNED_BYTES) } == 1;
    if !is_set {
        debug!("the allocator keeps the memory of large blocks that were freed");
    }
}

/// Returns the pages that hold freed memory only to the kernel. It has no effect on locked memory
/// (madvise(2), EINVAL), which stays at its highest need.
#[cfg(target_env = "gnu")]
pub(super) fn return_freed() {
    // SAFETY: the call takes a number, and gives up only memory that the allocator itself knows to be free.
    // It may be called at any time and by any thread.
    let has_returned = unsafe { libc::malloc_trim(0) } == 1;
    debug!(has_returned, "returned freed memory to the kernel");
}

#[cfg(not(target_env = "gnu"))]
pub(super) fn return_large_blocks() {}

#[cfg(not(target_env = "gnu"))]
pub(super) fn return_freed() {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_returned_once_after_participants_have_gone() {
        let mut freed = FreedMemory::default();
        let at = |ms| MonotonicNs::default().plus_ms(ms);
        assert!(!freed.is_due(0, at(20_000)), "nobody has gone");
        assert!(!freed.is_due(1, at(20_000)));
        assert!(!freed.is_due(2, at(29_999)));
        assert!(freed.is_due(2, at(30_000)));
        assert!(!freed.is_due(2, at(90_000)), "nobody has gone since");
        assert!(!freed.is_due(3, at(90_000)));
        assert!(freed.is_due(3, at(100_000)));
    }
}
