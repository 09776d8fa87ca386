//! The memory that the messages of control may take. Pure.

pub(in crate::process) use super::networks;
use super::parameters;

/// The readers of a network's probes and graph entries: of each 4 MiB of complete messages and 4 MiB of
/// unfinished ones, and 16 MiB of graph entries that wait for an earlier one.
pub(in crate::process) const REQUESTS_BYTES: u64 = 32 << 20;

/// The parameter services of a node.
pub(in crate::process) fn node_bytes() -> u64 {
    parameters::bytes_of_node() as u64
}
