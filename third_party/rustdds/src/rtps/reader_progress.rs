//! What a Writer knows of the progress of each matched reader.

use std::sync::{
  atomic::{AtomicI64, AtomicU64, Ordering},
  Arc,
};

use crate::structure::{guid::GUID, sequence_number::SequenceNumber};

/// Samples that one matched reader was offered, has acknowledged, and missed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MatchedReader {
  /// The reader.
  pub guid: GUID,
  /// Whether it requested RELIABLE.
  pub reliable: bool,
  /// Samples written since the reader was matched, and the history that it was
  /// offered then.
  pub offered: u64,
  /// Of those, samples that a RELIABLE reader has not acknowledged; 0 for a
  /// BEST_EFFORT one.
  pub unacknowledged: u64,
  /// Of those, samples that left the writer's history before the reader had them.
  /// Exact while the reader is less than 256 samples behind; beyond that, samples
  /// of which the reader has said nothing count as missed.
  pub overrun: u64,
}

/// The record behind a [`MatchedReader`]: the Writer updates it on its event loop,
/// any thread may read it.
#[derive(Debug)]
pub(crate) struct ReaderProgress {
  reader: GUID,
  reliable: bool,
  first_offered: SequenceNumber,
  acked_before: AtomicI64,
  overrun: AtomicU64,
}

impl ReaderProgress {
  pub fn new(reader: GUID, reliable: bool, first_offered: SequenceNumber) -> Self {
    Self {
      reader,
      reliable,
      first_offered,
      acked_before: AtomicI64::new(first_offered.into()),
      overrun: AtomicU64::new(0),
    }
  }

  pub fn first_offered(&self) -> SequenceNumber {
    self.first_offered
  }

  pub fn set_acked_before(&self, acked_before: SequenceNumber) {
    self
      .acked_before
      .store(acked_before.into(), Ordering::Relaxed);
  }

  pub fn add_overrun(&self, samples: u64) {
    self.overrun.fetch_add(samples, Ordering::Relaxed);
  }

  pub fn snapshot(&self, last: SequenceNumber) -> MatchedReader {
    let through_last = |first: i64| u64::try_from(i64::from(last) + 1 - first).unwrap_or(0);
    MatchedReader {
      guid: self.reader,
      reliable: self.reliable,
      offered: through_last(self.first_offered.into()),
      unacknowledged: if self.reliable {
        through_last(self.acked_before.load(Ordering::Relaxed))
      } else {
        0
      },
      overrun: self.overrun.load(Ordering::Relaxed),
    }
  }
}

// Two proxies of one reader are the same proxy whatever its progress.
impl PartialEq for ReaderProgress {
  fn eq(&self, other: &Self) -> bool {
    self.reader == other.reader
  }
}

impl Eq for ReaderProgress {}

pub(crate) type SharedProgress = Arc<ReaderProgress>;
