//! One route on one lane: taking, handing over, accounting.

use std::time::Duration;

use bytes::Bytes;
use tracing::{error, info, warn};

use super::super::arena::CopyArena;
use super::super::role::{Role, RoleError};
use super::super::watch::DropWatch;
use super::late_joiners::{Kept, LateJoiners};
use super::unsent::{Unsent, UnsentSamples};
use crate::clock;
use crate::config::{self, DropPolicy, Settings};
use crate::dds::{Participant, RawWriter, WriterEvent};
use crate::model::{
    DropReason, Durability, Guid, LaneCounters, LaneMode, MonotonicNs, OutputReaders, QosProfile,
    ReaderRecord, Reliability, SampleHeader, TrafficClass,
};
use crate::policy::{SequenceTracker, Sighting};
use crate::shm::{
    BoardWriter, Boards, HistogramWriter, LaneQueue, ProcessRole, RouteChannel, SampleSubscriber, ShmSample,
    Stage, SubscriberRole, TakeError,
};

/// After a restart, how long the readers of the process before are waited for. A live one is matched again
/// within 1 to 3 s (Fast DDS and Cyclone DDS answer a new participant at once); one that is not back by
/// then is taken to be gone.
const FORMER_READERS_MS: u64 = 5_000;

/// What the account of a forwarded sample needs.
struct Forwarded {
    bytes: u64,
    by_reference: bool,
    caught_up: bool,
    sequence: u64,
    written_at: MonotonicNs,
    writer: Guid,
    writer_sequence: i64,
}

/// One route on one lane.
pub(super) struct Output {
    id: String,
    lane: String,
    class: TrafficClass,
    route: usize,
    dds_topic: String,
    qos: QosProfile,
    window_samples: usize,
    by_reference_min_bytes: usize,
    /// What a gap in the sequence means while the lane forwards.
    overwritten: DropReason,
    /// What it means in the present mode.
    gap_reason: DropReason,
    mode: LaneMode,
    /// Drops that are how the lane works.
    expected_drops: &'static [DropReason],
    subscriber: SampleSubscriber,
    writer: Option<RawWriter>,
    unsent: UnsentSamples<Forwarded>,
    /// Samples taken that wait for a token.
    queued: u64,
    late_joiners: Option<LateJoiners>,
    tracker: SequenceTracker,
    counters: BoardWriter<LaneCounters>,
    readers: BoardWriter<OutputReaders>,
    /// Readers that the process before was matched with and this one is not yet. What is written meanwhile
    /// does not reach them.
    former_readers: Vec<Guid>,
    /// Samples published before this process came up were missed by its predecessor, not by it.
    started_at: MonotonicNs,
    caught_up: bool,
    /// Starts of ingress that this lane has seen.
    ingress_starts: u64,
    shm: HistogramWriter,
    dds_out: HistogramWriter,
    age: HistogramWriter,
    watch: DropWatch,
    boards: Boards,
}

