//! The input of one route in ingress: its DDS readers, its pool, its counters.

use std::collections::BTreeMap;
use std::sync::Arc;

use tracing::{error, info, warn};

use super::super::count_log::DropLog;
use super::super::error::RoleError;
use super::super::role::Role;
use super::arrival_progress::ArrivalProgress;
use super::pool::{Filled, PoolOwner};
use super::publishers::{Publishers, SequenceCheck};
use super::reader_record::ReaderRecord;
use super::source::{ReaderPlan, Source, label};
use crate::clock;
use crate::config::{Lane, Route, Settings};
use crate::dds::{
    ArrivalFlag, Endpoint, Inbox, Participant, ReaderEvent, ReaderQos, SampleOrigin, TakePayload,
};
use crate::model::{
    AgeBasis, DdsType, DropReason, Durability, Encapsulation, FixedText, Guid, IngressCounters, MonotonicNs,
    Reliability, RouteInfo, SampleHeader, TopicName, TrafficClass,
};
use crate::shm::{
    BacklogKeeper, BoardWriter, Boards, HistogramWriter, LaneWaker, LoanError, NoMemory, RouteChannel,
    SamplePublisher, ShmError, ShmNode, Stage, backlog_bytes,
};

/// Interval at which a route without a publisher logs that it waits.
const REMIND_MS: u64 = 30_000;

/// The critical lanes that serve a route.
fn critical_lanes(role: &Role, settings: &Settings, route: usize) -> Vec<LaneWaker> {
    let serves = |&(_, lane): &(usize, &Lane)| {
        lane.class() == TrafficClass::Critical && lane.outputs.iter().any(|output| output.route == route)
    };
    let lanes = settings.lanes.iter().enumerate();
    lanes.filter(serves).map(|(index, _)| role.boards.waker(index)).collect()
}

/// The input of one route: takes samples from its DDS readers and publishes them to shared memory.
pub(super) struct Input {
    id: String,
    /// The input topic; empty for a place without a topic.
    dds_topic: String,
    configured_type: Option<String>,
    pub route: Route,
    source: Source,
    inbox: Inbox,
    /// The reader of the publishers of each reliability, or of all where the configuration sets one.
    readers: BTreeMap<Reliability, ActiveReader>,
    records: [ReaderRecord; 2],
    /// The type of the first reader. It never changes, because the lanes have writers of it.
    settled_type: Option<String>,
    /// Whether the publishers have changed since `connect` last chose the readers.
    source_changed: bool,
    pool: PoolOwner,
    pub counters: BoardWriter<IngressCounters>,
    info: BoardWriter<RouteInfo>,
    dds_in: HistogramWriter,
    pub publishers: Publishers,
    drop_log: DropLog,
    remind_at: MonotonicNs,
}

/// The shared memory of an input: what it publishes to, and what it keeps for a lane that restarts.
pub(super) type OpenedPool = (SamplePublisher, Option<BacklogKeeper>);

pub(super) enum Step {
    Published,
    /// A sample was taken and not published: repeated, malformed or dropped.
    Discarded,
    /// No sample waited; the arrival flag is cleared until the next arrival.
    Empty,
}

struct ActiveReader {
    guid: Guid,
    has_keys: bool,
    qos: ReaderQos,
    writers: u64,
    idle: bool,
}

impl Input {
    /// Opens what ingress keeps of the pool of the route with this number.
    ///
    /// # Errors
    /// Shared memory cannot be opened.
    pub fn open_pool(
        node: &ShmNode,
        boards: &Boards,
        settings: &Settings,
        index: usize,
        publisher: SamplePublisher,
    ) -> Result<OpenedPool, ShmError> {
        let channel = RouteChannel::of(settings, index);
        let board = boards.backlog_writer(index);
        let backlog = BacklogKeeper::open(node, &channel, &publisher, backlog_bytes(settings), board)?;
        Ok((publisher, backlog))
    }

