//! The probe protocol: its messages as they are on the wire (docs/probe-protocol.md).

mod message;

pub use message::{MAX_MESSAGE_BYTES, PROBE_TYPE, ProbeId, ProbeRequest, ProbeResponse, Signature};