impl Output {
    pub fn open(
        role: &Role,
        participant: &mut Participant,
        settings: &Settings,
        lane_index: usize,
        output: &config::Output,
    ) -> Result<Self, RoleError> {
        let lane = &settings.lanes[lane_index];
        let route = &settings.routes[output.route];
        let boards = role.boards.clone();
        let mut counters = boards.lane_writer(lane_index, output.route);
        counters.update(|counters| {
            // What waited in a process that was killed died with it.
            let accounted = counters.forwarded + counters.drops.total();
            counters.drops.add(DropReason::LaneDown, counters.received().saturating_sub(accounted));
            counters.waiting = 0;
            counters.readers = 0;
        });
        let former = *counters.get();
        let mut readers = boards.output_readers_writer(lane_index, output.route);
        let former_readers = readers.get().iter().map(|record| record.reader).collect();
        readers.update(|readers| *readers = OutputReaders::default());
        let late_joiners = (output.qos.durability == Durability::TransientLocal
            && output.qos.reliability == Reliability::BestEffort)
            .then(|| LateJoiners::new(output.qos.depth().unwrap_or(1) as usize));
        let subscriber = SampleSubscriber::open(
            &role.node,
            &RouteChannel::of(settings, output.route),
            SubscriberRole::Lane(LaneQueue::of(lane)),
            true,
        )?;
        let mut opened = Self {
            id: route.id.to_string(),
            lane: lane.name.to_string(),
            class: lane.class,
            route: output.route,
            dds_topic: output.topic.to_dds(),
            qos: output.qos,
            window_samples: lane.window_samples,
            by_reference_min_bytes: lane.by_reference_min_bytes,
            overwritten: overwritten(lane.class, lane.rates.normal.drop_policy),
            gap_reason: overwritten(lane.class, lane.rates.normal.drop_policy),
            mode: LaneMode::Normal,
            expected_drops: expected_drops(lane.class),
            subscriber,
            writer: None,
            unsent: UnsentSamples::new(lane.window_samples.max(output.qos.depth().unwrap_or(1) as usize)),
            queued: 0,
            late_joiners,
            tracker: SequenceTracker::resume(former.first_sequence, former.last_sequence),
            watch: DropWatch::new(former.drops),
            counters,
            readers,
            former_readers,
            started_at: clock::monotonic(),
            caught_up: false,
            ingress_starts: boards.health(ProcessRole::Ingress).map_or(0, |health| health.starts),
            shm: boards.histogram_writer(Stage::Shm(lane_index), output.route),
            dds_out: boards.histogram_writer(Stage::DdsOut(lane_index), output.route),
            age: boards.histogram_writer(Stage::Age(lane_index), output.route),
            boards,
        };
        match &route.message_type {
            Some(message_type) => opened.make_writer(participant, &message_type.to_dds())?,
            None => opened.find_type(participant),
        }
        Ok(opened)
    }

    pub fn id(&self) -> &str {
        &self.id
    }

    /// What was done so far.
    pub fn counters(&self) -> &LaneCounters {
        self.counters.get()
    }

    /// Whether there is a DDS writer; there is none before the type is known.
    pub fn has_writer(&self) -> bool {
        self.writer.is_some()
    }

    pub fn durability(&self) -> Durability {
        self.qos.durability
    }

    /// The next sample that is not accounted for yet. What is missing before it is counted here; what was
    /// forwarded before a restart is not returned, but for a TRANSIENT_LOCAL output it is written again,
    /// because the new writer has to have it for late joiners.
    pub fn take(&mut self) -> Option<ShmSample> {
        loop {
            let sample = match self.subscriber.take() {
                Ok(Some(sample)) => sample,
                // At the limit nothing is lost: what waits goes on waiting.
                Ok(None) | Err(TakeError::BorrowLimit) => return None,
                Err(failure) => {
                    error!(
                        route = self.id,
                        lane = self.lane,
                        ?failure,
                        "a sample in shared memory is unusable"
                    );
                    continue;
                }
            };
            let sequence = sample.header().sequence;
            match self.tracker.see(sequence) {
                Sighting::InOrder => {}
                Sighting::AfterGap(missing) => self.count_missing(missing, sample.header()),
                Sighting::Duplicate => {
                    if self.qos.durability == Durability::TransientLocal && !self.caught_up {
                        self.restore(&sample);
                    }
                    continue;
                }
            }
            if sample.header().published_at >= self.started_at {
                self.caught_up = true;
            }
            return Some(sample);
        }
    }

