//! What a participant and its writers take over from those of a killed process.

use super::rustdds::{self, ContinuedWriter};
use crate::model::Guid;

/// The identity of a participant. A participant that takes it over is the same one to others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParticipantIdentity {
    /// Its GUID.
    pub participant: Guid,
    /// Its participant id, which gives its ports (RTPS 2.5, clause 9.6.2.3).
    pub participant_id: u16,
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
            highest_count: identity.highest_count,
            highest_number: identity.highest_number.max(graph_number),
        }
    }

    pub(super) fn to_rustdds(self) -> rustdds::ParticipantIdentity {
        rustdds::ParticipantIdentity {
            prefix: self.participant.prefix(),
            participant_id: self.participant_id,
            highest_count: self.highest_count,
            highest_number: self.highest_number,
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
    /// Called with each number before anything with it is sent, by any thread; must return at once.
    pub on_number: Box<dyn Fn(i64) + Send + Sync>,
}

impl WriterContinuation {
    pub(super) fn into_rustdds(self) -> ContinuedWriter {
        ContinuedWriter {
            entity_key: self.key,
            highest_number: self.highest_number,
            on_number: self.on_number,
        }
    }
}
