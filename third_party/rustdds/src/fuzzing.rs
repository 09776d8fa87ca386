//! What reads bytes off the network, without sockets, for fuzzers. Not part of
//! the API.

use std::{
  cell::RefCell,
  rc::Rc,
  sync::{Arc, Mutex, RwLock},
};

use bytes::Bytes;

use crate::{
  dds::{
    qos::{policy, QosPolicies, QosPolicyBuilder},
    statusevents::{sync_status_channel, DataReaderStatus},
    typedesc::TypeDesc,
    with_key::simpledatareader::ReaderCommand,
  },
  discovery::{
    DiscoveredReaderData, DiscoveredTopicData, DiscoveredWriterData, SpdpDiscoveredParticipantData,
  },
  messages::submessages::submessages::InterpreterSubmessage,
  mio_source,
  network::udp_sender::UDPSender,
  rtps::transmit::InterfaceObservations,
  polling::{new_shared_timer, wake_channel, LoopWaker},
  rtps::{
    message_receiver::MessageReceiver,
    reader::{Reader, ReaderIngredients},
    rtps_writer_proxy::RtpsWriterProxy,
    Message, SubmessageBody,
  },
  serialization::pl_cdr_adapters::PlCdrDeserialize,
  structure::{
    dds_cache::DDSCache,
    duration::Duration,
    guid::{EntityId, EntityKind, GuidPrefix, GUID},
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

/// Lets a reader, RELIABLE or not, that has matched the writer 000001.02 of
/// [`SENDER`] receive datagrams. Nothing is sent in reply.
pub fn receive<'a>(reliable: bool, datagrams: impl Iterator<Item = &'a [u8]>) {
  thread_local! {
    static UDP_SENDER: Option<Rc<UDPSender>> =
      UDPSender::new_with_networks(0, None, 0).ok().map(Rc::new);
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
    },
    udp_sender,
    new_shared_timer(),
    participant_status_sender,
  );
  // Without a locator there is nowhere to send a reply to.
  let writer = GUID::new_with_prefix_and_id(GuidPrefix::new(&SENDER), writer_id);
  reader.update_writer_proxy(
    RtpsWriterProxy::new(writer, vec![], vec![], EntityId::UNKNOWN),
    &qos,
  );
  message_receiver.add_reader(reader);

  for datagram in datagrams {
    let Ok(mut message) = Message::read_from_buffer(&Bytes::copy_from_slice(datagram)) else {
      continue;
    };
    // INFO_REPLY names addresses that replies are to go to.
    message.submessages.retain(|submessage| {
      !matches!(
        submessage.body,
        SubmessageBody::Interpreter(InterpreterSubmessage::InfoReply(..))
      )
    });
    message_receiver.handle_parsed_message(message);
    while acknack_receiver.try_recv().is_ok() {}
  }
}
