//! What reads bytes off the network, without sockets, for fuzzers. Not part of
//! the API.

use std::{
  cell::RefCell,
  rc::Rc,
  sync::{Arc, Mutex, RwLock},
};

use bytes::{Bytes, BytesMut};
use enumflags2::BitFlags;

use crate::{
  dds::{
    ddsdata::DDSData,
    lent::{LentMemory, Lender, PartialArrival, SampleMemory},
    qos::{policy, QosPolicies, QosPolicyBuilder},
    statusevents::{sync_status_channel, DataReaderStatus},
    typedesc::TypeDesc,
    with_key::{datawriter::WriteOptions, simpledatareader::ReaderCommand},
  },
  discovery::{
    DiscoveredReaderData, DiscoveredTopicData, DiscoveredWriterData, SpdpDiscoveredParticipantData,
  },
  messages::submessages::{
    elements::serialized_payload::SerializedPayload,
    submessages::DataFrag,
  },
  mio_source,
  network::udp_sender::UDPSender,
  rtps::transmit::InterfaceObservations,
  polling::{new_shared_timer, wake_channel, LoopWaker},
  rtps::{
    fragment_assembler::{FragmentAssemblers, StatedOnce},
    message_receiver::MessageReceiver,
    reader::{Reader, ReaderIngredients},
    rtps_reader_proxy::RtpsReaderProxy,
    rtps_writer_proxy::RtpsWriterProxy,
    writer::{Writer, WriterIngredients},
    writer_send_buffer::WriterSendBuffer,
    Message,
  },
  serialization::pl_cdr_adapters::PlCdrDeserialize,
  structure::{
    dds_cache::DDSCache,
    duration::Duration,
    guid::{EntityId, EntityKind, GuidPrefix, GUID},
    sequence_number::{FragmentNumber, SequenceNumber},
  },
  RepresentationIdentifier,
};

/// The participant that receives, and the one whose writer it knows.
pub const RECEIVER: [u8; 12] = [1; 12];
pub const SENDER: [u8; 12] = [2; 12];

/// Reads a datagram as an RTPS message. Whether it is one.
pub fn read_message(datagram: &[u8]) -> bool {
  Message::read_from_buffer(&Bytes::copy_from_slice(datagram)).is_ok()
}

/// Reads what SPDP and SEDP say of participants, readers, writers and topics.
/// How many of the four it could be.
pub fn read_discovery(bytes: &[u8], encoding: RepresentationIdentifier) -> usize {
  [
    SpdpDiscoveredParticipantData::from_pl_cdr_bytes(bytes, encoding).is_ok(),
    DiscoveredReaderData::from_pl_cdr_bytes(bytes, encoding).is_ok(),
    DiscoveredWriterData::from_pl_cdr_bytes(bytes, encoding).is_ok(),
    DiscoveredTopicData::from_pl_cdr_bytes(bytes, encoding).is_ok(),
  ]
  .into_iter()
  .filter(|ok| *ok)
  .count()
}

/// Reads what a former participant knew. How many records it has, if it is sound.
pub fn read_journal(bytes: &[u8]) -> Option<usize> {
  crate::discovery::journal::read(bytes, GuidPrefix::new(&RECEIVER)).map(|known| known.len())
}

