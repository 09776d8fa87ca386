//! The record of an output's readers on its board.

use serde::Serialize;

use super::health::LaneCounters;
use super::modes::UnmatchedPolicy;
use super::sample::Guid;

/// The most readers of one output that have a record each; further ones are only counted.
pub const MAX_OUTPUT_READERS: usize = 32;

/// The record of one reader that is matched with an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct ReaderRecord {
    /// The reader; all zero for none.
    #[serde(rename = "guid")]
    pub reader: Guid,
    /// Samples written since it was matched, plus the history that it was offered then.
    pub offered: u64,
    /// Of those, samples that a RELIABLE reader has not acknowledged; 0 for a BEST_EFFORT one.
    pub unacknowledged: u64,
    /// Of those, samples that left the writer's history before the reader received them.
    pub overrun: u64,
    /// 1 for a RELIABLE reader, 0 for a BEST_EFFORT one.
    #[serde(skip)]
    pub reliable: u64,
}

impl ReaderRecord {
    /// Whether the reader was matched anew since this earlier record, which starts its counts at 0.
    pub fn is_of_later_match(&self, earlier: &Self) -> bool {
        self.offered < earlier.offered || self.overrun < earlier.overrun
    }

    /// Samples that the reader has missed since this earlier record.
    pub fn missed_since(&self, earlier: &Self) -> u64 {
        if self.is_of_later_match(earlier) { self.overrun } else { self.overrun - earlier.overrun }
    }
}

/// The most readers of one output that are listed as not matched.
pub const MAX_UNMATCHED_READERS: usize = 8;

/// A reader of an output's topic that requests a stricter QoS than the output offers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct UnmatchedReader {
    /// The reader; all zero for none.
    pub reader: Guid,
    /// The number of the [`UnmatchedPolicy`](super::UnmatchedPolicy).
    pub policy: u64,
}

/// The readers of one output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct OutputReaders {
    /// The records of matched readers, those in use first.
    pub records: [ReaderRecord; MAX_OUTPUT_READERS],
    /// Readers that are not matched, those in use first.
    pub unmatched: [UnmatchedReader; MAX_UNMATCHED_READERS],
    /// Readers that a former process of the lane was matched with and the present one is not yet, those in
    /// use first.
    pub former: [Guid; MAX_OUTPUT_READERS],
    /// 1 if there may be former readers besides; 0 otherwise.
    pub more_former: u64,
    /// The forwarded samples of the lane when the records were written.
    pub forwarded: u64,
}

impl OutputReaders {
    /// The records in use.
    pub fn iter(&self) -> impl Iterator<Item = &ReaderRecord> {
        self.records.iter().filter(|record| record.reader != Guid::default())
    }

    /// The former readers that are not matched again yet.
    pub fn former(&self) -> impl Iterator<Item = Guid> {
        self.former.iter().copied().filter(|reader| *reader != Guid::default())
    }

    /// How many samples that count as forwarded one RELIABLE reader may have missed at most, if the process
    /// ended with these records and `counters`: those that the one furthest behind had not acknowledged, and
    /// those that were forwarded since the records were written.
    pub fn unconfirmed(&self, counters: &LaneCounters) -> u64 {
        let reliable = self.iter().filter(|record| record.reliable == 1);
        // A reader without a record was matched since.
        let is_new = counters.readers > self.iter().count() as u64;
        let behind = reliable.map(|record| record.unacknowledged).chain(is_new.then_some(0)).max();
        let since = counters.forwarded.saturating_sub(self.forwarded);
        behind.map_or(0, |behind| behind.saturating_add(since))
    }

    /// How many of the last samples that count as forwarded a RELIABLE reader may lack, as
    /// [`unconfirmed`](Self::unconfirmed); `None` if that is not known: a matched reader may have no record,
    /// or a reader of a former process has not matched since.
    pub fn lacking(&self, counters: &LaneCounters) -> Option<u64> {
        let is_full = self.iter().count() == self.records.len();
        let is_known = !is_full && self.more_former == 0 && self.former().next().is_none();
        is_known.then(|| self.unconfirmed(counters))
    }

