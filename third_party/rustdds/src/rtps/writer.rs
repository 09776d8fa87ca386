use std::{
  cell::RefCell,
  cmp::{max, min},
  collections::{BTreeMap, BTreeSet},
  net::SocketAddr,
  ops::Bound::Included,
  rc::Rc,
  sync::mpsc::TrySendError,
  time::Instant,
};

#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};
use speedy::Endianness;
use mio1::Token;

use crate::{
  dds::{
    qos::{
      policy,
      policy::{History, Reliability},
      HasQoSPolicy, QosPolicies,
    },
    statusevents::{
      CountWithChange, DataWriterStatus, DomainParticipantStatusEvent, StatusChannelSender,
    },
    with_key::datawriter::InstanceChange,
  },
  messages::submessages::submessages::{AckNack, AckSubmessage},
  network::{udp_sender::UDPSender, util::IfAddr},
  polling::SharedTimer,
  rtps::{
    constant::{
      DEFAULT_WRITER_MAX_SAMPLES, FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE, FRAGMENT_SIZE,
      HEARTBEAT_PERIOD_FAST, HEARTBEAT_PERIOD_SLOW, HEARTBEAT_SUBMESSAGE_SERIALIZED_SIZE,
      HISTORY_SETTLING, LARGE_SAMPLE_BYTES, NACK_FRAG_RESPONSE_DELAY,
      NACK_RESPONSE_DELAY, NACK_SUPPRESSION_DURATION, PENDING_TURN_MAX_BYTES, REPAIR_BATCH_MAX_BYTES,
      REPAIR_BATCH_MAX_BYTES_LOOPBACK, REPAIR_FRAGS_INTERVAL, REPAIR_FRAGS_MAX_BYTES,
      REPAIR_INTERVAL_DEFAULT, REPAIR_INTERVAL_MAX, REPAIR_INTERVAL_MIN, REPAIR_RATE_FACTOR, WRITE_RATE_PERIOD,
    },
    direct_send::{Offer, Plan},
    outbound::{Pieces, SocketId, TrafficClass},
    rtps_reader_proxy::{EvictedRequests, RtpsReaderProxy},
    timed_event::DpTimerEvent,
    transmit::{DefaultRouteSelector, InterfaceObservations, RouteKey},
    writer_send_buffer::WriterSendBuffer,
    Message, MessageBuilder,
  },
  structure::{
    cache_change::CacheChange,
    duration::Duration,
    entity::RTPSEntity,
    guid::{EntityId, GuidPrefix, GUID},
    locator::Locator,
    sequence_number::{FragmentNumber, SequenceNumber, SequenceNumberSet},
    time::Timestamp,
  },
};
#[cfg(feature = "security")]
use crate::{
  rtps::Submessage,
  security::{security_plugins::SecurityPluginsHandle, SecurityResult},
};
#[cfg(not(feature = "security"))]
use crate::no_security::SecurityPluginsHandle;

#[derive(PartialEq, Eq, Clone, Copy)]
pub enum DeliveryMode {
  Unicast,
  Multicast,
}

/// nonblocking-transmit: how far into the current push-mode sample we have
/// transmitted. Lets a large (fragmented) sample resume from the exact point
/// where the socket last returned WouldBlock, instead of restarting.
/// (see src/rtps/nonblocking_transmit_design.md)
#[derive(PartialEq, Eq, Clone, Copy, Debug)]
pub(crate) enum SampleCursor {
  /// Nothing of this sample has been transmitted yet (fresh DATA, or the first
  /// DATAFRAG together with any leading GAP).
  Fresh,
  /// Resume DATAFRAG transmission starting at this fragment number, then the
  /// trailing HEARTBEAT.
  Frag(FragmentNumber),
  /// All fragments sent; only the trailing HEARTBEAT of a fragmented sample
  /// remains.
  Heartbeat,
}

/// Matched readers that get the same datagrams of a sample.
#[derive(PartialEq, Eq, Clone, Copy, Debug)]
enum Audience {
  /// Every reader.
  All,
  /// Those that get datagrams with this many bytes of submessages. One remote reader
  /// would else make a local one receive 1 MiB in 780 datagrams in place of 17.
  Datagrams(usize),
}

/// How far a sample was sent before it was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct EarlySent {
  sequence_number: SequenceNumber,
  id: u64,
  // The first fragment that was not sent, and to whom the others were sent.
  next: u32,
  audience: Audience,
  // All matches until then: a reader that matched later lacks what was sent.
  matches: i32,
}

/// Item 1 (DATA aggregation): outcome of attempting to coalesce one or more
/// consecutive unfragmented multicast-to-all samples into a single datagram.
pub(crate) enum BatchOutcome {
  /// The aggregated datagram was accepted by every socket. `last_seq` is the
  /// highest sequence number included in the batch.
  Sent { last_seq: SequenceNumber },
  /// A socket returned WouldBlock and back-pressure applies (reliable, or a
  /// best-effort sample that opted in to blocking). The whole datagram is
  /// all-or-nothing: `last_sent` is left unchanged so the batch is rebuilt and
  /// resent from its first sequence number on the next write-readiness wake.
  Blocked { blocked: BTreeSet<SocketId> },
  /// A socket returned WouldBlock for a best-effort batch that must not block;
  /// the whole datagram is dropped and we advance past it. `last_seq` is the
  /// highest sequence number in the dropped batch.
  Dropped { last_seq: SequenceNumber },
}

/// nonblocking-transmit: outcome of a resumable bulk send of one cache change.
pub(crate) enum SendProgress {
  /// The whole sample (all fragments + trailing HEARTBEAT) was transmitted.
  Complete,
  /// A socket returned WouldBlock. `cursor` is where to resume, `blocked` names
  /// the sockets to arm for write readiness.
  Blocked {
    cursor: SampleCursor,
    blocked: BTreeSet<SocketId>,
  },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TimedEvent {
  Heartbeat,
  CacheCleaning,
  SendRepairData { to_reader: GUID },
  SendRepairFrags { to_reader: GUID },
}

// This is used to construct an actual Writer.
// Ingredients are sendable between threads, whereas the Writer is not.
pub(crate) struct WriterIngredients {
  pub guid: GUID,
  /// Shared, flow-controlled buffer of outgoing samples. The producer end is
  /// held by the `DataWriter`; this clone is the consumer end for the Writer.
  pub send_buffer: WriterSendBuffer,
  pub topic_name: String,
  pub(crate) like_stateless: bool, // Usually false (see like_stateless attribute of Writer)
  pub qos_policies: QosPolicies,
  pub status_sender: StatusChannelSender<DataWriterStatus>,

  pub(crate) security_plugins: Option<SecurityPluginsHandle>,
}

pub(crate) struct Writer {
  pub endianness: Endianness,
  /// Configures the mode in which the
  /// Writer operates. If
  /// pushMode==true, then the Writer
  /// will push changes to the reader. If
  /// pushMode==false, changes will
  /// only be announced via heartbeats
  /// and only be sent as response to the
  /// request of a reader
  pub push_mode: bool,
  /// Protocol tuning parameter that
  /// allows the RTPS Writer to
  /// repeatedly announce the
  /// availability of data by sending a
  /// Heartbeat Message.
  pub heartbeat_period: Option<Duration>,
  /// Faster Heartbeat period used while some matched reader still has
  /// unacknowledged samples. `None` for BestEffort (no periodic Heartbeat).
  pub heartbeat_period_fast: Option<Duration>,
  /// duration to launch cache change remove from DDSCache
  pub cache_cleaning_period: Duration,
  /// Protocol tuning parameter that
  /// allows the RTPS Writer to delay
  /// the response to a request for data
  /// from a negative acknowledgment.
  pub nack_response_delay: std::time::Duration,
  pub nackfrag_response_delay: std::time::Duration,

  /// Protocol tuning parameter that
  /// allows the RTPS Writer to ignore
  /// requests for data from negative
  /// acknowledgments that arrive ‘too
  /// soon’ after the corresponding
  /// change is sent.
  // TODO: use this
  #[allow(dead_code)]
  pub nack_suppression_duration: std::time::Duration,

  /// Largest serialized payload advertised at writer creation (discovery
  /// metadata fallback). Transmit decisions use
  /// [`Self::max_unfragmented_serialized_payload`] instead.
  #[allow(dead_code)]
  pub data_max_size_serialized: usize,

  my_guid: GUID,

  /// The RTPS ReaderProxy class represents the information an RTPS
  /// StatefulWriter maintains on each matched RTPS Reader
  readers: BTreeMap<GUID, RtpsReaderProxy>,
  matched_readers_count_total: i32, // all matches ever, never decremented
  requested_incompatible_qos_count: i32, // how many times some Reader requested incompatible QoS

  // Sending mechanism
  udp_sender: Rc<UDPSender>,

  // Extra fixed unicast destinations that every outgoing message from this
  // writer is *also* sent to, bypassing route selection. Empty for all writers
  // except the built-in SPDP participant writer, which uses it for the
  // "localhost SPDP peers" (127.0.0.1:<well-known SPDP ports>) so same-host
  // participants discover each other with no external network. Unlike loopback
  // locators discovered from peers, these are unconditional (they are how we
  // bootstrap same-host discovery in the first place). See
  // `src/rtps/loopback_same_host_design.md`.
  extra_unicast_destinations: Vec<Locator>,

  // Whether route selection may prefer a same-host peer's loopback locator.
  // Mirrors the participant-builder `same_host_loopback` knob; `true` by
  // default. Passed into `DefaultRouteSelector` on every route resolution.
  prefer_loopback_same_host: bool,

  // Interface-aware transmit: per-remote observed receive interfaces/addresses,
  // shared (intra-thread) with the MessageReceiver that records them. Consulted
  // when (re)resolving each reader proxy's SendRoute.
  interface_observations: Rc<RefCell<InterfaceObservations>>,

  // Snapshot of the local interface table (shared, read-only), used to resolve
  // each matched reader's per-peer path-MTU budget when its locators change.
  local_interfaces: Rc<[IfAddr]>,

  // Minimum per-peer datagram-payload budget over all matched readers. The
  // aggregated / packed datagram is a single packet shared by every reader
  // (sent to `EntityId::UNKNOWN`), so it must fit the smallest reader's path
  // MTU. Recomputed whenever a reader is added, updated, or removed. Falls back
  // to `FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE` when there are no matched readers.
  min_datagram_payload: usize,

  // By default, this writer is a StatefulWriter (see RTPS spec section 8.4.9)
  // If like_stateless is true, then the writer mimics the behavior of a Best-Effort
  // StatelessWriter. This behavior is needed only for a single built-in discovery topic of
  // Secure DDS (topic DCPSParticipantStatelessMessage).
  // The basic idea in mimicking BestEffort & Stateless is:
  //  1. Make sure no heartbeats, acknacks, or anything related to Reliable behavior is processed
  //  2. Use the RtpsReaderProxies merely as locators, do not utilize/modify their state
  // Note that unlike the Best-Effort StatelessWriter in the specification, here we don't send
  // GAP messages. But this shouldn't matter since the expected remote Reader is also BestEffort &
  // Stateless, and therefore does not process GAP messages at all.
  like_stateless: bool,

  /// Writer can only read/write to this topic DDSHistoryCache.
  my_topic_name: String,

  /// Shared, flow-controlled buffer of outgoing samples. Filled by the
  /// `DataWriter` (admission + sequence numbering), drained/transmitted here.
  send_buffer: WriterSendBuffer,
  /// nonblocking-transmit: transmit progress within the sample `last_sent + 1`
  /// (the one currently being pushed). `Fresh` unless a large sample was
  /// interrupted mid-way by a full socket.
  sample_cursor: SampleCursor,
  // Payload bytes written a second, and since when and how many bytes that is measured.
  write_rate_bytes_per_s: u64,
  write_rate_since: (Instant, u64),
  /// nonblocking-transmit: sockets on which the last push attempt hit
  /// WouldBlock. Drained by the event loop, which enqueues this writer on those
  /// sockets' round-robin queues and arms write readiness.
  blocked_sockets: BTreeSet<SocketId>,

  // The sample that `sample_cursor` is within. It is sent to its end although a
  // write may evict it meanwhile: a KEEP_LAST writer of samples that come faster than
  // the sockets take them would else begin each one and complete none.
  partly_sent: Option<CacheChange>,
  // Whom it is being sent to.
  audience: Audience,
  // How far the sample that is not written yet was sent.
  early_sent: Option<EarlySent>,

  /// Contains timer that needs to be set to timeout with duration of
  /// self.heartbeat_period timed_event_handler sends notification when timer
  /// is up via mio channel to poll in Dp_eventWrapper this also handles
  /// writers cache cleaning timeouts.
  pub(crate) timed_event_timer: SharedTimer<DpTimerEvent>,

  qos_policies: QosPolicies,

  // Used for sending status info about messages sent
  status_sender: StatusChannelSender<DataWriterStatus>,
  // offered_deadline_status: OfferedDeadlineMissedStatus,
  participant_status_sender: StatusChannelSender<DomainParticipantStatusEvent>,

  security_plugins: Option<SecurityPluginsHandle>,
}

impl Writer {
  pub fn new(
    i: WriterIngredients,
    udp_sender: Rc<UDPSender>,
    timed_event_timer: SharedTimer<DpTimerEvent>,
    participant_status_sender: StatusChannelSender<DomainParticipantStatusEvent>,
    interface_observations: Rc<RefCell<InterfaceObservations>>,
    local_interfaces: Rc<[IfAddr]>,
  ) -> Self {
    // If writer should behave statelessly, only BestEffort QoS is currently
    // supported
    if i.like_stateless && i.qos_policies.is_reliable() {
      panic!("RustDDS internal bug: attempted to create a stateless-like Writer with Reliable QoS");
    }

    let heartbeat_period = i
      .qos_policies
      .reliability
      .and_then(|reliability| {
        if matches!(reliability, Reliability::Reliable { .. }) {
          Some(HEARTBEAT_PERIOD_SLOW)
        } else {
          None
        }
      })
      .map(|hbp| {
        // What is the logic here? Which spec section?
        if let Some(policy::Liveliness::ManualByTopic { lease_duration }) =
          i.qos_policies.liveliness
        {
          let std_dur = lease_duration;
          std_dur / 3
        } else {
          hbp
        }
      });

    // Faster Heartbeat period used while some reader is still behind. Never
    // slower than the (possibly liveliness-shortened) slow period.
    let heartbeat_period_fast = heartbeat_period.map(|slow| min(HEARTBEAT_PERIOD_FAST, slow));

    // TODO: Configuration value
    let cache_cleaning_period = Duration::from_secs(6);

    // Start periodic Heartbeat. The first one soon: a writer that continues one of a former
    // process begins with samples that its readers may lack.
    if let Some(period) = heartbeat_period_fast {
      timed_event_timer.borrow_mut().set_timeout(
        std::time::Duration::from(period),
        DpTimerEvent::Writer {
          entity_id: i.guid.entity_id,
          event: TimedEvent::Heartbeat,
        },
      );
    }
    // start periodic cache cleaning
    timed_event_timer.borrow_mut().set_timeout(
      std::time::Duration::from(cache_cleaning_period),
      DpTimerEvent::Writer {
        entity_id: i.guid.entity_id,
        event: TimedEvent::CacheCleaning,
      },
    );

    Self {
      endianness: Endianness::LittleEndian,
      push_mode: true,
      heartbeat_period,
      heartbeat_period_fast,
      cache_cleaning_period,
      nack_response_delay: NACK_RESPONSE_DELAY, // default value from dp_event_loop
      nackfrag_response_delay: NACK_FRAG_RESPONSE_DELAY,
      nack_suppression_duration: NACK_SUPPRESSION_DURATION,
      // Conservative fallback for any discovery advertisement of max sample size.
      data_max_size_serialized: FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE,
      my_guid: i.guid,
      readers: BTreeMap::new(),
      matched_readers_count_total: 0,
      requested_incompatible_qos_count: 0,
      udp_sender,
      extra_unicast_destinations: Vec::new(),
      prefer_loopback_same_host: true,
      interface_observations,
      local_interfaces,
      min_datagram_payload: FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE,
      my_topic_name: i.topic_name,
      send_buffer: i.send_buffer,
      sample_cursor: SampleCursor::Fresh,
      write_rate_bytes_per_s: 0,
      write_rate_since: (Instant::now(), 0),
      blocked_sockets: BTreeSet::new(),
      partly_sent: None,
      audience: Audience::All,
      early_sent: None,
      timed_event_timer,
      like_stateless: i.like_stateless,
      qos_policies: i.qos_policies,
      status_sender: i.status_sender,
      participant_status_sender,

      security_plugins: i.security_plugins,
    }
  }

  /// Entity id encoded as a mio token. The internal poll no longer registers
  /// per-writer tokens; the doorbell ready queue carries the id instead.
  #[allow(dead_code)]
  pub fn entity_token(&self) -> Token {
    self.guid().entity_id.as_token()
  }

  pub fn is_reliable(&self) -> bool {
    self.qos_policies.is_reliable()
  }

  /// Lists the known local (same DomainParticipant) ReaderProxies
  /// Note that local non-matching Readers are not here.
  pub fn local_readers(&self) -> Vec<EntityId> {
    let min = GUID::new_with_prefix_and_id(self.my_guid.prefix, EntityId::MIN);
    let max = GUID::new_with_prefix_and_id(self.my_guid.prefix, EntityId::MAX);

    self
      .readers
      .range((Included(min), Included(max)))
      .filter_map(|(guid, _)| {
        if guid.prefix == self.my_guid.prefix {
          Some(guid.entity_id)
        } else {
          None
        }
      })
      .collect()
  }

  // --------------------------------------------------------------
  // --------------------------------------------------------------
  // --------------------------------------------------------------

  // Schedule a timed event for this Writer on the event loop's shared timer.
  // The payload is tagged with this Writer's EntityId so the event loop can
  // route the fired event back to this Writer.
  fn schedule_timed_event(&self, after: std::time::Duration, event: TimedEvent) {
    self.timed_event_timer.borrow_mut().set_timeout(
      after,
      DpTimerEvent::Writer {
        entity_id: self.my_guid.entity_id,
        event,
      },
    );
  }

  // Time between repair rounds for one reader. See REPAIR_INTERVAL_DEFAULT.
  fn repair_interval(&self) -> std::time::Duration {
    repair_interval_for(self.qos_policies.deadline().map(|dl| dl.0))
  }

  // Arm SendRepairData for `reader_guid` unless one is already pending, so one
  // reader never has two repair rounds running in parallel.
  fn schedule_repair_data(&mut self, reader_guid: GUID, after: std::time::Duration) {
    if let Some(rp) = self.lookup_reader_proxy_mut(reader_guid) {
      if !rp.repair_data_scheduled {
        rp.repair_data_scheduled = true;
        self.schedule_timed_event(
          after,
          TimedEvent::SendRepairData {
            to_reader: reader_guid,
          },
        );
      }
    }
  }

  // Same as schedule_repair_data, for SendRepairFrags.
  fn schedule_repair_frags(&mut self, reader_guid: GUID, after: std::time::Duration) {
    if let Some(rp) = self.lookup_reader_proxy_mut(reader_guid) {
      if !rp.repair_frags_scheduled {
        rp.repair_frags_scheduled = true;
        self.schedule_timed_event(
          after,
          TimedEvent::SendRepairFrags {
            to_reader: reader_guid,
          },
        );
      }
    }
  }

  // Whether the socket a unicast repair to this reader goes out on already has
  // queued control datagrams. Repairs are never dropped, so sending more there
  // would only lengthen the queue; the round waits for the next interval.
  fn repair_backlogged(&self, reader_guid: GUID) -> bool {
    let Some(rp) = self.readers.get(&reader_guid) else {
      return false;
    };
    // Same choice as send_message_to_readers makes for DeliveryMode::Unicast.
    let route = rp.send_route();
    let uses_unicast = if route.fallback {
      rp.unicast_locator_list.iter().any(Locator::is_udp)
    } else {
      route.unicast.is_some()
    };
    if uses_unicast {
      self.udp_sender.control_backlogged(SocketId::Unicast)
    } else {
      self
        .udp_sender
        .socket_ids()
        .into_iter()
        .filter(|id| matches!(id, SocketId::Multicast(_)))
        .any(|id| self.udp_sender.control_backlogged(id))
    }
  }

  // Handle a single timed event. The shared timer is drained by the event loop,
  // which dispatches each expired event to the addressed Writer.
  pub fn handle_timed_event(&mut self, event: TimedEvent) {
    match event {
      TimedEvent::Heartbeat => {
        let readers_behind = self.handle_heartbeat_tick(false);
        // ^^ false = This is automatic heartbeat by timer, not manual by application
        // call.
        // Adaptive period: reschedule sooner (fast) while some reader still has
        // unacknowledged data so repair is prompted quickly, and back off to the
        // slow period once everyone is caught up to keep idle traffic low.
        let next_period = if readers_behind {
          self.heartbeat_period_fast.or(self.heartbeat_period)
        } else {
          self.heartbeat_period
        };
        if let Some(period) = next_period {
          self.schedule_timed_event(std::time::Duration::from(period), TimedEvent::Heartbeat);
        }
      }
      TimedEvent::CacheCleaning => {
        self.handle_cache_cleaning();
        self.schedule_timed_event(
          std::time::Duration::from(self.cache_cleaning_period),
          TimedEvent::CacheCleaning,
        );
      }
      TimedEvent::SendRepairData {
        to_reader: reader_guid,
      } => {
        let is_late_joiner = match self.lookup_reader_proxy_mut(reader_guid) {
          Some(rp) => {
            rp.repair_data_scheduled = false;
            !rp.qos().is_reliable() && !rp.repair_mode
          }
          None => return, // reader is gone
        };
        if is_late_joiner {
          // The history, see `update_reader_proxy`.
          let history = self.send_buffer.history_before(self.last_sent().plus_1());
          if let Some(rp) = self.lookup_reader_proxy_mut(reader_guid) {
            for number in history {
              rp.request_change(number);
            }
            rp.repair_mode = true;
          }
        }
        // Do not add to a send socket that already holds queued control
        // datagrams: back off and try again in the next round.
        if !self.repair_backlogged(reader_guid) {
          self.handle_repair_data_send(reader_guid);
        }
        if self
          .readers
          .get(&reader_guid)
          .is_some_and(|rp| rp.repair_mode)
        {
          self.schedule_repair_data(reader_guid, self.repair_interval());
        }
      }
      TimedEvent::SendRepairFrags {
        to_reader: reader_guid,
      } => {
        match self.lookup_reader_proxy_mut(reader_guid) {
          Some(rp) => rp.repair_frags_scheduled = false,
          None => return, // reader is gone
        }
        if !self.repair_backlogged(reader_guid) {
          self.handle_repair_frags_send(reader_guid);
        }
        if self
          .readers
          .get(&reader_guid)
          .is_some_and(RtpsReaderProxy::repair_frags_requested)
        {
          self.schedule_repair_frags(reader_guid, REPAIR_FRAGS_INTERVAL);
        }
      } // SendRepairFrags
    } // match
  } // fn

  /// This is called by dp_wrapper every time cacheCleaning message is received.
  fn handle_cache_cleaning(&mut self) {
    // Upper bound on retained samples. Use the Writer QoS ResourceLimits if it
    // specifies a positive max_samples; otherwise fall back to a generous
    // default so that a reliable Writer keeps unacknowledged samples available
    // for repair instead of evicting them eagerly. This is only a memory-safety
    // backstop, not a normal operating limit.
    let resource_limit = self
      .qos_policies
      .resource_limits()
      .map(|rl| rl.max_samples)
      .filter(|&max_samples| max_samples > 0)
      .map_or(DEFAULT_WRITER_MAX_SAMPLES, |max_samples| {
        max_samples as usize
      });

    match self.qos_policies.history {
      None => {
        // DDS Specification says this is the default History policy
        self.remove_all_acked_changes_but_keep_depth(Some(1), resource_limit);
      }
      Some(History::KeepAll) => {
        self.remove_all_acked_changes_but_keep_depth(None, resource_limit);
      }
      Some(History::KeepLast { depth: d }) => {
        self.remove_all_acked_changes_but_keep_depth(Some(d as usize), resource_limit);
      }
    }
  }

  // --------------------------------------------------------------
  // --------------------------------------------------------------
  // --------------------------------------------------------------
  // Per-peer UDP-payload budget (bytes for RTPS submessages in one datagram)
  // for a send: the specific reader's resolved path-MTU budget for a directed
  // send, or the writer-wide minimum over all matched readers for a
  // multicast-to-all send (one datagram shared by every reader).
  fn datagram_budget(&self, target_reader_opt: Option<&RtpsReaderProxy>) -> usize {
    match target_reader_opt {
      Some(reader) => reader.max_datagram_payload(),
      None => self.min_datagram_payload,
    }
  }

  // The same for a part of the readers.
  fn audience_budget(
    &self,
    target_reader_opt: Option<&RtpsReaderProxy>,
    audience: Audience,
  ) -> usize {
    match audience {
      Audience::All => self.datagram_budget(target_reader_opt),
      Audience::Datagrams(budget) => budget,
    }
  }

  // The readers that a sample is sent to when it is written.
  fn receivers(&self) -> impl Iterator<Item = &RtpsReaderProxy> {
    self.readers.values().filter(|reader| !reader.is_joining())
  }

  // Whether a sample that is written now goes to no address, so that it need not be
  // serialized.
  fn has_no_receiver(&self) -> bool {
    self.extra_unicast_destinations.is_empty() && self.receivers().next().is_none()
  }

  // The parts of the readers that a sample is written to one after the other, those
  // with the largest datagrams first.
  fn audiences(&self, payload_size: usize) -> Vec<Audience> {
    if payload_size <= self.max_unfragmented_serialized_payload(None) {
      return vec![Audience::All];
    }
    let budgets = self.receivers().map(|reader| reader.written_budget(payload_size));
    let mut budgets: Vec<usize> = budgets.collect();
    budgets.sort_unstable_by(|one, other| other.cmp(one));
    budgets.dedup();
    if budgets.is_empty() {
      return vec![Audience::All];
    }
    budgets.into_iter().map(Audience::Datagrams).collect()
  }

  /// Largest serialized payload that fits in one unfragmented DATA submessage
  /// within the per-peer datagram budget. Fragmentation is triggered only when
  /// the payload exceeds this, not when it exceeds [`FRAGMENT_SIZE`].
  fn max_unfragmented_serialized_payload(
    &self,
    target_reader_opt: Option<&RtpsReaderProxy>,
  ) -> usize {
    self.max_unfragmented_in(self.datagram_budget(target_reader_opt))
  }

