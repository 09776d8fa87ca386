//! How an output continues that of a killed process: with its account and with the samples that readers may
//! lack.

use bytes::Bytes;

use super::super::arena::CopyArena;
use super::super::former_samples::Collected;
use super::super::unsent::{Forwarded, Unsent, record_sequence};
use super::Output;
use crate::clock;
use crate::dds::{FormerSample, Participant};
use crate::model::{DropReason, MonotonicNs};
use crate::policy::{SequenceOutcome, SequenceTracker};
use crate::shm::TakeError;

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
            let Some(number) = former.number_of(header.sequence) else {
                if header.sequence > former.last_sequence().max(self.tracker.last()) {
                    former.next = Some(sample);
                    former.complete();
                }
                continue;
            };
            let by_reference = self.may_pass_by_reference(sample.payload().len());
            let payload = if by_reference { Bytes::from_owner(sample) } else { arena.copy(sample.payload()) };
            former.collected.push(Collected {
                sequence: header.sequence,
                by_reference,
                sample: FormerSample {
                    number,
                    payload,
                    encapsulation: header.encapsulation,
                    timestamp: header.source_timestamp,
                },
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
        let (accounted, had_taken) = {
            let counters = self.counters.get();
            (counters.accounted_number, counters.last_sequence)
        };
        let (mut missing, mut to_send, mut to_send_taken) = (0, Vec::new(), 0);
        let record = |tracker: &mut SequenceTracker, sequence| match tracker.record(sequence) {
            SequenceOutcome::AfterGap(gap) => gap,
            SequenceOutcome::InOrder | SequenceOutcome::Duplicate => 0,
        };
        for collected in &former.collected {
            if collected.sample.number > accounted {
                missing += record(&mut self.tracker, collected.sequence);
                to_send_taken += u64::from(collected.sequence <= had_taken);
                to_send.push(Unsent {
                    sequence: collected.sample.number,
                    account: Forwarded {
                        number: collected.sample.number,
                        bytes: collected.sample.payload.len() as u64,
                        by_reference: collected.by_reference,
                        caught_up: false,
                        written_at: now,
                    },
                });
            }
        }
        if last_logged > self.tracker.last() {
            // It was sent, and is not there any more.
            missing += record(&mut self.tracker, last_logged) + 1;
        }
        let repairable = former.collected.len() - to_send.len();
        let (unsent, tracker) = (&mut self.unsent, &self.tracker);
        self.counters.update(|counters| {
            let counted = counters.forwarded + counters.drops.total();
            let lost = counters.received().saturating_sub(counted + to_send_taken);
            counters.drops.add(DropReason::LaneDown, lost + missing);
            for sample in to_send {
                if let Some(evicted) = unsent.push(sample) {
                    counters.drops.add(DropReason::WriteFailed, 1);
                    counters.accounted_number = counters.accounted_number.max(evicted.number);
                }
            }
            counters.unconfirmed += former.unconfirmed.saturating_sub(repairable as u64);
            record_sequence(counters, tracker);
            counters.waiting = unsent.len() as u64;
            counters.readers = 0;
        });
        self.readers.set(self.former_readers.on_board(self.counters.get().forwarded));
        self.next = former.next;
        former.collected.into_iter().map(|collected| collected.sample).collect()
    }
}
