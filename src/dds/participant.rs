//! A DDS participant that appears as one ROS 2 node.

use std::io;
use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use bytes::Bytes;

use super::arrivals::Arrivals;
use super::discovery::{Changes, Discovery, DiscoveryTurn};
use super::error::DdsError;
use super::graph;
use super::graph_watch::{GraphWatch, MAX_PARTICIPANTS};
use super::identity::{Kept, ParticipantIdentity, WriterContinuation};
use super::network;
use super::qos::{self, ReaderQos};
use super::reader::RawReader;
use super::rustdds::{
    DomainParticipant, DomainParticipantBuilder, GUID, NetworkCounters, Publisher, QosPolicies, RTPSEntity,
    SequenceNumber, Subscriber, ThreadTurns, Topic, TopicKind,
    dds::result::{CreateError, CreateResult},
};
use super::writer::{Matching, RawWriter};
use crate::config::DdsNetwork;
use crate::model::{
    DdsType, Durability, Encapsulation, Guid, History, MonotonicNs, NetworkRefusal, NetworkRefusals,
    QosProfile, Reliability, SourceTimestamp,
};

/// The part that the kernel keeps of the name of the thread of a participant that receives, acknowledges and
/// repairs.
pub const EVENT_LOOP_THREAD: &str = "RustDDS Partici";

/// The settings of a participant.
#[derive(Clone, Debug)]
pub struct ParticipantOptions<'a> {
    /// The DDS domain and the network interfaces.
    pub network: &'a DdsNetwork,
    /// The ROS 2 namespace of the node, such as `/adaptive_bridge`.
    pub namespace: String,
    /// The name of the node, under which ROS 2 shows the process.
    pub node_name: String,
    /// The bytes of an identifier in the ROS 2 graph: 24 up to ROS 2 Humble, 16 since Iron.
    pub graph_gid_bytes: usize,
    /// The Differentiated Services Code Point of what it sends by unicast, 0 to 63.
    pub dscp: u8,
}

/// A DDS participant with its node's entry in the ROS 2 graph.
pub struct Participant {
    /// First, because fields are dropped in this order and the library requires that writers are dropped
    /// first.
    graph: RawWriter,
    /// The highest sequence number of `graph`.
    graph_number: Arc<AtomicI64>,
    changes: Changes,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
    namespace: String,
    node_name: String,
    graph_gid_bytes: usize,
    readers: Vec<Guid>,
    writers: Vec<Guid>,
    /// The turns of the library's threads at the last check of `have_threads_turned` that succeeded.
    turns_seen: ThreadTurns,
    check_turns_at: MonotonicNs,
    network_counters: Arc<NetworkCounters>,
}

/// The QoS of the graph entries, as in `rmw_dds_common`: the last entry is delivered reliably, also to late
/// joiners.
const GRAPH_QOS: QosProfile = QosProfile {
    history: History::KeepLast { depth: 1 },
    durability: Durability::TransientLocal,
    ..QosProfile::CRITICAL
};

/// The QoS for reading the last entry of each participant. The topic has no key, so all participants share
/// the depth. An entry that a burst evicts is replaced when its participant publishes the next one.
const GRAPH_READER_QOS: ReaderQos = ReaderQos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 2 * MAX_PARTICIPANTS as u32,
    deadline_ms: None,
};

/// The most unacknowledged graph entries; one is written for each endpoint that is created or dropped.
const GRAPH_WINDOW_SAMPLES: usize = 1024;

/// A part of the entity id of the writer of graph entries, which is the same in each process.
const GRAPH_KEY: [u8; 3] = [0xff; 3];

/// An eighth of the shortest time of a watchdog; it adds to the time after which a standby kills the
/// process. A check wakes two threads, and housekeeping runs up to 100 times a second.
const CHECK_TURNS_MS: u64 = 250;

