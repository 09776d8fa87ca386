//! The samples of a route that ingress keeps for a lane that restarts.

use super::health::FixedText;

/// The last samples of a route, on a board: where a lane that restarts finds those that the channel does not
/// retain.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct Backlog {
    /// The sequence number of the first sample that ingress keeps; it keeps all later ones. 0 if none.
    pub first_sequence: u64,
    /// Where the first slot begins in the file of the route's pool.
    pub first_offset: u64,
    /// The bytes from one slot to the next.
    pub stride_bytes: u64,
    /// The number of slots.
    pub slots: u64,
    /// The file of the route's pool in shared memory.
    pub pool: FixedText,
}
