//! The sample header in shared memory.

use iceoryx2::prelude::ZeroCopySend;

use crate::model::SampleHeader;

/// Why a sample header that was read from shared memory is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// The sequence number is 0; sequence numbers begin at 1.
    #[error("a sample header with sequence number 0")]
    SequenceZero,
    /// The payload is longer than the route allows.
    #[error("a sample larger than its route allows")]
    PayloadTooLong,
}

/// iceoryx2's user header: a [`SampleHeader`], and the length of the payload for processes that read the slot
/// without a port of the channel.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct WireHeader {
    pub(super) sample: SampleHeader,
    pub(super) payload_bytes: u64,
}

/// The header has no padding, so that every byte in shared memory is written.
const _: () = assert!(
    size_of::<WireHeader>() == size_of::<SampleHeader>() + 8
        && size_of::<SampleHeader>() == 8 + 8 + 8 + 8 + 8 + 16 + 4 + 4 + 24
        && align_of::<SampleHeader>() == 8
);

// SAFETY: `SampleHeader` is `repr(C)`, of integers and byte arrays only: no pointer, no reference, no handle
// of a process, no destructor, every bit pattern valid. The type name denotes exactly this layout, and the
// name of the service contains the version.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "ab3::SampleHeader"
    }
}
