//! One DDS participant, which is one ROS 2 node.

use std::time::Duration;

use bytes::Bytes;

use super::arrivals::Arrivals;
use super::discovery::{Discovery, translate};
use super::error::DdsError;
use super::graph;
use super::graph_watch::{GraphWatch, MAX_PARTICIPANTS};
use super::network;
use super::qos::{self, ReaderQos};
use super::reader::{RawReader, Take};
use super::rustdds::{
    DomainParticipant, DomainParticipantBuilder, DomainParticipantStatusListener, GUID, Publisher,
    QosPolicies, RTPSEntity, SequenceNumber, StatusEvented, Subscriber, Topic, TopicKind,
};
use super::writer::RawWriter;
use crate::config::DdsNetwork;
use crate::model::{Durability, Guid, History, QosProfile, Reliability, SourceTimestamp};

/// What a participant is made of.
#[derive(Clone, Debug)]
pub struct ParticipantOptions<'a> {
    /// Domain and interfaces.
    pub network: &'a DdsNetwork,
    /// The ROS 2 namespace of the node, such as `/adaptive_bridge`.
    pub namespace: String,
    /// The name under which ROS 2 shows the process.
    pub node_name: String,
    /// Length of a graph identifier: 24 up to ROS 2 Humble, 16 since Iron.
    pub graph_gid_bytes: usize,
}

/// A DDS participant with its node's entry in the ROS 2 graph.
pub struct Participant {
    /// First, because fields are dropped in this order and the library wants its writers gone first.
    graph: RawWriter,
    listener: DomainParticipantStatusListener,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
    namespace: String,
    node_name: String,
    graph_gid_bytes: usize,
    readers: Vec<Guid>,
    writers: Vec<Guid>,
}

/// Each participant offers its graph entry as `rmw_dds_common` does: the last one, reliably, to late joiners.
const GRAPH_QOS: QosProfile = QosProfile {
    reliability: Reliability::Reliable,
    history: History::KeepLast { depth: 1 },
    durability: Durability::TransientLocal,
    lifespan_ms: None,
    deadline_ms: None,
};

/// Reads the last entry of each participant. The topic has no key, so the depth is that of all together; an
/// entry that is pushed out by a burst comes again when its participant next changes.
const GRAPH_READER_QOS: ReaderQos = ReaderQos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 2 * MAX_PARTICIPANTS as u32,
    deadline_ms: None,
};

/// Graph entries that may be unacknowledged; one is written for each endpoint made or dropped.
const GRAPH_WINDOW_SAMPLES: usize = 1024;

impl Participant {
    /// Joins the domain and announces the node.
    ///
    /// # Errors
    /// The DDS library cannot open its sockets. That an interface is absent is no error: it is used as soon
    /// as it is there.
    pub fn open(options: &ParticipantOptions) -> Result<Self, DdsError> {
        Self::build(options, |builder| builder)
    }

    /// Like [`open`](Self::open), and lets the thread that receives call `on_received`: after each datagram,
    /// before it is acknowledged, and when [`ring`](Self::ring) asks for it. A sample taken there has not
    /// been handed to another thread first, which saves a wake-up. It calls `on_arriving` some microseconds
    /// before, when it has a datagram with a sample or a part of one, with the writer, the sequence number,
    /// and how many bytes of the sample are yet to come behind it, as the datagram claims.
    ///
    /// While they run, nothing is received, acknowledged or sent. They must be short, wait for nothing and
    /// not panic, and may take from readers and arm them, but not call the participant. If `on_received` has
    /// more to do than it does at once it returns true, and is called again soon.
    ///
    /// # Errors
    /// As for [`open`](Self::open).
    pub fn open_receiving(
        options: &ParticipantOptions,
        mut on_arriving: impl FnMut(Guid, i64, usize) + Send + 'static,
        on_received: impl FnMut() -> bool + Send + 'static,
    ) -> Result<Self, DdsError> {
        let on_arriving = move |writer: GUID, sequence, left_bytes| {
            on_arriving(Guid(writer.to_bytes()), sequence, left_bytes);
        };
        Self::build(options, |builder| builder.on_sample_arriving(on_arriving).on_received(on_received))
    }

