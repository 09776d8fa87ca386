use std::{
  cmp::max,
  collections::{
    btree_map::{self, Entry},
    BTreeMap, HashMap,
  },
  iter,
  ops::Bound::{Excluded, Included},
  sync::{Arc, Mutex},
};

#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};

use crate::{
  create_error_internal,
  dds::{
    lent::Lender,
    qos::{
      policy::{History, ResourceLimits},
      QosPolicies,
    },
    typedesc::TypeDesc,
    CreateError, CreateResult,
  },
  rtps::constant::{
    builtin_topic_names::DCPS_PARTICIPANT, MAX_KEPT_BYTES_PER_BUILTIN_TOPIC,
    MAX_TRACKED_CHANGES_PER_WRITER, MAX_WITHHELD_BYTES_PER_TOPIC,
  },
  structure::{duration::Duration, sequence_number::SequenceNumber, time::Timestamp},
  GUID,
};
use super::cache_change::CacheChange;

// How long discovery data of a Writer that is not matched is kept.
const KEEP_UNMATCHED: Duration = Duration::from_secs(5);

/// DDSCache contains all cacheChanges that are
/// received by this participant. It is for serving local Readers. Local
/// Writers each contain a HistoryBuffer to CacheChanges written by themselves.
///
/// Readers and Writers need separate caches, because the garbage collection
/// algorithms must be different. DDS spec 1.4 table at pp. 99-100 defines the
/// QoS History to be scoped over each Writer (individually), whereas History
/// for Readers is scoped over the entire Topic (or Instances in it). This leads
/// to situations where some sample would be garbage collected by a Reader's
/// History policy, but must be preserved by a Writer's History Policy.
///
/// Each topic that has been subscribed to
/// is contained in a separate TopicCache. One TopicCache contains
/// only CacheChanges of one serialized IDL datatype. -> all cache changes in
/// same TopicCache can be serialized/deserialized same way. Topic/TopicCache is
/// identified by its name, which must be unique in the whole Domain.
///
/// More specifically, the DDSCache stores handles (Arcs) to mutexes protecting
/// the actual TopicCaches. For a given topic, the Reader/Writer and
/// DataReader/DataWriter get a clone of the handle and
/// interact with the TopicCache through this handle.
#[derive(Debug, Default)]
pub struct DDSCache {
  topic_caches: HashMap<String, Arc<Mutex<TopicCache>>>,
}

impl DDSCache {
  pub fn new() -> Self {
    Self::default()
  }
  // Insert new topic if it does not exist.
  // If it exists already, update cache size limits.
  // Return a handle to the cache topic.
  // TODO: If we pick up a topic from Discovery, can someone DoS us by
  // sending super large limits in Topic QoS?
  pub(crate) fn add_new_topic(
    &mut self,
    topic_name: String,
    topic_data_type: TypeDesc,
    qos: &QosPolicies,
  ) -> Arc<Mutex<TopicCache>> {
    let topic_cache_handle = self
      .topic_caches
      .entry(topic_name.clone())
      .and_modify(|tc| tc.lock().unwrap().update_keep_limits(qos))
      .or_insert(Arc::new(Mutex::new(TopicCache::new(
        topic_name,
        topic_data_type,
        qos,
      ))));

    topic_cache_handle.clone()
  }

  pub(crate) fn get_existing_topic_cache(
    &self,
    topic_name: &str,
  ) -> CreateResult<Arc<Mutex<TopicCache>>> {
    // Return a clone of the pointer to the mutex on an existing topic cache
    match self.topic_caches.get(topic_name) {
      Some(tc) => Ok(tc.clone()),
      None => create_error_internal!("Topic cache for topic {topic_name} not found in DDS cache"),
    }
  }

  // Readers and Writers of the topic that still exist keep their handle.
  pub fn remove_topic(&mut self, topic_name: &str) {
    if self.topic_caches.contains_key(topic_name) {
      self.topic_caches.remove(topic_name);
    }
  }

  pub fn garbage_collect(&mut self) {
    let unmatched_before = Timestamp::now() - KEEP_UNMATCHED;
    for tc in self.topic_caches.values_mut() {
      let mut tc = tc.lock().unwrap();
      tc.forget_unmatched_writers(unmatched_before);
      if let Some((last_timestamp, _)) = tc.changes.iter().next_back() {
        if *last_timestamp > tc.changes_reallocated_up_to {
          tc.remove_changes_before(Timestamp::ZERO);
        }
      }
    }
  }
}

#[derive(Debug)]
pub(crate) struct TopicCache {
  topic_name: String,
  #[allow(dead_code)] // TODO: Which (future) feature needs this?
  topic_data_type: TypeDesc,
  #[allow(dead_code)]
  // TODO: The relevant data here is in min/max keep_samples. Is this still relevant?
  topic_qos: QosPolicies,
  min_keep_samples: History,
  max_keep_samples: i32, // from QoS, for quick, repeated access
  // TODO: Change this to Option<u32>, where None means "no limit".
  is_built_in: bool,
  // The most payload bytes that it keeps in the library's memory beyond what is
  // withheld; for topics of the application what the lender says, if it does.
  max_keep_bytes: Option<usize>,

  // The main content of the cache is in this map.
  // Timestamp is assumed to be unique id over all the CacheChanges. Uniqueness is
  // enforced on insert (see `add_change_internal`) by never issuing a key that is
  // not strictly greater than the previous one, so a coarse system clock that
  // returns the same instant for two back-to-back receives cannot collide.
  changes: BTreeMap<Timestamp, CacheChange>,

  // The underlying Bytes buffers are reallocated after some time (once for each) in
  // order to release the original receive buffer. The idea behind this is that if a CacheChange
  // persists in the TopicCaceh for some time, it should no longer hold onto the receive buffer,
  // so we can recycle the buffers. Otherwise, we (practically) leak memory.
  changes_reallocated_up_to: Timestamp,

  // The largest key ever inserted into `changes`. Used to keep the keys strictly
  // monotonic: `receive_timestamp` is `Timestamp::now()` sampled per incoming
  // message, but the system clock granularity can be coarser than the time it
  // takes to process several aggregated DATA submessages, so two distinct samples
  // may carry the same instant. We then bump the key by one tick (~0.233 ns) so it
  // stays unique. This cannot outrun real time: regaining a whole second of skew
  // would need 2^32 receives within it.
  last_added_instant: Timestamp,