  // The same for a datagram budget.
  fn max_unfragmented_in(&self, budget: usize) -> usize {
    let hb_reserve = if self.is_reliable() && !self.like_stateless {
      HEARTBEAT_SUBMESSAGE_SERIALIZED_SIZE
    } else {
      0
    };
    // A DATAFRAG whose fragment size exceeds the sample is invalid (RTPS v2.5 Section
    // 8.3.8.3.3), so such a sample is sent whole whatever the MTU is.
    budget
      .saturating_sub(hb_reserve)
      .saturating_sub(DATA_SUBMESSAGE_OVERHEAD + self.inline_qos_bytes())
      .max(FRAGMENT_SIZE)
  }

  // What the inline QoS of a sample of a topic with keys takes at most.
  fn inline_qos_bytes(&self) -> usize {
    let kind = self.my_guid.entity_id.entity_kind;
    if kind.is_with_key() && kind.is_user_defined() {
      InstanceChange::MAX_INLINE_QOS_BYTES
    } else {
      0
    }
  }

  fn num_frags_and_frag_size(&self, payload_size: usize) -> (u32, u16) {
    let fragment_size = FRAGMENT_SIZE as u32;
    let data_size = payload_size as u32; // TODO: overflow check
                                         // Formula from RTPS spec v2.5 Section "8.3.8.3.5 Logical Interpretation"
    let num_frags =
      (data_size / fragment_size) + u32::from(!data_size.is_multiple_of(fragment_size)); // rounding up
    debug!("Fragmenting {data_size} to {num_frags} x {fragment_size}");
    // TODO: Check fragment_size overflow
    (num_frags, fragment_size as u16)
  }

  // The DataWriter has admitted one or more new samples into the shared send
  // buffer and rung the doorbell. Transmit every sample we have not sent yet.
  //
  // nonblocking-transmit: this is also the resume entry point. When a socket
  // returns WouldBlock mid-way, we stop and remember exactly where (`last_sent`
  // + `sample_cursor`); the event loop re-invokes us on write readiness. Large
  // (fragmented) samples resume from the exact fragment, never restart. Blocked
  // sockets are recorded in `blocked_sockets` for the event loop to schedule.
  // Prune a completed / dropped / skipped sequence number from every matched
  // reader's `unsent_changes` set. Historically this was only done on the NACK
  // repair path (`mark_change_sent`), so a best-effort push (which never gets
  // ACKNACKs) left `unsent_changes` growing by one entry per sample forever.
  // Pruning here keeps the per-reader bookkeeping bounded on the push path too.
  fn mark_change_sent_to_all_readers(&mut self, sequence_number: SequenceNumber) {
    if self.like_stateless {
      return;
    }
    for reader in self.readers.values_mut() {
      reader.mark_change_sent(sequence_number);
    }
  }

  // Item 1: is this sample eligible for the DATA-coalescing fast path?
  // We only coalesce unfragmented samples that go to every matched reader
  // (multicast-to-all). Fragmented or single-reader samples keep the existing
  // per-sample / per-fragment path.
  fn is_aggregatable(&self, cc: &CacheChange) -> bool {
    cc.data_value.payload_size() <= self.max_unfragmented_serialized_payload(None)
      && cc.write_options.to_single_reader().is_none()
  }

  // Item 1: greedily coalesce consecutive unfragmented multicast-to-all samples
  // starting at `first_seq` (up to `last_available`) into a single RTPS
  // datagram, then send it once. Returns None if the first sample is not
  // eligible (so the caller uses the per-sample path); otherwise the batch
  // outcome. The datagram is all-or-nothing on WouldBlock.
  fn try_send_aggregated_batch(
    &mut self,
    first_seq: SequenceNumber,
    last_available: SequenceNumber,
  ) -> Option<BatchOutcome> {
    // Peek the first sample. If it is missing (evicted) or not eligible, defer
    // to the per-sample path, which knows how to skip / fragment / route it.
    let first_cc = self.send_buffer.get_by_sn(first_seq)?;
    if !self.is_aggregatable(&first_cc) {
      return None;
    }
    // Readers that join get one HEARTBEAT for a batch, so there must be one.
    if self.readers.is_empty() && self.has_no_receiver() {
      return Some(BatchOutcome::Sent {
        last_seq: first_seq,
      });
    }

    let is_reliable = self.is_reliable();
    // Reserve room for the single trailing HEARTBEAT (reliable only).
    let hb_reserve = if is_reliable && !self.like_stateless {
      HEARTBEAT_SUBMESSAGE_SERIALIZED_SIZE
    } else {
      0
    };

    let mut builder = MessageBuilder::new();
    let mut last_seq = first_seq;
    let mut count: i32 = 0;
    // The batch back-pressures (rather than dropping) if the writer is reliable
    // or any included best-effort sample opted in to blocking.
    let mut may_block = is_reliable;
    // Whether a preceding INFO_TS in this datagram is still "active". An INFO_TS
    // applies to every following DATA until the next INFO_TS, so a timestamped
    // sample followed by a non-timestamped one must emit an invalidating INFO_TS
    // to avoid the latter inheriting the former's timestamp.
    let mut ts_active = false;

    let mut seq = first_seq;
    while seq <= last_available {
      let Some(cc) = self.send_buffer.get_by_sn(seq) else {
        // A gap in the buffer (evicted). Stop the batch here and let the
        // per-sample path handle the missing sequence number next.
        break;
      };
      if !self.is_aggregatable(&cc) {
        break;
      }

      // Build this sample's INFO_TS? + DATA submessages and check the budget.
      let mut sample = MessageBuilder::new();
      let sample_ts_active = match cc.write_options.source_timestamp() {
        Some(src_ts) => {
          sample = sample.ts_msg(self.endianness, Some(src_ts));
          true
        }
        None => {
          if ts_active {
            // Invalidate the previous timestamp so this DATA is not stamped.
            sample = sample.ts_msg(self.endianness, None);
          }
          false
        }
      };
      sample = sample.data_msg(
        &cc,
        EntityId::UNKNOWN, // multicast-to-all
        self.my_guid,
        self.endianness,
        self.security_plugins.as_ref(),
      );

      // Always include the first sample (even if it alone exceeds the budget, so
      // we make progress); otherwise stop before overflowing the datagram. The
      // budget is the minimum per-peer path-MTU over all matched readers, since
      // this datagram is multicast to all of them.
      if count > 0
        && builder.len_serialized() + sample.submessage_bytes_len() + hb_reserve
          > self.min_datagram_payload
      {
        break;
      }

      builder.append(sample);
      ts_active = sample_ts_active;
      last_seq = seq;
      count += 1;
      if cc.write_options.best_effort_may_block() {
        may_block = true;
      }
      seq = seq.plus_1();
    }

    // One trailing HEARTBEAT for the whole datagram (reliable writers only).
    if hb_reserve > 0 {
      builder = builder.heartbeat_msg(
        self.entity_id(),
        self.send_buffer.advertised_first(),
        last_seq,
        self.next_heartbeat_count(),
        self.endianness,
        EntityId::UNKNOWN, // to all readers
        false,             // final_flag: request ACKNACK
        false,             // liveliness_flag
      );
    }

    let message = builder.add_header_and_build(self.my_guid.prefix);
    let blocked = self.send_message_to_readers(
      DeliveryMode::Multicast,
      message,
      &mut self.receivers(),
      TrafficClass::Bulk,
    );

    if blocked.is_empty() {
      Some(BatchOutcome::Sent { last_seq })
    } else if may_block {
      Some(BatchOutcome::Blocked { blocked })
    } else {
      Some(BatchOutcome::Dropped { last_seq })
    }
  }

  /// Whether a sample waits to be sent.
  pub fn has_unsent(&self) -> bool {
    self.send_buffer.has_unsent()
  }

  /// Sends what is pending, at most `PENDING_TURN_MAX_BYTES`. Returns whether samples
  /// are left for another turn that no full socket holds back.
  pub fn process_pending(&mut self) -> bool {
    // The doorbell enqueues this writer's id and then wakes. A sample admitted
    // while we are here pushes another id, so the next wake runs us again. The
    // shared buffer's `last_seq` is the source of truth.
    let send_buffer = self.send_buffer.clone();
    let _no_other_sender = send_buffer.direct_send().lock();
    if send_buffer.holds_unsent() {
      return false;
    }
    let receivers = self.readers.len().max(1);
    let mut turn_bytes = 0;
    while turn_bytes < PENDING_TURN_MAX_BYTES {
      let last_available = self.send_buffer.last_change_sequence_number();
      if self.last_sent() >= last_available {
        return self.send_early();
      }
      let sequence_number = self.last_sent().plus_1();

      // Item 1 (DATA aggregation): coalesce several consecutive small samples
      // into one datagram to amortize the per-sample RTPS header + syscall.
      // Only engaged when starting a sample fresh (no mid-fragment resume),
      // in push mode, and with security off (per-reader crypto complicates
      // batching). `try_send_aggregated_batch` returns None when the first
      // sample is not eligible (fragmented or destined to a single reader), in
      // which case we fall through to the per-sample path below.
      if self.push_mode
        && self.sample_cursor == SampleCursor::Fresh
        && self.security_plugins.is_none()
      {
        match self.try_send_aggregated_batch(sequence_number, last_available) {
          Some(BatchOutcome::Sent { last_seq }) | Some(BatchOutcome::Dropped { last_seq }) => {
            // Coalesced samples are multicast-to-all, so per-reader `unsent`
            // bookkeeping is a no-op (notify + mark_sent cancel out); just
            // advance the frontier. Leaves `unsent_changes` empty on the push
            // path, exactly like the per-sample path after the Item 5 fix.
            self.set_last_sent(last_seq);
            self.sample_cursor = SampleCursor::Fresh;
            self.send_buffer.set_sent_frontier(last_seq);
            self.offer_to_joining_readers();
            // About a datagram.
            turn_bytes += FRAGMENT_SIZE * receivers;
            continue;
          }
          Some(BatchOutcome::Blocked { blocked }) => {
            // All-or-nothing: do not advance `last_sent`; the event loop resumes
            // us on write readiness and the batch is rebuilt from `sequence_number`.
            self.blocked_sockets.extend(blocked);
            return false;
          }
          None => { /* first sample not aggregatable; use the per-sample path */ }
        }
      }

      // Fetch an owned clone of the sample (cheap, Bytes-backed) so we hold the
      // buffer lock only momentarily and can serialize/send without it.
      let partly_sent = self
        .partly_sent
        .take()
        .filter(|cc| cc.sequence_number == sequence_number);
      let is_resumed = partly_sent.is_some();
      if !is_resumed {
        self.audience = Audience::All;
      }
      let Some(cc) = partly_sent.or_else(|| self.send_buffer.get_by_sn(sequence_number)) else {
        // The sample is gone (e.g. evicted). Skip it; readers that need it will
        // be told via GAP during repair.
        self.set_last_sent(sequence_number);
        self.sample_cursor = SampleCursor::Fresh;
        self.send_buffer.set_sent_frontier(sequence_number);
        self.mark_change_sent_to_all_readers(sequence_number);
        if self.send_buffer.is_withdrawn(sequence_number) {
          self.tell_withdrawn(sequence_number);
        }
        continue;
      };
      let write_options = cc.write_options.clone();
      turn_bytes += cc.data_value.payload_size() * receivers;

      // Notify reader proxies once per sample (only when starting it fresh).
      if self.sample_cursor == SampleCursor::Fresh && !self.like_stateless {
        let is_large = cc.data_value.payload_size() >= LARGE_SAMPLE_BYTES;
        // Within a sample the readers stay in the groups that it is written to.
        let now = (is_large && !is_resumed).then(Instant::now);
        for reader in self.readers.values_mut() {
          reader.notify_new_cache_change(sequence_number);
          if let Some(now) = now {
            reader.retry_large_datagrams(now);
          }

          // If the data is meant for a single reader only, set others as pending
          // GAP for this sequence number.
          if let Some(single_reader_guid) = write_options.to_single_reader() {
            if reader.remote_reader_guid != single_reader_guid && reader.qos().is_reliable() {
              reader.insert_pending_gap(sequence_number);
            }
          }
        }
      }

      if self.push_mode {
        // Send data (DATA or DATAFRAGs) and a Heartbeat, resuming from the
        // current fragment cursor. Compute the send in an inner scope so the
        // immutable borrow of `self.readers` (target reader) is released before
        // we mutate our cursor/frontier below.
        // Best-effort has no acknowledgement/repair semantics, so a heartbeat
        // per sample is pure overhead (an extra submessage built and sent for
        // every DATA). Only reliable writers piggyback a heartbeat here;
        // best-effort skips it entirely.
        let send_also_heartbeat = self.is_reliable();
        let is_begun;
        let progress = {
          let target_reader_opt = match write_options.to_single_reader() {
            Some(guid) => self.readers.get(&guid), // Sending only to this reader
            None => None,                          // Sending to all matched readers
          };
          // Built-in (discovery) writers carry low-volume, delivery-critical
          // SEDP/SPDP data. Their initial push must not be dropped on WouldBlock:
          // under a flat-out user writer the send socket is perpetually congested,
          // so a dropped DiscoveredWriterData would have to be recovered by the
          // reliable heartbeat/ACKNACK/repair chain - which is itself starved
          // (the shared timer barely fires under load), leaving the remote
          // endpoint permanently undiscovered. Route discovery pushes through the
          // never-dropped Control queue (strict priority in on_socket_writable)
          // so discovery completes regardless of user-data congestion. User
          // writers keep the flow-controlled Bulk path.
          let push_class = if self.my_guid.entity_id.kind().is_built_in() {
            TrafficClass::Control
          } else {
            TrafficClass::Bulk
          };
          if self.sample_cursor == SampleCursor::Fresh
            && cc.data_value.payload_size() > self.max_unfragmented_serialized_payload(None)
          {
            self.withdraw_from_best_effort_readers(sequence_number);
          }
          let mut audiences = match target_reader_opt {
            Some(_) => vec![Audience::All],
            None => self.audiences(cc.data_value.payload_size()),
          };
          if let Audience::Datagrams(current) = self.audience {
            // The sample was sent to those before.
            audiences.retain(
              |audience| matches!(audience, Audience::Datagrams(budget) if *budget <= current),
            );
          }
          let first_audience = audiences.first().copied();
          // The cursor is within the datagrams for the group that blocked. All of its readers
          // may have left it meanwhile.
          let mut cursor = match self.audience {
            Audience::Datagrams(_) if first_audience != Some(self.audience) => SampleCursor::Fresh,
            _ => self.sample_cursor,
          };
          if let (SampleCursor::Fresh, Some(early)) = (cursor, self.early_sent) {
            if self.send_buffer.completed_early() == Some((sequence_number, early.id))
              && early.sequence_number == sequence_number
              && audiences[..] == [early.audience]
              && early.matches == self.matched_readers_count_total
            {
              cursor = SampleCursor::Frag(FragmentNumber::new(early.next));
            }
          }
          let mut progress = SendProgress::Complete;
          let mut blocked_audience = Audience::All;
          for audience in audiences {
            let (_fragmented, outcome) = self.send_cache_change_from(
              &cc,
              send_also_heartbeat,
              target_reader_opt,
              audience,
              cursor,
              push_class,
            );
            progress = outcome;
            if let SendProgress::Blocked { .. } = progress {
              blocked_audience = audience;
              break;
            }
            cursor = SampleCursor::Fresh;
          }
          self.audience = blocked_audience;
          is_begun = is_resumed || Some(blocked_audience) != first_audience;
          progress
        };
        match progress {
          SendProgress::Complete => {
            self.set_last_sent(sequence_number);
            self.sample_cursor = SampleCursor::Fresh;
            self.send_buffer.set_sent_frontier(sequence_number);
            self.mark_change_sent_to_all_readers(sequence_number);
            self.offer_to_joining_readers();
          }
          SendProgress::Blocked { cursor, blocked } => {
            // Reliable writers always back-pressure. Best-effort writers only if
            // this sample opted in via `best_effort_may_block`; otherwise the
            // DDS default applies and we drop the (rest of the) sample and move
            // on to fresher data (spec v1.4 2.2.2.4.2.11).
            if self.is_reliable() || write_options.best_effort_may_block() {
              // Stop here; resume on write readiness. Back-pressure to the
              // application follows from `sent_frontier` not advancing.
              self.sample_cursor = cursor;
              if cursor != SampleCursor::Fresh || is_begun {
                self.partly_sent = Some(cc);
              }
              self.blocked_sockets.extend(blocked);
              return false;
            }
            // Drop: advance past this sample without recording blocked sockets,
            // so no write-readiness back-pressure is applied. The unsent
            // remainder is discarded and later evicted by cache cleaning.
            self.set_last_sent(sequence_number);
            self.sample_cursor = SampleCursor::Fresh;
            self.send_buffer.set_sent_frontier(sequence_number);
            self.mark_change_sent_to_all_readers(sequence_number);
          }
        }
      } else {
        // Send Heartbeat only (control).
        // Readers will ask for the DATA with ACKNACK, if they are interested.
        let final_flag = false; // false = request that readers acknowledge with ACKNACK.
        let liveliness_flag = false; // This is not a manual liveliness assertion (DDS API call), but side-effect of
        let hb_message = MessageBuilder::new()
          .heartbeat_msg(
            self.entity_id(), // from Writer
            self.send_buffer.advertised_first(),
            self.send_buffer.last_change_sequence_number(),
            self.next_heartbeat_count(),
            self.endianness,
            EntityId::UNKNOWN, // to Reader
            final_flag,
            liveliness_flag,
          )
          .add_header_and_build(self.my_guid.prefix);
        self.send_message_to_readers(
          DeliveryMode::Multicast,
          hb_message,
          &mut self.readers.values(),
          TrafficClass::Control,
        );
        self.set_last_sent(sequence_number);
        self.sample_cursor = SampleCursor::Fresh;
        self.send_buffer.set_sent_frontier(sequence_number);
      }
    }
    self.last_sent() < self.send_buffer.last_change_sequence_number()
      || self.send_buffer.early().is_some()
  }

  // Tells the readers that a sample was withdrawn, so that none waits for it. One that still
  // lacks earlier samples asks for it when it has them; the HEARTBEAT makes it ask, because
  // no sample may follow.
  fn tell_withdrawn(&mut self, sequence_number: SequenceNumber) {
    let withdrawn = EvictedRequests::Listed(BTreeSet::from([sequence_number]));
    for reader in self.receivers().filter(|reader| reader.qos().is_reliable()) {
      if self.is_withdrawn_later(reader, sequence_number) {
        continue;
      }
      let reader_guid = reader.remote_reader_guid;
      let message = MessageBuilder::new().dst_submessage(self.endianness, reader_guid.prefix);
      let message = self
        .withdraw_msg(message, &withdrawn, reader_guid)
        .add_header_and_build(self.my_guid.prefix);
      let receiver = &mut std::iter::once(reader);
      self.send_control_to_readers(DeliveryMode::Unicast, message, receiver);
    }
    self.handle_heartbeat_tick(false);
  }

  // Sends what is complete of a sample that is not written yet, but never its last fragment,
  // so that no reader has the sample before it is written. At most
  // `PENDING_TURN_MAX_BYTES`; returns whether more is left for another turn.
  fn send_early(&mut self) -> bool {
    let Some(early) = self.send_buffer.early() else {
      return false;
    };
    let cc = early.change;
    let payload_size = cc.data_value.payload_size();
    if !self.push_mode
      || self.security_plugins.is_some()
      || self.readers.is_empty()
      || self.readers.values().any(RtpsReaderProxy::is_joining)
      || cc.sequence_number != self.last_sent().plus_1()
      || payload_size <= self.max_unfragmented_serialized_payload(None)
    {
      return false;
    }
    let matches = self.matched_readers_count_total;
    let is_same = |sent: &EarlySent| sent.id == early.id && sent.matches == matches;
    let sent = match self.early_sent.filter(is_same) {
      Some(sent) => sent,
      None => {
        let now = Instant::now();
        for reader in self.readers.values_mut() {
          reader.retry_large_datagrams(now);
        }
        // With datagrams of several sizes, each fragment would go out once for each.
        let [audience] = self.audiences(payload_size)[..] else {
          return false;
        };
        self.withdraw_from_best_effort_readers(cc.sequence_number);
        EarlySent {
          sequence_number: cc.sequence_number,
          id: early.id,
          next: 1,
          audience,
          matches,
        }
      }
    };
    let (num_frags, fragment_size) = self.num_frags_and_frag_size(payload_size);
    let complete = early.available.min(payload_size) / usize::from(fragment_size);
    let limit = (complete as u32).min(num_frags - 1);
    let budget = self.audience_budget(None, sent.audience);
    let first = SampleCursor::Frag(FragmentNumber::new(sent.next));
    let mut messages =
      FragmentationIter::new_resume(self, &cc, None, budget, false, first).through(limit);
    if !messages.fragmentation_needed() {
      return false;
    }
    let mut next = sent.next;
    let mut blocked = BTreeSet::new();
    let mut turn_bytes = 0;
    while turn_bytes < PENDING_TURN_MAX_BYTES {
      let Some((_, message)) = messages.next() else {
        break;
      };
      if !self.send_buffer.mark_early_sent(early.id) {
        break;
      }
      let is_addressed = |reader: &&RtpsReaderProxy| match sent.audience {
        Audience::All => true,
        Audience::Datagrams(budget) => reader.written_budget(payload_size) == budget,
      };
      let receivers = &mut self.receivers().filter(is_addressed);
      blocked =
        self.send_message_to_readers(DeliveryMode::Multicast, message, receivers, TrafficClass::Bulk);
      if !blocked.is_empty() {
        break;
      }
      let sent_before = next;
      next = messages.next_fragment();
      turn_bytes += (next - sent_before) as usize * usize::from(fragment_size);
    }
    let more = blocked.is_empty() && turn_bytes >= PENDING_TURN_MAX_BYTES;
    self.early_sent = Some(EarlySent { next, ..sent });
    self.blocked_sockets.extend(blocked);
    more
  }

  /// nonblocking-transmit: drain and return the sockets on which the last push
  /// attempt hit WouldBlock, so the event loop can enqueue this writer for a
  /// round-robin resume on write readiness.
  pub fn take_blocked_sockets(&mut self) -> BTreeSet<SocketId> {
    std::mem::take(&mut self.blocked_sockets)
  }

  // Returns a boolean telling if the data had to be fragmented. This one-shot
  // wrapper is used by the repair path (ACKNACK response). Repair is a
  // reliability action: it must actually reach the reader, so it goes through
  // the never-dropped `Control` queue rather than the best-effort `Bulk` path.
  // Dropping repair on WouldBlock livelocks under sustained send congestion -
  // the reader re-NACKs, the retransmit is dropped again, and reliable data
  // (e.g. builtin SEDP DiscoveredWriterData) never gets delivered while a
  // flat-out writer keeps the socket blocked.
  fn send_cache_change(
    &self,
    cc: &CacheChange,
    send_also_heartbeat: bool,
    target_reader_opt: Option<&RtpsReaderProxy>,
  ) -> bool {
    let (fragmentation_needed, _progress) = self.send_cache_change_from(
      cc,
      send_also_heartbeat,
      target_reader_opt,
      Audience::All,
      SampleCursor::Fresh,
      TrafficClass::Control,
    );
    fragmentation_needed
  }

  // Resumable bulk send of one cache change starting at `cursor`. Returns
  // whether the sample is fragmented and how far the send got (Complete, or
  // Blocked with the cursor to resume from and the sockets that blocked).
  fn send_cache_change_from(
    &self,
    cc: &CacheChange,
    send_also_heartbeat: bool,
    target_reader_opt: Option<&RtpsReaderProxy>,
    audience: Audience,
    cursor: SampleCursor,
    class: TrafficClass,
  ) -> (bool, SendProgress) {
    // First make sure that if the data is meant for a single reader only, we do
    // not accidentally send it to everyone.
    if let Some(single_reader_guid) = cc.write_options.to_single_reader() {
      match target_reader_opt {
        None => {
          error!(
            "Data is meant for the single reader {single_reader_guid:?} but a proxy for this \
             reader was not provided. Not sending anything."
          );
          return (false, SendProgress::Complete);
        }
        Some(target_reader) => {
          if single_reader_guid != target_reader.remote_reader_guid {
            error!(
              "We were asked to send data meant for the reader {single_reader_guid:?} to a \
               different reader {:?}. Not gonna happen.",
              target_reader.remote_reader_guid
            );
            return (false, SendProgress::Complete);
          }
        }
      }
    }

    if target_reader_opt.is_none() && self.has_no_receiver() {
      return (false, SendProgress::Complete);
    }

    let budget = self.audience_budget(target_reader_opt, audience);
    let messages_to_send = FragmentationIter::new_resume(
      self,
      cc,
      target_reader_opt,
      budget,
      send_also_heartbeat,
      cursor,
    );
    let fragmentation_needed = messages_to_send.fragmentation_needed();
    let payload_size = cc.data_value.payload_size();

    // Send the messages, either to all readers or just one, stopping at the
    // first message that a socket could not accept.
    for (resume_cursor, msg) in messages_to_send {
      let blocked = match target_reader_opt {
        None => self.send_message_to_readers(
          DeliveryMode::Multicast,
          msg,
          &mut self
            .receivers()
            .filter(|reader| match audience {
              Audience::All => true,
              Audience::Datagrams(budget) => reader.written_budget(payload_size) == budget,
            }),
          class,
        ),
        Some(reader_proxy) => self.send_message_to_readers(
          DeliveryMode::Unicast,
          msg,
          &mut std::iter::once(reader_proxy),
          class,
        ),
      };
      if !blocked.is_empty() {
        return (
          fragmentation_needed,
          SendProgress::Blocked {
            cursor: resume_cursor,
            blocked,
          },
        );
      }
    }
    (fragmentation_needed, SendProgress::Complete)
  }

  // --------------------------------------------------------------
  // --------------------------------------------------------------
  // --------------------------------------------------------------