    /// Hands a taken sample to DDS.
    pub fn send(&mut self, sample: ShmSample, participant: &mut Participant, arena: &mut CopyArena) {
        if self.writer.is_none() {
            self.find_type(participant);
        }
        if !self.former_readers.is_empty() {
            // Between two housekeepings, readers may have been matched again.
            self.follow_matching(clock::monotonic());
        }
        let Some(writer) = &self.writer else {
            self.drop_sample(&sample, DropReason::NoWriter);
            return;
        };
        let header = *sample.header();
        let bytes = sample.payload().len();
        let began_at = clock::monotonic();
        // One borrow is left free, so that the next sample can be taken while all others are on their way.
        let by_reference = bytes >= self.by_reference_min_bytes
            && self.subscriber.borrowed() < self.subscriber.max_borrowed();
        let payload = if by_reference { Bytes::from_owner(sample) } else { arena.copy(sample.payload()) };
        let kept = self.late_joiners.as_ref().map(|_| Kept {
            payload: Bytes::copy_from_slice(&payload),
            encapsulation: header.encapsulation,
            timestamp: header.source_timestamp,
        });
        let outcome = writer.write(payload, header.encapsulation, header.source_timestamp);
        let complete = self.former_readers.is_empty();
        let done_at = clock::monotonic();
        let forwarded = Forwarded {
            bytes: bytes as u64,
            by_reference,
            caught_up: header.published_at < self.started_at,
            sequence: header.sequence,
            written_at: began_at,
            writer: header.writer_guid,
            writer_sequence: header.writer_sequence,
        };
        let sent_through = writer.sent_through();
        let (unsent, queued) = (&mut self.unsent, self.queued);
        self.counters.update(|counters| {
            while let Some(sent) = unsent.pop_sent(sent_through) {
                count_forwarded(counters, &sent);
            }
            account(counters, &self.tracker);
            match outcome {
                Ok(written) if written.readers == 0 || !complete => {
                    counters.drops.add(DropReason::NoReader, 1);
                }
                Ok(written) if written.sequence <= sent_through => count_forwarded(counters, &forwarded),
                Ok(written) => {
                    let evicted = unsent.push(Unsent { sequence: written.sequence, account: forwarded });
                    counters.drops.add(DropReason::WriteFailed, u64::from(evicted.is_some()));
                }
                Err(_) => counters.drops.add(DropReason::WriteFailed, 1),
            }
            counters.waiting = queued + unsent.len() as u64;
        });
        if outcome.is_ok() {
            if let (Some(late_joiners), Some(kept)) = (&mut self.late_joiners, kept) {
                late_joiners.keep(kept);
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

    /// Accounts for a taken sample that is not sent.
    pub fn drop_sample(&mut self, _sample: &ShmSample, reason: DropReason) {
        self.counters.update(|counters| {
            account(counters, &self.tracker);
            counters.drops.add(reason, 1);
        });
    }

    /// The lane applies another mode. One that forwards nothing takes samples at leisure, so most are
    /// overwritten.
    pub fn set_mode(&mut self, mode: LaneMode) {
        self.mode = mode;
        self.gap_reason = match (mode, self.class) {
            (LaneMode::Stopped, _) => DropReason::Stopped,
            (LaneMode::Suspended, TrafficClass::Noncritical) => DropReason::Suspended,
            _ => self.overwritten,
        };
    }

    /// The lane applies another drop policy.
    pub fn set_drop_policy(&mut self, policy: DropPolicy) {
        self.overwritten = overwritten(self.class, policy);
        self.set_mode(self.mode);
    }

    /// Counts what was sent since it was written; whether there is more to be sent.
    pub fn count_sent(&mut self) -> bool {
        if self.unsent.len() == 0 {
            return false;
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

    /// Counts what is still unsent when the lane ends.
    pub fn drop_unsent(&mut self) {
        let unsent = self.unsent.clear() as u64;
        if unsent > 0 {
            let queued = self.queued;
            self.counters.update(|counters| {
                counters.drops.add(DropReason::Shutdown, unsent);
                counters.waiting = queued;
            });
        }
    }

    /// Shows how many taken samples wait in the lane for a token.
    pub fn set_queued(&mut self, queued: usize) {
        self.queued = queued as u64;
        let waiting = self.queued + self.unsent.len() as u64;
        if self.counters.get().waiting != waiting || self.counters.get().last_sequence != self.tracker.last()
        {
            self.counters.update(|counters| {
                account(counters, &self.tracker);
                counters.waiting = waiting;
            });
        }
    }

    pub fn keep_house(&mut self, participant: &mut Participant, boards: &Boards, now: MonotonicNs) {
        if self.writer.is_none() {
            self.find_type(participant);
        }
        if let Some(health) = boards.health(ProcessRole::Ingress) {
            self.ingress_starts = health.starts;
        }
        self.follow_matching(now);
        self.record_readers(now);
        self.serve_late_joiners(now);
        self.watch.look(&self.counters.get().drops, &self.id, &self.lane, self.expected_drops, now);
    }

    /// Whether all RELIABLE readers have acknowledged everything, or do within `patience`.
    pub fn wait_acknowledged(&mut self, patience: Duration) -> bool {
        self.writer.as_ref().is_none_or(|writer| writer.wait_acknowledged(patience))
    }

    fn follow_matching(&mut self, now: MonotonicNs) {
        let Some(writer) = &self.writer else {
            return;
        };
        while let Some(event) = writer.poll_event() {
            match event {
                WriterEvent::Matched { reader, joined, readers } => {
                    self.counters.update(|counters| counters.readers = readers);
                    if joined {
                        self.former_readers.retain(|former| *former != reader);
                    }
                    info!(route = self.id, lane = self.lane, ?reader, joined, readers, "readers changed");
                    if let Some(late_joiners) = &mut self.late_joiners {
                        if joined {
                            late_joiners.joined(reader, now);
                        } else {
                            late_joiners.left(reader);
                        }
                    }
                }
                WriterEvent::Incompatible { reader } => {
                    warn!(
                        route = self.id,
                        lane = self.lane,
                        topic = self.dds_topic,
                        ?reader,
                        "a reader asks for more than this lane offers and gets nothing: change its QoS or \
                         the lane's"
                    );
                }
            }
        }
    }

    /// Shows the matched readers, and what single ones of them missed.
    fn record_readers(&mut self, now: MonotonicNs) {
        if now >= self.started_at.plus_ms(FORMER_READERS_MS) {
            self.former_readers.clear();
        }
        let Some(writer) = &self.writer else {
            return;
        };
        let mut shown = OutputReaders::default();
        let mut overrun = 0;
        for (place, reader) in shown.records.iter_mut().zip(writer.matched_readers()) {
            let former = self.readers.get().iter().find(|record| record.reader == reader.guid);
            overrun += reader.overrun.saturating_sub(former.map_or(0, |record| record.overrun));
            *place = ReaderRecord {
                reader: reader.guid,
                offered: reader.offered,
                unacknowledged: reader.unacknowledged,
                overrun: reader.overrun,
                reliable: u64::from(reader.reliable),
            };
        }
        if shown != *self.readers.get() {
            self.readers.update(|readers| *readers = shown);
        }
        if overrun > 0 {
            self.counters.update(|counters| counters.reader_overrun += overrun);
        }
    }

    fn serve_late_joiners(&mut self, now: MonotonicNs) {
        let (Some(late_joiners), Some(writer)) = (&mut self.late_joiners, &self.writer) else {
            return;
        };
        while let Some((reader, history)) = late_joiners.due(now) {
            for kept in history {
                let written =
                    writer.write_to(reader, kept.payload.clone(), kept.encapsulation, kept.timestamp);
                if let Err(failure) = written {
                    warn!(
                        route = self.id,
                        lane = self.lane,
                        ?reader,
                        %failure,
                        "history not sent to a late joiner"
                    );
                }
            }
        }
    }

    /// Makes the writer if ingress knows the type by now.
    fn find_type(&mut self, participant: &mut Participant) {
        let Some(info) = self.boards.route_info(self.route) else {
            return;
        };
        let dds_type = info.dds_type.as_str();
        if dds_type.is_empty() {
            return;
        }
        if let Err(failure) = self.make_writer(participant, dds_type) {
            error!(route = self.id, lane = self.lane, dds_type, %failure, "no writer");
        }
    }

    fn make_writer(&mut self, participant: &mut Participant, dds_type: &str) -> Result<(), RoleError> {
        let writer = participant.create_writer(&self.dds_topic, dds_type, &self.qos, self.window_samples)?;
        info!(
            route = self.id,
            lane = self.lane,
            topic = self.dds_topic,
            dds_type,
            reliability = ?self.qos.reliability,
            durability = ?self.qos.durability,
            "writing"
        );
        self.writer = Some(writer);
        Ok(())
    }

    /// Counts samples that never came, by why they did not.
    fn count_missing(&mut self, missing: u64, next: &SampleHeader) {
        let restarted = self.boards.health(ProcessRole::Ingress).is_some_and(|health| {
            health.starts != self.ingress_starts && next.published_at >= health.started_at
        });
        let reason = if !self.caught_up && self.tracker.first() > 0 && next.published_at < self.started_at {
            DropReason::LaneDown
        } else if restarted {
            DropReason::IngressDied
        } else if !self.caught_up {
            DropReason::LaneDown
        } else {
            self.gap_reason
        };
        self.counters.update(|counters| {
            counters.first_sequence = self.tracker.first();
            // The missing ones are accounted for with this; the one after them is not yet.
            counters.last_sequence = next.sequence - 1;
            counters.drops.add(reason, missing);
        });
    }

    /// Writes what was forwarded before a restart once more, for late joiners.
    fn restore(&mut self, sample: &ShmSample) {
        let header = sample.header();
        let payload = Bytes::copy_from_slice(sample.payload());
        if let Some(late_joiners) = &mut self.late_joiners {
            late_joiners.keep(Kept {
                payload,
                encapsulation: header.encapsulation,
                timestamp: header.source_timestamp,
            });
        } else if let Some(writer) = &self.writer
            && let Err(failure) = writer.write(payload, header.encapsulation, header.source_timestamp)
        {
            warn!(route = self.id, lane = self.lane, %failure, "history not restored after a restart");
        }
    }
}

fn count_forwarded(counters: &mut LaneCounters, sample: &Forwarded) {
    counters.forwarded += 1;
    counters.forwarded_bytes += sample.bytes;
    counters.by_reference += u64::from(sample.by_reference);
    counters.caught_up += u64::from(sample.caught_up);
    counters.last_forwarded_sequence = sample.sequence;
    counters.last_forwarded_at = sample.written_at;
    counters.last_writer_guid = sample.writer;
    counters.last_writer_sequence = sample.writer_sequence;
}

/// Brings the account up to the last sample taken.
fn account(counters: &mut LaneCounters, tracker: &SequenceTracker) {
    counters.first_sequence = tracker.first();
    counters.last_sequence = tracker.last();
}

/// A critical lane that misses samples was too slow. A noncritical one sleeps until it has a token, and what
/// is overwritten meanwhile gave way as its drop policy has it.
const fn overwritten(class: TrafficClass, policy: DropPolicy) -> DropReason {
    match (class, policy) {
        (TrafficClass::Critical, _) => DropReason::QueueOverflow,
        (TrafficClass::Noncritical, DropPolicy::DropOldest) => DropReason::Superseded,
        (TrafficClass::Noncritical, _) => DropReason::QueueFull,
    }
}

const fn expected_drops(class: TrafficClass) -> &'static [DropReason] {
    match class {
        TrafficClass::Critical => &[DropReason::NoReader],
        TrafficClass::Noncritical => &[
            DropReason::Superseded,
            DropReason::QueueFull,
            DropReason::Suspended,
            DropReason::Stopped,
            DropReason::NoReader,
        ],
    }
}