/// Lets a participant receive datagrams. Its reader 000001.07, RELIABLE or not,
/// has matched the writer 000001.02 of [`SENDER`], and its RELIABLE writer
/// 000002.02, which has sent a sample of 79 fragments and a small one, the reader
/// 000002.07. Nothing is sent in reply.
pub fn receive<'a>(reliable: bool, datagrams: impl Iterator<Item = &'a [u8]>) {
  thread_local! {
    static UDP_SENDER: Option<Rc<UDPSender>> =
      UDPSender::new_with_networks(0, &[], None, 0).ok().map(Rc::new);
  }
  let Some(udp_sender) = UDP_SENDER.with(Option::clone) else {
    return;
  };

  let waker = LoopWaker::new();
  let (acknack_sender, acknack_receiver) = wake_channel(8, &waker);
  let (spdp_liveness_sender, _spdp_liveness_receiver) = wake_channel(8, &waker);
  let receiver_prefix = GuidPrefix::new(&RECEIVER);
  let mut message_receiver = MessageReceiver::new(
    receiver_prefix,
    acknack_sender,
    spdp_liveness_sender,
    None,
    Rc::new(RefCell::new(InterfaceObservations::new())),
    Arc::default(),
  );

  let mut qos = QosPolicyBuilder::new().history(policy::History::KeepLast { depth: 4 });
  if reliable {
    qos = qos.reliability(policy::Reliability::Reliable {
      max_blocking_time: Duration::ZERO,
    });
  } else {
    qos = qos.reliability(policy::Reliability::BestEffort);
  }
  let qos: QosPolicies = qos.build();

  let (notification_sender, _notification_receiver) = mio_source::notification_channel(100);
  let Ok((_poll_source, poll_event_sender)) = mio_source::make_poll_channel() else {
    return;
  };
  let (Ok((status_sender, _status)), Ok((participant_status_sender, _participant_status))) = (
    sync_status_channel::<DataReaderStatus>(4),
    sync_status_channel(16),
  ) else {
    return;
  };
  let (_command_sender, data_reader_command_receiver) =
    wake_channel::<ReaderCommand>(10, &LoopWaker::new());
  let Ok(topic_cache_handle) = RwLock::new(DDSCache::new()).write().map(|mut cache| {
    cache.add_new_topic("t".to_string(), TypeDesc::new("t".to_string()), &qos)
  }) else {
    return;
  };
  if let Ok(mut topic_cache) = topic_cache_handle.lock() {
    topic_cache.lender = Lender(Some(Arc::new(EvenLengths)));
  }
  let reader_id =
    EntityId::new([0, 0, 1], EntityKind::READER_WITH_KEY_USER_DEFINED);
  let writer_id =
    EntityId::new([0, 0, 1], EntityKind::WRITER_WITH_KEY_USER_DEFINED);
  let mut reader = Reader::new(
    ReaderIngredients {
      guid: GUID::new_with_prefix_and_id(receiver_prefix, reader_id),
      notification_sender,
      status_sender,
      topic_name: "t".to_string(),
      topic_cache_handle,
      like_stateless: false,
      qos_policy: qos.clone(),
      data_reader_command_receiver,
      data_reader_waker: Arc::new(Mutex::new(None)),
      poll_event_sender,
      security_plugins: None,
      discovery_notify: None,
      taken: Default::default(),
    },
    Rc::clone(&udp_sender),
    new_shared_timer(),
    participant_status_sender,
  );
  // Without a locator there is nowhere to send a reply to.
  let remote_writer = GUID::new_with_prefix_and_id(GuidPrefix::new(&SENDER), writer_id);
  reader.update_writer_proxy(
    RtpsWriterProxy::new(remote_writer, vec![], vec![], EntityId::UNKNOWN),
    &qos,
  );
  message_receiver.add_reader(reader);

  let writer_qos = QosPolicyBuilder::new()
    .reliability(policy::Reliability::Reliable {
      max_blocking_time: Duration::ZERO,
    })
    .durability(policy::Durability::TransientLocal)
    .build();
  let Some((mut writer, remote_reader)) = sent_by_a_writer(udp_sender, &writer_qos) else {
    return;
  };

  for datagram in datagrams {
    let Ok(message) = Message::read_from_buffer(&Bytes::copy_from_slice(datagram)) else {
      continue;
    };
    message_receiver.handle_parsed_message(message);
    while let Ok((prefix, acknack)) = acknack_receiver.try_recv() {
      writer.handle_ack_nack(prefix, &acknack);
      writer.repair(remote_reader);
    }
  }
}

// Lends memory for some samples, so that both kinds are put together. As a pool does, it
// has none for samples of any length that a fragment claims: twenty of 64 MiB and more
// were more memory than the fuzzer allows.
struct EvenLengths;

const MAX_LENT_BYTES: usize = 1 << 20;

impl SampleMemory for EvenLengths {
  fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
    (len.is_multiple_of(2) && len <= MAX_LENT_BYTES)
      .then(|| Box::new(Zeros(BytesMut::zeroed(len))) as Box<dyn LentMemory>)
  }
}

struct Zeros(BytesMut);

impl LentMemory for Zeros {
  fn bytes(&mut self) -> &mut [u8] {
    &mut self.0
  }

  fn finish(self: Box<Self>) {}
}

