//! One output: takes the samples of a route from shared memory, writes them to DDS, and accounts for them.

mod announce;
mod catch_up;
mod former;
mod matching;
mod missing;

use std::collections::VecDeque;

use bytes::Bytes;
use tracing::error;

use super::super::count_log::DropLog;
use super::super::error::RoleError;
use super::super::role::Role;
use super::arena::CopyArena;
use super::bound_topic::BoundTopic;
use super::early_send::{EarlySend, Followed};
use super::former_readers::FormerReaders;
use super::former_samples::FormerSamples;
use super::gaps::overwrite_reason;
use super::history::{History, present_publishers};
use super::offer::{Offer, RouteDurability};
use super::overrun::Overrun;
use super::unsent::{Forwarded, UnsentSamples, count_forwarded, record_sequence};
use super::writer_record::{WriterRecord, latched};
use crate::clock;
use crate::config::{self, Forwarding, Settings};
use crate::dds::{Participant, RawWriter};
use crate::model::{
    DdsType, DropReason, Durability, Guid, LaneCounters, LaneMode, MonotonicNs, OutputReaders, PartialSample,
    TrafficClass, TypeHash, UnmatchedPolicy,
};
use crate::policy::{CatchUp, SequenceOutcome, SequenceTracker, critical_drop};
use crate::shm::{
    BoardWriter, Boards, HistogramWriter, ProcessRole, QueueLimits, RouteChannel, SampleSubscriber, ShmError,
    ShmNode, ShmSample, Stage, SubscriberRole, TakeError,
};

/// One output of a lane: the DDS writer of one route, and its account.
pub(super) struct Output {
    pub id: String,
    lane: String,
    class: TrafficClass,
    route: usize,
    topic: BoundTopic,
    /// What the configuration lets an output offer first, and once the publishers offer TRANSIENT_LOCAL.
    configured: (Offer, Option<Offer>),
    offer: Offer,
    /// What the output offers once the publishers offer TRANSIENT_LOCAL and no reader is matched; `None` when
    /// it does, and where the configuration gives the DURABILITY.
    latched_offer: Option<Offer>,
    pub durability: RouteDurability,
    by_reference_min_bytes: usize,
    /// The drop reason of a gap while the lane forwards.
    overwrite_reason: DropReason,
    /// The drop reason of a gap in the current mode.
    gap_reason: DropReason,
    mode: LaneMode,
    subscriber: SampleSubscriber,
    /// Created once the message type is known.
    pub writer: Option<RawWriter>,
    /// The hash that the writer announces.
    type_hash: TypeHash,
    /// Whether the writer is one of a type with keys.
    has_keys: bool,
    early: EarlySend,
    /// The board of a partial sample, read and not followed yet.
    partial: Option<PartialSample>,
    unsent: UnsentSamples,
    /// Samples taken that wait for a token.
    queued: u64,
    /// `None` for a VOLATILE output.
    history: Option<History>,
    tracker: SequenceTracker,
    pub counters: BoardWriter<LaneCounters>,
    readers: BoardWriter<OutputReaders>,
    overrun: Overrun,
    former_readers: FormerReaders,
    /// `None` if the lane does not keep its identity.
    record: Option<WriterRecord>,
    /// While samples of the former process are collected.
    former: Option<Box<FormerSamples>>,
    /// Samples that were taken, or copied from the backlog, and are the next ones.
    next: VecDeque<ShmSample>,
    /// How the lane receives what was published while it did not run.
    catch_up: CatchUp,
    /// Whether samples wait until those before are sent, and acknowledged while the lane catches up.
    is_paced: bool,
    /// Whether samples wait in the queue until the former readers have matched.
    is_held: bool,
    /// The publisher of the last sample taken.
    last_publisher: Guid,
    /// Readers of the topic that request a stricter QoS than the writer offers, each with the policy.
    unmatched: Vec<(Guid, UnmatchedPolicy)>,
    /// When this process opened the output. Samples published before were missed by the former one.
    started_at: MonotonicNs,
    /// Whether a sample published since `started_at` has been taken.
    caught_up: bool,
    /// Whether the writer has the history of the former process.
    has_former_history: bool,
    /// Starts of ingress at the last housekeeping.
    ingress_starts: u64,
    /// When ingress was started again, until a sample of the new process is taken.
    ingress_restarted_at: Option<MonotonicNs>,
    shm: HistogramWriter,
    dds_out: HistogramWriter,
    age: HistogramWriter,
    drop_log: DropLog,
    boards: Boards,
}

