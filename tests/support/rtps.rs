//! Forged RTPS participants (version 2.5 of the specification): each announces itself and one RELIABLE reader
//! as a DDS library does, and sends any acknowledgement that a test makes.
//!
//! Each has one UDP socket, whose address it announces for discovery and for samples.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};

use super::netns::Host;

/// The part of a GUID that identifies the participant.
pub type Prefix = [u8; 12];
/// The part of a GUID that identifies the reader or writer.
pub type EntityId = [u8; 4];

pub const PARTICIPANT: EntityId = [0, 0, 1, 0xc1];
pub(super) const SPDP_WRITER: EntityId = [0, 1, 0, 0xc2];
pub(super) const SPDP_READER: EntityId = [0, 1, 0, 0xc7];
/// The reader and the writer of announcements of writers.
pub const SEDP_PUBLICATIONS: (EntityId, EntityId) = ([0, 0, 3, 0xc7], [0, 0, 3, 0xc2]);
/// The reader and the writer of announcements of readers.
pub const SEDP_SUBSCRIPTIONS: (EntityId, EntityId) = ([0, 0, 4, 0xc7], [0, 0, 4, 0xc2]);
/// The entity id of the forged reader: a user-defined reader of a topic without a key.
const READER: EntityId = [0, 0, 1, 0x04];
/// The entity kind (last byte of the entity id) of a user-defined writer of a topic without a key.
const WRITER_KIND: u8 = 0x03;

/// The multicast address of participant discovery in domain 0.
pub(super) const SPDP_MULTICAST: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 0, 1), 7400);
/// The announced built-in endpoints: announcers and detectors of participants, publications and
/// subscriptions.
const BUILTIN_ENDPOINTS: u32 = 0x3f;
/// The announced lease, longer than any test.
pub const LEASE_S: u32 = 600;

/// Kinds of submessages (clause 9.4.5.1.1).
mod kind {
    pub const ACKNACK: u8 = 0x06;
    pub const HEARTBEAT: u8 = 0x07;
    pub const INFO_DST: u8 = 0x0e;
    pub const NACK_FRAG: u8 = 0x12;
    pub const DATA: u8 = 0x15;
    pub const DATA_FRAG: u8 = 0x16;
}

/// Ids of discovery parameters (clause 9.6.4).
pub(super) mod pid {
    pub const SENTINEL: u16 = 0x0001;
    pub const PARTICIPANT_LEASE_DURATION: u16 = 0x0002;
    pub const TOPIC_NAME: u16 = 0x0005;
    pub const TYPE_NAME: u16 = 0x0007;
    pub const PROTOCOL_VERSION: u16 = 0x0015;
    pub const VENDOR_ID: u16 = 0x0016;
    pub const RELIABILITY: u16 = 0x001a;
    pub const DURABILITY: u16 = 0x001d;
    pub const UNICAST_LOCATOR: u16 = 0x002f;
    pub const DEFAULT_UNICAST_LOCATOR: u16 = 0x0031;
    pub const METATRAFFIC_UNICAST_LOCATOR: u16 = 0x0032;
    pub const PARTICIPANT_GUID: u16 = 0x0050;
    pub const BUILTIN_ENDPOINT_SET: u16 = 0x0058;
    pub const ENDPOINT_GUID: u16 = 0x005a;
    pub const KEY_HASH: u16 = 0x0070;
    pub const STATUS_INFO: u16 = 0x0071;
}

/// A number set of ACKNACK and NACK_FRAG (clause 9.4.2.6): `bits` numbers from `base` on, of which `words`
/// marks some. The three values need not be consistent.
#[derive(Clone, Debug)]
pub struct NumberSet {
    pub base: i64,
    pub bits: u32,
    pub words: Vec<u32>,
}

impl NumberSet {
    /// An empty set, which acknowledges every number before `base`.
    pub fn none(base: i64) -> Self {
        Self { base, bits: 0, words: Vec::new() }
    }

    /// The largest set: 256 numbers, all marked.
    pub fn all(base: i64) -> Self {
        Self { base, bits: 256, words: vec![u32::MAX; 8] }
    }
}

