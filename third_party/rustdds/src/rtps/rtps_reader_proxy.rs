use std::{
  cmp::max,
  collections::{BTreeMap, BTreeSet, HashMap},
  net::{Ipv4Addr, SocketAddr},
  time::Instant,
};

use bit_vec::BitVec;
#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};
use mio1::Token;

use crate::{
  dds::{participant::DomainParticipant, qos::QosPolicies},
  discovery::{discovery_db::keep_first_locators, sedp_messages::DiscoveredReaderData},
  messages::submessages::{ack_nack::AckNack, submessage::AckSubmessage},
  network::util::{path_mtu_payload_for_peer, IfAddr},
  rtps::{
    constant::*,
    transmit::{InterfaceObservations, InterfaceSelector, RouteSelector, SendRoute},
  },
  structure::{
    guid::{EntityId, GUID},
    locator::Locator,
    sequence_number::{FragmentNumberSet, SequenceNumber},
  },
};
use super::{
  reader::ReaderIngredients,
  reader_progress::{OfferedHistory, SharedProgress},
  repairs_under_way::RepairsUnderWay,
};

// Requested samples that are gone, from which on a reader is taken to lack all that
// is gone: half of what one ACKNACK can request (RTPS v2.5 Section 8.3.5.5).
const BULK_GAP_MIN_SAMPLES: usize = 128;

// What one GAP can list (RTPS v2.5 Section 8.3.5.5).
const GAP_MAX_SPAN: i64 = 256;
// Fast DDS repeats its ACKNACK seven times a second while it has no HEARTBEAT.
const JOINING_MAX_ACKNACKS: u8 = 20;

/// Samples that a reader requested and that are no longer retained.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum EvictedRequests {
  /// These.
  Listed(BTreeSet<SequenceNumber>),
  /// All from `first` to the one before `before`.
  AllFrom {
    first: SequenceNumber,
    before: SequenceNumber,
  },
}

#[derive(Debug, PartialEq, Eq, Clone)]
/// ReaderProxy class represents the information an RTPS StatefulWriter
/// maintains on each matched RTPS Reader
//
// TODO: Maybe more of the members could be made private.
pub(crate) struct RtpsReaderProxy {
  /// Identifies the remote matched RTPS Reader that is represented by the
  /// ReaderProxy
  pub remote_reader_guid: GUID,
  /// Identifies the group to which the matched Reader belongs
  pub remote_group_entity_id: EntityId,
  /// List of unicast locators (transport, address, port combinations) that can
  /// be used to send messages to the matched RTPS Reader. The list may be empty
  pub unicast_locator_list: Vec<Locator>,
  /// List of multicast locators (transport, address, port combinations) that
  /// can be used to send messages to the matched RTPS Reader. The list may be
  /// empty
  pub multicast_locator_list: Vec<Locator>,

  /// Loopback unicast locators the reader advertised (e.g. `127.0.0.1`). These
  /// are kept out of `unicast_locator_list` so the legacy all-locators fallback
  /// never sends to a *remote* host's loopback, but are retained here so route
  /// selection can prefer them once the peer is positively confirmed to be on
  /// the same host. See `src/rtps/loopback_same_host_design.md`.
  pub loopback_unicast_locators: Vec<Locator>,

  /// Specifies whether the remote matched RTPS Reader expects in-line QoS to be
  /// sent along with any data.
  expects_in_line_qos: bool,
  /// Specifies whether the remote Reader is responsive to the Writer
  is_active: bool,

  // The ACKNACKs of a joining reader so far, see `start_joining`. `None` of any other.
  acknacks_while_joining: Option<u8>,

  // Reader has positively acked all SequenceNumbers _before_ this.
  // This is directly the same as readerSNState.base in ACKNACK submessage.
  pub all_acked_before: SequenceNumber,

  // What the DataWriter may know of this reader. `None` until the reader is matched.
  progress: Option<SharedProgress>,
  // Of the samples that the reader acknowledged before it went back and that are no longer
  // retained, those that the history has. `None` once it has acknowledged them again.
  offered_again: Option<OfferedHistory>,
  // Samples before this that the reader missed are counted in `progress`.
  overrun_counted_before: SequenceNumber,

  // List of SequenceNumbers to be sent to Reader. Both unsent and requested by ACKNACK.
  unsent_changes: BTreeSet<SequenceNumber>,

  // Messages that we are not going to send to this Reader.
  // We will send the SNs as GAP until they have been acked.
  // This is to be used in Reliable mode only.
  pending_gap: BTreeSet<SequenceNumber>,
  // true = send repair data messages due to NACKs, buffer messages by DataWriter
  // false = send data messages directly from DataWriter
  pub repair_mode: bool,
  // A SendRepairData / SendRepairFrags timer for this reader is pending. Keeps
  // each reader to one repair round at a time, however many ACKNACKs arrive.
  pub repair_data_scheduled: bool,
  pub repair_frags_scheduled: bool,
  // Count of the last ACKNACK / NACK_FRAG accepted from this reader. A reader
  // sends one ACKNACK to each of our locators; the copies carry the same count.
  pub last_acknack_count: Option<i32>,
  // The base of that ACKNACK. A reader that was matched anew on its side counts
  // from the beginning again, so an equal count alone makes no copy.
  pub last_acknack_base: SequenceNumber,
  pub last_nackfrag_count: Option<i32>,
  // When requests of this reader would have come one each NACK_RESPONSE_DELAY.
  requests_spaced_until: Option<Instant>,
  repairs_under_way: RepairsUnderWay,
  qos: QosPolicies,
  frags_requested: BTreeMap<SequenceNumber, BitVec>,

  // Interface-aware transmit: the resolved send destination for this reader,
  // recomputed when locators or observations change. Defaults to the fallback
  // (legacy all-locators) route until resolved.
  send_route: SendRoute,

  // Per-peer path-MTU budget: the number of bytes available for RTPS
  // submessages in one datagram sent to this reader, derived from the local
  // egress interface's MTU (same-subnet peer) or the conservative default
  // (`FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE`) for peers behind a router / unresolved.
  // Recomputed alongside `send_route`. Used to bound submessage packing and
  // multi-fragment DATAFRAG datagrams. An overestimate only causes IP
  // fragmentation, never data loss.
  max_datagram_payload: usize,

  // The path to the reader loses packets. Until then it gets large samples in datagrams
  // of one packet, see LARGE_SAMPLE_DATAGRAM.
  small_datagrams_until: Option<Instant>,

  // The first sample of which every fragment was sent to it. Requests for those before say
  // nothing of the path: they were withheld while the reader was joining, or a former
  // Writer was sending them.
  sent_whole_from: SequenceNumber,
}

