//! What an output announces: its topic, type and QoS, and the writer that has them.

use tracing::{error, info};

use super::super::super::error::RoleError;
use super::super::former_readers::FormerReaders;
use super::super::history::present_publishers;
use super::super::offer::Offer;
use super::super::overrun::Overrun;
use super::super::unsent::UnsentSamples;
use super::super::writer_record::Next;
use super::Output;
use crate::clock;
use crate::dds::{Participant, RawWriter};
use crate::model::{DdsType, DropReason, Durability, Guid};

impl Output {
    /// Whether the publishers offer TRANSIENT_LOCAL and the output does not, though it follows them.
    pub(super) fn is_to_latch(&self) -> bool {
        self.durability.get() == Durability::TransientLocal && self.latched_offer.is_some()
    }

    /// Offers TRANSIENT_LOCAL when the publishers do, unless the configuration gives the DURABILITY. A writer
    /// cannot change it (DDS 1.4 clause 2.2.3), and a reader misses what is written until it has matched the
    /// next writer, so the present one stays as long as it has a reader.
    pub(super) fn follow_durability(&mut self, participant: &mut Participant) {
        if !self.is_to_latch() {
            return;
        }
        if let Some(writer) = &self.writer
            && (self.unsent.len() > 0 || writer.matched_readers().next().is_some())
        {
            return;
        }
        let Some(latched) = self.latched_offer.take() else { return };
        if let Some(volatile) = self.writer.take() {
            self.remove_writer(volatile, participant);
        }
        self.start_offer(latched);
    }

    /// Removes a writer of a type without keys when the publishers have keys, or the reverse. Its readers
    /// match no such publisher either. What is not sent yet is sent first.
    fn follow_kind(&mut self, participant: &mut Participant, has_keys: bool) {
        if has_keys != self.has_keys
            && !self.count_sent()
            && let Some(former) = self.writer.take()
        {
            self.remove_writer(former, participant);
            self.history = self.offer.history();
        }
    }

    /// Drops a writer, whose readers leave with it: what they have not acknowledged counts as unconfirmed.
    fn remove_writer(&mut self, writer: RawWriter, participant: &mut Participant) {
        self.unmatched.clear();
        let withdrawn = u64::from(self.early.end());
        let behind = self.readers.get().unconfirmed(self.counters.get());
        self.readers.set(self.former_readers.on_board(self.counters.get().forwarded));
        self.counters.update(|counters| {
            counters.readers = 0;
            counters.withdrawn += withdrawn;
            counters.unconfirmed = counters.unconfirmed.saturating_add(behind);
        });
        self.overrun.count(&writer, &mut self.counters);
        self.overrun = Overrun::default();
        if let Some(record) = &mut self.record {
            record.removed();
        }
        let guid = writer.guid();
        drop(writer);
        participant.remove_endpoint(guid);
    }

    /// Determines what the next writer offers. The present one has been removed.
    fn start_offer(&mut self, offer: Offer) {
        self.history = offer.history();
        self.unsent = UnsentSamples::new(offer.most_unsent());
        self.offer = offer;
    }

    /// Publishes the topic that ingress has given to the place by now, in place of the former one. The data
    /// path calls this with each sample of a place: a sample never goes to the topic of another one.
    pub(super) fn follow_topic(&mut self, participant: &mut Participant) {
        let Some(info) = self.boards.route_info(self.route) else { return };
        let Some(topic) = self.topic.next(&info) else { return };
        self.count_sent();
        self.drop_unsent(DropReason::NoWriter);
        if let Some(former) = self.writer.take() {
            self.remove_writer(former, participant);
            participant.forget_topic(&self.topic.dds_topic);
        }
        // They were readers of the former topic.
        self.former_readers = FormerReaders::default();
        self.topic.set(&info, &topic);
        let (offer, latched_offer) = self.configured;
        self.start_offer(offer);
        self.latched_offer = latched_offer;
        self.durability.set(offer.qos.durability);
        self.last_publisher = Guid::default();
    }