/// A fragment of a sample, with what it claims of the sample.
pub struct Fragment<'a> {
    /// Its number, from 1 on.
    pub number: u32,
    pub bytes: &'a [u8],
    pub sequence: i64,
    /// The size of each fragment of the sample; only the last one may be shorter.
    pub size: u16,
    pub sample_bytes: u32,
}

/// An RTPS message, sent as one datagram.
#[derive(Clone, Debug)]
#[must_use]
pub struct Message(Vec<u8>);

impl Message {
    /// An empty message from a given participant.
    pub fn of(source: Prefix) -> Self {
        let mut bytes = b"RTPS\x02\x03\x01\x0f".to_vec();
        bytes.extend(source);
        Self(bytes)
    }

    /// Adds the announcement (SPDP) of a participant that receives at `address`.
    pub fn announcement(
        self,
        participant: Prefix,
        address: SocketAddrV4,
        sequence: i64,
        lease_s: u32,
    ) -> Self {
        let participant = Parameters::default()
            .with(pid::PROTOCOL_VERSION, &[2, 3])
            .with(pid::VENDOR_ID, &[1, 0x0f])
            .with(pid::PARTICIPANT_GUID, &[participant.as_slice(), &PARTICIPANT].concat())
            .with_locator(pid::METATRAFFIC_UNICAST_LOCATOR, address)
            .with_locator(pid::DEFAULT_UNICAST_LOCATOR, address)
            .with(pid::PARTICIPANT_LEASE_DURATION, &[lease_s, 0].map(u32::to_le_bytes).concat())
            .with(pid::BUILTIN_ENDPOINT_SET, &BUILTIN_ENDPOINTS.to_le_bytes());
        self.data(SPDP_READER, SPDP_WRITER, sequence, &participant)
    }

    /// Adds the announcement (SEDP) of a RELIABLE, VOLATILE reader of a participant, which receives at
    /// `address`.
    pub fn reader(
        self,
        participant: Prefix,
        reader: EntityId,
        topic: &str,
        type_name: &str,
        address: SocketAddrV4,
        sequence: i64,
    ) -> Self {
        let guid = |entity: EntityId| [participant.as_slice(), &entity].concat();
        let reliable_100_ms = [2, 0, 429_496_730].map(u32::to_le_bytes).concat();
        let reader = Parameters::default()
            .with(pid::ENDPOINT_GUID, &guid(reader))
            .with(pid::PARTICIPANT_GUID, &guid(PARTICIPANT))
            .with_text(pid::TOPIC_NAME, topic)
            .with_text(pid::TYPE_NAME, type_name)
            .with(pid::RELIABILITY, &reliable_100_ms)
            .with(pid::DURABILITY, &[0; 4])
            .with_locator(pid::UNICAST_LOCATOR, address);
        let (to, from) = SEDP_SUBSCRIPTIONS;
        self.data(to, from, sequence, &reader)
    }

    /// Adds INFO_DST: the following submessages are for a given participant.
    pub fn to(self, destination: Prefix) -> Self {
        self.submessage(kind::INFO_DST, 0x01, &destination)
    }

    /// Adds ACKNACK: the reader acknowledges all samples before the base and requests the marked ones.
    pub fn ack_nack(self, reader: EntityId, writer: EntityId, set: &NumberSet, count: i32) -> Self {
        let mut body = [reader, writer].concat();
        body.extend(number(set.base));
        body.extend(set.bits.to_le_bytes());
        body.extend(set.words.iter().flat_map(|word| word.to_le_bytes()));
        body.extend(count.to_le_bytes());
        self.submessage(kind::ACKNACK, 0x01, &body)
    }

    /// Adds NACK_FRAG: the reader requests the marked fragments of a sample.
    pub fn nack_frag(
        self,
        reader: EntityId,
        writer: EntityId,
        sample: i64,
        set: &NumberSet,
        count: i32,
    ) -> Self {
        let mut body = [reader, writer].concat();
        body.extend(number(sample));
        body.extend((set.base as u32).to_le_bytes());
        body.extend(set.bits.to_le_bytes());
        body.extend(set.words.iter().flat_map(|word| word.to_le_bytes()));
        body.extend(count.to_le_bytes());
        self.submessage(kind::NACK_FRAG, 0x01, &body)
    }