    /// The input of the route with this number, which publishes to `pool`.
    pub fn open(
        role: &Role,
        settings: &Settings,
        index: usize,
        flag: &Arc<ArrivalFlag>,
        (publisher, backlog): OpenedPool,
    ) -> Self {
        let route = settings.routes[index].clone();
        let mut counters = role.boards.ingress_writer(index);
        counters.update(|counters| counters.writers = 0);
        let publishers = Publishers::open(&role.boards, index, counters.get(), clock::monotonic());
        let info = role.boards.route_info_writer(index);
        let topic = route.input_topic.resolve(info.get());
        Self {
            id: route.id.to_string(),
            dds_topic: topic.map_or_else(String::new, |topic| topic.to_dds()),
            configured_type: route.message_type.as_ref().map(|name| name.to_dds()),
            source: Source::default(),
            inbox: Inbox::with_flag(Arc::clone(flag)),
            readers: BTreeMap::new(),
            records: [Reliability::BestEffort, Reliability::Reliable]
                .map(|reliability| ReaderRecord::of(role, index, reliability)),
            settled_type: None,
            source_changed: true,
            pool: PoolOwner::new(
                publisher,
                backlog,
                Some(ArrivalProgress::new(
                    role.boards.partial_writer(index),
                    critical_lanes(role, settings, index),
                )),
            ),
            drop_log: DropLog::new(counters.get().drops),
            counters,
            info,
            dds_in: role.boards.histogram_writer(Stage::DdsIn, index),
            publishers,
            remind_at: MonotonicNs(0),
            route,
        }
    }

    /// Whether there is a reader for at least one publisher.
    pub fn is_connected(&self) -> bool {
        self.readers.values().any(|reader| !reader.idle)
    }

    /// The topic of a place, and the samples received of it; `None` while it has none, and for other routes.
    pub fn bound(&self) -> Option<(TopicName, u64)> {
        let topic = self.info.get().topic().filter(|_| self.route.input_topic.is_place())?;
        Some((topic, self.counters.get().published.saturating_sub(self.info.get().bound_after)))
    }

    /// Whether the route has an input topic.
    pub fn has_topic(&self) -> bool {
        !self.dds_topic.is_empty()
    }

    /// Gives a place to a topic, in place of the present one. The samples that are numbered from now on are
    /// of this topic: the lanes learn of the topic, and of the number, before there is a reader.
    pub fn bind(&mut self, participant: &mut Participant, topic: &TopicName) {
        for reliability in [Reliability::Reliable, Reliability::BestEffort] {
            self.remove_reader(participant, reliability);
        }
        if self.has_topic() {
            participant.forget_topic(&self.dds_topic);
        }
        self.source = Source::default();
        self.source_changed = true;
        self.settled_type = None;
        self.publishers.mark_gone(|_| true, true);
        self.dds_topic = topic.to_dds();
        let bound_after = self.counters.get().published;
        let bound_count = self.info.get().bound_count.saturating_add(1);
        // The type of the former topic goes with it, so that no lane announces this one with that type.
        self.info.set(RouteInfo {
            bound_topic: FixedText::new(topic.as_str()),
            bound_after,
            bound_count,
            ..RouteInfo::default()
        });
    }

    /// Takes one sample and publishes it to the lanes, which the caller has to wake then.
    pub fn step(&mut self) -> Step {
        match self.inbox.take_from_any() {
            TakePayload::Empty => Step::Empty,
            TakePayload::Sample(origin, payload, encapsulation) => {
                let filled = self.pool.fill(payload);
                self.publish(filled, encapsulation, &origin)
            }
            TakePayload::Malformed => {
                self.counters.update(|counters| {
                    counters.received += 1;
                    counters.drops.add(DropReason::Malformed, 1);
                });
                Step::Discarded
            }
        }
    }

    /// Keeps the published sample for a lane that restarts. To be called when the lanes are awake.
    pub fn keep_published(&mut self) {
        self.pool.keep_published();
    }