  /// This is called periodically.
  ///
  /// Returns `true` if some matched reader still has unacknowledged data (i.e.
  /// a HEARTBEAT was sent to prompt repair), so the caller can reschedule the
  /// next periodic heartbeat sooner. Returns `false` when all readers are
  /// caught up.
  pub fn handle_heartbeat_tick(&mut self, is_manual_assertion: bool) -> bool {
    if self.like_stateless {
      info!(
        "Ignoring handling heartbeat tick in a stateless-like Writer, since it currently supports \
         only BestEffort QoS. topic={:?}",
        self.my_topic_name
      );
      return false;
    }
    // Reliable Stateful Writer (that tracks Readers by ReaderProxy) will not set
    // the final flag.
    let final_flag = false;
    let liveliness_flag = is_manual_assertion; // RTPS spec "8.3.7.5 Heartbeat"

    trace!(
      "heartbeat tick in topic {:?} have {} readers",
      self.topic_name(),
      self.readers.len()
    );

    let first_change = self.send_buffer.first_change_sequence_number();
    let last_change = self.send_buffer.last_change_sequence_number();

    // A BestEffort reader never acknowledges, and is owed nothing.
    let is_behind =
      |rp: &RtpsReaderProxy| rp.qos().is_reliable() && rp.all_acked_before <= last_change;

    if !self.readers.values().any(is_behind) {
      trace!("heartbeat tick: all readers have all available data.");
      false
    } else {
      // the interface to .heartbeat_msg is silly: we give ref to ourself
      // and that function then queries us.
      let hb_message = MessageBuilder::new()
        .ts_msg(self.endianness, Some(Timestamp::now()))
        .heartbeat_msg(
          self.entity_id(), // from Writer
          self.send_buffer.advertised_first(),
          self.last_advertised(),
          self.next_heartbeat_count(),
          self.endianness,
          EntityId::UNKNOWN, // to Reader
          final_flag,
          liveliness_flag,
        )
        .add_header_and_build(self.my_guid.prefix);

      debug!(
        "Writer {:?} topic={:} HEARTBEAT {:?} to {:?}",
        self.guid().entity_id,
        self.topic_name(),
        first_change,
        last_change,
      );

      // Not to those who have everything, of whom each would answer, ten times a
      // second as long as one other does not: for its lease, if that one was killed.
      // An assertion of liveliness is for all.
      let mut addressed = self
        .receivers()
        .filter(|rp| is_manual_assertion || is_behind(rp));
      self.offer_to_joining_readers();
      // In the volatile key exchange topic we cannot send to multiple readers by any
      // means, so we handle that separately.
      if self.entity_id() == EntityId::P2P_BUILTIN_PARTICIPANT_VOLATILE_SECURE_WRITER {
        for rp in addressed {
          self.send_control_to_readers(
            DeliveryMode::Unicast,
            hb_message.clone(),
            &mut std::iter::once(rp),
          );
        }
      } else {
        self.send_control_to_readers(DeliveryMode::Unicast, hb_message, &mut addressed);
      }
      true
    }
  }

  /// When receiving an ACKNACK Message indicating a Reader is missing some data
  /// samples, the Writer must respond by either sending the missing data
  /// samples, sending a GAP message when the sample is not relevant, or
  /// sending a HEARTBEAT message when the sample is no longer available
  pub fn handle_ack_nack(
    &mut self,
    reader_guid_prefix: GuidPrefix,
    ack_submessage: &AckSubmessage,
  ) {
    // sanity check
    if !self.is_reliable() || self.like_stateless {
      // Stateless-like Writer currently supports only BestEffort QoS, so ignore
      // acknack also for it
      warn!(
        "Writer {:x?} is best effort or stateless-like! It should not handle acknack messages!",
        self.entity_id()
      );
      return;
    }

    match ack_submessage {
      AckSubmessage::AckNack(ref an) => {
        // Update the ReaderProxy
        let last_seq = self.send_buffer.last_change_sequence_number(); // to avoid borrow problems
        let is_builtin = self.my_guid.entity_id.kind().is_built_in();
        let writer_is_volatile = self.qos_policies.is_volatile();
        let last_sent = self.push_mode.then_some(self.last_sent());
        let advertised_first = self.send_buffer.advertised_first();

        // sanity check requested sequence numbers
        if let Some(0) = an.reader_sn_state.iter().next().map(i64::from) {
          debug!("Request for SN zero! : {an:?}");
        }

        let reader_guid = GUID::new(reader_guid_prefix, an.reader_id);

        // sanity check
        if an.reader_sn_state.base() < SequenceNumber::from(1) {
          // This check is based on RTPS v2.5 Spec
          // Section "8.3.5.5 SequenceNumberSet" and
          // Section "8.3.8.1.3 Validity".
          // But apparently some RTPS implementations send ACKNACK with
          // reader_sn_state.base = 0 to indicate they have matched the writer,
          // so seeing these once per new writer should be ok.
          debug!(
            "ACKNACK SequenceNumberSet minimum must be >= 1, got {:?} from {:?} topic {:?}",
            an.reader_sn_state.base(),
            reader_guid,
            self.topic_name()
          );
        }

        let mut start_repair = false;
        let mut has_progressed = false;
        let mut went_back = false;
        let mut frontier_moved = false;

        if let Some(reader_proxy) = self.readers.get_mut(&reader_guid) {
          let my_topic = self.my_topic_name.as_str(); // for debugging
          if reader_proxy.last_acknack_count == Some(an.count)
            && reader_proxy.last_acknack_base == an.reader_sn_state.base()
          {
            trace!(
              "Ignoring duplicate ACKNACK count={} from {:?} topic={:?}",
              an.count,
              reader_guid,
              my_topic
            );
            return;
          }
          let is_first = reader_proxy.last_acknack_count.is_none();
          if is_first {
            reader_proxy.begin_anew_if_reset(an);
          }
          reader_proxy.last_acknack_count = Some(an.count);
          reader_proxy.last_acknack_base = an.reader_sn_state.base();

          // One that requests something, or says again what is known already, wants an
          // answer. A reader that wants too many is not answered, and what it
          // acknowledges counts all the same.
          let acknowledges_more = an.reader_sn_state.base() > reader_proxy.all_acked_before;
          let requests = an.reader_sn_state.iter().next().is_some();
          let is_one_too_many =
            (requests || !acknowledges_more) && !reader_proxy.accepts_request(Instant::now());
          if is_one_too_many && !acknowledges_more {
            return;
          }
          let acknowledgement;
          let ack_submessage = if is_one_too_many {
            acknowledgement = AckSubmessage::AckNack(AckNack {
              reader_sn_state: SequenceNumberSet::new_empty(an.reader_sn_state.base()),
              ..an.clone()
            });
            &acknowledgement
          } else {
            ack_submessage
          };

          // Mark requested SNs as "unsent changes"

          //TODO: We should drop SNs in "pending gap" from unsent changes
          // Below the first number there is nothing to acknowledge.
          let acked_before = reader_proxy.all_acked_before.max(SequenceNumber::from(1));
          went_back = an.reader_sn_state.base().max(SequenceNumber::from(1)) < acked_before;
          let serves_history =
            is_builtin || !(writer_is_volatile || reader_proxy.qos().is_volatile());
          let frontier = reader_proxy.all_acked_before;
          reader_proxy.handle_ack_nack(ack_submessage, last_seq, advertised_first, serves_history);
          frontier_moved = reader_proxy.all_acked_before != frontier;
          if is_one_too_many {
            if frontier_moved {
              self.refresh_acked_frontier();
            }
            return;
          }
          if went_back && serves_history {
            reader_proxy.offer_again(self.send_buffer.kept_before(acked_before));
          }
          has_progressed = reader_proxy.all_acked_before > acked_before;
          if let Some(last_sent) = last_sent {
            reader_proxy.forget_unsent_after(last_sent);
          }

          // Sanity Check: if the reader asked for something we did not even advertise
          // yet. TODO: This
          // checks the stored unset_changes, not presently received ACKNACK.
          if cfg!(debug_assertions) {
            if let Some(req_high) = reader_proxy.unsent_changes_iter().next_back() {
              if req_high > last_seq {
                debug!(
                  "ReaderProxy {:?} thinks we need to send {:?} but I have only up to {:?}",
                  reader_proxy.remote_reader_guid,
                  reader_proxy.unsent_changes_debug(),
                  last_seq
                );
              }
            }
            // Sanity Check 2
            if an.reader_sn_state.base() > last_seq.plus_1() {
              debug!(
                "ACKNACK from {:?} acks {:?}, but I have only up to {:?} count={:?} topic={:?}",
                reader_proxy.remote_reader_guid, an.reader_sn_state, last_seq, an.count, my_topic
              );
            }
            // Sanity check 3
            if let Some(max_req_sn) = an.reader_sn_state.iter().next_back() {
              if max_req_sn > last_seq {
                debug!(
                  "ACKNACK from {:?} requests {:?} but I have only up to {:?}",
                  reader_proxy.remote_reader_guid,
                  an.reader_sn_state.iter().collect::<Vec<SequenceNumber>>(),
                  last_seq
                );
              }
            }
          }

          if reader_proxy.ends_joining(an) {
            self.start_sending_to(reader_guid);
          } else if reader_proxy.is_joining() {
            self.offer_to_new_reader(reader_guid);
            return;
          } else if is_first {
            self.repair_what_was_lost_with_former(reader_guid);
          }
          let Some(reader_proxy) = self.readers.get_mut(&reader_guid) else {
            return;
          };
          // if we cannot send more data, we are done.
          // This is to prevent empty "repair data" messages from being sent.
          // One that only acknowledges asks for nothing, also when more has been
          // written meanwhile.
          start_repair =
            reader_proxy.all_acked_before <= last_seq && reader_proxy.first_unsent_change().is_some();
          reader_proxy.repair_mode = start_repair;
        } // if have reader_proxy

        // Every Writer, built-in or user, answers after nack_response_delay
        // (RTPS v2.5 Section 8.4.7.1.1), so that ACKNACKs arriving close
        // together are served by one repair round. If a round is already
        // pending, it also serves what this ACKNACK requested.
        if start_repair {
          if self.requests_large_sample(reader_guid, an) {
            self.send_small_datagrams_to(reader_guid_prefix);
          }
          self.schedule_repair_data(reader_guid, self.nack_response_delay);
        }

        // Acknowledgement frontier may have advanced: push it into the shared send
        // buffer so any back-pressured producer (or `wait_for_acknowledgments`
        // waiter) can make progress. It looks at every reader, so not for each of the
        // ACKNACKs that move nothing. Before the answer: a HEARTBEAT that goes with a
        // sample meanwhile would begin after what this one offers again.
        if frontier_moved {
          self.refresh_acked_frontier();
        }

        // See if we need to respond by GAP message
        if let Some(reader_proxy) = self.readers.get(&reader_guid) {
          if !reader_proxy.get_pending_gap().is_empty() {
            let gap_message = MessageBuilder::new()
              .gap_msg(
                reader_proxy.get_pending_gap(),
                self.my_guid.entity_id,
                self.endianness,
                reader_guid,
              )
              .add_header_and_build(self.my_guid.prefix);
            self.send_control_to_readers(
              DeliveryMode::Unicast,
              gap_message,
              &mut std::iter::once(reader_proxy),
            );
          }

          // An ACKNACK that requests nothing although the reader has not acknowledged
          // everything means the reader does not know what we have, typically a
          // preemptive ACKNACK from a reader that matched us after our HEARTBEAT.
          // Answer now instead of at the next heartbeat period.
          // One that has asked for fragments does know; it is answered with those.
          // So does one that acknowledges more than before. It is behind only as long
          // as the latest sample, which comes with a HEARTBEAT, is under way, and to be
          // answered at once would be its next ACKNACK: the two would never be done
          // while samples come faster than acknowledgements.
          // A base of 0 acknowledges nothing: Fast DDS repeats it seven times a second
          // until it has a HEARTBEAT, also of a writer that has nothing yet. Cyclone DDS
          // has a base of 1 then, and a VOLATILE reader of it takes all that the first
          // HEARTBEAT tells of for history: that must come before the first sample.
          // A reader that was matched anew on its side asks so as well, also one that
          // has acknowledged everything before.
          // What is not sent yet does not count: a reader requests at once all that a
          // HEARTBEAT tells of, and would get twice what is sent meanwhile.
          let last_advertised = self.last_advertised();
          let knows_nothing = an.reader_sn_state.base() < SequenceNumber::from(1);
          let has_nothing = last_advertised < SequenceNumber::from(1);
          let requests_nothing = an.reader_sn_state.iter().next().is_none();
          let requests_unoffered = an
            .reader_sn_state
            .iter()
            .any(|sn| sn < reader_proxy.all_acked_before);
          if requests_unoffered {
            // From before it was matched, or acknowledged before. The HEARTBEAT is for
            // Fast DDS, see `withdraw_msg`.
            let first_owed = reader_proxy.all_acked_before.max(SequenceNumber::from(1));
            let message =
              MessageBuilder::new().dst_submessage(self.endianness, reader_guid.prefix);
            let gap_message = self
              .begin_after_msg(message, first_owed - SequenceNumber::from(1), reader_guid)
              .gap_msg_before(
                first_owed,
                self.my_guid.entity_id,
                self.endianness,
                reader_guid,
              )
              .add_header_and_build(self.my_guid.prefix);
            self.send_control_to_readers(
              DeliveryMode::Unicast,
              gap_message,
              &mut std::iter::once(reader_proxy),
            );
          }
          if requests_nothing
            && (knows_nothing
              || has_nothing
              || went_back
              || (!has_progressed && reader_proxy.all_acked_before <= last_advertised))
            && !reader_proxy.repair_frags_requested()
          {
            let hb_message = MessageBuilder::new()
              .ts_msg(self.endianness, Some(Timestamp::now()))
              .heartbeat_msg(
                self.entity_id(),
                if went_back {
                  let first = if reader_proxy.is_offered_again() {
                    min(advertised_first, self.send_buffer.first_available())
                  } else {
                    advertised_first
                  };
                  max(first, reader_proxy.all_acked_before)
                } else {
                  max(advertised_first, reader_proxy.first_offered())
                },
                last_advertised,
                self.next_heartbeat_count(),
                self.endianness,
                reader_guid.entity_id,
                // Ask for an ACKNACK, unless it could say nothing else than this one,
                // and would be answered for ever.
                has_nothing && !knows_nothing, // final_flag
                false, // liveliness_flag
              )
              .add_header_and_build(self.my_guid.prefix);
            self.send_control_to_readers(
              DeliveryMode::Unicast,
              hb_message,
              &mut std::iter::once(reader_proxy),
            );
          }
        }
      } // AckNack
      AckSubmessage::NackFrag(ref nackfrag) => {
        // NackFrag is negative acknowledgement only, i.e. requesting missing fragments.
        let reader_guid = GUID::new(reader_guid_prefix, nackfrag.reader_id);
        let Some(reader_proxy) = self.lookup_reader_proxy_mut(reader_guid) else {
          return;
        };
        if reader_proxy.last_nackfrag_count == Some(nackfrag.count) {
          trace!(
            "Ignoring duplicate NACK_FRAG count={} from {:?}",
            nackfrag.count,
            reader_guid
          );
          return;
        }
        reader_proxy.last_nackfrag_count = Some(nackfrag.count);
        // Of a sample that was not sent yet everything is still to come, unless a group of
        // readers has it and others do not.
        let is_partly_sent = self
          .partly_sent
          .as_ref()
          .is_some_and(|cc| cc.sequence_number == nackfrag.writer_sn);
        if nackfrag.writer_sn > self.last_sent() && self.push_mode && !is_partly_sent {
          return;
        }
        let Some(cc) = self.send_buffer.get_by_sn(nackfrag.writer_sn) else {
          // The sample is gone: the repair round answers with a GAP and counts it.
          if let Some(reader_proxy) = self.lookup_reader_proxy_mut(reader_guid) {
            if nackfrag.writer_sn >= reader_proxy.all_acked_before
              && reader_proxy.accepts_request(Instant::now())
            {
              reader_proxy.request_change(nackfrag.writer_sn);
              reader_proxy.repair_mode = true;
              self.schedule_repair_data(reader_guid, self.nack_response_delay);
            }
          }
          return;
        };
        let (fragment_count, _) = self.num_frags_and_frag_size(cc.data_value.payload_size());
        let was_sent_whole = |reader: &RtpsReaderProxy| reader.was_sent_whole(nackfrag.writer_sn);
        if RtpsReaderProxy::shows_loss(&nackfrag.fragment_number_state, fragment_count)
          && self.readers.get(&reader_guid).is_some_and(was_sent_whole)
        {
          self.send_small_datagrams_to(reader_guid_prefix);
        }
        if let Some(reader_proxy) = self.lookup_reader_proxy_mut(reader_guid) {
          reader_proxy.mark_frags_requested(
            nackfrag.writer_sn,
            &nackfrag.fragment_number_state,
            fragment_count,
          );
          if reader_proxy.repair_frags_requested() {
            self.schedule_repair_frags(reader_guid, self.nackfrag_response_delay);
          }
        }
      }
    }
  }

  // Whether the first sample that was sent whole to the reader, and that it requests as a
  // whole, is a large one: none of its datagrams has arrived, as where the path drops every
  // packet of a split datagram.
  fn requests_large_sample(&self, reader_guid: GUID, an: &AckNack) -> bool {
    let Some(reader) = self.readers.get(&reader_guid) else {
      return false;
    };
    let first = (an.reader_sn_state.base() <= self.last_sent())
      .then(|| an.reader_sn_state.iter().find(|sn| reader.was_sent_whole(*sn)))
      .flatten();
    first
      .and_then(|sn| self.send_buffer.get_by_sn(sn))
      .is_some_and(|cc| cc.data_value.payload_size() >= LARGE_SAMPLE_BYTES)
  }

  // All readers of a participant are reached over the same path, and those at the same
  // address share datagrams.
  fn send_small_datagrams_to(&mut self, participant: GuidPrefix) {
    let now = Instant::now();
    let readers = self.readers.values_mut();
    readers
      .filter(|reader| reader.remote_reader_guid.prefix == participant)
      .for_each(|reader| reader.send_small_datagrams(now));
  }

  // The first sample of which a reader that is sent to from now on gets every fragment: the
  // one after the last may have been begun.
  fn first_whole_sample(&self) -> SequenceNumber {
    self.send_buffer.last_change_sequence_number().plus_1().plus_1()
  }

  // Recompute the reliable acknowledgement frontier (the smallest
  // `all_acked_before` over all matched reliable readers) and publish it to the
  // shared send buffer. Called whenever acknowledgements arrive or the set of
  // matched readers changes. `None` means there are no reliable readers, so the
  // writer is never back-pressured.
  //
  // A reader proxy reports `acked_up_to_before == 0` until its first ACKNACK;
  // `WriterSendBuffer::set_acked_frontier` reads that as 1, since sequence
  // numbers start at 1.
  //
  // TODO: On first match the first missed sample is only recovered via
  // periodic-heartbeat repair, which can take ~1 s under load.
  fn refresh_acked_frontier(&self) {
    if self.like_stateless {
      // Stateless-like writer is BestEffort: never throttle, never wait.
      self.send_buffer.set_acked_frontier(None);
      return;
    }
    let frontier = self
      .readers
      .values()
      .filter(|rp| rp.qos().is_reliable())
      .map(RtpsReaderProxy::acked_up_to_before)
      .min();
    self.send_buffer.set_acked_frontier(frontier);
    // Let go of what every reader has acknowledged now, instead of at the next cache
    // cleaning, up to 6 s later.
    if let Some(acked_before) = frontier {
      self.send_buffer.release_acknowledged(acked_before);
    }
  }

  // Send out missing data

  fn handle_repair_data_send(&mut self, to_reader: GUID) {
    if self.like_stateless {
      warn!(
        "Not sending repair data in a stateless-like Writer, since it currently supports only \
         BestEffort behavior. topic={:?}",
        self.my_topic_name
      );
      return;
    }
    // Note: here we remove the reader from our reader map temporarily.
    // Then we can mutate both the reader and other fields in self.
    // Doing a .get_mut() on the reader map would make self immutable.
    if let Some(mut reader_proxy) = self.readers.remove(&to_reader) {
      // We use a worker function to ensure that afterwards we can insert the
      // reader_proxy back. This technique ensures that all return paths lead to
      // re-insertion.
      self.handle_repair_data_send_worker(&mut reader_proxy);
      // insert reader back
      if let Some(rp) = self
        .readers
        .insert(reader_proxy.remote_reader_guid, reader_proxy)
      {
        // This should really not happen.
        error!("Reader proxy was duplicated somehow??? {rp:?}");
      }
    }
  }

  fn handle_repair_frags_send(&mut self, to_reader: GUID) {
    if self.like_stateless {
      warn!(
        "Not sending repair frags in a stateless-like Writer, since it currently supports only \
         BestEffort behavior. topic={:?}",
        self.my_topic_name
      );
      return;
    }

    // see similar function above
    if let Some(mut reader_proxy) = self.readers.remove(&to_reader) {
      let evicted_meanwhile = self.handle_repair_frags_send_worker(&mut reader_proxy);
      if let Some(rp) = self
        .readers
        .insert(reader_proxy.remote_reader_guid, reader_proxy)
      {
        // this is an internal logic error, or maybe out of memory
        error!("Reader proxy was duplicated somehow??? (frags) {rp:?}");
      }
      if evicted_meanwhile {
        self.schedule_repair_data(to_reader, self.nack_response_delay);
      }
    }
  }

  // A repair round of each kind, at once.
  pub(crate) fn repair(&mut self, to_reader: GUID) {
    self.handle_repair_data_send(to_reader);
    self.handle_repair_frags_send(to_reader);
  }

  // One repair round for a reader: send its unsent changes, lowest first, until
  // REPAIR_BATCH_MAX_BYTES have gone out (at least one change) or nothing is
  // left, which ends repair mode. GAPs and unfragmented DATA are packed into
  // datagrams of the reader's path-MTU budget; a fragmented sample goes out on
  // its own.
  fn handle_repair_data_send_worker(&mut self, reader_proxy: &mut RtpsReaderProxy) {
    // Note: The reader_proxy is now removed from readers map
    let reader_guid = reader_proxy.remote_reader_guid;

    debug!(
      "Repair data send to {reader_guid:?}. ReaderProxy Unsent changes: {:?}",
      reader_proxy.unsent_changes_debug()
    );

    // Security encodes each message for its readers as a whole, so with
    // security on every sample keeps a message of its own.
    let coalesce = self.security_plugins.is_none();
    let mut datagram: Option<MessageBuilder> = None;
    // Whether an INFO_TS in `datagram` still applies to the next DATA.
    let mut ts_active = false;
    let mut pending_gap_sent = false;
    let mut has_sent_sample = false;
    let mut round_bytes = 0;
    let round_max_bytes = if reader_proxy.is_reached_over_loopback() {
      REPAIR_BATCH_MAX_BYTES_LOOPBACK
    } else {
      self.repair_batch_max_bytes(Instant::now())
    };

    while round_bytes < round_max_bytes {
      let Some(unsent_sn) = reader_proxy.first_unsent_change() else {
        break;
      };
      let gone_before = self.send_buffer.available_after(unsent_sn);
      let pending_gaps = reader_proxy.get_pending_gap().clone();

      let mut gap = MessageBuilder::new();
      let mut cache_change = None;
      if let Some((first, before)) = reader_proxy.take_unoffered_requests() {
        // No HEARTBEAT that begins after them, as in `withdraw_msg`: the reader has no
        // fragment of these, and may still lack earlier samples of the history.
        gap = gap.gap_msg_range(first, before, self.entity_id(), self.endianness, reader_guid);
      } else if gone_before.is_some() && self.is_withdrawn_later(reader_proxy, unsent_sn) {
        reader_proxy.mark_change_sent(unsent_sn);
      } else if let Some(first_available) = gone_before {
        // The reader requests samples that are gone.
        let evicted = reader_proxy.take_evicted_requests(first_available, &self.send_buffer.withdrawn());
        debug!(
          "Reader {reader_guid:?} missed samples from {unsent_sn:?} on. I have only from \
           {first_available:?}. Topic {:?}",
          self.my_topic_name
        );
        gap = self.withdraw_msg(gap, &evicted, reader_guid);
      } else if !pending_gaps.contains(&unsent_sn) {
        match self.send_buffer.get_by_sn(unsent_sn) {
          Some(cc) => cache_change = Some(cc),
          None if self.is_withdrawn_later(reader_proxy, unsent_sn) => {
            reader_proxy.mark_change_sent(unsent_sn);
          }
          // The reader misses nothing: the sample has another number.
          None if self.send_buffer.is_withdrawn(unsent_sn) => {
            reader_proxy.mark_change_sent(unsent_sn);
            let withdrawn = EvictedRequests::Listed(BTreeSet::from([unsent_sn]));
            gap = self.withdraw_msg(gap, &withdrawn, reader_guid);
          }
          None => {
            // A write has evicted it since `gone_before` was read, or the send
            // buffer has a hole there.
            let evicted = reader_proxy.take_evicted_requests(unsent_sn.plus_1(), &BTreeSet::new());
            gap = self.withdraw_msg(gap, &evicted, reader_guid);
          }
        }
      }
      // SNs we are not going to send to this reader: announce them once per
      // round, together with the first change that goes out.
      if !pending_gaps.is_empty() && (!pending_gap_sent || pending_gaps.contains(&unsent_sn)) {
        gap = gap.gap_msg(
          &pending_gaps,
          self.entity_id(),
          self.endianness,
          reader_guid,
        );
        for sn in &pending_gaps {
          reader_proxy.mark_change_sent(*sn);
        }
        pending_gap_sent = true;
      }
      let gap_len = gap.submessage_bytes_len();
      if gap_len > 0 {
        round_bytes += gap_len;
        self.add_to_repair_datagram(&mut datagram, gap, 0, reader_proxy);
      }

      let Some(cc) = cache_change else {
        continue;
      };
      let payload_size = cc.data_value.payload_size();
      if !coalesce || payload_size > self.max_unfragmented_serialized_payload(Some(reader_proxy)) {
        // Keep the order: whatever is packed so far goes first.
        self.flush_repair_datagram(&mut datagram, reader_proxy);
        ts_active = false;
        // This emits the whole sample, including every fragment when it does
        // not fit one datagram. A later NACK_FRAG is what arms SendRepairFrags.
        self.send_cache_change(&cc, false, Some(reader_proxy));
        round_bytes += payload_size + DATA_SUBMESSAGE_OVERHEAD;
      } else {
        let source_timestamp = cc.write_options.source_timestamp();
        let mut data = MessageBuilder::new();
        if source_timestamp.is_some() {
          data = data.ts_msg(self.endianness, source_timestamp);
        }
        data = data.data_msg(
          &cc,
          reader_guid.entity_id,
          self.my_guid,
          self.endianness,
          self.security_plugins.as_ref(),
        );
        // An INFO_TS applies to every following DATA in the datagram, so a DATA
        // without a timestamp after one with must invalidate it.
        let invalidate_len = if source_timestamp.is_none() && ts_active {
          SUBMESSAGE_INFO_TS_INVALIDATE_SIZE
        } else {
          0
        };
        round_bytes += data.submessage_bytes_len();
        self.add_to_repair_datagram(&mut datagram, data, invalidate_len, reader_proxy);
        ts_active = source_timestamp.is_some();
      }
      reader_proxy.mark_change_repaired(unsent_sn, Instant::now());
      has_sent_sample = true;
    }

    if reader_proxy.first_unsent_change().is_none() {
      reader_proxy.repair_mode = false;
      // Late joiners get a history in the order that their ACKNACKs ask for.
      if has_sent_sample && self.qos_policies.is_volatile() && reader_proxy.qos().is_reliable() {
        let heartbeat = self.heartbeat_after_repair(reader_guid);
        self.add_to_repair_datagram(&mut datagram, heartbeat, 0, reader_proxy);
      }
    }
    self.flush_repair_datagram(&mut datagram, reader_proxy);
  } // fn