    /// Adds DATA with a parameter list in little endian.
    pub(super) fn data(
        self,
        reader: EntityId,
        writer: EntityId,
        sequence: i64,
        parameters: &Parameters,
    ) -> Self {
        let payload = [&[0x00, 0x03, 0, 0], parameters.ended().as_slice()].concat();
        self.sample(reader, writer, sequence, &payload)
    }

    /// Adds DATA with a payload, which begins with its encapsulation header.
    pub(super) fn sample(self, reader: EntityId, writer: EntityId, sequence: i64, payload: &[u8]) -> Self {
        let body = [&data_header(reader, writer, sequence), payload].concat();
        self.submessage(kind::DATA, 0x05, &body)
    }

    /// Adds DATA_FRAG: a fragment of a sample.
    pub fn fragment(self, reader: EntityId, writer: EntityId, fragment: &Fragment<'_>) -> Self {
        // Fields of this length follow before the inline QoS (RTPS 2.5, clause 9.4.5.5).
        let mut body = [0_u16, 28].map(u16::to_le_bytes).concat();
        body.extend([reader, writer].concat());
        body.extend(number(fragment.sequence));
        body.extend(fragment.number.to_le_bytes());
        body.extend([1, fragment.size].map(u16::to_le_bytes).concat());
        body.extend(fragment.sample_bytes.to_le_bytes());
        body.extend(fragment.bytes);
        self.submessage(kind::DATA_FRAG, 0x01, &body)
    }

    /// Adds DATA that disposes and unregisters an instance, whose key is a GUID.
    pub(super) fn dispose(self, reader: EntityId, writer: EntityId, sequence: i64, key: &[u8]) -> Self {
        let inline_qos =
            Parameters::default().with(pid::KEY_HASH, key).with(pid::STATUS_INFO, &[0, 0, 0, 3]).ended();
        let body = [data_header(reader, writer, sequence), inline_qos].concat();
        self.submessage(kind::DATA, 0x03, &body)
    }

    /// Adds HEARTBEAT.
    pub(super) fn heartbeat(
        self,
        reader: EntityId,
        writer: EntityId,
        first: i64,
        last: i64,
        count: i32,
    ) -> Self {
        let mut body = [reader, writer].concat();
        body.extend(number(first));
        body.extend(number(last));
        body.extend(count.to_le_bytes());
        self.submessage(kind::HEARTBEAT, 0x01, &body)
    }

    /// Sends it; one that cannot be sent is lost, as datagrams can be.
    pub fn send(&self, socket: &UdpSocket, to: SocketAddrV4) {
        let _ = socket.send_to(&self.0, to);
    }

    fn submessage(mut self, kind: u8, flags: u8, body: &[u8]) -> Self {
        self.0.extend([kind, flags]);
        self.0.extend((body.len() as u16).to_le_bytes());
        self.0.extend(body);
        self
    }
}

/// The beginning of DATA: no extra flags, and 16 bytes from here to the inline QoS or the payload.
fn data_header(reader: EntityId, writer: EntityId, sequence: i64) -> Vec<u8> {
    [&[0, 0, 16, 0], reader.as_slice(), &writer, &number(sequence)].concat()
}

/// Encodes a sequence number: the high half first, each half in little endian.
fn number(value: i64) -> [u8; 8] {
    let [high, low] = [(value >> 32) as u32, value as u32].map(u32::to_le_bytes);
    [high, low].concat().try_into().unwrap()
}

/// A list of discovery parameters.
#[derive(Default)]
pub(super) struct Parameters(Vec<u8>);

impl Parameters {
    /// The list with its end.
    fn ended(&self) -> Vec<u8> {
        [&self.0, pid::SENTINEL.to_le_bytes().as_slice(), &[0, 0]].concat()
    }

