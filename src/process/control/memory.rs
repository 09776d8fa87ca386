//! The memory that the messages of control may take. Pure.

pub(in crate::process) use super::networks;
use super::parameters;

/// The readers of a network's probes and graph entries: messages of some KiB, and unfinished ones of 4 MiB.
/// Forged messages that are larger than any of a ROS 2 node may need more; the limit then ends control.
pub(in crate::process) const REQUESTS_BYTES: u64 = 32 << 20;

/// The parameter services of a node.
pub(in crate::process) fn node_bytes() -> u64 {
    parameters::bytes_of_node() as u64
}