impl RtpsReaderProxy {
  pub fn new(remote_reader_guid: GUID, qos: QosPolicies, expects_in_line_qos: bool) -> Self {
    Self {
      remote_reader_guid,
      remote_group_entity_id: EntityId::UNKNOWN,
      unicast_locator_list: Vec::default(),
      multicast_locator_list: Vec::default(),
      loopback_unicast_locators: Vec::default(),
      expects_in_line_qos,
      is_active: true,
      acknacks_while_joining: None,
      all_acked_before: SequenceNumber::zero(),
      progress: None,
      offered_again: None,
      overrun_counted_before: SequenceNumber::zero(),
      unsent_changes: BTreeSet::new(),
      pending_gap: BTreeSet::new(),
      repair_mode: false,
      repair_data_scheduled: false,
      repair_frags_scheduled: false,
      last_acknack_count: None,
      last_acknack_base: SequenceNumber::zero(),
      last_nackfrag_count: None,
      requests_spaced_until: None,
      repairs_under_way: RepairsUnderWay::default(),
      qos,
      frags_requested: BTreeMap::new(),
      send_route: SendRoute::default(),
      max_datagram_payload: FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE,
      small_datagrams_until: None,
      sent_whole_from: SequenceNumber::zero(),
    }
  }

  // We get a (discovery) update on the properties of this remote Reader.
  // Update those properties that Discovery tells us, but keep run-time data.
  pub fn update(&mut self, update: &Self, topic: &str) {
    if self.remote_reader_guid != update.remote_reader_guid {
      error!("Update tried to change ReaderProxy GUID!"); // This is like
                                                          // changing primary
                                                          // key
                                                          // Refuse to update
    }
    if self.remote_group_entity_id != update.remote_group_entity_id {
      error!("Update tried to change ReaderProxy group entity id!"); // almost the same?
                                                                     // Refuse to update
    }

    // `update` may have loopback locators inline, see below.
    let differs = |(unicasts, loopbacks): (Vec<Locator>, Vec<Locator>)| {
      self.unicast_locator_list != unicasts
        || (!loopbacks.is_empty() && self.loopback_unicast_locators != loopbacks)
    };
    if differs(Self::split_loopback(&update.unicast_locator_list))
      || self.multicast_locator_list != update.multicast_locator_list
    {
      info!("Update changes Locators in ReaderProxy. topic={topic:?}");
      info!(
        "Unicast:\n  Old={:?}\n  New={:?}",
        self.unicast_locator_list, update.unicast_locator_list
      );
      info!(
        "Multicast:\n Old={:?}\n  New={:?}",
        self.multicast_locator_list, update.multicast_locator_list
      );
      // The incoming proxy may carry loopback either inline (built-in path via
      // `get_builtin_reader_proxy`) or already split into its bucket (discovered
      // path). Recombine both before splitting so the invariant holds regardless
      // of how `update` was constructed.
      let combined: Vec<Locator> = update
        .unicast_locator_list
        .iter()
        .chain(update.loopback_unicast_locators.iter())
        .copied()
        .collect();
      let (unicasts, loopbacks) = Self::split_loopback(&combined);
      self.unicast_locator_list = unicasts;
      self.loopback_unicast_locators = loopbacks;
      self
        .multicast_locator_list
        .clone_from(&update.multicast_locator_list);
    }

    self.expects_in_line_qos = update.expects_in_line_qos;

    // Apply QoS policies that are defined (only).
    // Undefined policies do not modify.
    let updated_qos = self.qos.modify_by(&update.qos);

    if self.qos != updated_qos {
      warn!("Update changes QoS in ReaderProxy topic={topic:?}.");
      info!(
        "  details:\n  Old: {:?}\n  New: {:?}",
        self.qos, updated_qos
      );
      self.qos = updated_qos;
    }
  }

  pub fn qos(&self) -> &QosPolicies {
    &self.qos
  }

  pub fn expects_inline_qos(&self) -> bool {
    self.expects_in_line_qos
  }

  /// The reader is matched: it is owed what it is offered, and nothing before.
  /// A reader of a built-in topic acknowledges from the beginning.
  pub fn start_progress(&mut self, progress: SharedProgress, is_builtin: bool) {
    if !is_builtin {
      self.all_acked_before = progress.first_offered();
    }
    self.progress = Some(progress);
  }

  /// The reader is joining: it may not have matched the Writer yet.
  ///
  /// A Writer often knows a reader before the reader knows the Writer. What is sent to
  /// it meanwhile is lost, and a VOLATILE reader of Cyclone DDS takes every sample up to
  /// the end of its first HEARTBEAT for history. So a joining reader gets no samples,
  /// and HEARTBEATs that end before the first sample that it is offered.
  pub fn start_joining(&mut self) {
    self.acknacks_while_joining = Some(0);
  }

  pub fn is_joining(&self) -> bool {
    self.acknacks_while_joining.is_some()
  }

  /// Whether an ACKNACK shows that a joining reader has had a HEARTBEAT.
  ///
  /// Base 0 (Fast DDS) or 1 (Cyclone DDS) shows it only when the Writer answered an
  /// ACKNACK before: both repeat it until they have a HEARTBEAT. A reader that sends
  /// nothing else is served after `JOINING_MAX_ACKNACKS`.
  pub fn ends_joining(&mut self, acknack: &AckNack) -> bool {
    let first_offered = self.first_offered();
    let Some(acknacks) = &mut self.acknacks_while_joining else {
      return false;
    };
    let one = SequenceNumber::from(1);
    let base = acknack.reader_sn_state.base();
    let has_heartbeat = base > first_offered.max(one)
      || (base == first_offered && (base > one || *acknacks > 0))
      || acknack.reader_sn_state.iter().any(|sn| sn >= first_offered);
    if has_heartbeat || *acknacks >= JOINING_MAX_ACKNACKS {
      self.acknacks_while_joining = None;
      return true;
    }
    *acknacks += 1;
    false
  }

  /// A reader of the writer that this one continues, which has lost its state of that one, gets
  /// nothing from before it was matched. To be called with its first ACKNACK.
  pub fn begin_anew_if_reset(&mut self, acknack: &AckNack) {
    let one = SequenceNumber::from(1);
    if let Some(progress) = self.progress.as_ref() {
      let first = progress.first_if_reset();
      if acknack.reader_sn_state.base() <= one && progress.first_offered() > one {
        self.all_acked_before = self.all_acked_before.max(first);
        progress.set_acked_before(self.all_acked_before);
      }
    }
  }

  /// The first sample that the reader is offered.
  pub fn first_offered(&self) -> SequenceNumber {
    self
      .progress
      .as_ref()
      .map_or_else(SequenceNumber::zero, |progress| progress.first_offered())
  }

  // If the reader is not offered this sample of the history, the next one that it is.
  fn offered_after(&self, sequence_number: SequenceNumber) -> Option<SequenceNumber> {
    match self.again_with(sequence_number) {
      Some(again) => again.offered_after(sequence_number),
      None => self.progress.as_ref()?.offered_after(sequence_number),
    }
  }

  /// Whether the reader is offered this sample of the history.
  pub fn offers_of_history(&self, sequence_number: SequenceNumber) -> bool {
    match self.again_with(sequence_number) {
      Some(again) => again.listed.contains(&sequence_number),
      None => {
        let progress = self.progress.as_ref();
        progress.is_some_and(|progress| progress.offers_of_history(sequence_number))
      }
    }
  }

