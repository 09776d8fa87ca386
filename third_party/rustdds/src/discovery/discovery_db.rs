use std::{
  collections::{BTreeMap, VecDeque},
  sync::{Arc, RwLock, RwLockReadGuard, RwLockWriteGuard},
  time::Instant,
};

use chrono::Utc;
#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};

use crate::{
  dds::{
    participant::DomainParticipant,
    qos::HasQoSPolicy,
    statusevents::{DomainParticipantStatusEvent, LostReason, StatusChannelSender},
    topic::{Topic, TopicDescription},
  },
  network_counts::{
    NetworkCounters, MAX_ENDPOINTS, MAX_ENDPOINTS_PER_PARTICIPANT, MAX_ENDPOINT_BYTES, MAX_LEASE,
    MAX_PARTICIPANTS, MAX_TOPICS,
  },
  rtps::{
    constant::MAX_LOCATORS_PER_READER, reader::ReaderIngredients, rtps_reader_proxy::RtpsReaderProxy,
    rtps_writer_proxy::RtpsWriterProxy,
  },
  serialization::pl_cdr_adapters::PlCdrSerialize,
  structure::{
    duration::Duration,
    entity::RTPSEntity,
    guid::{EntityId, GuidPrefix, GUID},
    locator::Locator,
  },
  RepresentationIdentifier,
};
use super::{
  attic::Attic,
  sedp_messages::{
    topics_inconsistent, DiscoveredReaderData, DiscoveredTopicData, DiscoveredWriterData,
    ParticipantMessageData, ReaderProxy, SubscriptionBuiltinTopicData, TopicBuiltinTopicData,
    WriterProxy,
  },
  spdp_participant_data::SpdpDiscoveredParticipantData,
};
#[cfg(not(feature = "security"))]
use crate::no_security::EndpointSecurityInfo;
#[cfg(feature = "security")]
use crate::{discovery::secure_discovery::AuthenticationStatus, security::EndpointSecurityInfo};

// If remote participant does not specify lease duration, how long silence
// until we pronounce it dead.
const DEFAULT_PARTICIPANT_LEASE_DURATION: Duration = Duration::from_secs(60);

// How much longer to wait than lease duration before pronouncing lost.
const PARTICIPANT_LEASE_DURATION_TOLERANCE: Duration = Duration::from_secs(0);

// TODO: Let DiscoveryDB itself become thread-safe and support smaller-scope
// lock
pub(crate) struct DiscoveryDB {
  my_guid: GUID,
  participant_proxies: BTreeMap<GuidPrefix, SpdpDiscoveredParticipantData>,
  participant_last_life_signs: BTreeMap<GuidPrefix, Instant>,
  // The keys of participant_proxies, the one discovered first in front.
  discovery_order: VecDeque<GuidPrefix>,

  // Authentication statuses of participants
  #[cfg(feature = "security")]
  authentication_statuses: BTreeMap<GuidPrefix, AuthenticationStatus>,

  // local writer proxies for topics (topic name acts as key)
  local_topic_writers: BTreeMap<GUID, DiscoveredWriterData>,
  // local reader proxies for topics (topic name acts as key)
  local_topic_readers: BTreeMap<GUID, DiscoveredReaderData>,

  // remote readers and writers (via discovery)
  external_topic_readers: BTreeMap<GUID, DiscoveredReaderData>,
  external_topic_writers: BTreeMap<GUID, DiscoveredWriterData>,

  // The readers and writers of participants that are gone, which may come back.
  attic: Attic,

  // Database of topic updates:
  // Outer level key is topic name
  // Inner key is topic data sender.
  topics: BTreeMap<String, BTreeMap<GUID, (DiscoveredVia, DiscoveredTopicData)>>,

  // sender for notifying (potential) waiters in participant.find_topic() call
  topic_updated_sender: std::sync::mpsc::SyncSender<()>,

  participant_status_sender: StatusChannelSender<DomainParticipantStatusEvent>,

  counters: Arc<NetworkCounters>,
}

/// What an announcement of a participant did to the database.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ParticipantUpdate {
  /// It was there before.
  Known,
  /// It was added, and another one removed if there was no room.
  New { evicted: Option<GuidPrefix> },
  /// It is ill-formed, or there is no room for it.
  Refused,
}

// How did we discover this topic
#[derive(PartialEq, Eq, Clone, Copy, Debug)]
pub(crate) enum DiscoveredVia {
  Topic,        // explicitly, via the topic topic (does this actually occur?)
  Publication,  // we discovered there is a writer on this topic
  Subscription, // we discovered a reader on this topic
  SelfDefined,  // not discovered, but defined by the local DomainParticipant
}

// Removes what belongs to a participant.
fn take_by_guid_prefix<D>(guid_prefix: GuidPrefix, from: &mut BTreeMap<GUID, D>) -> Vec<D> {
  let guids: Vec<GUID> = from.range(guid_prefix.range()).map(|(g, _)| *g).collect();
  guids.iter().filter_map(|guid| from.remove(guid)).collect()
}

// Bytes of the announcement of an endpoint without its locators, each of which takes 28.
fn announced_bytes(endpoint: &impl PlCdrSerialize, locators: usize) -> usize {
  let serialized = endpoint.to_pl_cdr_bytes(RepresentationIdentifier::PL_CDR_LE);
  serialized.map_or(usize::MAX, |bytes| bytes.len().saturating_sub(28 * locators))
}

// If there are too many, those of transports that are not UDP, which are not used here, go first.
pub(crate) fn keep_first_locators(locators: &mut Vec<Locator>) {
  if locators.len() > MAX_LOCATORS_PER_READER {
    locators.sort_by_key(|locator| !locator.is_udp());
  }
  locators.truncate(MAX_LOCATORS_PER_READER);
  locators.shrink_to_fit();
}

pub(crate) fn discovery_db_read(
  discovery_db: &Arc<RwLock<DiscoveryDB>>,
) -> RwLockReadGuard<'_, DiscoveryDB> {
  match discovery_db.read() {
    Ok(db) => db,
    Err(e) => panic!("RustDDS internal bug: DiscoveryDB is poisoned after a prior panic: {e:?}."),
  }
}

pub(crate) fn discovery_db_write(
  discovery_db: &Arc<RwLock<DiscoveryDB>>,
) -> RwLockWriteGuard<'_, DiscoveryDB> {
  match discovery_db.write() {
    Ok(db) => db,
    Err(e) => panic!("RustDDS internal bug: DiscoveryDB is poisoned after a prior panic: {e:?}."),
  }
}

impl DiscoveryDB {
  pub fn new(
    my_guid: GUID,
    topic_updated_sender: std::sync::mpsc::SyncSender<()>,
    participant_status_sender: StatusChannelSender<DomainParticipantStatusEvent>,
  ) -> Self {
    Self {
      my_guid,
      participant_proxies: BTreeMap::new(),
      participant_last_life_signs: BTreeMap::new(),
      discovery_order: VecDeque::new(),
      #[cfg(feature = "security")]
      authentication_statuses: BTreeMap::new(),
      local_topic_writers: BTreeMap::new(),
      local_topic_readers: BTreeMap::new(),
      external_topic_readers: BTreeMap::new(),
      external_topic_writers: BTreeMap::new(),
      attic: Attic::default(),
      topics: BTreeMap::new(),
      topic_updated_sender,
      participant_status_sender,
      counters: Arc::default(),
    }
  }

  pub fn counters(&self) -> Arc<NetworkCounters> {
    Arc::clone(&self.counters)
  }

  fn send_participant_status(&self, event: DomainParticipantStatusEvent) {
    self
      .participant_status_sender
      .try_send(event)
      .unwrap_or_else(|e| error!("Cannot report participant status: {e:?}"));
  }