impl Participant {
    /// Joins the domain and announces the node.
    ///
    /// # Errors
    /// The DDS library cannot open its sockets. An absent interface is no error: it is used as soon as the
    /// host has it.
    pub fn open(options: &ParticipantOptions) -> Result<Self, DdsError> {
        Self::build(options, 0, |builder| builder)
    }

    /// Like [`open`](Self::open), as a participant that a later process may continue, and that may itself
    /// continue one of a killed process: others take both for the same one.
    ///
    /// # Errors
    /// As for [`open`](Self::open); a port of the identity is taken, or the journal is not sound as a whole.
    pub fn open_kept(options: &ParticipantOptions, kept: Kept) -> Result<Self, DdsError> {
        Self::build(options, kept.graph_number(), |builder| kept.extend(builder))
    }

    /// Like [`open_kept`](Self::open_kept), but the thread that receives calls `on_received` after each
    /// datagram, before it acknowledges it, and after [`ring`](Self::ring). Taking a sample there saves the
    /// wake-up of another thread. Some microseconds earlier, for a datagram with a sample or a fragment of
    /// one, the thread calls `on_arriving` with the writer's GUID, the sequence number, and the bytes of the
    /// sample that are still missing after this datagram, as the datagram claims.
    ///
    /// Readers of `urgent_topics`, which are DDS topic names, get a UDP port of their own. What arrives there
    /// is received before what waits on other ports. Unfinished samples of all readers together take at most
    /// `max_unfinished_bytes` of the library's memory.
    ///
    /// While they run, nothing is received, acknowledged or sent. They must be short, wait for nothing and
    /// not panic, and may take from readers and arm them, but not call the participant. `on_received` returns
    /// true if it has left work undone; it is then called again soon.
    ///
    /// A participant that continues another one receives no samples until
    /// [`receive_samples`](Self::receive_samples): they wait in the sockets, because a sample is discarded if
    /// there is no reader that is matched with its writer.
    ///
    /// # Errors
    /// As for [`open_kept`](Self::open_kept).
    pub fn open_receiving(
        options: &ParticipantOptions,
        kept: Kept,
        max_unfinished_bytes: usize,
        urgent_topics: impl IntoIterator<Item = String>,
        on_arriving: impl FnMut([u8; 16], i64, usize) + Send + 'static,
        on_received: impl FnMut() -> bool + Send + 'static,
    ) -> Result<Self, DdsError> {
        let holds = kept.former.is_some();
        Self::build(options, kept.graph_number(), |builder| {
            let builder = kept.extend(builder);
            let builder = if holds { builder.holding_user_traffic() } else { builder };
            let builder = builder.with_max_unfinished_bytes(max_unfinished_bytes);
            let builder = builder.with_urgent_topics(urgent_topics);
            builder.on_sample_arriving(on_arriving).on_received(on_received)
        })
    }

    fn build(
        options: &ParticipantOptions,
        graph_number: i64,
        extend: impl FnOnce(DomainParticipantBuilder) -> DomainParticipantBuilder,
    ) -> Result<Self, DdsError> {
        let mut builder = DomainParticipantBuilder::new(options.network.domain_id);
        let interfaces = &options.network.interfaces;
        if !interfaces.is_empty() {
            builder = builder.with_only_interfaces(network::selectors(interfaces));
        }
        builder = builder.with_discovery_peers(options.network.static_peers.iter().copied());
        builder = builder.with_dscp(options.dscp).with_user_data(qos::enclave());
        for absent in network::absent_interfaces(interfaces)? {
            tracing::warn!(node = options.node_name, domain_id = options.network.domain_id, "{absent}");
        }
        let failed = |error: CreateError| {
            DdsError::library(format!("a participant in DDS domain {}", options.network.domain_id), error)
        };
        let participant = extend(builder).build().map_err(failed)?;
        let none = QosPolicies::qos_none();
        let publisher = participant.create_publisher(&none).map_err(failed)?;
        let subscriber = participant.create_subscriber(&none).map_err(failed)?;
        let changes = Changes::of(&participant);
        let number = Arc::new(AtomicI64::new(graph_number));
        let told = Arc::clone(&number);
        let continuation = WriterContinuation {
            key: GRAPH_KEY,
            highest_number: graph_number,
            samples: Vec::new(),
            sent_through: graph_number,
            readers: Vec::new(),
            on_number: Box::new(move |number, _| told.store(number, Ordering::Relaxed)),
        };
        let graph = make_writer(
            &participant,
            &publisher,
            graph::TOPIC,
            graph::TYPE,
            qos::of_writer(&GRAPH_QOS, GRAPH_WINDOW_SAMPLES),
            Some(continuation),
        )?;
        let network_counters = participant.network_counters();
        let opened = Self {
            participant,
            publisher,
            subscriber,
            changes,
            graph,
            graph_number: number,
            namespace: options.namespace.clone(),
            node_name: options.node_name.clone(),
            graph_gid_bytes: options.graph_gid_bytes,
            readers: Vec::new(),
            writers: Vec::new(),
            turns_seen: ThreadTurns::default(),
            check_turns_at: MonotonicNs::default(),
            network_counters,
        };
        opened.publish_graph_entry();
        Ok(opened)
    }

