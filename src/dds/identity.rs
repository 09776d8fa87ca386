//! What a participant and its writers take over from those of a killed process.

use std::net::UdpSocket;

use bytes::Bytes;

use super::rustdds::{self, ContinuedSample, ContinuedWriter, DomainParticipantBuilder, GUID};
use super::writer::{encoding, timestamp};
use crate::model::{Encapsulation, Guid, SourceTimestamp};

/// The identity of a participant. A participant that takes it over is the same one to others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParticipantIdentity {
    /// Its GUID.
    pub participant: Guid,
    /// Its participant id, which gives its ports (RTPS 2.5, clause 9.6.2.3).
    pub participant_id: u16,
    /// The UDP port of its urgent topics; 0 without them.
    pub urgent_port: u16,
    /// The highest count of any HEARTBEAT, ACKNACK or NACK_FRAG.
    pub highest_count: i32,
    /// The highest sequence number of any writer of the participant's own: of discovery and of the graph.
    pub highest_number: i64,
}

impl ParticipantIdentity {
    pub(super) fn from_rustdds(
        identity: rustdds::ParticipantIdentity,
        graph_number: i64,
        guid: Guid,
    ) -> Self {
        Self {
            participant: guid,
            participant_id: identity.participant_id,
            urgent_port: identity.urgent_port,
            highest_count: identity.highest_count,
            highest_number: identity.highest_number.max(graph_number),
        }
    }

    pub(super) fn to_rustdds(self) -> rustdds::ParticipantIdentity {
        rustdds::ParticipantIdentity {
            prefix: self.participant.prefix(),
            participant_id: self.participant_id,
            urgent_port: self.urgent_port,
            highest_count: self.highest_count,
            highest_number: self.highest_number,
        }
    }
}

/// What a participant takes over from one of a killed process, and leaves to a later one.
#[derive(Default)]
pub struct Kept {
    /// The identity, and the [discovery journal](super::Participant::discovery_journal), which is read as
    /// what comes from the network. `None` for a participant that is another one to others.
    pub former: Option<(ParticipantIdentity, Vec<u8>)>,
    /// The sockets of the former participant, with what has arrived meanwhile. Another participant uses them
    /// as well: on a port that is new to it, Fast DDS 2.9.0 with assertions aborts when it matches a reader.
    pub sockets: Vec<UdpSocket>,
}

impl Kept {
    pub(super) fn graph_number(&self) -> i64 {
        self.former.as_ref().map_or(0, |(identity, _)| identity.highest_number)
    }

    pub(super) fn extend(self, builder: DomainParticipantBuilder) -> DomainParticipantBuilder {
        let builder = builder.with_sockets(self.sockets);
        match self.former {
            Some((identity, journal)) => {
                builder.continuing(identity.to_rustdds()).with_discovery_journal(journal)
            }
            None => builder,
        }
    }
}

/// How a writer continues one of a killed process.
pub struct WriterContinuation {
    /// A part of the entity id, which no other writer of the participant has; it begins with a byte from 0x80
    /// to 0xfe.
    pub key: [u8; 3],
    /// The first sample gets the number after this one, which the former writer must have sent last: readers
    /// discard lower ones without a word. 0 for a new writer.
    pub highest_number: i64,
    /// The last samples of the former writer, in the order of their numbers; a number between them was that
    /// of a sample that was withdrawn. The former readers that lack them get them.
    pub samples: Vec<FormerSample>,
    /// Of the numbers of the former writer, those after this one are sent again.
    pub sent_through: i64,
    /// The readers of the former writer.
    pub readers: Vec<Guid>,
    /// Called with each number before anything with it is sent, by any thread, and with whether it is that of
    /// a sample that is written: one that is begun early may be withdrawn. Must return at once.
    pub on_number: Box<dyn Fn(i64, bool) + Send + Sync>,
}

/// A sample that a killed process has written.
pub struct FormerSample {
    /// Its RTPS sequence number.
    pub number: i64,
    /// Its payload.
    pub payload: Bytes,
    /// The encapsulation of the payload.
    pub encapsulation: Encapsulation,
    /// Its source timestamp.
    pub timestamp: SourceTimestamp,
    /// The publisher that sent it, in whose history a writer that is TRANSIENT_LOCAL keeps it.
    pub publisher: Guid,
}

impl FormerSample {
    fn into_rustdds(self) -> ContinuedSample {
        ContinuedSample {
            number: self.number,
            payload: self.payload,
            encoding: encoding(self.encapsulation),
            encoding_options: self.encapsulation.options(),
            source_timestamp: timestamp(self.timestamp),
            history_source: Some(GUID::from_bytes(self.publisher.0)),
        }
    }
}

impl WriterContinuation {
    pub(super) fn into_rustdds(self) -> ContinuedWriter {
        ContinuedWriter {
            entity_key: self.key,
            highest_number: self.highest_number,
            samples: self.samples.into_iter().map(FormerSample::into_rustdds).collect(),
            sent_through: self.sent_through,
            readers: self.readers.iter().map(|reader| GUID::from_bytes(reader.0)).collect(),
            on_number: self.on_number,
        }
    }
}
