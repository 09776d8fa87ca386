//! The history for late joiners of a writer whose samples come from several sources.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::{
  rtps::constant::{DEFAULT_WRITER_MAX_SAMPLES, KEEP_LAST_MAX_RETAINED_BYTES},
  structure::{cache_change::CacheChange, guid::GUID, sequence_number::SequenceNumber},
};

/// The last samples of each source, for a KEEP_LAST writer that is not VOLATILE.
///
/// A writer that forwards the samples of several writers has one sequence of numbers for
/// all of them, and its last `depth` samples may all be of one source. So each source has
/// a history of its own, as an instance of a keyed topic has (DDS v1.4 Section 2.2.3.18).
///
/// The samples are in the send buffer as long as it retains them for other reasons, and
/// here afterwards.
#[derive(Debug, Default)]
pub(crate) struct SourceHistory {
  // The last `depth` numbers of each source, in order.
  sources: BTreeMap<GUID, VecDeque<SequenceNumber>>,
  // Those that the send buffer has released.
  kept: BTreeMap<SequenceNumber, CacheChange>,
  kept_bytes: usize,
  evicted: u64,
}

impl SourceHistory {
  /// A sample of this source is written. Its history loses the oldest one.
  pub fn record(&mut self, source: GUID, sequence_number: SequenceNumber, depth: usize) {
    let numbers = self.sources.entry(source).or_default();
    numbers.push_back(sequence_number);
    while numbers.len() > depth.max(1) {
      let superseded = numbers.pop_front();
      if let Some(change) = superseded.and_then(|number| self.kept.remove(&number)) {
        self.kept_bytes -= change.data_value.payload_size();
      }
    }
  }

  /// The send buffer has released this sample. It is kept if its source's history has it,
  /// and if there are other sources: the send buffer retains the last samples of a single
  /// one.
  pub fn keep(&mut self, change: CacheChange) {
    let Some(source) = change.write_options.history_source() else {
      return;
    };
    let are_several = self.sources.len() > 1;
    let Some(numbers) = self.sources.get_mut(&source) else {
      return;
    };
    let Ok(place) = numbers.binary_search(&change.sequence_number) else {
      return;
    };
    if !are_several {
      numbers.remove(place);
      return;
    }
    self.kept_bytes += change.data_value.payload_size();
    self.kept.insert(change.sequence_number, change);
    while self.kept_bytes > KEEP_LAST_MAX_RETAINED_BYTES
      || self.kept.len() > DEFAULT_WRITER_MAX_SAMPLES
    {
      let Some((number, oldest)) = self.kept.pop_first() else {
        break;
      };
      self.kept_bytes -= oldest.data_value.payload_size();
      self.evicted += 1;
      let source = oldest.write_options.history_source();
      if let Some(numbers) = source.and_then(|source| self.sources.get_mut(&source)) {
        numbers.retain(|listed| *listed != number);
      }
    }
  }

  /// Forgets a source and its samples.
  pub fn forget(&mut self, source: GUID) {
    for number in self.sources.remove(&source).unwrap_or_default() {
      if let Some(change) = self.kept.remove(&number) {
        self.kept_bytes -= change.data_value.payload_size();
      }
    }
  }

  pub fn get(&self, sequence_number: SequenceNumber) -> Option<&CacheChange> {
    self.kept.get(&sequence_number)
  }

  /// The first and the last sample that only this history has.
  pub fn kept_range(&self) -> Option<(SequenceNumber, SequenceNumber)> {
    let first = self.kept.first_key_value()?.0;
    Some((*first, *self.kept.last_key_value()?.0))
  }

  /// The kept samples before this number.
  pub fn kept_before(&self, before: SequenceNumber) -> BTreeSet<SequenceNumber> {
    self.kept.range(..before).map(|(number, _)| *number).collect()
  }

  /// The first kept sample after this number.
  pub fn kept_after(&self, sequence_number: SequenceNumber) -> Option<SequenceNumber> {
    let mut later = self.kept.range(sequence_number.plus_1()..);
    later.next().map(|(number, _)| *number)
  }

