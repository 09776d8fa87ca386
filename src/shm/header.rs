//! The sample header in shared memory, and its validation after reading.

use iceoryx2::prelude::ZeroCopySend;

use crate::model::{AgeBasis, Encapsulation, Guid, MonotonicNs, SampleHeader, SourceTimestamp};

/// The size of a [`SampleHeader`] in shared memory.
pub const HEADER_BYTES: usize = size_of::<SampleHeader>();

/// Why a sample header that was read from shared memory is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// The header is not [`HEADER_BYTES`] long.
    #[error("a sample header of the wrong length")]
    WrongLength,
    /// The sequence number is 0; sequence numbers begin at 1.
    #[error("a sample header with sequence number 0")]
    SequenceZero,
    /// The payload is longer than the route allows.
    #[error("a sample larger than its route allows")]
    PayloadTooLong,
}

/// Decodes and validates a header from bytes that any process may have written. Every encapsulation and
/// timestamp is accepted, because they are forwarded unchanged, and every age basis, because all its values
/// are valid.
pub fn decode_header(bytes: &[u8]) -> Result<SampleHeader, HeaderError> {
    let bytes: &[u8; HEADER_BYTES] = bytes.try_into().map_err(|_| HeaderError::WrongLength)?;
    let word = |at: usize| {
        let mut word = [0; 8];
        word.copy_from_slice(&bytes[at..at + 8]);
        u64::from_ne_bytes(word)
    };
    let mut writer_guid = Guid::default();
    writer_guid.0.copy_from_slice(&bytes[40..56]);
    let header = SampleHeader {
        sequence: word(0),
        source_timestamp: SourceTimestamp(word(8)),
        taken_at: MonotonicNs(word(16)),
        published_at: MonotonicNs(word(24)),
        writer_sequence: word(32).cast_signed(),
        writer_guid,
        encapsulation: Encapsulation([bytes[56], bytes[57], bytes[58], bytes[59]]),
        age_basis: AgeBasis::from_bits(u32::from_ne_bytes([bytes[60], bytes[61], bytes[62], bytes[63]])),
    };
    if header.sequence == 0 { Err(HeaderError::SequenceZero) } else { Ok(header) }
}

/// A [`SampleHeader`] as iceoryx2's user header.
#[derive(Clone, Copy, Debug, Default)]
#[repr(transparent)]
pub(super) struct WireHeader(pub(super) SampleHeader);

/// The header has no padding, so that every byte in shared memory is written.
const _: () = assert!(HEADER_BYTES == 8 + 8 + 8 + 8 + 8 + 16 + 4 + 4 && align_of::<SampleHeader>() == 8);

// SAFETY: `SampleHeader` is `repr(C)`, of integers and byte arrays only: no pointer, no reference, no handle
// of a process, no destructor, every bit pattern valid. The type name denotes exactly this layout, and the
// name of the service contains the version.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        "ab1::SampleHeader"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes_of(header: WireHeader) -> [u8; HEADER_BYTES] {
        // SAFETY: both are 64 bytes, and the header has no padding (asserted above).
        unsafe { std::mem::transmute(header) }
    }

    #[test]
    fn a_header_is_read_as_it_was_written() {
        let mut wire = WireHeader::default();
        wire.0.sequence = 0x0102_0304_0506_0708;
        wire.0.source_timestamp = SourceTimestamp(u64::MAX);
        wire.0.taken_at = MonotonicNs(3);
        wire.0.published_at = MonotonicNs(4);
        wire.0.writer_sequence = -1;
        wire.0.writer_guid = Guid([7; 16]);
        wire.0.encapsulation = Encapsulation([1, 2, 3, 4]);
        wire.0.age_basis = AgeBasis::arrival(5_000);
        assert_eq!(decode_header(&bytes_of(wire)), Ok(wire.0));
    }

    #[test]
    fn headers_that_ingress_never_writes_are_refused() {
        let wire = WireHeader::default();
        assert_eq!(decode_header(&bytes_of(wire)), Err(HeaderError::SequenceZero));
        assert_eq!(decode_header(&[0; HEADER_BYTES - 1]), Err(HeaderError::WrongLength));
        assert_eq!(decode_header(&[]), Err(HeaderError::WrongLength));
    }
}
