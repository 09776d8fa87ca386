//! The probe protocol: its messages as they are on the wire, and who is believed (docs/probe-protocol.md).

mod answers;
mod message;
mod secret;
mod trust;
mod watch;

use crate::dds::ReaderQos;
use crate::model::{Durability, History, QosProfile, Reliability};

pub use answers::Answers;
pub use message::{MAX_MESSAGE_BYTES, PROBE_TYPE, ProbeId, ProbeRequest, ProbeResponse, Signature};
pub use secret::{Secret, SecretError};
pub use trust::{Signed, Trust};
pub use watch::RefusalWatch;

/// Messages that may wait for whoever reads them: those of 64 senders at once.
const PROBE_DEPTH: u32 = 64;

/// What a writer of either topic offers.
pub const PROBE_WRITER_QOS: QosProfile = QosProfile {
    reliability: Reliability::BestEffort,
    history: History::KeepLast { depth: 1 },
    durability: Durability::Volatile,
    lifespan_ms: None,
    deadline_ms: None,
};

/// What a reader of either topic asks for.
pub const PROBE_READER_QOS: ReaderQos = ReaderQos {
    reliability: Reliability::BestEffort,
    durability: Durability::Volatile,
    depth: PROBE_DEPTH,
    deadline_ms: None,
};