impl Output {
    /// Opens the queue of an output. Ingress delivers the retained samples to it when it publishes the next
    /// sample.
    pub fn open_queue(
        node: &ShmNode,
        settings: &Settings,
        lane: &config::Lane,
        route: usize,
    ) -> Result<SampleSubscriber, ShmError> {
        let limits = SubscriberRole::Lane(QueueLimits::of(lane));
        SampleSubscriber::open(node, &RouteChannel::of(settings, route), limits, true)
    }

    /// Opens an output that takes its samples from `queue`.
    pub fn open(
        role: &Role,
        participant: &mut Participant,
        settings: &Settings,
        lane_index: usize,
        output: &config::Output,
        queue: SampleSubscriber,
    ) -> Result<Self, RoleError> {
        let lane = &settings.lanes[lane_index];
        let route = &settings.routes[output.route];
        let boards = role.boards.clone();
        let info = boards.route_info(output.route).unwrap_or_default();
        let counters = boards.lane_writer(lane_index, output.route);
        let readers = boards.output_readers_writer(lane_index, output.route);
        let record = WriterRecord::of(role, participant, lane_index, output);
        let logged = record.as_ref().map(WriterRecord::logged).unwrap_or_default();
        let started_at = clock::monotonic();
        let former_readers = FormerReaders::of(readers.get(), started_at);
        let unconfirmed = readers.get().unconfirmed(counters.get());
        let offer = Offer::of(lane, output.qos);
        let accounted = counters.get().accounted_number;
        let unsent = logged.iter().filter(|(number, _)| *number > accounted).count();
        // Fewer than the writer retains: to look at all 256 took 4 ms of the pause when a standby takes over.
        let lacking = readers.get().lacking(counters.get());
        let lacking = lacking.map_or(usize::MAX, |forwarded| forwarded as usize + unsent);
        // Late joiners may need all.
        let is_latched = latched(output, &info).is_some();
        let most = if is_latched { usize::MAX } else { offer.window_samples.min(lacking.max(1)) };
        let former_samples = FormerSamples::new(logged, most, unconfirmed, started_at);
        let latched_offer = output.latched_qos.map(|qos| Offer::of(lane, qos));
        let catch_up = match lane.class() {
            TrafficClass::Critical => {
                CatchUp::of_critical(offer.window_samples, readers.get().iter(), started_at)
            }
            TrafficClass::Noncritical => CatchUp::never(),
        };
        let mut opened = Self {
            id: route.id.to_string(),
            lane: lane.name.to_string(),
            class: lane.class(),
            route: output.route,
            topic: BoundTopic::new(route, output, &info),
            configured: (offer, latched_offer),
            history: offer.history(),
            unsent: UnsentSamples::new(offer.most_unsent()),
            durability: RouteDurability::new(&offer, latched_offer.is_some()),
            offer,
            latched_offer,
            by_reference_min_bytes: lane.by_reference_min_bytes,
            overwrite_reason: overwrite_reason(&lane.forwarding),
            gap_reason: overwrite_reason(&lane.forwarding),
            mode: LaneMode::Normal,
            subscriber: queue,
            writer: None,
            type_hash: TypeHash::UNKNOWN,
            has_keys: false,
            early: EarlySend::default(),
            partial: None,
            queued: 0,
            tracker: SequenceTracker::resume(counters.get().first_sequence, counters.get().last_sequence),
            drop_log: DropLog::new(counters.get().drops),
            counters,
            readers,
            overrun: Overrun::default(),
            is_held: lane.class() == TrafficClass::Critical && !former_readers.is_empty(),
            former_readers,
            record,
            former: Some(Box::new(former_samples)),
            next: VecDeque::new(),
            catch_up,
            is_paced: false,
            last_publisher: Guid::default(),
            unmatched: Vec::new(),
            started_at,
            caught_up: false,
            has_former_history: false,
            ingress_starts: boards.health(ProcessRole::Ingress).map_or(0, |health| health.starts),
            ingress_restarted_at: None,
            shm: boards.histogram_writer(Stage::Shm(lane_index), output.route),
            dds_out: boards.histogram_writer(Stage::DdsOut(lane_index), output.route),
            age: boards.histogram_writer(Stage::Age(lane_index), output.route),
            boards,
        };
        if opened.has_nothing_to_collect() {
            opened.close_former_account(false, started_at);
        }
        match &route.message_type {
            // The type of a place is known with its topic.
            Some(message_type) if !opened.topic.is_place => {
                opened.durability.set(info.durability());
                opened.follow_durability(participant);
                let has_keys = info.has_keys != 0;
                let dds_type = DdsType { name: &message_type.to_dds(), hash: info.type_hash, has_keys };
                opened.make_writer(participant, dds_type)?;
            }
            _ => opened.announce_type(participant),
        }
        Ok(opened)
    }