    /// Creates the writer if ingress has published the type by now, and lets it announce the type's hash.
    pub(super) fn announce_type(&mut self, participant: &mut Participant) {
        if self.topic.is_place {
            self.follow_topic(participant);
        }
        let Some(info) = self.boards.route_info(self.route) else {
            return;
        };
        // Ingress may have given the place another topic just now; the next call follows it.
        let Some(dds_type) = info.announced_type().filter(|_| self.topic.is_current(&info)) else {
            return;
        };
        self.durability.set(info.durability());
        self.follow_durability(participant);
        self.follow_kind(participant, dds_type.has_keys);
        match &self.writer {
            None => {
                if let Err(failure) = self.make_writer(participant, dds_type) {
                    let (route, lane, dds_type) = (&self.id, &self.lane, dds_type.name);
                    error!(route, lane, dds_type, %failure, "cannot create the DDS writer");
                }
            }
            Some(writer) if dds_type.hash != self.type_hash => {
                writer.set_type_hash(dds_type.hash);
                self.type_hash = dds_type.hash;
            }
            Some(_) => {}
        }
    }

    pub(super) fn make_writer(
        &mut self,
        participant: &mut Participant,
        dds_type: DdsType,
    ) -> Result<(), RoleError> {
        let now = clock::monotonic();
        if self.former.as_ref().is_some_and(|former| !former.is_complete(now)) {
            return Ok(());
        }
        let Offer { qos, window_samples, supersedes } = self.offer;
        // What late joiners need may still come, and is then written again.
        let lacks_history =
            self.history.is_some() && self.former.as_ref().is_some_and(|former| !former.has_last());
        if let Some(record) = self.record.as_mut().filter(|_| lacks_history) {
            record.give_up();
        }
        let mut publishers = Vec::new();
        let continuation = self
            .record
            .as_mut()
            .map(|record| record.next(participant.guid(), &self.topic.dds_topic, &dds_type, &qos));
        // Of a place, the topic may be another one than that of the former process.
        if self.topic.is_place && continuation.as_ref().is_none_or(|next| !next.is_former) {
            self.former_readers = FormerReaders::default();
        }
        let writer = match continuation {
            None => participant.create_writer(&self.topic.dds_topic, dds_type, &qos, window_samples)?,
            Some(Next { mut continuation, superseded, .. }) => {
                if let Some(key) = superseded {
                    participant.dispose_former_writer(key);
                }
                let is_continued = continuation.highest_number > 0;
                if !is_continued {
                    self.counters.update(|counters| counters.accounted_number = 0);
                }
                continuation.samples = self.close_former_account(is_continued, now);
                self.has_former_history = is_continued && self.history.is_some();
                publishers = continuation.samples.iter().map(|sample| sample.publisher).collect();
                continuation.sent_through = self.counters.get().accounted_number;
                continuation.readers = self.former_readers.missing().to_vec();
                let topic = &self.topic.dds_topic;
                let created =
                    participant.create_writer_continuing(topic, dds_type, &qos, window_samples, continuation);
                if created.is_err() {
                    self.drop_unsent(DropReason::WriteFailed);
                }
                created?
            }
        };
        info!(
            route = self.id,
            lane = self.lane,
            topic = self.topic.dds_topic,
            dds_type = dds_type.name,
            has_keys = dds_type.has_keys,
            reliability = ?qos.reliability,
            durability = ?qos.durability,
            "DDS writer created"
        );
        if supersedes {
            writer.skip_evicted();
        }
        if let Some(history) = &mut self.history {
            for publisher in publishers {
                history.add(publisher, None, Some(&writer), || present_publishers(&self.boards, self.route));
            }
        }
        self.writer = Some(writer);
        self.type_hash = dds_type.hash;
        if self.has_keys != dds_type.has_keys {
            self.has_keys = dds_type.has_keys;
            self.durability.set_changed();
        }
        Ok(())
    }
}
