//! What a Writer knows of the progress of each matched reader.

use std::{
  collections::BTreeSet,
  sync::{
    atomic::{AtomicI64, AtomicU64, Ordering},
    Arc,
  },
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
  first_if_reset: SequenceNumber,
  history: Option<OfferedHistory>,
  // Samples that had been withdrawn when the reader was matched.
  withdrawn_before: u64,
  acked_before: AtomicI64,
  overrun: AtomicU64,
}

/// A history with holes, such as the last samples of several sources: of what was written
/// before the reader was matched, it is offered these only.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct OfferedHistory {
  pub listed: BTreeSet<SequenceNumber>,
  /// The first number after this history: the first one that was written, or is to be sent
  /// to all, after the match.
  pub before: SequenceNumber,
}

impl OfferedHistory {
  /// If this sample is not offered, the next one that is.
  pub fn offered_after(&self, sequence_number: SequenceNumber) -> Option<SequenceNumber> {
    if sequence_number >= self.before || self.listed.contains(&sequence_number) {
      return None;
    }
    let later = self.listed.range(sequence_number..self.before).next();
    Some(later.copied().unwrap_or(self.before))
  }
}

impl ReaderProgress {
  pub fn new(reader: GUID, reliable: bool, first_offered: SequenceNumber) -> Self {
    Self {
      reader,
      reliable,
      first_offered,
      first_if_reset: first_offered,
      history: None,
      withdrawn_before: 0,
      acked_before: AtomicI64::new(first_offered.into()),
      overrun: AtomicU64::new(0),
    }
  }

  #[must_use]
  pub fn with_history(mut self, history: Option<OfferedHistory>) -> Self {
    self.history = history;
    self
  }

  /// A reader of the writer that this one continues. If it has lost its state meanwhile, it is a
  /// new one, to which nothing from before its match is sent.
  #[must_use]
  pub fn or_if_reset(mut self, first: SequenceNumber) -> Self {
    self.first_if_reset = first;
    self
  }

  /// The first sample for a reader that has no state of the writer.
  pub fn first_if_reset(&self) -> SequenceNumber {
    self.first_if_reset
  }

  /// Of a Writer that had withdrawn so many samples when the reader was matched.
  #[must_use]
  pub fn without_withdrawn(mut self, withdrawn: u64) -> Self {
    self.withdrawn_before = withdrawn;
    self
  }

  /// If the reader is not offered this sample, the next one that it is offered.
  pub fn offered_after(&self, sequence_number: SequenceNumber) -> Option<SequenceNumber> {
    self.history.as_ref()?.offered_after(sequence_number)
  }

  /// Whether the reader is offered this sample of the history.
  pub fn offers_of_history(&self, sequence_number: SequenceNumber) -> bool {
    let history = self.history.as_ref();
    history.is_some_and(|history| history.listed.contains(&sequence_number))
  }

  /// How many samples of this range the reader is offered.
  pub fn offered_between(&self, first: SequenceNumber, before: SequenceNumber) -> u64 {
    let (listed, first) = match &self.history {
      Some(history) if first < history.before => {
        let end = history.before.min(before);
        let listed = if first < end {
          history.listed.range(first..end).count()
        } else {
          0
        };
        (listed as u64, history.before)
      }
      _ => (0, first),
    };
    listed + u64::try_from(i64::from(before) - i64::from(first)).unwrap_or(0)
  }

  pub fn first_offered(&self) -> SequenceNumber {
    self.first_offered
  }

  pub fn is_reliable(&self) -> bool {
    self.reliable
  }

  pub fn set_acked_before(&self, acked_before: SequenceNumber) {
    self
      .acked_before
      .store(acked_before.into(), Ordering::Relaxed);
  }

  pub fn add_overrun(&self, samples: u64) {
    self.overrun.fetch_add(samples, Ordering::Relaxed);
  }

  pub fn overrun(&self) -> u64 {
    self.overrun.load(Ordering::Relaxed)
  }

  /// `withdrawn` samples were withdrawn by now, `withdrawn_from` of them from a number on.
  pub fn snapshot(
    &self,
    last: SequenceNumber,
    withdrawn: u64,
    withdrawn_from: impl Fn(SequenceNumber) -> u64,
  ) -> MatchedReader {
    let through_last = |first| self.offered_between(first, last.plus_1());
    let offered = through_last(self.first_offered);
    MatchedReader {
      guid: self.reader,
      reliable: self.reliable,
      offered: offered.saturating_sub(withdrawn - self.withdrawn_before),
      unacknowledged: if self.reliable {
        let first = SequenceNumber::new(self.acked_before.load(Ordering::Relaxed));
        through_last(first).saturating_sub(withdrawn_from(first))
      } else {
        0
      },
      overrun: self.overrun(),
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