    /// Its GUID.
    pub fn guid(&self) -> Guid {
        Guid(self.participant.guid().to_bytes())
    }

    /// What a later process needs to [continue](Self::open_kept) the participant; `None` if that cannot be
    /// done, because a port is not the one that goes with the participant id.
    pub fn identity(&self) -> Option<ParticipantIdentity> {
        let graph_number = self.graph_number.load(Ordering::Relaxed);
        let identity = self.participant.identity()?;
        Some(ParticipantIdentity::from_rustdds(identity, graph_number, self.guid()))
    }

    /// Duplicates of its sockets, for a later process, in which what arrives waits until then. Once.
    ///
    /// # Errors
    /// The process has no file descriptor left, the participant is not one to be continued, or this was
    /// called before.
    pub fn sockets(&self) -> io::Result<Vec<UdpSocket>> {
        self.participant.sockets()
    }

    /// Receives the samples that wait in the sockets of a participant of
    /// [`open_receiving`](Self::open_receiving) that continues another one, and later ones.
    pub fn receive_samples(&self) {
        self.participant.receive_user_traffic();
    }

    /// What discovery knows of other participants and of their endpoints of this one's topics.
    pub fn discovery_journal(&self) -> Vec<u8> {
        self.participant.discovery_journal()
    }

    /// Makes the thread that receives call `on_received` of [`open_receiving`](Self::open_receiving) once.
    pub fn ring(&self) {
        self.participant.wake_event_loop();
    }

    /// Whether the receiving thread and the discovery thread turn: false if one of them hangs or has ended.
    /// Then the participant receives nothing or finds no peer, without an error.
    ///
    /// It checks that both have begun a turn since the last check, and wakes them for the next one. After a
    /// check that has succeeded it returns true for a quarter of a second without another.
    pub fn have_threads_turned(&mut self, now: MonotonicNs) -> bool {
        if now < self.check_turns_at {
            return true;
        }
        let (seen, turns) = (self.turns_seen, self.participant.wake_threads());
        let turned = turns.event_loop != seen.event_loop && turns.discovery != seen.discovery;
        if turned {
            self.turns_seen = turns;
            self.check_turns_at = now.plus_ms(CHECK_TURNS_MS);
        }
        turned
    }

    /// What the participant has refused of the network since it was opened.
    pub fn network_refusals(&self) -> NetworkRefusals {
        let counts = self.network_counters.counts();
        let mut refusals = NetworkRefusals::default();
        refusals.add(NetworkRefusal::MalformedDatagram, counts.malformed_datagrams);
        refusals.add(NetworkRefusal::TooManyParticipants, counts.announcements_refused);
        refusals.add(NetworkRefusal::EvictedParticipant, counts.participants_evicted);
        refusals.add(NetworkRefusal::TooManyEndpoints, counts.endpoints_refused);
        refusals.add(NetworkRefusal::UnfinishedSample, counts.unfinished_discarded);
        refusals
    }

