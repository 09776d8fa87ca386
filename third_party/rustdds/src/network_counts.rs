//! Counts of what a participant refuses of the network, and the limits beyond which
//! it refuses.
//!
//! Any host of the network can announce participants and endpoints that do not exist.
//! These limits bound the memory that discovery uses for them.

use std::{
  sync::atomic::{AtomicU64, Ordering},
  time::Duration,
};

/// Remote participants that discovery keeps. At this number it evicts, for each new
/// one, the oldest participant of which no endpoint has a topic of ours. 1,024 are
/// several times the nodes of a large robot; each takes some 12 KiB.
pub(crate) const MAX_PARTICIPANTS: usize = 1_024;

/// Readers, and as many writers, that discovery keeps of one participant. A ROS 2 node
/// has some 8 of each, so that a process of 500 nodes is within the limit.
pub(crate) const MAX_ENDPOINTS_PER_PARTICIPANT: usize = 4_096;

/// Readers, and as many writers, that discovery keeps of all participants. Those with
/// a topic of ours are accepted up to twice this number.
pub(crate) const MAX_ENDPOINTS: usize = 16_384;

/// Bytes of an endpoint's announcement without its addresses, of which 16 are kept. A
/// larger announcement is refused: 16,384 of 64 KB would take a gigabyte. That of a ROS 2
/// endpoint has 800 bytes at most: two names of 255, the hash of its type, and its QoS.
pub(crate) const MAX_ENDPOINT_BYTES: usize = 2_048;

/// Topic names that discovery keeps.
pub(crate) const MAX_TOPICS: usize = 16_384;

/// The longest lease that a participant is granted. One that claims a longer lease,
/// or an infinite one, and is silent for this long is removed, and is back with its
/// next announcement.
pub(crate) const MAX_LEASE: Duration = Duration::from_secs(300);

/// What a participant has refused of the network since it was created.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NetworkCounts {
  /// Datagrams that are not RTPS or not well-formed, and announcements of participants
  /// that are not well-formed or not sent by that participant.
  pub malformed_datagrams: u64,
  /// Announcements of unknown participants that were dropped: too many at a time, or
  /// no room for another participant.
  pub announcements_refused: u64,
  /// Participants that were removed to make room for new ones.
  pub participants_evicted: u64,
  /// Announcements of endpoints and topics that were dropped: no room for another.
  pub endpoints_refused: u64,
  /// Unfinished samples that were discarded for a limit: 128 of a Writer, the memory of a
  /// reader, or that of all readers together
  /// ([`with_max_unfinished_bytes`](crate::DomainParticipantBuilder::with_max_unfinished_bytes)).
  /// Not those that are discarded below all limits because no fragment came for 10 s.
  pub unfinished_discarded: u64,
}

/// The counters behind [`NetworkCounts`], which both threads of a participant increment.
#[derive(Debug, Default)]
pub struct NetworkCounters {
  pub(crate) malformed_datagrams: Counter,
  pub(crate) announcements_refused: Counter,
  pub(crate) participants_evicted: Counter,
  pub(crate) endpoints_refused: Counter,
  pub(crate) unfinished_discarded: Counter,
}

impl NetworkCounters {
  /// The counts so far. Waits for no other thread.
  pub fn counts(&self) -> NetworkCounts {
    NetworkCounts {
      malformed_datagrams: self.malformed_datagrams.get(),
      announcements_refused: self.announcements_refused.get(),
      participants_evicted: self.participants_evicted.get(),
      endpoints_refused: self.endpoints_refused.get(),
      unfinished_discarded: self.unfinished_discarded.get(),
    }
  }
}

#[derive(Debug, Default)]
pub(crate) struct Counter(AtomicU64);

impl Counter {
  pub fn increment(&self) {
    self.add(1);
  }

  pub fn add(&self, count: usize) {
    self.0.fetch_add(count as u64, Ordering::Relaxed);
  }

  fn get(&self) -> u64 {
    self.0.load(Ordering::Relaxed)
  }
}
