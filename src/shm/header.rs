//! The sample header as shared memory carries it, and the check of what was read there.

use std::fmt;

use crate::model::SampleHeader;

/// The size of a [`SampleHeader`] in shared memory.
pub const HEADER_BYTES: usize = size_of::<SampleHeader>();

/// What is wrong with a header that was read from shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeaderError {
    /// Not [`HEADER_BYTES`] long.
    WrongLength,
    /// Sequences begin at 1.
    SequenceZero,
    /// The reserved field is not 0.
    ReservedNotZero,
}

impl fmt::Display for HeaderError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::WrongLength => "a sample header of the wrong length",
            Self::SequenceZero => "a sample header with sequence 0",
            Self::ReservedNotZero => "a sample header whose reserved field is not 0",
        })
    }
}

impl std::error::Error for HeaderError {}

/// Reads a header from bytes that any process may have written.
pub fn decode_header(bytes: &[u8]) -> Result<SampleHeader, HeaderError> {
    let _ = bytes;
    todo!()
}