  // What is offered again, if it ends after this sample.
  fn again_with(&self, sequence_number: SequenceNumber) -> Option<&OfferedHistory> {
    let again = self.offered_again.as_ref();
    again.filter(|again| sequence_number < again.before)
  }

  /// The reader went back behind samples that it has acknowledged. It gets those of them that
  /// the history has, as a new late joiner does. A GAP alone tells it that the others are gone,
  /// of which no fragment is sent to it any more.
  ///
  /// One that goes back once more before it has them keeps this list: it may have fragments of
  /// a listed sample that is gone by then.
  pub fn offer_again(&mut self, history: OfferedHistory) {
    let has_some = history.listed.range(self.all_acked_before..).next().is_some();
    if self.offered_again.is_none() && has_some {
      self.offered_again = Some(history);
    }
  }

  /// Whether it went back, and has not acknowledged the kept samples again.
  pub fn is_offered_again(&self) -> bool {
    self.offered_again.is_some()
  }

  // How many samples of this range the reader is offered.
  fn offered_between(&self, first: SequenceNumber, before: SequenceNumber) -> u64 {
    match &self.progress {
      Some(progress) => progress.offered_between(first, before),
      None => u64::try_from(i64::from(before) - i64::from(first)).unwrap_or(0),
    }
  }

  /// If the first sample requested is one that the reader is not offered, takes the
  /// requests up to the next one that it is, and returns these two numbers: one GAP tells
  /// it of any number of samples. The reader will request the next one, too.
  pub fn take_unoffered_requests(&mut self) -> Option<(SequenceNumber, SequenceNumber)> {
    let first = self.first_unsent_change()?;
    let before = self.offered_after(first)?;
    self.unsent_changes = self.unsent_changes.split_off(&before);
    let is_offered = self.offers_of_history(before);
    if is_offered && !self.repairs_under_way.is_under_way(before, Instant::now()) {
      self.unsent_changes.insert(before);
    }
    Some((first, before))
  }

  // Counts `missed` samples, all of them before `before`, once.
  fn add_overrun(&mut self, missed: u64, before: SequenceNumber) {
    self.overrun_counted_before = max(self.overrun_counted_before, before);
    if let Some(progress) = &self.progress {
      progress.add_overrun(missed);
    }
  }

  /// Whether a request of this reader is answered, or one too many.
  pub fn accepts_request(&mut self, now: Instant) -> bool {
    let spaced_until = self
      .requests_spaced_until
      .map_or(now, |spaced_until| spaced_until.max(now));
    let is_accepted = spaced_until - now < NACK_RESPONSE_DELAY * REQUESTS_BURST;
    if is_accepted {
      self.requests_spaced_until = Some(spaced_until + NACK_RESPONSE_DELAY);
    }
    is_accepted
  }

  /// Takes samples that the reader requested and that are no longer retained, those
  /// before `first_available`, counts them as missed, and returns them for a GAP:
  /// the first ones, as many as a GAP can list. A reader that lacks nearly everything
  /// gets one GAP for all that is gone: 256 samples in each round trip would not catch
  /// up with 1 kHz behind 200 ms.
  /// Of those in `withdrawn`, the reader misses nothing.
  pub fn take_evicted_requests(
    &mut self,
    first_available: SequenceNumber,
    withdrawn: &BTreeSet<SequenceNumber>,
  ) -> EvictedRequests {
    let still_retained = self.unsent_changes.split_off(&first_available);
    let mut evicted = std::mem::replace(&mut self.unsent_changes, still_retained);
    let Some(&first) = evicted.first() else {
      return EvictedRequests::Listed(evicted);
    };
    let mut further = evicted.split_off(&(first + SequenceNumber::from(GAP_MAX_SPAN)));
    let last = evicted.last().copied().unwrap_or(first);

    let uncounted = |sn: &&SequenceNumber| {
      **sn >= self.overrun_counted_before
        && **sn >= self.first_offered()
        && self.offered_after(**sn).is_none()
        && !withdrawn.contains(sn)
    };
    let missed = evicted.iter().filter(uncounted).count() as u64;
    let counted_before = last.plus_1();
    let span = i64::from(counted_before) - i64::from(first);
    if evicted.len() >= BULK_GAP_MIN_SAMPLES && span <= 2 * evicted.len() as i64 {
      let unknown_from = max(counted_before, self.overrun_counted_before);
      let unknown = self.offered_between(unknown_from, first_available);
      let withdrawn = if unknown_from < first_available {
        withdrawn.range(unknown_from..first_available).count()
      } else {
        0
      };
      let unknown = unknown.saturating_sub(withdrawn as u64);
      self.add_overrun(missed + unknown, first_available);
      return EvictedRequests::AllFrom {
        first,
        before: first_available,
      };
    }
    further.append(&mut self.unsent_changes);
    self.unsent_changes = further;
    self.add_overrun(missed, counted_before);
    EvictedRequests::Listed(evicted)
  }

