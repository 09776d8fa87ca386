//! The probe protocol: its messages as they are on the wire, and who is believed (docs/probe-protocol.md).

mod message;
mod secret;
mod trust;

pub use message::{MAX_MESSAGE_BYTES, PROBE_TYPE, ProbeId, ProbeRequest, ProbeResponse, Signature};
pub use secret::{Secret, SecretError};
pub use trust::{Signed, Trust};
