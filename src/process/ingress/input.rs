//! One route in ingress: its readers, its pool, its counters.

use std::sync::Arc;

use tracing::{error, info, warn};

use super::super::inbox::{Bell, Inbox};
use super::super::role::{Role, RoleError};
use super::super::watch::DropWatch;
use super::clocks::Clocks;
use super::followed::Followed;
use super::pool::{Filled, PoolOwner};
use super::publishers::{Publishers, Standing};
use super::source::{Source, Wanted, label};
use crate::clock;
use crate::config::{Route, Settings};
use crate::dds::{Endpoint, Participant, Payload, ReaderEvent, ReaderQos, SampleOrigin, Take};
use crate::model::{
    DropReason, Encapsulation, FixedText, Guid, IngressCounters, MonotonicNs, Reliability, RouteInfo,
    SampleHeader, TopicName,
};
use crate::shm::{BoardWriter, HistogramWriter, LoanError, RouteChannel, SamplePublisher, Stage};

/// How often a route without a publisher says so.
const REMIND_MS: u64 = 30_000;

/// One route in ingress.
pub(super) struct Input {
    id: String,
    dds_topic: String,
    configured_type: Option<String>,
    route: Route,
    source: Source,
    inbox: Inbox,
    /// The reader of the RELIABLE publishers, or of all where the configuration says RELIABLE.
    reliable: Option<Reading>,
    /// The reader of the BEST_EFFORT publishers, or of all where the configuration says BEST_EFFORT.
    best_effort: Option<Reading>,
    /// The type that the lanes have writers for: once read, it stays.
    settled_type: Option<String>,
    /// Whether the publishers have changed since the reader was last thought over.
    source_changed: bool,
    pool: PoolOwner,
    counters: BoardWriter<IngressCounters>,
    info: BoardWriter<RouteInfo>,
    dds_in: HistogramWriter,
    clocks: Clocks,
    publishers: Publishers,
    watch: DropWatch,
    remind_at: MonotonicNs,
    conflict: Option<(String, String)>,
}

/// One reader of the inbox.
struct Reading {
    reader: Guid,
    qos: ReaderQos,
    /// Publishers matched.
    writers: u64,
    /// Whether its last publisher is gone.
    idle: bool,
}

impl Input {
    pub fn open(role: &Role, settings: &Settings, index: usize, bell: &Arc<Bell>) -> Result<Self, RoleError> {
        let route = settings.routes[index].clone();
        let mut counters = role.boards.ingress_writer(index);
        counters.update(|counters| counters.writers = 0);
        let publishers = Publishers::open(&role.boards, index, counters.get(), clock::monotonic());
        Ok(Self {
            id: route.id.to_string(),
            dds_topic: route.input_topic.to_dds(),
            configured_type: route.message_type.as_ref().map(|name| name.to_dds()),
            source: Source::default(),
            inbox: Inbox::with_bell(Arc::clone(bell)),
            reliable: None,
            best_effort: None,
            settled_type: None,
            source_changed: true,
            pool: PoolOwner::new(SamplePublisher::create(&role.node, &RouteChannel::of(settings, index))?),
            watch: DropWatch::new(counters.get().drops),
            counters,
            info: role.boards.route_info_writer(index),
            dds_in: role.boards.histogram_writer(Stage::DdsIn, index),
            clocks: Clocks::new(route.id.as_str()),
            publishers,
            remind_at: MonotonicNs(0),
            conflict: None,
            route,
        })
    }

    /// Whether a publisher was found and is read.
    pub fn is_connected(&self) -> bool {
        self.readings().any(|reading| !reading.idle)
    }

    /// Whether a sample has come of each publisher that wrote until the predecessor of this process died.
    pub fn has_resumed(&self) -> bool {
        self.publishers.have_resumed()
    }

    /// What was done so far.
    pub fn counters(&self) -> &IngressCounters {
        self.counters.get()
    }