  pub fn update_participant(&mut self, data: &SpdpDiscoveredParticipantData) -> ParticipantUpdate {
    debug!("update_participant: {:?}", data);
    let guid = data.participant_guid;

    // sanity check
    if guid.entity_id != EntityId::PARTICIPANT {
      error!("Discovered participant GUID entity_id is not for participant: {guid:?}");
      self.counters.malformed_datagrams.increment();
      return ParticipantUpdate::Refused;
    }

    // We allow discovery to discover self, since our discovery readers
    // will receive our own announcements via broadcast. If we do not recognize
    // our own participant, there is confusion about unknown writers on the
    // discovery topics.
    //
    // if guid == self.my_guid {
    //   debug!("DiscoveryDB discovered self. Skipping.");
    //   return
    // }

    let mut update = ParticipantUpdate::Known;
    if !self.participant_proxies.contains_key(&guid.prefix) {
      let is_full = self.participant_proxies.len() >= MAX_PARTICIPANTS;
      let evicted = is_full.then(|| self.oldest_without_local_topic()).flatten();
      if is_full && evicted.is_none() {
        self.counters.announcements_refused.increment();
        return ParticipantUpdate::Refused;
      }
      info!("New remote participant: {:?}", data);
      if guid == self.my_guid {
        info!("Remote participant {guid:?} is myself, but some reflection is good.");
      } else {
        update = ParticipantUpdate::New { evicted };
      }
      self.discovery_order.push_back(guid.prefix);

      // This may be a rediscovery: Participant lease time timed out, but then
      // came back, e.g. by network outage. We then restore readers/writers from
      // attic to discovery DB.
      // After it has left the attic, which the evicted one enters.
      self.restore_endpoints_of(guid.prefix);
      self.restore_topics_of(guid.prefix);

      if let Some(evicted) = evicted {
        self.counters.participants_evicted.increment();
        self.remove_participant(evicted, true);
      }
    }

    // In any case:
    // Update SpdpDiscoveredParticipantData to DB
    let mut data = data.clone();
    for locators in [
      &mut data.metatraffic_unicast_locators,
      &mut data.metatraffic_multicast_locators,
      &mut data.default_unicast_locators,
      &mut data.default_multicast_locators,
    ] {
      keep_first_locators(locators);
    }
    data.entity_name = data.entity_name.filter(|name| name.len() <= MAX_ENDPOINT_BYTES);
    self.participant_proxies.insert(guid.prefix, data);
    // Timestamp last life sign fro participant
    self
      .participant_last_life_signs
      .insert(guid.prefix, Instant::now());

    update
  }

  // The participant that was discovered first of those that have no endpoint with a
  // topic of ours, if there is one.
  fn oldest_without_local_topic(&self) -> Option<GuidPrefix> {
    let mut remote = self.discovery_order.iter().copied();
    remote.find(|prefix| {
      *prefix != self.my_guid.prefix && !self.has_endpoint_with_local_topic(*prefix)
    })
  }

  /// Whether that participant has a reader or writer of a topic of ours.
  pub fn has_endpoint_with_local_topic(&self, prefix: GuidPrefix) -> bool {
    let mut readers = self.external_topic_readers.range(prefix.range());
    let mut writers = self.external_topic_writers.range(prefix.range());
    readers.any(|(_, reader)| self.is_local_topic(reader.subscription_topic_data.topic_name()))
      || writers.any(|(_, writer)| self.is_local_topic(&writer.publication_topic_data.topic_name))
  }

  fn is_local_topic(&self, name: &str) -> bool {
    let mut readers = self.local_topic_readers.values();
    let mut writers = self.local_topic_writers.values();
    readers.any(|reader| reader.subscription_topic_data.topic_name() == name)
      || writers.any(|writer| writer.publication_topic_data.topic_name == name)
  }

  // Whether there is room for one more endpoint, given the endpoints of its kind.
  fn has_room_for_endpoint<D>(
    &self,
    of_kind: &BTreeMap<GUID, D>,
    guid: GUID,
    topic: &str,
    announced_bytes: usize,
  ) -> bool {
    let of_participant = || of_kind.range(guid.prefix.range()).count();
    let is_known_or_admitted = || {
      of_kind.contains_key(&guid)
        || of_participant() < MAX_ENDPOINTS_PER_PARTICIPANT
          && (of_kind.len() < MAX_ENDPOINTS
            || of_kind.len() < 2 * MAX_ENDPOINTS && self.is_local_topic(topic))
    };
    let has_room = announced_bytes <= MAX_ENDPOINT_BYTES && is_known_or_admitted();
    if !has_room {
      self.counters.endpoints_refused.increment();
    }
    has_room
  }

  /// Whether it is one whose lease has expired: then its last announcement.
  /// Participants repeat that with the same sequence number, and the reader
  /// drops what it has seen before.
  pub fn participant_is_alive(
    &mut self,
    guid_prefix: GuidPrefix,
  ) -> Option<SpdpDiscoveredParticipantData> {
    if let Some(ts) = self.participant_last_life_signs.get_mut(&guid_prefix) {
      let now = Instant::now();
      if now.duration_since(*ts) > std::time::Duration::from_secs(1) {
        debug!("Participant alive update for {guid_prefix:?}, but no full update.");
      }
      *ts = now;
      None
    } else {
      info!(
        "Participant alive update for unknown {guid_prefix:?}. This is normal, if the message \
         does not repeat."
      );
      self.attic.take_announcement(guid_prefix)
    }
  }

  // active_disposal means that we received a discovery message announcing the
  // disposal of the participant. active_disposal=false means that the
  // participant timed out.
  //
  // Its readers and writers are remembered in both cases: a participant that
  // reintroduces itself disposes itself first, and our readers drop the endpoints that
  // it announces afterwards, because they have received them before.
  //
  // Returns whether it was known, or its endpoints were.
  pub fn remove_participant(&mut self, guid_prefix: GuidPrefix, active_disposal: bool) -> bool {
    info!("removing participant {guid_prefix:?}");
    let participant_data = self.participant_proxies.remove(&guid_prefix);
    let is_present = participant_data.is_some();
    self.participant_last_life_signs.remove(&guid_prefix);
    self.discovery_order.retain(|prefix| *prefix != guid_prefix);
    #[cfg(feature = "security")]
    self.authentication_statuses.remove(&guid_prefix);

    self.forget_topics_of(guid_prefix);

    let is_known = is_present || self.restore_endpoints_of(guid_prefix);
    let endpoints = (
      take_by_guid_prefix(guid_prefix, &mut self.external_topic_readers),
      take_by_guid_prefix(guid_prefix, &mut self.external_topic_writers),
    );
    if !is_known {
      // Endpoints of a participant that was never discovered are not remembered.
      return !endpoints.0.is_empty() || !endpoints.1.is_empty();
    }
    // A datagram that it sent before it said goodbye is no sign of life.
    let may_return = !active_disposal;
    self.attic.remember(guid_prefix, &endpoints, participant_data.as_ref(), may_return);
    true
  }

  // Returns whether the participant was in the attic. What was announced since it was gone stays.
  fn restore_endpoints_of(&mut self, guid_prefix: GuidPrefix) -> bool {
    let Some((readers, writers)) = self.attic.take(guid_prefix) else { return false };
    for reader in readers {
      let guid = reader.reader_proxy.remote_reader_guid;
      self.external_topic_readers.entry(guid).or_insert(reader);
    }
    for writer in writers {
      let guid = writer.writer_proxy.remote_writer_guid;
      self.external_topic_writers.entry(guid).or_insert(writer);
    }
    true
  }

  // What the participant and its endpoints announced of topics. A topic with another
  // user stays, so that without this `ros_discovery_info` of ROS 2 would keep 400 bytes
  // of each endpoint that ever used it.
  fn forget_topics_of(&mut self, guid_prefix: GuidPrefix) {
    for announced in self.topics.values_mut() {
      let gone: Vec<GUID> = announced
        .range(guid_prefix.range())
        .map(|(g, _)| *g)
        .collect();
      for guid in gone {
        announced.remove(&guid);
      }
    }
  }

  fn forget_topic_of(&mut self, endpoint: GUID, topic_name: &str) {
    if let Some(announced) = self.topics.get_mut(topic_name) {
      announced.remove(&endpoint);
    }
  }

  // The opposite, for endpoints that have returned from the attic.
  fn restore_topics_of(&mut self, guid_prefix: GuidPrefix) {
    let (readers, writers) = self.endpoints_of(guid_prefix);
    let readers = readers.iter().map(|reader| {
      (
        reader.reader_proxy.remote_reader_guid,
        reader.subscription_topic_data.to_topic_data(),
        DiscoveredVia::Subscription,
      )
    });
    let writers = writers.iter().map(|writer| {
      (
        writer.writer_proxy.remote_writer_guid,
        writer.publication_topic_data.to_topic_data(),
        DiscoveredVia::Publication,
      )
    });
    for (guid, topic, via) in readers.chain(writers) {
      self.update_topic_data(&DiscoveredTopicData::new(Utc::now(), topic), guid, via);
    }
  }

  pub fn find_participant_proxy(
    &self,
    guid_prefix: GuidPrefix,
  ) -> Option<&SpdpDiscoveredParticipantData> {
    self.participant_proxies.get(&guid_prefix)
  }

  /// The participants that fulfil a condition.
  pub fn participant_prefixes(
    &self,
    condition: impl Fn(&SpdpDiscoveredParticipantData) -> bool,
  ) -> Vec<GuidPrefix> {
    let participants = self.participant_proxies.iter();
    participants
      .filter(|(_, data)| condition(data))
      .map(|(prefix, _)| *prefix)
      .collect()
  }

