//! The samples that the former process of a lane has written, for the readers that lack them.
//!
//! A reader asks the next process for a sample that it lacks, as both are the same writer to it. The samples
//! are still in their slots, and the send log has their numbers. The process collects them before it has a
//! writer: a writer without them would answer that they are gone.

use bytes::Bytes;

use crate::dds::FormerSample;
use crate::model::MonotonicNs;
use crate::shm::ShmSample;

/// How long the process waits for the retained samples, which ingress delivers with the next sample of the
/// route or after 0.1 s.
const WAIT_MS: u64 = 500;

/// A sample of the former process, with what its account needs.
pub(super) struct Collected {
    pub sequence: u64,
    pub by_reference: bool,
    pub sample: FormerSample,
}

/// What is known of the former process' samples.
pub(super) struct FormerSamples {
    /// RTPS sequence numbers and sequence numbers in the route, both ascending.
    logged: Vec<(i64, u64)>,
    pub collected: Vec<Collected>,
    /// The first sample that the former process had not written.
    pub next: Option<ShmSample>,
    /// Samples that a reader may lack if none is collected.
    pub unconfirmed: u64,
    /// Whether they were looked for among those that ingress keeps.
    pub has_read_backlog: bool,
    give_up_at: MonotonicNs,
    is_complete: bool,
}

impl FormerSamples {
    /// The last ones in the log, at most so many.
    pub fn new(mut logged: Vec<(i64, u64)>, most: usize, unconfirmed: u64, now: MonotonicNs) -> Self {
        logged.drain(..logged.len().saturating_sub(most));
        Self {
            logged,
            collected: Vec::new(),
            next: None,
            unconfirmed,
            has_read_backlog: false,
            give_up_at: now.plus_ms(WAIT_MS),
            is_complete: false,
        }
    }

    /// The RTPS sequence number of the sample with this sequence number in the route.
    pub fn number_of(&self, sequence: u64) -> Option<i64> {
        let place = self.logged.binary_search_by_key(&sequence, |(_, logged)| *logged).ok()?;
        Some(self.logged[place].0)
    }

    /// The sequence number in the route of the first sample that a reader may lack.
    pub fn first_sequence(&self) -> u64 {
        self.logged.first().map_or(u64::MAX, |(_, sequence)| *sequence)
    }

    /// Collects a sample if the former process has written it and it was not collected yet. In the order of
    /// their numbers.
    pub fn collect(
        &mut self,
        sample: ShmSample,
        by_reference: bool,
        payload: impl FnOnce(ShmSample) -> Bytes,
    ) {
        let header = *sample.header();
        let Some(number) = self.number_of(header.sequence) else { return };
        if self.collected.last().is_some_and(|last| last.sequence >= header.sequence) {
            return;
        }
        let payload = payload(sample);
        let (encapsulation, timestamp) = (header.encapsulation, header.source_timestamp);
        let publisher = header.writer_guid;
        let sample = FormerSample { number, payload, encapsulation, timestamp, publisher };
        self.collected.push(Collected { sequence: header.sequence, by_reference, sample });
    }

    /// The sequence number in the route of the last sample that the former process has written.
    pub fn last_sequence(&self) -> u64 {
        self.logged.last().map_or(0, |(_, sequence)| *sequence)
    }

    /// There are no more.
    pub const fn complete(&mut self) {
        self.is_complete = true;
    }

    /// Whether all that can be collected is.
    pub fn is_complete(&self, now: MonotonicNs) -> bool {
        self.is_complete || now >= self.give_up_at
    }

    /// Whether the last sample that the former process has written is among those that are collected.
    pub fn has_last(&self) -> bool {
        self.collected.last().map_or(0, |collected| collected.sequence) == self.last_sequence()
    }

    /// Leaves those that can't be offered: with a hole before them, readers would take the samples in it for
    /// withdrawn. A sample that is missing was overwritten before the others.
    pub fn keep_contiguous(&mut self) {
        let mut place = self.collected.len();
        let mut logged = self.logged.iter().rev();
        while place > 0
            && logged.next().is_some_and(|(number, _)| *number == self.collected[place - 1].sample.number)
        {
            place -= 1;
        }
        self.collected.drain(..place);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Encapsulation, Guid, SourceTimestamp};

    fn collected(number: i64, sequence: u64) -> Collected {
        let sample = FormerSample {
            number,
            payload: Bytes::new(),
            encapsulation: Encapsulation::CDR_LE,
            timestamp: SourceTimestamp::NONE,
            publisher: Guid::default(),
        };
        Collected { sequence, by_reference: false, sample }
    }

    fn former() -> FormerSamples {
        // 8 is that of a sample that was withdrawn.
        FormerSamples::new(vec![(5, 21), (6, 22), (7, 25), (9, 26)], 3, 0, MonotonicNs(0))
    }

    #[test]
    fn the_log_is_read_for_as_many_samples_as_the_writer_retains() {
        let mut former = former();
        assert_eq!(
            [21, 22, 23, 25, 26, 27].map(|it| former.number_of(it)),
            [None, Some(6), None, Some(7), Some(9), None]
        );
        assert_eq!(former.last_sequence(), 26);
        let end = MonotonicNs(0).plus_ms(WAIT_MS);
        assert!(!former.is_complete(MonotonicNs(end.0 - 1)) && former.is_complete(end));
        former.complete();
        assert!(former.is_complete(MonotonicNs(0)));
    }

    #[test]
    fn samples_before_one_that_is_missing_are_left() {
        let numbers = |given: &[(i64, u64)]| {
            let mut former = former();
            former.collected = given.iter().map(|(number, sequence)| collected(*number, *sequence)).collect();
            former.keep_contiguous();
            former.collected.iter().map(|collected| collected.sample.number).collect::<Vec<_>>()
        };
        assert_eq!(numbers(&[(6, 22), (7, 25), (9, 26)]), [6, 7, 9]);
        assert_eq!(numbers(&[(7, 25), (9, 26)]), [7, 9]);
        assert_eq!(numbers(&[(6, 22), (9, 26)]), [9]);
        assert!(numbers(&[(6, 22), (7, 25)]).is_empty() && numbers(&[]).is_empty());
    }

    #[test]
    fn a_history_is_whole_if_it_has_the_last_sample() {
        let mut former = former();
        assert!(!former.has_last());
        former.collected = vec![collected(7, 25)];
        assert!(!former.has_last());
        former.collected.push(collected(9, 26));
        assert!(former.has_last());
        assert!(FormerSamples::new(Vec::new(), 3, 0, MonotonicNs(0)).has_last(), "none was written");
    }
}
