//! What other participants have, as discovery reports it.

use super::qos::{durability_of, reliability_of};
use super::rustdds::{DomainParticipantStatusEvent, EndpointDescription, LostReason};
use crate::model::{Durability, Guid, Reliability};
use crate::policy::Location;

/// Announced addresses of an endpoint that are looked at. A host has fewer.
const MAX_ADDRESSES: usize = 64;

/// A reader or writer that discovery has seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Its GUID.
    pub guid: Guid,
    /// DDS topic, such as `rt/scan`.
    pub topic: String,
    /// DDS type, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub dds_type: String,
    /// RELIABILITY that it offers or requests.
    pub reliability: Reliability,
    /// DURABILITY that it offers or requests.
    pub durability: Durability,
    /// What is known of where it is.
    pub location: Location,
}

/// A change in what other participants have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Discovery {
    /// A writer is there, or changed.
    Writer(Endpoint),
    /// A writer is gone.
    WriterGone(Guid),
    /// A reader is there, or changed.
    Reader(Endpoint),
    /// A reader is gone.
    ReaderGone(Guid),
    /// A participant is gone, and with it its readers and writers, of which nothing else is said.
    ParticipantGone {
        /// The prefix that their GUIDs have in common.
        prefix: [u8; 12],
        /// For how long nothing was heard of it, if its lease has ended; `None` if it said goodbye.
        silent_ms: Option<u64>,
    },
    /// A reader of ours asks for more than a writer offers, or a reader for more than ours offers.
    Incompatible {
        /// The endpoint of ours.
        local: Guid,
        /// The other one.
        remote: Guid,
    },
}

/// The event in our terms; `None` for one that the bridge has no use for.
pub(super) fn translate(event: DomainParticipantStatusEvent) -> Option<Discovery> {
    use DomainParticipantStatusEvent as Event;
    match event {
        // DDS 1.4 table in clause 2.2.3: RELIABILITY defaults to RELIABLE for writers, BEST_EFFORT for
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
        Event::RemoteReaderQosIncompatible { local_writer, remote_reader, .. } => {
            Some(Discovery::Incompatible {
                local: Guid(local_writer.to_bytes()),
                remote: Guid(remote_reader.to_bytes()),
            })
        }
        Event::RemoteWriterQosIncompatible { local_reader, remote_writer, .. } => {
            Some(Discovery::Incompatible {
                local: Guid(local_reader.to_bytes()),
                remote: Guid(remote_writer.to_bytes()),
            })
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
        topic: description.topic_name,
        dds_type: description.type_name,
    }
}