  // The HEARTBEAT after the last one of the samples or fragments that a reader has requested. It
  // requests an ACKNACK: repairs get lost, too, and a writer that waits for the acknowledgement
  // may send nothing else.
  fn heartbeat_after_repair(&self, reader_guid: GUID) -> MessageBuilder {
    MessageBuilder::new().heartbeat_msg(
      self.entity_id(),
      self.send_buffer.advertised_first(),
      self.last_advertised(),
      self.next_heartbeat_count(),
      self.endianness,
      reader_guid.entity_id,
      false, // final_flag
      false, // liveliness_flag
    )
  }

  // Whether a late joiner is not told yet that this sample of the history is gone, which a
  // later one of its source has replaced: the HEARTBEAT of `withdraw_msg` would withdraw
  // the earlier samples of the history, too, of which the reader may still lack fragments.
  // It requests the sample with each ACKNACK until it has those. Meanwhile it waits for
  // them in any case, because it gives samples to its application in order.
  //
  // What was written after the match is gone only when the reader is a whole window behind.
  // It does not wait then.
  fn is_withdrawn_later(&self, reader_proxy: &RtpsReaderProxy, gone: SequenceNumber) -> bool {
    let is_told_in_order =
      reader_proxy.offers_of_history(gone) || self.send_buffer.is_withdrawn(gone);
    if !reader_proxy.qos().is_reliable() || !is_told_in_order {
      return false;
    }
    let first_lacking = reader_proxy.all_acked_before;
    let first_to_come = self.send_buffer.available_after(first_lacking);
    let mut first_to_come = first_to_come.unwrap_or(first_lacking);
    while first_to_come < gone && self.send_buffer.is_withdrawn(first_to_come) {
      first_to_come = first_to_come.plus_1();
    }
    first_to_come < gone
  }

  // Tells a reader that it gets these samples no more: a HEARTBEAT that begins after
  // them, then a GAP.
  //
  // Fast DDS (2.x and 3.x) frees a sample of which it has some fragments when a GAP
  // names it, but keeps it in the list that the application takes from: the application
  // then takes freed memory, without an end, and samples out of order. At a HEARTBEAT
  // that begins after the sample it forgets it properly.
  fn withdraw_msg(
    &self,
    message: MessageBuilder,
    evicted: &EvictedRequests,
    reader_guid: GUID,
  ) -> MessageBuilder {
    let writer = self.entity_id();
    match evicted {
      EvictedRequests::Listed(listed) => match listed.last() {
        Some(last) => self.begin_after_msg(message, *last, reader_guid).gap_msg(
          listed,
          writer,
          self.endianness,
          reader_guid,
        ),
        None => message,
      },
      EvictedRequests::AllFrom { first, before } => self
        .begin_after_msg(message, *before - SequenceNumber::from(1), reader_guid)
        .gap_msg_range(*first, *before, writer, self.endianness, reader_guid),
    }
  }

  // A HEARTBEAT to one reader that offers what comes after `last_withdrawn`.
  fn begin_after_msg(
    &self,
    message: MessageBuilder,
    last_withdrawn: SequenceNumber,
    reader_guid: GUID,
  ) -> MessageBuilder {
    message.heartbeat_msg(
      self.entity_id(),
      last_withdrawn.plus_1(),
      max(self.last_advertised(), last_withdrawn),
      self.next_heartbeat_count(),
      self.endianness,
      reader_guid.entity_id,
      true,  // final_flag: the repair round ends with a HEARTBEAT that requests ACKNACK
      false, // liveliness_flag
    )
  }

  // Most bytes of one repair round for a reader on another host.
  fn repair_batch_max_bytes(&mut self, now: Instant) -> usize {
    let written = self.send_buffer.written_bytes();
    let (since, written_then) = self.write_rate_since;
    let elapsed = now.saturating_duration_since(since);
    if elapsed >= WRITE_RATE_PERIOD {
      self.write_rate_bytes_per_s = ((written - written_then) as f64 / elapsed.as_secs_f64()) as u64;
      self.write_rate_since = (now, written);
    }
    let interval_ns = self.repair_interval().as_nanos() as u64;
    let between_rounds = self.write_rate_bytes_per_s.saturating_mul(interval_ns) / 1_000_000_000;
    usize::try_from(between_rounds * REPAIR_RATE_FACTOR)
      .unwrap_or(usize::MAX)
      .clamp(REPAIR_BATCH_MAX_BYTES, REPAIR_BATCH_MAX_BYTES_LOOPBACK)
  }

  // Append `part` to the repair datagram being built for `reader_proxy`, first
  // sending the datagram if `part` (plus `invalidate_len` bytes for an INFO_TS
  // invalidation) would not fit the reader's path-MTU budget. A fresh datagram
  // starts with INFO_DST and takes `part` even if it alone is too large. When
  // the part joins an existing datagram and `invalidate_len > 0`, an
  // invalidating INFO_TS goes in front of it.
  fn add_to_repair_datagram(
    &self,
    datagram: &mut Option<MessageBuilder>,
    part: MessageBuilder,
    invalidate_len: usize,
    reader_proxy: &RtpsReaderProxy,
  ) {
    let fits = datagram.as_ref().is_some_and(|d| {
      d.len_serialized() + invalidate_len + part.submessage_bytes_len()
        <= reader_proxy.max_datagram_payload()
    });
    if !fits {
      self.flush_repair_datagram(datagram, reader_proxy);
    }
    let started_new = datagram.is_none();
    let d = datagram.get_or_insert_with(|| {
      MessageBuilder::new().dst_submessage(self.endianness, reader_proxy.remote_reader_guid.prefix)
    });
    if !started_new && invalidate_len > 0 {
      d.append(MessageBuilder::new().ts_msg(self.endianness, None));
    }
    d.append(part);
  }

  fn flush_repair_datagram(
    &self,
    datagram: &mut Option<MessageBuilder>,
    reader_proxy: &RtpsReaderProxy,
  ) {
    if let Some(d) = datagram.take() {
      self.send_control_to_readers(
        DeliveryMode::Unicast,
        d.add_header_and_build(self.my_guid.prefix),
        &mut std::iter::once(reader_proxy),
      );
    }
  }

  // One repair round of fragments for a reader: those requested, lowest first,
  // until REPAIR_FRAGS_MAX_BYTES have gone out. Runs of fragments share a DATAFRAG,
  // and DATAFRAGs a datagram, as far as the reader's path MTU allows. The HEARTBEAT
  // after the last one makes the reader say at once what is still missing: a
  // NACK_FRAG names 256 fragments at most. Returns whether a requested sample was
  // evicted meanwhile, which needs a GAP.
  fn handle_repair_frags_send_worker(
    &mut self,
    reader_proxy: &mut RtpsReaderProxy, /* This is mutable proxy temporarily detached from the
                                         * set of reader proxies */
  ) -> bool {
    let reader_guid = reader_proxy.remote_reader_guid;
    let budget = reader_proxy.max_datagram_payload();
    let mut datagram: Option<MessageBuilder> = None;
    let mut round_bytes = 0;
    let mut evicted_meanwhile = false;

    while round_bytes < REPAIR_FRAGS_MAX_BYTES {
      // A fragment starts at a multiple of the fragment size, so a run that is
      // longer than a datagram holds is cut here.
      let max_run = (budget / FRAGMENT_SIZE).max(1) as u32;
      let Some((seq_num, start, run)) = reader_proxy.first_requested_frags(max_run) else {
        break;
      };
      let Some(cache_change) = self.send_buffer.get_by_sn(seq_num) else {
        // Evicted meanwhile: the repair round of samples answers with a GAP.
        reader_proxy.forget_requested_frags(seq_num);
        if seq_num >= reader_proxy.all_acked_before {
          reader_proxy.request_change(seq_num);
          reader_proxy.repair_mode = true;
          evicted_meanwhile = true;
        }
        continue;
      };
      // If the data is meant for a single reader only, make sure it is the one we're
      // about to send frags to.
      if let Some(single_reader_guid) = cache_change.write_options.to_single_reader() {
        if single_reader_guid != reader_guid {
          error!(
            "We were asked to send datafrags meant for the reader {single_reader_guid:?} to a \
             different reader {reader_guid:?}. Not gonna happen."
          );
          reader_proxy.forget_requested_frags(seq_num);
          continue;
        }
      }
      let payload_size = cache_change.data_value.payload_size();
      let (fragment_count, fragment_size) = self.num_frags_and_frag_size(payload_size);
      let Ok(sample_size) = u32::try_from(payload_size) else {
        reader_proxy.forget_requested_frags(seq_num);
        continue;
      };

      // Generate datafrag message
      let mut part = MessageBuilder::new();
      if let Some(src_ts) = cache_change.write_options.source_timestamp() {
        part = part.ts_msg(self.endianness, Some(src_ts));
      } else if datagram.is_some() {
        // An INFO_TS of the sample before would apply to this one, too.
        part = part.ts_msg(self.endianness, None);
      }
      let header_len = part.len_serialized() + INFO_DST_SUBMESSAGE_SIZE;
      let count = frags_per_datafrag(
        header_len + self.inline_qos_bytes(),
        budget,
        start,
        fragment_count,
        fragment_size,
        payload_size,
      )
      .min(run);
      part = part.data_frag_msg(
        &cache_change,
        reader_guid.entity_id, // reader
        self.my_guid,          // writer
        FragmentNumber::new(start),
        count as u16,
        fragment_size,
        sample_size,
        self.endianness,
        self.security_plugins.as_ref(),
      );
      round_bytes += part.submessage_bytes_len();
      // Repair frags are a reliability action (response to a NACK_FRAG), so they
      // must actually reach the reader: they use the never-dropped `Control` queue.
      self.add_to_repair_datagram(&mut datagram, part, 0, reader_proxy);
      if self.security_plugins.is_some() {
        // Security encodes each message for its readers as a whole.
        self.flush_repair_datagram(&mut datagram, reader_proxy);
      }
      reader_proxy.mark_frags_sent(seq_num, start, count);
    }

    if round_bytes > 0 && !reader_proxy.repair_frags_requested() {
      let heartbeat = self.heartbeat_after_repair(reader_guid);
      self.add_to_repair_datagram(&mut datagram, heartbeat, 0, reader_proxy);
    }
    self.flush_repair_datagram(&mut datagram, reader_proxy);
    evicted_meanwhile
  } // fn

  // The last sample that a HEARTBEAT may speak of. In push mode that is the last
  // one that was sent: a reader asks at once for those that it hears of and does
  // not have, and would be sent what waits here a second time.
  fn last_advertised(&self) -> SequenceNumber {
    let last = self.send_buffer.last_change_sequence_number();
    if self.push_mode {
      // A HEARTBEAT must not end before one before its first sample (RTPS v2.5
      // Section 8.3.8.6.3), and samples can be evicted before they were sent.
      let before_first = self.send_buffer.first_change_sequence_number() - SequenceNumber::new(1);
      max(min(last, self.last_sent()), before_first)
    } else {
      last
    }
  }

  /// Removes permanently cacheChanges from DDSCache.
  /// CacheChanges can be safely removed only if they are acked by all readers.
  /// (Reliable) Depth is QoS policy History depth.
  /// Returns SequenceNumbers of removed CacheChanges
  /// This is called repeatedly by handle_cache_cleaning action.
  fn remove_all_acked_changes_but_keep_depth(
    &mut self,
    depth: Option<usize>,
    resource_limit: usize,
  ) {
    let first_keeper = if !self.like_stateless {
      // Regular stateful writer behavior
      // All readers have acked up to this point (SequenceNumber). BestEffort ones
      // never do, and are owed nothing: counting them would keep every
      // announcement of the participant, one each 2 s, up to the resource limit.
      let acked_by_all_readers = self
        .readers
        .values()
        .filter(|reader| self.is_reliable() && reader.qos().is_reliable())
        .map(RtpsReaderProxy::acked_up_to_before)
        .min()
        .unwrap_or_else(|| self.send_buffer.last_change_sequence_number().plus_1());
      // If all readers have acked all up to before 5, and depth is 5, we need
      // to keep samples 0..4, i.e. from acked_up_to_before - depth .
      let depth_keeper = if let Some(depth) = depth {
        max(
          acked_by_all_readers - SequenceNumber::from(depth),
          self.send_buffer.first_change_sequence_number(),
        )
      } else {
        // try to keep all
        self.send_buffer.first_change_sequence_number()
      };
      // Never evict samples that some matched (reliable) reader has not yet
      // acknowledged: clamp the keeper to at most the all-acked point so that
      // unacknowledged samples remain available for repair. The resource-limit
      // backstop below still bounds memory if a reader falls hopelessly behind.
      min(depth_keeper, acked_by_all_readers)
    } else {
      // Stateless-like writer currently supports only BestEffort behavior, so here we
      // make it explicit that it does not care about acked sequence numbers
      let depth = depth.unwrap_or(0);
      max(
        self.send_buffer.last_change_sequence_number() - SequenceNumber::from(depth),
        self.send_buffer.first_change_sequence_number(),
      )
    };
    // Memory-safety backstop: never retain more than `resource_limit` samples,
    // even if that forces eviction of still-unacknowledged data.
    let first_keeper = max(
      max(
        first_keeper,
        self.send_buffer.last_change_sequence_number() - SequenceNumber::from(resource_limit),
      ),
      SequenceNumber::zero(),
    );
    debug!(
      "WriterSendBuffer: cleaning before {first_keeper:?} topic={:?}",
      self.topic_name()
    );
    // actual cleaning
    self.send_buffer.remove_changes_before(first_keeper);
  }

  pub(crate) fn next_heartbeat_count(&self) -> i32 {
    self.send_buffer.direct_send().next_heartbeat_count()
  }

  // Highest sequence number that was fully transmitted (push mode), by this Writer
  // or by the thread that wrote it. Samples with `seq` in
  // `(last_sent, send_buffer.last]` are pending send.
  fn last_sent(&self) -> SequenceNumber {
    self.send_buffer.direct_send().last_sent()
  }

  fn set_last_sent(&self, last_sent: SequenceNumber) {
    self.send_buffer.direct_send().set_last_sent(last_sent);
  }

  // Says what the threads that write may send without the event loop: to every
  // matched reader a datagram by unicast, as `send_message_to_readers` would.
  fn refresh_direct_plan(&self) {
    *self.send_buffer.direct_send().lock() = self.direct_plan();
  }

  fn direct_plan(&self) -> Option<Plan> {
    if self.my_guid.entity_id.kind().is_built_in()
      || self.like_stateless
      || !self.push_mode
      || self.security_plugins.is_some()
      || !self.extra_unicast_destinations.is_empty()
      || self.readers.is_empty()
    {
      return None;
    }
    let mut addresses: Vec<SocketAddr> = Vec::new();
    let mut offers: Vec<Offer> = Vec::new();
    for reader in self.readers.values() {
      // Readers of this participant get samples from its cache.
      if reader.remote_reader_guid.prefix == self.my_guid.prefix {
        return None;
      }
      let route = reader.send_route();
      let chosen = route.unicast.as_ref().map(std::slice::from_ref);
      let locators = if route.fallback {
        &reader.unicast_locator_list[..]
      } else {
        chosen?
      };
      let before = addresses.len();
      let mut known = 0;
      for locator in locators {
        let Locator::UdpV4(address) = locator else {
          continue; // cannot be reached
        };
        let address = SocketAddr::V4(*address);
        if address.ip().is_multicast() {
          return None;
        }
        if reader.is_joining() {
          known += 1;
          offers.push(Offer {
            address,
            reader: reader.remote_reader_guid.entity_id,
            first: reader.first_offered().max(SequenceNumber::from(1)),
          });
        } else if addresses.contains(&address) {
          known += 1;
        } else {
          addresses.push(address);
        }
      }
      if addresses.len() == before && known == 0 {
        return None;
      }
    }
    Some(Plan {
      socket: self.udp_sender.unicast_socket(),
      addresses,
      offers,
      max_payload: self.max_unfragmented_serialized_payload(None),
      heartbeat: self.is_reliable(),
    })
  }

  #[cfg(feature = "security")]
  fn security_encode(
    &self,
    message: Message,
    readers: &[&RtpsReaderProxy],
  ) -> SecurityResult<Message> {
    // If we have security plugins, use them, otherwise pass through
    if let Some(security_plugins_handle) = &self.security_plugins {
      // Get the source and destination GUIDs
      let source_guid = self.guid();
      let destination_guid_list: Vec<GUID> = readers
        .iter()
        .map(|reader_proxy| reader_proxy.remote_reader_guid)
        .collect();
      // Destructure
      let Message {
        header,
        submessages,
      } = message;

      // Encode submessages
      SecurityResult::<Vec<Vec<Submessage>>>::from_iter(submessages.iter().map(|submessage| {
        security_plugins_handle
          .get_plugins()
          .encode_datawriter_submessage(submessage.clone(), &source_guid, &destination_guid_list)
          // Convert each encoding output to a Vec of 1 or 3 submessages
          .map(Vec::from)
      }))
      // Flatten and convert back to Message
      .map(|encoded_submessages| Message {
        header,
        submessages: encoded_submessages.concat(),
      })
      // Encode message
      .and_then(|message| {
        // Convert GUIDs to GuidPrefixes
        let source_guid_prefix = source_guid.prefix;
        let destination_guid_prefix_list: Vec<GuidPrefix> = destination_guid_list
          .iter()
          .map(|guid| guid.prefix)
          .collect();
        // Encode message
        security_plugins_handle.get_plugins().encode_message(
          message,
          &source_guid_prefix,
          &destination_guid_prefix_list,
        )
      })
    } else {
      Ok(message)
    }
  }

  // nonblocking-transmit: `class` selects the queueing policy. `Control`
  // datagrams go through the never-dropped per-socket control queue; `Bulk`
  // datagrams are attempted non-blocking and the sockets that returned
  // WouldBlock are returned so the caller can stop and arm write readiness.
  // Returns the set of blocked sockets (always empty for `Control`).
  fn send_message_to_readers(
    &self,
    preferred_mode: DeliveryMode,
    message: Message,
    readers: &mut dyn Iterator<Item = &RtpsReaderProxy>,
    class: TrafficClass,
  ) -> BTreeSet<SocketId> {
    // Interface-aware transmit (see src/rtps/transmit_design.md): each reader
    // carries a pre-resolved `SendRoute`. When the route is known we emit a
    // single datagram per distinct destination (`RouteKey`), targeting one
    // interface for multicast. When the route is unknown/ambiguous we fall back
    // to the legacy path (send to every advertised locator on every interface)
    // so reachability is preserved.

    // Only the security path needs the readers materialized into a slice (to
    // pass to `security_encode`). In the default (non-security) build we iterate
    // the incoming iterator directly below, avoiding a per-sample Vec
    // allocation on the send hot path.
    #[cfg(feature = "security")]
    let readers = readers.collect::<Vec<_>>();

    let mut blocked: BTreeSet<SocketId> = BTreeSet::new();

    // User data goes to each reader by unicast. Multicast over Wi-Fi is sent at
    // the lowest rate and never repeated by the link layer, and it loads every
    // host on the network.
    let preferred_mode = if self.my_guid.entity_id.kind().is_built_in() {
      preferred_mode
    } else {
      DeliveryMode::Unicast
    };

    #[cfg(feature = "security")]
    let encoded = self.security_encode(message, &readers);
    #[cfg(not(feature = "security"))]
    let encoded: Result<Message, ()> = Ok(message);

    match encoded {
      Ok(message) => {
        let serialized = match class {
          TrafficClass::Bulk => message.write_in_pieces(self.endianness),
          // It may be queued, which takes one piece.
          TrafficClass::Control => message.write_to_vec_fast(self.endianness).map(Pieces::whole),
        };
        let pieces = match serialized {
          Ok(pieces) => pieces,
          Err(e) => {
            error!("Failed to serialize RTPS message for send: {e:?}");
            return blocked;
          }
        };
        let (datagram, buffer) = (pieces.gather(), &pieces.head);

        // De-duplication of narrowed (interface-aware) sends across readers.
        let mut sent_routes: BTreeSet<RouteKey> = BTreeSet::new();
        // De-duplication of legacy (all-interface) sends across readers.
        let mut sent_legacy: BTreeSet<Locator> = BTreeSet::new();

        macro_rules! emit_multicast {
          ($mc:expr, $iface:expr) => {
            if sent_routes.insert(RouteKey::Multicast($mc, $iface)) {
              match class {
                TrafficClass::Control => self
                  .udp_sender
                  .send_to_multicast_locator_via(buffer, &$mc, &$iface),
                TrafficClass::Bulk => blocked.extend(
                  self
                    .udp_sender
                    .try_send_to_multicast_locator_via(datagram, &$mc, &$iface),
                ),
              }
            } else {
              trace!("Already sent to multicast {:?} via {:?}", $mc, $iface);
            }
          };
        }
        macro_rules! emit_unicast {
          ($uc:expr) => {
            if sent_routes.insert(RouteKey::Unicast($uc)) {
              match class {
                TrafficClass::Control => self.udp_sender.send_to_locator(buffer, &$uc),
                TrafficClass::Bulk => {
                  blocked.extend(self.udp_sender.try_send_to_locator(datagram, &$uc));
                }
              }
            } else {
              trace!("Already sent to unicast {:?}", $uc);
            }
          };
        }
        macro_rules! send_legacy {
          ($locs:expr) => {
            for loc in $locs.iter() {
              if sent_legacy.insert(*loc) {
                match class {
                  TrafficClass::Control => self.udp_sender.send_to_locator(buffer, loc),
                  TrafficClass::Bulk => {
                    blocked.extend(self.udp_sender.try_send_to_locator(datagram, loc));
                  }
                }
              } else {
                trace!("Already sent to {:?}", loc);
              }
            }
          };
        }

        for reader in readers {
          let route = reader.send_route();

          if route.fallback {
            // Unknown/ambiguous route: preserve reachability using the legacy
            // all-locators/all-interfaces path with the original precedence.
            match (
              preferred_mode,
              reader
                .unicast_locator_list
                .iter()
                .find(|l| Locator::is_udp(l)),
              reader
                .multicast_locator_list
                .iter()
                .find(|l| Locator::is_udp(l)),
            ) {
              (DeliveryMode::Multicast, _, Some(_)) => {
                send_legacy!(reader.multicast_locator_list)
              }
              (DeliveryMode::Unicast, Some(_), _) => send_legacy!(reader.unicast_locator_list),
              (_, _, Some(_)) => send_legacy!(reader.multicast_locator_list),
              (_, Some(_), _) => send_legacy!(reader.unicast_locator_list),
              (_, None, None) => warn!("send_message_to_readers: No locators for {reader:?}"),
            }
            continue;
          }

          // Narrowed route: reuse the multicast/unicast preference precedence.
          match (preferred_mode, route.multicast, route.unicast) {
            (DeliveryMode::Multicast, Some((mc, iface)), _) => emit_multicast!(mc, iface),
            (DeliveryMode::Unicast, _, Some(uc)) => emit_unicast!(uc),
            (_, _, Some(uc)) => emit_unicast!(uc),
            (_, Some((mc, iface)), _) => emit_multicast!(mc, iface),
            (_, None, None) => {
              warn!("send_message_to_readers: resolved route has no destination for {reader:?}");
            }
          }
        }

        // Fixed extra unicast destinations (SPDP localhost peers): what is for
        // everybody goes there, too, unless it was sent there already.
        if preferred_mode == DeliveryMode::Multicast {
          for locator in &self.extra_unicast_destinations {
            if !sent_legacy.contains(locator) {
              emit_unicast!(*locator);
            }
          }
        }
      }
      Err(e) => error!("Failed to send message to readers. Encoding failed: {e:?}"),
    }
    blocked
  }

  // Kept for readability at call sites that fire a single control message and
  // do not care about back-pressure (heartbeats, GAPs, repair control).
  fn send_control_to_readers(
    &self,
    preferred_mode: DeliveryMode,
    message: Message,
    readers: &mut dyn Iterator<Item = &RtpsReaderProxy>,
  ) {
    let _ = self.send_message_to_readers(preferred_mode, message, readers, TrafficClass::Control);
  }

  #[allow(dead_code)] // symmetry with send_control_to_readers; reserved for future direct bulk sends
  fn send_bulk_to_readers(
    &self,
    preferred_mode: DeliveryMode,
    message: Message,
    readers: &mut dyn Iterator<Item = &RtpsReaderProxy>,
  ) -> BTreeSet<SocketId> {
    self.send_message_to_readers(preferred_mode, message, readers, TrafficClass::Bulk)
  }

  // Send status to DataWriter or however is listening
  fn send_status(&self, status: DataWriterStatus) {
    self
      .status_sender
      .try_send_impl(status)
      .unwrap_or_else(|e| match e {
        // TODO: dead code. `StatusChannelSender::try_send` currently converts a
        // full channel into `Ok(())` (dropping the event), so this arm is never
        // reached. Kept because the handling is correct if `try_send` is ever
        // made to return `Full` again (cf. PR #442).
        TrySendError::Full(_) => (), // This is normal in case there is no receiver
        TrySendError::Disconnected(_) => {
          debug!("send_status - status receiver is disconnected");
        }
      });
  }

  /// Set the fixed unicast destinations every outgoing message is also sent to
  /// (in addition to matched readers), bypassing route selection. Used only for
  /// the built-in SPDP writer's "localhost SPDP peers". See
  /// [`Self::extra_unicast_destinations`].
  pub fn set_extra_unicast_destinations(&mut self, locators: Vec<Locator>) {
    self.extra_unicast_destinations = locators;
  }

  /// Enable/disable preferring a same-host peer's loopback locator during route
  /// selection. See the participant-builder `same_host_loopback` knob.
  pub fn set_prefer_loopback_same_host(&mut self, enabled: bool) {
    self.prefer_loopback_same_host = enabled;
  }