  /// The participants, the one that was discovered first at the front.
  pub fn participants_by_age(&self) -> impl Iterator<Item = (GuidPrefix, &SpdpDiscoveredParticipantData)> {
    let prefixes = self.discovery_order.iter();
    prefixes.filter_map(|prefix| Some((*prefix, self.participant_proxies.get(prefix)?)))
  }

  pub fn remove_topic_reader(&mut self, guid: GUID) {
    info!("remove_topic_reader {guid:?}");
    if let Some(reader) = self.external_topic_readers.remove(&guid) {
      self.forget_topic_of(guid, reader.subscription_topic_data.topic_name());
    }
  }

  pub fn get_topic_reader(&self, guid: &GUID) -> Option<&DiscoveredReaderData> {
    self.external_topic_readers.get(guid)
  }

  pub fn get_topic_writer(&self, guid: &GUID) -> Option<&DiscoveredWriterData> {
    self.external_topic_writers.get(guid)
  }

  pub fn remove_topic_writer(&mut self, guid: GUID) {
    if let Some(writer) = self.external_topic_writers.remove(&guid) {
      self.forget_topic_of(guid, writer.publication_topic_data.topic_name());
    }
  }

  // Delete participant proxies, if we have not heard of them within
  // lease_duration
  pub fn participant_cleanup(&mut self) -> Vec<(GuidPrefix, LostReason)> {
    let inow = Instant::now();

    let mut to_remove = Vec::new();
    // TODO: We are not cleaning up liast_life_signs table, but that should not be a
    // problem, except for a slight memory leak.
    for (&guid, sp) in &self.participant_proxies {
      let lease_duration = sp
        .lease_duration
        .unwrap_or(DEFAULT_PARTICIPANT_LEASE_DURATION)
        .min(Duration::from_std(MAX_LEASE));
      // let lease_duration = lease_duration + lease_duration; // double it
      match self.participant_last_life_signs.get(&guid) {
        Some(&last_life) => {
          // keep, if duration not exceeded
          let elapsed = Duration::from_std(inow.duration_since(last_life));
          if elapsed <= lease_duration + PARTICIPANT_LEASE_DURATION_TOLERANCE {
            // No timeout yet, we keep this, so do nothing.
          } else {
            info!(
              "participant cleanup - deleting participant proxy {guid:?}. lease_duration = \
               {lease_duration:?} elapsed = {elapsed:?}"
            );
            to_remove.push((
              guid,
              LostReason::Timeout {
                lease: lease_duration,
                elapsed,
              },
            ));
          }
        }
        None => {
          error!("Participant {guid:?} not in last_life_signs table?");
        }
      } // match
    } // for

    for (guid, _) in &to_remove {
      self.remove_participant(*guid, false); // false = removed due to timeout
    }

    to_remove
  }

  fn topic_has_writers_or_readers(&self, topic_name: &str) -> bool {
    // TODO: This entire function has silly implementation.
    // We should really have a separate map from Topic to Readers & Writers
    if self
      .local_topic_readers
      .iter()
      .any(|(_, p)| p.subscription_topic_data.topic_name() == topic_name)
    {
      return true;
    }

    if self
      .local_topic_writers
      .iter()
      .any(|(_, p)| p.publication_topic_data.topic_name == topic_name)
    {
      return true;
    }

    if self
      .external_topic_readers
      .values()
      .any(|p| p.subscription_topic_data.topic_name() == topic_name)
    {
      return true;
    }

    if self
      .external_topic_writers
      .values()
      .any(|p| p.publication_topic_data.topic_name == topic_name)
    {
      return true;
    }

    false
  }

  pub fn topic_cleanup(&mut self) {
    // removing topics that have no readers or writers
    let dead_topics: Vec<_> = self
      .topics
      .keys()
      .filter(|tn| !self.topic_has_writers_or_readers(tn))
      .cloned()
      .collect();
    for dt in &dead_topics {
      self.topics.remove(dt);
    }
  }

  pub fn update_local_topic_writer(&mut self, writer: DiscoveredWriterData) {
    self
      .local_topic_writers
      .insert(writer.writer_proxy.remote_writer_guid, writer);
  }

  /// Replaces the USER_DATA of a local writer, and returns the writer, unless
  /// it has the same or does not exist.
  pub fn set_user_data(&mut self, guid: GUID, user_data: Vec<u8>) -> Option<&DiscoveredWriterData> {
    let writer = self.local_topic_writers.get_mut(&guid)?;
    if writer.user_data == user_data {
      return None;
    }
    writer.user_data = user_data;
    Some(writer)
  }

  pub fn remove_local_topic_writer(&mut self, guid: GUID) {
    self.local_topic_writers.remove(&guid);
  }

  // TODO: This is silly. Returns one of the parameters cloned, or None
  // TODO: Why are we here checking if discovery db already has this? What about
  // reader proxies in writers?

  // Here we make updates when a new Reader is found via Discovery.
  // * It may be one of our own.
  // * We may have seen it before.
  //
  // In case DiscoveredReaderData does not have locators, we try to get
  // them from the remote participant.
  //
  // The topic is updated to the topics table.
  //
  // None if there is no room for it.
  pub fn update_subscription(
    &mut self,
    data: &DiscoveredReaderData,
  ) -> Option<DiscoveredReaderData> {
    // Not used here, and as long as the application of the Reader likes.
    let data = &DiscoveredReaderData {
      content_filter: None,
      ..data.clone()
    };
    let guid = data.reader_proxy.remote_reader_guid;
    let topic = data.subscription_topic_data.topic_name();
    let proxy = &data.reader_proxy;
    let locators = proxy.unicast_locator_list.len() + proxy.multicast_locator_list.len();
    let bytes = announced_bytes(data, locators);
    if !self.has_room_for_endpoint(&self.external_topic_readers, guid, topic, bytes) {
      return None;
    }

    // fill in the default locators from participant, in case DRD did not provide
    // any
    let default_locator_lists = self
      .find_participant_proxy(guid.prefix)
      .map(|pp| {
        debug!("Added participant locators to Reader {guid:?}");
        (
          pp.default_unicast_locators.clone(),
          pp.default_multicast_locators.clone(),
        )
      })
      .unwrap_or_else(|| {
        if guid.prefix != GuidPrefix::UNKNOWN {
          // This is normal, since we might not know about the participant yet.
          debug!(
            "No remote participant known for {:?}\nSearched with {:?} in {:?}",
            data,
            guid.prefix,
            self.participant_proxies.keys()
          );
        }
        (Vec::default(), Vec::default())
      });

    // Build enriched data with participant's default locators filled in, so that
    // later lookups via readers_on_topic() return usable locator information.
    let enriched = DiscoveredReaderData {
      reader_proxy: ReaderProxy::from(RtpsReaderProxy::from_discovered_reader_data(
        data,
        &default_locator_lists.0,
        &default_locator_lists.1,
      )),
      ..data.clone()
    };

    self.external_topic_readers.insert(guid, enriched.clone());
    debug!("External reader: {enriched:?}");

    // Now the topic update:
    let dtd = data.subscription_topic_data.to_topic_data();
    self.update_topic_data(
      &DiscoveredTopicData::new(Utc::now(), dtd),
      guid,
      DiscoveredVia::Subscription,
    );

    // TODO: Lookup the topic in DB, data sent by the same participant that sent the
    // reader update. If there is a DiscoveredVia::Topic record, use QosPolicies
    // from that record and modify by QoS given in the DRD.

    Some(enriched)
  }

  // TODO: This is silly. Returns one of the parameters cloned, or None
  //
  // None if there is no room for it.
  pub fn update_publication(
    &mut self,
    data: &DiscoveredWriterData,
  ) -> Option<DiscoveredWriterData> {
    let guid = data.writer_proxy.remote_writer_guid;
    let topic = &data.publication_topic_data.topic_name;
    let proxy = &data.writer_proxy;
    let locators = proxy.unicast_locator_list.len() + proxy.multicast_locator_list.len();
    let bytes = announced_bytes(data, locators);
    if !self.has_room_for_endpoint(&self.external_topic_writers, guid, topic, bytes) {
      return None;
    }

    // fill in the default locators from participant, in case DRD did not provide
    // any
    let default_locator_lists = self
      .find_participant_proxy(guid.prefix)
      .map(|pp| {
        debug!("Added participant locators to Writer {guid:?}");
        (
          pp.default_unicast_locators.clone(),
          pp.default_multicast_locators.clone(),
        )
      })
      .unwrap_or_else(|| {
        if guid.prefix != GuidPrefix::UNKNOWN {
          // This is normal, since we might not know about the participant yet.
          debug!(
            "No remote participant known for {:?}\nSearched with {:?} in {:?}",
            data,
            guid.prefix,
            self.participant_proxies.keys()
          );
        }
        (Vec::default(), Vec::default())
      });

    // Build enriched data with participant's default locators filled in, so that
    // later lookups via writers_on_topic() return usable locator information.
    let mut writer_proxy = WriterProxy::from(RtpsWriterProxy::from_discovered_writer_data(
      data,
      &default_locator_lists.0,
      &default_locator_lists.1,
    ));
    keep_first_locators(&mut writer_proxy.unicast_locator_list);
    keep_first_locators(&mut writer_proxy.multicast_locator_list);
    let enriched = DiscoveredWriterData {
      writer_proxy,
      ..data.clone()
    };

    self.external_topic_writers.insert(guid, enriched.clone());
    debug!("External writer: {enriched:?}");

    // Now the topic update:
    let dtd = data.publication_topic_data.to_topic_data();
    self.update_topic_data(
      &DiscoveredTopicData::new(Utc::now(), dtd),
      guid,
      DiscoveredVia::Publication,
    );

    Some(enriched)
  }

