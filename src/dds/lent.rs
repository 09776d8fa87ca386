//! Memory of the bridge in which the DDS library assembles large samples, which saves a copy.

use std::any::Any;
use std::sync::Arc;

use super::rustdds;

/// Lends memory for samples that arrive in fragments.
pub trait SampleMemory: Send + Sync {
    /// Lends memory for a payload of `len` bytes; `None` when none is free, and the DDS library then uses its
    /// own. Called on the thread that receives: must not wait.
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>>;
}

/// Memory for one payload. A reader returns it in [`Payload::Lent`]; the DDS library drops it if the sample
/// never becomes complete.
pub trait LentMemory: Any + Send {
    /// The memory, of the requested length.
    fn bytes(&mut self) -> &mut [u8];
}

/// The payload of a sample that was taken from a reader.
pub enum Payload<'a> {
    /// In the library's receive buffer, from which it must be copied.
    Bytes(&'a [u8]),
    /// In memory that was lent for it.
    Lent(Box<dyn LentMemory>),
}

impl Payload<'_> {
    /// Calls `read` with the bytes, wherever they are.
    pub(super) fn with_bytes<R>(self, read: impl FnOnce(&[u8]) -> R) -> R {
        match self {
            Self::Bytes(bytes) => read(bytes),
            Self::Lent(mut memory) => read(memory.bytes()),
        }
    }
}

/// Implements RustDDS' trait of the same name with a [`SampleMemory`] of the bridge.
pub(super) struct SampleMemoryAdapter(pub Arc<dyn SampleMemory>);

/// Implements RustDDS' trait of the same name with a [`LentMemory`] of the bridge.
pub(super) struct LentMemoryAdapter(pub Box<dyn LentMemory>);

impl rustdds::SampleMemory for SampleMemoryAdapter {
    fn lend(&self, len: usize) -> Option<Box<dyn rustdds::LentMemory>> {
        Some(Box::new(LentMemoryAdapter(self.0.lend(len)?)))
    }
}

impl rustdds::LentMemory for LentMemoryAdapter {
    fn bytes(&mut self) -> &mut [u8] {
        self.0.bytes()
    }
}