  pub fn unsent_changes_iter(
    &self,
  ) -> impl std::iter::DoubleEndedIterator<Item = SequenceNumber> + '_ {
    self.unsent_changes.iter().cloned()
  }

  // used to produce log messages
  pub fn unsent_changes_debug(&self) -> Vec<SequenceNumber> {
    self.unsent_changes_iter().collect()
  }

  pub fn first_unsent_change(&self) -> Option<SequenceNumber> {
    self.unsent_changes_iter().next()
  }

  pub fn mark_change_sent(&mut self, seq_num: SequenceNumber) {
    self.unsent_changes.remove(&seq_num);
  }

  /// The sample was sent to this reader as a repair.
  pub fn mark_change_repaired(&mut self, seq_num: SequenceNumber, now: Instant) {
    self.mark_change_sent(seq_num);
    self.repairs_under_way.sent(seq_num, now);
  }

  // Changes are actually sent (via DATA/DATAFRAG) or reported missing as GAP
  pub fn remove_from_unsent_set_all_before(&mut self, before_seq_num: SequenceNumber) {
    // The handy split_off function "Returns everything after the given key,
    // including the key."
    self.unsent_changes = self.unsent_changes.split_off(&before_seq_num);
  }

  /// The unicast and multicast addresses that a reader of a user's topic announces.
  pub fn user_traffic_locators(
    self_locators: &HashMap<Token, Vec<Locator>>,
    is_urgent: bool,
  ) -> (Vec<Locator>, Vec<Locator>) {
    let of = |token| self_locators.get(&token).cloned().unwrap_or_default();
    if is_urgent {
      (of(URGENT_TRAFFIC_LISTENER_TOKEN), Vec::new())
    } else {
      (
        of(USER_TRAFFIC_LISTENER_TOKEN),
        of(USER_TRAFFIC_MUL_LISTENER_TOKEN),
      )
    }
  }

  pub fn from_reader(reader: &ReaderIngredients, domain_participant: &DomainParticipant) -> Self {
    let mut self_locators = domain_participant.self_locators(); // This clones a map of locator lists.
    let (unicast_locator_list, multicast_locator_list) =
      if reader.guid.entity_id.kind().is_user_defined() {
        let is_urgent = domain_participant
          .urgent_topics()
          .contains(&reader.topic_name);
        Self::user_traffic_locators(&self_locators, is_urgent)
      } else {
        let mut take = |token| self_locators.remove(&token).unwrap_or_default();
        (
          take(DISCOVERY_LISTENER_TOKEN),
          take(DISCOVERY_MUL_LISTENER_TOKEN),
        )
      };
    Self {
      remote_reader_guid: reader.guid,
      remote_group_entity_id: EntityId::UNKNOWN, // TODO
      unicast_locator_list,
      multicast_locator_list,
      // `from_reader` builds the proxy we *advertise* for a local reader (via
      // SEDP), so loopback stays in `unicast_locator_list` here; the bucket is
      // only meaningful for proxies used as live send destinations.
      loopback_unicast_locators: Vec::new(),
      // Cyclone DDS does not match a Reader that expects it.
      expects_in_line_qos: false,
      is_active: true,
      acknacks_while_joining: None,
      all_acked_before: SequenceNumber::zero(),
      progress: None,
      offered_again: None,
      overrun_counted_before: SequenceNumber::zero(),
      unsent_changes: BTreeSet::new(),
      pending_gap: BTreeSet::new(),
      repair_mode: false,
      repair_data_scheduled: false,
      repair_frags_scheduled: false,
      last_acknack_count: None,
      last_acknack_base: SequenceNumber::zero(),
      last_nackfrag_count: None,
      requests_spaced_until: None,
      repairs_under_way: RepairsUnderWay::default(),
      qos: reader.qos_policy.clone(),
      frags_requested: BTreeMap::new(),
      send_route: SendRoute::default(),
      max_datagram_payload: FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE,
      small_datagrams_until: None,
      sent_whole_from: SequenceNumber::zero(),
    }
  }

  fn discovered_or_default(drd: &[Locator], default: &[Locator]) -> Vec<Locator> {
    let announced = if drd.is_empty() { default } else { drd };
    let mut locators = announced.to_vec();
    keep_first_locators(&mut locators);
    locators
  }

  // OpenDDS (and RustDDS itself) advertise the loopback address as a Locator,
  // which is problematic if we are *not* on the same host. Rather than discard
  // it outright, partition the advertised unicast locators into non-loopback
  // (returned first, used by the normal/fallback send path) and loopback
  // (returned second, used only once the peer is confirmed same-host). See
  // `src/rtps/loopback_same_host_design.md`.
  fn split_loopback(locators: &[Locator]) -> (Vec<Locator>, Vec<Locator>) {
    locators.iter().copied().partition(|l| !l.is_loopback())
  }

  /// Enforce the loopback-bucket invariant: any loopback address in
  /// `unicast_locator_list` is moved into `loopback_unicast_locators`.
  /// Idempotent. Applied to freshly-inserted proxies (e.g. the built-in
  /// `get_builtin_reader_proxy` path, which fills `unicast_locator_list`
  /// inline) so loopback is never used by the non-same-host send path. See
  /// `src/rtps/loopback_same_host_design.md`.
  pub fn normalize_loopback(&mut self) {
    if self.unicast_locator_list.iter().any(Locator::is_loopback) {
      let combined: Vec<Locator> = self
        .unicast_locator_list
        .iter()
        .chain(self.loopback_unicast_locators.iter())
        .copied()
        .collect();
      let (unicasts, loopbacks) = Self::split_loopback(&combined);
      self.unicast_locator_list = unicasts;
      self.loopback_unicast_locators = loopbacks;
    }
  }

  pub fn from_discovered_reader_data(
    discovered_reader_data: &DiscoveredReaderData,
    default_unicast_locators: &[Locator],
    default_multicast_locators: &[Locator],
  ) -> Self {
    let advertised_unicast = Self::discovered_or_default(
      &discovered_reader_data.reader_proxy.unicast_locator_list,
      default_unicast_locators,
    );
    let (unicast_locator_list, loopback_unicast_locators) =
      Self::split_loopback(&advertised_unicast);

    let multicast_locator_list = Self::discovered_or_default(
      &discovered_reader_data.reader_proxy.multicast_locator_list,
      default_multicast_locators,
    );

    Self {
      remote_reader_guid: discovered_reader_data.reader_proxy.remote_reader_guid,
      remote_group_entity_id: EntityId::UNKNOWN, // TODO
      unicast_locator_list,
      multicast_locator_list,
      loopback_unicast_locators,
      expects_in_line_qos: discovered_reader_data.reader_proxy.expects_inline_qos,
      is_active: true,
      acknacks_while_joining: None,
      all_acked_before: SequenceNumber::zero(),
      progress: None,
      offered_again: None,
      overrun_counted_before: SequenceNumber::zero(),
      unsent_changes: BTreeSet::new(),
      pending_gap: BTreeSet::new(),
      repair_mode: false,
      repair_data_scheduled: false,
      repair_frags_scheduled: false,
      last_acknack_count: None,
      last_acknack_base: SequenceNumber::zero(),
      last_nackfrag_count: None,
      requests_spaced_until: None,
      repairs_under_way: RepairsUnderWay::default(),
      qos: discovered_reader_data.subscription_topic_data.qos(),
      frags_requested: BTreeMap::new(),
      send_route: SendRoute::default(),
      max_datagram_payload: FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE,
      small_datagrams_until: None,
      sent_whole_from: SequenceNumber::zero(),
    }
  }

  /// The currently resolved [`SendRoute`] for this reader.
  pub fn send_route(&self) -> SendRoute {
    self.send_route
  }

  /// Recompute this reader's [`SendRoute`] from its advertised locators and the
  /// per-participant [`InterfaceObservations`], using `selector`.
  pub fn resolve_send_route(
    &mut self,
    observations: &InterfaceObservations,
    local_multicast_ifaces: &[InterfaceSelector],
    selector: &dyn RouteSelector,
  ) {
    let observed = observations.get(self.remote_reader_guid.prefix);
    let substitutes;
    let mut loopback_unicast_locators = &self.loopback_unicast_locators;
    if loopback_unicast_locators.is_empty() && observed.is_some_and(|it| it.is_same_host()) {
      substitutes = self.loopback_substitutes(observations);
      loopback_unicast_locators = &substitutes;
    }
    self.send_route = selector.select(
      &self.unicast_locator_list,
      &self.multicast_locator_list,
      loopback_unicast_locators,
      observed,
      local_multicast_ifaces,
    );
  }

  /// Where a reader on this host is reached that announces none but addresses which
  /// this host has no longer: Fast DDS and Cyclone DDS announce the address that
  /// `eth0` had when they were started, whatever becomes of it, and bind their
  /// sockets to all addresses. Empty while one of the announced addresses is there.
  fn loopback_substitutes(&self, observations: &InterfaceObservations) -> Vec<Locator> {
    let announced = || {
      self
        .unicast_locator_list
        .iter()
        .filter_map(|locator| match locator {
          Locator::UdpV4(address) => Some(SocketAddr::V4(*address)),
          _ => None,
        })
    };
    if announced().any(|address| observations.is_own_address(address.ip())) {
      return Vec::new();
    }
    announced()
      .map(|address| Locator::from(SocketAddr::from((Ipv4Addr::LOCALHOST, address.port()))))
      .collect()
  }

  /// The per-peer datagram-payload budget (bytes for RTPS submessages in one
  /// datagram) resolved for this reader. Defaults to
  /// [`FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE`] until [`resolve_path_mtu`] runs.
  ///
  /// [`resolve_path_mtu`]: Self::resolve_path_mtu
  pub fn max_datagram_payload(&self) -> usize {
    self.max_datagram_payload
  }

  /// The bytes of submessages in one datagram of a sample that is written, which is not
  /// repaired.
  pub fn written_budget(&self, payload_size: usize) -> usize {
    if payload_size < LARGE_SAMPLE_BYTES || self.small_datagrams_until.is_some() {
      self.max_datagram_payload
    } else {
      self.max_datagram_payload.max(LARGE_SAMPLE_DATAGRAM)
    }
  }

  /// Whether a request for fragments shows that the path loses packets: the first
  /// fragments of a large sample fit any receive buffer, and most of them are missing.
  /// With 28 % of packets lost, 4 % of the datagrams of ten packets arrive.
  pub fn shows_loss(requested: &FragmentNumberSet, fragment_count: u32) -> bool {
    let is_large = fragment_count as usize * FRAGMENT_SIZE >= LARGE_SAMPLE_BYTES;
    // A set names its base and the 255 numbers after it, at most. Beyond `u32` they
    // would overflow.
    is_large
      && u32::from(requested.base()) <= OBSERVED_FRAGMENTS
      && requested
        .iter()
        .map(u32::from)
        .filter(|number| (1..=OBSERVED_FRAGMENTS).contains(number))
        .count() as u32
        >= OBSERVED_FRAGMENTS / 2
  }

  /// From this sample on, every fragment is sent to the reader.
  pub fn send_whole_from(&mut self, first: SequenceNumber) {
    self.sent_whole_from = first;
  }

  /// Whether no fragment of the sample was withheld from the reader, if it was sent.
  pub fn was_sent_whole(&self, sn: SequenceNumber) -> bool {
    self.sent_whole_from <= sn
  }

  /// Sends large samples in datagrams of one packet for a while.
  pub fn send_small_datagrams(&mut self, now: Instant) {
    self.small_datagrams_until = Some(now + SMALL_DATAGRAMS_PERIOD);
  }

  /// Sends large samples in large datagrams again when the period is over.
  pub fn retry_large_datagrams(&mut self, now: Instant) {
    self.small_datagrams_until = self.small_datagrams_until.filter(|until| now < *until);
  }

  /// Recompute this reader's
  /// [`max_datagram_payload`](Self::max_datagram_payload) from its advertised
  /// unicast locators and the local interface table.
  ///
  /// We take the minimum budget over all of the reader's unicast locators
  /// (including the loopback bucket) so that whichever path the [`SendRoute`]
  /// ends up using, the datagram fits. A loopback locator resolves to the
  /// (typically large) loopback-interface MTU, so it never lowers the minimum;
  /// its only effect is to give a same-host-only peer (which advertises *only*
  /// loopback) the large loopback budget instead of the conservative default.
  /// When the reader advertises no unicast locators at all, we keep the
  /// default.
  ///
  /// # Design note: current vs. ideal (future work)
  ///
  /// What could be improved: today a peer only gets a larger-than-fallback
  /// budget if *every* advertised unicast address clears the bar (IPv4,
  /// same-subnet as a local interface, OS-reported MTU > 1500), or if it
  /// advertises loopback only. Ideally it should suffice that the *single
  /// locator we actually send to* has a large MTU (e.g. one jumbo-frame
  /// same-subnet address should win even when the peer also advertises an
  /// ordinary 1500-MTU address).
  ///
  /// Why we take the conservative `min` now: the budget is a single per-reader
  /// scalar, fixed here and consumed at message-build time, and the resulting
  /// datagram can legitimately be sent to *all* of the peer's locators (the
  /// `SendRoute { fallback: true }` path in `Writer::send_message_to_readers`,
  /// and the multicast-to-all path via `min_datagram_payload`). So it must fit
  /// the smallest MTU among them; an overestimate would cause IP fragmentation
  /// on the copies aimed at the smaller-MTU locators.
  ///
  /// Three things missing before "some locator suffices" would be correct:
  /// 1. MTU resolved *per chosen route/locator* rather than as this per-reader
  ///    `min` scalar decoupled from route selection.
  /// 2. A route selector that *deterministically prefers* the large-MTU locator
  ///    (today `DefaultRouteSelector::select_unicast` narrows by observed
  ///    source IP, not by subnet/MTU, and otherwise falls back to all
  ///    locators).
  /// 3. A guarantee that a datagram built with the larger budget is sent to
  ///    *only* that one locator (today the fallback and multicast-to-all paths
  ///    reuse one datagram across many locators).
  pub fn resolve_path_mtu(&mut self, local_interfaces: &[IfAddr]) {
    let budget = self
      .unicast_locator_list
      .iter()
      .chain(self.loopback_unicast_locators.iter())
      .filter(|l| l.is_udp())
      .map(|l| path_mtu_payload_for_peer(local_interfaces, SocketAddr::from(*l).ip()))
      .min();
    self.max_datagram_payload = budget.unwrap_or(FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE);
  }

  pub fn handle_ack_nack(
    &mut self,
    ack_submessage: &AckSubmessage,
    last_available: SequenceNumber,
    advertised_first: SequenceNumber,
    serves_history: bool,
  ) {
    match ack_submessage {
      AckSubmessage::AckNack(acknack) => {
        // Eliminate case that base = 0
        let mut new_all_acked_before = max(acknack.reader_sn_state.base(), SequenceNumber::from(1));
        // Sending acknack with sn_state base = 0 should not happen.
        // This is not allowed by  SequenceNumberSet
        // validity rules (RTPS Spec v2.5 "8.3.5.5 SequenceNumberSet")
        //
        // The correct way to acknowledge that nothing has been received is to
        // send ACKNACK with reader_sn_state.base = 1 and empty set contents.
        // This means everything before 1 has been received, but since
        // sequence numbering starts at 1 by definition
        // (in Section 8.3.5.4 SequenceNumber), it means "nothing"
        //
        // This is logged in `writer` object.

        // Ignore ACKNACK whose readerSNState.base claims ack beyond last_seq + 1 (the
        // writer's last change sequence number). Matches reliable writer/reader
        // semantics; a forged base would otherwise pin all_acked_before and
        // block real ACKNACKs (issue #405).
        let max_plausible_acked_before = last_available.plus_1();
        if new_all_acked_before > max_plausible_acked_before {
          debug!(
            "Ignoring ACKNACK: base {:?} implies ack through unsent data (last sent seq={:?}, max \
             plausible all-acked-before {:?}) reader={:x?}",
            new_all_acked_before,
            last_available,
            max_plausible_acked_before,
            self.remote_reader_guid
          );
          return;
        }

        let now = Instant::now();
        self.repairs_under_way.acknowledged(acknack, now);

        // The reader acknowledges less than before. Either an older ACKNACK was
        // overtaken by a newer one, or the reader's participant discarded ours when
        // our lease expired there, and has matched us anew: then the reader has no
        // state of us and waits for what it acknowledged before.
        // An overtaken one costs a repeated repair, which the next ACKNACK ends. A
        // reader that is ignored here waits for ever.
        if new_all_acked_before < self.all_acked_before {
          debug!(
            "ACKNACK moves all_acked_before backwards: old={:?} new={:?} reader={:x?} count={}",
            self.all_acked_before, new_all_acked_before, self.remote_reader_guid, acknack.count
          );
          if serves_history {
            // What it acknowledged before is no loss when it is gone by now.
            self.overrun_counted_before = max(self.overrun_counted_before, self.all_acked_before);
            new_all_acked_before = max(new_all_acked_before, self.first_offered());
          } else {
            // What it acknowledged is not delivered a second time: the Writer answers
            // with a GAP. What it has not acknowledged, as far as it is retained, is sent.
            for nack_sn in acknack.reader_sn_state.iter() {
              if nack_sn >= self.all_acked_before
                && nack_sn <= last_available
                && !self.repairs_under_way.is_under_way(nack_sn, now)
              {
                self.unsent_changes.insert(nack_sn);
              }
            }
            return;
          }
        }
        // What no HEARTBEAT offers any more the reader skips without a request.
        let skipped_from = max(self.all_acked_before, self.overrun_counted_before);
        let skipped_before = new_all_acked_before.min(advertised_first);
        if skipped_before > skipped_from {
          let skipped = self.offered_between(skipped_from, skipped_before);
          self.add_overrun(skipped, skipped_before);
        }
        self.remove_from_unsent_set_all_before(new_all_acked_before);
        self.all_acked_before = new_all_acked_before;
        if let Some(progress) = &self.progress {
          progress.set_acked_before(new_all_acked_before);
        }
        self.frags_requested = self.frags_requested.split_off(&new_all_acked_before);
        self.offered_again = self
          .offered_again
          .take()
          .filter(|again| new_all_acked_before < again.before);

        // Insert the requested changes. These are (by construction) greater
        // then new_all_acked_before.
        for nack_sn in acknack.reader_sn_state.iter() {
          if nack_sn >= new_all_acked_before
            && !self.repairs_under_way.is_under_way(nack_sn, now)
          {
            self.unsent_changes.insert(nack_sn);
          }
        }
        // sanity check
        if let Some(&high) = self.unsent_changes.iter().next_back() {
          if high > last_available {
            debug!(
              "ReaderProxy {:?} asks for {:?} but I have only up to {:?}. Truncating request. \
               ACKNACK = {:?}",
              self.remote_reader_guid, self.unsent_changes, last_available, acknack
            );
            // Requesting something which is not yet available is unreasonable.
            // Ignore the request from last_available + 1 onwards.
            self.unsent_changes.split_off(&last_available.plus_1());
          }
        }
        // AckNack also clears pending_gap
        self.pending_gap = self.pending_gap.split_off(&self.all_acked_before);
      }

      AckSubmessage::NackFrag(_nack_frag) => {
        // TODO
        error!("NACKFRAG not implemented");
      }
    }
  }

  pub fn insert_pending_gap(&mut self, seq_num: SequenceNumber) {
    self.pending_gap.insert(seq_num);
  }

  /// Not requested: what comes after `last_sent` will be sent without it.
  pub fn forget_unsent_after(&mut self, last_sent: SequenceNumber) {
    self.unsent_changes.split_off(&last_sent.plus_1());
  }

  /// The reader asks for this sample.
  pub fn request_change(&mut self, sequence_number: SequenceNumber) {
    self.unsent_changes.insert(sequence_number);
  }

  /// These samples are to be sent to the reader.
  pub fn request_changes(&mut self, range: std::ops::Range<SequenceNumber>) {
    let mut next = range.start;
    while next < range.end {
      self.unsent_changes.insert(next);
      next = next.plus_1();
    }
  }

  /// Whether everything for this reader goes over loopback.
  pub fn is_reached_over_loopback(&self) -> bool {
    !self.send_route.fallback
      && self
        .send_route
        .unicast
        .is_some_and(|locator| locator.is_loopback())
  }

  pub fn get_pending_gap(&self) -> &BTreeSet<SequenceNumber> {
    &self.pending_gap
  }

  /// this should be called every time a new CacheChange is set to RTPS writer
  /// HistoryCache
  pub fn notify_new_cache_change(&mut self, sequence_number: SequenceNumber) {
    if sequence_number == SequenceNumber::from(0) {
      error!(
        "new cache change with {:?}! bad! my GUID = {:?}",
        sequence_number, self.remote_reader_guid
      );
    }
    self.unsent_changes.insert(sequence_number);

    // Memory-safety backstop: never let this set grow without bound. In normal
    // operation it is pruned as samples are pushed (see Writer::process_pending)
    // or acknowledged (handle_ack_nack), but a best-effort flood sends no
    // ACKNACKs, so cap the set and drop the oldest (least-useful-to-resend)
    // entries if it ever exceeds the cap.
    while self.unsent_changes.len() > MAX_UNSENT_CHANGES_PER_READER {
      if let Some(&oldest) = self.unsent_changes.iter().next() {
        self.unsent_changes.remove(&oldest);
      } else {
        break;
      }
    }
  }

  #[cfg(test)]
  pub fn unsent_changes_count(&self) -> usize {
    self.unsent_changes.len()
  }

  pub fn acked_up_to_before(&self) -> SequenceNumber {
    self.all_acked_before
  }

  /// The first offered sample that the reader has neither acknowledged nor, as far as is
  /// counted, missed.
  pub fn unknown_from(&self) -> SequenceNumber {
    let known_before = max(self.all_acked_before, self.overrun_counted_before);
    max(known_before, self.first_offered())
  }

  // Fragment handling

  /// `fragment_count` is how many fragments the sample has. What the set claims
  /// beyond it, or before the first one, is not requested: a NACK_FRAG costs no
  /// more than the sample that it is about.
  pub fn mark_frags_requested(
    &mut self,
    seq_num: SequenceNumber,
    frag_nums: &FragmentNumberSet,
    fragment_count: u32,
  ) {
    // A set names its base and the 255 numbers after it, at most.
    if u32::from(frag_nums.base()) < 1 || u32::from(frag_nums.base()) > fragment_count {
      return;
    }
    // FragmentNumbers start at 1
    let requested = frag_nums
      .iter()
      .map(u32::from)
      .filter(|f| (1..=fragment_count).contains(f));
    for f in requested {
      self
        .frags_requested
        .entry(seq_num)
        .or_insert_with(|| BitVec::from_elem(fragment_count as usize, false))
        .set(f as usize - 1, true);
    }
  }

  /// The first run of requested fragments of the lowest sample that any are
  /// requested of: its sequence number, the number of the first fragment and how
  /// many follow one another, `max_run` at most.
  pub fn first_requested_frags(&self, max_run: u32) -> Option<(SequenceNumber, u32, u32)> {
    let (&seq_num, requested) = self.frags_requested.iter().find(|(_, rf)| rf.any())?;
    // By words of 32, the lowest bit first: the set of a large sample is long.
    let (word, bits) = requested
      .blocks()
      .enumerate()
      .find(|(_, bits)| *bits != 0)?;
    let start = word * 32 + bits.trailing_zeros() as usize;
    let run = (start..start + max_run as usize)
      .take_while(|index| requested.get(*index) == Some(true))
      .count();
    Some((seq_num, start as u32 + 1, run as u32))
  }

  /// The fragments are on their way, or cannot be had: no longer requested.
  pub fn mark_frags_sent(&mut self, seq_num: SequenceNumber, start: u32, count: u32) {
    if let Some(requested) = self.frags_requested.get_mut(&seq_num) {
      for f in start..start.saturating_add(count) {
        let index = f as usize - 1;
        if index < requested.len() {
          requested.set(index, false);
        }
      }
      if requested.none() {
        self.frags_requested.remove(&seq_num);
      }
    }
  }

  /// The sample is acknowledged, or gone.
  pub fn forget_requested_frags(&mut self, seq_num: SequenceNumber) {
    self.frags_requested.remove(&seq_num);
  }

  pub fn repair_frags_requested(&self) -> bool {
    self.frags_requested.values().any(|rf| rf.any())
  }
}

