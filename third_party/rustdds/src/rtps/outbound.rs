//! Core types for the nonblocking-transmit outbound path.
//!
//! See `src/rtps/nonblocking_transmit_design.md`. These types are shared by
//! `UDPSender` (which owns the sockets and the never-dropped control queues),
//! the `Writer` (bulk DATA producer, resumable), and `DPEventLoop` (which owns
//! the poll and the per-socket round-robin of writers willing to send bulk).

use std::{collections::VecDeque, net::SocketAddr};

use bytes::Bytes;

/// Identifies one physical sender socket owned by `UDPSender`.
///
/// `Multicast(i)` indexes into `UDPSender::multicast_sockets` (one socket per
/// local multicast-capable interface).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum SocketId {
  Unicast,
  Multicast(usize),
}

/// Outcome of a single non-blocking datagram send attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SendOutcome {
  /// The datagram was handed to the kernel.
  Sent,
  /// The kernel send buffer is full. For control this means "keep it queued";
  /// for bulk this means "stop and back off, resume on writable".
  WouldBlock,
  /// A permanent error (bad address, encode failure, unknown locator kind).
  /// Never retried.
  Dropped,
}

/// Traffic class deciding the per-socket queueing policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TrafficClass {
  /// Control/discovery (HEARTBEAT, ACKNACK, GAP, SPDP/SEDP): high priority,
  /// never dropped, drained before bulk data.
  Control,
  /// Bulk user DATA/DATAFRAG: flow-controlled; on WouldBlock the producer stops
  /// and is resumed on write readiness (or, for repair, simply retried later).
  Bulk,
}

/// The bytes of a datagram, in pieces that the kernel gathers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Gather<'a> {
  pub head: &'a [u8],
  pub fragments: &'a [u8],
  /// At most 3 bytes of zero after the fragments.
  pub padding_len: usize,
}

impl<'a> Gather<'a> {
  pub fn whole(datagram: &'a [u8]) -> Self {
    Self {
      head: datagram,
      fragments: &[],
      padding_len: 0,
    }
  }

  pub fn len(&self) -> usize {
    self.head.len() + self.fragments.len() + self.padding_len
  }

  pub fn pieces(&self) -> [&'a [u8]; 3] {
    [self.head, self.fragments, &[0; 3][..self.padding_len]]
  }
}

/// A serialized message. Fragments with which it ends are not copied.
#[derive(Debug)]
pub(crate) struct Pieces {
  /// What comes before the fragments; all of a message that does not end with any.
  pub head: Vec<u8>,
  /// The fragments, a part of the sample's own bytes.
  pub fragments: Bytes,
  /// The bytes after the fragments, which are zero; at most 3.
  pub padding_len: usize,
}

impl Pieces {
  pub fn whole(message: Vec<u8>) -> Self {
    Self {
      head: message,
      fragments: Bytes::new(),
      padding_len: 0,
    }
  }

  pub fn gather(&self) -> Gather<'_> {
    Gather {
      head: &self.head,
      fragments: &self.fragments,
      padding_len: self.padding_len,
    }
  }
}

/// A queued outbound datagram. Used only for the never-dropped control queue;
/// bulk data is regenerated on demand and never buffered here.
#[derive(Debug)]
pub(crate) struct Datagram {
  pub addr: SocketAddr,
  pub bytes: Vec<u8>,
}

/// A per-socket FIFO of control datagrams that must never be dropped.
pub(crate) type ControlQueue = VecDeque<Datagram>;

/// Soft high-watermark for a per-socket control queue. Exceeding it only logs a
/// warning (a persistently wedged socket usually means the peer/link is dead);
/// nothing is ever dropped.
pub(crate) const CONTROL_QUEUE_WARN_LEN: usize = 1024;
