//! The RTPS edge: a participant, a raw reader, a raw writer and discovery, on RustDDS.
//!
//! Payloads pass as the bytes that were on the wire, with their encapsulation header, and are never decoded;
//! that is why any message type will do. No RustDDS type leaves this module, so that another DDS library
//! could stand behind it.

mod arrivals;
mod discovery;
mod error;
mod graph;
mod graph_watch;
mod lent;
mod network;
mod participant;
mod payload;
mod qos;
mod reader;
mod writer;

pub use arrivals::{Arrival, Arrivals, ArrivalsCloser};
pub use discovery::{Discovery, Endpoint};
pub use error::DdsError;
pub use graph::{GraphEntry, GraphNode, decode_graph, encode_graph};
pub use graph_watch::{GraphRefusals, GraphWatch, MAX_GRAPH_ENDPOINTS, MAX_PARTICIPANTS};
pub use lent::{LentMemory, Payload, SampleMemory};
pub use network::{AbsentInterface, absent_interfaces, host_addresses, interfaces};
pub use participant::{Participant, ParticipantOptions};
pub use qos::ReaderQos;
pub use reader::{RawReader, ReaderEvent, SampleOrigin, Take};
pub use writer::{MatchedReader, RawWriter, WriteError, WriterEvent, Written};

/// RustDDS, in the version that ros2-client uses, so that there is one of it.
use ros2_client::dds::rustdds;
