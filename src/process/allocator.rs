//! How much free memory the allocator of the process keeps.

#[cfg(target_env = "gnu")]
use nix::libc;
#[cfg(target_env = "gnu")]
use tracing::debug;

/// The size from which the allocator returns a freed block to the kernel: its default, which it otherwise
/// raises to that of the largest block freed. The DDS library receives into blocks of 256 KiB. When more of
/// them were in use than ever before, such as for the announcements of a hundred participants that join
/// together, the process kept their memory: with 9,500 participants that came and went, ingress grew by 1.6
/// MiB and control by 2.4, and now by 0.8 and 1.3.
#[cfg(target_env = "gnu")]
const RETURNED_BYTES: libc::c_int = 128 << 10;

/// The areas from which the allocator takes memory. By default each thread takes it from one of its own, and
/// a block that another thread frees goes back to the area that it came from. With 9,500 participants that
/// came and went, control grew by 2.0 MiB, and with one area for all threads by 0.6 to 0.9; the other
/// processes by 0.3 to 0.8, and by 0.2 to 1.4.
#[cfg(target_env = "gnu")]
const AREAS: libc::c_int = 1;

/// Makes the allocator return large blocks to the kernel when they are freed, and take memory from one area
/// for all threads. It does the latter only when it is called before a second thread is started.
#[cfg(target_env = "gnu")]
pub fn bound_free_memory() {
    for (parameter, value) in [(libc::M_MMAP_THRESHOLD, RETURNED_BYTES), (libc::M_ARENA_MAX, AREAS)] {
        // SAFETY: the call takes two numbers, and changes which memory the allocator takes and returns. It
        // may be called at any time and by any thread.
        let is_set = unsafe { libc::mallopt(parameter, value) } == 1;
        if !is_set {
            debug!(parameter, value, "the allocator keeps more memory that was freed");
        }
    }
}

/// Without the allocator of the GNU C library, nothing is changed.
#[cfg(not(target_env = "gnu"))]
pub fn bound_free_memory() {}