  pub fn update_reader_proxy(
    &mut self,
    reader_proxy: &RtpsReaderProxy,
    requested_qos: &QosPolicies,
  ) {
    debug!(
      "update_reader_proxy topic={:?} reader_proxy={reader_proxy:?}",
      self.my_topic_name
    );
    match self.qos_policies.compliance_failure_wrt(requested_qos) {
      // matched QoS
      None => {
        let new_reader = self.matched_reader_update(reader_proxy);
        // A (possibly new) reliable reader changes the acknowledgement frontier
        // and thus the back-pressure window.
        self.refresh_acked_frontier();
        if new_reader {
          self.matched_readers_count_total += 1;
          self.send_status(DataWriterStatus::PublicationMatched {
            // total: How many matches have been detected ever?
            total: CountWithChange::new(self.matched_readers_count_total, 1),
            // current: How many readers we are matched with?
            current: CountWithChange::new(self.readers.len() as i32, 1),
            reader: reader_proxy.remote_reader_guid,
            missed: 0,
          });
          self.send_participant_status(DomainParticipantStatusEvent::RemoteReaderMatched {
            local_writer: self.my_guid,
            remote_reader: reader_proxy.remote_reader_guid,
          });
          // Reliable: send an initial HEARTBEAT to the newly matched reader so it
          // can request the samples we already hold (repair/late-join). This runs
          // synchronously on the discovery-match event in the event loop, so it
          // does NOT depend on the periodic heartbeat timer - which is CPU-starved
          // under a flat-out user writer, leaving the timer to fire seldom or
          // never. Without this prompt, a reader that matches after our initial
          // send burst is never told what we have and never NACKs, so reliable
          // data (notably builtin SEDP DiscoveredWriterData) is never delivered
          // and the endpoints stay unmatched. Unicast to just the new reader.
          // A BestEffort reader takes no HEARTBEAT.
          if self.is_reliable()
            && !self.like_stateless
            && (reader_proxy.qos().is_reliable() || self.my_guid.entity_id.kind().is_built_in())
          {
            self.offer_to_new_reader(reader_proxy.remote_reader_guid);
          }
          // A BEST_EFFORT late joiner requests nothing. It is sent the history unasked,
          // when it knows this writer.
          if self.is_reliable()
            && !self.my_guid.entity_id.kind().is_built_in()
            && !self.qos_policies.is_volatile()
            && !reader_proxy.qos().is_reliable()
            && !reader_proxy.qos().is_volatile()
          {
            self.schedule_repair_data(reader_proxy.remote_reader_guid, HISTORY_SETTLING);
          }
          info!(
            "Matched new remote reader on topic={:?} reader={:?}",
            self.topic_name(),
            reader_proxy.remote_reader_guid
          );
          debug!("Reader details: {:?}", reader_proxy);
        }
      }
      Some(bad_policy_id) => {
        // QoS not compliant :(
        warn!(
          "update_reader_proxy - QoS mismatch {:?} topic={:?}",
          bad_policy_id,
          self.topic_name()
        );
        info!(
          "Reader QoS={:?} Writer QoS={:?}",
          requested_qos, self.qos_policies
        );

        self.requested_incompatible_qos_count += 1;
        self.send_status(DataWriterStatus::OfferedIncompatibleQos {
          count: CountWithChange::new(self.requested_incompatible_qos_count, 1),
          last_policy_id: bad_policy_id,
          reader: reader_proxy.remote_reader_guid,
          requested_qos: Box::new(requested_qos.clone()),
          offered_qos: Box::new(self.qos_policies.clone()),
        });
        self.send_participant_status(DomainParticipantStatusEvent::RemoteReaderQosIncompatible {
          local_writer: self.my_guid,
          remote_reader: reader_proxy.remote_reader_guid,
          requested_qos: Box::new(requested_qos.clone()),
          offered_qos: Box::new(self.qos_policies.clone()),
        });
      }
    } // match
  }

  // Update the given reader proxy. Preserve data we are tracking.
  // return value: true = reader was new, false = reader was previously known
  fn matched_reader_update(&mut self, updated_reader_proxy: &RtpsReaderProxy) -> bool {
    let mut is_new = false;
    let is_builtin = self.my_guid.entity_id.kind().is_built_in();
    let writer_keeps_history = !self.qos_policies.is_volatile();
    // The threads that write send nothing by themselves until the new reader is in
    // their plan: what they write meanwhile goes to it, too, from the event loop.
    let send_buffer = self.send_buffer.clone();
    let mut no_other_sender = send_buffer.direct_send().lock();
    // Capture the interface set once; resolution consults current observations.
    let multicast_ifaces = self.udp_sender.multicast_interfaces();
    let selector = DefaultRouteSelector::new(self.prefer_loopback_same_host);
    // Cyclone DDS has one state for all readers of a participant. Readers of our own
    // participant know this Writer.
    let new_guid = updated_reader_proxy.remote_reader_guid;
    let has_received_sibling = self
      .readers
      .range(new_guid.prefix.range())
      .any(|(_, sibling)| sibling.qos().is_reliable() && !sibling.is_joining());
    let joins = self.is_reliable()
      && !is_builtin
      && !self.like_stateless
      && updated_reader_proxy.qos().is_reliable()
      && (!writer_keeps_history || updated_reader_proxy.qos().is_volatile())
      && !has_received_sibling
      && new_guid.prefix != self.my_guid.prefix
      // It knows this Writer from the former process.
      && !send_buffer.is_former_reader(new_guid);
    let first_whole_sample = self.first_whole_sample();
    self
      .readers
      .entry(updated_reader_proxy.remote_reader_guid)
      .and_modify(|rp| {
        rp.update(updated_reader_proxy, &self.my_topic_name);
        // Locators may have changed; refresh the interface-aware send route and
        // the per-peer path-MTU budget.
        rp.resolve_send_route(
          &self.interface_observations.borrow(),
          &multicast_ifaces,
          &selector,
        );
        rp.resolve_path_mtu(&self.local_interfaces);
      })
      .or_insert_with(|| {
        is_new = true;
        let mut new_proxy = updated_reader_proxy.clone();
        // Ensure loopback stays in the gated bucket even for proxies that
        // arrive with it inline (e.g. the built-in get_builtin_reader_proxy path).
        new_proxy.normalize_loopback();
        // A VOLATILE reader begins with the present, also at a writer that keeps its
        // history for others (DDS v1.4 Section 2.2.3.4).
        let wants_history = is_builtin || (writer_keeps_history && !new_proxy.qos().is_volatile());
        let progress = self.send_buffer.reader_matched(
          new_proxy.remote_reader_guid,
          new_proxy.qos().is_reliable(),
          wants_history,
        );
        new_proxy.start_progress(progress, is_builtin);
        new_proxy.send_whole_from(first_whole_sample);
        if joins {
          new_proxy.start_joining();
        }
        new_proxy.resolve_send_route(
          &self.interface_observations.borrow(),
          &multicast_ifaces,
          &selector,
        );
        new_proxy.resolve_path_mtu(&self.local_interfaces);
        new_proxy
      });
    // A reader was added or its locators changed: refresh the writer-wide
    // minimum datagram budget used for packing.
    self.min_datagram_payload = self.smallest_datagram_payload();
    *no_other_sender = self.direct_plan();
    is_new
  }

  // The first HEARTBEAT to a reader that was matched a moment ago. That of a joining
  // reader ends before its first sample.
  //
  // It is for that reader alone: another one of its participant would take samples
  // before `first` for gone, although they are yet to be sent or repaired. Cyclone DDS
  // has one state for all readers of a participant, so what they lack stays on offer.
  fn offer_to_new_reader(&self, new_reader_guid: GUID) {
    let Some(new_reader) = self.readers.get(&new_reader_guid) else {
      return;
    };
    let first_available = self.send_buffer.first_available();
    let has_sibling = self
      .readers
      .range(new_reader_guid.prefix.range())
      .any(|(guid, _)| *guid != new_reader_guid);
    let first = if has_sibling {
      self.send_buffer.advertised_first()
    } else {
      max(first_available, new_reader.first_offered())
    };
    let before_first = first - SequenceNumber::from(1);
    let last = if new_reader.is_joining() {
      before_first
    } else {
      max(self.last_advertised(), before_first)
    };
    let hb_message = MessageBuilder::new()
      .ts_msg(self.endianness, Some(Timestamp::now()))
      .heartbeat_msg(
        self.entity_id(),
        first,
        last,
        self.next_heartbeat_count(),
        self.endianness,
        new_reader_guid.entity_id,
        false, // final_flag: require the reader to respond with ACKNACK
        false, // liveliness_flag
      )
      .add_header_and_build(self.my_guid.prefix);
    self.send_control_to_readers(
      DeliveryMode::Unicast,
      hb_message,
      &mut std::iter::once(new_reader),
    );
  }

  // Withdraws older samples from the BEST_EFFORT readers of a RELIABLE writer, before
  // a sample in fragments is sent.
  //
  // Cyclone DDS (0.10) keeps the fragments of incomplete samples of a RELIABLE writer
  // until a GAP, or a HEARTBEAT to one of its RELIABLE readers, withdraws them. Once it
  // has 16 incomplete samples it discards the fragments of all newer ones, so that a
  // BEST_EFFORT reader behind a lossy link would get nothing any more.
  //
  // The state is one for all readers of a participant: a RELIABLE one still needs what
  // it lacks, and gets HEARTBEATs. A late joiner still needs the history.
  fn withdraw_from_best_effort_readers(&self, next: SequenceNumber) {
    let before = next - SequenceNumber::from(SAMPLES_LEFT_TO_BEST_EFFORT);
    if !self.is_reliable() || self.like_stateless || before <= SequenceNumber::from(1) {
      return;
    }
    for (guid, reader) in &self.readers {
      let mut siblings = self.readers.range(guid.prefix.range());
      if siblings.any(|(_, sibling)| sibling.qos().is_reliable() || sibling.repair_mode) {
        continue;
      }
      let message = MessageBuilder::new()
        .dst_submessage(self.endianness, guid.prefix)
        .gap_msg_before(before, self.entity_id(), self.endianness, *guid)
        .add_header_and_build(self.my_guid.prefix);
      self.send_control_to_readers(DeliveryMode::Unicast, message, &mut std::iter::once(reader));
    }
  }

  // With each sample, so that a joining reader has a HEARTBEAT as soon as it knows the
  // Writer. Fast DDS repeats its own request each 140 ms.
  fn offer_to_joining_readers(&self) {
    for joining in self.readers.values().filter(|rp| rp.is_joining()) {
      self.offer_to_new_reader(joining.remote_reader_guid);
    }
  }

  // What a former process has sent and the reader has not received goes to it as a repair, without
  // a wait for its request.
  fn repair_what_was_lost_with_former(&mut self, reader_guid: GUID) {
    let first_retained = self.send_buffer.first_change_sequence_number();
    let last = min(self.send_buffer.former_last(), self.last_sent());
    if let Some(reader) = self.readers.get_mut(&reader_guid) {
      let first = max(first_retained, reader.all_acked_before);
      reader.request_changes(first..last.plus_1());
    }
  }

  // The reader has joined: what was written meanwhile goes to it as a repair, and what
  // follows when it is written.
  fn start_sending_to(&mut self, reader_guid: GUID) {
    let send_buffer = self.send_buffer.clone();
    let mut no_other_sender = send_buffer.direct_send().lock();
    let last = self.last_sent();
    let first_retained = send_buffer.first_change_sequence_number();
    let first_whole_sample = self.first_whole_sample();
    if let Some(reader) = self.readers.get_mut(&reader_guid) {
      reader.send_whole_from(first_whole_sample);
      let first = max(first_retained, reader.all_acked_before);
      reader.request_changes(first..last.plus_1());
    }
    *no_other_sender = self.direct_plan();
  }

  /// Recompute [`min_datagram_payload`](Self::min_datagram_payload) as the
  /// minimum per-peer budget over all matched readers. The aggregated/packed
  /// datagram is one packet multicast to every reader, so it must fit the
  /// smallest path MTU. With no matched readers, fall back to the default.
  fn recompute_min_datagram_payload(&mut self) {
    self.min_datagram_payload = self.smallest_datagram_payload();
    self.refresh_direct_plan();
  }

  fn smallest_datagram_payload(&self) -> usize {
    let budgets = self
      .readers
      .values()
      .map(RtpsReaderProxy::max_datagram_payload);
    budgets
      .min()
      .unwrap_or(FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE)
  }

  /// Refresh the [`SendRoute`](crate::rtps::transmit::SendRoute) of every
  /// matched reader belonging to `prefix`. Called when fresh interface
  /// observations for that participant may have arrived (e.g. periodic SPDP).
  pub fn recompute_routes_for(&mut self, prefix: GuidPrefix) {
    let multicast_ifaces = self.udp_sender.multicast_interfaces();
    let selector = DefaultRouteSelector::new(self.prefer_loopback_same_host);
    {
      let observations = self.interface_observations.borrow();
      for rp in self.readers.values_mut() {
        if rp.remote_reader_guid.prefix == prefix {
          rp.resolve_send_route(&observations, &multicast_ifaces, &selector);
          rp.resolve_path_mtu(&self.local_interfaces);
        }
      }
    }
    self.recompute_min_datagram_payload();
  }

  /// Resolves the route to each matched reader anew, for the interfaces that this
  /// host has now.
  pub fn follow_interfaces(&mut self, interfaces: Rc<[IfAddr]>) {
    self.local_interfaces = interfaces;
    let multicast_ifaces = self.udp_sender.multicast_interfaces();
    let selector = DefaultRouteSelector::new(self.prefer_loopback_same_host);
    {
      let observations = self.interface_observations.borrow();
      for rp in self.readers.values_mut() {
        rp.resolve_send_route(&observations, &multicast_ifaces, &selector);
        rp.resolve_path_mtu(&self.local_interfaces);
      }
    }
    self.recompute_min_datagram_payload();
  }

  // Returns how many samples add to the reader's overrun by that.
  fn matched_reader_remove(&mut self, guid: GUID) -> u64 {
    let removed = self.readers.remove(&guid);
    // Before `refresh_acked_frontier`, which releases what only this reader lacks.
    let missed = removed.as_ref().map_or(0, |reader| {
      self.send_buffer.reader_unmatched(guid, reader.unknown_from())
    });
    if let Some(ref removed_reader) = removed {
      info!(
        "Removed reader proxy. topic={:?} reader={:?}",
        self.topic_name(),
        removed_reader.remote_reader_guid,
      );
      debug!("Removed reader proxy details: {removed_reader:?}");
    }
    #[cfg(feature = "security")]
    if let Some(security_plugins_handle) = &self.security_plugins {
      security_plugins_handle
        .get_plugins()
        .unregister_remote_reader(&self.my_guid, &guid)
        .unwrap_or_else(|e| error!("{e}"));
    }
    missed
  }

  pub fn reader_lost(&mut self, guid: GUID) {
    if self.readers.contains_key(&guid) {
      info!(
        "reader_lost topic={:?} reader={:?}",
        self.topic_name(),
        guid
      );
      let missed = self.matched_reader_remove(guid);
      // Removing a reader may relax (raise) the writer-wide minimum budget.
      self.recompute_min_datagram_payload();
      // self.matched_readers_count_total -= 1; // this never decreases
      self.send_status(DataWriterStatus::PublicationMatched {
        total: CountWithChange::new(self.matched_readers_count_total, 0),
        current: CountWithChange::new(self.readers.len() as i32, -1),
        reader: guid,
        missed,
      });
    }
    // A matched reader going away may complete a pending wait_for_acknowledgments
    // and may relax back-pressure: recompute the acknowledgement frontier.
    self.refresh_acked_frontier();
  }

  // Entire remote participant was lost.
  // Remove all remote readers belonging to it.
  pub fn participant_lost(&mut self, guid_prefix: GuidPrefix) {
    let lost_readers: Vec<GUID> = self
      .readers
      .range(guid_prefix.range())
      .map(|(g, _)| *g)
      .collect();
    for reader in lost_readers {
      self.reader_lost(reader);
    }
  }

  fn lookup_reader_proxy_mut(&mut self, guid: GUID) -> Option<&mut RtpsReaderProxy> {
    self.readers.get_mut(&guid)
  }

  pub fn topic_name(&self) -> &String {
    &self.my_topic_name
  }

  fn send_participant_status(&self, event: DomainParticipantStatusEvent) {
    self
      .participant_status_sender
      .try_send(event)
      .unwrap_or_else(|e| error!("Cannot report participant status: {e:?}"));
  }

  // TODO
  // This is placeholder for not-yet-implemented feature.
  //
  // pub fn reset_offered_deadline_missed_status(&mut self) {
  //   self.offered_deadline_status.reset_change();
  // }
}

impl RTPSEntity for Writer {
  fn guid(&self) -> GUID {
    self.my_guid
  }
}

impl HasQoSPolicy for Writer {
  fn qos(&self) -> QosPolicies {
    self.qos_policies.clone()
  }
}

// Serialized overhead of one DATA submessage excluding its serialized payload
// and inline QoS. Conservative fixed fields only; underestimating inline QoS
// causes earlier fragmentation (safe), never datagram overflow.
const DATA_SUBMESSAGE_OVERHEAD: usize = 48;

// Submessage header and GUID prefix.
const INFO_DST_SUBMESSAGE_SIZE: usize = 16;

// How many of the newest samples are not withdrawn from BEST_EFFORT readers, because
// their fragments may still be on the way. Half of the 16 incomplete samples that
// Cyclone DDS keeps.
const SAMPLES_LEFT_TO_BEST_EFFORT: i64 = 8;

// An invalidating INFO_TS is a bare submessage header.
const SUBMESSAGE_INFO_TS_INVALIDATE_SIZE: usize = 4;

// Serialized overhead of one DATAFRAG submessage excluding its payload:
// submessage header (4) + extraFlags (2) + octetsToInlineQos (2) + readerId (4)
// + writerId (4) + writerSN (8) + fragmentStartingNum (4) +
// fragmentsInSubmessage (2) + fragmentSize (2) + sampleSize (4) = 36 bytes.
// Inline QoS (e.g. related sample identity) would add more; ignoring it only
// risks a slight overestimate, which degrades to benign IP fragmentation rather
// than data loss.
const DATAFRAG_SUBMESSAGE_OVERHEAD: usize = 36;

// A fifth of a finite, positive Deadline, clamped to
// [REPAIR_INTERVAL_MIN, REPAIR_INTERVAL_MAX]. No Deadline, INFINITE, zero or
// negative give REPAIR_INTERVAL_DEFAULT.
fn repair_interval_for(deadline: Option<Duration>) -> std::time::Duration {
  match deadline {
    Some(d) if d != Duration::INFINITE && d > Duration::ZERO => {
      std::time::Duration::from(d / 5).clamp(REPAIR_INTERVAL_MIN, REPAIR_INTERVAL_MAX)
    }
    _ => REPAIR_INTERVAL_DEFAULT,
  }
}

// Adaptive packing: how many contiguous fragments (starting at 1-based `start`)
// to place in a single DATAFRAG submessage so the datagram stays within
// `budget` bytes. `header_len` is the datagram size already committed (RTPS
// header + optional INFO_TS/INFO_DST). The fragment *size* is constant; only
// the count adapts. Always returns at least 1 (we emit progress even if a lone
// fragment exceeds the budget, letting IP fragmentation handle the overflow).
fn frags_per_datafrag(
  header_len: usize,
  budget: usize,
  start: u32,
  num_frags: u32,
  fragment_size: u16,
  data_size: usize,
) -> u32 {
  let fragment_size = fragment_size as usize;
  let remaining_frags = num_frags - (start - 1);
  // Bytes available in this datagram for the DATAFRAG payload.
  let payload_cap = budget
    .saturating_sub(header_len)
    .saturating_sub(DATAFRAG_SUBMESSAGE_OVERHEAD);
  // Bytes from the first fragment of this run to the end of the sample.
  let start_byte = (start as usize - 1) * fragment_size;
  let bytes_to_end = data_size.saturating_sub(start_byte);

  let k = if payload_cap >= bytes_to_end {
    // The rest of the sample (including a shorter final fragment) fits.
    remaining_frags
  } else {
    // Only whole fragments fit; take as many as the budget allows (>= 1).
    ((payload_cap / fragment_size) as u32).max(1)
  };
  k.min(remaining_frags)
}

struct FragmentationIter<'a> {
  writer: &'a Writer,
  cache_change: &'a CacheChange,
  target_reader_opt: Option<&'a RtpsReaderProxy>,
  // Bytes for submessages in one datagram.
  budget: usize,
  reader_entity_id: EntityId,
  send_heartbeat: bool,
  finished: bool,
  // The last fragment that may be sent.
  through: u32,
  state: FragmentationIterState,
}

impl<'a> FragmentationIter<'a> {
  // nonblocking-transmit: build an iterator that resumes at `cursor`. `Fresh`
  // yields everything (leading GAP for a single reader, all DATAFRAGs, trailing
  // HEARTBEAT, or a single DATA for an unfragmented sample). `Frag(n)` skips the
  // GAP and earlier fragments and resumes at fragment `n`. `Heartbeat` yields
  // only the trailing HEARTBEAT.
  fn new_resume(
    writer: &'a Writer,
    cache_change: &'a CacheChange,
    target_reader_opt: Option<&'a RtpsReaderProxy>,
    budget: usize,
    send_heartbeat: bool,
    cursor: SampleCursor,
  ) -> Self {
    // The EntityId of the destination
    let reader_entity_id =
      target_reader_opt.map_or(EntityId::UNKNOWN, |p| p.remote_reader_guid.entity_id);

    let data_size = cache_change.data_value.payload_size();
    let fragmentation_needed = data_size > writer.max_unfragmented_in(budget);

    let state = if fragmentation_needed {
      let fragmented = match cursor {
        SampleCursor::Fresh => FragmentedState::TargetReader,
        SampleCursor::Frag(start) => {
          let (num_frags, fragment_size) = writer.num_frags_and_frag_size(data_size);
          FragmentedState::Fragments {
            next: u32::from(start),
            num_frags,
            fragment_size,
          }
        }
        SampleCursor::Heartbeat => FragmentedState::Heartbeat,
      };
      FragmentationIterState::Fragmented(fragmented, data_size)
    } else {
      FragmentationIterState::Unfragmented
    };

    Self {
      writer,
      cache_change,
      target_reader_opt,
      budget,
      state,
      reader_entity_id,
      finished: false,
      through: u32::MAX,
      send_heartbeat,
    }
  }

  // Ends before the first datagram with a fragment after this one.
  fn through(mut self, last: u32) -> Self {
    self.through = last;
    self
  }

  // The first fragment of the next datagram.
  fn next_fragment(&self) -> u32 {
    match self.state {
      FragmentationIterState::Fragmented(FragmentedState::Fragments { next, .. }, _) => next,
      _ => 1,
    }
  }

  fn fragmentation_needed(&self) -> bool {
    matches!(self.state, FragmentationIterState::Fragmented(..))
  }
}

enum FragmentationIterState {
  Fragmented(FragmentedState, usize),
  Unfragmented,
}

enum FragmentedState {
  TargetReader,
  // Adaptive-packing DATAFRAG cursor: the next 1-based fragment number to send,
  // the total fragment count, and the (constant) fragment size. Each `next()`
  // emits one datagram carrying a single DATAFRAG submessage that packs as many
  // contiguous fragments as the destination's path-MTU budget allows.
  Fragments {
    next: u32,
    num_frags: u32,
    fragment_size: u16,
  },
  Heartbeat,
}

impl<'a> Iterator for FragmentationIter<'a> {
  // nonblocking-transmit: each item carries the cursor to resume from should
  // this message be the one that a socket cannot accept.
  type Item = (SampleCursor, Message);
  fn next(&mut self) -> Option<Self::Item> {
    if self.finished {
      return None;
    }

    let cc = self.cache_change;
    let writer = self.writer;
    let target_reader_opt = self.target_reader_opt;
    let reader_entity_id = self.reader_entity_id;
    let send_heartbeat = self.send_heartbeat;

    match &mut self.state {
      FragmentationIterState::Fragmented(state, data_size) => {
        // fragmentation_needed: We need to send DATAFRAGs
        match state {
          FragmentedState::TargetReader => {
            let (num_frags, fragment_size) = writer.num_frags_and_frag_size(*data_size);
            *state = FragmentedState::Fragments {
              next: 1,
              num_frags,
              fragment_size,
            };

            // If sending to a single reader, add a GAP message with pending gaps if any
            if let Some(reader) = target_reader_opt {
              if !reader.get_pending_gap().is_empty() {
                let gap_msg = MessageBuilder::new()
                  .dst_submessage(writer.endianness, reader.remote_reader_guid.prefix)
                  .gap_msg(
                    reader.get_pending_gap(),
                    writer.entity_id(),
                    writer.endianness,
                    reader.remote_reader_guid,
                  )
                  .add_header_and_build(writer.my_guid.prefix);
                // Leading GAP: if it blocks, resume from Fresh (re-send GAP too).
                return Some((SampleCursor::Fresh, gap_msg));
              }
            }
            self.next()
          }
          FragmentedState::Fragments {
            next,
            num_frags,
            fragment_size,
          } => {
            if *next <= *num_frags {
              let start = *next;
              let fragment_size = *fragment_size;
              let num_frags = *num_frags;
              let data_size = *data_size;

              let mut message_builder = MessageBuilder::new(); // fresh builder

              if let Some(src_ts) = cc.write_options.source_timestamp() {
                // Add timestamp (applies to the DATAFRAG that follows).
                message_builder = message_builder.ts_msg(writer.endianness, Some(src_ts));
              }

              if let Some(reader) = target_reader_opt {
                // Add info_destination
                message_builder = message_builder
                  .dst_submessage(writer.endianness, reader.remote_reader_guid.prefix);
              }

              let budget = self.budget;
              // How many contiguous fragments (starting at `start`) fit in one
              // DATAFRAG submessage within the remaining datagram budget. Fragment
              // *size* is constant (RTPS rule); only the *count* per submessage
              // adapts to the path MTU.
              let k = frags_per_datafrag(
                message_builder.len_serialized() + writer.inline_qos_bytes(),
                budget,
                start,
                num_frags,
                fragment_size,
                data_size,
              );
              if start + k - 1 > self.through {
                return None;
              }

              let sample_size_u32 = match u32::try_from(data_size) {
                Ok(n) => n,
                Err(_) => {
                  error!("sample_to_samplestream: data_size {data_size} does not fit in u32");
                  return None;
                }
              };

              message_builder = message_builder.data_frag_msg(
                cc,
                reader_entity_id, // reader
                writer.my_guid,
                FragmentNumber::new(start),
                k as u16,
                fragment_size,
                sample_size_u32,
                writer.endianness,
                writer.security_plugins.as_ref(),
              );

              *next = start + k;
              let datafrag_msg = message_builder.add_header_and_build(writer.my_guid.prefix);
              // If this datagram blocks, resume from its first fragment next time
              // (the same K is recomputed deterministically).
              return Some((SampleCursor::Frag(FragmentNumber::new(start)), datafrag_msg));
            }
            *state = FragmentedState::Heartbeat;
            self.next()
          }
          FragmentedState::Heartbeat => {
            self.finished = true;

            // Add HEARTBEAT message if needed
            if send_heartbeat && !writer.like_stateless {
              let final_flag = false; // false = request that readers acknowledge with ACKNACK.
              let liveliness_flag = false; // This is not a manual liveliness assertion (DDS API call), but side-effect of
                                           // writing new data.
              let hb_msg = MessageBuilder::new()
                .heartbeat_msg(
                  writer.entity_id(), // from Writer
                  writer.send_buffer.advertised_first(),
                  max(cc.sequence_number, writer.last_advertised()),
                  writer.next_heartbeat_count(),
                  writer.endianness,
                  reader_entity_id, // to Reader
                  final_flag,
                  liveliness_flag,
                )
                .add_header_and_build(writer.my_guid.prefix);
              // Trailing HEARTBEAT: if it blocks, resume from Heartbeat only.
              return Some((SampleCursor::Heartbeat, hb_msg));
            }
            None
          }
        }
      }
      FragmentationIterState::Unfragmented => {
        // We can send DATA
        let mut message_builder = MessageBuilder::new();

        // If DataWriter sent us a source timestamp, then add that.
        // Timestamp has to go before Data to have effect on Data.
        if let Some(src_ts) = cc.write_options.source_timestamp() {
          message_builder = message_builder.ts_msg(writer.endianness, Some(src_ts));
        }

        if let Some(reader) = target_reader_opt {
          // Add info_destination
          message_builder =
            message_builder.dst_submessage(writer.endianness, reader.remote_reader_guid.prefix);

          // If the reader is pending GAPs on any sequence numbers, add a GAP
          if !reader.get_pending_gap().is_empty() {
            message_builder = message_builder.gap_msg(
              reader.get_pending_gap(),
              writer.entity_id(),
              writer.endianness,
              reader.remote_reader_guid,
            );
          }
        }

        // Add the DATA submessage
        message_builder = message_builder.data_msg(
          cc,
          reader_entity_id,
          writer.my_guid,
          writer.endianness,
          writer.security_plugins.as_ref(),
        );

        // Add HEARTBEAT if needed
        if send_heartbeat && !writer.like_stateless {
          let final_flag = false; // false = request that readers acknowledge with ACKNACK.
          let liveliness_flag = false; // This is not a manual liveliness assertion (DDS API call), but side-effect of
                                       // writing new data.
          message_builder = message_builder.heartbeat_msg(
            writer.entity_id(),
            writer.send_buffer.advertised_first(),
            max(cc.sequence_number, writer.last_advertised()),
            writer.next_heartbeat_count(),
            writer.endianness,
            reader_entity_id, // to Reader
            final_flag,
            liveliness_flag,
          );
        }

        let data_message = message_builder.add_header_and_build(writer.my_guid.prefix);
        self.finished = true;
        // Unfragmented DATA (+HEARTBEAT): if it blocks, resume from Fresh.
        Some((SampleCursor::Fresh, data_message))
      }
    }
  }
}

