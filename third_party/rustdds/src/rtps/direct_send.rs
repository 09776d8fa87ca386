//! Sending a sample on the thread that writes it.
//!
//! A DataWriter's sample is sent by the event loop: a doorbell, a wake-up and a
//! turn of the loop. When nothing waits to be sent before it, it fits one
//! datagram, and all that is to be known for that datagram is known, the thread
//! that writes can as well send it itself. Whatever else there is (fragments, a
//! full socket, multicast, security, repair, local readers) is left to the event
//! loop, which says in a [`Plan`] what may be done without it.
//!
//! Whoever sends holds the lock on the plan, so that no sample is sent twice or
//! before the one that precedes it.

use std::{
  net::{SocketAddr, UdpSocket},
  sync::{
    atomic::{AtomicI32, AtomicI64, Ordering},
    Arc, Mutex, MutexGuard, PoisonError,
  },
};

use speedy::Endianness;

use crate::{
  rtps::{identity::UsedNumbers, MessageBuilder},
  structure::{
    cache_change::CacheChange,
    guid::{EntityId, GUID},
    sequence_number::SequenceNumber,
  },
};

/// How a datagram reaches every matched reader.
pub(crate) struct Plan {
  pub socket: Arc<UdpSocket>,
  pub addresses: Vec<SocketAddr>,
  /// The joining readers, see `RtpsReaderProxy::start_joining`.
  pub offers: Vec<Offer>,
  /// The largest serialized payload that fits one datagram to each of them.
  pub max_payload: usize,
  /// Whether the Writer is Reliable.
  pub heartbeat: bool,
}

/// What a joining reader gets instead of a sample: a HEARTBEAT that ends before the first
/// sample that the reader is offered.
pub(crate) struct Offer {
  pub address: SocketAddr,
  pub reader: EntityId,
  pub first: SequenceNumber,
}

pub(crate) struct DirectSend {
  plan: Mutex<Option<Plan>>,
  // Written by whoever holds the lock.
  last_sent: AtomicI64,
  heartbeat_count: AtomicI32,
  numbers: Arc<UsedNumbers>,
}

impl DirectSend {
  pub fn new() -> Self {
    Self {
      plan: Mutex::new(None),
      last_sent: AtomicI64::new(0),
      heartbeat_count: AtomicI32::new(1),
      numbers: Arc::default(),
    }
  }

  /// Counts after those that the participant takes over.
  pub fn count_with(&mut self, numbers: Arc<UsedNumbers>) {
    self.heartbeat_count = AtomicI32::new(numbers.count_before() + 1);
    self.numbers = numbers;
  }

  /// What its participant has used.
  pub fn numbers(&self) -> &UsedNumbers {
    &self.numbers
  }

  /// Held by whoever sends samples for the first time.
  pub fn lock(&self) -> MutexGuard<'_, Option<Plan>> {
    self.plan.lock().unwrap_or_else(PoisonError::into_inner)
  }

  /// Highest sequence number that was sent completely.
  pub fn last_sent(&self) -> SequenceNumber {
    SequenceNumber::new(self.last_sent.load(Ordering::Acquire))
  }

  pub fn set_last_sent(&self, last_sent: SequenceNumber) {
    self
      .last_sent
      .store(i64::from(last_sent), Ordering::Release);
  }

  pub fn next_heartbeat_count(&self) -> i32 {
    let count = self.heartbeat_count.fetch_add(1, Ordering::Relaxed);
    self.numbers.use_count(count);
    count
  }

  /// Sends a sample if that can be done here and now. If not, or if a socket
  /// would block, the event loop has to do it, for all readers.
  pub fn try_send(
    &self,
    writer_guid: GUID,
    sequence_number: SequenceNumber,
    sample: impl FnOnce() -> Option<(CacheChange, SequenceNumber)>,
  ) -> bool {
    // The event loop sends just now, and has to go on with this one.
    let Ok(plan) = self.plan.try_lock() else {
      return false;
    };
    let Some(plan) = plan.as_ref() else {
      return false;
    };
    if self.last_sent().plus_1() != sequence_number {
      return false;
    }
    let Some((cc, first_available)) = sample() else {
      return false;
    };
    if cc.data_value.payload_size() > plan.max_payload
      || cc.write_options.to_single_reader().is_some()
    {
      return false;
    }

    let endianness = Endianness::LittleEndian;
    let mut builder = MessageBuilder::new();
    if let Some(source_timestamp) = cc.write_options.source_timestamp() {
      builder = builder.ts_msg(endianness, Some(source_timestamp));
    }
    builder = builder.data_msg(&cc, EntityId::UNKNOWN, writer_guid, endianness, None);
    if plan.heartbeat {
      builder = builder.heartbeat_msg(
        writer_guid.entity_id,
        first_available,
        sequence_number,
        self.next_heartbeat_count(),
        endianness,
        EntityId::UNKNOWN,
        false, // final_flag: request ACKNACK
        false, // liveliness_flag
      );
    }
    let message = builder.add_header_and_build(writer_guid.prefix);
    let Ok(datagram) = message.write_to_vec_fast(endianness) else {
      return false;
    };
    for address in &plan.addresses {
      match plan.socket.send_to(&datagram, address) {
        Ok(_) => {}
        Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => return false,
        // As the event loop has it: one address that cannot be reached does not
        // keep the sample from the others.
        Err(e) => log::warn!("try_send to {address}: {e:?} len={}", datagram.len()),
      }
    }
    for offer in &plan.offers {
      self.send_offer(writer_guid, plan, offer);
    }
    self.set_last_sent(sequence_number);
    true
  }

  fn send_offer(&self, writer_guid: GUID, plan: &Plan, offer: &Offer) {
    let endianness = Endianness::LittleEndian;
    let message = MessageBuilder::new()
      .heartbeat_msg(
        writer_guid.entity_id,
        offer.first,
        offer.first - SequenceNumber::from(1),
        self.next_heartbeat_count(),
        endianness,
        offer.reader,
        false, // final_flag: request ACKNACK
        false, // liveliness_flag
      )
      .add_header_and_build(writer_guid.prefix);
    if let Ok(datagram) = message.write_to_vec_fast(endianness) {
      // The next sample repeats it.
      let _ = plan.socket.send_to(&datagram, offer.address);
    }
  }
}