    fn build(
        options: &ParticipantOptions,
        extend: impl FnOnce(DomainParticipantBuilder) -> DomainParticipantBuilder,
    ) -> Result<Self, DdsError> {
        let what = || format!("a participant in DDS domain {}", options.network.domain_id);
        let mut builder = DomainParticipantBuilder::new(options.network.domain_id);
        let interfaces = &options.network.interfaces;
        if !interfaces.is_empty() {
            builder = builder.with_only_interfaces(network::selectors(interfaces));
        }
        for absent in network::absent_interfaces(interfaces)? {
            tracing::warn!(node = options.node_name, domain_id = options.network.domain_id, "{absent}");
        }
        let participant = extend(builder).build().map_err(|error| DdsError::library(what(), error))?;
        let none = QosPolicies::qos_none();
        let publisher =
            participant.create_publisher(&none).map_err(|error| DdsError::library(what(), error))?;
        let subscriber =
            participant.create_subscriber(&none).map_err(|error| DdsError::library(what(), error))?;
        let listener = participant.status_listener();
        let graph = make_writer(
            &participant,
            &publisher,
            graph::TOPIC,
            graph::TYPE,
            &qos::of_writer(&GRAPH_QOS, GRAPH_WINDOW_SAMPLES),
        )?;
        let opened = Self {
            participant,
            publisher,
            subscriber,
            listener,
            graph,
            namespace: options.namespace.clone(),
            node_name: options.node_name.clone(),
            graph_gid_bytes: options.graph_gid_bytes,
            readers: Vec::new(),
            writers: Vec::new(),
        };
        opened.announce();
        Ok(opened)
    }

    /// The participant's GUID.
    pub fn guid(&self) -> Guid {
        Guid(self.participant.guid().to_bytes())
    }

    /// Lets the thread that receives turn once, with a call of what [`open_receiving`](Self::open_receiving)
    /// was given.
    pub fn ring(&self) {
        self.participant.wake_event_loop();
    }

    /// Where samples come in, for a thread that looks at them before they are received. To be dropped before
    /// the participant, whose ports it has, too.
    ///
    /// # Errors
    /// The process may have no more descriptors; it is not from [`open_receiving`](Self::open_receiving), or
    /// this was called before.
    pub fn arrivals(&self) -> Result<Arrivals, DdsError> {
        Arrivals::new(self.participant.onlooker_sockets())
    }

    /// Says goodbye for a participant that died and could not: the others forget its readers and writers at
    /// once, instead of when its lease ends, 15 s later. Until then a RELIABLE, KEEP_ALL publisher waits for
    /// the acknowledgements of a reader that is no more.
    pub fn say_goodbye_for(&self, dead: Guid) {
        if dead != Guid::default() && self.participant.dispose_participant(GUID::from_bytes(dead.0)).is_err()
        {
            tracing::warn!(?dead, "goodbye for a dead participant not sent; its lease has to end");
        }
    }

    /// Whether an endpoint is one of this participant's own.
    pub fn owns(&self, endpoint: Guid) -> bool {
        endpoint.prefix() == self.guid().prefix()
    }