    /// Returns a watch of the sockets on which samples arrive, for a thread that peeks at datagrams before
    /// they are received. Drop it before the participant, because it keeps the participant's ports bound.
    ///
    /// # Errors
    /// The process has no file descriptor left, the participant is not from
    /// [`open_receiving`](Self::open_receiving), or this was called before.
    pub fn arrivals(&self) -> Result<Arrivals, DdsError> {
        Arrivals::new(self.participant.sockets_to_peek())
    }

    /// Announces that a participant whose process died has left. Remote participants then drop its readers
    /// and writers at once, instead of when its lease expires, 15 s later. Until then a RELIABLE, KEEP_ALL
    /// publisher waits for acknowledgements of a reader that no longer exists.
    pub fn dispose_participant(&self, dead: Guid) {
        if dead != Guid::default() && self.participant.dispose_participant(GUID::from_bytes(dead.0)).is_err()
        {
            tracing::warn!(
                ?dead,
                "cannot announce that the participant of a dead process has left; remote participants drop \
                 it when its lease expires"
            );
        }
    }

    /// Tells other participants that a writer of the former process is gone, whose participant this one
    /// continues. `key` is the part of its entity id that [`WriterContinuation::key`] gave.
    pub fn dispose_former_writer(&self, key: [u8; 3]) {
        if self.participant.dispose_former_writer(key).is_err() {
            tracing::warn!(?key, "cannot announce that a writer of the former process is gone");
        }
    }

    /// Whether an endpoint belongs to this participant.
    pub fn owns(&self, endpoint: Guid) -> bool {
        endpoint.prefix() == self.guid().prefix()
    }

