//! Changes of remote readers, writers and participants, as discovery reports them.

use super::qos::{durability_of, reliability_of};
use super::rustdds::{DomainParticipantStatusEvent, EndpointDescription, LostReason};
use crate::model::{Durability, Guid, Reliability, TypeHash};
use crate::policy::Location;

/// The most announced addresses of an endpoint that are kept. A host has fewer.
const MAX_ADDRESSES: usize = 64;

/// The most changes that wait for [`Participant::poll_discovery`](super::Participant::poll_discovery): those
/// beyond are lost.
pub(super) const MAX_WAITING_CHANGES: usize = 2_048;

/// The changes of discovery that the caller still takes before it does its other work: as many as can wait. A
/// peer that announces and withdraws endpoints as fast as it can keeps no caller in a loop.
#[derive(Debug)]
pub struct DiscoveryTurn {
    left: usize,
}

impl DiscoveryTurn {
    /// Whether the turn takes another change, also one that the bridge does not look at, which then counts.
    pub(super) const fn takes_another(&mut self) -> bool {
        let takes_another = self.left > 0;
        self.left = self.left.saturating_sub(1);
        takes_another
    }
}

impl Default for DiscoveryTurn {
    fn default() -> Self {
        Self { left: MAX_WAITING_CHANGES }
    }
}

/// A remote reader or writer that was discovered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Its GUID.
    pub guid: Guid,
    /// DDS topic, such as `rt/scan`.
    pub topic: String,
    /// DDS type, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub dds_type: String,
    /// The hash of the type's definition, if it announces one.
    pub type_hash: TypeHash,
    /// The RELIABILITY that it offers or requests.
    pub reliability: Reliability,
    /// The DURABILITY that it offers or requests.
    pub durability: Durability,
    /// The addresses from which its host is determined.
    pub location: Location,
}

/// A change of a remote reader, writer or participant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Discovery {
    /// A writer was discovered, or has changed.
    Writer(Endpoint),
    /// A writer was deleted.
    WriterGone(Guid),
    /// A reader was discovered, or has changed.
    Reader(Endpoint),
    /// A reader was deleted.
    ReaderGone(Guid),
    /// A participant has left or its lease has expired. Its readers and writers are gone with it; no separate
    /// change reports them.
    ParticipantGone {
        /// The GUID prefix of the participant and of its endpoints.
        prefix: [u8; 12],
        /// The time for which nothing was received from it, if its lease has expired; `None` if it announced
        /// that it leaves.
        silent_ms: Option<u64>,
    },
}

/// Converts an event of RustDDS; `None` for one that the bridge does not use.
pub(super) fn translate(event: DomainParticipantStatusEvent) -> Option<Discovery> {
    use DomainParticipantStatusEvent as Event;
    match event {
        // DDS 1.4, table in clause 2.2.3: the default RELIABILITY is RELIABLE for writers and BEST_EFFORT for
        // readers.
        Event::WriterDetected { writer } => Some(Discovery::Writer(endpoint(writer, Reliability::Reliable))),
        Event::ReaderDetected { reader } => {
            Some(Discovery::Reader(endpoint(reader, Reliability::BestEffort)))
        }
        Event::WriterLost { guid, .. } => Some(Discovery::WriterGone(Guid(guid.to_bytes()))),
        Event::ReaderLost { guid, .. } => Some(Discovery::ReaderGone(Guid(guid.to_bytes()))),
        Event::ParticipantLost { id, reason } => {
            let silent_ms = match reason {
                LostReason::Disposed => None,
                LostReason::Timeout { elapsed, .. } => {
                    Some(u64::try_from(elapsed.to_std().as_millis()).unwrap_or(u64::MAX))
                }
            };
            Some(Discovery::ParticipantGone { prefix: id.as_ref().try_into().ok()?, silent_ms })
        }
        _ => None,
    }
}

fn endpoint(description: EndpointDescription, default_reliability: Reliability) -> Endpoint {
    Endpoint {
        guid: Guid(description.guid.to_bytes()),
        reliability: reliability_of(&description.qos, default_reliability),
        durability: durability_of(&description.qos),
        location: Location {
            seen_from: description.seen_from.map(|source| source.ip()),
            announced: description
                .unicast_addresses
                .iter()
                .take(MAX_ADDRESSES)
                .map(|address| address.ip())
                .collect(),
        },
        type_hash: TypeHash::find_in(&description.user_data),
        topic: description.topic_name,
        dds_type: description.type_name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_takes_as_many_changes_as_can_wait() {
        let mut turn = DiscoveryTurn::default();
        let taken = (0..10_000).filter(|_| turn.takes_another()).count();
        assert_eq!(taken, MAX_WAITING_CHANGES);
    }
}