    /// A reader of `topic`, a DDS topic name, and its place in the node's graph entry.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn create_reader(
        &mut self,
        topic: &str,
        dds_type: &str,
        reader_qos: &ReaderQos,
    ) -> Result<RawReader, DdsError> {
        let reader = self.make_reader(topic, dds_type, reader_qos)?;
        self.enlist(&reader);
        discard_earlier(&reader);
        Ok(reader)
    }

    /// Like [`create_reader`](Self::create_reader), for a RELIABLE reader that goes on where another one has
    /// ended, in this process or in an earlier one. Of each writer in `taken` it neither requests nor gives
    /// samples up to and including that number. It gives all that arrives from the first instant on.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn create_reader_after(
        &mut self,
        topic: &str,
        dds_type: &str,
        reader_qos: &ReaderQos,
        taken: impl IntoIterator<Item = (Guid, i64)>,
    ) -> Result<RawReader, DdsError> {
        let made_topic = make_topic(&self.participant, topic, dds_type, &qos::of_reader(reader_qos))?;
        // The library computes with the number after it.
        let number = |taken: i64| SequenceNumber::from(taken.min(i64::MAX - 1));
        let taken = taken.into_iter().map(|(writer, taken)| (GUID::from_bytes(writer.0), number(taken)));
        self.participant
            .begin_after(&made_topic, taken)
            .map_err(|error| DdsError::library(format!("a reader of {topic}"), error))?;
        let reader = self.make_reader(topic, dds_type, reader_qos)?;
        self.enlist(&reader);
        Ok(reader)
    }

    /// Like [`create_reader`](Self::create_reader), for a BEST_EFFORT reader beside a RELIABLE one of the
    /// same topic: it [ignores](RawReader::ignore_reliable_writers) RELIABLE writers from the beginning.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn create_reader_beside_reliable(
        &mut self,
        topic: &str,
        dds_type: &str,
        reader_qos: &ReaderQos,
    ) -> Result<RawReader, DdsError> {
        let reader = self.make_reader(topic, dds_type, reader_qos)?;
        reader.ignore_reliable_writers();
        self.enlist(&reader);
        discard_earlier(&reader);
        Ok(reader)
    }

    /// Adds the reader to the node's graph entry.
    fn enlist(&mut self, reader: &RawReader) {
        self.readers.push(reader.guid);
        self.announce();
    }

    /// Learns from now on which nodes the other participants have. As in ROS 2 itself, the reader for that is
    /// in no node's graph entry.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn watch_graph(&self) -> Result<GraphWatch, DdsError> {
        self.make_reader(graph::TOPIC, graph::TYPE, &GRAPH_READER_QOS).map(GraphWatch::new)
    }

    fn make_reader(
        &self,
        topic: &str,
        dds_type: &str,
        reader_qos: &ReaderQos,
    ) -> Result<RawReader, DdsError> {
        let policies = qos::of_reader(reader_qos);
        let what = || format!("a reader of {topic}");
        let made_topic = make_topic(&self.participant, topic, dds_type, &policies)?;
        let inner = self
            .subscriber
            .create_simple_datareader_no_key(&made_topic, Some(policies))
            .map_err(|error| DdsError::library(what(), error))?;
        let guid = Guid(inner.guid().to_bytes());
        Ok(RawReader { inner, guid })
    }

    /// A writer of `topic`, a DDS topic name, and its place in the node's graph entry. A RELIABLE writer
    /// retains `window_samples` for readers that have not acknowledged them; beyond that, the oldest sample
    /// goes, and a reader that lacks it misses it.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn create_writer(
        &mut self,
        topic: &str,
        dds_type: &str,
        writer_qos: &QosProfile,
        window_samples: usize,
    ) -> Result<RawWriter, DdsError> {
        self.add_writer(topic, dds_type, &qos::of_writer(writer_qos, window_samples))
    }

    /// Like [`create_writer`](Self::create_writer), but [`RawWriter::write`] of a KEEP_ALL writer waits up to
    /// `max_blocking` for room in a full window, as ROS 2 publishers do (100 ms). For publishers: the bridge
    /// itself never waits.
    ///
    /// # Errors
    /// The DDS library refused.
    pub fn create_blocking_writer(
        &mut self,
        topic: &str,
        dds_type: &str,
        writer_qos: &QosProfile,
        window_samples: usize,
        max_blocking: Duration,
    ) -> Result<RawWriter, DdsError> {
        let policies = qos::of_blocking_writer(writer_qos, window_samples, max_blocking);
        self.add_writer(topic, dds_type, &policies)
    }

    fn add_writer(
        &mut self,
        topic: &str,
        dds_type: &str,
        policies: &QosPolicies,
    ) -> Result<RawWriter, DdsError> {
        let writer = make_writer(&self.participant, &self.publisher, topic, dds_type, policies)?;
        self.writers.push(writer.guid());
        self.announce();
        Ok(writer)
    }

    /// Takes a dropped reader or writer out of the node's graph entry.
    pub fn forget(&mut self, endpoint: Guid) {
        self.readers.retain(|guid| *guid != endpoint);
        self.writers.retain(|guid| *guid != endpoint);
        self.announce();
    }

    /// The next change in what other participants have, if there is one.
    pub fn poll_discovery(&self) -> Option<Discovery> {
        loop {
            if let Some(change) = translate(self.listener.try_recv_status()?) {
                return Some(change);
            }
        }
    }

    fn announce(&self) {
        let entry = graph::encode_graph(
            self.guid(),
            &self.namespace,
            &self.node_name,
            &self.readers,
            &self.writers,
            self.graph_gid_bytes,
        );
        // A full window means that 1024 entries are unacknowledged; the next entry says all that this one
        // does.
        if let Err(error) = self.graph.write(Bytes::from(entry), graph::ENCAPSULATION, SourceTimestamp::NONE)
        {
            tracing::warn!(node = self.node_name, %error, "ROS 2 graph entry not published");
        }
    }
}

/// Discards the samples that a new reader begins with: the library keeps them by topic, beyond the life of a
/// reader, and what a former reader has taken would be taken once more.
fn discard_earlier(reader: &RawReader) {
    while reader.take(&mut |_, _| {}) != Take::Empty {}
}

fn make_topic(
    participant: &DomainParticipant,
    name: &str,
    dds_type: &str,
    policies: &QosPolicies,
) -> Result<Topic, DdsError> {
    participant
        .create_topic(name.to_owned(), dds_type.to_owned(), policies, TopicKind::NoKey)
        .map_err(|error| DdsError::library(format!("the topic {name}"), error))
}

fn make_writer(
    participant: &DomainParticipant,
    publisher: &Publisher,
    topic: &str,
    dds_type: &str,
    policies: &QosPolicies,
) -> Result<RawWriter, DdsError> {
    let made_topic = make_topic(participant, topic, dds_type, policies)?;
    let inner = publisher
        .create_datawriter_no_key(&made_topic, Some(policies.clone()))
        .map_err(|error| DdsError::library(format!("a writer of {topic}"), error))?;
    let guid = Guid(inner.guid().to_bytes());
    Ok(RawWriter { inner, guid })
}
