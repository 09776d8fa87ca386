//! The probe protocol: encoding, signing and checking of its messages (docs/probe-protocol.md).

mod message;
mod request_handler;
mod secret;
mod trust;

use crate::dds::ReaderQos;
use crate::model::{Durability, History, QosProfile, Reliability};

pub use message::{MAX_MESSAGE_BYTES, PROBE_TYPE, ProbeId, ProbeRequest, ProbeResponse, Signature};
pub use request_handler::RequestHandler;
pub use secret::{Secret, SecretError};
pub use trust::{Signed, Trust};

/// History depth of the readers: one message each of 64 senders that send at the same time.
const PROBE_DEPTH: u32 = 64;

/// QoS of the writers of both topics: RELIABLE, so that the RELIABLE subscriptions of the original Python
/// package match. A writer with KEEP_LAST never waits for a reader.
pub const PROBE_WRITER_QOS: QosProfile =
    QosProfile { history: History::KeepLast { depth: 1 }, ..QosProfile::CRITICAL };

/// QoS of the readers of both topics: BEST_EFFORT, because a repaired message would hide the loss that the
/// probes measure. Such a reader matches writers of both reliabilities.
pub const PROBE_READER_QOS: ReaderQos = ReaderQos {
    reliability: Reliability::BestEffort,
    durability: Durability::Volatile,
    depth: PROBE_DEPTH,
    deadline_ms: None,
};