/// Puts samples of two writers together in memory that older samples have left, from fragments that overlap, come
/// again, and contradict each other. Each step takes 8 bytes; the readers are RELIABLE if `reliable` is set.
///
/// # Panics
///
/// If a sample or a report of its arrival shows a byte that no fragment had, or a byte changes
/// after it was reported.
pub fn assemble(reliable: bool, steps: &[u8]) {
  let lender = || Lender(Some(Arc::new(UsedMemory)));
  let mut assemblers = FragmentAssemblers::default();
  for &[sample, start, count, fragment_size, size_high, size_low, content, kind] in
    steps.as_chunks::<8>().0
  {
    let writer = GUID::new(GuidPrefix::new(&[sample & 1; 12]), EntityId::MIN);
    let writer_sn = SequenceNumber::new(i64::from(sample >> 1 & 3) + 1);
    if kind == u8::MAX {
      assemblers.discard_before(writer, writer_sn);
      continue;
    }
    let len = usize::from(count) * usize::from(fragment_size);
    // One time in 16 it is a byte shorter than it claims.
    let len = len.saturating_sub((kind & 15 == 1).into());
    let fragment = DataFrag {
      reader_id: EntityId::UNKNOWN,
      writer_id: EntityId::MIN,
      inline_qos: None,
      writer_sn,
      fragment_starting_num: FragmentNumber::new(start.into()),
      fragments_in_submessage: count.into(),
      fragment_size: fragment_size.into(),
      data_size: u16::from_be_bytes([size_high, size_low]).into(),
      serialized_payload: vec![content % USED; len].into(),
    };
    let completed = assemblers.new_datafrag(
      writer,
      reliable,
      &fragment,
      BitFlags::empty(),
      StatedOnce::default(),
      lender,
    );
    if let Some((DDSData::Data { lent: Some(lent), .. }, _)) = completed {
      if let Some(memory) = lent.with(Option::take) {
        memory.finish();
      }
    }
    assert!(assemblers.own_bytes() <= lender().limits().max_total_bytes);
  }
}

// What memory that is lent holds of an older sample. No fragment has this byte.
const USED: u8 = 0xEE;

struct UsedMemory;

impl SampleMemory for UsedMemory {
  fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
    Some(Box::new(Watched {
      bytes: vec![USED; len],
      reported: Vec::new(),
    }))
  }
}

struct Watched {
  bytes: Vec<u8>,
  // The complete bytes of the last report.
  reported: Vec<u8>,
}

impl Watched {
  fn check(&self, complete_bytes: usize) {
    assert!(self.bytes.starts_with(&self.reported), "reported bytes have changed");
    assert!(
      !self.bytes[..complete_bytes].contains(&USED),
      "bytes of an older sample are reported"
    );
  }
}

impl LentMemory for Watched {
  fn bytes(&mut self) -> &mut [u8] {
    &mut self.bytes
  }

  fn arrived(&mut self, arrival: &PartialArrival) {
    assert!(arrival.complete_bytes > self.reported.len(), "nothing new is reported");
    self.check(arrival.complete_bytes);
    self.reported = self.bytes[..arrival.complete_bytes].to_vec();
  }

  fn finish(self: Box<Self>) {
    self.check(self.bytes.len());
  }
}

// A writer that has sent something, and its one reader.
fn sent_by_a_writer(udp_sender: Rc<UDPSender>, qos: &QosPolicies) -> Option<(Writer, GUID)> {
  let entity = |kind| EntityId::new([0, 0, 2], kind);
  let guid = GUID::new_with_prefix_and_id(
    GuidPrefix::new(&RECEIVER),
    entity(EntityKind::WRITER_WITH_KEY_USER_DEFINED),
  );
  let remote_reader = GUID::new_with_prefix_and_id(
    GuidPrefix::new(&SENDER),
    entity(EntityKind::READER_WITH_KEY_USER_DEFINED),
  );
  let send_buffer = WriterSendBuffer::new(guid, "t".to_string(), true, false, false, 8, 8, 8);
  let (status_sender, _status) = sync_status_channel(4).ok()?;
  let (participant_status_sender, _participant_status) = sync_status_channel(16).ok()?;
  let mut writer = Writer::new(
    WriterIngredients {
      guid,
      send_buffer: send_buffer.clone(),
      topic_name: "t".to_string(),
      like_stateless: false,
      qos_policies: qos.clone(),
      status_sender,
      security_plugins: None,
    },
    udp_sender,
    new_shared_timer(),
    participant_status_sender,
    Rc::new(RefCell::new(InterfaceObservations::new())),
    Rc::from(Vec::new()),
  );
  for bytes in [20_000, 8] {
    let payload = SerializedPayload::new(RepresentationIdentifier::CDR_LE, vec![0; bytes]);
    send_buffer.admit_blocking(
      WriteOptions::default(),
      DDSData::new(payload),
      Some(std::time::Duration::ZERO),
    );
  }
  writer.process_pending();
  writer.update_reader_proxy(&RtpsReaderProxy::new(remote_reader, qos.clone(), false), qos);
  Some((writer, remote_reader))
}
