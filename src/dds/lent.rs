//! Memory that large samples are put together in, so that they need not be copied there.

use std::any::Any;
use std::sync::Arc;

use super::rustdds;

/// Lends memory for samples that arrive in fragments.
pub trait SampleMemory: Send + Sync {
    /// Memory for a payload of `len` bytes; `None` when there is none at hand, and the DDS library then uses
    /// its own. Called on the thread that receives: must not wait.
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>>;
}

/// Memory for one payload. Comes back in [`Payload::Lent`], or is dropped when the sample never becomes
/// complete.
pub trait LentMemory: Any + Send {
    /// The memory, as long as what was asked for.
    fn bytes(&mut self) -> &mut [u8];
}

/// A payload as a reader hands it over.
pub enum Payload<'a> {
    /// In the library's receive buffer: to be copied.
    Bytes(&'a [u8]),
    /// In memory that was lent for it.
    Lent(Box<dyn LentMemory>),
}

impl Payload<'_> {
    /// Lends the bytes to `look`, wherever they are.
    pub(super) fn with_bytes<R>(self, look: impl FnOnce(&[u8]) -> R) -> R {
        match self {
            Self::Bytes(bytes) => look(bytes),
            Self::Lent(mut memory) => look(memory.bytes()),
        }
    }
}

/// What the library knows of who lends.
pub(super) struct Lender(pub Arc<dyn SampleMemory>);

/// What the library knows of what was lent.
pub(super) struct Lent(pub Box<dyn LentMemory>);

impl rustdds::SampleMemory for Lender {
    fn lend(&self, len: usize) -> Option<Box<dyn rustdds::LentMemory>> {
        Some(Box::new(Lent(self.0.lend(len)?)))
    }
}

impl rustdds::LentMemory for Lent {
    fn bytes(&mut self) -> &mut [u8] {
        self.0.bytes()
    }
}