  // This is for local participant updating the topic table
  pub fn update_topic_data_p(&mut self, topic: &Topic) {
    let topic_data = DiscoveredTopicData::new(
      Utc::now(),
      TopicBuiltinTopicData::new(
        None,
        topic.name(),
        topic.get_type().name().to_owned(),
        &topic.qos(),
      ),
    );
    self.update_topic_data(&topic_data, self.my_guid, DiscoveredVia::SelfDefined);
  }

  // Topic update sends notifications, in case someone was waiting to find a
  // topic. Return value indicates whether the topic (name) was new to us. This
  // is used to add
  pub fn update_topic_data(
    &mut self,
    dtd: &DiscoveredTopicData,
    updater: GUID,
    discovered_via: DiscoveredVia,
  ) {
    trace!("Update topic data: {:?}", dtd);
    let topic_name = dtd.topic_data.name.clone();
    let mut notify = false;
    let mut inconsistency_event_to_send = None;

    if let Some(t) = self.topics.get_mut(&dtd.topic_data.name) {
      if let Some(old_dtd) = t.get_mut(&updater) {
        // already have it from the same source, do some checking(?) and merging
        if !topics_inconsistent(&dtd.topic_data, &old_dtd.1.topic_data) {
          // If this discovery was from Topic topic and the old was not, then update
          // TODO: Why do we have this logic? Where is the spec? Or ant reason for it?
          // Is it even triggered ever?
          if discovered_via == DiscoveredVia::Topic {
            *old_dtd = (discovered_via, dtd.clone()); // update QoS
            notify = true;
          } else {
            debug!(
              "Topic {:?} update ignored from {:?}. Already have this.",
              topic_name, updater
            );
            // TODO: Here we could warn about QoS changes.
            //
            // It is normal to have different (but compatible) QoS policies
            // for Reader and Writer. We end up here if the same Participant has
            // both Reader and Writer with different QoS. Also
            // different Readers could have different QoS,
            // as could Writers.
          }
        } else {
          error!(
            "Inconsistent topic update from {:?}: type was: {:?} new type: {:?}",
            updater, old_dtd.1.topic_data.type_name, dtd.topic_data.type_name,
          );
          inconsistency_event_to_send = Some(DomainParticipantStatusEvent::InconsistentTopic {
            previous_topic_data: Box::new((&old_dtd.1.topic_data).into()),
            previous_source: updater,
            discovered_topic_data: Box::new((&dtd.topic_data).into()),
            discovery_source: updater,
          });
        }
      } else {
        for (source_guid, (_via, existing_dtd)) in t.iter() {
          if topics_inconsistent(&existing_dtd.topic_data, &dtd.topic_data) {
            inconsistency_event_to_send = Some(DomainParticipantStatusEvent::InconsistentTopic {
              previous_topic_data: Box::new((&existing_dtd.topic_data).into()),
              previous_source: *source_guid,
              discovered_topic_data: Box::new((&dtd.topic_data).into()),
              discovery_source: updater,
            });
            // Note: There are potentially several sources of inconsistency
            // (loop), but we will report only one of them.
          }
        }
        // We have to topic, but not from this participant
        // TODO: Check that there is agreement about topic type name (at least)
        if discovered_via == DiscoveredVia::Topic && !t.is_empty() {
          // Each participant may announce each topic, which would be millions of entries.
          return;
        }
        t.insert(updater, (discovered_via, dtd.clone())); // this should return None
        notify = true;
      }
    } else if discovered_via != DiscoveredVia::SelfDefined
      && (self.topics.len() >= MAX_TOPICS
        || topic_name.len() + dtd.topic_data.type_name.len() > MAX_ENDPOINT_BYTES)
    {
      self.counters.endpoints_refused.increment();
    } else {
      // new topic to us
      let mut b = BTreeMap::new();
      b.insert(updater, (discovered_via, dtd.clone()));
      self.topics.insert(topic_name, b);
      self.send_participant_status(DomainParticipantStatusEvent::TopicDetected {
        name: dtd.topic_data.name.clone(),
        type_name: dtd.topic_data.type_name.clone(),
      });
    };
    if let Some(ev) = inconsistency_event_to_send {
      self.send_participant_status(ev);
    }
    if notify {
      self
        .topic_updated_sender
        .try_send(())
        // It is quite normal for this to fail due to channel full,
        // because usually there is no-one at the other end receiving.
        .unwrap_or_else(|e| trace!("update_topic_data: Notification send failed: {e:?}"));
    }
  }

  // local topic readers

  /// Builds the discovery record of a local reader.
  ///
  /// This locks the participant (`dpi`, for its locators and GUID), so it is
  /// a separate step from [`Self::update_local_topic_reader`]: build the record
  /// first, then take the Discovery DB lock and insert it. The two locks are
  /// not held together. Calling this while holding `discovery_db` could
  /// deadlock against `DomainParticipant::find_topic()`, which holds `dpi`
  /// while reading the DB.
  pub fn local_topic_reader_data(
    domain_participant: &DomainParticipant,
    topic: &Topic,
    reader: &ReaderIngredients,
    sec_info_opt: Option<EndpointSecurityInfo>,
  ) -> DiscoveredReaderData {
    let reader_guid = reader.guid;

    let reader_proxy = RtpsReaderProxy::from_reader(reader, domain_participant);

    let subscription_data = SubscriptionBuiltinTopicData::new(
      reader_guid,
      Some(domain_participant.guid()),
      topic.name(),
      topic.get_type().name().to_string(),
      &reader.qos_policy,
      sec_info_opt,
    );

    // TODO: possibly change content filter to dynamic value
    let content_filter = None;

    DiscoveredReaderData {
      reader_proxy: ReaderProxy::from(reader_proxy),
      subscription_topic_data: subscription_data,
      content_filter,
      user_data: reader.qos_policy.user_data().cloned().unwrap_or_default().value,
    }
  }

  /// Inserts a record built by [`Self::local_topic_reader_data`].
  pub fn update_local_topic_reader(&mut self, discovered_reader_data: DiscoveredReaderData) {
    self.local_topic_readers.insert(
      discovered_reader_data.reader_proxy.remote_reader_guid,
      discovered_reader_data,
    );
  }

  pub fn remove_local_topic_reader(&mut self, guid: GUID) {
    self.local_topic_readers.remove(&guid);
  }

  pub fn get_local_topic_reader(&self, guid: GUID) -> Option<&DiscoveredReaderData> {
    self.local_topic_readers.get(&guid)
  }

  pub fn get_local_topic_writer(&self, guid: GUID) -> Option<&DiscoveredWriterData> {
    self.local_topic_writers.get(&guid)
  }

  pub fn get_all_local_topic_readers(&self) -> impl Iterator<Item = &DiscoveredReaderData> {
    self.local_topic_readers.values()
  }

  pub fn get_all_local_topic_writers(&self) -> impl Iterator<Item = &DiscoveredWriterData> {
    self.local_topic_writers.values()
  }

  pub fn get_all_external_topic_readers(&self) -> impl Iterator<Item = &DiscoveredReaderData> {
    self.external_topic_readers.values()
  }

  pub fn get_all_external_topic_writers(&self) -> impl Iterator<Item = &DiscoveredWriterData> {
    self.external_topic_writers.values()
  }

  /// What is known of the readers and writers of another participant.
  pub fn endpoints_of(
    &self,
    guid_prefix: GuidPrefix,
  ) -> (Vec<DiscoveredReaderData>, Vec<DiscoveredWriterData>) {
    fn of<D: Clone>(endpoints: &BTreeMap<GUID, D>, guid_prefix: GuidPrefix) -> Vec<D> {
      let range = endpoints.range(guid_prefix.range());
      range.map(|(_, data)| data.clone()).collect()
    }
    (
      of(&self.external_topic_readers, guid_prefix),
      of(&self.external_topic_writers, guid_prefix),
    )
  }

