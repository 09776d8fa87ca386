//! What a process refuses of the network.

use super::counts::{Counts, reasons};

reasons! {
    /// Why a DDS participant of the bridge refused something that it received. A refused datagram or
    /// announcement is counted and has no other effect.
    NetworkRefusal:
    /// A datagram that is not RTPS or not well-formed, or an announcement of a participant that is not
    /// well-formed or not sent by that participant.
    MalformedDatagram = "malformed_datagram", "malformed datagrams dropped",
    /// An announcement of an unknown participant: too many in a short time, or no room for another one.
    TooManyParticipants = "too_many_participants", "announcements of new participants refused",
    /// A participant without a topic of the bridge was removed to make room for a new one.
    EvictedParticipant = "evicted_participant", "participants removed to make room for new ones",
    /// An announcement of an endpoint or a topic without room for another one.
    TooManyEndpoints = "too_many_endpoints", "announcements of readers, writers and topics refused",
    /// A sample or announcement of which fragments were missing, discarded because its writer had too many of
    /// them, or because those of its topic or of all inputs needed too much memory.
    UnfinishedSample = "unfinished_sample", "samples discarded of which fragments were missing",
}

/// Counts of what a participant refused of the network, by reason.
pub type NetworkRefusals = Counts<NetworkRefusal, { NetworkRefusal::COUNT }>;
