use std::{
  cmp::max,
  collections::{BTreeMap, BTreeSet},
  sync::{Arc, Condvar, Mutex, MutexGuard},
  time::{Duration as StdDuration, Instant},
};
use core::task::Waker;

#[allow(unused_imports)]
use log::{debug, error, trace, warn};

use crate::{
  dds::{ddsdata::DDSData, with_key::datawriter::WriteOptions},
  rtps::{
    constant::{
      DEFAULT_WRITER_MAX_SAMPLES, KEEP_LAST_MAX_RETAINED_BYTES, MAX_ADVERTISED_EVICTED_SAMPLES,
    },
    direct_send::DirectSend,
    identity::{ContinuedWriter, UsedNumbers},
    reader_progress::{MatchedReader, OfferedHistory, ReaderProgress},
    source_history::SourceHistory,
  },
  structure::{cache_change::CacheChange, guid::GUID, sequence_number::SequenceNumber},
};

/// Result of an admission attempt into the [`WriterSendBuffer`].
pub(crate) enum Admission {
  /// The sample was admitted. It now lives in the send buffer and is ready for
  /// the Writer (event loop) to transmit.
  Admitted {
    sequence_number: SequenceNumber,
    /// Readers that were matched when the sample was admitted.
    readers: usize,
  },
  /// The reliable send window is full and no room became available within the
  /// allotted blocking time. The sample was *not* stored.
  WouldBlock,
}

// The actual shared state. Guarded by a single Mutex; the Condvar is signalled
// whenever the reliable acknowledgement frontier advances or the window grows,
// i.e. whenever a previously-blocked producer (or a `wait_for_acknowledgments`
// waiter) might be able to make progress.
struct Inner {
  // --- the send buffer proper (replaces the old HistoryBuffer) ---
  // Keyed by SequenceNumber, which is allocated here under the lock and is thus
  // strictly monotonic and unique. This is the single source of truth for the
  // Writer's outgoing samples (send, repair, fragmentation, eviction).
  changes: BTreeMap<SequenceNumber, CacheChange>,
  retained_bytes: usize,     // payload bytes of `changes`
  written_bytes: u64,        // payload bytes of all samples ever written
  first_seq: SequenceNumber, // oldest still retained (default 1)
  last_seq: SequenceNumber,  // latest allocated (default 0 == nothing yet)
  begins_with: SequenceNumber, // what the first sample gets (default 1)

  // The sample of which fragments are sent before all of it is written.
  early: Option<Early>,
  // The samples that were begun so far.
  early_count: u64,
  // The number and the id of the sample that was completed last.
  completed_early: Option<(SequenceNumber, u64)>,
  // Numbers that readers have fragments of, and no sample: it was withdrawn.
  withdrawn: BTreeSet<SequenceNumber>,
  // How many there ever were.
  withdrawn_total: u64,

  // What late joiners get beside `changes`, if the samples come from several sources.
  history: SourceHistory,

  // Of the writer that this one continues, those that have not matched yet: what they may
  // lack is kept, until then at most.
  former_readers: BTreeSet<GUID>,
  former_readers_until: Option<Instant>,
  // The last sample of that writer, and until when samples that it had not sent wait at most.
  former_last: SequenceNumber,
  unsent_wait_until: Option<Instant>,

  // What each matched reader was offered and has acknowledged.
  readers: BTreeMap<GUID, Arc<ReaderProgress>>,
  // What the readers missed that are no longer matched.
  left_overrun: u64,

  // --- flow control ---
  // Maximum number of unacknowledged samples a reliable writer may have
  // outstanding before `write` must block/fail.
  window_limit: usize,
  // The acknowledgement frontier: the smallest `all_acked_before` over all
  // matched *reliable* readers. Only meaningful when `reliable_readers_present`.
  // Maintained by the Writer (event loop) via `set_acked_frontier`.
  acked_before: SequenceNumber,
  reliable_readers_present: bool,

  // nonblocking-transmit: the unsent backlog limit. The Writer advances
  // `sent_frontier` as it actually transmits samples; when the network socket
  // congests, `sent_frontier` stalls, the backlog `(sent_frontier, last_seq]`
  // fills, and admission blocks -- back-pressure reaching the application.
  // Applies to reliable *and* best-effort writers; built-in/discovery are
  // exempt so discovery never stalls.
  // (see src/rtps/nonblocking_transmit_design.md)
  backlog_limit: usize,
  // Highest sequence number the Writer has actually put on the wire.
  sent_frontier: SequenceNumber,

  // Hard upper bound on the number of retained samples for *non-blocking*
  // (best-effort, DDS-default) writes. Because such writes are never throttled
  // at admission (see `has_room`), and eviction otherwise only happens on the
  // periodic (6 s) cache-cleaning timer, the buffer would grow without bound
  // when the application produces faster than the socket drains. We therefore
  // apply KeepLast-style "newest wins" eviction directly on insert: once the
  // buffer exceeds `max_retain`, the oldest samples are dropped. Derived from
  // the writer's History depth / ResourceLimits (same value as `window_limit`).
  // Does NOT apply to reliable / opted-in writers, which are bounded by the
  // send window / unsent-backlog and must retain samples for repair.
  max_retain: usize,

  // How many evicted samples a HEARTBEAT still offers.
  max_advertised_evicted: usize,

  // Wakers of async producers / ack-waiters parked because the window was full
  // or acknowledgements were still pending. Drained (woken) on any advance.
  wakers: Vec<Waker>,

  // Threads parked on `progress`. To notify it is a system call, also for nobody.
  parked_threads: usize,
}

/// A sample that is not written yet, of which the Writer may send the first fragments.
#[derive(Clone)]
pub(crate) struct Early {
  /// Distinguishes it from others that were to have the same number.
  pub id: u64,
  /// With the number that the next sample gets, and the whole length of the payload, of
  /// which only the first `available` bytes may be read.
  pub change: CacheChange,
  /// Bytes of the serialized payload that are complete.
  pub available: usize,
  // Whether a fragment was sent, so that the number can't be that of another sample.
  is_begun: bool,
}

impl Early {
  // Whether this is the same sample, as far as its fragments tell.
  fn completed_by(&self, write_options: &WriteOptions, data: &DDSData) -> bool {
    let begun = &self.change;
    begun.data_value.payload_size() == data.payload_size()
      && begun.write_options.source_timestamp() == write_options.source_timestamp()
  }
}

// They are known from the journal of discovery, and match with the writer's creation.
const FORMER_READERS_MATCH_WITHIN: StdDuration = StdDuration::from_secs(5);

// For how long samples that the former writer had not sent wait for them at most.
const UNSENT_WAIT: StdDuration = StdDuration::from_secs(1);

// A reader that acknowledges nothing may ask for a number for as long as it is matched;
// without the record it counts as one more that the reader missed.
const MAX_WITHDRAWN: usize = 1024;

impl Inner {
  // Gives up the sample that is sent early. Its number is not used again if a reader may
  // have a fragment with it.
  fn withdraw_early(&mut self) -> bool {
    let Some(early) = self.early.take() else {
      return false;
    };
    if early.is_begun {
      self.last_seq = early.change.sequence_number;
      self.withdrawn.insert(self.last_seq);
      self.withdrawn_total += 1;
      if self.withdrawn.len() > MAX_WITHDRAWN {
        self.withdrawn.pop_first();
      }
    }
    early.is_begun
  }

  fn evict_oldest(&mut self) {
    if let Some((oldest, evicted)) = self.changes.pop_first() {
      self.first_seq = oldest.plus_1();
      self.release(evicted);
    }
  }

  // Two samples stay whatever their size: the one that was just written and the one that
  // may be half sent.
  fn is_over_window(&self) -> bool {
    self.changes.len() > self.window_limit
      || (self.retained_bytes > KEEP_LAST_MAX_RETAINED_BYTES && self.changes.len() > 2)
  }

  // Of a sample that was removed from `changes`.
  fn release(&mut self, released: CacheChange) {
    self.retained_bytes -= released.data_value.payload_size();
    self.history.keep(released);
  }

  // The first sample that is available, in `changes` or in the history.
  fn first_available(&self) -> SequenceNumber {
    let kept = self.history.kept_range();
    kept.map_or(self.first_seq, |(first, _)| first.min(self.first_seq))
  }