  /// The kept samples of this range, which is empty if it ends before it begins.
  pub fn kept_between(
    &self,
    first: SequenceNumber,
    before: SequenceNumber,
  ) -> impl Iterator<Item = SequenceNumber> + '_ {
    let kept = self.kept.range(first..first.max(before));
    kept.map(|(number, _)| *number)
  }

  /// The numbers of the history of all sources; `None` while there is one source at most,
  /// whose history is what the send buffer retained last.
  pub fn numbers(&self) -> Option<BTreeSet<SequenceNumber>> {
    let are_several = self.sources.len() > 1 || !self.kept.is_empty();
    are_several.then(|| self.sources.values().flatten().copied().collect())
  }

  /// Samples that were evicted because of the bounds of the history.
  pub fn evicted(&self) -> u64 {
    self.evicted
  }
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::{
    dds::{ddsdata::DDSData, with_key::datawriter::WriteOptionsBuilder},
    messages::submessages::elements::serialized_payload::SerializedPayload,
    structure::guid::{EntityId, GuidPrefix},
    RepresentationIdentifier,
  };

  fn source(number: u8) -> GUID {
    GUID::new(GuidPrefix::new(&[number; 12]), EntityId::UNKNOWN)
  }

  fn change(of: u8, number: i64, bytes: usize) -> CacheChange {
    let payload = SerializedPayload::new(RepresentationIdentifier::CDR_LE, vec![0; bytes]);
    let options = WriteOptionsBuilder::new().history_source(source(of));
    CacheChange::new(
      GUID::GUID_UNKNOWN,
      SequenceNumber::new(number),
      options.build(),
      DDSData::new(payload),
    )
  }

  fn numbers(history: &SourceHistory) -> Option<Vec<i64>> {
    let numbers = history.numbers()?;
    Some(numbers.into_iter().map(i64::from).collect())
  }

  // Writes samples, each of which the send buffer releases at once.
  fn write(history: &mut SourceHistory, depth: usize, samples: &[(u8, i64)], bytes: usize) {
    for (of, number) in samples {
      history.record(source(*of), SequenceNumber::new(*number), depth);
      history.keep(change(*of, *number, bytes));
    }
  }

  #[test]
  fn each_source_has_its_own_last_samples() {
    let mut history = SourceHistory::default();
    history.record(source(1), SequenceNumber::new(1), 2);
    write(&mut history, 2, &[(2, 2), (2, 3), (2, 4)], 8);
    history.keep(change(1, 1, 8));
    assert_eq!(numbers(&history), Some(vec![1, 3, 4]));
    assert!(history.get(SequenceNumber::new(2)).is_none());
    assert_eq!(
      history.kept_range(),
      Some((SequenceNumber::new(1), SequenceNumber::new(4)))
    );
    assert_eq!(
      history.kept_after(SequenceNumber::new(1)),
      Some(SequenceNumber::new(3))
    );
    write(&mut history, 2, &[(1, 5), (1, 6)], 8);
    assert_eq!(numbers(&history), Some(vec![3, 4, 5, 6]));
    history.forget(source(2));
    assert_eq!(numbers(&history), Some(vec![5, 6]));
    assert!(history.get(SequenceNumber::new(3)).is_none());
    assert_eq!(history.evicted(), 0);
  }

  #[test]
  fn nothing_is_kept_of_a_single_source() {
    let mut history = SourceHistory::default();
    write(&mut history, 2, &[(1, 1), (1, 2), (1, 3)], 8);
    assert_eq!((numbers(&history), history.kept_range()), (None, None));
    // What was released before the second source came is gone.
    write(&mut history, 2, &[(2, 4)], 8);
    assert_eq!(numbers(&history), Some(vec![4]));
  }

  #[test]
  fn the_history_is_bounded_and_loses_the_oldest_samples() {
    let mut history = SourceHistory::default();
    history.record(source(0), SequenceNumber::new(1), 1);
    for of in 1..=40 {
      write(&mut history, 1, &[(of, i64::from(of) + 1)], 1 << 20);
    }
    assert!(history.kept_bytes <= KEEP_LAST_MAX_RETAINED_BYTES);
    let kept = numbers(&history).unwrap();
    assert_eq!(kept.last(), Some(&41));
    assert_eq!(history.evicted(), 41 - kept.len() as u64);
    // Number 1 is in the send buffer.
    assert_eq!(kept[0], 1);
    assert_eq!(kept[1], 41 - (kept.len() as i64 - 2));
  }
}