    pub(super) fn with(mut self, id: u16, value: &[u8]) -> Self {
        let padded = value.len().next_multiple_of(4);
        self.0.extend(id.to_le_bytes());
        self.0.extend((padded as u16).to_le_bytes());
        self.0.extend(value);
        self.0.resize(self.0.len() + padded - value.len(), 0);
        self
    }

    pub(super) fn with_text(self, id: u16, text: &str) -> Self {
        let mut value = (text.len() as u32 + 1).to_le_bytes().to_vec();
        value.extend(text.as_bytes());
        value.push(0);
        self.with(id, &value)
    }

    pub(super) fn with_locator(self, id: u16, address: SocketAddrV4) -> Self {
        let mut value = 1_u32.to_le_bytes().to_vec();
        value.extend(u32::from(address.port()).to_le_bytes());
        value.extend([0; 12]);
        value.extend(address.ip().octets());
        self.with(id, &value)
    }
}

/// The addresses of a participant that has announced itself.
#[derive(Clone, Copy, Debug)]
pub struct Announced {
    /// The address for endpoint discovery.
    pub discovery: SocketAddrV4,
    /// The address of its readers and writers.
    pub traffic: SocketAddrV4,
}

/// A writer that has sent a sample or a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Writer {
    pub participant: Prefix,
    pub entity: EntityId,
    /// The first sequence number that it sent or announced.
    pub first: i64,
    /// The last sequence number that it sent or announced.
    pub last: i64,
}

/// A forged participant with one RELIABLE, VOLATILE reader.
pub struct ForgedReader {
    prefix: Prefix,
    socket: UdpSocket,
    address: SocketAddrV4,
    announced: BTreeMap<Prefix, Announced>,
    writer: Option<Writer>,
}

impl ForgedReader {
    /// Creates a forged reader on a host; `identity` distinguishes it from others.
    pub fn new(host: &Host, identity: u8) -> Self {
        let socket = host.udp_socket();
        socket.set_nonblocking(true).unwrap();
        let address = SocketAddrV4::new(host.address(), socket.local_addr().unwrap().port());
        // The first two bytes are those of Fast DDS.
        let prefix = [1, 0x0f, b'f', b'o', b'r', b'g', b'e', b'd', 0, 0, 0, identity];
        Self { prefix, socket, address, announced: BTreeMap::new(), writer: None }
    }

    /// Its GUID as text, formatted as by the bridge.
    pub fn guid(&self) -> String {
        let hexadecimal =
            |bytes: &[u8]| -> String { bytes.iter().map(|byte| format!("{byte:02x}")).collect() };
        format!("{}:{}", hexadecimal(&self.prefix), hexadecimal(&READER))
    }

    pub fn prefix(&self) -> Prefix {
        self.prefix
    }

    /// The address of its socket.
    pub(super) fn address(&self) -> SocketAddrV4 {
        self.address
    }

    /// The participants that have announced themselves to it.
    pub(super) fn announced(&self) -> &BTreeMap<Prefix, Announced> {
        &self.announced
    }

    pub fn entity(&self) -> EntityId {
        READER
    }

    /// Announces the participant by multicast (SPDP), and its reader of a topic to all participants that have
    /// announced themselves (SEDP).
    pub fn announce_endpoint(&self, topic: &str, type_name: &str) {
        let announcement = Message::of(self.prefix).announcement(self.prefix, self.address, 1, LEASE_S);
        self.send(&announcement, SPDP_MULTICAST);

        let (to, from) = SEDP_SUBSCRIPTIONS;
        for (prefix, announced) in &self.announced {
            let endpoint = Message::of(self.prefix)
                .to(*prefix)
                .reader(self.prefix, READER, topic, type_name, self.address, 1)
                .heartbeat(to, from, 1, 1, 1);
            self.send(&endpoint, announced.discovery);
        }
    }

    /// Handles the datagrams that have arrived.
    pub fn receive(&mut self) {
        let mut buffer = [0; 1 << 16];
        while let Ok(length) = self.socket.recv(&mut buffer) {
            self.handle(&buffer[..length]);
        }
    }

