//! Samples that are put together in memory of the application.

use std::{
  fmt,
  sync::{Arc, Mutex, PoisonError},
};

/// Where the application has memory for samples that arrive in fragments: one
/// that is put together there need not be copied from the library's memory. See
/// [`set_sample_memory`](crate::no_key::SimpleDataReader::set_sample_memory).
pub trait SampleMemory: Send + Sync {
  /// Memory of `len` bytes, for a payload without its encapsulation header;
  /// `None` has the library use its own. On the thread that receives, which
  /// waits meanwhile.
  fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>>;
}

/// Memory for one sample. The library drops it when the sample never becomes
/// complete, or when nobody takes it.
pub trait LentMemory: Send {
  /// The memory, as long as what was asked for. The same bytes at each call.
  fn bytes(&mut self) -> &mut [u8];

  /// Gives the memory, with the whole sample in it, back to the application that
  /// lent it, and has now taken the sample. The library does not call this.
  fn finish(self: Box<Self>);
}

// The payload of a complete sample, until a reader takes it.
#[derive(Clone)]
pub struct Lent {
  len: usize,
  memory: Arc<Mutex<Option<Box<dyn LentMemory>>>>,
}

impl Lent {
  pub(crate) fn new(len: usize, memory: Box<dyn LentMemory>) -> Self {
    Self {
      len,
      memory: Arc::new(Mutex::new(Some(memory))),
    }
  }

  pub(crate) fn len(&self) -> usize {
    self.len
  }

  // Shows the memory, for the first one to take it out.
  pub(crate) fn with<R>(&self, look: impl FnOnce(&mut Option<Box<dyn LentMemory>>) -> R) -> R {
    look(&mut self.memory.lock().unwrap_or_else(PoisonError::into_inner))
  }
}

impl fmt::Debug for Lent {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    write!(f, "Lent({} bytes)", self.len)
  }
}

impl PartialEq for Lent {
  fn eq(&self, other: &Self) -> bool {
    Arc::ptr_eq(&self.memory, &other.memory)
  }
}

impl Eq for Lent {}

// Who is asked for memory, if anybody is.
#[derive(Clone, Default)]
pub(crate) struct Lender(pub Option<Arc<dyn SampleMemory>>);

impl fmt::Debug for Lender {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    f.write_str(if self.0.is_some() { "Lender" } else { "none" })
  }
}
