//! Samples that are put together in memory of the application.

use std::{
  fmt,
  sync::{Arc, Mutex, PoisonError},
};

use crate::structure::{guid::GUID, sequence_number::SequenceNumber, time::Timestamp};

/// Where the application has memory for samples that arrive in fragments: one
/// that is put together there need not be copied from the library's memory. See
/// [`set_sample_memory`](crate::no_key::SimpleDataReader::set_sample_memory).
pub trait SampleMemory: Send + Sync {
  /// Memory of `len` bytes, for a payload without its encapsulation header;
  /// `None` has the library use its own. On the thread that receives, which
  /// waits meanwhile.
  ///
  /// `len` is what the writer claims, at most 4 GiB. For a sample that is too large
  /// for the application, return memory that discards what is written to it.
  fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>>;

  /// How much memory of its own the library uses.
  fn limits(&self) -> AssemblyLimits {
    AssemblyLimits::default()
  }
}

/// How much of its own memory the library uses for samples of which fragments are
/// missing, at one Reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AssemblyLimits {
  /// The largest serialized sample. Fragments of a larger one are dropped.
  pub max_sample_bytes: usize,
  /// All samples together, with 4 KiB for each and one bit for each fragment. When they
  /// need more, one sample of the Writer with the most of it is discarded. All Readers of a
  /// participant together have
  /// [`DomainParticipantBuilder::with_max_unfinished_bytes`](crate::DomainParticipantBuilder::with_max_unfinished_bytes).
  pub max_total_bytes: usize,
  /// Complete samples that the topic keeps in the library's memory, whether they were taken
  /// or not. `None`: only the number of samples in the Readers' History limits them.
  pub max_kept_bytes: Option<usize>,
}

impl Default for AssemblyLimits {
  // Where memory is locked (mlockall), zeroed memory is committed at once.
  fn default() -> Self {
    Self {
      max_sample_bytes: 64 * 1024 * 1024 + 4,
      max_total_bytes: 2 * (64 * 1024 * 1024 + 4),
      max_kept_bytes: None,
    }
  }
}

// Of the Readers of built-in topics, which assemble what any participant sends.
struct BuiltIn;

impl SampleMemory for BuiltIn {
  fn lend(&self, _len: usize) -> Option<Box<dyn LentMemory>> {
    None
  }

  // Discovery data are parameter lists of some hundred bytes.
  fn limits(&self) -> AssemblyLimits {
    AssemblyLimits {
      max_sample_bytes: 256 * 1024,
      max_total_bytes: 4 * 1024 * 1024,
      max_kept_bytes: None,
    }
  }
}

/// A sample of which fragments have arrived, but not all of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PartialArrival {
  /// The Writer that sends it.
  pub writer: GUID,
  /// Its sequence number.
  pub sequence_number: SequenceNumber,
  /// Its source timestamp, if a fragment that arrived had one.
  pub source_timestamp: Option<Timestamp>,
  /// Its encapsulation header: the representation identifier and the options.
  pub encapsulation: [u8; 4],
  /// The payload bytes without a gap from its beginning, which do not change any more.
  pub complete_bytes: usize,
}

/// Memory for one sample. The library drops it when the sample never becomes
/// complete, or when nobody takes it.
pub trait LentMemory: Send {
  /// The memory, as long as what was asked for, or empty if [`write`](Self::write)
  /// discards. The same bytes at each call.
  fn bytes(&mut self) -> &mut [u8];

  /// Writes a part of the sample at `from`, within the length that was asked for.
  fn write(&mut self, from: usize, data: &[u8]) {
    self.bytes()[from..from + data.len()].copy_from_slice(data);
  }

  /// Fragments have arrived that lengthen the part without a gap at the sample's beginning,
  /// and others are missing. On the thread that receives, which waits meanwhile.
  fn arrived(&mut self, _arrival: &PartialArrival) {}

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

impl Lender {
  pub fn built_in() -> Self {
    Self(Some(Arc::new(BuiltIn)))
  }

  pub fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
    self.0.as_ref()?.lend(len)
  }

  pub fn limits(&self) -> AssemblyLimits {
    self
      .0
      .as_ref()
      .map_or_else(AssemblyLimits::default, |memory| memory.limits())
  }
}

impl fmt::Debug for Lender {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    f.write_str(if self.0.is_some() { "Lender" } else { "none" })
  }
}