    /// Creates a reader of `topic`, a DDS topic name, and adds it to the node's graph entry.
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_reader<'t>(
        &mut self,
        topic: &str,
        dds_type: impl Into<DdsType<'t>>,
        reader_qos: &ReaderQos,
    ) -> Result<RawReader, DdsError> {
        let begin = DomainParticipant::begin_now;
        let reader = self.make_reader(topic, dds_type.into(), reader_qos, None, begin)?;
        Ok(self.add_to_graph(reader))
    }

    /// Like [`create_reader`](Self::create_reader), for a RELIABLE reader that continues after an earlier
    /// one, of this process or of another. For each writer in `taken` it neither requests nor returns samples
    /// up to and including that sequence number. It returns every sample that arrives after its creation.
    ///
    /// `key` is a part of its entity id, which no other reader of the participant has; it begins with a byte
    /// from 0x80 to 0xfe. A reader that has that of the former participant's reader is the same one to
    /// others.
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_reader_after(
        &mut self,
        topic: &str,
        dds_type: DdsType<'_>,
        reader_qos: &ReaderQos,
        key: [u8; 3],
        taken: impl IntoIterator<Item = (Guid, i64)>,
    ) -> Result<RawReader, DdsError> {
        // The library adds 1 to the number.
        let last_taken = |number: i64| SequenceNumber::from(number.min(i64::MAX - 1));
        let taken =
            taken.into_iter().map(|(writer, number)| (GUID::from_bytes(writer.0), last_taken(number)));
        let reader = self.make_reader(topic, dds_type, reader_qos, Some(key), |participant, topic| {
            participant.begin_after(topic, taken)
        })?;
        Ok(self.add_to_graph(reader))
    }

    /// Like [`create_reader`](Self::create_reader), for a BEST_EFFORT reader. It is beside a RELIABLE one of
    /// the same topic if `beside_reliable`: it [ignores](RawReader::ignore_reliable_writers) RELIABLE writers
    /// from its creation on. `key` is as for [`create_reader_after`](Self::create_reader_after).
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_best_effort_reader(
        &mut self,
        topic: &str,
        dds_type: DdsType<'_>,
        reader_qos: &ReaderQos,
        key: [u8; 3],
        beside_reliable: bool,
    ) -> Result<RawReader, DdsError> {
        let begin = DomainParticipant::begin_now;
        let reader = self.make_reader(topic, dds_type, reader_qos, Some(key), begin)?;
        if beside_reliable {
            reader.ignore_reliable_writers();
        }
        Ok(self.add_to_graph(reader))
    }

    fn add_to_graph(&mut self, reader: RawReader) -> RawReader {
        self.readers.push(reader.guid);
        self.publish_graph_entry();
        reader
    }

    /// Creates a [`GraphWatch`], which reads the graph entries of the other participants. As in ROS 2 itself,
    /// its reader is not in the node's graph entry.
    ///
    /// # Errors
    /// The DDS library cannot create the reader.
    pub fn watch_graph(&self) -> Result<GraphWatch, DdsError> {
        let reader = self.make_reader(graph::TOPIC, graph::TYPE, &GRAPH_READER_QOS, None, |_, _| Ok(()))?;
        reader.expect_small_samples();
        Ok(GraphWatch::new(reader))
    }

    /// Creates a reader. `begin` determines with which sample it begins: the library keeps samples by topic,
    /// beyond the life of a reader, so a new reader would take samples again that an earlier one has taken.
    fn make_reader(
        &self,
        topic: &str,
        dds_type: DdsType<'_>,
        reader_qos: &ReaderQos,
        key: Option<[u8; 3]>,
        begin: impl FnOnce(&DomainParticipant, &Topic) -> CreateResult<()>,
    ) -> Result<RawReader, DdsError> {
        let policies = qos::of_reader(reader_qos).with_user_data(qos::user_data(dds_type.hash));
        let made_topic = make_topic(&self.participant, topic, dds_type, &policies)?;
        let create = || match key {
            Some(key) => {
                self.subscriber.create_simple_datareader_raw_continuing(&made_topic, Some(policies), key)
            }
            None => self.subscriber.create_simple_datareader_raw(&made_topic, Some(policies)),
        };
        let inner = begin(&self.participant, &made_topic)
            .and_then(|()| create())
            .map_err(|error| DdsError::library(format!("a reader of {topic}"), error))?;
        let guid = Guid(inner.guid().to_bytes());
        Ok(RawReader { inner, guid })
    }

    /// Creates a writer of `topic`, a DDS topic name, and adds it to the node's graph entry. A RELIABLE
    /// writer retains `window_samples` that readers have not acknowledged. Beyond that it evicts the oldest
    /// sample, which is an overrun for each reader that has not acknowledged it.
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_writer<'t>(
        &mut self,
        topic: &str,
        dds_type: impl Into<DdsType<'t>>,
        writer_qos: &QosProfile,
        window_samples: usize,
    ) -> Result<RawWriter, DdsError> {
        let policies = qos::of_writer(writer_qos, window_samples);
        self.add_writer(topic, dds_type.into(), policies, None)
    }

    /// Like [`create_writer`](Self::create_writer), for a writer that continues one of a killed process.
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_writer_continuing(
        &mut self,
        topic: &str,
        dds_type: DdsType<'_>,
        writer_qos: &QosProfile,
        window_samples: usize,
        continuation: WriterContinuation,
    ) -> Result<RawWriter, DdsError> {
        let policies = qos::of_writer(writer_qos, window_samples);
        self.add_writer(topic, dds_type, policies, Some(continuation))
    }

    /// Like [`create_writer`](Self::create_writer), but [`RawWriter::write`] of a KEEP_ALL writer waits up to
    /// `max_blocking` for room in a full window, as ROS 2 publishers do (100 ms). For demo and tests: the
    /// bridge itself never waits.
    ///
    /// # Errors
    /// The DDS library cannot create it.
    pub fn create_blocking_writer<'t>(
        &mut self,
        topic: &str,
        dds_type: impl Into<DdsType<'t>>,
        writer_qos: &QosProfile,
        window_samples: usize,
        max_blocking: Duration,
    ) -> Result<RawWriter, DdsError> {
        let policies = qos::of_blocking_writer(writer_qos, window_samples, max_blocking);
        self.add_writer(topic, dds_type.into(), policies, None)
    }

    fn add_writer(
        &mut self,
        topic: &str,
        dds_type: DdsType<'_>,
        policies: QosPolicies,
        continuation: Option<WriterContinuation>,
    ) -> Result<RawWriter, DdsError> {
        let writer =
            make_writer(&self.participant, &self.publisher, topic, dds_type, policies, continuation)?;
        self.writers.push(writer.guid());
        self.publish_graph_entry();
        Ok(writer)
    }

    /// Removes a dropped reader or writer from the node's graph entry.
    pub fn remove_endpoint(&mut self, endpoint: Guid) {
        self.readers.retain(|guid| *guid != endpoint);
        self.writers.retain(|guid| *guid != endpoint);
        self.publish_graph_entry();
    }

    /// Forgets a topic, a DDS topic name, of which all readers and writers have been dropped: else the
    /// library keeps its last samples as long as the participant.
    pub fn forget_topic(&self, topic: &str) {
        self.participant.forget_topic(topic);
    }

    /// Waits until discovery reports a change that [`poll_discovery`](Self::poll_discovery) has not returned,
    /// or for `most`. It may return earlier.
    pub fn wait_for_discovery(&self, most: Duration) {
        self.changes.wait(most);
    }

    /// Returns the next change that discovery reports, if there is one and `turn` still takes one. If more
    /// waited than can, it compares what it has returned with all that discovery has, at most once a second,
    /// and returns the difference at the end of the turn, which is to be polled until then.
    pub fn poll_discovery(&mut self, turn: &mut DiscoveryTurn) -> Option<Discovery> {
        self.changes.poll(&self.participant, turn)
    }

    fn publish_graph_entry(&self) {
        let entry = graph::encode_graph(
            self.guid(),
            &self.namespace,
            &self.node_name,
            &self.readers,
            &self.writers,
            self.graph_gid_bytes,
        );
        // A full window means that 1024 entries are unacknowledged; the next entry lists all endpoints again.
        if let Err(error) = self.graph.write(Bytes::from(entry), Encapsulation::CDR_LE, SourceTimestamp::NONE)
        {
            tracing::warn!(node = self.node_name, %error, "cannot publish the node's ROS 2 graph entry");
        }
    }
}