// pub enum ChangeForReaderStatusKind {
//   UNSENT,
//   NACKNOWLEDGED,
//   REQUESTED,
//   ACKNOWLEDGED,
//   UNDERWAY,
// }

// ///The RTPS ChangeForReader is an association class that maintains
// information of a CacheChange in the RTPS ///Writer HistoryCache as it
// pertains to the RTPS Reader represented by the ReaderProxy pub struct
// RTPSChangeForReader {   ///Indicates the status of a CacheChange relative to
// the RTPS Reader represented by the ReaderProxy.   pub kind:
// ChangeForReaderStatusKind,   ///Indicates whether the change is relevant to
// the RTPS Reader represented by the ReaderProxy.   pub is_relevant: bool,
// }

// impl RTPSChangeForReader {
//   pub fn new() -> RTPSChangeForReader {
//     RTPSChangeForReader {
//       kind: ChangeForReaderStatusKind::UNSENT,
//       is_relevant: true,
//     }
//   }
// }

#[cfg(test)]
mod bounded_unsent_tests {
  use super::*;
  use crate::structure::guid::GuidPrefix;

  fn test_proxy() -> RtpsReaderProxy {
    let guid = GUID::new(GuidPrefix::UNKNOWN, EntityId::UNKNOWN);
    RtpsReaderProxy::new(guid, QosPolicies::default(), false)
  }