  /// The readers of a participant whose topics are ours, too.
  pub fn readers_of_local_topics(
    &self,
    prefix: GuidPrefix,
  ) -> impl Iterator<Item = &DiscoveredReaderData> {
    let readers = self.external_topic_readers.range(prefix.range());
    readers
      .map(|(_, reader)| reader)
      .filter(|reader| self.is_local_topic(reader.subscription_topic_data.topic_name()))
  }

  /// The writers of a participant whose topics are ours, too.
  pub fn writers_of_local_topics(
    &self,
    prefix: GuidPrefix,
  ) -> impl Iterator<Item = &DiscoveredWriterData> {
    let writers = self.external_topic_writers.range(prefix.range());
    writers
      .map(|(_, writer)| writer)
      .filter(|writer| self.is_local_topic(&writer.publication_topic_data.topic_name))
  }

  // Note:
  // If multiple participants announce the same topic, this will
  // return duplicates, one per announcing participant.
  // The duplicates are not necessarily identical, but may have different QoS.
  pub fn all_user_topics(&self) -> impl Iterator<Item = &DiscoveredTopicData> {
    self
      .topics
      .iter()
      .filter(|(s, _)| !s.starts_with("DCPS"))
      .flat_map(|(_, gm)| gm.values().map(|dtd| &dtd.1))
  }

  // a Topic may have multiple definitions, because there may be multiple
  // participants publishing the topic information.
  // At least the QoS details may be different.
  // This just returns the first one found in the database, which is indexed by
  // GUID.
  pub fn get_topic(&self, topic_name: &str) -> Option<&DiscoveredTopicData> {
    self
      .topics
      .get(topic_name)
      .and_then(|m| m.values().next().map(|t| &t.1))
  }

  pub fn writers_on_topic_and_participant(
    &self,
    topic_name: &str,
    participant: GuidPrefix,
  ) -> Vec<DiscoveredWriterData> {
    let on_participant = self
      .external_topic_writers
      .range(participant.range())
      .map(|(_guid, dwd)| dwd);
    debug!("Writers on participant {participant:?} are {on_participant:?}");
    on_participant
      .filter(|dwd| dwd.publication_topic_data.topic_name == topic_name)
      .cloned()
      .collect()
  }

  pub fn readers_on_topic_and_participant(
    &self,
    topic_name: &str,
    participant: GuidPrefix,
  ) -> Vec<DiscoveredReaderData> {
    self
      .external_topic_readers
      .range(participant.range())
      .map(|(_guid, drd)| drd)
      .filter(|drd| drd.subscription_topic_data.topic_name() == topic_name)
      .cloned()
      .collect()
  }

  pub fn writers_on_topic(&self, topic_name: &str) -> Vec<&DiscoveredWriterData> {
    // Get external & local writers on the topic
    let exernal_writers = self
      .external_topic_writers
      .values()
      .filter(|wd| wd.publication_topic_data.topic_name() == topic_name);
    let local_writers = self
      .local_topic_writers
      .values()
      .filter(|wd| wd.publication_topic_data.topic_name() == topic_name);
    // Combine & return
    let combined: Vec<&DiscoveredWriterData> = exernal_writers.chain(local_writers).collect();
    combined
  }

  pub fn readers_on_topic(&self, topic_name: &str) -> Vec<&DiscoveredReaderData> {
    // Get external & local readers on the topic
    let exernal_readers = self
      .external_topic_readers
      .values()
      .filter(|rd| rd.subscription_topic_data.topic_name() == topic_name);
    let local_readers = self
      .local_topic_readers
      .values()
      .filter(|rd| rd.subscription_topic_data.topic_name() == topic_name);
    // Combine & return
    let combined: Vec<&DiscoveredReaderData> = exernal_readers.chain(local_readers).collect();
    combined
  }

  // // TODO: return iterator somehow?
  #[cfg(test)] // used only for testing
  pub fn get_local_topic_readers<T: TopicDescription>(
    &self,
    topic: &T,
  ) -> Vec<&DiscoveredReaderData> {
    let topic_name = topic.name();
    self
      .local_topic_readers
      .iter()
      .filter(|(_, p)| *p.subscription_topic_data.topic_name() == topic_name)
      .map(|(_, p)| p)
      .collect()
  }

  pub fn update_lease_duration(&mut self, data: &ParticipantMessageData) {
    let now = Instant::now();
    let prefix = data.guid;
    self
      .external_topic_writers
      .range_mut(prefix.range())
      .for_each(|(_guid, p)| p.last_updated = now);
  }

  #[cfg(feature = "security")]
  pub fn get_authentication_status(&self, guid_prefix: GuidPrefix) -> Option<AuthenticationStatus> {
    self.authentication_statuses.get(&guid_prefix).copied()
  }

  #[cfg(feature = "security")]
  pub fn update_authentication_status(
    &mut self,
    guid_prefix: GuidPrefix,
    status: AuthenticationStatus,
  ) {
    self.authentication_statuses.insert(guid_prefix, status);
  }
}

#[cfg(test)]
pub(crate) mod tests {
  use std::{sync::Mutex, time::Duration as StdDuration};

  use byteorder::LittleEndian;

  use super::*;
  use crate::{
    dds::{
      qos::QosPolicies,
      statusevents::{sync_status_channel, DataReaderStatus},
      topic::TopicKind,
      with_key::simpledatareader::ReaderCommand,
    },
    discovery::attic::{MAX_ATTIC_BYTES, MAX_PARTICIPANTS_IN_ATTIC},
    mio_source,
    polling::{wake_channel, LoopWaker},
    serialization::CDRSerializerAdapter,
    structure::guid::*,
    test::{
      random_data::RandomData,
      test_data::{reader_proxy_data, spdp_participant_data, subscription_builtin_topic_data},
      test_domain::test_domain_id,
    },
  };