    fn publish(&mut self, filled: Filled, encapsulation: Encapsulation, origin: &SampleOrigin) -> Step {
        let taken_at = clock::monotonic();
        let taken_at_wall = clock::wall();
        let (place, age_basis) = match self.publishers.check(origin, taken_at, taken_at_wall) {
            SequenceCheck::New(place, age_basis) => (Some(place), age_basis),
            SequenceCheck::Unmarked => (None, AgeBasis::SOURCE),
            SequenceCheck::Repeated(place) => {
                self.publishers.update(place, &mut self.counters, |counters, account| {
                    counters.repeated += 1;
                    account.repeated += 1;
                });
                return Step::Discarded;
            }
        };
        let dropped = match filled.slot {
            Ok(_) => None,
            Err(LoanError::TooLarge { .. }) => Some(DropReason::TooLarge),
            Err(LoanError::NoMemory(NoMemory::Quota)) => Some(DropReason::OverQuota),
            Err(LoanError::NoMemory(NoMemory::Budget)) => Some(DropReason::OverBudget),
            Err(LoanError::NoMemory(_)) => Some(DropReason::ShmFull),
            Err(_) => Some(DropReason::PoolExhausted),
        };
        let count = |counters: &mut IngressCounters| {
            counters.received += 1;
            counters.received_bytes += filled.bytes as u64;
            counters.last_received_at = taken_at;
            match dropped {
                Some(reason) => counters.drops.add(reason, 1),
                None => {
                    counters.published += 1;
                    counters.in_place += u64::from(filled.in_place);
                }
            }
            counters.published
        };
        // Counted before it is published: if the process dies in between, the lanes see a gap and count it.
        // The other order could publish two samples with one sequence number, or one sample twice.
        let sequence = match place {
            Some(place) => self.publishers.update(place, &mut self.counters, |counters, account| {
                let lost = account.take(origin.sequence, taken_at);
                counters.lost_upstream = counters.lost_upstream.saturating_add(lost);
                count(counters)
            }),
            None => self.counters.update(|counters| {
                counters.unmarked += 1;
                count(counters)
            }),
        };
        match (age_basis.late_ns(), origin.source_timestamp.to_wall()) {
            (Some(late_ns), _) => self.dds_in.record(late_ns),
            (None, Some(written)) => self.dds_in.record(taken_at_wall.since(written)),
            (None, None) => {}
        }
        let Ok(slot) = filled.slot else { return Step::Discarded };
        let header = SampleHeader {
            sequence,
            source_timestamp: origin.source_timestamp,
            taken_at,
            published_at: clock::monotonic(),
            writer_sequence: origin.sequence,
            writer_guid: origin.writer,
            encapsulation,
            age_basis,
            key: origin.key,
        };
        if let Err(error) = slot.publish(header) {
            error!(route = self.id, %error, "sample not published; the lanes will count it as missing");
        }
        Step::Published
    }

    /// Handles a discovered writer. Ignores writers of other topics.
    pub fn writer_found(&mut self, writer: &Endpoint) {
        if writer.topic != self.dds_topic || !self.has_topic() {
            return;
        }
        self.source_changed = true;
        self.publishers.mark_gone(|known| known == writer.guid, false);
        if self.source.insert(writer) {
            info!(
                route = self.id,
                topic = self.dds_topic,
                dds_type = writer.dds_type,
                offers = label(writer.reliability, writer.durability),
                "publisher found"
            );
        }
    }