  // Regression: the push path (Writer::process_pending) now prunes each sample
  // from unsent_changes via mark_change_sent, so a best-effort flood (no
  // ACKNACKs) does not leave one entry per sample behind. Model that here.
  #[test]
  fn unsent_changes_do_not_grow_when_pruned_on_push() {
    let mut rp = test_proxy();
    for i in 1..=50_000 {
      let sn = SequenceNumber::new(i);
      rp.notify_new_cache_change(sn);
      rp.mark_change_sent(sn); // Writer::process_pending does this on
                               // Complete/drop.
    }
    assert_eq!(
      rp.unsent_changes_count(),
      0,
      "unsent_changes should be empty after every sample is marked sent"
    );
  }

  // Regression / safety net: even if pruning never happened (pathological peer),
  // the hard cap must keep unsent_changes bounded.
  #[test]
  fn unsent_changes_bounded_by_hard_cap() {
    let mut rp = test_proxy();
    let n = (MAX_UNSENT_CHANGES_PER_READER as i64) * 4;
    for i in 1..=n {
      rp.notify_new_cache_change(SequenceNumber::new(i));
    }
    assert!(
      rp.unsent_changes_count() <= MAX_UNSENT_CHANGES_PER_READER,
      "unsent_changes exceeded cap {}: {} entries",
      MAX_UNSENT_CHANGES_PER_READER,
      rp.unsent_changes_count()
    );
  }
}