  // How many samples from `first` on, of those that the reader is offered, are gone.
  fn gone_from(&self, first: SequenceNumber, reader: &ReaderProgress) -> u64 {
    let kept = self.history.kept_between(first, self.first_seq);
    let kept = kept.filter(|number| reader.offered_after(*number).is_none()).count();
    let withdrawn = self.withdrawn.iter().filter(|number| (first..self.first_seq).contains(*number));
    let not_retained = reader.offered_between(first, self.first_seq);
    not_retained.saturating_sub((kept + withdrawn.count()) as u64)
  }

  fn advertised_first(&self) -> SequenceNumber {
    if !self.reliable_readers_present {
      return self.first_seq;
    }
    let furthest_back = match self.history.kept_range() {
      // A late joiner may still lack what is kept for it.
      Some((_, last)) if self.acked_before <= last => self.acked_before,
      _ => self.first_seq - SequenceNumber::from(self.max_advertised_evicted),
    };
    let unacknowledged = max(self.acked_before, furthest_back);
    max(unacknowledged, self.begins_with).min(self.first_seq)
  }
}

struct Shared {
  inner: Mutex<Inner>,
  direct_send: DirectSend,
  // Signalled together with `wakers` whenever progress may be possible.
  progress: Condvar,
  // Fixed for the lifetime of the writer.
  writer_guid: GUID,
  reliable_writer: bool,
  is_builtin: bool,
  // The HISTORY depth of a KEEP_LAST writer whose writes never wait for a
  // reader: when the retained samples reach their limit, the oldest one goes,
  // and the readers that lack it get a GAP (DDS v1.4 Section 2.2.3.18). `None`
  // for KEEP_ALL, whose writes wait for acknowledgements.
  keep_last: Option<usize>,
  // True for VOLATILE durability (the DDS default). When true, a reliable writer
  // with no matched reliable reader trims KeepLast on insert (there is no
  // late-joiner to serve, so retaining unacked samples is pointless). When false
  // (TRANSIENT_LOCAL / TRANSIENT / PERSISTENT) the writer must retain samples for
  // late-joining readers, so pre-match trimming is disabled.
  volatile: bool,
  topic_name: String,
  // See `ContinuedWriter`.
  on_number: Option<Box<dyn Fn(i64, bool) + Send + Sync>>,
}

/// A shared, flow-controlled buffer of samples between a `DataWriter`
/// (producer, application threads) and its RTPS `Writer` (consumer, event
/// loop).
///
/// The producer side allocates a sequence number and inserts a sample only when
/// the reliable send window has room (synchronous admission, no round-trip).
/// The consumer side transmits unsent samples, advances the acknowledgement
/// frontier as ACKNACKs arrive, and evicts acknowledged samples. Both sides
/// hold a cloned handle to the same `Arc`.
#[derive(Clone)]
pub(crate) struct WriterSendBuffer {
  shared: Arc<Shared>,
}

impl WriterSendBuffer {
  #[allow(clippy::too_many_arguments)]
  pub fn new(
    writer_guid: GUID,
    topic_name: String,
    reliable_writer: bool,
    is_builtin: bool,
    volatile: bool,
    window_limit: usize,
    backlog_limit: usize,
    max_retain: usize,
  ) -> Self {
    Self {
      shared: Arc::new(Shared {
        inner: Mutex::new(Inner {
          changes: BTreeMap::new(),
          retained_bytes: 0,
          written_bytes: 0,
          former_readers: BTreeSet::new(),
          former_readers_until: None,
          former_last: SequenceNumber::zero(),
          unsent_wait_until: None,
          readers: BTreeMap::new(),
          left_overrun: 0,
          early: None,
          early_count: 0,
          completed_early: None,
          withdrawn: BTreeSet::new(),
          withdrawn_total: 0,
          history: SourceHistory::default(),
          first_seq: SequenceNumber::new(1),
          last_seq: SequenceNumber::new(0),
          begins_with: SequenceNumber::new(1),
          window_limit: window_limit.max(1),
          acked_before: SequenceNumber::new(1),
          reliable_readers_present: false,
          backlog_limit: backlog_limit.max(1),
          sent_frontier: SequenceNumber::new(0),
          max_retain: max_retain.max(1),
          max_advertised_evicted: MAX_ADVERTISED_EVICTED_SAMPLES,
          wakers: Vec::new(),
          parked_threads: 0,
        }),
        direct_send: DirectSend::new(),
        progress: Condvar::new(),
        writer_guid,
        reliable_writer,
        is_builtin,
        keep_last: None,
        volatile,
        topic_name,
        on_number: None,
      }),
    }
  }

  /// Counts with the numbers of the participant; a built-in writer also numbers its samples
  /// after those. To be called before the buffer is shared.
  #[must_use]
  pub fn numbered_with(mut self, numbers: Arc<UsedNumbers>) -> Self {
    let highest = numbers.highest_number();
    match Arc::get_mut(&mut self.shared) {
      Some(shared) => {
        shared.direct_send.count_with(numbers);
        if shared.is_builtin {
          Self::begin_after(shared, highest);
        }
      }
      None => error!("WriterSendBuffer: numbers were set after the buffer was shared"),
    }
    self
  }

  /// Continues the writer of a former process, with its last samples. To be called before
  /// the buffer is shared, and after `keep_last`.
  #[must_use]
  pub fn continue_former(mut self, continued: ContinuedWriter) -> Self {
    let Some(shared) = Arc::get_mut(&mut self.shared) else {
      error!("WriterSendBuffer: it was to continue a former one after it was shared");
      return self;
    };
    let highest = SequenceNumber::new(continued.highest_number);
    Self::begin_after(shared, highest);
    if let (Ok(inner), Some(first)) = (shared.inner.get_mut(), continued.samples.first()) {
      let first = SequenceNumber::new(first.number);
      (inner.first_seq, inner.begins_with, inner.acked_before) = (first, first, first);
      let sent = SequenceNumber::new(continued.sent_through);
      inner.sent_frontier = sent.clamp(first - SequenceNumber::new(1), highest);
      shared.direct_send.set_last_sent(inner.sent_frontier);
      for sample in continued.samples {
        let number = SequenceNumber::new(sample.number);
        let (options, data) = sample.into_data();
        if let (false, Some(depth)) = (shared.volatile, shared.keep_last) {
          inner.history.record(&options, number, depth);
        }
        let change = CacheChange::new(shared.writer_guid, number, options, data);
        inner.retained_bytes += change.data_value.payload_size();
        inner.changes.insert(number, change);
      }
      let withdrawn = SequenceNumber::range_inclusive(first, highest);
      inner.withdrawn = withdrawn.filter(|number| !inner.changes.contains_key(number)).collect();
      inner.withdrawn_total = inner.withdrawn.len() as u64;
      inner.former_readers = continued.readers.into_iter().collect();
      inner.former_readers_until = Some(Instant::now() + FORMER_READERS_MATCH_WITHIN);
      inner.former_last = highest;
      inner.unsent_wait_until = Some(Instant::now() + UNSENT_WAIT);
    }
    shared.on_number = Some(continued.on_number);
    self
  }

  /// Whether there are samples of a former writer that it may not have sent.
  pub fn has_unsent(&self) -> bool {
    let inner = self.shared.inner.lock().unwrap();
    self.shared.direct_send.last_sent() < inner.last_seq
  }

  /// Whether it was a reader of the former writer, and has not matched this one yet.
  pub fn is_former_reader(&self, reader: GUID) -> bool {
    self.shared.inner.lock().unwrap().former_readers.contains(&reader)
  }

  /// The last sample of the former writer; 0 if there was none.
  pub fn former_last(&self) -> SequenceNumber {
    self.shared.inner.lock().unwrap().former_last
  }

  /// Whether samples of a former writer wait until its readers have matched: sent before, they would
  /// reach no reader, and a BEST_EFFORT one never requests them. They wait until something else is
  /// written, `UNSENT_WAIT` at most.
  pub fn holds_unsent(&self) -> bool {
    let inner = self.shared.inner.lock().unwrap();
    let is_waiting = !inner.former_readers.is_empty()
      && inner.unsent_wait_until.is_some_and(|until| Instant::now() < until);
    is_waiting
      && inner.last_seq == inner.former_last
      && self.shared.direct_send.last_sent() < inner.last_seq
  }