    /// Handles the loss of a participant, and with it of its writers.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) {
        self.source_changed |= self.source.remove_participant(prefix);
        self.publishers.mark_gone(|known| known.prefix() == prefix, true);
    }

    /// Handles the loss of a writer. The writer may be of any topic.
    pub fn writer_gone(&mut self, guid: Guid) {
        self.source.remove(guid);
        self.publishers.writer_gone(guid);
        self.source_changed = true;
    }

    /// Creates and removes readers, connects new lanes, updates the boards, and logs.
    pub fn housekeeping(&mut self, participant: &mut Participant, now: MonotonicNs) -> Result<(), RoleError> {
        self.connect(participant, now)?;
        self.follow_matching();
        self.pool.housekeeping(now);
        self.publishers.set_reliabilities(|writer| self.source.reliability_of(writer));
        let mut counters = *self.counters.get();
        counters.writers = self.matched_writers();
        let memory = self.pool.memory();
        counters.pool_bytes = memory.used_bytes;
        counters.pool_peak_bytes = memory.peak_bytes;
        counters.budget_bytes = memory.budget_bytes;
        counters.budget_used_bytes = memory.budget_used_bytes;
        counters.budget_peak_bytes = memory.budget_peak_bytes;
        self.publishers.report_clocks(&self.id, &mut counters, now);
        self.counters.set(counters);
        self.drop_log.log_drops(&self.counters.get().drops, &self.id, "ingress", |_| false, now);
        Ok(())
    }

    /// Creates the readers that the discovered publishers need, and removes the others.
    fn connect(&mut self, participant: &mut Participant, now: MonotonicNs) -> Result<(), RoleError> {
        if !self.has_topic() || (self.is_connected() && !std::mem::take(&mut self.source_changed)) {
            return Ok(());
        }
        let known_type = self.settled_type.as_deref().or(self.configured_type.as_deref());
        let had_keys = self.info.get().has_keys != 0;
        let plan = self.source.plan(known_type, had_keys, &self.route.input_qos, self.route.max_sample_bytes);
        match plan {
            ReaderPlan::Readers { dds_type, reliable, best_effort } => {
                // Before the readers are created: a lane must be able to create its writer before it gets a
                // sample.
                self.update_info(&dds_type, true);
                // The RELIABLE reader first: until it exists, the BEST_EFFORT reader takes the samples of a
                // RELIABLE publisher that has joined BEST_EFFORT ones.
                self.update_reader(participant, Reliability::Reliable, &dds_type, reliable)?;
                self.update_reader(participant, Reliability::BestEffort, &dds_type, best_effort)
            }
            ReaderPlan::TypeConflict(first_type) => {
                self.update_info(&first_type, false);
                Ok(())
            }
            ReaderPlan::Unknown => {
                // Also names a publisher of another type than the configured one.
                if let Some(dds_type) = known_type.map(ToOwned::to_owned) {
                    self.update_info(&dds_type, true);
                }
                self.retire(participant, Reliability::Reliable);
                self.retire(participant, Reliability::BestEffort);
                if now >= self.remind_at {
                    info!(
                        route = self.id,
                        topic = self.dds_topic,
                        message_type = self.configured_type.as_deref().unwrap_or("any"),
                        "waiting for a publisher"
                    );
                    self.remind_at = now.plus_ms(REMIND_MS);
                }
                Ok(())
            }
        }
    }

    /// Publishes the type to the lanes unless the publishers announce several and the configuration sets none
    /// (`is_settled`), and names a publisher that announces another one.
    fn update_info(&mut self, dds_type: &str, is_settled: bool) {
        let type_hash = self.source.type_hash(dds_type, self.info.get().type_hash);
        let has_keys = self.source.has_keys(dds_type, self.info.get().has_keys != 0);
        let of_route = DdsType { name: dds_type, hash: type_hash, has_keys };
        let RouteInfo { bound_topic, bound_after, bound_count, .. } = *self.info.get();
        let mut info = RouteInfo {
            type_hash,
            has_keys: has_keys.into(),
            bound_topic,
            bound_after,
            bound_count,
            ..RouteInfo::default()
        };
        let durability = self.source.durability(of_route, self.info.get().durability());
        info.transient_local = u64::from(durability == Durability::TransientLocal);
        if is_settled {
            info.dds_type = FixedText::new(dds_type);
        }
        if let Some(other) = self.source.find_other_type(of_route) {
            info.other_writer = other.guid;
            info.other_type = FixedText::new(&other.dds_type);
            info.other_hash = other.type_hash;
        }
        if info == *self.info.get() {
            return;
        }
        if info.other_writer != Guid::default() && info.other_writer != self.info.get().other_writer {
            let (route, topic, writer) = (&self.id, &self.dds_topic, info.other_writer);
            let other = info.other_type.as_str();
            if other == dds_type && writer.has_keys() != has_keys {
                error!(
                    route,
                    topic,
                    ?writer,
                    dds_type,
                    has_keys,
                    "a publisher announces the type with keys and others without, so DDS does not match both: \
                     build all nodes with the same version of its package"
                );
            } else if other == dds_type {
                let other_hash = info.other_hash;
                error!(
                    route, topic, ?writer, dds_type, %type_hash, %other_hash,
                    "a publisher announces another definition of the type: build all nodes with the same version \
                     of its package"
                );
            } else {
                error!(
                    route,
                    topic,
                    ?writer,
                    one = dds_type,
                    other,
                    "two types claim the topic: set message_type of the route, or stop one of the publishers"
                );
            }
        }
        self.info.update(|current| *current = info);
    }

    /// Creates, replaces or retires the reader of this reliability, so that it matches `required`.
    fn update_reader(
        &mut self,
        participant: &mut Participant,
        reliability: Reliability,
        dds_type: &str,
        required: Option<ReaderQos>,
    ) -> Result<(), RoleError> {
        let Some(qos) = required else {
            self.retire(participant, reliability);
            return Ok(());
        };
        if let Some(current) = self.readers.get_mut(&reliability) {
            // A reader that requests less than all publishers offer matches each of them, and to replace it
            // would lose samples. But a TRANSIENT_LOCAL publisher sends its history only to a reader that is
            // TRANSIENT_LOCAL itself, so an idle VOLATILE reader is replaced.
            let idle = std::mem::take(&mut current.idle);
            let fits = current.qos.durability <= qos.durability
                && !(idle && current.qos.durability < qos.durability);
            // A reader without keys matches no publisher with keys, and the reverse. The route changes over
            // when it has no publisher of the former kind.
            if fits && current.has_keys == (self.info.get().has_keys != 0) {
                return Ok(());
            }
        }
        self.create_reader(participant, dds_type, qos)
    }

    /// Makes the reader idle when it has no publisher any more. A RELIABLE reader stays, because the next
    /// publisher sends as soon as it discovers a reader. A BEST_EFFORT one is removed: alone, it would not
    /// recover lost first samples of a RELIABLE publisher; beside a RELIABLE reader, it would make that
    /// publisher send each sample twice.
    fn retire(&mut self, participant: &mut Participant, reliability: Reliability) {
        if let Some(reader) = self.readers.get_mut(&reliability) {
            reader.idle = true;
            if reliability == Reliability::BestEffort {
                self.remove_reader(participant, reliability);
            }
        }
    }

    /// Creates the reader of the reliability in `qos`, in place of the present one.
    fn create_reader(
        &mut self,
        participant: &mut Participant,
        dds_type: &str,
        qos: ReaderQos,
    ) -> Result<(), RoleError> {
        self.remove_reader(participant, qos.reliability);
        let topic = self.dds_topic.as_str();
        let (hash, has_keys) = (self.info.get().type_hash, self.info.get().has_keys != 0);
        let announced_type = DdsType { name: dds_type, hash, has_keys };
        let record = &mut self.records[qos.reliability as usize];
        let key = record.next(participant.guid(), topic, &announced_type, &qos);
        let reader = match qos.reliability {
            Reliability::Reliable => participant.create_reader_after(
                topic,
                announced_type,
                &qos,
                key,
                self.publishers.last_sequences(),
            )?,
            // A BEST_EFFORT reader takes what arrives from now on; it cannot request earlier samples.
            Reliability::BestEffort => {
                let beside_reliable = self.readers.contains_key(&Reliability::Reliable);
                participant.create_best_effort_reader(topic, announced_type, &qos, key, beside_reliable)?
            }
        };
        info!(
            route = self.id,
            topic,
            dds_type,
            has_keys,
            qos = label(qos.reliability, qos.durability),
            depth = qos.depth,
            "DDS reader created"
        );
        if qos.reliability == Reliability::Reliable {
            for other in self.inbox.readers() {
                other.ignore_reliable_writers();
            }
        }
        self.settled_type = Some(dds_type.to_owned());
        let active = ActiveReader { guid: reader.guid(), has_keys, qos, writers: 0, idle: false };
        self.readers.insert(qos.reliability, active);
        self.inbox.add(reader);
        self.lend_memory();
        Ok(())
    }

    /// Drops the readers, which the DDS library requires before the participant is dropped.
    pub fn close(&mut self) {
        for reader in std::mem::take(&mut self.readers).into_values() {
            drop(self.inbox.remove(reader.guid));
        }
    }

    fn remove_reader(&mut self, participant: &mut Participant, reliability: Reliability) {
        if let Some(former) = self.readers.remove(&reliability) {
            self.records[reliability as usize].removed();
            drop(self.inbox.remove(former.guid));
            participant.remove_endpoint(former.guid);
            self.lend_memory();
        }
    }

    /// Lends the pool's memory to the readers. The DDS library keeps one lender per topic and drops it with
    /// any of the topic's readers, so this is done again after each change.
    fn lend_memory(&self) {
        for reader in self.inbox.readers() {
            reader.lend_memory(self.pool.lender());
        }
    }

    /// Whether the readers are matched with as many publishers as wrote until the former process died.
    pub fn is_matched_again(&self) -> bool {
        self.matched_writers() >= self.publishers.expected()
    }

    /// The number of matched publishers. A RELIABLE one that the BEST_EFFORT reader matched before there was
    /// a RELIABLE reader counts once.
    fn matched_writers(&self) -> u64 {
        let writers = self.readers.iter().map(|(reliability, reader)| match reliability {
            Reliability::BestEffort if self.readers.len() > 1 => {
                reader.writers.min(self.source.best_effort_writers())
            }
            _ => reader.writers,
        });
        writers.sum()
    }

    fn follow_matching(&mut self) {
        for reader in self.inbox.readers() {
            let mut active = self.readers.values_mut();
            let Some(active) = active.find(|active| active.guid == reader.guid()) else { continue };
            while let Some(event) = reader.poll_event() {
                match event {
                    ReaderEvent::Matched { writers } => active.writers = writers,
                    // The RELIABLE reader does not match a BEST_EFFORT publisher; the other reader does.
                    ReaderEvent::Incompatible { writer }
                        if self.route.input_qos.reliability.is_none()
                            && self.source.reliability_of(writer) != Some(Reliability::Reliable) => {}
                    ReaderEvent::Incompatible { writer } => {
                        warn!(
                            route = self.id,
                            ?writer,
                            asked = label(active.qos.reliability, active.qos.durability),
                            "a publisher offers a weaker QoS than the reader requests, so its samples are \
                             not received: remove or relax qos_overrides.input of the topic"
                        );
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