#[cfg(test)]
mod acknack_tests {
  use super::*;
  use crate::{
    messages::submessages::{ack_nack::AckNack, submessage::AckSubmessage},
    structure::{guid::GuidPrefix, sequence_number::SequenceNumberSet},
  };

  #[test]
  fn acknack_with_base_beyond_sent_data_does_not_advance_all_acked_before() {
    let guid = GUID::new(GuidPrefix::UNKNOWN, EntityId::UNKNOWN);
    let mut rp = RtpsReaderProxy::new(guid, QosPolicies::default(), false);
    rp.all_acked_before = SequenceNumber::from(10);

    let forged_base = SequenceNumber::new(4_611_686_018_427_387_993);
    let ack = AckNack {
      reader_id: EntityId::UNKNOWN,
      writer_id: EntityId::UNKNOWN,
      reader_sn_state: SequenceNumberSet::new_empty(forged_base),
      count: 1,
    };

    rp.handle_ack_nack(
      &AckSubmessage::AckNack(ack),
      SequenceNumber::from(100),
      SequenceNumber::from(1),
      true,
    );

    assert_eq!(rp.all_acked_before, SequenceNumber::from(10));
  }

  #[test]
  fn acknack_with_valid_base_updates_all_acked_before() {
    let guid = GUID::new(GuidPrefix::UNKNOWN, EntityId::UNKNOWN);
    let mut rp = RtpsReaderProxy::new(guid, QosPolicies::default(), false);

    let ack = AckNack {
      reader_id: EntityId::UNKNOWN,
      writer_id: EntityId::UNKNOWN,
      reader_sn_state: SequenceNumberSet::new_empty(SequenceNumber::from(50)),
      count: 1,
    };

    rp.handle_ack_nack(
      &AckSubmessage::AckNack(ack),
      SequenceNumber::from(100),
      SequenceNumber::from(1),
      true,
    );

    assert_eq!(rp.all_acked_before, SequenceNumber::from(50));
  }

