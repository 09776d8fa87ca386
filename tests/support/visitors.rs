//! Forged ROS 2 participants in large numbers, each with the endpoints of a small node: they join, send a few
//! samples, and leave with or without announcing it.

use std::net::SocketAddrV4;

use adaptive_bridge::dds::encode_graph;
use adaptive_bridge::model::Guid;

use super::netns::Host;
use super::rtps::{
    EntityId, ForgedReader, LEASE_S, Message, PARTICIPANT, Parameters, Prefix, SEDP_PUBLICATIONS,
    SEDP_SUBSCRIPTIONS, SPDP_MULTICAST, SPDP_READER, SPDP_WRITER, pid,
};
use super::wait_until;

/// The lease that a visitor announces before it is killed, so that it expires soon.
const LAST_LEASE_S: u32 = 1;
/// The value of a QoS policy RELIABILITY with a blocking time of 100 ms; the first word is its kind.
const BEST_EFFORT: [u32; 3] = [1, 0, 429_496_730];
const RELIABLE: [u32; 3] = [2, 0, 429_496_730];
/// The encapsulation header of plain little-endian CDR.
const CDR_LE: [u8; 4] = [0, 1, 0, 0];

/// A reader or writer that each visitor has.
#[derive(Clone, Debug)]
pub struct Endpoint {
    pub topic: &'static str,
    pub type_name: &'static str,
    pub is_writer: bool,
    pub is_reliable: bool,
    pub is_transient_local: bool,
    /// The samples that each visitor writes, without encapsulation header.
    pub samples: Vec<Vec<u8>>,
}

impl Endpoint {
    /// A RELIABLE, VOLATILE reader.
    pub fn reader(topic: &'static str, type_name: &'static str) -> Self {
        Self {
            topic,
            type_name,
            is_writer: false,
            is_reliable: true,
            is_transient_local: false,
            samples: Vec::new(),
        }
    }

    /// A RELIABLE, VOLATILE writer.
    pub fn writer(topic: &'static str, type_name: &'static str) -> Self {
        Self { is_writer: true, ..Self::reader(topic, type_name) }
    }

    pub fn best_effort(self) -> Self {
        Self { is_reliable: false, ..self }
    }

    pub fn transient_local(self) -> Self {
        Self { is_transient_local: true, ..self }
    }

    pub fn samples(self, samples: Vec<Vec<u8>>) -> Self {
        Self { samples, ..self }
    }

    /// The entity id of the visitors' endpoint of this number; endpoints of topics without a key.
    fn entity(&self, number: usize) -> EntityId {
        [0, 0, 0x10 + number as u8, if self.is_writer { 0x03 } else { 0x04 }]
    }
}

/// How a visitor leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leave {
    /// It disposes its endpoints and itself, as a program that ends normally.
    Close,
    /// It disposes only itself.
    CloseParticipant,
    /// It disposes itself and then its endpoints.
    CloseParticipantFirst,
    /// It sends nothing more, as a program that is killed, after it has shortened its lease.
    Kill,
}

/// The visitors of a host, of which some are present.
pub struct Visitors {
    /// Owns the socket of all visitors, and the addresses of the participants to announce them to.
    resident: ForgedReader,
    endpoints: Vec<Endpoint>,
    present: Vec<Prefix>,
    /// The number of visitors that have joined so far.
    joined: u64,
}

impl Visitors {
    /// Creates visitors that have these endpoints, on a host, and waits until so many participants have
    /// announced themselves to it.
    pub fn new(host: &Host, endpoints: Vec<Endpoint>, participants: usize) -> Self {
        let mut resident = ForgedReader::new(host, 0xff);
        wait_until("the announcements of the participants", || {
            resident.announce_endpoint("rt/unused", "std_msgs::msg::dds_::String_");
            resident.receive();
            resident.announced().len() == participants
        });
        Self { resident, endpoints, present: Vec::new(), joined: 0 }
    }

    /// The addresses of the participants, for discovery.
    fn participants(&self) -> Vec<(Prefix, SocketAddrV4)> {
        self.resident.announced().iter().map(|(prefix, announced)| (*prefix, announced.discovery)).collect()
    }

    /// Adds visitors to those that are present. The caller announces them until the bridge has matched them.
    pub fn join(&mut self, count: usize) {
        for _ in 0..count {
            self.joined += 1;
            let mut prefix = [1, 0x0f, b'v', b'i', 0, 0, 0, 0, 0, 0, 0, 0];
            prefix[4..].copy_from_slice(&self.joined.to_be_bytes());
            self.present.push(prefix);
        }
    }

    /// Announces those that are present and their endpoints, always with the same sequence numbers.
    pub fn announce(&mut self) {
        self.resident.receive();
        let address = self.resident.address();
        let participants = self.participants();
        for prefix in &self.present {
            self.announce_participant(*prefix, 1, LEASE_S, SPDP_MULTICAST);
            for (participant, discovery) in &participants {
                for writers in [true, false] {
                    let (reader, writer) = if writers { SEDP_PUBLICATIONS } else { SEDP_SUBSCRIPTIONS };
                    let mut message = Message::of(*prefix).to(*participant);
                    let mut sequence = 0;
                    for (number, endpoint) in self.endpoints.iter().enumerate() {
                        if endpoint.is_writer == writers {
                            sequence += 1;
                            let described = describe(*prefix, endpoint.entity(number), endpoint, address);
                            message = message.data(reader, writer, sequence, &described);
                        }
                    }
                    self.resident.send(&message.heartbeat(reader, writer, 1, sequence, 1), *discovery);
                }
            }
        }
    }