  fn begin_after(shared: &mut Shared, highest: SequenceNumber) {
    if let Ok(inner) = shared.inner.get_mut() {
      let first = highest.plus_1();
      (inner.first_seq, inner.begins_with, inner.acked_before) = (first, first, first);
      (inner.last_seq, inner.sent_frontier) = (highest, highest);
      shared.direct_send.set_last_sent(highest);
    }
  }

  fn report_number(shared: &Shared, number: SequenceNumber, is_written: bool) {
    if let Some(on_number) = &shared.on_number {
      on_number(number.into(), is_written);
    }
    if shared.is_builtin {
      shared.direct_send.numbers().use_number(number);
    }
  }

  /// Makes this the buffer of a KEEP_LAST writer: a write never waits for
  /// acknowledgements, and the oldest sample goes when `window_limit` samples are
  /// retained. To be called before the buffer is shared.
  #[must_use]
  pub fn keep_last(mut self, depth: usize) -> Self {
    match Arc::get_mut(&mut self.shared) {
      Some(shared) if !shared.is_builtin => {
        shared.keep_last = Some(depth.max(1));
        if let Ok(inner) = shared.inner.get_mut() {
          inner.window_limit = max(inner.window_limit, depth);
        }
      }
      Some(_) => {}
      None => error!("WriterSendBuffer: KEEP_LAST was set after the buffer was shared"),
    }
    self
  }

  /// From now on a HEARTBEAT begins with the oldest sample retained, so that a reader
  /// skips what is gone without a request and a GAP, each of which may be lost.
  pub fn offer_only_retained(&self) {
    self.shared.inner.lock().unwrap().max_advertised_evicted = 0;
  }

  // --- predicates (must be called while holding the lock) ---

  // Is there room to admit one more sample right now?
  //
  // `may_block` is `true` for reliable writers and for best-effort writes that
  // opted in via `WriteOptions::best_effort_may_block`. When `false` (a
  // best-effort write that must not block, the DDS default) admission is never
  // throttled: congested samples are dropped later at the socket instead.
  fn has_room(shared: &Shared, inner: &Inner, may_block: bool) -> bool {
    if shared.is_builtin {
      // Built-in (discovery) writers must never stall.
      return true;
    }

    if shared.keep_last.is_some() && shared.reliable_writer {
      // The oldest sample gives way, see `insert_locked`.
      return true;
    }

    if !may_block {
      // Best-effort write that must not block (DDS v1.4 2.2.2.4.2.11 default).
      // Never throttle admission.
      return true;
    }

    // nonblocking-transmit: unsent-backlog limit. Applies to reliable writers
    // and to best-effort writers that opted in -- when the socket cannot drain,
    // the application is back-pressured instead of dropping. Samples in
    // (sent_frontier, last_seq].
    let unsent = i64::from(inner.last_seq) - i64::from(inner.sent_frontier);
    if unsent >= inner.backlog_limit as i64 {
      return false;
    }

    if !shared.reliable_writer || !inner.reliable_readers_present {
      // Best-effort and "no reliable reader yet" writers have no acknowledgement
      // window to wait on; the backlog limit above is their only throttle.
      return true;
    }
    // Number of unacknowledged samples in [acked_before, last_seq].
    let unacked = i64::from(inner.last_seq) - i64::from(inner.acked_before) + 1;
    unacked < inner.window_limit as i64
  }

  // Wake every parked producer / ack-waiter. Called after any state change that
  // could let someone make progress.
  fn wake_all(inner: &mut Inner, progress: &Condvar) {
    for w in inner.wakers.drain(..) {
      w.wake();
    }
    if inner.parked_threads > 0 {
      progress.notify_all();
    }
  }