  // All of 1..=9 acknowledged, 10..=12 not; then an ACKNACK of a reader that has
  // no state of this writer any more and requests everything.
  fn matched_anew(serves_history: bool) -> RtpsReaderProxy {
    let guid = GUID::new(GuidPrefix::UNKNOWN, EntityId::UNKNOWN);
    let mut rp = RtpsReaderProxy::new(guid, QosPolicies::default(), false);
    rp.all_acked_before = SequenceNumber::from(10);
    let requested = (1..=12).map(SequenceNumber::from).collect();
    let ack = AckNack {
      reader_id: EntityId::UNKNOWN,
      writer_id: EntityId::UNKNOWN,
      reader_sn_state: SequenceNumberSet::from_base_and_set(SequenceNumber::from(1), &requested),
      count: 1,
    };
    rp.handle_ack_nack(
      &AckSubmessage::AckNack(ack),
      SequenceNumber::from(12),
      SequenceNumber::from(5),
      serves_history,
    );
    rp
  }

  #[test]
  fn a_reader_that_was_matched_anew_on_its_side_gets_the_history() {
    let rp = matched_anew(true);
    assert_eq!(rp.all_acked_before, SequenceNumber::from(1));
    assert_eq!(rp.unsent_changes_count(), 12);
    assert!(rp.get_pending_gap().is_empty());
  }

  #[test]
  fn a_reader_that_was_matched_anew_gets_no_volatile_sample_that_it_acknowledged() {
    let rp = matched_anew(false);
    let not_acknowledged = (10..=12).map(SequenceNumber::from);
    assert!(rp.unsent_changes_iter().eq(not_acknowledged));
    assert_eq!(rp.all_acked_before, SequenceNumber::from(10));
  }
}

#[cfg(test)]
mod route_tests {
  use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};

  use super::*;
  use crate::{
    discovery::sedp_messages::ReaderProxy,
    rtps::transmit::{DefaultRouteSelector, InterfaceObservations, InterfaceSelector},
    structure::guid::GuidPrefix,
  };

  fn udp(ip: [u8; 4], port: u16) -> Locator {
    Locator::UdpV4(SocketAddrV4::new(
      Ipv4Addr::new(ip[0], ip[1], ip[2], ip[3]),
      port,
    ))
  }

  fn iface(ip: [u8; 4]) -> InterfaceSelector {
    InterfaceSelector::Ip(IpAddr::V4(Ipv4Addr::new(ip[0], ip[1], ip[2], ip[3])))
  }

  fn proxy_with_prefix(prefix: GuidPrefix) -> RtpsReaderProxy {
    let guid = GUID::new(prefix, EntityId::UNKNOWN);
    RtpsReaderProxy::new(guid, QosPolicies::default(), false)
  }

  #[test]
  fn resolve_falls_back_without_observation() {
    let mut rp = proxy_with_prefix(GuidPrefix::UNKNOWN);
    rp.unicast_locator_list = vec![udp([10, 0, 0, 5], 7410)];
    let observations = InterfaceObservations::new();
    rp.resolve_send_route(
      &observations,
      &[iface([10, 0, 0, 1])],
      &DefaultRouteSelector::default(),
    );
    assert!(rp.send_route().fallback);
  }

  #[test]
  fn resolve_narrows_with_observation() {
    let prefix = GuidPrefix::new(&[9; 12]);
    let mut rp = proxy_with_prefix(prefix);
    rp.unicast_locator_list = vec![udp([10, 0, 0, 5], 7410)];
    rp.multicast_locator_list = vec![udp([239, 255, 0, 1], 7401)];

    let mut observations = InterfaceObservations::new();
    observations.record(
      prefix,
      Some(iface([10, 0, 0, 1])),
      SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 5)), 7410),
    );

    rp.resolve_send_route(
      &observations,
      &[iface([10, 0, 0, 1])],
      &DefaultRouteSelector::default(),
    );

    let route = rp.send_route();
    assert!(!route.fallback);
    assert_eq!(route.unicast, Some(udp([10, 0, 0, 5], 7410)));
    assert_eq!(
      route.multicast,
      Some((udp([239, 255, 0, 1], 7401), iface([10, 0, 0, 1])))
    );
  }

  #[test]
  fn update_partitions_loopback_into_bucket() {
    let prefix = GuidPrefix::new(&[7; 12]);
    let mut rp = proxy_with_prefix(prefix);

    // An incoming update carrying a loopback and a LAN locator inline (as the
    // built-in reader-proxy path does).
    let mut update = proxy_with_prefix(prefix);
    update.unicast_locator_list = vec![udp([127, 0, 0, 1], 7413), udp([10, 0, 0, 5], 7413)];

    rp.update(&update, "topic");

    // Loopback is kept out of the normal list but retained in the bucket.
    assert_eq!(rp.unicast_locator_list, vec![udp([10, 0, 0, 5], 7413)]);
    assert_eq!(
      rp.loopback_unicast_locators,
      vec![udp([127, 0, 0, 1], 7413)]
    );
  }

  #[test]
  fn normalize_loopback_moves_inline_loopback_to_bucket() {
    // Mimics a freshly built built-in reader proxy with loopback inline.
    let mut rp = proxy_with_prefix(GuidPrefix::new(&[5; 12]));
    rp.unicast_locator_list = vec![udp([127, 0, 0, 1], 7410), udp([10, 0, 0, 5], 7410)];
    rp.normalize_loopback();
    assert_eq!(rp.unicast_locator_list, vec![udp([10, 0, 0, 5], 7410)]);
    assert_eq!(
      rp.loopback_unicast_locators,
      vec![udp([127, 0, 0, 1], 7410)]
    );
    // Idempotent.
    rp.normalize_loopback();
    assert_eq!(rp.unicast_locator_list, vec![udp([10, 0, 0, 5], 7410)]);
    assert_eq!(
      rp.loopback_unicast_locators,
      vec![udp([127, 0, 0, 1], 7410)]
    );
  }

  #[test]
  fn discovery_record_keeps_bucket_loopback() {
    // A remote reader bound only to loopback, e.g. CycloneDDS on `lo`.
    let mut rp = proxy_with_prefix(GuidPrefix::new(&[9; 12]));
    rp.loopback_unicast_locators = vec![udp([127, 0, 0, 1], 7413)];

    let record = ReaderProxy::from(rp);
    assert_eq!(record.unicast_locator_list, vec![udp([127, 0, 0, 1], 7413)]);
  }

  #[test]
  fn same_host_route_selects_bucket_loopback() {
    let prefix = GuidPrefix::new(&[8; 12]);
    let mut rp = proxy_with_prefix(prefix);
    rp.unicast_locator_list = vec![udp([10, 0, 0, 5], 7413)];
    rp.loopback_unicast_locators = vec![udp([127, 0, 0, 1], 7413)];

    let mut observations = InterfaceObservations::new();
    observations.record(
      prefix,
      None,
      SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7410),
    );

    rp.resolve_send_route(&observations, &[], &DefaultRouteSelector::default());

    let route = rp.send_route();
    assert!(!route.fallback);
    assert_eq!(route.unicast, Some(udp([127, 0, 0, 1], 7413)));
  }
}