  // Samples added since the last collection; a large one counts as several.
  added_since_collection: usize,

  // sequence_numbers is an index to "changes" by GUID and SN
  sequence_numbers: BTreeMap<GUID, BTreeMap<SequenceNumber, Timestamp>>,

  // Keep track of how far we have "reliably" received samples from each Writer
  // This means that all data up to this point has either been received, or
  // we have been notified (GAP or HEARTBEAT) that is not available and never will.
  // Therefore, data before the marker SN can be handed off to a Reliable DataReader.
  // Initially, we consider the marker for each Writer (GUID) to be SequenceNumber::new(1)
  received_reliably_before: BTreeMap<GUID, SequenceNumber>,

  // Of each Writer, the samples that became available at once when a missing one came, and
  // that no Reliable DataReader has read since: the first of them, and the one after them.
  unread: BTreeMap<GUID, (SequenceNumber, SequenceNumber)>,

  // Where the application wants samples of several fragments, if it does.
  pub(crate) lender: Lender,

  // What the application has taken of each Writer before: Readers of the topic that
  // are made from now on begin after these samples.
  pub(crate) taken: BTreeMap<GUID, SequenceNumber>,

  // BestEffort Readers of the topic that are made from now on begin after this key
  // of `changes`.
  pub(crate) begin_instant: Timestamp,
}

impl TopicCache {
  pub fn new(topic_name: String, topic_data_type: TypeDesc, topic_qos: &QosPolicies) -> Self {
    let is_built_in = topic_name.starts_with("DCPS");
    let mut new_self = Self {
      topic_name,
      is_built_in,
      max_keep_bytes: is_built_in.then_some(MAX_KEPT_BYTES_PER_BUILTIN_TOPIC),
      topic_data_type,
      topic_qos: topic_qos.clone(),
      min_keep_samples: History::KeepLast { depth: 1 }, /* dummy value, next call will overwrite
                                                         * this */
      max_keep_samples: 1, // dummy value, next call will overwrite this
      changes: BTreeMap::new(),
      changes_reallocated_up_to: Timestamp::ZERO,
      last_added_instant: Timestamp::ZERO,
      added_since_collection: 0,
      sequence_numbers: BTreeMap::new(),
      received_reliably_before: BTreeMap::new(),
      unread: BTreeMap::new(),
      lender: Lender::default(),
      taken: BTreeMap::new(),
      begin_instant: Timestamp::ZERO,
    };

    new_self.update_keep_limits(topic_qos);

    new_self
  }

  pub fn set_lender(&mut self, lender: Lender) {
    if !self.is_built_in {
      self.max_keep_bytes = lender.limits().max_kept_bytes;
    }
    self.lender = lender;
  }

  // Lets Readers that are made from now on begin after what is here.
  pub fn begin_now(&mut self) {
    self.begin_instant = self.last_added_instant;
    let highest = |(writer, numbers): (&GUID, &BTreeMap<SequenceNumber, Timestamp>)| {
      numbers.last_key_value().map(|(number, _)| (*writer, *number))
    };
    self.taken = self.sequence_numbers.iter().filter_map(highest).collect();
  }

  pub fn update_keep_limits(&mut self, qos: &QosPolicies) {
    let min_keep_samples = qos
      .history()
      // default history setting from DDS spec v1.4 Section 2.2.3 "Supported QoS",
      // Table at p.99
      .unwrap_or(History::KeepLast { depth: 1 });

    // Look up some Topic-specific resource limit
    // and remove earliest samples until we are within limit.
    // This prevents cache from growing indefinitely.
    let max_keep_samples = qos
      .resource_limits()
      .unwrap_or(ResourceLimits {
        // This is some default limits out of the hat, if there was no QoS specification.
        // The purpose of these limits is to prevent excessive memory usage.
        max_samples: 64,
        max_instances: 64,
        max_samples_per_instance: 64,
      })
      .max_samples;
    // TODO: We cannot currently keep track of instance counts, because TopicCache
    // or DDSCache below do not know about instances.

    // If a definite minimum is specified, increase resource limit to at least that.
    let max_keep_samples = match min_keep_samples {
      History::KeepLast { depth: n } if n > max_keep_samples => n,
      _ => max_keep_samples,
    };

    // actual update. This is will only ever increase cache size.
    self.min_keep_samples = max(min_keep_samples, self.min_keep_samples);
    self.max_keep_samples = max(max_keep_samples, self.max_keep_samples);
  }

  // Returns true if the "reliably_received_before"-marker was actually moved
  // forward and false if not. The marker never moves backwards: the cache may
  // have given up on a missing sample that the Reader is still waiting for.
  pub fn mark_reliably_received_before(&mut self, writer: GUID, sn: SequenceNumber) -> bool {
    let prev_sn = self.reliable_before(writer);
    // The entry must exist even at the initial value: withheld samples are
    // protected only for Writers that have one.
    let marker = self.received_reliably_before.entry(writer).or_default();
    *marker = max(*marker, sn);
    self.advance_marker_over_present(writer);
    self.keep_until_read(writer, prev_sn);
    prev_sn < self.reliable_before(writer)
  }

  // Keeps the samples that have become available at once, from that one on, until they are
  // read: as many as a Reader tracks. They are more than what is kept by the number of
  // samples if many were missing, and the oldest of them were received first.
  fn keep_until_read(&mut self, writer: GUID, first: SequenceNumber) {
    let before = self.reliable_before(writer);
    let Some(numbers) = self.sequence_numbers.get(&writer) else {
      return;
    };
    if before <= first.plus_1() || numbers.range(first..before).nth(1).is_none() {
      return;
    }
    let (from, until) = self.unread.entry(writer).or_insert((first, before));
    *until = before;
    *from = max(*from, before - SequenceNumber::from(MAX_TRACKED_CHANGES_PER_WRITER));
  }

  // A Reliable DataReader has read the samples of the Writer up to that one.
  pub fn set_read(&mut self, writer: GUID, up_to: SequenceNumber) {
    if let Entry::Occupied(mut unread) = self.unread.entry(writer) {
      let (from, until) = unread.get_mut();
      *from = max(*from, up_to.plus_1());
      if from >= until {
        unread.remove();
      }
    }
  }

