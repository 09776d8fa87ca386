//! A forged participant that announces endpoints and writes samples, each at any rate, to one
//! participant of the bridge.

use std::net::SocketAddrV4;
use std::sync::atomic::{AtomicI64, Ordering};

use super::netns::{Host, udp_ports_of};
use super::rtps::{
    Announced, EntityId, ForgedReader, Fragment, Message, Prefix, SEDP_PUBLICATIONS, SEDP_SUBSCRIPTIONS,
};
use super::visitors::{Endpoint, describe};
use super::wait_for;

/// A forged participant. What it sends is for the participant of one process.
///
/// Announcements and complete samples end with a heartbeat that says that earlier samples of the writer are
/// no longer available, so that a lost datagram delays none of the following ones.
pub struct Forger {
    socket: ForgedReader,
    prefix: Prefix,
    to: Prefix,
    announced: Announced,
    /// The last sequence number of its announcements of readers and of writers.
    sequence: AtomicI64,
}

impl Forger {
    /// Creates it on a host, and waits until the participant of the process, which runs on the host `bridge`,
    /// has announced itself to it; `identity` distinguishes it from others.
    pub fn new(host: &Host, identity: u8, (bridge, process): (&Host, i32)) -> Self {
        let mut socket = ForgedReader::new(host, identity);
        let ports = udp_ports_of(process);
        let (to, announced) = wait_for(format!("the announcement of process {process}"), || {
            socket.announce_endpoint("rt/unused", "std_msgs::msg::dds_::String_");
            socket.receive();
            let mut participants = socket.announced().iter();
            // Participants on other hosts have the same ports.
            let is_of_process = |(_, one): &(&Prefix, &Announced)| {
                *one.traffic.ip() == bridge.address() && ports.contains(&one.traffic.port())
            };
            participants.find(is_of_process).map(|(prefix, announced)| (*prefix, *announced))
        });
        // The socket has announced a reader with number 1.
        Self { prefix: socket.prefix(), socket, to, announced, sequence: AtomicI64::new(1) }
    }

    /// The part of its GUIDs that identifies the participant.
    pub fn prefix(&self) -> Prefix {
        self.prefix
    }

    /// Announces endpoints like this one, which have these entity ids.
    pub fn announce(&self, endpoint: &Endpoint, entities: &[EntityId]) {
        let (reader, writer) = if endpoint.is_writer { SEDP_PUBLICATIONS } else { SEDP_SUBSCRIPTIONS };
        let first = self.sequence.fetch_add(entities.len() as i64, Ordering::Relaxed) + 1;
        let mut message = Message::of(self.prefix).to(self.to);
        for (sequence, entity) in (first..).zip(entities) {
            let described = describe(self.prefix, *entity, endpoint, self.socket.address());
            message = message.data(reader, writer, sequence, &described);
        }
        let last = first + entities.len() as i64 - 1;
        let message = message.heartbeat(reader, writer, first, last, last as i32);
        self.socket.send(&message, self.announced.discovery);
    }

    /// Sends a sample so many times in one datagram, with numbers from `first` on. The payload begins with
    /// its encapsulation header.
    pub fn write(&self, writer: EntityId, first: i64, payload: &[u8], count: usize) {
        let last = first + count as i64 - 1;
        let samples = (first..=last).fold(Message::of(self.prefix).to(self.to), |message, sequence| {
            message.sample([0; 4], writer, sequence, payload)
        });
        let message = samples.heartbeat([0; 4], writer, first, last, last as i32);
        self.socket.send(&message, self.traffic());
    }

    /// Sends a sample in fragments. The payload begins with its encapsulation header.
    pub fn write_large(&self, writer: EntityId, sequence: i64, payload: &[u8]) {
        let (size, sample_bytes) = (60_000_u16, payload.len() as u32);
        for (number, bytes) in (1..).zip(payload.chunks(size.into())) {
            let fragment = Fragment { number, bytes, sequence, size, sample_bytes };
            let message = Message::of(self.prefix).to(self.to).fragment([0; 4], writer, &fragment);
            self.socket.send(&message, self.traffic());
        }
        let end = Message::of(self.prefix).to(self.to);
        let end = end.heartbeat([0; 4], writer, sequence, sequence, sequence as i32);
        self.socket.send(&end, self.traffic());
    }

    /// Sends only the first fragment of a sample that has `sample_bytes` bytes, at least 60,000.
    pub fn write_unfinished(&self, writer: EntityId, sequence: i64, sample_bytes: u32) {
        let fragment = Fragment { number: 1, bytes: &[0; 60_000], sequence, size: 60_000, sample_bytes };
        let message = Message::of(self.prefix).to(self.to).fragment([0; 4], writer, &fragment);
        self.socket.send(&message, self.traffic());
    }

    fn traffic(&self) -> SocketAddrV4 {
        self.announced.traffic
    }
}
