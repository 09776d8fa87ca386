//! A large sample of which ingress has received a part.

use super::health::FixedText;
use super::sample::{Encapsulation, Guid};
use super::time::{MonotonicNs, SourceTimestamp};

/// A large sample of which ingress has received a part, on a board: a critical lane may send that part while
/// the rest arrives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct PartialSample {
    /// Increases by one with each such sample of the route, also across restarts of ingress; 0 for none.
    pub number: u64,
    /// The publisher's DDS writer.
    pub writer_guid: Guid,
    /// The sequence number that the writer gave the sample.
    pub writer_sequence: i64,
    /// Its source timestamp.
    pub source_timestamp: SourceTimestamp,
    /// When its first fragment arrived.
    pub began_at: MonotonicNs,
    /// Where its payload begins in the file of the route's pool.
    pub pool_offset: u64,
    /// The length of the payload in bytes.
    pub len: u64,
    /// The bytes from the beginning of the payload that are complete.
    pub available: u64,
    /// How the payload is encoded.
    pub encapsulation: Encapsulation,
    /// 1 if the sample never becomes complete, else 0.
    pub ended: u32,
    /// The number of the last sample that ingress took when it was complete.
    pub taken_number: u64,
    /// The file of the route's pool in shared memory.
    pub pool: FixedText,
}
