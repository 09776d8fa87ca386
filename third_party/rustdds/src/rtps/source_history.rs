//! The history for late joiners of a writer whose samples come from several sources.

use std::{
  cmp::max,
  collections::{BTreeMap, BTreeSet, VecDeque},
};

use crate::{
  dds::with_key::datawriter::WriteOptions,
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
  // The last `depth` numbers of each source, in order; of a topic with keys, of each
  // source and key hash.
  sources: BTreeMap<Source, VecDeque<SequenceNumber>>,
  has_keys: bool,
  // Those that the send buffer has released.
  kept: BTreeMap<SequenceNumber, CacheChange>,
  kept_bytes: usize,
  evicted: u64,
}

// A source, and the key hash of an instance.
type Source = (GUID, Option<[u8; 16]>);

// How many samples a source of a topic with keys has if it sends no key hashes, so that the
// instances are not known: then a late joiner gets more than the last `depth` of each, and
// forgets the others by its own HISTORY.
const DEPTH_OF_UNKNOWN_KEYS: usize = 1024;

fn source_of(options: &WriteOptions) -> Option<Source> {
  let key_hash = options.instance_change().and_then(|change| change.key_hash);
  Some((options.history_source()?, key_hash))
}

impl SourceHistory {
  /// A sample is written. The history of its source, if it has one, loses the oldest.
  pub fn record(&mut self, options: &WriteOptions, sequence_number: SequenceNumber, depth: usize) {
    let Some(source) = source_of(options) else {
      return;
    };
    let is_keyed = options.instance_change().is_some();
    self.has_keys |= is_keyed;
    let depth = if is_keyed && source.1.is_none() {
      max(depth, DEPTH_OF_UNKNOWN_KEYS)
    } else {
      depth
    };
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
    let Some(source) = source_of(&change.write_options) else {
      return;
    };
    let are_several = self.are_several();
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
      let Some(source) = source_of(&oldest.write_options) else {
        continue;
      };
      if let Some(numbers) = self.sources.get_mut(&source) {
        numbers.retain(|listed| *listed != number);
        // The sender chooses the keys: their number is bounded as that of the samples is.
        if numbers.is_empty() && source.1.is_some() {
          self.sources.remove(&source);
        }
      }
    }
  }

  // Whether the last samples of the send buffer are not the history.
  fn are_several(&self) -> bool {
    self.sources.len() > 1 || self.has_keys
  }

  /// Forgets a source and its samples.
  pub fn forget(&mut self, source: GUID) {
    let of_source = (source, None)..=(source, Some([u8::MAX; 16]));
    let keys: Vec<Source> = self.sources.range(of_source).map(|(key, _)| *key).collect();
    for number in keys.iter().filter_map(|key| self.sources.remove(key)).flatten() {
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
    let are_several = self.are_several() || !self.kept.is_empty();
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
    dds::{
      ddsdata::DDSData,
      with_key::datawriter::{InstanceChange, WriteOptionsBuilder},
    },
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
      let change = change(*of, *number, bytes);
      history.record(&change.write_options, SequenceNumber::new(*number), depth);
      history.keep(change);
    }
  }

  #[test]
  fn each_source_has_its_own_last_samples() {
    let mut history = SourceHistory::default();
    history.record(&change(1, 1, 8).write_options, SequenceNumber::new(1), 2);
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

  fn keyed(key: Option<u8>, number: i64) -> CacheChange {
    let mut change = change(1, number, 8);
    let options = WriteOptionsBuilder::new().history_source(source(1));
    let instance = InstanceChange {
      key_hash: key.map(|key| [key; 16]),
      ..InstanceChange::default()
    };
    change.write_options = options.instance_change(instance).build();
    change
  }

  #[test]
  fn each_key_of_a_source_has_its_own_last_samples() {
    let mut history = SourceHistory::default();
    let mut write = |key, number| {
      let change = keyed(key, number);
      history.record(&change.write_options, change.sequence_number, 2);
      history.keep(change);
      numbers(&history).unwrap()
    };
    for (key, number) in [(1, 1), (2, 2), (2, 3), (2, 4)] {
      write(Some(key), number);
    }
    assert_eq!(write(Some(1), 5), [1, 3, 4, 5]);
    assert_eq!(write(Some(1), 6), [3, 4, 5, 6]);
    // Without a hash the keys are not known.
    for number in 7..7 + 2000 {
      write(None, number);
    }
    assert_eq!(write(None, 2007).len(), 4 + DEPTH_OF_UNKNOWN_KEYS);
    history.forget(source(1));
    assert!(history.sources.is_empty() && history.kept.is_empty());
    assert_eq!(history.kept_bytes, 0);
  }

  #[test]
  fn keys_are_bounded_as_the_samples_are() {
    let mut history = SourceHistory::default();
    for number in 1..=3 * DEFAULT_WRITER_MAX_SAMPLES as i64 {
      let mut change = keyed(None, number);
      let mut key_hash = [0; 16];
      key_hash[..8].copy_from_slice(&number.to_le_bytes());
      let instance = InstanceChange {
        key_hash: Some(key_hash),
        ..InstanceChange::default()
      };
      let options = WriteOptionsBuilder::new().history_source(source(1));
      change.write_options = options.instance_change(instance).build();
      history.record(&change.write_options, change.sequence_number, 2);
      history.keep(change);
    }
    assert_eq!(history.sources.len(), DEFAULT_WRITER_MAX_SAMPLES);
    assert_eq!(history.kept.len(), DEFAULT_WRITER_MAX_SAMPLES);
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
    history.record(&change(0, 1, 8).write_options, SequenceNumber::new(1), 1);
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