    fn announce_participant(&self, prefix: Prefix, sequence: i64, lease_s: u32, to: SocketAddrV4) {
        let address = self.resident.address();
        let announcement = Message::of(prefix).announcement(prefix, address, sequence, lease_s);
        self.resident.send(&announcement, to);
    }

    /// Sends the samples of those that are present, with the graph entry of each on `ros_discovery_info`.
    pub fn write(&mut self) {
        let traffic: Vec<(Prefix, SocketAddrV4)> = self
            .resident
            .announced()
            .iter()
            .map(|(prefix, announced)| (*prefix, announced.traffic))
            .collect();
        for prefix in &self.present {
            for (number, endpoint) in self.endpoints.iter().enumerate().filter(|(_, one)| one.is_writer) {
                let (reader, writer) = ([0; 4], endpoint.entity(number));
                let mut samples = endpoint.samples.clone();
                if endpoint.topic == "ros_discovery_info" {
                    samples.push(self.graph_entry(*prefix));
                }
                for (participant, address) in &traffic {
                    let mut message = Message::of(*prefix).to(*participant);
                    let mut sequence = 0;
                    for sample in &samples {
                        sequence += 1;
                        let payload = [CDR_LE.as_slice(), sample].concat();
                        message = message.sample(reader, writer, sequence, &payload);
                    }
                    self.resident.send(&message.heartbeat(reader, writer, 1, sequence, 1), *address);
                }
            }
        }
    }

    fn graph_entry(&self, prefix: Prefix) -> Vec<u8> {
        let guids = |writers: bool| -> Vec<Guid> {
            let endpoints = self.endpoints.iter().enumerate();
            endpoints
                .filter(|(_, endpoint)| endpoint.is_writer == writers)
                .map(|(number, endpoint)| Guid(guid(prefix, endpoint.entity(number))))
                .collect()
        };
        encode_graph(Guid(guid(prefix, PARTICIPANT)), "/", "visitor", &guids(false), &guids(true), 16)
    }

    /// Removes all visitors from those that are present.
    pub fn clear(&mut self) {
        self.present.clear();
    }

    /// Lets all visitors leave that are present, one after the other in the given ways. Its datagrams can be
    /// lost, so the caller repeats it while visitors are still matched; each call renews the last lease of
    /// killed ones.
    pub fn leave(&mut self, ways: &[Leave]) {
        self.resident.receive();
        let participants = self.participants();
        for (&prefix, way) in self.present.iter().zip(ways.iter().cycle()) {
            for (participant, discovery) in &participants {
                if *way == Leave::Kill {
                    self.announce_participant(prefix, 2, LAST_LEASE_S, *discovery);
                    continue;
                }
                let goodbye = Message::of(prefix).to(*participant);
                let goodbye = goodbye.dispose(SPDP_READER, SPDP_WRITER, 2, &guid(prefix, PARTICIPANT));
                if *way == Leave::Close {
                    self.dispose_endpoints(prefix, *participant, *discovery);
                }
                self.resident.send(&goodbye, *discovery);
                if *way == Leave::CloseParticipantFirst {
                    self.dispose_endpoints(prefix, *participant, *discovery);
                }
            }
        }
    }

    fn dispose_endpoints(&self, prefix: Prefix, participant: Prefix, discovery: SocketAddrV4) {
        for writers in [true, false] {
            let (reader, writer) = if writers { SEDP_PUBLICATIONS } else { SEDP_SUBSCRIPTIONS };
            let endpoints = self.endpoints.iter().enumerate();
            let ours: Vec<_> = endpoints.filter(|(_, one)| one.is_writer == writers).collect();
            let mut sequence = ours.len() as i64;
            let mut message = Message::of(prefix).to(participant);
            for (number, endpoint) in ours {
                sequence += 1;
                let key = guid(prefix, endpoint.entity(number));
                message = message.dispose(reader, writer, sequence, &key);
            }
            self.resident.send(&message.heartbeat(reader, writer, 1, sequence, 2), discovery);
        }
    }
}

fn guid(prefix: Prefix, entity: EntityId) -> [u8; 16] {
    let mut guid = [0; 16];
    guid[..12].copy_from_slice(&prefix);
    guid[12..].copy_from_slice(&entity);
    guid
}

/// The announcement of an endpoint.
pub(super) fn describe(
    prefix: Prefix,
    entity: EntityId,
    endpoint: &Endpoint,
    address: SocketAddrV4,
) -> Parameters {
    let reliability = if endpoint.is_reliable { RELIABLE } else { BEST_EFFORT };
    Parameters::default()
        .with(pid::ENDPOINT_GUID, &guid(prefix, entity))
        .with(pid::PARTICIPANT_GUID, &guid(prefix, PARTICIPANT))
        .with_text(pid::TOPIC_NAME, endpoint.topic)
        .with_text(pid::TYPE_NAME, endpoint.type_name)
        .with(pid::RELIABILITY, &reliability.map(u32::to_le_bytes).concat())
        .with(pid::DURABILITY, &u32::from(endpoint.is_transient_local).to_le_bytes())
        .with_locator(pid::UNICAST_LOCATOR, address)
}