  // Park this thread until `wake_all`, or until `max_wait` has passed.
  fn park<'a>(
    shared: &'a Shared,
    mut inner: MutexGuard<'a, Inner>,
    max_wait: Option<StdDuration>,
  ) -> MutexGuard<'a, Inner> {
    inner.parked_threads += 1;
    let mut inner = match max_wait {
      None => shared.progress.wait(inner).unwrap(),
      Some(max_wait) => shared.progress.wait_timeout(inner, max_wait).unwrap().0,
    };
    inner.parked_threads -= 1;
    inner
  }

  // --- producer side ---

  /// Synchronous admission. Blocks the calling thread until there is room in
  /// the reliable send window, or `timeout` elapses. On success the sample is
  /// stored and its sequence number returned. Built-in / best-effort writers
  /// always admit immediately.
  pub fn admit_blocking(
    &self,
    write_options: WriteOptions,
    data: DDSData,
    timeout: Option<StdDuration>,
  ) -> Admission {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();

    // Reliable writers always back-pressure; best-effort only if this write
    // opted in via `best_effort_may_block`.
    let may_block = shared.reliable_writer || write_options.best_effort_may_block();

    let deadline = timeout.map(|t| Instant::now() + t);
    loop {
      if Self::has_room(shared, &inner, may_block) {
        let sequence_number =
          Self::insert_locked(shared, &mut inner, write_options, data, may_block);
        return Admission::Admitted {
          sequence_number,
          readers: inner.readers.len(),
        };
      }
      // Window full: wait for an acknowledgement to free up space.
      match deadline {
        None => inner = Self::park(shared, inner, None),
        Some(deadline) => {
          let now = Instant::now();
          if now >= deadline {
            return Admission::WouldBlock;
          }
          inner = Self::park(shared, inner, Some(deadline - now));
        }
      }
    }
  }

  /// Non-blocking admission for async writers. On success returns the allocated
  /// sequence number. On a full window returns the (write_options, data) back
  /// so the caller can retry later, and registers `waker` to be woken when
  /// room becomes available.
  pub fn try_admit(
    &self,
    write_options: WriteOptions,
    data: DDSData,
    waker: &Waker,
  ) -> Result<SequenceNumber, (WriteOptions, DDSData)> {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    let may_block = shared.reliable_writer || write_options.best_effort_may_block();
    if Self::has_room(shared, &inner, may_block) {
      Ok(Self::insert_locked(
        shared,
        &mut inner,
        write_options,
        data,
        may_block,
      ))
    } else {
      register_waker(&mut inner.wakers, waker);
      Err((write_options, data))
    }
  }

  fn insert_locked(
    shared: &Shared,
    inner: &mut Inner,
    write_options: WriteOptions,
    data: DDSData,
    may_block: bool,
  ) -> SequenceNumber {
    let is_completed = |early: &mut Early| {
      write_options.completes_early() && early.completed_by(&write_options, &data)
    };
    match inner.early.take_if(is_completed) {
      Some(early) => inner.completed_early = Some((early.change.sequence_number, early.id)),
      None => {
        inner.withdraw_early();
      }
    }
    let seq = inner.last_seq.plus_1();
    Self::report_number(shared, seq, true);
    if let (false, Some(depth)) = (shared.volatile, shared.keep_last) {
      inner.history.record(&write_options, seq, depth);
    }
    let cc = CacheChange::new(shared.writer_guid, seq, write_options, data);
    inner.retained_bytes += cc.data_value.payload_size();
    inner.written_bytes += cc.data_value.payload_size() as u64;
    inner.changes.insert(seq, cc);
    inner.last_seq = seq;

    // KeepLast "newest wins" bound. Applied on insert for:
    //  - non-blocking best-effort writes: never throttled at admission (`has_room`
    //    returns true), and the only other eviction path is the periodic
    //    cache-cleaning timer, which starves under a sustained flood -- so without
    //    this the buffer grows without bound (confirmed multi-GB leak);
    //  - reliable writers with NO matched reliable reader yet: there is nobody to
    //    repair to, so retaining unacknowledged samples is pointless. A reliable
    //    writer that produces flat-out before discovery completes (discovery is
    //    CPU-starved under load and can lag ~1 s) would otherwise race thousands of
    //    samples ahead, and when the reader finally matches it faces a huge
    //    unacknowledged backlog that must be recovered via repair at the slow (100
    //    ms) heartbeat cadence -- collapsing reliable throughput. Trimming to
    //    KeepLast here keeps only the recent samples (correct for volatile
    //    durability); once a reliable reader matches, `reliable_readers_present`
    //    flips true and we retain everything again for repair.
    // For a matched reader, what is unsent stays within the window: with a small depth, a burst
    // would evict samples that the application counts as sent.
    // Built-in (discovery) writers are always exempt to never lose discovery data.
    let trim_keep_last = !shared.is_builtin
      && (!may_block
        || (shared.reliable_writer && shared.volatile && !inner.reliable_readers_present));
    if trim_keep_last {
      while inner.changes.len() > inner.max_retain
        && !Self::waits_for_one_reader(shared, inner)
        && (inner.readers.is_empty()
          || inner.is_over_window()
          || Self::is_oldest_sent(shared, inner))
      {
        inner.evict_oldest();
      }
    } else if shared.keep_last.is_some() {
      // Some reader has not acknowledged the oldest sample for `window_limit`
      // samples. It alone misses that sample.
      while inner.is_over_window() {
        inner.evict_oldest();
      }
    }
    seq
  }

  /// Offers the first `available` bytes of a sample that is not written yet. `data` has
  /// the length of the whole serialized payload. Returns whether the Writer may send them:
  /// not if another sample is offered already, and not of a Writer that keeps samples for
  /// late joiners.
  pub fn begin_early(&self, write_options: WriteOptions, data: DDSData, available: usize) -> bool {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    let may = shared.reliable_writer && shared.volatile && !shared.is_builtin;
    if !may || inner.early.is_some() {
      return false;
    }
    let number = inner.last_seq.plus_1();
    inner.early_count += 1;
    inner.early = Some(Early {
      id: inner.early_count,
      change: CacheChange::new(shared.writer_guid, number, write_options, data),
      available,
      is_begun: false,
    });
    true
  }

  /// Offers more bytes of the sample that was begun.
  pub fn extend_early(&self, available: usize) {
    if let Some(early) = &mut self.shared.inner.lock().unwrap().early {
      early.available = early.available.max(available);
    }
  }

  /// Gives up the sample that was begun; the next one gets another number if fragments of
  /// it were sent. Returns whether they were.
  pub fn withdraw_early(&self) -> bool {
    self.shared.inner.lock().unwrap().withdraw_early()
  }

  /// The sample that was begun.
  pub fn early(&self) -> Option<Early> {
    self.shared.inner.lock().unwrap().early.clone()
  }

  /// Notes that fragments of the sample with this id are sent from now on. Returns false if
  /// it was completed or withdrawn meanwhile: its number may be that of another one.
  pub fn mark_early_sent(&self, id: u64) -> bool {
    let mut inner = self.shared.inner.lock().unwrap();
    let Some(early) = inner.early.as_mut().filter(|early| early.id == id) else {
      return false;
    };
    early.is_begun = true;
    Self::report_number(&self.shared, early.change.sequence_number, false);
    true
  }

  /// The number and the id of the sample that was completed last.
  pub fn completed_early(&self) -> Option<(SequenceNumber, u64)> {
    self.shared.inner.lock().unwrap().completed_early
  }

  /// Whether the number is that of a sample that was withdrawn.
  pub fn is_withdrawn(&self, sn: SequenceNumber) -> bool {
    self.shared.inner.lock().unwrap().withdrawn.contains(&sn)
  }

  /// The numbers of samples that were withdrawn.
  pub fn withdrawn(&self) -> BTreeSet<SequenceNumber> {
    self.shared.inner.lock().unwrap().withdrawn.clone()
  }

  // Whether the oldest sample is one for a late joiner that the event loop has not sent
  // yet. The history may be longer than `max_retain`, which later samples bound.
  fn waits_for_one_reader(shared: &Shared, inner: &Inner) -> bool {
    if shared.volatile || inner.changes.len() > inner.max_retain + DEFAULT_WRITER_MAX_SAMPLES {
      return false;
    }
    inner.changes.first_key_value().is_some_and(|(oldest, change)| {
      change.write_options.to_single_reader().is_some() && *oldest > shared.direct_send.last_sent()
    })
  }

  fn is_oldest_sent(shared: &Shared, inner: &Inner) -> bool {
    let oldest = inner.changes.first_key_value();
    oldest.is_none_or(|(oldest, _)| *oldest <= shared.direct_send.last_sent())
  }

  /// Sends a freshly admitted sample on the calling thread, if that is possible.
  /// If not, the event loop has to do it: ring its doorbell.
  pub fn send_now(&self, sequence_number: SequenceNumber) -> bool {
    let sent = self
      .shared
      .direct_send
      .try_send(self.shared.writer_guid, sequence_number, || {
        let inner = self.shared.inner.lock().unwrap();
        let change = inner.changes.get(&sequence_number)?.clone();
        Some((change, inner.advertised_first()))
      });
    if sent {
      self.set_sent_frontier(sequence_number);
    }
    sent
  }

  // --- consumer side (Writer / event loop) ---

  /// What the threads that write may send themselves.
  pub fn direct_send(&self) -> &DirectSend {
    &self.shared.direct_send
  }

  /// Update the reliable acknowledgement frontier. `acked_before` is the
  /// minimum `all_acked_before` over all matched reliable readers, and
  /// `present` tells whether any reliable reader is currently matched. Wakes
  /// blocked producers / ack-waiters when the frontier advances or a reader
  /// goes away.
  ///
  /// A reader that has not sent an ACKNACK yet reports `all_acked_before == 0`.
  /// The frontier is never below the number of the first sample: anything
  /// lower would count a sample that does not exist against the send window.
  pub fn set_acked_frontier(&self, acked_before: Option<SequenceNumber>) {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    let advanced = match acked_before {
      Some(sn) => {
        let sn = max(sn, inner.begins_with);
        let adv = sn > inner.acked_before || !inner.reliable_readers_present;
        inner.acked_before = sn;
        inner.reliable_readers_present = true;
        adv
      }
      None => {
        // No reliable readers (any more). Everything counts as acknowledged.
        let adv = inner.reliable_readers_present;
        inner.reliable_readers_present = false;
        adv
      }
    };
    if advanced {
      Self::wake_all(&mut inner, &shared.progress);
    }
  }

  /// nonblocking-transmit: advance the "actually transmitted" frontier. Called
  /// by the Writer as it puts samples on the wire. Wakes producers parked on a
  /// full unsent backlog when the frontier advances.
  pub fn set_sent_frontier(&self, sent_frontier: SequenceNumber) {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    if sent_frontier > inner.sent_frontier {
      inner.sent_frontier = sent_frontier;
      Self::wake_all(&mut inner, &shared.progress);
    }
  }

  /// Payload bytes of all samples that were ever written.
  pub fn written_bytes(&self) -> u64 {
    self.shared.inner.lock().unwrap().written_bytes
  }

  /// The sequence number of the latest allocated sample (0 if none yet).
  pub fn last_change_sequence_number(&self) -> SequenceNumber {
    self.shared.inner.lock().unwrap().last_seq
  }

  /// Number of samples currently retained in the buffer. Test-only.
  #[cfg(test)]
  pub fn retained_len(&self) -> usize {
    self.shared.inner.lock().unwrap().changes.len()
  }

  /// The first sequence number that a HEARTBEAT to all readers offers.
  ///
  /// It is below the first retained one while a reader has not acknowledged samples
  /// that were evicted: the reader then requests those that it lacks, is answered
  /// by a GAP, and the Writer knows how many it missed.
  pub fn advertised_first(&self) -> SequenceNumber {
    self.shared.inner.lock().unwrap().advertised_first()
  }

  /// Registers a matched reader and returns the first sample that it is offered,
  /// with the record of its progress. `wants_history` is whether the reader is to
  /// get samples that were written before it was matched: of a KEEP_LAST writer
  /// the last `depth` ones. Any other reader is offered what has not been sent yet,
  /// because that is sent to it, too. The caller holds the lock of the direct send.
  pub fn reader_matched(
    &self,
    reader: GUID,
    reliable: bool,
    wants_history: bool,
  ) -> Arc<ReaderProgress> {
    let mut inner = self.shared.inner.lock().unwrap();
    let next = inner.last_seq.plus_1();
    let first_unsent = self.shared.direct_send.last_sent().plus_1().min(next);
    let mut history = None;
    let first_of_new = if !wants_history {
      first_unsent
    } else if let Some(mut listed) = inner.history.numbers() {
      listed.split_off(&first_unsent);
      let first = listed.first().copied().unwrap_or(first_unsent);
      history = Some(OfferedHistory {
        listed,
        before: first_unsent,
      });
      first
    } else {
      // What is not sent yet goes to the reader when it is sent, also what is not among the
      // last samples of the history any more.
      Self::history_first_locked(&self.shared, &inner).min(first_unsent)
    };
    let first_offered = if inner.former_readers.remove(&reader) {
      // It got the history from the former writer, and may lack any sample since.
      history = None;
      inner.first_seq.min(first_unsent)
    } else {
      first_of_new
    };
    let withdrawn = inner.withdrawn.range(first_offered..).count() as u64;
    let progress = ReaderProgress::new(reader, reliable, first_offered)
      .with_history(history)
      .or_if_reset(first_of_new)
      .without_withdrawn(inner.withdrawn_total - withdrawn);
    let progress = Arc::new(progress);
    inner.readers.insert(reader, progress.clone());
    progress
  }

  /// The samples of the history before this one, for a late joiner.
  pub fn history_before(&self, before: SequenceNumber) -> BTreeSet<SequenceNumber> {
    let inner = self.shared.inner.lock().unwrap();
    let mut numbers = inner.history.numbers().unwrap_or_else(|| {
      let first = Self::history_first_locked(&self.shared, &inner);
      inner.changes.range(first..).map(|(number, _)| *number).collect()
    });
    numbers.split_off(&before);
    numbers
  }

  /// What only the history has of the samples that a reader acknowledged, before this one.
  pub fn kept_before(&self, acknowledged_before: SequenceNumber) -> OfferedHistory {
    let inner = self.shared.inner.lock().unwrap();
    let before = acknowledged_before.min(inner.first_seq);
    OfferedHistory {
      listed: inner.history.kept_before(before),
      before,
    }
  }

  /// Forgets the history of a source.
  pub fn forget_history_of(&self, source: GUID) {
    self.shared.inner.lock().unwrap().history.forget(source);
  }

  /// Samples of several sources that left the history because of its bounds.
  pub fn history_evicted(&self) -> u64 {
    self.shared.inner.lock().unwrap().history.evicted()
  }

  fn history_first_locked(shared: &Shared, inner: &Inner) -> SequenceNumber {
    match shared.keep_last {
      Some(depth) => max(
        inner.first_seq,
        inner.last_seq.plus_1() - SequenceNumber::from(depth),
      ),
      None => inner.first_seq,
    }
  }

  /// Forgets a reader that is gone. Returns how many samples add to its overrun by that: those
  /// from `unknown_from` on that it was offered and that are gone, because it will not tell
  /// any more whether it has them. What is still available adds nothing: a reader that leaves
  /// in order has not acknowledged the latest samples yet.
  pub fn reader_unmatched(&self, reader: GUID, unknown_from: SequenceNumber) -> u64 {
    let mut inner = self.shared.inner.lock().unwrap();
    let Some(progress) = inner.readers.remove(&reader) else {
      return 0;
    };
    let missed = if progress.is_reliable() && !self.shared.is_builtin {
      inner.gone_from(unknown_from, &progress)
    } else {
      0
    };
    inner.left_overrun += progress.overrun() + missed;
    missed
  }

  /// The overruns of all matched readers, and of those that have left. It never decreases.
  pub fn overrun(&self) -> u64 {
    let inner = self.shared.inner.lock().unwrap();
    let matched: u64 = inner.readers.values().map(|reader| reader.overrun()).sum();
    inner.left_overrun + matched
  }

  /// Every matched reader, with what it was offered, acknowledged and missed.
  pub fn matched_readers(&self) -> Vec<MatchedReader> {
    let inner = self.shared.inner.lock().unwrap();
    let last = inner.last_seq;
    let withdrawn_from = |first| inner.withdrawn.range(first..).count() as u64;
    let snapshot = |r: &Arc<ReaderProgress>| r.snapshot(last, inner.withdrawn_total, withdrawn_from);
    inner.readers.values().map(snapshot).collect()
  }

  /// The lowest sequence number still retained (or the next-to-be-written if
  /// the buffer is empty).
  pub fn first_change_sequence_number(&self) -> SequenceNumber {
    self.shared.inner.lock().unwrap().first_seq
  }

  /// Fetch a clone of the sample with the given sequence number, if retained.
  /// Returns an owned `CacheChange` (a cheap `Bytes`-backed clone) so the
  /// caller can serialize and transmit without holding the lock.
  pub fn get_by_sn(&self, sn: SequenceNumber) -> Option<CacheChange> {
    let inner = self.shared.inner.lock().unwrap();
    let change = inner.changes.get(&sn).or_else(|| inner.history.get(sn));
    change.cloned()
  }

  /// The first sample that is available, also if only the history has it.
  pub fn first_available(&self) -> SequenceNumber {
    self.shared.inner.lock().unwrap().first_available()
  }

  /// If this sample is gone, because it is before the first one retained and the history
  /// does not have it: the next one that is available.
  pub fn available_after(&self, missing: SequenceNumber) -> Option<SequenceNumber> {
    let inner = self.shared.inner.lock().unwrap();
    if missing >= inner.first_seq || inner.history.get(missing).is_some() {
      return None;
    }
    let kept = inner.history.kept_after(missing);
    Some(kept.map_or(inner.first_seq, |kept| kept.min(inner.first_seq)))
  }

  /// Evict all samples with sequence number strictly less than `remove_before`.
  pub fn remove_changes_before(&self, remove_before: SequenceNumber) {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    let count_before = inner.changes.len();
    let kept = inner.changes.split_off(&remove_before);
    for evicted in std::mem::replace(&mut inner.changes, kept).into_values() {
      inner.release(evicted);
    }
    if remove_before > inner.first_seq {
      inner.first_seq = remove_before;
    }
    let count_after = inner.changes.len();
    if count_before != count_after {
      debug!(
        "WriterSendBuffer: removed {} change(s) before {:?} topic={}",
        count_before - count_after,
        remove_before,
        shared.topic_name
      );
    }
  }

  /// Releases the samples before `acked_before`, which every reliable reader has
  /// acknowledged, but for those that a writer which is not VOLATILE keeps for late
  /// joiners: the last `depth` ones, or all of a KEEP_ALL writer.
  pub fn release_acknowledged(&self, acked_before: SequenceNumber) {
    let mut inner = self.shared.inner.lock().unwrap();
    if !inner.former_readers.is_empty() {
      if inner.former_readers_until.is_some_and(|until| Instant::now() < until) {
        return;
      }
      inner.former_readers.clear();
    }
    let remove_before = match (self.shared.volatile, self.shared.keep_last) {
      (true, _) => acked_before,
      (false, Some(depth)) => {
        acked_before.min(inner.last_seq.plus_1() - SequenceNumber::from(depth))
      }
      (false, None) => return,
    };
    while let Some(entry) = inner.changes.first_entry() {
      if *entry.key() >= remove_before {
        break;
      }
      let released = entry.remove();
      inner.release(released);
    }
    // Not past what has been written: a reader may acknowledge ahead of us.
    let written_before = inner.last_seq.plus_1();
    inner.first_seq = max(inner.first_seq, remove_before.min(written_before));
  }

  /// Evicts one sample. Readers that lack it are told by a GAP.
  pub fn remove(&self, sequence_number: SequenceNumber) {
    let mut inner = self.shared.inner.lock().unwrap();
    if let Some(evicted) = inner.changes.remove(&sequence_number) {
      inner.retained_bytes -= evicted.data_value.payload_size();
    }
    let first = inner.changes.keys().next().copied();
    inner.first_seq = first.unwrap_or_else(|| inner.last_seq.plus_1());
  }

  // --- wait_for_acknowledgments support ---

  /// Has every matched reliable reader acknowledged everything up to and
  /// including `target`? Also true when there are no reliable readers.
  pub fn is_acked_through(&self, target: SequenceNumber) -> bool {
    let inner = self.shared.inner.lock().unwrap();
    !inner.reliable_readers_present || inner.acked_before > target
  }

  /// Synchronously wait until everything up to `target` is acknowledged, or
  /// `max_wait` elapses. Returns `true` if acknowledged.
  pub fn wait_for_acked_through(&self, target: SequenceNumber, max_wait: StdDuration) -> bool {
    let shared = &*self.shared;
    let mut inner = shared.inner.lock().unwrap();
    let deadline = Instant::now() + max_wait;
    loop {
      if !inner.reliable_readers_present || inner.acked_before > target {
        return true;
      }
      let now = Instant::now();
      if now >= deadline {
        return false;
      }
      inner = Self::park(shared, inner, Some(deadline - now));
    }
  }

  /// Register `waker` to be notified when the acknowledgement frontier advances
  /// (used by the async `wait_for_acknowledgments` future).
  pub fn register_ack_waker(&self, waker: &Waker) {
    let mut inner = self.shared.inner.lock().unwrap();
    register_waker(&mut inner.wakers, waker);
  }
}