// -------------------------------------------------------------------------------------
// -------------------------------------------------------------------------------------
// -------------------------------------------------------------------------------------

#[cfg(test)]
mod tests {
  use std::thread;

  use byteorder::LittleEndian;
  use log::info;

  use super::frags_per_datafrag;

  // At a 1500-byte-MTU budget, a two-fragment "1 KB" sample (its serialized form
  // is slightly over the 1024-byte fragment size) packs BOTH fragments into one
  // DATAFRAG submessage, so it goes out in a single datagram instead of two.
  #[test]
  fn small_mtu_packs_1k_sample_into_one_datafrag() {
    // header_len 20 (RTPS header only), budget 1452, fragment size 1024,
    // sample 1036 bytes => 2 fragments.
    assert_eq!(frags_per_datafrag(20, 1452, 1, 2, 1024, 1036), 2);
  }

  // A large sample at a 1500-byte MTU can only fit one 1024-byte fragment per
  // datagram (2 * 1024 would overflow), so K collapses to 1.
  #[test]
  fn small_mtu_large_sample_one_fragment_per_datagram() {
    assert_eq!(frags_per_datafrag(20, 1452, 1, 10, 1024, 10240), 1);
  }

  // A jumbo-frame budget packs several whole fragments per DATAFRAG.
  #[test]
  fn jumbo_mtu_packs_several_fragments() {
    // budget 8952 (9000 MTU - 48), header 20 => payload_cap 8900 => 8 * 1024.
    assert_eq!(frags_per_datafrag(20, 8952, 1, 10, 1024, 10240), 8);
  }

  // The final run (including the shorter tail fragment) is taken whole when it
  // fits.
  #[test]
  fn tail_run_includes_partial_last_fragment() {
    // Fragments 9 and 10 of a 10240-byte sample: 1024 + (partial) with a large
    // budget => both fit.
    assert_eq!(frags_per_datafrag(20, 100_000, 9, 10, 1024, 10240), 2);
  }

  // A pathologically small budget still emits at least one fragment (progress),
  // accepting benign IP fragmentation for the overflow.
  #[test]
  fn tiny_budget_still_emits_one_fragment() {
    assert_eq!(frags_per_datafrag(20, 100, 1, 5, 1024, 5120), 1);
  }

  // K never exceeds the number of fragments actually remaining.
  #[test]
  fn k_capped_by_remaining_fragments() {
    assert_eq!(frags_per_datafrag(20, 100_000, 1, 3, 1024, 2600), 3);
  }

  use crate::{
    dds::{
      participant::DomainParticipant, qos::QosPolicies, topic::TopicKind,
      with_key::datawriter::DataWriter,
    },
    serialization::CDRSerializerAdapter,
    test::{random_data::*, test_domain::test_domain_id},
  };

  #[test]
  fn test_writer_receives_datawriter_cache_change_notifications() {
    let domain_participant =
      DomainParticipant::new(test_domain_id(0)).expect("Failed to create participant");
    let qos = QosPolicies::qos_none();
    let _default_dw_qos = QosPolicies::qos_none();

    let publisher = domain_participant
      .create_publisher(&qos)
      .expect("Failed to create publisher");
    let topic = domain_participant
      .create_topic(
        "Aasii".to_string(),
        "Huh?".to_string(),
        &qos,
        TopicKind::WithKey,
      )
      .expect("Failed to create topic");
    let data_writer: DataWriter<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>> =
      publisher
        .create_datawriter(&topic, None)
        .expect("Failed to create datawriter");

    let data = RandomData {
      a: 4,
      b: "Fobar".to_string(),
    };

    let data2 = RandomData {
      a: 2,
      b: "Fobar".to_string(),
    };

    let data3 = RandomData {
      a: 3,
      b: "Fobar".to_string(),
    };

    let write_result = data_writer.write(data, None);
    info!("writerResult:  {write_result:?}");

    data_writer
      .write(data2, None)
      .expect("Unable to write data");

    info!("writerResult:  {write_result:?}");
    let write_result = data_writer.write(data3, None);

    thread::sleep(std::time::Duration::from_millis(100));
    info!("writerResult:  {write_result:?}");
  }

  #[test]
  fn repair_interval_is_fifth_of_deadline_clamped() {
    use super::{repair_interval_for, Duration};
    // DDS Durations count 2^-32 s, so a fifth may be off by a nanosecond.
    let interval_ms = |deadline: Option<Duration>| {
      (repair_interval_for(deadline).as_micros() as f64 / 1000.0).round() as u64
    };
    assert_eq!(interval_ms(Some(Duration::from_millis(50))), 10);
    assert_eq!(interval_ms(Some(Duration::from_secs(1))), 100);
    assert_eq!(interval_ms(Some(Duration::from_millis(1))), 1);
    assert_eq!(interval_ms(Some(Duration::from_millis(200))), 40);
    assert_eq!(interval_ms(None), 10);
    assert_eq!(interval_ms(Some(Duration::INFINITE)), 10);
    assert_eq!(interval_ms(Some(Duration::ZERO)), 10);
  }

  // Repair (ACKNACK response) tests. The Writer runs without an event loop, so
  // the tests poll the shared timer themselves and hand SendRepairData to the
  // Writer as the event loop would.
  mod repair {
    use std::{
      cell::RefCell,
      net::SocketAddr,
      rc::Rc,
      time::{Duration as StdDuration, Instant},
    };

    use super::super::*;
    use crate::{
      dds::{
        ddsdata::DDSData,
        qos::{policy::Durability, QosPolicyBuilder},
        statusevents::{sync_status_channel, StatusChannelReceiver},
        with_key::datawriter::{WriteOptions, WriteOptionsBuilder},
      },
      discovery::discovery::Discovery,
      messages::submessages::{
        elements::serialized_payload::SerializedPayload,
        submessages::{AckNack, NackFrag, WriterSubmessage},
      },
      polling::new_shared_timer,
      rtps::{writer_send_buffer::Admission, SubmessageBody},
      structure::{
        guid::EntityKind,
        sequence_number::{FragmentNumberSet, SequenceNumberSet},
      },
      RepresentationIdentifier,
    };

    struct Fixture {
      writer: Writer,
      reader_guid: GUID,
      timer: SharedTimer<DpTimerEvent>,
      status: StatusChannelReceiver<DataWriterStatus>,
      _participant_status: StatusChannelReceiver<DomainParticipantStatusEvent>,
    }

    impl Fixture {
      // A reliable Writer that holds samples 1..=sample_count of `payload_len`
      // bytes and is matched with one remote reader. Without a locator the
      // reader gets nothing on the wire, but the repair bookkeeping runs.
      fn new(
        writer_id: EntityId,
        writer_qos: QosPolicies,
        reader_id: EntityId,
        reader_qos: &QosPolicies,
        sample_count: i64,
        payload_len: usize,
        reader_locator: Option<SocketAddr>,
      ) -> Self {
        let send_buffer = WriterSendBuffer::new(
          GUID::new(GuidPrefix::new(&[1; 12]), writer_id),
          "repair_test".to_string(),
          true, // reliable
          writer_id.kind().is_built_in(),
          false,
          DEFAULT_WRITER_MAX_SAMPLES,
          DEFAULT_WRITER_MAX_SAMPLES,
          DEFAULT_WRITER_MAX_SAMPLES,
        );
        Self::with_buffer(
          send_buffer,
          writer_id,
          writer_qos,
          reader_id,
          reader_qos,
          sample_count,
          payload_len,
          reader_locator,
        )
      }

      #[allow(clippy::too_many_arguments)]
      fn with_buffer(
        send_buffer: WriterSendBuffer,
        writer_id: EntityId,
        writer_qos: QosPolicies,
        reader_id: EntityId,
        reader_qos: &QosPolicies,
        sample_count: i64,
        payload_len: usize,
        reader_locator: Option<SocketAddr>,
      ) -> Self {
        let guid = GUID::new(GuidPrefix::new(&[1; 12]), writer_id);
        for _ in 0..sample_count {
          let data = DDSData::new(SerializedPayload::new(
            RepresentationIdentifier::CDR_LE,
            vec![0; payload_len],
          ));
          assert!(matches!(
            send_buffer.admit_blocking(WriteOptions::default(), data, Some(StdDuration::ZERO)),
            Admission::Admitted { .. }
          ));
        }
        let (status_sender, status) = sync_status_channel(4).unwrap();
        let (participant_status_sender, participant_status) = sync_status_channel(16).unwrap();
        let timer = new_shared_timer();
        let mut writer = Writer::new(
          WriterIngredients {
            guid,
            send_buffer,
            topic_name: "repair_test".to_string(),
            like_stateless: false,
            qos_policies: writer_qos,
            status_sender,
            security_plugins: None,
          },
          Rc::new(UDPSender::new(0).unwrap()),
          Rc::clone(&timer),
          participant_status_sender,
          Rc::new(RefCell::new(InterfaceObservations::default())),
          Rc::from(Vec::<IfAddr>::new()),
        );
        // Sent already, to nobody.
        writer.set_last_sent(writer.send_buffer.last_change_sequence_number());
        let reader_guid = GUID::new(GuidPrefix::new(&[2; 12]), reader_id);
        let mut reader_proxy = RtpsReaderProxy::new(reader_guid, reader_qos.clone(), false);
        reader_proxy
          .unicast_locator_list
          .extend(reader_locator.map(Locator::from));
        writer.update_reader_proxy(&reader_proxy, reader_qos);
        assert!(
          writer.readers.contains_key(&reader_guid),
          "reader did not match"
        );
        Self {
          writer,
          reader_guid,
          timer,
          status,
          _participant_status: participant_status,
        }
      }

      // A built-in SEDP publications Writer and a remote SEDP publications
      // reader, with the QoS Discovery gives them.
      fn sedp(sample_count: i64, payload_len: usize) -> Self {
        Self::new(
          EntityId::SEDP_BUILTIN_PUBLICATIONS_WRITER,
          Discovery::builtin_publisher_qos(),
          EntityId::SEDP_BUILTIN_PUBLICATIONS_READER,
          &Discovery::builtin_subscriber_qos(),
          sample_count,
          payload_len,
          None,
        )
      }

      fn user(sample_count: i64, payload_len: usize, reader_locator: Option<SocketAddr>) -> Self {
        let qos = QosPolicyBuilder::new()
          .reliability(Reliability::Reliable {
            max_blocking_time: Duration::from_millis(100),
          })
          .history(History::KeepAll)
          .durability(Durability::TransientLocal)
          .build();
        Self::new(
          EntityId::new([0, 0, 1], EntityKind::WRITER_WITH_KEY_USER_DEFINED),
          qos.clone(),
          EntityId::new([0, 0, 2], EntityKind::READER_WITH_KEY_USER_DEFINED),
          &qos,
          sample_count,
          payload_len,
          reader_locator,
        )
      }

      fn reader_proxy(&self) -> &RtpsReaderProxy {
        &self.writer.readers[&self.reader_guid]
      }

      fn unsent(&self) -> usize {
        self.reader_proxy().unsent_changes_count()
      }

      // The reader has received nothing and requests `requested`.
      fn ack_nack(&mut self, requested: impl IntoIterator<Item = i64>, count: i32) {
        let requested: BTreeSet<SequenceNumber> =
          requested.into_iter().map(SequenceNumber::new).collect();
        let ack_nack = AckNack {
          reader_id: self.reader_guid.entity_id,
          writer_id: self.writer.my_guid.entity_id,
          reader_sn_state: SequenceNumberSet::from_base_and_set(SequenceNumber::new(1), &requested),
          count,
        };
        self
          .writer
          .handle_ack_nack(self.reader_guid.prefix, &AckSubmessage::AckNack(ack_nack));
      }

      // Timed events addressed to our reader that expire within `max_wait`.
      // This keeps SendRepairFrags, which next_repair_event skips.
      fn reader_events(&self, max_wait: StdDuration) -> Vec<TimedEvent> {
        let give_up = Instant::now() + max_wait;
        let mut found = Vec::new();
        loop {
          while let Some(fired) = self.timer.borrow_mut().poll() {
            if let DpTimerEvent::Writer { event, .. } = fired {
              let to_reader = match event {
                TimedEvent::SendRepairData { to_reader }
                | TimedEvent::SendRepairFrags { to_reader } => Some(to_reader),
                TimedEvent::Heartbeat | TimedEvent::CacheCleaning => None,
              };
              if to_reader == Some(self.reader_guid) {
                found.push(event);
              }
            }
          }
          if Instant::now() >= give_up {
            return found;
          }
          std::thread::sleep(StdDuration::from_millis(1));
        }
      }

      // The next SendRepairData timeout scheduled for our reader, waiting up to
      // `max_wait` for it to expire. Other timeouts are skipped.
      fn next_repair_event(&self, max_wait: StdDuration) -> Option<TimedEvent> {
        let give_up = Instant::now() + max_wait;
        loop {
          while let Some(fired) = self.timer.borrow_mut().poll() {
            if let DpTimerEvent::Writer {
              event: TimedEvent::SendRepairData { to_reader },
              ..
            } = fired
            {
              if to_reader == self.reader_guid {
                return Some(TimedEvent::SendRepairData { to_reader });
              }
            }
          }
          if Instant::now() >= give_up {
            return None;
          }
          std::thread::sleep(StdDuration::from_millis(1));
        }
      }

      // Run one repair round; returns how many changes it sent.
      fn repair_round(&mut self) -> usize {
        let event = self
          .next_repair_event(StdDuration::from_secs(5))
          .expect("SendRepairData was not scheduled");
        let before = self.unsent();
        self.writer.handle_timed_event(event);
        before - self.unsent()
      }
    }

    // Built-in and user Writers alike answer an ACKNACK only after
    // nack_response_delay, from the SendRepairData timer.
    #[test]
    fn acknack_schedules_repair_after_nack_response_delay() {
      for mut f in [Fixture::sedp(5, 8), Fixture::user(5, 8, None)] {
        f.writer.nack_response_delay = StdDuration::from_millis(200);
        f.ack_nack(1..=5, 1);
        assert_eq!(f.unsent(), 5, "repaired on the ACKNACK");
        assert!(f.reader_proxy().repair_mode);
        assert!(
          f.next_repair_event(StdDuration::from_millis(100)).is_none(),
          "repair before nack_response_delay"
        );
        assert_eq!(f.repair_round(), 5);
        assert!(!f.reader_proxy().repair_mode);
      }
    }

    // A round stops once REPAIR_BATCH_MAX_BYTES have gone out and the next
    // round continues where it stopped.
    #[test]
    fn repair_round_is_byte_limited_and_continues() {
      // 1000-byte samples: the eighth crosses 8 KiB.
      let mut f = Fixture::user(20, 1000, None);
      f.writer.nack_response_delay = StdDuration::ZERO;
      f.ack_nack(1..=20, 1);
      assert_eq!(f.repair_round(), 8);
      assert_eq!(f.repair_round(), 8);
      assert!(f.reader_proxy().repair_mode);
      assert_eq!(f.repair_round(), 4);
      assert!(!f.reader_proxy().repair_mode);
      assert!(f.next_repair_event(StdDuration::from_millis(50)).is_none());

      // Small SEDP-sized samples: many per round, still more than one round.
      let mut f = Fixture::sedp(250, 64);
      f.writer.nack_response_delay = StdDuration::ZERO;
      f.ack_nack(1..=250, 1);
      let first = f.repair_round();
      assert!(first > 50 && first < 250, "first round sent {first}");
      while f.reader_proxy().repair_mode {
        f.repair_round();
      }
      assert_eq!(f.unsent(), 0);
    }

    // A sample larger than a whole round still goes out, one per round. These
    // samples are fragmented, and that send is the only one: it does not arm
    // SendRepairFrags.
    #[test]
    fn repair_round_sends_at_least_one_sample() {
      let mut f = Fixture::user(3, 20_000, None);
      f.writer.nack_response_delay = StdDuration::ZERO;
      f.ack_nack(1..=3, 1);
      for _ in 0..3 {
        assert_eq!(f.repair_round(), 1);
        assert!(!f.reader_proxy().repair_frags_requested());
      }
      assert!(!f.reader_proxy().repair_mode);
      assert!(f
        .reader_events(StdDuration::from_millis(50))
        .iter()
        .all(|event| !matches!(event, TimedEvent::SendRepairFrags { .. })));
    }

    // A repeated ACKNACK count is a copy and changes nothing; a new count does.
    #[test]
    fn duplicate_acknack_count_is_ignored() {
      let mut f = Fixture::user(5, 8, None);
      f.writer.nack_response_delay = StdDuration::ZERO;
      f.ack_nack(1..=5, 1);
      assert_eq!(f.repair_round(), 5);

      f.ack_nack(1..=5, 1);
      assert_eq!(f.unsent(), 0);
      assert!(!f.reader_proxy().repair_mode);
      assert!(f.next_repair_event(StdDuration::from_millis(50)).is_none());

      f.ack_nack(1..=5, 2);
      assert_eq!(f.unsent(), 5);
      assert_eq!(f.repair_round(), 5);
    }

    // What waits to be sent goes out without a request, so a request does not send
    // it a second time.
    #[test]
    fn what_was_not_sent_yet_is_not_repaired() {
      let mut f = Fixture::user(5, 8, None);
      f.writer.set_last_sent(SequenceNumber::new(2));
      f.ack_nack(1..=5, 1);
      assert_eq!(f.unsent(), 2);
      assert_eq!(f.writer.last_advertised(), SequenceNumber::new(2));
    }

    fn nack_frag(f: &mut Fixture, writer_sn: i64, set: FragmentNumberSet, count: i32) {
      let nack_frag = NackFrag {
        reader_id: f.reader_guid.entity_id,
        writer_id: f.writer.my_guid.entity_id,
        writer_sn: SequenceNumber::new(writer_sn),
        fragment_number_state: set,
        count,
      };
      f.writer.handle_ack_nack(
        f.reader_guid.prefix,
        &AckSubmessage::NackFrag(nack_frag),
      );
    }

    fn frags(range: std::ops::RangeInclusive<u32>) -> FragmentNumberSet {
      let base = FragmentNumber::new(*range.start());
      FragmentNumberSet::from_base_and_set(base, &range.map(FragmentNumber::new).collect())
    }

    // 256 bits that are all set, from any base.
    fn all_from(base: u32) -> FragmentNumberSet {
      use speedy::{Readable, Writable};
      let mut bytes = frags(1..=256).write_to_vec_with_ctx(Endianness::LittleEndian).unwrap();
      bytes[..4].copy_from_slice(&base.to_le_bytes());
      FragmentNumberSet::read_from_buffer_with_ctx(Endianness::LittleEndian, &bytes).unwrap()
    }

    // A request for fragments that do not exist costs nothing: no memory, no timer,
    // no datagram, and no panic.
    #[test]
    fn fragments_that_do_not_exist_are_not_requested() {
      let mut f = Fixture::user(2, 20_000, None); // 15 fragments
      for (count, (sn, base)) in [
        (1, 0),
        (1, 16),
        (1, u32::MAX),
        (1, u32::MAX - 255),
        (0, 1),
        (3, 1),
        (-1, 1),
        (i64::MAX, 1),
      ]
      .into_iter()
      .enumerate()
      {
        nack_frag(&mut f, sn, all_from(base), count as i32);
        assert!(!f.reader_proxy().repair_frags_requested(), "{sn} {base}");
      }
      assert!(!f.reader_proxy().repair_frags_scheduled);

      nack_frag(&mut f, 2, all_from(15), 100);
      let only_the_last = Some((SequenceNumber::new(2), 15, 1));
      assert_eq!(f.reader_proxy().first_requested_frags(1000), only_the_last);
      f.writer.handle_repair_frags_send(f.reader_guid);
      assert!(!f.reader_proxy().repair_frags_requested());
    }

    // A reader on another host gets a sample of 1 MB in 75 datagrams, one of 60 KB as the
    // MTU has it. Once it has requested most of the first fragments of a large sample, it
    // gets such samples as the MTU has it, too, for a while.
    #[test]
    fn a_large_sample_is_written_in_large_datagrams_unless_the_path_loses_packets() {
      let mut f = Fixture::user(1, 1_000_000, None);
      let budget = |f: &Fixture, payload_size| f.reader_proxy().written_budget(payload_size);
      let per_datagram = |f: &Fixture, payload_size| {
        let (num_frags, size) = f.writer.num_frags_and_frag_size(payload_size);
        let header = INFO_DST_SUBMESSAGE_SIZE;
        frags_per_datafrag(header, budget(f, payload_size), 1, num_frags, size, payload_size)
      };
      assert_eq!((per_datagram(&f, 60_000), per_datagram(&f, 1_000_000)), (1, 10));
      // The reader was matched after sample 1 was sent, and sample 2 may have been begun then.
      write(&f, 2, 1_000_000);
      f.writer.set_last_sent(SequenceNumber::new(3));
      for sn in 1..=2 {
        nack_frag(&mut f, sn, frags(10..=30), sn as i32);
        f.ack_nack([sn], sn as i32);
        assert_eq!(per_datagram(&f, 1_000_000), 10, "{sn}");
      }
      // What does not fit the reader's receive buffer, and what does not exist.
      nack_frag(&mut f, 3, frags(100..=300), 3);
      nack_frag(&mut f, 3, all_from(u32::MAX - 3), 4);
      assert_eq!(per_datagram(&f, 1_000_000), 10);
      nack_frag(&mut f, 3, frags(10..=30), 5);
      assert_eq!(per_datagram(&f, 1_000_000), 1);
      let later = Instant::now() + crate::rtps::constant::SMALL_DATAGRAMS_PERIOD;
      f.writer.readers.values_mut().for_each(|reader| reader.retry_large_datagrams(later));
      assert_eq!(per_datagram(&f, 1_000_000), 10);
      // Where no packet of a split datagram arrives, the whole sample is requested.
      f.ack_nack([2, 3], 3);
      assert_eq!(per_datagram(&f, 1_000_000), 1);
    }

    #[test]
    fn a_request_for_a_small_sample_says_nothing_of_large_datagrams() {
      let mut f = Fixture::user(1, 20_000, None);
      f.ack_nack(1..=1, 1);
      assert!(f.reader_proxy().written_budget(1_000_000) >= 10 * FRAGMENT_SIZE);
    }

    // A fragment size above the sample's size is invalid. A WireGuard interface has an
    // MTU of 1,420, that of others 1,280.
    #[test]
    fn a_sample_that_is_smaller_than_a_fragment_is_sent_whole() {
      let f = Fixture::user(0, 8, None);
      for mtu in [68, 576, 1_280, 1_420, 1_500] {
        let budget = crate::rtps::constant::payload_budget_for_mtu(mtu);
        assert!(f.writer.max_unfragmented_in(budget) >= FRAGMENT_SIZE, "{mtu}");
      }
    }

    // A round is bounded, and a few rounds answer what several NACK_FRAGs ask for.
    #[test]
    fn a_round_repairs_what_several_nack_frags_ask_for() {
      let mut f = Fixture::user(1, 600_000, None); // 447 fragments
      for (count, base) in (1..=447).step_by(256).enumerate() {
        nack_frag(&mut f, 1, frags(base..=(base + 255).min(447)), count as i32);
      }
      let per_round = (REPAIR_FRAGS_MAX_BYTES / FRAGMENT_SIZE) as u32;
      f.writer.handle_repair_frags_send(f.reader_guid);
      let (_, start, _) = f.reader_proxy().first_requested_frags(1).unwrap();
      assert!(start > per_round / 2 && start <= per_round + 1, "{start}");
      for _ in 1..5 {
        f.writer.handle_repair_frags_send(f.reader_guid);
      }
      assert!(!f.reader_proxy().repair_frags_requested());
    }

    // What is acknowledged is requested no longer, in part or as a whole.
    #[test]
    fn an_acknowledgement_ends_the_repair_of_fragments() {
      let mut f = Fixture::user(2, 20_000, None);
      nack_frag(&mut f, 1, frags(3..=9), 1);
      assert!(f.reader_proxy().repair_frags_requested());
      f.writer.handle_ack_nack(
        f.reader_guid.prefix,
        &AckSubmessage::AckNack(AckNack {
          reader_id: f.reader_guid.entity_id,
          writer_id: f.writer.my_guid.entity_id,
          reader_sn_state: SequenceNumberSet::new_empty(SequenceNumber::new(2)),
          count: 1,
        }),
      );
      assert!(!f.reader_proxy().repair_frags_requested());
    }