    /// Takes the next sample that is not accounted for yet, and counts the ones missing before it. Samples
    /// that were forwarded before a restart are skipped; for a TRANSIENT_LOCAL output they are written again,
    /// because the new writer needs them for late joiners. After a restart, a critical lane takes none before
    /// its former readers have matched.
    pub fn take(&mut self) -> Option<ShmSample> {
        self.catch_up.turn(clock::monotonic);
        if self.collects_former() || (self.is_held && self.is_still_held()) || self.is_to_be_paced() {
            return None;
        }
        loop {
            let taken = self.next.pop_front().map_or_else(|| self.subscriber.take(), |next| Ok(Some(next)));
            let sample = match taken {
                Ok(Some(sample)) => sample,
                // The borrow limit loses nothing: the samples stay in the channel.
                Ok(None) => {
                    self.end_catch_up();
                    return None;
                }
                Err(TakeError::BorrowLimit) => return None,
                Err(failure) => {
                    self.log_unusable(failure);
                    continue;
                }
            };
            let sequence = sample.header().sequence;
            let expected = self.tracker.last() + 1;
            if expected > 1 && expected < sequence {
                self.begin_catch_up();
                if self.catch_up.is_on() {
                    let behind = self.backlog(expected..sequence);
                    if !behind.is_empty() {
                        self.next.push_front(sample);
                        behind.into_iter().rev().for_each(|sample| self.next.push_front(sample));
                        continue;
                    }
                }
            }
            self.follow_burst(sample.payload().len());
            match self.tracker.record(sequence) {
                SequenceOutcome::InOrder => {}
                SequenceOutcome::AfterGap(missing) => self.count_missing(missing, sample.header()),
                SequenceOutcome::Duplicate => {
                    let is_latched = self.offer.qos.durability == Durability::TransientLocal;
                    if is_latched && !self.caught_up && !self.has_former_history {
                        self.restore(&sample);
                    }
                    continue;
                }
            }
            self.follow_restarts(sample.header());
            if self.is_too_old(sample.header()) {
                let reason = if self.caught_up { self.gap_reason } else { DropReason::LaneDown };
                self.drop_sample(&sample, reason);
                continue;
            }
            self.follow_publisher(sample.header().writer_guid);
            return Some(sample);
        }
    }

    fn log_unusable(&self, failure: TakeError) {
        error!(route = self.id, lane = self.lane, ?failure, "skipped an unusable sample in shared memory");
    }

    /// Reads how much of a large sample has arrived.
    pub fn read_progress(&mut self) {
        self.partial = self.boards.partial(self.route);
    }

    /// Begins to send a large sample of which a part has arrived, sends more of it, or withdraws it. To be
    /// called when all samples are taken that were published before the board was read.
    pub fn follow_progress(&mut self) {
        // Samples before that one still wait.
        if self.is_held || self.is_paced {
            return;
        }
        let Some(partial) = self.partial.take() else { return };
        let Some(writer) = &self.writer else { return };
        // A new writer for late joiners, or of a place's next topic, may be due before the next sample.
        let may_begin = self.history.is_none()
            && !self.has_keys
            && !self.is_to_latch()
            && critical_drop(self.mode).is_none()
            && self.former_readers.is_empty()
            && self.counters.get().readers > 0;
        let present = if may_begin { self.boards.partial(self.route) } else { None };
        let followed = self.early.follow(&partial, writer, present, clock::monotonic());
        let (withdrew, began) = match followed {
            Followed::Nothing => return,
            Followed::Began => (0, 1),
            Followed::Withdrew => (1, 0),
            Followed::WithdrewAndBegan => (1, 1),
        };
        self.counters.update(|counters| {
            counters.withdrawn += withdrew;
            counters.begun_early += began;
        });
    }

    /// Whether DDS may keep a taken sample of that size in its slot. One borrow stays free, so that the next
    /// sample can be taken while DDS holds all others.
    fn may_pass_by_reference(&self, bytes: usize) -> bool {
        bytes >= self.by_reference_min_bytes
            && self.history.is_none()
            && self.subscriber.borrowed() < self.subscriber.max_borrowed()
    }

    /// Withdraws the sample that was begun early, if there is one.
    fn withdraw_early(&mut self) {
        if self.early.end() {
            if let Some(writer) = &self.writer {
                writer.withdraw_early();
            }
            self.counters.update(|counters| counters.withdrawn += 1);
        }
    }