// Avoid storing duplicate wakers for the same task.
fn register_waker(wakers: &mut Vec<Waker>, waker: &Waker) {
  if !wakers.iter().any(|w| w.will_wake(waker)) {
    wakers.push(waker.clone());
  }
}

#[cfg(test)]
mod tests {
  use std::time::Duration as StdDuration;

  use bytes::Bytes;

  use super::*;
  use crate::{
    dds::{ddsdata::DDSData, with_key::datawriter::WriteOptionsBuilder},
    messages::submessages::elements::serialized_payload::SerializedPayload,
    structure::guid::{EntityId, EntityKind, GuidPrefix, GUID},
    RepresentationIdentifier,
  };

  fn sample() -> DDSData {
    DDSData::new(SerializedPayload::new(
      RepresentationIdentifier::CDR_LE,
      vec![0u8; 8],
    ))
  }

  fn admit_now(buf: &WriterSendBuffer, opts: WriteOptions) -> bool {
    matches!(
      buf.admit_blocking(opts, sample(), Some(StdDuration::ZERO)),
      Admission::Admitted { .. }
    )
  }

  fn may_block_opts() -> WriteOptions {
    WriteOptionsBuilder::new()
      .best_effort_may_block(true)
      .build()
  }

  // A matched reliable reader that has not sent an ACKNACK yet reports
  // `all_acked_before == 0`. Sequence numbers start at 1, so that frontier
  // leaves nothing unacknowledged on a fresh writer: the window must still
  // admit `window_limit` samples.
  #[test]
  fn unacknowledged_reader_frontier_leaves_full_window() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1,
      /* backlog_limit */ 1000,
      /* max_retain */ 1,
    );
    buf.set_acked_frontier(Some(SequenceNumber::zero()));

    assert!(admit_now(&buf, WriteOptions::default())); // seq 1
    assert!(!admit_now(&buf, WriteOptions::default())); // window full

    // The reader's first ACKNACK acknowledges seq 1.
    buf.set_acked_frontier(Some(SequenceNumber::new(2)));
    assert!(admit_now(&buf, WriteOptions::default())); // seq 2
  }

  // Each of the two ways to wait is woken by progress, and leaves nobody parked.
  #[test]
  fn parked_threads_are_woken() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1,
      /* backlog_limit */ 1000,
      /* max_retain */ 1,
    );
    buf.set_acked_frontier(Some(SequenceNumber::new(1)));
    assert!(admit_now(&buf, WriteOptions::default())); // seq 1
    let parked = |buf: &WriterSendBuffer| buf.shared.inner.lock().unwrap().parked_threads;
    assert_eq!(parked(&buf), 0);
    let waits = StdDuration::from_secs(60);
    std::thread::scope(|threads| {
      let writer = threads.spawn(|| buf.admit_blocking(WriteOptions::default(), sample(), None));
      let waiter = threads.spawn(|| buf.wait_for_acked_through(SequenceNumber::new(1), waits));
      while parked(&buf) < 2 {
        std::thread::yield_now();
      }
      buf.set_acked_frontier(Some(SequenceNumber::new(2)));
      assert!(matches!(writer.join().unwrap(), Admission::Admitted { .. }));
      assert!(waiter.join().unwrap());
    });
    assert_eq!(parked(&buf), 0);
    assert!(!admit_now(&buf, WriteOptions::default())); // a wait that is over
    assert_eq!(parked(&buf), 0);
  }

  fn small_buffer(kind: EntityKind) -> WriterSendBuffer {
    WriterSendBuffer::new(
      GUID::dummy_test_guid(kind),
      "t".to_string(),
      /* reliable_writer */ true,
      kind.is_built_in(),
      /* volatile */ true,
      /* window_limit */ 2,
      /* backlog_limit */ 2,
      /* max_retain */ 2,
    )
  }

  // A writer that continues another one is as one that has written nothing: its readers
  // lack nothing, and its window is empty. It tells each number once, before it can be sent.
  #[test]
  fn a_continued_writer_begins_after_the_highest_number() {
    let told = Arc::new(Mutex::new(Vec::new()));
    let tell = Arc::clone(&told);
    let buf = small_buffer(EntityKind::WRITER_NO_KEY_USER_DEFINED)
      .continue_former(ContinuedWriter {
        on_number: Box::new(move |number, written| tell.lock().unwrap().push((number, written))),
        ..ContinuedWriter::after(41)
      });
    assert_eq!(buf.last_change_sequence_number(), SequenceNumber::new(41));
    assert_eq!(buf.direct_send().last_sent(), SequenceNumber::new(41));
    assert_eq!(buf.advertised_first(), SequenceNumber::new(42));
    // A reader that has not acknowledged anything yet.
    buf.set_acked_frontier(Some(SequenceNumber::zero()));
    assert!(buf.is_acked_through(SequenceNumber::new(41)));
    assert_eq!(buf.advertised_first(), SequenceNumber::new(42));
    assert!(admit_now(&buf, WriteOptions::default()));
    assert!(buf.get_by_sn(SequenceNumber::new(42)).is_some());
    assert_eq!(*told.lock().unwrap(), [(42, true)]);

    // A number of which fragments are sent before the sample is written, or withdrawn.
    assert!(buf.begin_early(WriteOptions::default(), sample(), 8));
    assert_eq!(*told.lock().unwrap(), [(42, true)]);
    assert!(buf.mark_early_sent(buf.early().unwrap().id));
    assert_eq!(*told.lock().unwrap(), [(42, true), (43, false)]);
    assert!(buf.withdraw_early());
    buf.set_acked_frontier(Some(SequenceNumber::new(44)));
    buf.set_sent_frontier(SequenceNumber::new(43));
    assert!(admit_now(&buf, WriteOptions::default()));
    assert_eq!(*told.lock().unwrap(), [(42, true), (43, false), (44, true)]);
  }

  // It has the samples of the former writer until all readers of that one have acknowledged them.
  #[test]
  fn a_continued_writer_has_the_samples_of_the_former_one() {
    let number = SequenceNumber::new;
    let reader = |id: u8| GUID::new(GuidPrefix::new(&[id; 12]), EntityId::PARTICIPANT);
    let sample = |number: i64| crate::ContinuedSample {
      number,
      payload: Bytes::from(vec![number as u8; 8]),
      encoding: RepresentationIdentifier::CDR_LE,
      encoding_options: [0, 0],
      source_timestamp: None,
      history_source: None,
    };
    let buf = small_buffer(EntityKind::WRITER_NO_KEY_USER_DEFINED).continue_former(ContinuedWriter {
      samples: [37, 38, 40, 41].map(sample).into(),
      sent_through: 40,
      readers: vec![reader(1), reader(2)],
      ..ContinuedWriter::after(41)
    });
    assert!(buf.has_unsent());
    assert_eq!((buf.direct_send().last_sent(), buf.retained_len()), (number(40), 4));
    assert_eq!(buf.advertised_first(), number(37));
    assert!(buf.is_withdrawn(number(39)));
    let offered = |id: u8| buf.reader_matched(reader(id), true, false).first_offered();
    assert_eq!((offered(1), offered(3)), (number(37), number(41)), "a former reader and a new one");
    let of = |id: u8| buf.matched_readers().into_iter().find(|r| r.guid == reader(id)).unwrap();
    assert_eq!((of(1).offered, of(3).offered), (4, 1), "39 was withdrawn");
    buf.set_acked_frontier(Some(number(41)));
    buf.release_acknowledged(number(41));
    assert_eq!(buf.retained_len(), 4, "another former reader may lack them");
    assert!(buf.holds_unsent());
    assert_eq!(offered(2), number(37));
    assert!(buf.has_unsent() && !buf.holds_unsent(), "all former readers have matched");
    buf.release_acknowledged(number(41));
    assert_eq!(buf.retained_len(), 1);
  }

  // Their GAP would withdraw some of the samples that are sent to it next.
  #[test]
  fn a_late_joiner_is_offered_all_that_is_not_sent_yet() {
    let guid = EntityId::new([0, 0, 1], EntityKind::WRITER_NO_KEY_USER_DEFINED);
    let guid = GUID::new(GuidPrefix::new(&[1; 12]), guid);
    let buf = WriterSendBuffer::new(guid, "latched".to_string(), true, false, false, 256, 256, 2)
      .keep_last(2);
    for _ in 0..10 {
      assert!(admit_now(&buf, WriteOptions::default()));
    }
    let mut offered = (1..).map(|id| {
      let reader = GUID::new(GuidPrefix::new(&[id; 12]), EntityId::PARTICIPANT);
      buf.reader_matched(reader, true, true).first_offered()
    });
    for (last_sent, expected) in [(4, 5), (8, 9), (10, 9)] {
      buf.direct_send().set_last_sent(SequenceNumber::new(last_sent));
      assert_eq!(offered.next(), Some(SequenceNumber::new(expected)), "{last_sent} were sent");
    }
  }

  // A former reader may lack any of its samples. A late joiner gets the last ones of each source.
  #[test]
  fn a_continued_writer_has_the_history_of_the_former_one() {
    let number = SequenceNumber::new;
    let reader = |id: u8| GUID::new(GuidPrefix::new(&[id; 12]), EntityId::PARTICIPANT);
    let source = |id: u8| GUID::new(GuidPrefix::new(&[100 + id; 12]), EntityId::PARTICIPANT);
    let sample = |(number, of): (i64, u8)| crate::ContinuedSample {
      number,
      payload: Bytes::from(vec![number as u8; 8]),
      encoding: RepresentationIdentifier::CDR_LE,
      encoding_options: [0, 0],
      source_timestamp: None,
      history_source: Some(source(of)),
    };
    let continuing = |samples: &[(i64, u8)]| {
      let guid = EntityId::new([0, 0, 1], EntityKind::WRITER_NO_KEY_USER_DEFINED);
      let guid = GUID::new(GuidPrefix::new(&[1; 12]), guid);
      WriterSendBuffer::new(guid, "latched".to_string(), true, false, false, 256, 256, 2)
        .keep_last(2)
        .continue_former(ContinuedWriter {
          samples: samples.iter().copied().map(sample).collect(),
          sent_through: 41,
          readers: vec![reader(1)],
          ..ContinuedWriter::after(41)
        })
    };
    let one_source = continuing(&[(38, 1), (39, 1), (40, 1), (41, 1)]);
    let several = continuing(&[(37, 2), (38, 1), (39, 1), (40, 1), (41, 1)]);
    for (buf, first, of_late_joiner) in
      [(one_source, 38, vec![40, 41]), (several, 37, vec![37, 40, 41])]
    {
      let offered = |id: u8| buf.reader_matched(reader(id), true, true);
      assert_eq!(offered(1).first_offered(), number(first), "a former reader");
      assert_eq!(offered(2).first_offered(), number(of_late_joiner[0]), "a late joiner");
      // Both have acknowledged everything.
      buf.set_acked_frontier(Some(number(42)));
      buf.release_acknowledged(number(42));
      let kept: Vec<i64> = buf.history_before(number(42)).into_iter().map(i64::from).collect();
      assert_eq!(kept, of_late_joiner);
      assert!(kept.iter().all(|kept| buf.get_by_sn(number(*kept)).is_some()));
      assert!(buf.get_by_sn(number(39)).is_none());
    }
  }

  #[test]
  fn the_numbers_of_a_former_writer_are_checked() {
    let with = |numbers: &[i64], highest: i64| {
      let sample = |number: &i64| crate::ContinuedSample {
        number: *number,
        payload: Bytes::new(),
        encoding: RepresentationIdentifier::CDR_LE,
        encoding_options: [0, 0],
        source_timestamp: None,
        history_source: None,
      };
      let samples = numbers.iter().map(sample).collect();
      ContinuedWriter { samples, ..ContinuedWriter::after(highest) }.is_valid()
    };
    assert!(with(&[], 0) && with(&[1], 1) && with(&[5, 7], 9));
    assert!(!with(&[], -1) && !with(&[], i64::MAX));
    assert!(!with(&[0], 1) && !with(&[2], 1) && !with(&[2, 2], 3) && !with(&[3, 2], 3));
    assert!(!with(&[1], 5_000));
  }

  #[test]
  fn a_built_in_writer_begins_after_the_numbers_that_the_participant_takes_over() {
    let identity = crate::ParticipantIdentity {
      prefix: [1; 12],
      participant_id: 0,
      urgent_port: 0,
      highest_count: 500,
      highest_number: 4096,
    };
    let numbers = Arc::new(UsedNumbers::after(&identity));
    let built_in = small_buffer(EntityKind::WRITER_WITH_KEY_BUILT_IN)
      .numbered_with(Arc::clone(&numbers));
    let users = small_buffer(EntityKind::WRITER_NO_KEY_USER_DEFINED)
      .numbered_with(Arc::clone(&numbers));
    for buf in [&built_in, &users] {
      assert!(admit_now(buf, WriteOptions::default()));
    }
    assert_eq!(built_in.last_change_sequence_number(), SequenceNumber::new(4097));
    assert_eq!(users.last_change_sequence_number(), SequenceNumber::new(1));
    assert_eq!(numbers.highest_number(), SequenceNumber::new(4097));
    for count in [501, 502] {
      assert_eq!(users.direct_send().next_heartbeat_count(), count);
    }
    assert_eq!(built_in.direct_send().next_heartbeat_count(), 501);
    assert_eq!(numbers.highest_count(), 502);
  }

  // nonblocking-transmit: a best-effort writer that opted in via
  // `best_effort_may_block` is throttled by the unsent-backlog limit once the
  // socket stops draining, and released when the Writer advances the sent
  // frontier.
  #[test]
  fn backlog_limit_backpressures_best_effort_when_may_block() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ false,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1000,
      /* backlog_limit */ 2,
      /* max_retain */ 1000,
    );

    // Nothing sent yet: backlog fills after two admissions.
    assert!(admit_now(&buf, may_block_opts())); // seq 1
    assert!(admit_now(&buf, may_block_opts())); // seq 2
    assert!(!admit_now(&buf, may_block_opts())); // backlog full (2 unsent, limit 2)

    // The Writer transmits seq 1; backlog drops to 1, room opens for one more.
    buf.set_sent_frontier(SequenceNumber::new(1));
    assert!(admit_now(&buf, may_block_opts())); // seq 3
    assert!(!admit_now(&buf, may_block_opts())); // full again (2 unsent: seq
                                                 // 2,3)
  }

  // By default (`best_effort_may_block == false`, DDS v1.4 2.2.2.4.2.11) a
  // best-effort write is never throttled at admission, even when the backlog is
  // already full -- congested samples are dropped later at the socket instead.
  #[test]
  fn backlog_limit_ignored_for_best_effort_by_default() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ false,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1000,
      /* backlog_limit */ 1,
      /* max_retain */ 1000,
    );
    // Default WriteOptions => best_effort_may_block == false => never blocks.
    assert!(admit_now(&buf, WriteOptions::default()));
    assert!(admit_now(&buf, WriteOptions::default()));
    assert!(admit_now(&buf, WriteOptions::default())); // still admitted despite
                                                       // full backlog
  }

  // Built-in (discovery) writers must never be throttled by the backlog.
  #[test]
  fn backlog_limit_exempts_builtin() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      false,
      /* is_builtin */ true,
      /* volatile */ true,
      1000,
      /* backlog_limit */ 1,
      /* max_retain */ 1000,
    );
    assert!(admit_now(&buf, may_block_opts()));
    assert!(admit_now(&buf, may_block_opts()));
    assert!(admit_now(&buf, may_block_opts())); // still admitted despite tiny
                                                // backlog limit
  }

  // A best-effort (non-blocking, DDS-default) writer is never throttled at
  // admission, but the retained buffer must stay bounded by `max_retain`
  // (KeepLast "newest wins"): the leak fix. Every write is admitted, yet the
  // buffer never holds more than `max_retain` samples, and it retains the
  // newest ones (oldest are evicted on insert).
  #[test]
  fn best_effort_default_bounded_by_max_retain() {
    let max_retain = 4;
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ false,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1000,
      /* backlog_limit */ 1000,
      max_retain,
    );

    for _ in 0..100 {
      // Default WriteOptions => best-effort, non-blocking => always admitted.
      assert!(admit_now(&buf, WriteOptions::default()));
      // Invariant after every insert: never exceeds the retain bound.
      assert!(buf.retained_len() <= max_retain);
    }

    // Exactly `max_retain` retained, and they are the newest sequence numbers.
    assert_eq!(buf.retained_len(), max_retain);
    let last = buf.last_change_sequence_number();
    assert_eq!(last, SequenceNumber::new(100));
    let first = buf.first_change_sequence_number();
    assert_eq!(first, SequenceNumber::new(100 - max_retain as i64 + 1));
    // Newest is retained, an evicted older one is gone.
    assert!(buf.get_by_sn(last).is_some());
    assert!(buf.get_by_sn(SequenceNumber::new(1)).is_none());
  }

  #[test]
  fn what_is_unsent_is_retained_for_a_best_effort_reader() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 8,
      /* backlog_limit */ 1000,
      /* max_retain */ 2,
    );
    let write = |count: usize| (0..count).for_each(|_| assert!(admit_now(&buf, WriteOptions::default())));
    write(5);
    assert_eq!(buf.retained_len(), 2, "without a reader");
    buf.reader_matched(GUID::GUID_UNKNOWN, false, false);
    write(6);
    assert_eq!(buf.retained_len(), 8);
    write(2);
    assert_eq!(buf.retained_len(), 8, "the window is full");
    buf.direct_send().set_last_sent(SequenceNumber::new(10));
    write(1);
    assert_eq!(buf.first_change_sequence_number(), SequenceNumber::new(11));
    buf.direct_send().set_last_sent(SequenceNumber::new(14));
    write(1);
    assert_eq!(buf.retained_len(), 2);
  }

  // The history of a BEST_EFFORT writer is written again to a late joiner: more samples
  // than the writer retains, which stay until they were sent.
  #[test]
  fn what_is_for_one_reader_is_retained_until_it_was_sent() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ false,
      /* is_builtin */ false,
      /* volatile */ false,
      /* window_limit */ 1000,
      /* backlog_limit */ 1000,
      /* max_retain */ 2,
    );
    let to_one = || {
      WriteOptionsBuilder::new()
        .to_single_reader(GUID::GUID_UNKNOWN)
        .build()
    };
    for _ in 0..4 {
      assert!(admit_now(&buf, WriteOptions::default()));
    }
    for _ in 0..14 {
      assert!(admit_now(&buf, to_one()));
    }
    assert!(admit_now(&buf, WriteOptions::default()));
    assert_eq!(buf.retained_len(), 15);
    assert_eq!(
      buf.first_change_sequence_number(),
      SequenceNumber::new(5)
    );
    buf.direct_send().set_last_sent(SequenceNumber::new(10));
    assert!(admit_now(&buf, WriteOptions::default()));
    assert_eq!(
      buf.first_change_sequence_number(),
      SequenceNumber::new(11)
    );
    buf.direct_send().set_last_sent(SequenceNumber::new(20));
    assert!(admit_now(&buf, WriteOptions::default()));
    assert_eq!(buf.retained_len(), 2);
  }

  // A durable (non-VOLATILE) reliable writer must NOT drop on insert even before
  // a reader matches: it retains samples for late-joining readers. The
  // `max_retain` bound does not apply to it.
  #[test]
  fn durable_reliable_writer_not_trimmed_before_match() {
    let max_retain = 2;
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ false, // TRANSIENT_LOCAL etc: keep for late joiners
      /* window_limit */ 1000,
      /* backlog_limit */ 1000,
      max_retain,
    );
    // No reliable readers matched yet => admission not window-throttled.
    for _ in 0..10 {
      assert!(admit_now(&buf, WriteOptions::default()));
    }
    // Durable path keeps everything for potential late-joiner delivery / repair
    // despite tiny max_retain.
    assert_eq!(buf.retained_len(), 10);
  }

  // A VOLATILE reliable writer with no matched reliable reader trims KeepLast on
  // insert: there is no late joiner to serve, so retaining unacknowledged samples
  // is pointless and would create a huge post-match repair backlog (the reliable
  // flat-out throughput fix). Once a reliable reader matches
  // (`set_acked_frontier(Some(..))`), trimming stops and everything is retained
  // for repair.
  #[test]
  fn volatile_reliable_writer_trimmed_until_reader_matches() {
    let max_retain = 4;
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ true,
      /* window_limit */ 1000,
      /* backlog_limit */ 1000,
      max_retain,
    );
    // No reliable reader yet: admitted freely (backlog has room) but trimmed to
    // KeepLast so the buffer cannot balloon before discovery completes.
    for _ in 0..100 {
      assert!(admit_now(&buf, WriteOptions::default()));
      assert!(buf.retained_len() <= max_retain);
    }
    assert_eq!(buf.retained_len(), max_retain);

    // A reliable reader matches: from now on the writer retains everything for
    // repair (no trimming), even past max_retain.
    buf.set_acked_frontier(Some(SequenceNumber::new(101)));
    for _ in 0..10 {
      assert!(admit_now(&buf, WriteOptions::default()));
    }
    assert_eq!(buf.retained_len(), max_retain + 10);
  }

  // A reader that has acknowledged nothing skips what is gone.
  #[test]
  fn a_writer_can_offer_only_what_it_retains() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      true,
      false,
      true,
      5,
      1000,
      2,
    )
    .keep_last(2);
    buf.set_acked_frontier(Some(SequenceNumber::new(1)));
    for _ in 0..10 {
      assert!(admit_now(&buf, WriteOptions::default()));
    }
    assert_eq!(buf.retained_len(), 5);
    assert_eq!(
      buf.history_before(SequenceNumber::new(11)),
      [9, 10].map(SequenceNumber::new).into()
    );
    assert_eq!(buf.advertised_first(), SequenceNumber::new(1));
    buf.offer_only_retained();
    assert_eq!(buf.advertised_first(), SequenceNumber::new(6));
  }

  // What the history keeps for late joiners is no loss, nor what a late joiner was not offered.
  #[test]
  fn a_reader_that_leaves_has_missed_nothing_that_the_history_has() {
    let buf = WriterSendBuffer::new(
      GUID::GUID_UNKNOWN,
      "t".to_string(),
      /* reliable_writer */ true,
      /* is_builtin */ false,
      /* volatile */ false,
      /* window_limit */ 8,
      /* backlog_limit */ 1000,
      /* max_retain */ 1,
    )
    .keep_last(1);
    let guid = |number: u8| GUID::new(GuidPrefix::new(&[number; 12]), EntityId::UNKNOWN);
    let write = |source: u8| {
      let options = WriteOptionsBuilder::new().history_source(guid(source));
      assert!(admit_now(&buf, options.build()));
    };
    let first = SequenceNumber::new(1);
    let [early, late, best_effort] = [101, 102, 103].map(guid);
    buf.reader_matched(early, true, true);
    buf.reader_matched(best_effort, false, true);
    buf.set_acked_frontier(Some(first));
    (1..=3).for_each(write);
    (0..97).for_each(|_| write(100));
    buf.direct_send().set_last_sent(SequenceNumber::new(100));
    buf.reader_matched(late, true, true); // it is offered 1, 2, 3 and 100
    write(2);
    assert_eq!(buf.first_change_sequence_number(), SequenceNumber::new(94));

    assert_eq!(buf.reader_unmatched(late, first), 1, "sample 2 was replaced");
    assert_eq!(buf.reader_unmatched(early, first), 93 - 2, "1 and 3 are kept");
    assert_eq!(buf.reader_unmatched(best_effort, first), 0);
    assert_eq!(buf.reader_unmatched(late, first), 0, "it is not matched any more");
    assert_eq!(buf.overrun(), 1 + 93 - 2);
  }
}