    fn acknowledge(f: &mut Fixture, base: i64, requested: &[i64], count: i32) {
      let requested: BTreeSet<SequenceNumber> =
        requested.iter().copied().map(SequenceNumber::new).collect();
      let base = SequenceNumber::new(base);
      f.writer.handle_ack_nack(
        f.reader_guid.prefix,
        &AckSubmessage::AckNack(AckNack {
          reader_id: f.reader_guid.entity_id,
          writer_id: f.writer.my_guid.entity_id,
          reader_sn_state: SequenceNumberSet::from_base_and_set(base, &requested),
          count,
        }),
      );
    }

    fn write(f: &Fixture, samples: usize, payload_len: usize) {
      write_with(f, WriteOptions::default(), samples, payload_len);
    }

    fn write_with(f: &Fixture, options: WriteOptions, samples: usize, payload_len: usize) {
      for _ in 0..samples {
        let data = DDSData::new(SerializedPayload::new(
          RepresentationIdentifier::CDR_LE,
          vec![0; payload_len],
        ));
        let none = Some(StdDuration::ZERO);
        let admission = f
          .writer
          .send_buffer
          .admit_blocking(options.clone(), data, none);
        assert!(
          matches!(admission, Admission::Admitted { .. }),
          "a write failed"
        );
      }
      f.writer
        .set_last_sent(f.writer.send_buffer.last_change_sequence_number());
    }

    // A RELIABLE, VOLATILE, KEEP_LAST writer that retains 256 samples, with one reader.
    fn keep_last() -> Fixture {
      keep_last_after(0)
    }

    // One whose samples are numbered from the next number on.
    fn keep_last_after(highest: i64) -> Fixture {
      let mut f = keep_last_continuing(crate::ContinuedWriter::after(highest));
      let has_nothing = AckNack {
        reader_id: f.reader_guid.entity_id,
        writer_id: f.writer.my_guid.entity_id,
        reader_sn_state: SequenceNumberSet::new_empty(SequenceNumber::new(highest + 1)),
        count: 0,
      };
      let proxy = f.writer.readers.get_mut(&f.reader_guid).unwrap();
      while proxy.is_joining() {
        proxy.ends_joining(&has_nothing);
      }
      f
    }

    // One that continues another one, and a reader that is joining.
    fn keep_last_continuing(continued: crate::ContinuedWriter) -> Fixture {
      let qos = QosPolicyBuilder::new()
        .reliability(Reliability::Reliable {
          max_blocking_time: Duration::ZERO,
        })
        .history(History::KeepLast { depth: 10 })
        .durability(Durability::Volatile)
        .build();
      let guid = EntityId::new([0, 0, 1], EntityKind::WRITER_WITH_KEY_USER_DEFINED);
      let buffer = WriterSendBuffer::new(
        GUID::new(GuidPrefix::new(&[1; 12]), guid),
        "keep_last_test".to_string(),
        true,
        false,
        true,
        256,
        256,
        10,
      )
      .keep_last(10)
      .continue_former(continued);
      let reader = EntityId::new([0, 0, 2], EntityKind::READER_WITH_KEY_USER_DEFINED);
      Fixture::with_buffer(buffer, guid, qos.clone(), reader, &qos, 0, 0, None)
    }

    fn only_reader(f: &Fixture) -> crate::MatchedReader {
      let readers = f.writer.send_buffer.matched_readers();
      *readers
        .iter()
        .find(|reader| reader.guid == f.reader_guid)
        .expect("the reader is matched")
    }

    // A reader that acknowledges nothing costs others nothing: each write succeeds, and
    // no more is retained than the limits allow.
    #[test]
    fn a_keep_last_writer_never_waits_for_a_reader() {
      let f = keep_last();
      write(&f, 10_000, 8);
      assert_eq!(f.writer.send_buffer.retained_len(), 256);
      let reader = only_reader(&f);
      assert_eq!((reader.offered, reader.unacknowledged), (10_000, 10_000));
      assert_eq!(reader.overrun, 0, "it has said nothing of what it lacks");

      let f = keep_last();
      write(&f, 40, (1 << 20) - 4);
      // 32 MiB, and 4 bytes of each sample for its encapsulation header.
      assert_eq!(f.writer.send_buffer.retained_len(), 32);
      write(&f, 1, 64 << 20);
      assert_eq!(
        f.writer.send_buffer.retained_len(),
        2,
        "the two latest samples"
      );
    }

    // The samples that are gone are counted for the reader that requests them, once.
    #[test]
    fn what_a_reader_missed_is_counted_for_it_once() {
      let mut f = keep_last();
      write(&f, 300, 8); // 1 to 44 are gone
      acknowledge(&mut f, 10, &[10, 12, 50], 1);
      assert_eq!(f.repair_round(), 3);
      assert_eq!(only_reader(&f).overrun, 2);
      acknowledge(&mut f, 10, &[10, 12], 2); // the GAP was lost
      assert_eq!(f.repair_round(), 2);
      assert_eq!(only_reader(&f).overrun, 2);
      acknowledge(&mut f, 20, &[21, 22], 3);
      f.repair_round();
      assert_eq!(only_reader(&f).overrun, 4);
      acknowledge(&mut f, 301, &[], 4);
      let reader = only_reader(&f);
      assert_eq!((reader.overrun, reader.unacknowledged), (4, 0));
      assert_eq!(f.writer.send_buffer.retained_len(), 0);
    }

    // Late acknowledgements of samples that arrived are no loss.
    #[test]
    fn a_reader_that_acknowledges_late_has_missed_nothing() {
      let mut f = keep_last();
      write(&f, 2_000, 8);
      for (count, base) in (100..=2_001).step_by(50).enumerate() {
        acknowledge(&mut f, base, &[], count as i32);
      }
      assert_eq!(only_reader(&f).overrun, 0);
    }

    // A reader that was stopped for long is sent on with one GAP, and what no HEARTBEAT
    // offers any more counts as missed when the reader skips it.
    #[test]
    fn a_reader_that_is_far_behind_skips_what_is_gone() {
      let mut f = keep_last();
      write(&f, 1_256, 8); // 1 to 1,000 are gone
      let requested: Vec<i64> = (101..=356).collect();
      acknowledge(&mut f, 101, &requested, 1);
      f.repair_round();
      assert_eq!(only_reader(&f).overrun, 900);

      let mut f = keep_last();
      write(&f, 20_256, 8); // 1 to 20,000 are gone
      let first = i64::from(f.writer.send_buffer.advertised_first());
      assert_eq!(first, 20_001 - 8_192);
      acknowledge(&mut f, first, &[], 1);
      assert_eq!(only_reader(&f).overrun, first as u64 - 1);
    }

    // A reader that leaves will not tell what it lacks. What is gone of what it was offered
    // and has not acknowledged counts as missed, once; what is retained does not.
    #[test]
    fn what_is_gone_and_a_reader_that_leaves_has_not_acknowledged_counts_as_missed() {
      for (base, requested, counted_before, missed) in [
        (1, vec![], 0, 744),
        (301, vec![], 0, 444),
        (10, vec![10, 12], 2, 732),
        (745, vec![], 0, 0),
        (990, vec![], 0, 0),
        (1_001, vec![], 0, 0),
      ] {
        let mut f = keep_last();
        write(&f, 1_000, 8); // 1 to 744 are gone
        acknowledge(&mut f, base, &requested, 1);
        if !requested.is_empty() {
          f.repair_round();
        }
        assert_eq!(f.writer.send_buffer.overrun(), counted_before, "{base}");
        f.writer.reader_lost(f.reader_guid);
        let overrun = f.writer.send_buffer.overrun();
        assert_eq!(overrun, counted_before + missed, "{base}");
        let reported = std::iter::from_fn(|| f.status.try_recv().ok()).map(|status| match status {
          DataWriterStatus::PublicationMatched { missed, .. } => missed,
          other => panic!("{other:?}"),
        });
        assert!(reported.eq([0, missed]), "of the match and of its end: {base}");
      }
    }

    // The sum has each loss once, of any number of readers, also of one that leaves and
    // returns with the same GUID. A reader is not owed what was written before its match.
    #[test]
    fn the_overruns_of_all_readers_add_up_when_some_leave_and_return() {
      let mut f = keep_last();
      let qos = f.writer.qos_policies.clone();
      let join = |f: &mut Fixture, guid: GUID| {
        let proxy = RtpsReaderProxy::new(guid, qos.clone(), false);
        f.writer.update_reader_proxy(&proxy, &qos);
      };
      let entity = f.reader_guid.entity_id;
      let others: Vec<GUID> = (11..=50)
        .map(|number| GUID::new(GuidPrefix::new(&[number; 12]), entity))
        .collect();
      others.iter().for_each(|guid| join(&mut f, *guid));
      write(&f, 300, 8); // 1 to 44 are gone
      acknowledge(&mut f, 10, &[10, 12], 1);
      f.repair_round();
      assert_eq!(f.writer.send_buffer.overrun(), 2);

      f.writer.reader_lost(others[0]);
      assert_eq!(f.writer.send_buffer.overrun(), 2 + 44);
      join(&mut f, others[0]);
      write(&f, 300, 8); // 1 to 344 are gone
      let matched = f.writer.send_buffer.matched_readers();
      assert_eq!(matched.iter().map(|reader| reader.overrun).sum::<u64>(), 2);
      assert_eq!(f.writer.send_buffer.overrun(), 2 + 44);

      f.writer.reader_lost(others[0]);
      assert_eq!(f.writer.send_buffer.overrun(), 2 + 44 + 44, "301 to 344");
      others.iter().for_each(|guid| f.writer.reader_lost(*guid));
      assert_eq!(f.writer.send_buffer.overrun(), 2 + 44 + 44 + 39 * 344);
      f.writer.reader_lost(f.reader_guid);
      let of_the_first = 2 + (344 - 12);
      assert_eq!(f.writer.send_buffer.overrun(), of_the_first + 44 + 44 + 39 * 344);
    }

    // One reader's acknowledgements do not depend on another's, and a joining reader is
    // owed nothing that was written before.
    #[test]
    fn a_joining_volatile_reader_is_owed_nothing() {
      let mut f = keep_last();
      write(&f, 5, 8);
      acknowledge(&mut f, 6, &[], 1);
      let late = GUID::new(GuidPrefix::new(&[3; 12]), f.reader_guid.entity_id);
      let qos = f.writer.qos_policies.clone();
      f.writer
        .update_reader_proxy(&RtpsReaderProxy::new(late, qos.clone(), false), &qos);
      write(&f, 2, 8);
      acknowledge(&mut f, 8, &[], 2);
      let readers = f.writer.send_buffer.matched_readers();
      let of_late = readers.iter().find(|reader| reader.guid == late).unwrap();
      assert_eq!((of_late.offered, of_late.unacknowledged), (2, 2));
      assert_eq!(only_reader(&f).unacknowledged, 0);
      f.writer.reader_lost(late);
      assert_eq!(f.writer.send_buffer.retained_len(), 0);
      assert_eq!(f.writer.send_buffer.matched_readers().len(), 1);
    }

    // A sample that is written, but not sent, when a reader joins is sent to that
    // reader. A HEARTBEAT that begins after it would withdraw it first.
    #[test]
    fn a_joining_volatile_reader_is_offered_what_is_not_sent_yet() {
      let mut f = keep_last();
      write(&f, 5, 8);
      f.writer.set_last_sent(SequenceNumber::new(4));
      let late = GUID::new(GuidPrefix::new(&[3; 12]), f.reader_guid.entity_id);
      let qos = f.writer.qos_policies.clone();
      f.writer
        .update_reader_proxy(&RtpsReaderProxy::new(late, qos.clone(), false), &qos);
      assert_eq!(f.writer.readers[&late].first_offered(), SequenceNumber::new(5));
      let readers = f.writer.send_buffer.matched_readers();
      let joined = readers.iter().find(|reader| reader.guid == late).unwrap();
      assert_eq!((joined.offered, joined.unacknowledged), (1, 1));
    }

    // Each HEARTBEAT before the reader acknowledges one ends before what it is offered:
    // Cyclone DDS would take what a first one tells of for history.
    #[test]
    fn a_joining_volatile_reader_gets_what_was_written_before_it_knew_the_writer() {
      for written_before in [0, 5] {
        let mut f = keep_last();
        write(&f, written_before, 8);
        f.writer.reader_lost(f.reader_guid);
        let first = written_before as i64 + 1;
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let late = GUID::new(GuidPrefix::new(&[3; 12]), f.reader_guid.entity_id);
        let qos = f.writer.qos_policies.clone();
        let mut proxy = RtpsReaderProxy::new(late, qos.clone(), false);
        proxy.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
        f.writer.update_reader_proxy(&proxy, &qos);
        // As if it were no loopback locator, which is not used before the route is resolved.
        let reader = f.writer.readers.get_mut(&late).unwrap();
        reader.unicast_locator_list = proxy.unicast_locator_list;
        f.reader_guid = late;

        let last_sent = f.writer.last_sent();
        write(&f, 3, 8);
        f.writer.set_last_sent(last_sent);
        f.writer.process_pending();
        assert_eq!(f.writer.last_sent(), SequenceNumber::new(first + 2));
        let offer = (0, vec![(first, first - 1)]);
        assert_eq!(received_messages(&socket), offer, "one datagram for three samples");
        let plan = f.writer.direct_plan().expect("a plan with an offer");
        assert_eq!((plan.addresses.len(), plan.offers.len()), (0, 1));

        f.writer.handle_heartbeat_tick(false);
        assert_eq!(received_messages(&socket), offer);
        acknowledge(&mut f, 1, &[], 1);
        assert_eq!(received_messages(&socket), offer);
        assert!(f.reader_proxy().is_joining());
        assert_eq!(f.unsent(), 0);
        acknowledge(&mut f, first, &[], 2);
        assert!(!f.reader_proxy().is_joining());
        // The sample after the last one may have been begun.
        let was_sent_whole = |sn| f.reader_proxy().was_sent_whole(SequenceNumber::new(sn));
        assert!(!was_sent_whole(first + 3) && was_sent_whole(first + 4));
        assert_eq!(received_messages(&socket), (0, vec![(first, first + 2)]));
        assert_eq!(f.repair_round(), 3);
        assert_eq!(received_messages(&socket).0, 3);
        let plan = f.writer.direct_plan().expect("a plan with an address");
        assert_eq!((plan.addresses.len(), plan.offers.len()), (1, 0));
      }
    }

    // Of a writer that keeps history, a TRANSIENT_LOCAL reader gets the last `depth`
    // samples, whatever another reader has not acknowledged, and a VOLATILE one nothing.
    #[test]
    fn a_late_joiner_gets_the_depth_of_the_history() {
      let mut f = Fixture::user(0, 8, None);
      f.writer.send_buffer = WriterSendBuffer::new(
        f.writer.my_guid,
        "t".to_string(),
        true,
        false,
        false,
        100,
        100,
        3,
      )
      .keep_last(3);
      write(&f, 50, 8);
      for (prefix, durability, offered) in [
        (4, Durability::TransientLocal, 3),
        (5, Durability::Volatile, 0),
      ] {
        let late = GUID::new(GuidPrefix::new(&[prefix; 12]), f.reader_guid.entity_id);
        let mut qos = f.writer.qos_policies.clone();
        qos.durability = Some(durability);
        f.writer
          .update_reader_proxy(&RtpsReaderProxy::new(late, qos.clone(), false), &qos);
        let readers = f.writer.send_buffer.matched_readers();
        let joined = readers.iter().find(|reader| reader.guid == late).unwrap();
        assert_eq!(joined.offered, offered, "{durability:?}");
      }
    }

    // A writer with depth 1 of the samples of several sources.
    fn of_several_sources() -> Fixture {
      let mut f = Fixture::user(0, 8, None);
      f.writer.send_buffer = WriterSendBuffer::new(
        f.writer.my_guid,
        "t".to_string(),
        true,
        false,
        false,
        8,
        8,
        1,
      )
      .keep_last(1);
      let former = f.writer.readers.remove(&f.reader_guid);
      assert!(former.is_some());
      f.writer.nack_response_delay = StdDuration::ZERO;
      f
    }

    fn of(source: u8) -> WriteOptions {
      let source = GUID::new(GuidPrefix::new(&[source; 12]), EntityId::UNKNOWN);
      WriteOptionsBuilder::new().history_source(source).build()
    }

    // A late joiner at a socket, of which `received_messages` shows the first HEARTBEAT.
    fn late_joiner(f: &mut Fixture) -> std::net::UdpSocket {
      let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
      let late = GUID::new(GuidPrefix::new(&[3; 12]), f.reader_guid.entity_id);
      let qos = f.writer.qos_policies.clone();
      f.writer
        .update_reader_proxy(&RtpsReaderProxy::new(late, qos.clone(), false), &qos);
      // As if it were no loopback locator, which is not used before the route is resolved.
      let reader = f.writer.readers.get_mut(&late).unwrap();
      reader.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
      f.reader_guid = late;
      f.writer.offer_to_new_reader(late);
      socket
    }

    // Each source has a history of its own. One GAP withdraws any number of other samples,
    // which do not count as missed.
    #[test]
    fn a_late_joiner_gets_the_last_sample_of_each_source() {
      let mut f = of_several_sources();
      let few = 3;
      (1..=few).for_each(|source| write_with(&f, of(source), 1, 8));
      write_with(&f, of(100), 100_000, 8);
      let last = 100_003;

      let socket = late_joiner(&mut f);
      assert_eq!(received_messages(&socket), (0, vec![(1, last)]));
      let reader = only_reader(&f);
      assert_eq!((reader.offered, reader.unacknowledged), (4, 4));

      // What it requests, and the sample after the hole.
      let requested: Vec<i64> = (1..=256).collect();
      acknowledge(&mut f, 1, &requested, 1);
      assert_eq!(f.repair_round(), 256);
      assert_eq!(received_messages(&socket).0, 4);
      acknowledge(&mut f, 4, &requested[3..], 2); // the GAP was lost
      f.repair_round();
      assert_eq!(withdrawn(&socket), [(4, last)]);
      write_with(&f, of(2), 1, 8);
      acknowledge(&mut f, last + 1, &[], 3);
      let reader = only_reader(&f);
      assert_eq!(
        (reader.offered, reader.unacknowledged, reader.overrun),
        (5, 1, 0)
      );

      // A later sample of one source replaces only its own.
      acknowledge(&mut f, last + 2, &[], 4);
      write_with(&f, of(100), 20, 8);
      let later = GUID::new(GuidPrefix::new(&[4; 12]), f.reader_guid.entity_id);
      let qos = f.writer.qos_policies.clone();
      f.writer
        .update_reader_proxy(&RtpsReaderProxy::new(later, qos.clone(), false), &qos);
      let before = SequenceNumber::new(last + 1_000);
      assert_eq!(
        f.writer.send_buffer.history_before(before),
        [1, 3, last + 1, last + 21].map(SequenceNumber::new).into()
      );
      f.reader_guid = later;
      assert_eq!(only_reader(&f).offered, 4);
    }

    // The other publisher's sample is withdrawn when the reader has what precedes it, because
    // the HEARTBEAT that begins after it withdraws both. The last number is of source 100.
    #[test]
    fn a_sample_of_the_history_stays_on_offer_while_another_source_replaces_a_later_one() {
      let mut f = of_several_sources();
      write_with(&f, of(1), 1, 20_000);
      (2..=3).for_each(|source| write_with(&f, of(source), 1, 8));
      write_with(&f, of(100), 97, 8);
      let socket = late_joiner(&mut f);
      assert_eq!(received_messages(&socket), (0, vec![(1, 100)]));

      // It has some fragments of the first sample.
      nack_frag(&mut f, 1, frags(3..=9), 1);
      write_with(&f, of(2), 1, 8);
      acknowledge(&mut f, 1, &[2, 3], 1);
      assert_eq!(f.repair_round(), 2);
      assert_eq!(received_messages(&socket), (1, vec![]), "one sample, nothing withdrawn");
      // It may have fragments of the replaced one.
      nack_frag(&mut f, 2, frags(1..=2), 2);
      assert_eq!(f.repair_round(), 1);
      assert_eq!(received_messages(&socket), (0, vec![]));
      assert_eq!(only_reader(&f).overrun, 0);
      assert!(f.writer.handle_heartbeat_tick(false));
      assert_eq!(received_messages(&socket), (0, vec![(1, 101)]));

      // It has the first sample by now.
      acknowledge(&mut f, 2, &[2], 2);
      assert_eq!(f.repair_round(), 1);
      assert_eq!(received_messages(&socket), (0, vec![(3, 101)]));
      assert_eq!(only_reader(&f).overrun, 1);
    }

    // A reader that has not acknowledged a whole window goes on with what is retained.
    #[test]
    fn the_history_does_not_hold_back_a_late_joiner_that_misses_later_samples() {
      let mut f = of_several_sources();
      write_with(&f, of(1), 1, 20_000);
      write_with(&f, of(100), 99, 8);
      let socket = late_joiner(&mut f);
      write_with(&f, of(100), 10, 8); // 103 to 110 are retained
      received_messages(&socket);
      acknowledge(&mut f, 1, &[100, 101, 102, 103], 1);
      assert_eq!(f.repair_round(), 4);
      assert_eq!(received_messages(&socket), (1, vec![(103, 110)]));
      assert_eq!(only_reader(&f).overrun, 2);
    }

    // A reader that was matched anew on its side is offered the history of the present, also
    // of what was written since the match, and what is retained. The rest is no loss, and is
    // withdrawn without a HEARTBEAT, which would withdraw the history before it.
    #[test]
    fn a_late_joiner_that_went_back_gets_the_last_sample_of_each_source_again() {
      let mut f = of_several_sources();
      (1..=3).for_each(|source| write_with(&f, of(source), 1, 8));
      write_with(&f, of(100), 97, 8);
      let socket = late_joiner(&mut f);
      acknowledge(&mut f, 101, &[], 1);
      write_with(&f, of(2), 1, 8);
      write_with(&f, of(100), 99, 8); // 200 is retained, 1, 3 and 101 are kept
      acknowledge(&mut f, 201, &[], 2);
      received_messages(&socket);
      assert_eq!(f.writer.send_buffer.retained_len(), 1);

      acknowledge(&mut f, 1, &[], 1);
      assert_eq!(received_messages(&socket), (0, vec![(1, 200)]));
      assert_eq!(f.writer.send_buffer.advertised_first(), SequenceNumber::new(1));
      let requested: Vec<i64> = (1..=200).collect();
      acknowledge(&mut f, 1, &requested, 2);
      assert_eq!(f.repair_round(), 200);
      assert_eq!(received_messages(&socket), (4, vec![]));
      acknowledge(&mut f, 2, &[2], 3);
      f.repair_round();
      assert_eq!(withdrawn(&socket), [(2, 3)]);
      acknowledge(&mut f, 102, &requested[101..199], 4);
      f.repair_round();
      assert_eq!(withdrawn(&socket), [(102, 200)]);
      acknowledge(&mut f, 201, &[], 5);
      let reader = only_reader(&f);
      assert_eq!((reader.unacknowledged, reader.overrun), (0, 0));
      assert!(!f.reader_proxy().is_offered_again());
    }

    // What a source replaces after the reader went back is withdrawn when the reader has what
    // precedes it, as from a new late joiner.
    #[test]
    fn what_is_replaced_after_a_late_joiner_went_back_is_withdrawn_in_order() {
      let mut f = of_several_sources();
      (1..=3).for_each(|source| write_with(&f, of(source), 1, 8));
      write_with(&f, of(100), 97, 8);
      let socket = late_joiner(&mut f);
      acknowledge(&mut f, 101, &[], 1);
      write_with(&f, of(2), 1, 8);
      write_with(&f, of(100), 99, 8); // 200 is retained, 1, 3 and 101 are kept
      acknowledge(&mut f, 201, &[], 2);
      acknowledge(&mut f, 1, &[], 1);
      write_with(&f, of(2), 1, 8);
      received_messages(&socket);
      acknowledge(&mut f, 1, &[1, 2, 3, 101], 2);
      assert_eq!(f.repair_round(), 4);
      assert_eq!(received_messages(&socket), (2, vec![]), "1 and 3, nothing withdrawn");
      acknowledge(&mut f, 101, &[101], 3);
      assert_eq!(f.repair_round(), 1);
      assert_eq!(received_messages(&socket), (0, vec![(102, 201)]));
    }

    // An ACKNACK that lies moves neither another reader's frontier nor, beyond what was
    // written, its own.
    #[test]
    fn a_false_acknack_acknowledges_no_more_than_was_written() {
      let mut f = keep_last();
      write(&f, 300, 8);
      acknowledge(&mut f, i64::MAX / 2, &[], 1);
      acknowledge(&mut f, 301, &[301, 400, 500], 2);
      acknowledge(&mut f, 1, &[1, 2, 3], 3);
      acknowledge(&mut f, -5, &[], 4);
      assert!(f.unsent() <= 3);
      write(&f, 300, 8);
      assert_eq!(only_reader(&f).unacknowledged, 300);
    }

    // At 1 kHz of 3 KB a round repairs more than is written meanwhile, at 30 Hz no more
    // than a slow link takes, and never more than a receive buffer does.
    #[test]
    fn repair_keeps_ahead_of_what_is_written() {
      for (samples, payload_len, expected) in [
        (30, 3_000, 8_192..=8_192),
        (1_000, 3_000, 59_000..=61_000),
        (30, 1 << 20, 65_536..=65_536),
      ] {
        let mut f = keep_last();
        let began = f.writer.write_rate_since.0;
        write(&f, samples, payload_len);
        let second = began + StdDuration::from_secs(1);
        let max = f.writer.repair_batch_max_bytes(second);
        assert!(expected.contains(&max), "{samples} samples: {max}");
        assert_eq!(f.writer.repair_batch_max_bytes(second), max);
      }
    }

    // Of a thousand requests in a row those of REQUESTS_BURST are answered, and what the
    // others acknowledge counts.
    #[test]
    fn one_reader_is_not_answered_without_end() {
      let mut f = keep_last();
      write(&f, 300, 8);
      let before = f.writer.next_heartbeat_count();
      let began = Instant::now();
      for count in 0..1_000 {
        acknowledge(&mut f, 1, &[], count); // answered with a HEARTBEAT
      }
      let answers = f.writer.next_heartbeat_count() - before - 1;
      let meanwhile = began.elapsed().as_nanos() / NACK_RESPONSE_DELAY.as_nanos();
      assert!(answers >= 16 && answers as u128 <= 17 + meanwhile, "{answers}");

      for count in 1_000..1_100 {
        acknowledge(&mut f, i64::from(count) - 900, &[299], count);
      }
      assert_eq!(only_reader(&f).unacknowledged, 300 - 198);
      assert!(f.unsent() <= 1);
    }