  // Samples present without a break right at the marker have nothing missing
  // before them, so move the marker past them. This matters after giving up on
  // a missing sample, when the Reader still reports it as missing.
  fn advance_marker_over_present(&mut self, writer: GUID) {
    let Some(marker) = self.received_reliably_before.get_mut(&writer) else {
      return;
    };
    if let Some(sn_map) = self.sequence_numbers.get(&writer) {
      for sn in sn_map.range(*marker..).map(|(sn, _)| *sn) {
        if sn != *marker {
          break;
        }
        *marker = sn.plus_1();
      }
    }
  }

  // The Writer is gone, so samples it never completed are no longer awaited.
  //
  // Its samples go, too. No Reliable DataReader gets them from here on, but when the
  // Writer is matched again, all that it sent before count as received, and a new
  // DataReader of the topic would get what a former one has taken.
  pub fn forget_reliable_writer(&mut self, writer: GUID) {
    if self.received_reliably_before.remove(&writer).is_none() {
      return;
    }
    self.unread.remove(&writer);
    for instant in self
      .sequence_numbers
      .remove(&writer)
      .unwrap_or_default()
      .values()
    {
      self.changes.remove(instant);
    }
  }

  // Discovery data may come before its Writer is matched, which makes discovery faster. If the
  // Writer is not matched then, or was before, as with the disposes of a participant that
  // has said goodbye, no Reliable DataReader gets the data.
  fn forget_unmatched_writers(&mut self, before: Timestamp) {
    // Of participants, a Best-Effort DataReader reads the announcements of all.
    if !self.is_built_in || self.topic_name == DCPS_PARTICIPANT {
      return;
    }
    let (matched, changes) = (&self.received_reliably_before, &mut self.changes);
    self.sequence_numbers.retain(|writer, instants| {
      let is_kept =
        matched.contains_key(writer) || instants.values().any(|instant| *instant >= before);
      if !is_kept {
        for instant in instants.values() {
          changes.remove(instant);
        }
      }
      is_kept
    });
  }