    /// Writes a taken sample to DDS, unless the mode drops it, and accounts for it.
    pub fn send(&mut self, sample: ShmSample, participant: &mut Participant, arena: &mut CopyArena) {
        // The DDS library may still send from the slot, so that the slot has to be kept.
        let completes = self.early.is_begun(sample.header(), sample.payload().len())
            && self.may_pass_by_reference(sample.payload().len())
            && self.early.is_of_same_slot(self.boards.partial(self.route));
        if !completes {
            self.withdraw_early();
        }
        // A noncritical lane polls no sample in such a mode.
        if let Some(reason) = critical_drop(self.mode) {
            return self.drop_sample(&sample, reason);
        }
        if self.topic.is_place {
            self.follow_topic(participant);
        }
        let other_kind = sample.header().key.is_keyed() != self.has_keys;
        if self.writer.is_none() || other_kind || (self.is_to_latch() && self.counters.get().readers == 0) {
            self.announce_type(participant);
        }
        // After both calls, which follow the topic of a place: its former topic has no writer any more.
        if self.topic.is_former(sample.header().sequence) {
            return self.drop_sample(&sample, DropReason::NoWriter);
        }
        if !self.former_readers.is_empty() {
            // Former readers may have matched since the last housekeeping.
            self.follow_matching(clock::monotonic());
        }
        // A writer of the other kind would send what its readers take for something else.
        let Some(writer) = self.writer.as_ref().filter(|_| sample.header().key.is_keyed() == self.has_keys)
        else {
            self.drop_sample(&sample, DropReason::NoWriter);
            return;
        };
        let header = *sample.header();
        let bytes = sample.payload().len();
        let began_at = clock::monotonic();
        let by_reference = self.may_pass_by_reference(bytes);
        let payload = if by_reference {
            Bytes::from_owner(sample)
        } else if self.history.is_some() {
            // Late joiners need it while the lane runs, and with it a borrow or a chunk of the arena.
            Bytes::copy_from_slice(sample.payload())
        } else {
            arena.copy(sample.payload())
        };
        let kept = self.history.as_ref().and_then(|history| history.kept(&payload, &header));
        let publisher = self.history.as_ref().map(|_| header.writer_guid);
        let (encapsulation, timestamp) = (header.encapsulation, header.source_timestamp);
        if let Some(record) = &self.record {
            record.writing(header.sequence);
        }
        let completes = self.early.end();
        let outcome = if completes {
            // A writer that refuses the sample withdraws it.
            writer.complete_early(payload, encapsulation, timestamp).inspect_err(|_| writer.withdraw_early())
        } else {
            writer.write_from(publisher, payload, encapsulation, timestamp, header.key)
        };
        self.catch_up.wrote(bytes as u64);
        let complete = self.former_readers.is_empty();
        let done_at = clock::monotonic();
        let forwarded = Forwarded {
            number: outcome.map_or(0, |written| written.sequence),
            bytes: bytes as u64,
            by_reference,
            caught_up: header.published_at < self.started_at,
            written_at: began_at,
        };
        let sent_through = writer.sent_through();
        let (unsent, queued) = (&mut self.unsent, self.queued);
        self.counters.update(|counters| {
            while let Some(sent) = unsent.pop_sent(sent_through) {
                count_forwarded(counters, &sent);
            }
            record_sequence(counters, &self.tracker);
            match outcome {
                Ok(written) if written.readers == 0 || !complete => {
                    counters.drops.add(DropReason::NoReader, 1);
                    counters.accounted_number = written.sequence;
                }
                Ok(written) if written.sequence <= sent_through => count_forwarded(counters, &forwarded),
                Ok(_) => {
                    let evicted = unsent.push(forwarded);
                    if let Some(evicted) = evicted {
                        counters.drops.add(DropReason::WriteFailed, 1);
                        counters.accounted_number = counters.accounted_number.max(evicted.number);
                    }
                }
                Err(_) => {
                    counters.drops.add(DropReason::WriteFailed, 1);
                    counters.withdrawn += u64::from(completes);
                }
            }
            counters.waiting = queued + unsent.len() as u64;
        });
        if outcome.is_ok() {
            if let Some(history) = &mut self.history {
                let present = || present_publishers(&self.boards, self.route);
                history.add(header.writer_guid, kept, Some(writer), present);
            }
            self.shm.record(began_at.since(header.published_at));
            self.dds_out.record(done_at.since(began_at));
            if header.age_basis.late_ns().is_some() {
                self.age.record(done_at.since(header.age_from()));
            } else if let Some(written) = header.source_timestamp.to_wall() {
                self.age.record(clock::wall().since(written));
            }
        }
    }