    /// The readers that are not matched, each with the policy.
    pub fn unmatched(&self) -> impl Iterator<Item = (Guid, UnmatchedPolicy)> {
        let used = self.unmatched.iter().filter(|record| record.reader != Guid::default());
        used.map(|record| {
            let number = u8::try_from(record.policy).unwrap_or(0);
            (record.reader, UnmatchedPolicy::from_u8(number).unwrap_or_default())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_readers_of_an_output_are_those_whose_records_are_in_use() {
        let mut readers = OutputReaders::default();
        assert_eq!(
            (readers.iter().count(), readers.unmatched().count(), readers.former().count()),
            (0, 0, 0)
        );
        let [matched, strict, foreign] = [1, 2, 3].map(|number| Guid([number; 16]));
        readers.records[0].reader = matched;
        readers.former[0] = matched;
        let policy = UnmatchedPolicy::Durability as u64;
        readers.unmatched[0] = UnmatchedReader { reader: strict, policy };
        // A number that only a foreign program writes.
        readers.unmatched[1] = UnmatchedReader { reader: foreign, policy: 1 << 40 };
        assert_eq!(readers.iter().map(|record| record.reader).collect::<Vec<_>>(), [matched]);
        assert_eq!(readers.former().collect::<Vec<_>>(), [matched]);
        let unmatched: Vec<_> = readers.unmatched().collect();
        assert_eq!(unmatched, [(strict, UnmatchedPolicy::Durability), (foreign, UnmatchedPolicy::default())]);
    }

    #[test]
    fn unconfirmed_is_what_the_reader_furthest_behind_may_have_missed_when_the_process_ended() {
        let mut readers = OutputReaders { forwarded: 1_000, ..OutputReaders::default() };
        let mut counters = LaneCounters { forwarded: 1_020, ..LaneCounters::default() };
        assert_eq!(readers.unconfirmed(&counters), 0);
        // A reader that was matched after the records were written.
        counters.readers = 1;
        assert_eq!(readers.unconfirmed(&counters), 20);
        for (place, (unacknowledged, reliable)) in [(0, 0), (7, 1), (3, 1)].into_iter().enumerate() {
            let reader = Guid([1 + place as u8; 16]);
            readers.records[place] =
                ReaderRecord { reader, unacknowledged, reliable, ..ReaderRecord::default() };
        }
        counters.readers = 3;
        assert_eq!(readers.unconfirmed(&counters), 27);
        // BEST_EFFORT readers are promised nothing.
        (readers.records[1].reliable, readers.records[2].reliable) = (0, 0);
        assert_eq!(readers.unconfirmed(&counters), 0);
        // A process that ended on SIGTERM, after every reader had acknowledged every sample.
        readers.forwarded = counters.forwarded;
        readers.records[1] = ReaderRecord { unacknowledged: 0, reliable: 1, ..readers.records[1] };
        assert_eq!(readers.unconfirmed(&counters), 0);
    }

    #[test]
    fn what_readers_may_lack_is_not_known_without_a_record_of_each() {
        let reader = Guid([1; 16]);
        let record = ReaderRecord { reader, unacknowledged: 7, reliable: 1, ..ReaderRecord::default() };
        let mut readers = OutputReaders { forwarded: 1_000, ..OutputReaders::default() };
        readers.records[0] = record;
        let counters = LaneCounters { forwarded: 1_020, readers: 1, ..LaneCounters::default() };
        assert_eq!(readers.lacking(&counters), Some(27));
        let more = OutputReaders { more_former: 1, ..readers };
        assert_eq!(more.lacking(&counters), None);
        let mut waiting = readers;
        waiting.former[0] = reader;
        assert_eq!(waiting.lacking(&counters), None);
        readers.records.fill(record);
        assert_eq!(readers.lacking(&counters), None);
    }
}