    // One GAP of a range withdraws any number of evicted samples in a row, and several
    // GAPs withdraw scattered ones.
    #[test]
    fn what_is_gone_is_not_listed_one_by_one() {
      let from = |number: i64| SequenceNumber::new(number);
      let mut f = keep_last();
      write(&f, 1, 8);
      let reader = f.writer.readers.get_mut(&f.reader_guid).unwrap();
      (1..=200).for_each(|number| reader.request_change(from(number)));
      let day_at_1_khz = from(86_400_000);
      assert_eq!(
        reader.take_evicted_requests(day_at_1_khz, &BTreeSet::new()),
        EvictedRequests::AllFrom {
          first: from(1),
          before: day_at_1_khz
        }
      );
      [300, 301, 555, 556, 5_000]
        .into_iter()
        .for_each(|number| reader.request_change(from(number)));
      for expected in [&[300, 301, 555][..], &[556], &[5_000], &[]] {
        let expected = expected.iter().copied().map(from).collect();
        assert_eq!(
          reader.take_evicted_requests(day_at_1_khz, &BTreeSet::new()),
          EvictedRequests::Listed(expected)
        );
      }
    }

    // Nobody acknowledges what a BestEffort writer sends.
    #[test]
    fn announcements_do_not_pile_up() {
      let qos = Discovery::create_spdp_participant_qos();
      let mut f = Fixture::new(
        EntityId::SPDP_BUILTIN_PARTICIPANT_WRITER,
        qos.clone(),
        EntityId::SPDP_BUILTIN_PARTICIPANT_READER,
        &qos,
        1000,
        8,
        None,
      );
      f.writer.handle_cache_cleaning();
      // The depth of its History.
      assert_eq!(f.writer.send_buffer.retained_len(), 8);
    }

    // A reliable reader that has not acknowledged may still ask for all of it.
    #[test]
    fn what_a_reliable_reader_lacks_is_kept() {
      let mut f = Fixture::user(5, 8, None);
      f.writer.qos_policies.history = Some(History::KeepLast { depth: 1 });
      f.writer.handle_cache_cleaning();
      assert_eq!(f.writer.send_buffer.retained_len(), 5);
    }

    // Cyclone DDS asks for a HEARTBEAT so, also a writer without samples.
    #[test]
    fn a_reader_that_asks_a_writer_without_samples_is_answered() {
      let mut f = Fixture::user(0, 8, None);
      let before = f.writer.next_heartbeat_count();
      f.ack_nack([], 1);
      assert_eq!(f.writer.next_heartbeat_count(), before + 2);
    }

    // It was written while the ACKNACK was under way: its own HEARTBEAT tells of it.
    #[test]
    fn a_reader_that_acknowledges_more_than_before_is_not_answered() {
      let mut f = Fixture::user(5, 8, None);
      f.writer.nack_response_delay = StdDuration::ZERO;
      let mut count = 0;
      let mut heartbeats_after_ack_before = |base| {
        let before = f.writer.next_heartbeat_count();
        count += 1;
        f.writer.handle_ack_nack(
          f.reader_guid.prefix,
          &AckSubmessage::AckNack(AckNack {
            reader_id: f.reader_guid.entity_id,
            writer_id: f.writer.my_guid.entity_id,
            reader_sn_state: SequenceNumberSet::new_empty(SequenceNumber::new(base)),
            count,
          }),
        );
        f.writer.next_heartbeat_count() - before - 1
      };
      assert_eq!(heartbeats_after_ack_before(1), 1, "it has nothing, and does not know");
      assert_eq!(heartbeats_after_ack_before(3), 0);
      assert_eq!(heartbeats_after_ack_before(5), 0);
      assert_eq!(heartbeats_after_ack_before(5), 1, "it says so again");
      assert_eq!(heartbeats_after_ack_before(6), 0, "it has everything");
      assert!(f.next_repair_event(StdDuration::from_millis(50)).is_none());
    }

    // As when the Writer is behind the application: a reader requests all that it hears of, and
    // each of those samples would be sent to it twice.
    #[test]
    fn a_reader_that_wants_an_answer_hears_only_of_samples_that_were_sent() {
      let (mut f, socket) = with_socket();
      write(&f, 5, 8);
      f.writer.set_last_sent(SequenceNumber::new(2));
      let mut count = 1;
      let mut heartbeats_after_ack_before = |base| {
        count += 1;
        acknowledge(&mut f, base, &[], count);
        let (samples, heartbeats) = received_messages(&socket);
        assert_eq!(samples, 0);
        heartbeats.into_iter().map(|(_, last)| last).collect::<Vec<_>>()
      };
      assert_eq!(heartbeats_after_ack_before(2), []);
      assert_eq!(heartbeats_after_ack_before(2), [2], "it says so again");
      assert_eq!(heartbeats_after_ack_before(3), []);
      assert_eq!(heartbeats_after_ack_before(3), [], "it has what was sent");
    }

    // Its participant discarded ours and has matched it anew: it begins with an
    // ACKNACK that requests nothing, and whose count it may have had before.
    #[test]
    fn a_reader_that_was_matched_anew_on_its_side_is_answered_and_served() {
      let mut f = Fixture::user(5, 8, None);
      f.writer.nack_response_delay = StdDuration::ZERO;
      let reader_guid = f.reader_guid;
      let ack_nack = |f: &mut Fixture, base: i64, requested: &[i64]| {
        let requested = requested.iter().copied().map(SequenceNumber::new).collect();
        let base = SequenceNumber::new(base);
        let ack_nack = AckNack {
          reader_id: reader_guid.entity_id,
          writer_id: f.writer.my_guid.entity_id,
          reader_sn_state: SequenceNumberSet::from_base_and_set(base, &requested),
          count: 1,
        };
        let before = f.writer.next_heartbeat_count();
        f.writer
          .handle_ack_nack(reader_guid.prefix, &AckSubmessage::AckNack(ack_nack));
        f.writer.next_heartbeat_count() - before - 1
      };
      assert_eq!(ack_nack(&mut f, 6, &[]), 0, "it has everything");
      assert_eq!(ack_nack(&mut f, 1, &[]), 1, "it knows nothing");
      assert!(f.writer.handle_heartbeat_tick(false), "it is behind again");
      f.writer.readers.get_mut(&reader_guid).unwrap().last_acknack_count = Some(0);
      assert_eq!(ack_nack(&mut f, 1, &[1, 2, 3, 4, 5]), 0);
      assert_eq!(f.unsent(), 5);
      assert!(f.next_repair_event(StdDuration::from_secs(10)).is_some());
    }

    // What a reader at `socket` has got by now: how many samples, and the first and the
    // last sample of each HEARTBEAT.
    fn received_messages(socket: &std::net::UdpSocket) -> (usize, Vec<(i64, i64)>) {
      socket
        .set_read_timeout(Some(StdDuration::from_millis(200)))
        .unwrap();
      let mut buffer = [0; 4096];
      let (mut samples, mut heartbeats) = (0, Vec::new());
      while let Ok(len) = socket.recv(&mut buffer) {
        let datagram = bytes::Bytes::copy_from_slice(&buffer[..len]);
        for submessage in Message::read_from_buffer(&datagram).unwrap().submessages {
          match submessage.body {
            SubmessageBody::Writer(WriterSubmessage::Heartbeat(heartbeat, _)) => {
              heartbeats.push((heartbeat.first_sn.into(), heartbeat.last_sn.into()));
            }
            SubmessageBody::Writer(WriterSubmessage::Data(..)) => samples += 1,
            _ => {}
          }
        }
      }
      (samples, heartbeats)
    }

    // Each datagram that a reader at `socket` has got, by now.
    fn received(socket: &std::net::UdpSocket) -> usize {
      socket
        .set_read_timeout(Some(StdDuration::from_millis(200)))
        .unwrap();
      let mut buffer = [0; 4096];
      std::iter::from_fn(|| socket.recv(&mut buffer).ok()).count()
    }

    // The sample numbers that GAPs withdraw at `socket`, each range up to its end.
    fn withdrawn(socket: &std::net::UdpSocket) -> Vec<(i64, i64)> {
      socket
        .set_read_timeout(Some(StdDuration::from_millis(200)))
        .unwrap();
      let mut buffer = [0; 65_536];
      let mut ranges = Vec::new();
      while let Ok(len) = socket.recv(&mut buffer) {
        let datagram = bytes::Bytes::copy_from_slice(&buffer[..len]);
        for submessage in Message::read_from_buffer(&datagram).unwrap().submessages {
          if let SubmessageBody::Writer(WriterSubmessage::Gap(gap, _)) = submessage.body {
            ranges.push((gap.gap_start.into(), gap.gap_list.base().into()));
          }
        }
      }
      ranges
    }

    #[test]
    fn a_best_effort_reader_without_a_reliable_sibling_gets_a_gap_before_each_fragmented_sample() {
      let mut f = keep_last();
      let sockets = [(); 2].map(|()| std::net::UdpSocket::bind("127.0.0.1:0").unwrap());
      let alone = GUID::new(GuidPrefix::new(&[8; 12]), EntityId::UNKNOWN);
      let beside_reliable = GUID::new(f.reader_guid.prefix, EntityId::UNKNOWN);
      let best_effort = QosPolicyBuilder::new().reliability(Reliability::BestEffort).build();
      for (guid, socket) in [alone, beside_reliable].into_iter().zip(&sockets) {
        let mut proxy = RtpsReaderProxy::new(guid, best_effort.clone(), false);
        proxy.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
        f.writer.update_reader_proxy(&proxy, &best_effort);
        // As if it were no loopback locator, which is not used before the route is resolved.
        let reader = f.writer.readers.get_mut(&guid).unwrap();
        reader.unicast_locator_list = proxy.unicast_locator_list;
      }
      let mut send = |samples, payload_len| {
        let last_sent = f.writer.last_sent();
        write(&f, samples, payload_len);
        f.writer.set_last_sent(last_sent);
        f.writer.process_pending();
        sockets.each_ref().map(withdrawn)
      };
      assert_eq!(send(20, 8), [vec![], vec![]], "samples of one datagram");
      assert_eq!(send(1, 200_000), [vec![(1, 13)], vec![]]);
      assert_eq!(send(1, 200_000), [vec![(1, 14)], vec![]]);
    }

    // The event loop has ACKNACKs to receive before the next turn.
    #[test]
    fn a_turn_sends_fewer_samples_to_more_readers() {
      let sent_in_a_turn = |readers: u8, payload_len| {
        let mut f = keep_last();
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let qos = QosPolicyBuilder::new().reliability(Reliability::BestEffort).build();
        for id in 1..readers {
          let guid = GUID::new(GuidPrefix::new(&[id; 12]), EntityId::UNKNOWN);
          let mut proxy = RtpsReaderProxy::new(guid, qos.clone(), false);
          proxy.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
          f.writer.update_reader_proxy(&proxy, &qos);
        }
        assert_eq!(f.writer.readers.len(), readers.into());
        let last_sent = f.writer.last_sent();
        write(&f, 200, payload_len);
        f.writer.set_last_sent(last_sent);
        assert!(f.writer.process_pending(), "some are left");
        i64::from(f.writer.last_sent()) - i64::from(last_sent)
      };
      assert_eq!([1, 16].map(|readers| sent_in_a_turn(readers, 4_092)), [64, 4]);
    }

    // What a reader at `socket` has got, by now: the fragments of each number, and the last
    // numbers of HEARTBEATs.
    fn received_fragments(socket: &std::net::UdpSocket) -> (Vec<(i64, Vec<u32>)>, Vec<i64>) {
      socket
        .set_read_timeout(Some(StdDuration::from_millis(200)))
        .unwrap();
      let mut buffer = [0; 65_536];
      let (mut samples, mut heartbeats) = (BTreeMap::<i64, Vec<u32>>::new(), Vec::new());
      while let Ok(len) = socket.recv(&mut buffer) {
        let datagram = bytes::Bytes::copy_from_slice(&buffer[..len]);
        for submessage in Message::read_from_buffer(&datagram).unwrap().submessages {
          match submessage.body {
            SubmessageBody::Writer(WriterSubmessage::Heartbeat(heartbeat, _)) => {
              heartbeats.push(heartbeat.last_sn.into());
            }
            SubmessageBody::Writer(WriterSubmessage::DataFrag(data, _)) => {
              let first = u32::from(data.fragment_starting_num);
              let count = u32::from(data.fragments_in_submessage);
              let fragments = samples.entry(data.writer_sn.into()).or_default();
              fragments.extend(first..first + count);
            }
            _ => {}
          }
        }
      }
      (samples.into_iter().collect(), heartbeats)
    }

    const EARLY_BYTES: usize = 30_000;
    // With the encapsulation header.
    const EARLY_FRAGMENTS: u32 = (EARLY_BYTES + 4).div_ceil(FRAGMENT_SIZE) as u32;

    fn early_sample() -> DDSData {
      let payload = vec![7; EARLY_BYTES];
      DDSData::new(SerializedPayload::new(RepresentationIdentifier::CDR_LE, payload))
    }

    fn complete_early(f: &mut Fixture) -> i64 {
      let options = WriteOptionsBuilder::new().completes_early().build();
      let none = Some(StdDuration::ZERO);
      let admission = f
        .writer
        .send_buffer
        .admit_blocking(options, early_sample(), none);
      let Admission::Admitted {
        sequence_number, ..
      } = admission
      else {
        panic!("the write failed");
      };
      while f.writer.process_pending() {}
      sequence_number.into()
    }

    fn begin_early(f: &mut Fixture, available: usize) -> bool {
      let options = WriteOptions::default();
      let begun = f
        .writer
        .send_buffer
        .begin_early(options, early_sample(), available);
      while f.writer.process_pending() {}
      begun
    }

    fn with_socket() -> (Fixture, std::net::UdpSocket) {
      let mut f = keep_last();
      let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
      let reader = f.writer.readers.get_mut(&f.reader_guid).unwrap();
      reader.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
      (f, socket)
    }

    #[test]
    fn a_sample_is_sent_as_it_becomes_complete() {
      let (mut f, socket) = with_socket();
      let mut fragments = Vec::new();
      assert!(begin_early(&mut f, 10_000));
      assert!(!begin_early(&mut f, 10_000), "one at a time");
      for available in [10_000, 12_000, 25_000, EARLY_BYTES, EARLY_BYTES + 4] {
        f.writer.send_buffer.extend_early(available);
        while f.writer.process_pending() {}
        let (samples, heartbeats) = received_fragments(&socket);
        assert_eq!(heartbeats, Vec::<i64>::new(), "the sample is not offered yet");
        for (number, sent) in samples {
          assert_eq!(number, 1);
          fragments.extend(sent);
        }
        assert!(fragments.len() <= available / FRAGMENT_SIZE, "of {available} bytes");
      }
      let all_but_the_last: Vec<u32> = (1..EARLY_FRAGMENTS).collect();
      assert_eq!(fragments, all_but_the_last);
      assert_eq!(f.writer.send_buffer.last_change_sequence_number(), SequenceNumber::new(0));

      assert_eq!(complete_early(&mut f), 1);
      let (samples, heartbeats) = received_fragments(&socket);
      fragments.extend(samples.into_iter().flat_map(|(_, sent)| sent));
      assert_eq!(fragments, (1..=EARLY_FRAGMENTS).collect::<Vec<_>>(), "each once");
      assert_eq!(heartbeats, [1]);
    }

    // A reader that acknowledged samples of a former process has what comes after them, gets
    // what is written next, and is offered nothing of what went before.
    #[test]
    fn a_continued_writer_serves_the_readers_of_the_former_one() {
      let mut f = keep_last_after(41);
      assert_eq!(only_reader(&f).unacknowledged, 0);
      acknowledge(&mut f, 42, &[], 1);
      write(&f, 3, 8);
      let reader = only_reader(&f);
      assert_eq!((reader.offered, reader.unacknowledged, reader.overrun), (3, 3, 0));
      // One that lacks the last samples of the former process requests them.
      acknowledge(&mut f, 40, &[40, 41, 43], 2);
      assert_eq!(f.repair_round(), 1, "of the three numbers it has one");
      acknowledge(&mut f, 45, &[], 3);
      let reader = only_reader(&f);
      assert_eq!((reader.offered, reader.unacknowledged, reader.overrun), (3, 0, 0));
      assert_eq!(f.writer.send_buffer.retained_len(), 0);
    }

    #[test]
    fn a_former_reader_gets_what_it_lacks_unless_it_has_lost_its_state() {
      let continuing = || {
        let reader = EntityId::new([0, 0, 2], EntityKind::READER_WITH_KEY_USER_DEFINED);
        let sample = |number| crate::ContinuedSample {
          number,
          payload: bytes::Bytes::from_static(&[0; 8]),
          encoding: RepresentationIdentifier::CDR_LE,
          encoding_options: [0, 0],
          source_timestamp: None,
          history_source: None,
        };
        keep_last_continuing(crate::ContinuedWriter {
          samples: [37, 38, 40, 41].map(sample).into(),
          readers: vec![GUID::new(GuidPrefix::new(&[2; 12]), reader)],
          ..crate::ContinuedWriter::after(41)
        })
      };
      let mut f = continuing();
      assert_eq!(only_reader(&f).unacknowledged, 4);
      acknowledge(&mut f, 38, &[], 1);
      assert_eq!(f.repair_round(), 4, "of 39 it gets a GAP");
      acknowledge(&mut f, 42, &[], 2);
      let reader = only_reader(&f);
      assert_eq!((reader.unacknowledged, reader.overrun), (0, 0));
      assert_eq!(f.writer.send_buffer.retained_len(), 0);

      for base in [0, 1] {
        let mut f = continuing();
        acknowledge(&mut f, base, &[], 1);
        assert_eq!(f.unsent(), 0, "nothing is sent again: {base}");
        assert_eq!(only_reader(&f).unacknowledged, 0);
        write(&f, 1, 8);
        assert_eq!(only_reader(&f).unacknowledged, 1);
      }
    }

    // The reader acknowledges at once what it lacked of a former process' samples, instead of with
    // the next sample: that one may wait for the acknowledgement.
    #[test]
    fn only_the_last_repair_round_ends_with_a_heartbeat() {
      let mut f = keep_last_after(41);
      acknowledge(&mut f, 42, &[], 1);
      write(&f, 10, 2_000);
      f.writer.nack_response_delay = StdDuration::ZERO;
      acknowledge(&mut f, 42, &(42..52).collect::<Vec<_>>(), 2);
      let mut round = || {
        let before = f.writer.next_heartbeat_count();
        let repaired = f.repair_round();
        (repaired, f.writer.next_heartbeat_count() - before - 1)
      };
      assert_eq!([(); 3].map(|()| round()), [(4, 0), (4, 0), (2, 1)]);
    }

    // Sent before the last former reader has matched, it would not reach a BEST_EFFORT one.
    #[test]
    fn an_unsent_sample_of_a_former_process_waits_for_its_readers() {
      let of = |id: u8| {
        let reader = EntityId::new([0, 0, 2], EntityKind::READER_WITH_KEY_USER_DEFINED);
        GUID::new(GuidPrefix::new(&[id; 12]), reader)
      };
      let sample = |number| crate::ContinuedSample {
        number,
        payload: bytes::Bytes::from_static(&[0; 8]),
        encoding: RepresentationIdentifier::CDR_LE,
        encoding_options: [0, 0],
        source_timestamp: None,
        history_source: None,
      };
      let continuing = || {
        let f = keep_last_continuing(crate::ContinuedWriter {
          samples: [40, 41].map(sample).into(),
          readers: vec![of(2), of(3)],
          ..crate::ContinuedWriter::after(41)
        });
        f.writer.set_last_sent(SequenceNumber::new(40));
        f
      };
      let sent = |f: &mut Fixture| {
        f.writer.process_pending();
        i64::from(f.writer.last_sent())
      };
      let mut f = continuing();
      assert_eq!((sent(&mut f), f.writer.has_unsent()), (40, true));
      let qos = QosPolicyBuilder::new().reliability(Reliability::BestEffort).build();
      f.writer.update_reader_proxy(&RtpsReaderProxy::new(of(3), qos.clone(), false), &qos);
      assert_eq!(sent(&mut f), 41);

      // What is written meanwhile does not wait.
      let mut f = continuing();
      write_with(&f, WriteOptions::default(), 1, 8);
      assert_eq!(sent(&mut f), 42);
    }

    // A message of a RELIABLE Writer ends with a HEARTBEAT, whose number shows that it was built.
    #[test]
    fn a_sample_is_not_serialized_for_no_reader() {
      let (mut f, _socket) = with_socket();
      let send_two = |f: &mut Fixture| {
        let before = f.writer.next_heartbeat_count();
        for payload_len in [8, 100_000] {
          let last_sent = f.writer.last_sent();
          write(f, 1, payload_len);
          f.writer.set_last_sent(last_sent);
          while f.writer.process_pending() {}
          let last = f.writer.send_buffer.last_change_sequence_number();
          assert_eq!(f.writer.last_sent(), last);
        }
        f.writer.next_heartbeat_count() - before - 1
      };
      assert_eq!(send_two(&mut f), 2);
      f.writer.reader_lost(f.reader_guid);
      assert_eq!(send_two(&mut f), 0);
    }

    #[test]
    fn a_sample_that_never_becomes_complete_is_withdrawn() {
      let (mut f, socket) = with_socket();
      write(&f, 3, 8);
      acknowledge(&mut f, 4, &[], 1);
      assert!(begin_early(&mut f, 15_000));
      // Another sample comes first.
      f.writer.send_buffer.withdraw_early();
      write_with(&f, WriteOptions::default(), 1, 8);
      assert_eq!(f.writer.send_buffer.last_change_sequence_number(), SequenceNumber::new(5));
      received(&socket);
      acknowledge(&mut f, 4, &[4], 2);
      f.repair_round();
      assert_eq!(withdrawn(&socket), [(4, 5)]);
      let reader = only_reader(&f);
      assert_eq!((reader.offered, reader.unacknowledged, reader.overrun), (4, 1, 0));
      // Its number is used again if no fragment was sent.
      f.writer.set_last_sent(SequenceNumber::new(4));
      assert!(begin_early(&mut f, 0));
      assert!(!f.writer.send_buffer.withdraw_early());
      assert_eq!(complete_early(&mut f), 6);
    }

    #[test]
    fn a_reader_that_is_behind_hears_later_of_a_sample_that_was_withdrawn() {
      let (mut f, socket) = with_socket();
      write(&f, 3, 8);
      assert!(begin_early(&mut f, 15_000));
      write(&f, 1, 8);
      received(&socket);
      // The HEARTBEAT that withdraws a sample withdraws those before it, too.
      acknowledge(&mut f, 2, &[2, 3, 4], 1);
      f.repair_round();
      assert_eq!(withdrawn(&socket), []);
      acknowledge(&mut f, 4, &[4], 2);
      f.repair_round();
      assert_eq!(withdrawn(&socket), [(4, 5)]);
      assert_eq!(only_reader(&f).overrun, 0);
    }

    #[test]
    fn who_was_matched_in_the_middle_gets_the_whole_sample() {
      let (mut f, socket) = with_socket();
      assert!(begin_early(&mut f, 15_000));
      received(&socket);
      f.writer.matched_readers_count_total += 1;
      assert_eq!(complete_early(&mut f), 1);
      let (samples, _) = received_fragments(&socket);
      assert_eq!(samples, [(1, (1..=EARLY_FRAGMENTS).collect())]);
    }

    #[test]
    fn only_those_who_are_behind_get_heartbeats() {
      let socket = || std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
      let (behind, done, best_effort) = (socket(), socket(), socket());
      let proxy = |prefix: u8, socket: &std::net::UdpSocket, qos: &QosPolicies| {
        let guid = GUID::new(GuidPrefix::new(&[prefix; 12]), EntityId::UNKNOWN);
        let mut proxy = RtpsReaderProxy::new(guid, qos.clone(), false);
        proxy.unicast_locator_list = vec![Locator::from(socket.local_addr().unwrap())];
        proxy
      };
      let reliable = QosPolicyBuilder::new()
        .reliability(policy::Reliability::Reliable {
          max_blocking_time: Duration::ZERO,
        })
        .build();
      let unreliable = QosPolicyBuilder::new()
        .reliability(policy::Reliability::BestEffort)
        .build();
      let mut f = Fixture::user(5, 8, None);
      let first = f.reader_guid;
      f.writer.readers.remove(&first);
      for (prefix, socket, qos) in [
        (3, &behind, &reliable),
        (4, &done, &reliable),
        (5, &best_effort, &unreliable),
      ] {
        let proxy = proxy(prefix, socket, qos);
        f.writer.readers.insert(proxy.remote_reader_guid, proxy);
      }
      let done_guid = GUID::new(GuidPrefix::new(&[4; 12]), EntityId::UNKNOWN);
      f.writer
        .readers
        .get_mut(&done_guid)
        .unwrap()
        .all_acked_before = SequenceNumber::from(6);

      assert!(f.writer.handle_heartbeat_tick(false), "one is behind");
      let counts = [&behind, &done, &best_effort].map(received);
      assert_eq!(counts, [1, 0, 0]);
      assert!(f.writer.handle_heartbeat_tick(true));
      let counts = [&behind, &done, &best_effort].map(received);
      assert_eq!(counts, [1, 1, 1], "liveliness is for all");

      let behind_guid = GUID::new(GuidPrefix::new(&[3; 12]), EntityId::UNKNOWN);
      f.writer
        .readers
        .get_mut(&behind_guid)
        .unwrap()
        .all_acked_before = SequenceNumber::from(6);
      assert!(!f.writer.handle_heartbeat_tick(false), "nobody is behind");
    }

    // While the reader's send socket has queued control datagrams, a round
    // sends nothing and re-arms; once the queue drains, repair proceeds.
    #[test]
    fn repair_waits_for_control_backlog() {
      // A loopback locator would not be used before route resolution.
      let mut f = Fixture::user(5, 8, Some(SocketAddr::from(([192, 0, 2, 1], 9))));
      f.writer.nack_response_delay = StdDuration::ZERO;
      f.writer
        .udp_sender
        .inject_control_backlog(SocketId::Unicast);
      f.ack_nack(1..=5, 1);
      assert_eq!(f.repair_round(), 0);
      assert!(f.reader_proxy().repair_mode);

      f.writer.udp_sender.flush_control(SocketId::Unicast);
      assert_eq!(f.repair_round(), 5);
      assert!(!f.reader_proxy().repair_mode);
    }
  }
}