  // The changes that a Reliable DataReader cannot yet take, because an earlier sample from
  // the same Writer is still missing, by Writer and SequenceNumber.
  fn withheld_changes(&self) -> impl Iterator<Item = (GUID, SequenceNumber, Timestamp)> + '_ {
    self
      .received_reliably_before
      .iter()
      .filter_map(|(writer, marker)| Some((writer, self.sequence_numbers.get(writer)?.range(marker..))))
      .flat_map(|(writer, withheld)| withheld.map(|(sn, instant)| (*writer, *sn, *instant)))
  }

  // Whether the change is kept however many there are: no DataReader could read it yet.
  fn is_retained(&self, change: &CacheChange) -> bool {
    let (writer, sn) = (&change.writer_guid, change.sequence_number);
    let marker = self.received_reliably_before.get(writer);
    let unread = self.unread.get(writer);
    marker.is_some_and(|marker| sn >= *marker)
      || unread.is_some_and(|(from, until)| (*from..*until).contains(&sn))
  }

  // The oldest samples that exceed the limits, of those that are not retained, or of all if
  // `retained` is 0.
  fn excess_samples(&self, retained: usize) -> usize {
    let count = self.changes.len().saturating_sub(retained);
    let by_count = count.saturating_sub(self.max_keep_samples as usize);
    let Some(max_keep_bytes) = self.max_keep_bytes else {
      return by_count;
    };
    let mut bytes = 0;
    let changes = self.changes.values().rev();
    let kept = changes
      .filter(|change| retained == 0 || !self.is_retained(change))
      .take_while(|change| {
        bytes += change.data_value.own_bytes();
        bytes <= max_keep_bytes
      });
    max(by_count, count - kept.count())
  }

  fn withheld_bytes(&self) -> usize {
    self.bytes_of(self.withheld_changes().map(|(.., instant)| instant))
  }

  fn unread_changes(&self) -> impl Iterator<Item = Timestamp> + '_ {
    let instants = self.unread.iter().filter_map(|(writer, (from, until))| {
      let numbers = self.sequence_numbers.get(writer)?;
      Some(numbers.range(*from..*until).map(|(_, instant)| *instant))
    });
    instants.flatten()
  }

  fn bytes_of(&self, instants: impl Iterator<Item = Timestamp>) -> usize {
    instants
      .filter_map(|instant| self.get_change(&instant))
      .map(|change| change.data_value.payload_size())
      .sum()
  }

  // Over MAX_WITHHELD_BYTES_PER_TOPIC, give up on missing samples, oldest first,
  // and hand over the samples after them. Returns true if anything was given up.
  fn give_up_withheld_over_limit(&mut self) -> bool {
    // Under the limits nothing is retained just for being withheld.
    if self.excess_samples(0) == 0 {
      return false;
    }
    if self.bytes_of(self.unread_changes()) > MAX_WITHHELD_BYTES_PER_TOPIC {
      self.unread.clear();
    }
    let mut gave_up = false;
    while self.withheld_bytes() > MAX_WITHHELD_BYTES_PER_TOPIC {
      let oldest = self.withheld_changes().min_by_key(|(.., instant)| *instant);
      let Some((writer, ..)) = oldest else { break };
      let first_present = self.withheld_changes().find(|(of, ..)| *of == writer);
      let Some((_, first_present, _)) = first_present else { break };
      debug!(
        "Topic {:?}: giving up on samples from {:?} missing before {:?}",
        self.topic_name, writer, first_present
      );
      self.received_reliably_before.insert(writer, first_present);
      self.advance_marker_over_present(writer);
      gave_up = true;
    }
    gave_up
  }

  pub fn get_change(&self, instant: &Timestamp) -> Option<&CacheChange> {
    self.changes.get(instant)
  }

  pub fn add_change(&mut self, instant: &Timestamp, cache_change: CacheChange) {
    self
      .add_change_internal(instant, cache_change)
      .map(|cc_back| {
        warn!(
          "DDSCache insert failed topic={:?} cache_change={:?}",
          self.topic_name, cc_back
        );
      });
  }

  fn add_change_internal(
    &mut self,
    instant: &Timestamp,
    cache_change: CacheChange,
  ) -> Option<CacheChange> {
    // First, do garbage collection.
    // But not at every insert, just to save time and effort.
    // Garbage collect more often when samples are large, so the cache does not
    // balloon between collections for big (e.g. fragmented) payloads:
    //   payload <= 1 KiB   : GC every 64 samples (cheap amortization)
    //   1 KiB < p <= 64 KiB: GC every 8 samples
    //   payload > 64 KiB    : GC on every sample
    // Samples are counted: their numbers are chosen by the sender, who must not choose
    // when the cache collects.
    let payload_size = cache_change.data_value.payload_size();
    self.added_since_collection += if payload_size <= 1024 {
      1
    } else if payload_size <= 65536 && !self.is_built_in {
      8
    } else {
      64
    };
    if self.added_since_collection >= 64 {
      self.added_since_collection = 0;
      debug!("Garbage collecting topic {}", self.topic_name);
      self.remove_changes_before(Timestamp::ZERO);
      // remove limit is so low that it has no effect.
      // We actually only remove to keep cache size between min and max limits.
    }

    // Now to the actual adding business.
    if let Some(old_instant) = self.find_by_sn(&cache_change) {
      // Got duplicate DATA for a SN that we already have. It should be discarded.
      trace!(
        "add_change: discarding duplicate {:?} from {:?}. old timestamp = {:?}, new = {:?}",
        cache_change.sequence_number,
        cache_change.writer_guid,
        old_instant,
        instant,
      );
      // We are keeping this quiet, because e.g. FastDDS Discoery keeps sending the
      // same SequenceNumber in periodic updates.
      None
    } else {
      // This is a new (to us) SequenceNumber, this is the default processing path.
      // Ensure a strictly monotonic (hence unique) key: if the clock did not
      // advance since the previous insert (coarse clock vs. back-to-back receives),
      // bump by one tick so distinct samples never share a key. Keys stay ordered,
      // so time-range reads and GC are unaffected.
      let key = if *instant > self.last_added_instant {
        *instant
      } else {
        Timestamp::from_ticks(self.last_added_instant.to_ticks().wrapping_add(1))
      };
      self.last_added_instant = key;

      self.insert_sn(key, &cache_change);
      self.changes.insert(key, cache_change).inspect(|old_cc| {
        // Should be unreachable now that keys are strictly monotonic, but keep the
        // guard rather than silently overwriting if the invariant is ever broken.
        error!("DDSHistoryCache already contained element with key {key:?} !!!");
        self.remove_sn(old_cc);
      })
    }
  }

  fn find_by_sn(&self, cc: &CacheChange) -> Option<Timestamp> {
    self
      .sequence_numbers
      .get(&cc.writer_guid)
      .and_then(|snm| snm.get(&cc.sequence_number))
      .copied()
  }

  fn insert_sn(&mut self, instant: Timestamp, cc: &CacheChange) {
    self
      .sequence_numbers
      .entry(cc.writer_guid)
      .or_default()
      .insert(cc.sequence_number, instant);
  }

  pub fn get_changes_in_range_best_effort<'a>(
    &'a self,
    start_instant: Timestamp,
    end_instant: Timestamp,
  ) -> ChangesInRangeBestEffort<'a, impl FnMut(BestEffortMap<'a>) -> ChangesItem<'a>> {
    // Sanity check
    let start_instant = if start_instant <= end_instant {
      // sane case
      start_instant
    } else {
      // insane case
      error!(
        "get_changes_in_range_best_effort: Did my clock jump backwards? start={start_instant:?} \
         end={end_instant:?}"
      );
      end_instant
    };

    // Get result as tree range
    self
      .changes
      .range((Excluded(start_instant), Included(end_instant)))
      .map(|(i, c)| (*i, c))
  }

  pub fn get_changes_in_range_reliable<'a, 'b>(
    &'a self,
    last_read_sn: &'b BTreeMap<GUID, SequenceNumber>,
  ) -> ChangesInRangeReliable<
    'a,
    impl FnMut(ReliableFlat<'a>) -> ReliableFlatItem<'a> + use<'a, 'b>,
    impl FnMut(ReliableMap<'a>) -> Option<ChangesItem<'a>>,
  > {
    self
      .sequence_numbers
      .iter()
      .flat_map(|(guid, sn_map)| {
        let lower_bound_exc = last_read_sn
          .get(guid)
          .cloned()
          .unwrap_or(SequenceNumber::zero());
        let upper_bound_exc = self.reliable_before(*guid);
        // make sure lower < upper, so that `.range()` does not panic.
        let upper_bound_exc = max(upper_bound_exc, lower_bound_exc.plus_1());
        sn_map.range((Excluded(lower_bound_exc), Excluded(upper_bound_exc)))
      }) // we get iterator of Timestamp
      .filter_map(|(_sn, t)| self.get_change(t).map(|cc| (*t, cc)))
  }

  pub fn get_changes_in_range<'a>(
    &'a self,
    reliable: bool,
    latest_instant: Timestamp,
    last_read_sn: &'a BTreeMap<GUID, SequenceNumber>,
  ) -> impl Iterator<Item = (Timestamp, &'a CacheChange)> {
    if reliable {
      ChangesInRange::Reliable(self.get_changes_in_range_reliable(last_read_sn))
    } else {
      ChangesInRange::BestEffort(
        self.get_changes_in_range_best_effort(latest_instant, Timestamp::INFINITE),
      )
    }
  }
  /// Whether a Reliable Reader receives from the Writer.
  pub fn is_read_reliably(&self, writer: GUID) -> bool {
    self.received_reliably_before.contains_key(&writer)
  }

  /// Whether anything is known of the Writer: samples, or how far a Reliable Reader
  /// has received it.
  pub fn has_writer(&self, writer: GUID) -> bool {
    self.sequence_numbers.contains_key(&writer)
      || self.received_reliably_before.contains_key(&writer)
      || self.taken.contains_key(&writer)
  }

  /// The number of Writers of which something is known, or more.
  pub fn writer_count(&self) -> usize {
    self.sequence_numbers.len() + self.received_reliably_before.len() + self.taken.len()
  }

  fn reliable_before(&self, writer: GUID) -> SequenceNumber {
    self
      .received_reliably_before
      .get(&writer)
      .cloned()
      .unwrap_or(SequenceNumber::default())
    // Sequence numbering starts at default(), so anything before that is always
    // received reliably, since no such samples exist.
  }

  fn remove_sn(&mut self, cc: &CacheChange) {
    let mut emptied = false;

    self.sequence_numbers.entry(cc.writer_guid).and_modify(|s| {
      s.remove(&cc.sequence_number);
      emptied = s.is_empty();
    });
    if emptied {
      self.sequence_numbers.remove(&cc.writer_guid);
    }
  }

  /// Garbarge collection:
  ///
  /// Remove changes before given Timestamp, but keep at least
  /// `self.min_keep_samples`.
  ///
  /// If we are over `self.max_keep_samples`, then remove the oldest samples
  /// until `max_keep_samples` is reached, regardless of `remove_before`.
  pub fn remove_changes_before(&mut self, remove_before: Timestamp) {
    // TODO: Currently, TopicCache does not know about Keys is Samples/CacheChanges,
    // because they are opaque binary blobs at this point. Therefore, we cannot
    // distinguish between instances, so cannot observe max instance counts.
    // We have to do just with min/max sample counts.

    let retained = self.withheld_changes().count() + self.unread_changes().count();
    let sample_count = self.changes.len().saturating_sub(retained);

    // We must remove at least enough to stay within max limit,
    let must_remove_count = self.excess_samples(retained);

    let may_remove_count = match self.min_keep_samples {
      // We are erquested to KeepAll, so do not remove more than absolutely required.
      History::KeepAll => must_remove_count,

      // We are requested to keep some depth, so we may remove up to that.
      History::KeepLast { depth } => max(
        sample_count.saturating_sub(depth as usize),
        must_remove_count,
      ),
    };

    // Samples withheld from a Reliable DataReader have not been delivered yet, so
    // they are kept even beyond `max_keep_samples`. They are released once the
    // missing sample is repaired, or declared irrelevant by GAP or HEARTBEAT, or
    // when they exceed MAX_WITHHELD_BYTES_PER_TOPIC and we give up on the missing
    // sample. Samples released by giving up are not evicted in the same pass, so
    // the Reader gets a chance to take them.
    if !self.give_up_withheld_over_limit() {
      // Any of the changes may be retained: a repair is received after younger samples.
      let mut removed = Vec::new();
      for (instant, change) in &self.changes {
        let must_remove = removed.len() < must_remove_count;
        let may_remove = *instant < remove_before && removed.len() < may_remove_count;
        if !must_remove && !may_remove {
          break;
        }
        if !self.is_retained(change) {
          removed.push(*instant);
        }
      }
      for instant in removed {
        if let Some(change) = self.changes.remove(&instant) {
          self.remove_sn(&change);
        }
      }
    }

    // Now, reallocate old cache changes
    let reallocate_timeout = crate::Duration::from_secs(5);
    let now = Timestamp::now();

    // Take max to avoid crash if clock jumps backward.
    let reallocate_limit = max(now - reallocate_timeout, self.changes_reallocated_up_to);

    self
      .changes
      .range_mut((
        Excluded(self.changes_reallocated_up_to),
        Included(reallocate_limit),
      ))
      .for_each(|(_, cc)| cc.reallocate());

    self.changes_reallocated_up_to = reallocate_limit;
  }

  pub fn topic_name(&self) -> String {
    self.topic_name.clone()
  }

  #[cfg(test)]
  pub(crate) fn max_keep_samples(&self) -> i32 {
    self.max_keep_samples
  }
}

