//! The payload of a received sample, and memory of the bridge in which the DDS library assembles large
//! samples, which saves a copy.

use bytes::Bytes;

pub use super::rustdds::{AssemblyLimits, LentMemory, SampleMemory};

/// The payload of a sample that was taken from a reader.
pub enum Payload {
    /// In the library's receive buffer, which it keeps in memory until it is dropped.
    Bytes(Bytes),
    /// In memory that was [lent](super::RawReader::lend_memory) for it.
    Lent(Box<dyn LentMemory>),
}

/// Of topics with samples of at most some KiB: graph entries, probes and their responses. Anyone on the
/// network can send fragments that claim more.
pub(super) struct SmallSamples;

impl SampleMemory for SmallSamples {
    fn lend(&self, _len: usize) -> Option<Box<dyn LentMemory>> {
        None
    }

    fn limits(&self) -> AssemblyLimits {
        AssemblyLimits { max_sample_bytes: 1 << 20, max_total_bytes: 4 << 20 }
    }
}