fn make_topic(
    participant: &DomainParticipant,
    name: &str,
    dds_type: DdsType<'_>,
    policies: &QosPolicies,
) -> Result<Topic, DdsError> {
    let kind = if dds_type.has_keys { TopicKind::WithKey } else { TopicKind::NoKey };
    participant
        .create_topic(name.to_owned(), dds_type.name.to_owned(), policies, kind)
        .map_err(|error| DdsError::library(format!("the topic {name}"), error))
}

fn make_writer(
    participant: &DomainParticipant,
    publisher: &Publisher,
    topic: &str,
    dds_type: DdsType<'_>,
    policies: QosPolicies,
    continuation: Option<WriterContinuation>,
) -> Result<RawWriter, DdsError> {
    let made_topic = make_topic(participant, topic, dds_type, &policies)?;
    let policies = policies.with_user_data(qos::user_data(dds_type.hash));
    let inner = match continuation {
        None => publisher.create_datawriter_raw(&made_topic, Some(policies)),
        Some(continuation) => publisher.create_datawriter_raw_continuing(
            &made_topic,
            Some(policies),
            continuation.into_rustdds(),
        ),
    };
    let inner = inner.map_err(|error| DdsError::library(format!("a writer of {topic}"), error))?;
    let guid = Guid(inner.guid().to_bytes());
    Ok(RawWriter { inner, guid, matching: Matching::default() })
}