type ChangesInRangeBestEffort<'a, F> = iter::Map<btree_map::Range<'a, Timestamp, CacheChange>, F>;
type ChangesInRangeReliable<'a, F1, F2> = iter::FilterMap<
  iter::FlatMap<
    btree_map::Iter<'a, GUID, BTreeMap<SequenceNumber, Timestamp>>,
    btree_map::Range<'a, SequenceNumber, Timestamp>,
    F1,
  >,
  F2,
>;

// type definitions for iterators
type BestEffortMap<'a> = (&'a Timestamp, &'a CacheChange);

type ReliableMap<'a> = (&'a SequenceNumber, &'a Timestamp);
type ReliableFlat<'a> = (&'a GUID, &'a BTreeMap<SequenceNumber, Timestamp>);
type ReliableFlatItem<'a> = btree_map::Range<'a, SequenceNumber, Timestamp>;

type ChangesItem<'a> = (Timestamp, &'a CacheChange);

pub(crate) enum ChangesInRange<'a, F, F1, F2> {
  BestEffort(ChangesInRangeBestEffort<'a, F>),
  Reliable(ChangesInRangeReliable<'a, F1, F2>),
}

impl<'a, F, F1, F2> Iterator for ChangesInRange<'a, F, F1, F2>
where
  F: FnMut(BestEffortMap<'a>) -> ChangesItem<'a>,
  F1: FnMut(ReliableFlat<'a>) -> ReliableFlatItem<'a>,
  F2: FnMut(ReliableMap<'a>) -> Option<ChangesItem<'a>>,
{
  type Item = ChangesItem<'a>;

  fn next(&mut self) -> Option<Self::Item> {
    match self {
      Self::Reliable(r) => r.next(),
      Self::BestEffort(b) => b.next(),
    }
  }
}

// -----------------------------------------------------------------------
// -----------------------------------------------------------------------
// -----------------------------------------------------------------------

#[cfg(test)]
mod tests {
  use std::{
    collections::BTreeMap,
    sync::{Arc, RwLock},
    thread,
  };

  use super::{DDSCache, TopicCache};
  use crate::{
    dds::{
      ddsdata::DDSData,
      lent::{AssemblyLimits, Lender, LentMemory, SampleMemory},
      qos::{policy::History, QosPolicies, QosPolicyBuilder},
      typedesc::TypeDesc,
      with_key::datawriter::WriteOptions,
    },
    discovery::discovery::Discovery,
    messages::submessages::elements::serialized_payload::SerializedPayload,
    structure::{
      cache_change::CacheChange,
      duration::Duration,
      guid::{EntityId, EntityKind, GuidPrefix, GUID},
      sequence_number::SequenceNumber,
      time::Timestamp,
    },
    RepresentationIdentifier,
  };

  // A reliable DataReader reads each remote writer's samples in sequence
  // number order. Sample 2 waits while sample 1 is repaired; collection must
  // not evict it before that repair arrives.
  fn read_after_repair(reader_qos: &QosPolicies) -> Vec<SequenceNumber> {
    let sample = |writer, sn| {
      CacheChange::new(
        writer,
        SequenceNumber::new(sn),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::default()),
      )
    };
    let sedp_writer = |prefix| {
      GUID::new(
        GuidPrefix::new(&[prefix; 12]),
        EntityId::SEDP_BUILTIN_PUBLICATIONS_WRITER,
      )
    };

    let mut topic_cache = TopicCache::new(
      "DCPSPublication".to_string(),
      TypeDesc::new("DiscoveredWriterData".to_string()),
      &Discovery::builtin_subscriber_qos(),
    );
    topic_cache.update_keep_limits(reader_qos);

    let waiting = sedp_writer(1);
    topic_cache.add_change(&Timestamp::now(), sample(waiting, 2));

    let mut last_read_sn = BTreeMap::new();
    for prefix in 2..66 {
      let other = sedp_writer(prefix);
      topic_cache.add_change(&Timestamp::now(), sample(other, 1));
      topic_cache.mark_reliably_received_before(other, SequenceNumber::new(2));
      last_read_sn.insert(other, SequenceNumber::new(1));
    }

    topic_cache.remove_changes_before(Timestamp::ZERO);
    topic_cache.add_change(&Timestamp::now(), sample(waiting, 1));
    topic_cache.mark_reliably_received_before(waiting, SequenceNumber::new(3));

    topic_cache
      .get_changes_in_range_reliable(&last_read_sn)
      .filter(|(_, cc)| cc.writer_guid == waiting)
      .map(|(_, cc)| cc.sequence_number)
      .collect()
  }

  #[test]
  fn sedp_reader_limits_keep_sample_waiting_for_repair() {
    assert_eq!(
      read_after_repair(&Discovery::builtin_subscriber_qos()),
      [SequenceNumber::new(1)]
    );
    assert_eq!(
      read_after_repair(&Discovery::builtin_sedp_reader_qos()),
      [SequenceNumber::new(1), SequenceNumber::new(2)]
    );
  }

  // Announcements may come before their Writer is matched. Disposes of a participant's endpoints
  // come after its goodbye, and anything can be forged.
  #[test]
  fn discovery_data_of_unmatched_writers_is_kept_for_a_moment() {
    let writer = |prefix| {
      GUID::new(GuidPrefix::new(&[prefix; 12]), EntityId::SEDP_BUILTIN_PUBLICATIONS_WRITER)
    };
    let [matched, unmatched] = [1, 2].map(writer);
    for (topic, is_forgotten) in [("DCPSPublication", true), ("DCPSParticipant", false)] {
      let mut topic_cache = TopicCache::new(
        topic.to_string(),
        TypeDesc::new("test".to_string()),
        &Discovery::builtin_sedp_reader_qos(),
      );
      let received = Timestamp::now();
      for writer in [matched, unmatched] {
        let sample = CacheChange::new(
          writer,
          SequenceNumber::new(1),
          WriteOptions::default(),
          DDSData::new(SerializedPayload::default()),
        );
        topic_cache.add_change(&received, sample);
      }
      topic_cache.mark_reliably_received_before(matched, SequenceNumber::new(2));
      topic_cache.forget_unmatched_writers(received);
      assert_eq!(topic_cache.changes.len(), 2, "{topic}");
      topic_cache.forget_unmatched_writers(Timestamp::now() + Duration::from_secs(1));
      assert!(topic_cache.has_writer(matched), "{topic}");
      assert_eq!(topic_cache.has_writer(unmatched), !is_forgotten, "{topic}");
      assert_eq!(topic_cache.changes.len(), if is_forgotten { 1 } else { 2 }, "{topic}");
    }
  }

  // A new Reader must not get what a former one has received, nor lose what comes
  // from the moment of its creation on.
  #[test]
  fn a_reader_that_begins_now_gets_only_later_samples() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = GUID::new(GuidPrefix::new(&[1; 12]), EntityId::SEDP_BUILTIN_PUBLICATIONS_WRITER);
    let add = |topic_cache: &mut TopicCache, sn| {
      let change = CacheChange::new(
        writer,
        SequenceNumber::new(sn),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::default()),
      );
      topic_cache.add_change(&Timestamp::now(), change);
      topic_cache.mark_reliably_received_before(writer, SequenceNumber::new(sn + 1));
    };
    for sn in 1..=3 {
      add(&mut topic_cache, sn);
    }
    topic_cache.begin_now();
    for sn in 4..=5 {
      add(&mut topic_cache, sn);
    }
    let (begin, taken) = (topic_cache.begin_instant, topic_cache.taken.clone());
    for is_reliable in [false, true] {
      let numbers: Vec<i64> = topic_cache
        .get_changes_in_range(is_reliable, begin, &taken)
        .map(|(_, change)| i64::from(change.sequence_number))
        .collect();
      assert_eq!(numbers, [4, 5], "{is_reliable}");
    }
  }

  // The first sample was received before the wall clock was set back by an hour, the second one after it.
  #[test]
  fn a_best_effort_reader_gets_what_is_received_after_the_clock_was_set_back() {
    let mut topic_cache = keep_all_topic_cache();
    let after_step = Timestamp::now();
    let before_step = after_step + Duration::from_secs(3600);
    for (sn, received) in [(1, before_step), (2, after_step)] {
      let change = CacheChange::new(
        user_writer(),
        SequenceNumber::new(sn),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::default()),
      );
      topic_cache.add_change(&received, change);
    }
    let numbers: Vec<i64> = topic_cache
      .get_changes_in_range(false, before_step, &BTreeMap::new())
      .map(|(_, change)| i64::from(change.sequence_number))
      .collect();
    assert_eq!(numbers, [2]);
  }

  fn keep_all_topic_cache() -> TopicCache {
    TopicCache::new(
      "Square".to_string(),
      TypeDesc::new("ShapeType".to_string()),
      &QosPolicyBuilder::new().history(History::KeepAll).build(),
    )
  }

  fn user_writer() -> GUID {
    GUID::new(
      GuidPrefix::new(&[7; 12]),
      EntityId::new([0, 0, 1], EntityKind::WRITER_WITH_KEY_USER_DEFINED),
    )
  }

  // Adds a sample like a Reliable Reader that is still missing sample 1.
  fn add_after_missing_first(topic_cache: &mut TopicCache, writer: GUID, sn: i64, size: usize) {
    topic_cache.add_change(
      &Timestamp::now(),
      CacheChange::new(
        writer,
        SequenceNumber::new(sn),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::new(
          RepresentationIdentifier::CDR_LE,
          vec![0; size],
        )),
      ),
    );
    topic_cache.mark_reliably_received_before(writer, SequenceNumber::new(1));
  }

  #[test]
  fn reliably_received_marker_does_not_move_backwards() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    assert!(topic_cache.mark_reliably_received_before(writer, SequenceNumber::new(10)));
    assert!(!topic_cache.mark_reliably_received_before(writer, SequenceNumber::new(5)));
    assert_eq!(topic_cache.reliable_before(writer), SequenceNumber::new(10));
  }

  // E.g. Fast DDS sends its first HEARTBEAT 3 s after matching, so a late joiner
  // waits that long for the samples before its first one.
  #[test]
  fn small_withheld_samples_are_kept() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    for sn in 2..=91 {
      add_after_missing_first(&mut topic_cache, writer, sn, 100);
    }
    topic_cache.remove_changes_before(Timestamp::ZERO);
    assert_eq!(topic_cache.changes.len(), 90);
    assert_eq!(topic_cache.reliable_before(writer), SequenceNumber::new(1));
  }

  // The Writer sends the last sample first, and then repairs the others but for the first.
  #[test]
  fn a_withheld_sample_is_kept_while_older_ones_are_repaired() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    let last = 2 * i64::from(topic_cache.max_keep_samples);
    add_after_missing_first(&mut topic_cache, writer, last, 100);
    for sn in 2..last {
      add_after_missing_first(&mut topic_cache, writer, sn, 100);
      topic_cache.remove_changes_before(Timestamp::ZERO);
    }
    add_after_missing_first(&mut topic_cache, writer, 1, 100);
    let numbers: Vec<i64> = topic_cache
      .get_changes_in_range_reliable(&BTreeMap::new())
      .map(|(_, change)| i64::from(change.sequence_number))
      .collect();
    assert_eq!(numbers, (1..=last).collect::<Vec<_>>());
  }

  // Twice as many samples as are kept otherwise become available with the first one.
  #[test]
  fn samples_that_become_available_at_once_are_kept_until_they_are_read() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    let max_keep = i64::from(topic_cache.max_keep_samples);
    let last = 2 * max_keep;
    for sn in (2..=last).chain([1]) {
      add_after_missing_first(&mut topic_cache, writer, sn, 100);
    }
    for sn in last + 1..=last + 10 {
      add_after_missing_first(&mut topic_cache, writer, sn, 100);
      topic_cache.remove_changes_before(Timestamp::ZERO);
    }
    let count_unread = |topic_cache: &TopicCache, read: i64| {
      let read = BTreeMap::from([(writer, SequenceNumber::new(read))]);
      topic_cache.get_changes_in_range_reliable(&read).count() as i64
    };
    assert_eq!(count_unread(&topic_cache, 0), last + 10);
    topic_cache.set_read(writer, SequenceNumber::new(max_keep));
    topic_cache.remove_changes_before(Timestamp::ZERO);
    assert_eq!(count_unread(&topic_cache, 0), last);
    assert_eq!(count_unread(&topic_cache, max_keep), max_keep + 10);
    topic_cache.set_read(writer, SequenceNumber::new(last));
    topic_cache.remove_changes_before(Timestamp::ZERO);
    assert_eq!(count_unread(&topic_cache, 0), max_keep);
    assert!(topic_cache.unread.is_empty());
  }

  // An application that reads nothing.
  #[test]
  fn large_unread_samples_are_kept_by_their_number_only() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    let size = crate::rtps::constant::MAX_WITHHELD_BYTES_PER_TOPIC / 100;
    for sn in (2..=100).chain([1]).chain(101..=120) {
      add_after_missing_first(&mut topic_cache, writer, sn, size);
      topic_cache.remove_changes_before(Timestamp::ZERO);
    }
    assert!(topic_cache.changes.len() <= topic_cache.max_keep_samples as usize);
  }

  // As many withheld samples as are kept otherwise, of a Writer whose first sample is missing.
  #[test]
  fn withheld_samples_do_not_keep_those_of_other_writers() {
    let mut topic_cache = keep_all_topic_cache();
    let max_keep = topic_cache.max_keep_samples as usize;
    for sn in 2..max_keep as i64 + 2 {
      add_after_missing_first(&mut topic_cache, user_writer(), sn, 100);
    }
    let other = GUID::dummy_test_guid(EntityKind::WRITER_WITH_KEY_USER_DEFINED);
    for sn in 1..=100 {
      add_after_missing_first(&mut topic_cache, other, sn, 100);
      topic_cache.remove_changes_before(Timestamp::ZERO);
    }
    assert_eq!(topic_cache.changes.len(), 2 * max_keep);
    assert_eq!(topic_cache.withheld_changes().count(), max_keep);
  }

  #[test]
  fn large_withheld_samples_are_given_up_and_handed_over() {
    let mut topic_cache = keep_all_topic_cache();
    let writer = user_writer();
    let size = 256 * 1024;
    let max_keep = topic_cache.max_keep_samples as i64;

    // Up to the sample count limit, everything is kept anyway.
    for sn in 2..=max_keep + 1 {
      add_after_missing_first(&mut topic_cache, writer, sn, size);
    }
    assert_eq!(topic_cache.reliable_before(writer), SequenceNumber::new(1));

    // Beyond it, over MAX_WITHHELD_BYTES_PER_TOPIC, the next collection gives up
    // on sample 1 and hands over everything after it, without evicting it in the
    // same pass.
    add_after_missing_first(&mut topic_cache, writer, max_keep + 2, size);
    assert_eq!(topic_cache.reliable_before(writer), SequenceNumber::new(1));
    topic_cache.remove_changes_before(Timestamp::ZERO);
    assert_eq!(
      topic_cache.reliable_before(writer),
      SequenceNumber::new(max_keep + 3)
    );
    let handed_over: Vec<_> = topic_cache
      .get_changes_in_range_reliable(&BTreeMap::new())
      .map(|(_, cc)| i64::from(cc.sequence_number))
      .collect();
    assert_eq!(handed_over, (2..=max_keep + 2).collect::<Vec<_>>());

    // Later samples are handed over as they arrive, and the cache stays bounded.
    for sn in max_keep + 3..=200 {
      add_after_missing_first(&mut topic_cache, writer, sn, size);
    }
    assert_eq!(
      topic_cache.reliable_before(writer),
      SequenceNumber::new(201)
    );
    assert!(topic_cache.changes.len() <= topic_cache.max_keep_samples as usize + 1);
  }

  #[test]
  fn large_announcements_are_kept_up_to_a_number_of_bytes() {
    let cache_of = |name: &str| {
      let qos = QosPolicyBuilder::new()
        .history(History::KeepAll)
        .resource_limits(super::ResourceLimits {
          max_samples: 4096,
          max_instances: 4096,
          max_samples_per_instance: 4096,
        })
        .build();
      TopicCache::new(name.to_owned(), TypeDesc::new("type".to_owned()), &qos)
    };
    let fill = |mut cache: TopicCache| {
      // Numbers that are no multiple of eight.
      for number in (1..8 * 1_000).step_by(8) {
        let payload =
          SerializedPayload::new(RepresentationIdentifier::PL_CDR_LE, vec![0; 60_000]);
        let change = CacheChange::new(
          user_writer(),
          SequenceNumber::new(number),
          WriteOptions::default(),
          DDSData::new(payload),
        );
        cache.add_change(&Timestamp::now(), change);
      }
      cache.changes.len()
    };
    let kept = fill(cache_of("DCPSPublication"));
    assert!(
      kept * 60_000 <= super::MAX_KEPT_BYTES_PER_BUILTIN_TOPIC + 2 * 60_000,
      "{kept} samples"
    );
    assert_eq!(fill(cache_of("rt/scan")), 1_000);
  }

  // A collection at each 64th number would never come.
  #[test]
  fn the_numbers_that_a_sender_chooses_do_not_change_how_many_samples_are_kept() {
    let mut cache = keep_all_topic_cache();
    for number in (1..64 * 10_000).step_by(64) {
      let payload = SerializedPayload::new(RepresentationIdentifier::CDR_LE, vec![0; 100]);
      let change = CacheChange::new(
        user_writer(),
        SequenceNumber::new(number),
        WriteOptions::default(),
        DDSData::new(payload),
      );
      cache.add_change(&Timestamp::now(), change);
    }
    let most = cache.max_keep_samples as usize + 64;
    assert!(cache.changes.len() <= most, "{} samples, at most {most}", cache.changes.len());
  }

  // A History of 1,024 scans may be one of 64 images.
  #[test]
  fn a_topic_of_the_application_keeps_as_many_bytes_as_its_lender_says() {
    struct Keeps;

    impl SampleMemory for Keeps {
      fn lend(&self, _len: usize) -> Option<Box<dyn LentMemory>> {
        None
      }

      fn limits(&self) -> AssemblyLimits {
        AssemblyLimits {
          max_kept_bytes: Some(1_000_000),
          ..AssemblyLimits::default()
        }
      }
    }

    let mut cache = keep_all_topic_cache();
    let mut kept_after = |numbers: std::ops::RangeInclusive<i64>| {
      for number in numbers {
        let payload = SerializedPayload::new(RepresentationIdentifier::CDR_LE, vec![0; 99_996]);
        let change = CacheChange::new(
          user_writer(),
          SequenceNumber::new(number),
          WriteOptions::default(),
          DDSData::new(payload),
        );
        cache.add_change(&Timestamp::now(), change);
      }
      cache.set_lender(Lender(Some(Arc::new(Keeps))));
      cache.changes.len()
    };
    assert_eq!(kept_after(1..=30), 30);
    // What is added is taken before the next collection.
    assert_eq!(kept_after(31..=50), 11);
  }

  #[test]
  fn create_dds_cache_and_topic_cache() {
    // Create DDS cache
    let dds_cache = Arc::new(RwLock::new(DDSCache::new()));
    // Set a topic name and some QoS policies
    let topic_name = String::from("ImJustATopic");
    let qos = QosPolicies::qos_none();

    // Add the new topic to DDS cache
    let topic_cache_handle = dds_cache.write().unwrap().add_new_topic(
      topic_name,
      TypeDesc::new("IDontKnowIfThisIsNecessary".to_string()),
      &qos,
    );

    // Create a cache change and add it to the topic cache
    let change1 = CacheChange::new(
      GUID::GUID_UNKNOWN,
      SequenceNumber::new(1),
      WriteOptions::default(),
      DDSData::new(SerializedPayload::default()),
    );
    topic_cache_handle
      .lock()
      .unwrap()
      .add_change(&crate::Timestamp::now(), change1);

    let topic_cache_handle2 = topic_cache_handle.clone();
    thread::spawn(move || {
      // Create two new cache changes and add them to topic cache
      let change2 = CacheChange::new(
        GUID::GUID_UNKNOWN,
        SequenceNumber::new(2),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::default()),
      );
      let change3 = CacheChange::new(
        GUID::GUID_UNKNOWN,
        SequenceNumber::new(3),
        WriteOptions::default(),
        DDSData::new(SerializedPayload::default()),
      );

      topic_cache_handle2
        .lock()
        .unwrap()
        .add_change(&crate::Timestamp::now(), change2);
      topic_cache_handle2
        .lock()
        .unwrap()
        .add_change(&crate::Timestamp::now(), change3);
    })
    .join()
    .unwrap();

    // Verify that there are 3 cache changes in the topic cache
    assert_eq!(
      topic_cache_handle
        .lock()
        .unwrap()
        .get_changes_in_range_best_effort(
          crate::Timestamp::now() - crate::Duration::from_secs(23),
          crate::Timestamp::now()
        )
        .count(),
      3
    );
  }
}