  #[test]
  fn discdb_participant_operations() {
    let (discovery_db_event_sender, _discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();

    let mut discoverydb = DiscoveryDB::new(
      GUID::new_participant_guid(),
      discovery_db_event_sender,
      status_sender,
    );
    let mut data = spdp_participant_data().unwrap();
    data.lease_duration = Some(Duration::from(StdDuration::from_secs(1)));

    discoverydb.update_participant(&data);
    assert_eq!(discoverydb.participant_proxies.len(), 1);

    discoverydb.update_participant(&data);
    assert_eq!(discoverydb.participant_proxies.len(), 1);

    std::thread::sleep(StdDuration::from_secs(2));
    discoverydb.participant_cleanup();
    assert!(discoverydb.participant_proxies.is_empty());

    // TODO: more operations tests
  }

  fn database() -> DiscoveryDB {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    DiscoveryDB::new(GUID::new_participant_guid(), updated_sender, status_sender)
  }

  pub(crate) fn new_participant() -> SpdpDiscoveredParticipantData {
    let mut participant = spdp_participant_data().unwrap();
    participant.participant_guid = GUID::new_participant_guid();
    participant
  }

  pub(crate) fn new_reader(participant: GUID, number: u32, topic: &str) -> DiscoveredReaderData {
    let mut reader = DiscoveredReaderData::default(topic.to_string(), "RandomData".to_string());
    let [_, key @ ..] = number.to_be_bytes();
    let id = EntityId::create_custom_entity_id(key, EntityKind::READER_NO_KEY_USER_DEFINED);
    reader.reader_proxy.remote_reader_guid = GUID::new(participant.prefix, id);
    reader
  }

  pub(crate) fn new_writer(participant: GUID, number: u32, topic: &str) -> DiscoveredWriterData {
    use crate::discovery::sedp_messages::PublicationBuiltinTopicData;
    let [_, key @ ..] = number.to_be_bytes();
    let id = EntityId::create_custom_entity_id(key, EntityKind::WRITER_NO_KEY_USER_DEFINED);
    let guid = GUID::new(participant.prefix, id);
    let (topic, dds_type) = (topic.to_string(), "RandomData".to_string());
    DiscoveredWriterData {
      last_updated: Instant::now(),
      writer_proxy: WriterProxy::new(guid, Vec::new(), Vec::new()),
      publication_topic_data: PublicationBuiltinTopicData::new(guid, None, topic, dds_type, None),
      user_data: Vec::new(),
    }
  }

  #[test]
  fn a_flood_of_participants_evicts_the_oldest_without_a_topic_of_ours() {
    let mut db = database();
    let (matched, unmatched) = (new_participant(), new_participant());
    let local = new_reader(GUID::new_participant_guid(), 1, "ours");
    db.update_local_topic_reader(local);
    for participant in [&matched, &unmatched] {
      db.update_participant(participant);
    }
    let reader = new_reader(matched.participant_guid, 1, "ours");
    assert!(db.update_subscription(&reader).is_some());
    let flood = (0..3_000).map(|_| db.update_participant(&new_participant()));
    let evicted: Vec<GuidPrefix> = flood
      .filter_map(|update| match update {
        ParticipantUpdate::New { evicted } => evicted,
        other => panic!("{other:?}"),
      })
      .collect();
    assert_eq!(db.participant_proxies.len(), MAX_PARTICIPANTS);
    assert_eq!(evicted[0], unmatched.participant_guid.prefix);
    assert!(db.participant_proxies.contains_key(&matched.participant_guid.prefix));
    assert_eq!(db.discovery_order.len(), MAX_PARTICIPANTS);
    assert!(db.attic.participants() <= MAX_PARTICIPANTS_IN_ATTIC);
    assert_eq!(db.counters().counts().participants_evicted, evicted.len() as u64);
  }

  #[test]
  fn the_endpoints_of_one_that_returns_survive_the_eviction_that_makes_room_for_it() {
    let mut db = database();
    let returning = new_participant();
    let prefix = returning.participant_guid.prefix;
    db.update_participant(&returning);
    db.update_subscription(&new_reader(returning.participant_guid, 1, "theirs"));
    db.remove_participant(prefix, false);
    // It is the oldest one in the attic, which is full.
    while db.attic.participants() < MAX_PARTICIPANTS_IN_ATTIC {
      let other = new_participant();
      db.update_participant(&other);
      db.remove_participant(other.participant_guid.prefix, true);
    }
    while db.participant_proxies.len() < MAX_PARTICIPANTS {
      db.update_participant(&new_participant());
    }
    let update = db.update_participant(&returning);
    assert!(matches!(update, ParticipantUpdate::New { evicted: Some(_) }), "{update:?}");
    assert_eq!(db.endpoints_of(prefix).0.len(), 1);
    assert!(!db.attic.contains(prefix));
  }

  #[test]
  fn a_participant_is_refused_when_all_others_have_a_topic_of_ours() {
    let mut db = database();
    db.update_local_topic_reader(new_reader(GUID::new_participant_guid(), 1, "ours"));
    for number in 0..MAX_PARTICIPANTS {
      let participant = new_participant();
      db.update_participant(&participant);
      db.update_subscription(&new_reader(participant.participant_guid, number as u32, "ours"));
    }
    assert_eq!(db.update_participant(&new_participant()), ParticipantUpdate::Refused);
    assert_eq!(db.counters().counts().announcements_refused, 1);
  }

  #[test]
  fn endpoints_are_limited_for_each_participant_and_for_all() {
    let mut db = database();
    db.update_local_topic_reader(new_reader(GUID::new_participant_guid(), 1, "ours"));
    let greedy = new_participant().participant_guid;
    let accepts = |db: &mut DiscoveryDB, participant: GUID, number: usize, topic: &str| {
      let reader = new_reader(participant, number as u32, topic);
      db.update_subscription(&reader).is_some()
    };
    let accepted = (0..5_000).filter(|n| accepts(&mut db, greedy, *n, "greedy")).count();
    assert_eq!(accepted, MAX_ENDPOINTS_PER_PARTICIPANT);
    assert!(accepts(&mut db, greedy, 1, "greedy"), "an endpoint that is known is updated");
    for topic in 0..20 {
      let other = new_participant().participant_guid;
      for n in 0..1_000 {
        accepts(&mut db, other, n, &format!("theirs{topic}"));
      }
    }
    assert_eq!(db.external_topic_readers.len(), MAX_ENDPOINTS);
    let late = new_participant().participant_guid;
    assert!(!accepts(&mut db, late, 1, "theirs"));
    assert!(accepts(&mut db, late, 2, "ours"), "a reader of our topic is accepted");
    // As many again, of five participants.
    let mut accepted = 1;
    for _ in 0..5 {
      let other = new_participant().participant_guid;
      let all = 0..MAX_ENDPOINTS_PER_PARTICIPANT;
      accepted += all.filter(|n| accepts(&mut db, other, *n, "ours")).count();
    }
    assert_eq!(accepted, MAX_ENDPOINTS);
    assert!(!accepts(&mut db, late, 3, "ours"));
    assert!(db.counters().counts().endpoints_refused > 5_000 - MAX_ENDPOINTS_PER_PARTICIPANT as u64);
  }

  #[test]
  fn what_an_endpoint_announces_is_limited_in_bytes() {
    let mut db = database();
    let participant = new_participant().participant_guid;
    let named = |number, bytes| new_reader(participant, number, &"t".repeat(bytes));
    assert!(db.update_subscription(&named(1, 256)).is_some());
    assert!(db.update_subscription(&named(2, MAX_ENDPOINT_BYTES)).is_none());
    let large = DiscoveredReaderData {
      user_data: vec![0; MAX_ENDPOINT_BYTES],
      ..named(1, 256)
    };
    assert!(db.update_subscription(&large).is_none());
    assert_eq!(db.counters().counts().endpoints_refused, 2);
    // A host with many interfaces is not refused; the first addresses count.
    let mut many = named(3, 256);
    let locator = Locator::UdpV4("192.0.2.1:7411".parse().unwrap());
    many.reader_proxy.unicast_locator_list = vec![locator; 2_000];
    // Those of another transport do not count.
    let shared_memory = Locator::Other {
      kind: 16,
      port: 7411,
      address: [0; 16],
    };
    let others = std::iter::repeat_n(shared_memory, 2 * MAX_LOCATORS_PER_READER);
    many.reader_proxy.unicast_locator_list.splice(0..0, others);
    let known = db.update_subscription(&many).unwrap();
    assert_eq!(
      known.reader_proxy.unicast_locator_list,
      vec![locator; MAX_LOCATORS_PER_READER]
    );
    let mut participant = new_participant();
    participant.default_unicast_locators = vec![locator; 2_000];
    db.update_participant(&participant);
    let known = db.find_participant_proxy(participant.participant_guid.prefix);
    assert_eq!(known.unwrap().default_unicast_locators.len(), MAX_LOCATORS_PER_READER);
  }

  #[test]
  fn the_endpoints_of_participants_that_are_gone_are_limited() {
    let mut db = database();
    let mut gone = Vec::new();
    for _ in 0..4 {
      let participant = new_participant();
      db.update_participant(&participant);
      for number in 0..MAX_ENDPOINTS_PER_PARTICIPANT {
        let mut reader = new_reader(participant.participant_guid, number as u32, "theirs");
        reader.user_data = vec![0; 1_500];
        assert!(db.update_subscription(&reader).is_some());
      }
      db.remove_participant(participant.participant_guid.prefix, true);
      gone.push(participant);
    }
    assert!(db.attic.bytes() > MAX_ATTIC_BYTES / 2 && db.attic.bytes() <= MAX_ATTIC_BYTES);
    let restored = |db: &mut DiscoveryDB, participant: &SpdpDiscoveredParticipantData| {
      db.update_participant(participant);
      db.endpoints_of(participant.participant_guid.prefix).0.len()
    };
    assert_eq!(restored(&mut db, &gone[0]), 0, "the one that has been gone for longest");
    for participant in &gone[2..] {
      assert_eq!(restored(&mut db, participant), MAX_ENDPOINTS_PER_PARTICIPANT);
    }
    assert_eq!(db.attic.bytes(), 0);
  }

  #[test]
  fn an_endpoint_of_one_that_is_gone_stays_with_the_others_of_it() {
    let mut db = database();
    let participant = new_participant();
    let prefix = participant.participant_guid.prefix;
    db.update_participant(&participant);
    db.update_subscription(&new_reader(participant.participant_guid, 1, "theirs"));
    db.remove_participant(prefix, false);
    // It is announced before its participant returns, and its topic has changed.
    db.update_subscription(&new_reader(participant.participant_guid, 1, "another"));
    db.update_subscription(&new_reader(participant.participant_guid, 2, "theirs"));
    assert!(db.remove_participant(prefix, true));
    assert_eq!(db.endpoints_of(prefix).0.len(), 0);
    db.update_participant(&participant);
    let readers = db.endpoints_of(prefix).0;
    let topics: Vec<_> = readers.iter().map(|r| r.subscription_topic_data.topic_name()).collect();
    assert_eq!(topics, ["another", "theirs"]);
  }

  #[test]
  fn a_topic_of_others_is_remembered_once_however_many_announce_it() {
    let mut db = database();
    let data = TopicBuiltinTopicData::new(
      None,
      "theirs".to_string(),
      "RandomData".to_string(),
      &QosPolicies::qos_none(),
    );
    for _ in 0..10 {
      let topic = DiscoveredTopicData::new(Utc::now(), data.clone());
      db.update_topic_data(&topic, GUID::new_participant_guid(), DiscoveredVia::Topic);
    }
    assert_eq!(db.topics["theirs"].len(), 1);
  }

  // Prints what the kernel counts for a database at all its limits, with the largest
  // announcements that it accepts. In a process of its own, because the memory of other
  // tests would count.
  #[cfg(target_os = "linux")]
  #[test]
  fn a_full_database_takes_a_bounded_amount_of_memory() {
    const ALONE: &str = "RUSTDDS_TEST_ALONE";
    if std::env::var_os(ALONE).is_none() {
      let name = "discovery::discovery_db::tests::a_full_database_takes_a_bounded_amount_of_memory";
      let status = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture"])
        .env(ALONE, "1")
        .status();
      assert!(status.unwrap().success());
      return;
    }
    let resident_kib = || -> usize {
      let status = std::fs::read_to_string("/proc/self/status").unwrap();
      let line = status.lines().find(|line| line.starts_with("RssAnon")).unwrap();
      line.split_whitespace().nth(1).unwrap().parse().unwrap()
    };
    let before = resident_kib();
    let mut db = database();
    fill_with_large_announcements(&mut db, 16);
    for prefix in db.participant_prefixes(|_| true) {
      db.remove_participant(prefix, true);
    }
    assert!(db.attic.bytes() > MAX_ATTIC_BYTES / 2);
    db.topic_cleanup();
    fill_with_large_announcements(&mut db, MAX_PARTICIPANTS);
    assert_eq!(db.external_topic_writers.len(), MAX_ENDPOINTS);
    let mib = (resident_kib() - before) / 1024;
    println!("a full database takes {mib} MiB");
    assert!(mib < 400, "{mib} MiB");
  }

  // Adds as many readers and writers as there is room for, of so many participants.
  fn fill_with_large_announcements(db: &mut DiscoveryDB, participants: usize) {
    let locators = vec![Locator::UdpV4("192.0.2.1:7411".parse().unwrap()); MAX_LOCATORS_PER_READER];
    for place in 0..participants {
      let mut participant = new_participant();
      participant.default_unicast_locators = locators.clone();
      participant.metatraffic_unicast_locators = locators.clone();
      db.update_participant(&participant);
      for number in 0..MAX_ENDPOINTS / participants {
        let topic = format!("{place}_{number:0>800}");
        let mut reader = new_reader(participant.participant_guid, number as u32, &topic);
        reader.reader_proxy.unicast_locator_list = locators.clone();
        reader.reader_proxy.multicast_locator_list = locators.clone();
        reader.user_data = vec![0; 900];
        assert!(db.update_subscription(&reader).is_some());
        let guid = reader.reader_proxy.remote_reader_guid;
        let writer = DiscoveredWriterData {
          last_updated: Instant::now(),
          writer_proxy: WriterProxy::new(guid, locators.clone(), locators.clone()),
          publication_topic_data: crate::discovery::PublicationBuiltinTopicData::new(
            guid,
            None,
            topic,
            "t".repeat(900),
            None,
          ),
          user_data: Vec::new(),
        };
        assert!(db.update_publication(&writer).is_some());
      }
    }
  }

  #[test]
  fn a_lease_is_granted_for_five_minutes_at_most() {
    let mut db = database();
    let mut participant = new_participant();
    participant.lease_duration = Some(Duration::INFINITE);
    db.update_participant(&participant);
    let prefix = participant.participant_guid.prefix;
    let heard = |db: &mut DiscoveryDB, ago_s: u64| {
      let sign = Instant::now().checked_sub(StdDuration::from_secs(ago_s)).unwrap();
      db.participant_last_life_signs.insert(prefix, sign);
      db.participant_cleanup().len()
    };
    assert_eq!(heard(&mut db, 299), 0);
    assert_eq!(heard(&mut db, 301), 1);
  }

  #[test]
  fn endpoints_of_a_disposed_participant_are_restored_with_its_next_announcement() {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let mut db = DiscoveryDB::new(GUID::new_participant_guid(), updated_sender, status_sender);
    let announce = |db: &mut DiscoveryDB| {
      let mut participant = spdp_participant_data().unwrap();
      participant.participant_guid = GUID::new_participant_guid();
      db.update_participant(&participant);
      let mut reader =
        DiscoveredReaderData::default("some_topic".to_string(), "RandomData".to_string());
      reader.reader_proxy.remote_reader_guid = GUID::new(
        participant.participant_guid.prefix,
        EntityId::create_custom_entity_id([0, 0, 1], EntityKind::READER_NO_KEY_USER_DEFINED),
      );
      db.update_subscription(&reader);
      participant
    };
    let participant = announce(&mut db);
    let prefix = participant.participant_guid.prefix;
    for was_silent in [false, true] {
      if was_silent {
        db.remove_participant(prefix, false);
      }
      db.remove_participant(prefix, true);
      assert_eq!(db.endpoints_of(prefix).0.len(), 0);
      assert!(db.participant_is_alive(prefix).is_none(), "a late datagram does not restore it");
      let update = db.update_participant(&participant);
      assert_eq!(update, ParticipantUpdate::New { evicted: None });
      assert_eq!(db.endpoints_of(prefix).0.len(), 1);
    }

    // The memory for those that are gone is bounded, and the first to go is the first forgotten.
    db.remove_participant(prefix, true);
    for _ in 0..MAX_PARTICIPANTS_IN_ATTIC {
      let other = announce(&mut db).participant_guid.prefix;
      db.remove_participant(other, true);
    }
    assert_eq!(db.attic.participants(), MAX_PARTICIPANTS_IN_ATTIC);
    db.update_participant(&participant);
    assert_eq!(db.endpoints_of(prefix).0.len(), 0);
  }

  #[test]
  fn discdb_writer_proxies() {
    let (discovery_db_event_sender, _discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let _discoverydb = DiscoveryDB::new(
      GUID::new_participant_guid(),
      discovery_db_event_sender,
      status_sender,
    );
    let topic_name = String::from("some_topic");
    let type_name = String::from("RandomData");
    let _dreader = DiscoveredReaderData::default(topic_name, type_name);

    // TODO: more tests :)
  }

  #[test]
  fn discdb_subscription_operations() {
    let (discovery_db_event_sender, _discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();

    let mut discovery_db = DiscoveryDB::new(
      GUID::new_participant_guid(),
      discovery_db_event_sender,
      status_sender,
    );

    let domain_participant =
      DomainParticipant::new(test_domain_id(0)).expect("Failed to create publisher");
    let topic = domain_participant
      .create_topic(
        "Foobar".to_string(),
        "RandomData".to_string(),
        &QosPolicies::qos_none(),
        TopicKind::WithKey,
      )
      .unwrap();
    let topic2 = domain_participant
      .create_topic(
        "Barfoo".to_string(),
        "RandomData".to_string(),
        &QosPolicies::qos_none(),
        TopicKind::WithKey,
      )
      .unwrap();

    let publisher1 = domain_participant
      .create_publisher(&QosPolicies::qos_none())
      .unwrap();
    let dw = publisher1
      .create_datawriter::<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>>(&topic, None)
      .unwrap();

    let writer_data = DiscoveredWriterData::new(&dw, &topic, &domain_participant, None);

    discovery_db.update_local_topic_writer(writer_data);
    assert_eq!(discovery_db.local_topic_writers.len(), 1);

    let publisher2 = domain_participant
      .create_publisher(&QosPolicies::qos_none())
      .unwrap();
    let dw2 = publisher2
      .create_datawriter::<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>>(
        &topic2, None,
      )
      .unwrap();
    let writer_data2 = DiscoveredWriterData::new(&dw2, &topic2, &domain_participant, None);
    discovery_db.update_local_topic_writer(writer_data2);
    assert_eq!(discovery_db.local_topic_writers.len(), 2);

    // creating data
    let reader1 = reader_proxy_data().unwrap();
    let reader1sub = subscription_builtin_topic_data().unwrap();
    // reader1sub.set_key(reader1.remote_reader_guid);
    // reader1sub.set_topic_name(&topic.name());
    let dreader1 = DiscoveredReaderData {
      reader_proxy: reader1.clone(),
      subscription_topic_data: reader1sub.clone(),
      content_filter: None,
      user_data: Vec::new(),
    };
    discovery_db.update_subscription(&dreader1);

    let reader2 = reader_proxy_data().unwrap();
    let reader2sub = subscription_builtin_topic_data().unwrap();
    // reader2sub.set_key(reader2.remote_reader_guid);
    // reader2sub.set_topic_name(&topic2.name());
    let dreader2 = DiscoveredReaderData {
      reader_proxy: reader2,
      subscription_topic_data: reader2sub,
      content_filter: None,
      user_data: Vec::new(),
    };
    discovery_db.update_subscription(&dreader2);

    let reader3 = reader1;
    let reader3sub = reader1sub;
    let dreader3 = DiscoveredReaderData {
      reader_proxy: reader3,
      subscription_topic_data: reader3sub,
      content_filter: None,
      user_data: Vec::new(),
    };
    discovery_db.update_subscription(&dreader3);

    // TODO: there might be a need for different scenarios
  }

  #[test]
  fn discdb_external_endpoint_snapshots() {
    let (discovery_db_event_sender, _discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();

    let mut discovery_db = DiscoveryDB::new(
      GUID::new_participant_guid(),
      discovery_db_event_sender,
      status_sender,
    );

    // Nothing discovered yet.
    assert_eq!(discovery_db.get_all_external_topic_readers().count(), 0);
    assert_eq!(discovery_db.get_all_external_topic_writers().count(), 0);

    // Discover one external Reader via SEDP subscription data.
    let reader = reader_proxy_data().unwrap();
    let reader_sub = subscription_builtin_topic_data().unwrap();
    let dreader = DiscoveredReaderData {
      reader_proxy: reader,
      subscription_topic_data: reader_sub,
      content_filter: None,
      user_data: Vec::new(),
    };
    discovery_db.update_subscription(&dreader);

    // Discover one external Writer via SEDP publication data.
    let domain_participant =
      DomainParticipant::new(test_domain_id(0)).expect("Failed to create participant");
    let topic = domain_participant
      .create_topic(
        "Foobar".to_string(),
        "RandomData".to_string(),
        &QosPolicies::qos_none(),
        TopicKind::WithKey,
      )
      .unwrap();
    let publisher = domain_participant
      .create_publisher(&QosPolicies::qos_none())
      .unwrap();
    let dw = publisher
      .create_datawriter::<RandomData, CDRSerializerAdapter<RandomData, LittleEndian>>(&topic, None)
      .unwrap();
    let writer_data = DiscoveredWriterData::new(&dw, &topic, &domain_participant, None);
    discovery_db.update_publication(&writer_data);

    // Both accessors return the discovered endpoints as a snapshot.
    let readers = discovery_db
      .get_all_external_topic_readers()
      .cloned()
      .collect::<Vec<_>>();
    let writers = discovery_db
      .get_all_external_topic_writers()
      .cloned()
      .collect::<Vec<_>>();
    assert_eq!(readers.len(), 1);
    assert_eq!(writers.len(), 1);
    assert_eq!(
      readers[0].reader_proxy.remote_reader_guid,
      dreader.reader_proxy.remote_reader_guid
    );
    assert_eq!(
      writers[0].writer_proxy.remote_writer_guid,
      writer_data.writer_proxy.remote_writer_guid
    );
  }

  #[test]
  fn discdb_local_topic_reader() {
    let (discovery_db_event_sender, _discovery_db_event_receiver) =
      std::sync::mpsc::sync_channel::<()>(4);

    let dp = DomainParticipant::new(test_domain_id(0)).expect("Failed to create participant");
    let topic = dp
      .create_topic(
        "some topic name".to_string(),
        "Wazzup".to_string(),
        &QosPolicies::qos_none(),
        TopicKind::WithKey,
      )
      .unwrap();
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let mut discoverydb = DiscoveryDB::new(
      GUID::new_participant_guid(),
      discovery_db_event_sender,
      status_sender,
    );

    // Create reader ingredients
    let (notification_sender1, _notification_receiver1) =
      crate::mio_source::notification_channel(100);
    let (_notification_event_source1, notification_event_sender1) =
      mio_source::make_poll_channel().unwrap();
    let data_reader_waker1 = Arc::new(Mutex::new(None));

    let (status_sender1, _status_receiver1) = sync_status_channel::<DataReaderStatus>(4).unwrap();
    let (_reader_commander1, reader_command_receiver1) =
      wake_channel::<ReaderCommand>(100, &LoopWaker::new());

    let topic_cache =
      dp.dds_cache()
        .write()
        .unwrap()
        .add_new_topic(topic.name(), topic.get_type(), &topic.qos());

    let reader1_ing = ReaderIngredients {
      guid: GUID::dummy_test_guid(EntityKind::READER_NO_KEY_USER_DEFINED),
      notification_sender: notification_sender1,
      status_sender: status_sender1,
      topic_name: topic.name(),
      topic_cache_handle: topic_cache.clone(),
      like_stateless: false,
      qos_policy: QosPolicies::qos_none(),
      data_reader_command_receiver: reader_command_receiver1,
      data_reader_waker: data_reader_waker1,
      poll_event_sender: notification_event_sender1,
      security_plugins: None,
      discovery_notify: None,
      taken: BTreeMap::new(),
    };

    // Add the reader to the database and verify the info is updated
    discoverydb.update_local_topic_reader(DiscoveryDB::local_topic_reader_data(
      &dp,
      &topic,
      &reader1_ing,
      None,
    ));
    assert_eq!(discoverydb.local_topic_readers.len(), 1);
    assert_eq!(discoverydb.get_local_topic_readers(&topic).len(), 1);

    // Verify that the info does not change if the reader is added a second time
    discoverydb.update_local_topic_reader(DiscoveryDB::local_topic_reader_data(
      &dp,
      &topic,
      &reader1_ing,
      None,
    ));
    assert_eq!(discoverydb.local_topic_readers.len(), 1);
    assert_eq!(discoverydb.get_local_topic_readers(&topic).len(), 1);

    // Create second reader ingredients for the same topic
    let (notification_sender2, _notification_receiver2) =
      crate::mio_source::notification_channel(100);
    let (_notification_event_source2, notification_event_sender2) =
      mio_source::make_poll_channel().unwrap();
    let data_reader_waker2 = Arc::new(Mutex::new(None));

    let (status_sender2, _status_receiver2) = sync_status_channel::<DataReaderStatus>(4).unwrap();
    let (_reader_commander2, reader_command_receiver2) =
      wake_channel::<ReaderCommand>(100, &LoopWaker::new());

    let mut guid2 = GUID::dummy_test_guid(EntityKind::READER_NO_KEY_USER_DEFINED);
    guid2.prefix = GuidPrefix::new(b"Another fake"); // GUID needs to be different in order to be added

    let reader2_ing = ReaderIngredients {
      guid: guid2,
      notification_sender: notification_sender2,
      status_sender: status_sender2,
      topic_name: topic.name(),
      topic_cache_handle: topic_cache,
      like_stateless: false,
      qos_policy: QosPolicies::qos_none(),
      data_reader_command_receiver: reader_command_receiver2,
      data_reader_waker: data_reader_waker2,
      poll_event_sender: notification_event_sender2,
      security_plugins: None,
      discovery_notify: None,
      taken: BTreeMap::new(),
    };

    // Add the second reader to the database and verify the info is updated
    discoverydb.update_local_topic_reader(DiscoveryDB::local_topic_reader_data(
      &dp,
      &topic,
      &reader2_ing,
      None,
    ));
    assert_eq!(discoverydb.get_local_topic_readers(&topic).len(), 2);
    assert_eq!(discoverydb.get_all_local_topic_readers().count(), 2);
  }

  #[test]
  fn what_endpoints_announced_of_a_topic_goes_with_them() {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let mut db = DiscoveryDB::new(GUID::new_participant_guid(), updated_sender, status_sender);
    let mut participant = spdp_participant_data().unwrap();
    participant.participant_guid = GUID::new_participant_guid();
    let prefix = participant.participant_guid.prefix;
    let new_reader = |number: u8, prefix: GuidPrefix| {
      let mut reader =
        DiscoveredReaderData::default("some_topic".to_string(), "RandomData".to_string());
      reader.reader_proxy.remote_reader_guid = GUID::new(
        prefix,
        EntityId::create_custom_entity_id([0, 0, number], EntityKind::READER_NO_KEY_USER_DEFINED),
      );
      reader
    };
    // One of another participant stays.
    let stays = new_reader(1, GUID::new_participant_guid().prefix);
    db.update_subscription(&stays);
    db.update_participant(&participant);
    for number in 1..=3 {
      db.update_subscription(&new_reader(number, prefix));
    }
    assert_eq!(db.topics["some_topic"].len(), 4);
    db.remove_topic_reader(new_reader(2, prefix).reader_proxy.remote_reader_guid);
    assert_eq!(db.topics["some_topic"].len(), 3);
    for is_disposed in [true, false] {
      db.remove_participant(prefix, is_disposed);
      assert_eq!(db.topics["some_topic"].len(), 1);
      // It returns with the endpoints that are in the attic.
      db.update_participant(&participant);
      assert_eq!(db.topics["some_topic"].len(), 3);
    }
    db.remove_participant(prefix, true);
    db.remove_topic_reader(stays.reader_proxy.remote_reader_guid);
    assert!(db.get_topic("some_topic").is_none());
  }
}