    /// The input topic.
    pub fn topic(&self) -> &TopicName {
        &self.route.input_topic
    }

    /// Takes one sample and publishes it; whether there was one. `wake` wakes the lanes. When there was none
    /// the bell is silent, and rings at the next arrival.
    pub fn step(&mut self, wake: impl FnOnce()) -> bool {
        let pool = &self.pool;
        let mut received: Option<(Filled, Encapsulation)> = None;
        let mut receive = |payload: Payload<'_>, encapsulation: Encapsulation| {
            received = Some((pool.fill(payload), encapsulation));
        };
        match self.inbox.take_payload(&mut receive) {
            Take::Empty => return false,
            Take::Sample(origin) => match received {
                Some((filled, encapsulation)) => {
                    self.publish(filled, encapsulation, origin, wake);
                }
                // The library says that there was a sample and gave none; it has no such path today.
                None => self.count_malformed(),
            },
            Take::Malformed => self.count_malformed(),
        }
        true
    }

    /// The high-water marks of the publishers.
    pub fn followed(&self) -> Arc<Followed> {
        self.publishers.followed()
    }

    fn publish(
        &mut self,
        filled: Filled,
        encapsulation: Encapsulation,
        origin: SampleOrigin,
        wake: impl FnOnce(),
    ) {
        let taken_at = clock::monotonic();
        let taken_at_wall = clock::wall();
        let place = match self.publishers.standing(origin.writer, origin.sequence, taken_at) {
            Standing::Next(place) => Some(place),
            Standing::Unmarked => None,
            Standing::Repeated(place) => {
                self.publishers.update(place, &mut self.counters, |counters, account| {
                    counters.repeated += 1;
                    account.repeated += 1;
                });
                return;
            }
        };
        let source = origin.source_timestamp;
        let age_basis = self.clocks.observe(origin.writer, source, taken_at, taken_at_wall);
        let dropped = match filled.slot {
            Ok(_) => None,
            Err(LoanError::TooLarge { .. }) => Some(DropReason::TooLarge),
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
        // Counted before it is published: a process that dies in between leaves a hole in the sequence, which
        // the lanes count, and neither two samples of one number nor one sample published twice.
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
        if let Ok(slot) = filled.slot {
            let header = SampleHeader {
                sequence,
                source_timestamp: origin.source_timestamp,
                taken_at,
                published_at: clock::monotonic(),
                writer_sequence: origin.sequence,
                writer_guid: origin.writer,
                encapsulation,
                age_basis,
            };
            let published = slot.publish(header);
            wake();
            if let Err(error) = published {
                error!(route = self.id, ?error, "sample not published; the lanes will count it as missing");
            }
        }
        match (age_basis.late_ns(), source.to_wall()) {
            (Some(late_ns), _) => self.dds_in.record(late_ns),
            (None, Some(written)) => self.dds_in.record(taken_at_wall.since(written)),
            (None, None) => {}
        }
    }

    fn count_malformed(&mut self) {
        self.counters.update(|counters| {
            counters.received += 1;
            counters.drops.add(DropReason::Malformed, 1);
        });
    }

    /// Discovery knows a writer; whatever its topic.
    pub fn writer_found(&mut self, writer: &Endpoint) {
        if writer.topic != self.dds_topic {
            return;
        }
        self.source_changed = true;
        self.publishers.found(writer.guid);
        if self.source.found(writer) {
            info!(
                route = self.id,
                topic = self.dds_topic,
                dds_type = writer.dds_type,
                offers = label(writer.reliability, writer.durability),
                "publisher found"
            );
        }
    }

    /// A participant is gone, and with it its writers.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) {
        self.source_changed |= self.source.participant_gone(prefix);
        self.publishers.participant_gone(prefix);
    }

    /// A writer is gone; whatever its topic.
    pub fn writer_gone(&mut self, guid: Guid) {
        self.source.gone(guid);
        self.publishers.gone(guid);
        self.source_changed = true;
    }

    /// Connects to the publisher, attends to lanes that came, logs.
    pub fn keep_house(&mut self, participant: &mut Participant, now: MonotonicNs) -> Result<(), RoleError> {
        self.connect(participant, now)?;
        self.follow_matching();
        self.pool.attend();
        self.publishers.set_reliabilities(|writer| self.source.reliability_of(writer));
        let mut counters = *self.counters.get();
        counters.writers = self.matched_writers();
        self.clocks.keep_house(&mut counters, now);
        if counters != *self.counters.get() {
            self.counters.update(|present| *present = counters);
        }
        self.watch.look(&self.counters.get().drops, &self.id, "ingress", &[], now);
        Ok(())
    }

    fn connect(&mut self, participant: &mut Participant, now: MonotonicNs) -> Result<(), RoleError> {
        if self.is_connected() && !std::mem::take(&mut self.source_changed) {
            return Ok(());
        }
        let known_type = self.settled_type.as_deref().or(self.configured_type.as_deref());
        if let Some(dds_type) = known_type
            && let Some(other) = self.source.of_other_type(dds_type)
        {
            let conflict = (dds_type.to_owned(), other.dds_type.clone());
            self.report_conflict(conflict);
        }
        let known_type = self.settled_type.as_deref().or(self.configured_type.as_deref());
        let wanted = self.source.wanted(known_type, &self.route.input_qos, self.route.max_sample_bytes);
        match wanted {
            Wanted::Readers { dds_type, reliable, best_effort } => {
                // First this one: until it is there, the BEST_EFFORT reader takes what a RELIABLE publisher
                // writes that has just joined BEST_EFFORT ones.
                self.adapt(participant, Reliability::Reliable, &dds_type, reliable)?;
                self.adapt(participant, Reliability::BestEffort, &dds_type, best_effort)
            }
            Wanted::TypeConflict(one, other) => {
                self.report_conflict((one, other));
                Ok(())
            }
            Wanted::Unknown => {
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

    /// Brings the reader of that reliability in line with what is wanted.
    fn adapt(
        &mut self,
        participant: &mut Participant,
        reliability: Reliability,
        dds_type: &str,
        wanted: Option<ReaderQos>,
    ) -> Result<(), RoleError> {
        let Some(qos) = wanted else {
            self.retire(participant, reliability);
            return Ok(());
        };
        if let Some(current) = self.reading_mut(reliability) {
            // A reader that asks for less than all publishers offer is matched with each of them, and to
            // replace it would lose samples. But what a TRANSIENT_LOCAL publisher wrote before, it sends only
            // to a reader that asks for it.
            let idle = std::mem::take(&mut current.idle);
            if current.qos.durability <= qos.durability && !(idle && current.qos.durability < qos.durability)
            {
                return Ok(());
            }
        }
        self.read(participant, dds_type, qos)
    }

    /// The last publisher of the reader is gone. The next one begins as soon as it finds a reader, so a
    /// RELIABLE reader stays for it. Behind a BEST_EFFORT one the first samples of a RELIABLE publisher would
    /// not be repaired, and beside a RELIABLE one its publishers would send everything twice.
    fn retire(&mut self, participant: &mut Participant, reliability: Reliability) {
        if let Some(reading) = self.reading_mut(reliability) {
            reading.idle = true;
            if reliability == Reliability::BestEffort {
                self.disconnect(participant, reliability);
            }
        }
    }

    fn read(
        &mut self,
        participant: &mut Participant,
        dds_type: &str,
        qos: ReaderQos,
    ) -> Result<(), RoleError> {
        self.disconnect(participant, qos.reliability);
        // Before the reader: a lane must be able to make its writer before the first sample reaches it.
        self.info.update(|info| info.dds_type = FixedText::new(dds_type));
        let topic = self.dds_topic.as_str();
        let reader = match qos.reliability {
            Reliability::Reliable => {
                participant.create_reader_after(topic, dds_type, &qos, self.publishers.marks())?
            }
            // A BEST_EFFORT reader takes by time, not by number.
            Reliability::BestEffort if self.reliable.is_none() => {
                participant.create_reader(topic, dds_type, &qos)?
            }
            Reliability::BestEffort => participant.create_reader_beside_reliable(topic, dds_type, &qos)?,
        };
        info!(
            route = self.id,
            topic,
            dds_type,
            qos = label(qos.reliability, qos.durability),
            depth = qos.depth,
            "reading"
        );
        if qos.reliability == Reliability::Reliable {
            for other in self.inbox.readers() {
                other.ignore_reliable_writers();
            }
        }
        self.settled_type = Some(dds_type.to_owned());
        *self.place(qos.reliability) = Some(Reading { reader: reader.guid(), qos, writers: 0, idle: false });
        self.inbox.add(reader);
        self.lend_memory();
        Ok(())
    }

    /// Lets go of the readers, which the DDS library wants gone before the participant.
    pub fn close(&mut self) {
        for reading in [self.reliable.take(), self.best_effort.take()].into_iter().flatten() {
            drop(self.inbox.remove(reading.reader));
        }
    }

    fn disconnect(&mut self, participant: &mut Participant, reliability: Reliability) {
        if let Some(former) = self.place(reliability).take() {
            drop(self.inbox.remove(former.reader));
            participant.forget(former.reader);
            self.lend_memory();
        }
    }

    /// Lends the readers the pool's memory. It is lent by topic, and a reader that goes ends it.
    fn lend_memory(&self) {
        for reader in self.inbox.readers() {
            reader.lend_memory(self.pool.lender());
        }
    }

    fn place(&mut self, reliability: Reliability) -> &mut Option<Reading> {
        match reliability {
            Reliability::Reliable => &mut self.reliable,
            Reliability::BestEffort => &mut self.best_effort,
        }
    }

    fn reading_mut(&mut self, reliability: Reliability) -> Option<&mut Reading> {
        self.place(reliability).as_mut()
    }

    fn readings(&self) -> impl Iterator<Item = &Reading> {
        [&self.reliable, &self.best_effort].into_iter().flatten()
    }

    /// Publishers matched. A RELIABLE one that the BEST_EFFORT reader has matched before there was a RELIABLE
    /// reader counts once.
    fn matched_writers(&self) -> u64 {
        match (&self.reliable, &self.best_effort) {
            (Some(reliable), Some(best_effort)) => {
                reliable.writers + best_effort.writers.min(self.source.best_effort_writers())
            }
            _ => self.readings().map(|reading| reading.writers).sum(),
        }
    }

    fn follow_matching(&mut self) {
        for reader in self.inbox.readers() {
            let mut readings = [&mut self.reliable, &mut self.best_effort].into_iter().flatten();
            let Some(reading) = readings.find(|reading| reading.reader == reader.guid()) else { continue };
            while let Some(event) = reader.poll_event() {
                match event {
                    ReaderEvent::Matched { writers } => reading.writers = writers,
                    // The other reader has it.
                    ReaderEvent::Incompatible { writer }
                        if self.route.input_qos.reliability.is_none()
                            && self.source.reliability_of(writer) != Some(Reliability::Reliable) => {}
                    ReaderEvent::Incompatible { writer } => {
                        warn!(
                            route = self.id,
                            ?writer,
                            asked = label(reading.qos.reliability, reading.qos.durability),
                            "a publisher offers less than the reader asks for: leave qos_overrides.input open"
                        );
                    }
                }
            }
        }
    }

    fn report_conflict(&mut self, conflict: (String, String)) {
        if self.conflict.as_ref() != Some(&conflict) {
            error!(
                route = self.id,
                topic = self.dds_topic,
                one = conflict.0,
                other = conflict.1,
                "two types claim the topic: set message_type of the route, or stop one of the publishers"
            );
            self.conflict = Some(conflict);
        }
    }
}