    /// Counts a taken sample that is not sent.
    pub fn drop_sample(&mut self, _sample: &ShmSample, reason: DropReason) {
        self.withdraw_early();
        self.counters.update(|counters| {
            record_sequence(counters, &self.tracker);
            counters.drops.add(reason, 1);
        });
    }

    /// Whether the writer is one of a type with keys.
    pub const fn has_keys(&self) -> bool {
        self.has_keys
    }

    /// Applies another mode of the lane. A noncritical lane that forwards nothing takes samples only at
    /// housekeeping, so most are overwritten in its channel queue; the mode is then the reason of these gaps.
    pub fn set_mode(&mut self, mode: LaneMode) {
        self.mode = mode;
        if critical_drop(mode).is_some() {
            self.withdraw_early();
        }
        self.gap_reason = match (mode, self.class) {
            (LaneMode::Stopped, _) => DropReason::Stopped,
            (LaneMode::Suspended, TrafficClass::Noncritical) => DropReason::Suspended,
            _ => self.overwrite_reason,
        };
    }

    /// Applies another drop policy of the lane, which is the reason of gaps in its channel queue.
    pub fn set_forwarding(&mut self, forwarding: &Forwarding) {
        self.overwrite_reason = overwrite_reason(forwarding);
        self.set_mode(self.mode);
    }

    /// Counts the samples that the DDS library has sent by now, and returns whether some are still unsent.
    pub fn count_sent(&mut self) -> bool {
        if self.unsent.len() == 0 {
            return false;
        }
        // Those of the former process count when its readers have them.
        if self.is_held {
            return true;
        }
        let sent_through = self.writer.as_ref().map_or(i64::MAX, RawWriter::sent_through);
        if let Some(first) = self.unsent.pop_sent(sent_through) {
            let (unsent, queued) = (&mut self.unsent, self.queued);
            self.counters.update(|counters| {
                count_forwarded(counters, &first);
                while let Some(sent) = unsent.pop_sent(sent_through) {
                    count_forwarded(counters, &sent);
                }
                counters.waiting = queued + unsent.len() as u64;
            });
        }
        self.unsent.len() > 0
    }

    /// Counts the samples as dropped that are unsent when the lane ends.
    pub fn shut_down(&mut self) {
        self.close_former_account(false, clock::monotonic());
        self.drop_unsent(DropReason::Shutdown);
    }

    fn drop_unsent(&mut self, reason: DropReason) {
        let unsent = self.unsent.clear() as u64;
        if unsent > 0 {
            let queued = self.queued;
            self.counters.update(|counters| {
                counters.drops.add(reason, unsent);
                counters.waiting = queued;
            });
        }
    }

    /// Records the number of taken samples that wait for a token.
    pub fn set_queued(&mut self, queued: usize) {
        self.queued = queued as u64;
        let waiting = self.queued + self.unsent.len() as u64;
        if self.counters.get().waiting != waiting || self.counters.get().last_sequence != self.tracker.last()
        {
            self.counters.update(|counters| {
                record_sequence(counters, &self.tracker);
                counters.waiting = waiting;
            });
        }
    }

    /// Announces the type as far as it is known by now, follows matching, serves late joiners, logs drops.
    pub fn housekeeping(&mut self, participant: &mut Participant, now: MonotonicNs) {
        self.announce_type(participant);
        if let Some(health) = self.boards.health(ProcessRole::Ingress)
            && health.starts != self.ingress_starts
        {
            self.ingress_starts = health.starts;
            self.ingress_restarted_at = Some(health.started_at);
            self.withdraw_early();
            self.early.forget_pool();
        }
        self.follow_matching(now);
        self.record_readers(now);
        if let (Some(history), Some(writer)) = (&mut self.history, &self.writer) {
            history.serve(writer, &self.id, &self.lane, now);
        }
        let class = self.class;
        let is_expected = |reason: DropReason| reason.is_expected(class);
        self.drop_log.log_drops(&self.counters.get().drops, &self.id, &self.lane, is_expected, now);
    }

    /// Reads the durability with the first sample of each publisher: ingress publishes type and durability
    /// before it takes that sample, and the next housekeeping would be too late for it.
    fn follow_publisher(&mut self, publisher: Guid) {
        if publisher == self.last_publisher || !self.durability.follows_publishers() {
            return;
        }
        self.last_publisher = publisher;
        if let Some(info) = self.boards.route_info(self.route) {
            self.durability.set(info.durability());
        }
    }
}

#[cfg(test)]
mod tests;
