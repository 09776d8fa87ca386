//! The payload of a received sample, and memory of the bridge in which the DDS library assembles large
//! samples, which saves a copy.

use bytes::Bytes;

pub use super::rustdds::{LentMemory, SampleMemory};

/// The payload of a sample that was taken from a reader.
pub enum Payload {
    /// In the library's receive buffer, which it keeps in memory until it is dropped.
    Bytes(Bytes),
    /// In memory that was [lent](super::RawReader::lend_memory) for it.
    Lent(Box<dyn LentMemory>),
}
