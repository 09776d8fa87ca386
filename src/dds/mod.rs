//! The DDS interface of the bridge: participant, raw reader, raw writer and discovery, on top of RustDDS.
//!
//! Payloads are forwarded as the bytes that were on the wire, with their encapsulation header, and are never
//! decoded; so the bridge forwards any message type. The public interface has no RustDDS types, so that
//! another DDS library could replace RustDDS, except the two traits by which that borrows memory from the
//! bridge.

mod arrivals;
mod discovery;
mod error;
mod graph;
mod graph_watch;
mod identity;
mod memory;
mod network;
mod participant;
mod qos;
mod reader;
mod writer;

pub use arrivals::{Arrival, Arrivals, ArrivalsCloser};
pub use discovery::{Discovery, DiscoveryTurn, Endpoint};
pub use error::DdsError;
pub use graph::{GraphEntry, GraphNode, decode_graph, encode_graph};
pub use graph_watch::{GraphRefusals, GraphWatch, MAX_GRAPH_ENDPOINTS, MAX_PARTICIPANTS};
pub use identity::{FormerSample, Kept, ParticipantIdentity, WriterContinuation};
pub use memory::{DISCOVERY_BYTES, SOCKETS_BYTES, WITHHELD_BYTES, history_bytes};
pub use network::{host_addresses, interfaces};
pub use participant::{EVENT_LOOP_THREAD, Participant, ParticipantOptions};
pub use qos::ReaderQos;
pub use reader::{
    ArrivalFlag, AssemblyLimits, Inbox, LentMemory, PartialArrival, Payload, RawReader, ReaderEvent,
    SampleMemory, SampleOrigin, Take, TakePayload, partial_sample,
};
pub use writer::{RawWriter, WriteError, WriterEvent, Written};

/// RustDDS in the version that ros2-client uses, so that the program contains one version of it.
use ros2_client::dds::rustdds;
