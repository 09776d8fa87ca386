//! How an output continues that of a killed process: with its account and with the samples that readers may
//! lack.

use std::ops::Range;

use bytes::Bytes;
use tracing::warn;

use super::super::arena::CopyArena;
use super::super::history::present_publishers;
use super::super::unsent::{Forwarded, record_sequence};
use super::Output;
use crate::clock;
use crate::dds::{FormerSample, Participant};
use crate::model::{DropReason, MonotonicNs};
use crate::shm::{ShmSample, TakeError, read_backlog};

impl Output {
    /// Whether the output waits for samples of the former process.
    pub const fn collects_former(&self) -> bool {
        self.former.is_some()
    }

    /// Whether the former process has written nothing, or its writer can't be continued.
    pub(super) fn has_nothing_to_collect(&self) -> bool {
        self.former.as_ref().is_none_or(|former| former.last_sequence() == 0)
    }

    /// Collects the samples that the former process has written, and creates the writer when it has them.
    pub fn collect_former(&mut self, participant: &mut Participant, arena: &mut CopyArena) {
        let Some(mut former) = self.former.take() else { return };
        let now = clock::monotonic();
        while former.next.is_none() {
            let sample = match self.subscriber.take() {
                Ok(Some(sample)) => sample,
                Ok(None) | Err(TakeError::BorrowLimit) => {
                    if !std::mem::replace(&mut former.has_read_backlog, true) {
                        // Before ingress delivers to this queue.
                        for earlier in self.backlog(former.first_sequence()..former.last_sequence() + 1) {
                            former.collect(earlier, false, Bytes::from_owner);
                        }
                    }
                    // Ingress delivers the retained samples in their order.
                    let last = former.collected.last().map(|collected| collected.sequence);
                    if last == Some(former.last_sequence()) {
                        former.complete();
                    }
                    break;
                }
                Err(failure) => {
                    self.log_unusable(failure);
                    continue;
                }
            };
            let header = *sample.header();
            if former.collected.is_empty() {
                // The channel retains fewer samples than the backlog has.
                for earlier in self.backlog(former.first_sequence()..header.sequence) {
                    former.collect(earlier, false, Bytes::from_owner);
                }
            }
            if header.sequence > former.last_sequence().max(self.tracker.last()) {
                former.next = Some(sample);
                former.complete();
                continue;
            }
            let by_reference = self.may_pass_by_reference(sample.payload().len());
            let is_latched = self.history.is_some();
            former.collect(sample, by_reference, |sample| {
                if by_reference {
                    Bytes::from_owner(sample)
                } else if is_latched {
                    Bytes::copy_from_slice(sample.payload())
                } else {
                    arena.copy(sample.payload())
                }
            });
        }
        let is_complete = former.is_complete(now);
        self.former = Some(former);
        if is_complete {
            self.announce_type(participant);
            // The type is not known, or the writer could not be created.
            self.close_former_account(false, now);
        }
    }

    /// Copies of the samples with these sequence numbers that ingress keeps for a lane that restarts.
    pub(super) fn backlog(&self, wanted: Range<u64>) -> Vec<ShmSample> {
        read_backlog(&self.boards, self.route, wanted).unwrap_or_else(|error| {
            warn!(route = self.id, lane = self.lane, %error, "cannot read what ingress keeps of the route");
            Vec::new()
        })
    }

    /// Closes the account of the former process, and returns what the next writer offers of its samples:
    /// nothing unless it continues the former writer. The samples that are not offered, and were not counted,
    /// are lost with the process.
    pub(super) fn close_former_account(&mut self, is_continued: bool, now: MonotonicNs) -> Vec<FormerSample> {
        let Some(mut former) = self.former.take() else { return Vec::new() };
        if !is_continued {
            former.collected.clear();
        }
        former.keep_contiguous();
        let last_logged = former.last_sequence();
        let accounted = self.counters.get().accounted_number;
        let counted = former.collected.partition_point(|collected| collected.sample.number <= accounted);
        let (repairable, uncounted) = former.collected.split_at(counted);
        for collected in uncounted {
            self.tracker.record(collected.sequence);
        }
        // The last one that was sent may not be there any more.
        self.tracker.record(last_logged);
        self.catch_up.wrote(uncounted.len() as u64);
        let has_readers = !self.former_readers.is_empty();
        let (unsent, tracker) = (&mut self.unsent, &self.tracker);
        self.counters.update(|counters| {
            record_sequence(counters, tracker);
            let known = counters.forwarded + counters.drops.total() + uncounted.len() as u64;
            counters.drops.add(DropReason::LaneDown, counters.received().saturating_sub(known));
            for collected in uncounted {
                let number = collected.sample.number;
                let account = Forwarded {
                    number,
                    bytes: collected.sample.payload.len() as u64,
                    by_reference: collected.by_reference,
                    caught_up: false,
                    written_at: now,
                };
                let dropped = if has_readers {
                    let evicted = unsent.push(account);
                    evicted.map(|evicted| (DropReason::WriteFailed, evicted.number))
                } else {
                    Some((DropReason::NoReader, number))
                };
                if let Some((reason, number)) = dropped {
                    counters.drops.add(reason, 1);
                    counters.accounted_number = number;
                }
            }
            let unconfirmed = former.unconfirmed.saturating_sub(repairable.len() as u64);
            counters.unconfirmed = counters.unconfirmed.saturating_add(unconfirmed);
            counters.waiting = unsent.len() as u64;
            counters.readers = 0;
        });
        self.readers.set(self.former_readers.on_board(self.counters.get().forwarded));
        self.next.extend(former.next);
        former.collected.into_iter().map(|collected| collected.sample).collect()
    }

    /// Writes a sample that was forwarded before a restart again, for late joiners.
    pub(super) fn restore(&mut self, sample: &ShmSample) {
        if self.topic.is_former(sample.header().sequence) || sample.header().key.is_keyed() != self.has_keys {
            return;
        }
        let Some(history) = &mut self.history else { return };
        let (header, publisher) = (sample.header(), sample.header().writer_guid);
        let payload = Bytes::copy_from_slice(sample.payload());
        let kept = history.kept(&payload, header);
        if kept.is_none()
            && let Some(writer) = &self.writer
        {
            if let Some(record) = &self.record {
                record.writing(header.sequence);
            }
            let (encapsulation, timestamp) = (header.encapsulation, header.source_timestamp);
            match writer.write_from(Some(publisher), payload, encapsulation, timestamp, header.key) {
                // The former process has accounted for the sample.
                Ok(written) => self.counters.update(|it| it.accounted_number = written.sequence),
                Err(failure) => {
                    warn!(route = self.id, lane = self.lane, %failure, "cannot restore the history after a restart");
                }
            }
        }
        history.add(publisher, kept, self.writer.as_ref(), || present_publishers(&self.boards, self.route));
    }
}