    /// The writer of the topic and its address; `None` until the writer has sent something.
    pub fn writer(&self) -> Option<(Writer, SocketAddrV4)> {
        let writer = self.writer?;
        Some((writer, self.announced.get(&writer.participant)?.traffic))
    }

    /// Sends a datagram; one that cannot be sent is lost, as datagrams can be.
    pub fn send(&self, message: &Message, to: SocketAddrV4) {
        message.send(&self.socket, to);
    }

    fn handle(&mut self, datagram: &[u8]) -> Option<()> {
        let source: Prefix = datagram.get(8..20)?.try_into().ok()?;
        let mut rest = &datagram[20..];
        while let [kind, flags, low, high, following @ ..] = rest {
            let length = usize::from(u16::from_le_bytes([*low, *high]));
            let length = if length == 0 { following.len() } else { length };
            let body = following.get(..length)?;
            rest = &following[length..];
            match *kind {
                kind::DATA if body.get(8..12)? == SPDP_WRITER => {
                    if let Some(announced) = announcement(*flags, body) {
                        self.announced.insert(source, announced);
                    }
                }
                kind::DATA | kind::DATA_FRAG if *body.get(11)? == WRITER_KIND => {
                    self.note_writer(source, body.get(8..12)?, body.get(12..20)?)?;
                }
                kind::HEARTBEAT if *body.get(7)? == WRITER_KIND => {
                    self.note_writer(source, body.get(4..8)?, body.get(16..24)?)?;
                }
                _ => {}
            }
        }
        Some(())
    }

    /// Records a sequence number that a writer sent or announced.
    fn note_writer(&mut self, participant: Prefix, entity: &[u8], number: &[u8]) -> Option<()> {
        let half = |at: usize| Some(u32::from_le_bytes(number.get(at..at + 4)?.try_into().ok()?));
        let number = i64::from(half(0)?) << 32 | i64::from(half(4)?);
        let first = self.writer.map_or(number, |writer| writer.first);
        let last = self.writer.map_or(number, |writer| writer.last.max(number));
        self.writer = Some(Writer { participant, entity: entity.try_into().ok()?, first, last });
        Some(())
    }
}

/// Parses the addresses in the announcement of a participant that uses IPv4 and little endian, as the bridge
/// does.
fn announcement(flags: u8, data: &[u8]) -> Option<Announced> {
    let mut rest = data.get(20..)?;
    if flags & 0x02 != 0 {
        rest = parameters(rest, |_, _| ())?;
    }
    let (mut discovery, mut traffic) = (None, None);
    parameters(rest.get(4..)?, |id, value| {
        let place = match id {
            pid::METATRAFFIC_UNICAST_LOCATOR => &mut discovery,
            pid::DEFAULT_UNICAST_LOCATOR => &mut traffic,
            _ => return,
        };
        if let Some(address) = address(value).filter(|address| !address.ip().is_loopback()) {
            place.get_or_insert(address);
        }
    })?;
    Some(Announced { discovery: discovery?, traffic: traffic? })
}

/// Calls `each` for every parameter of a list; returns the bytes after the list.
fn parameters(mut list: &[u8], mut each: impl FnMut(u16, &[u8])) -> Option<&[u8]> {
    loop {
        let [id_low, id_high, low, high, following @ ..] = list else { return None };
        let id = u16::from_le_bytes([*id_low, *id_high]);
        let length = usize::from(u16::from_le_bytes([*low, *high]));
        if id == pid::SENTINEL {
            return Some(following);
        }
        each(id, following.get(..length)?);
        list = &following[length..];
    }
}

fn address(locator: &[u8]) -> Option<SocketAddrV4> {
    let port = u32::from_le_bytes(locator.get(4..8)?.try_into().ok()?);
    let ip: [u8; 4] = locator.get(20..24)?.try_into().ok()?;
    (locator.get(..4)? == 1_u32.to_le_bytes()).then(|| SocketAddrV4::new(ip.into(), port as u16))
}
