use std::{
  cmp::min,
  collections::{btree_map::Entry, BTreeMap},
  fmt, iter,
  time::{Duration, Instant},
};

use bit_vec::BitVec;
use enumflags2::BitFlags;
use bytes::{Bytes, BytesMut};
#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};

use crate::{
  dds::{
    ddsdata::DDSData,
    lent::{PartialArrival, Lender, Lent, LentMemory},
    with_key::datawriter::InstanceChange,
  },
  messages::submessages::{
    elements::serialized_payload::SerializedPayload,
    submessages::{DATAFRAG_Flags, DataFrag},
  },
  structure::{
    cache_change::ChangeKind,
    guid::GUID,
    sequence_number::{FragmentNumber, SequenceNumber},
    time::Timestamp,
  },
};

// Where the fragments of one sample are put together.
enum Memory {
  // The library's: encapsulation and payload.
  Own(BytesMut),
  // The application's, for the payload; the encapsulation is beside it.
  Lent {
    encapsulation: [u8; ENCAPSULATION_LEN],
    payload: Box<dyn LentMemory>,
  },
}

const ENCAPSULATION_LEN: usize = 4;

impl Memory {
  fn write(&mut self, from: usize, data: &[u8]) {
    match self {
      Memory::Own(buffer) => buffer[from..from + data.len()].copy_from_slice(data),
      Memory::Lent {
        encapsulation,
        payload,
      } => {
        let (head, tail) = data.split_at(
          ENCAPSULATION_LEN
            .saturating_sub(from)
            .min(data.len()),
        );
        encapsulation[from.min(ENCAPSULATION_LEN)..][..head.len()].copy_from_slice(head);
        let from = (from + head.len()).saturating_sub(ENCAPSULATION_LEN);
        payload.write(from, tail);
      }
    }
  }

  // What was put together, as data or as a key.
  fn into_dds_data(self, data_size: usize, is_key: bool) -> std::io::Result<DDSData> {
    match self {
      Memory::Own(buffer) => {
        let serialized = SerializedPayload::from_bytes(&buffer.freeze())?;
        Ok(if is_key {
          DDSData::new_disposed_by_key(ChangeKind::NotAliveDisposed, serialized)
        } else {
          DDSData::new(serialized)
        })
      }
      Memory::Lent {
        encapsulation,
        payload,
      } => {
        let encapsulation = SerializedPayload::from_bytes(&Bytes::copy_from_slice(&encapsulation))?;
        let lent = Lent::new(data_size - ENCAPSULATION_LEN, payload);
        Ok(DDSData::new_lent(encapsulation, lent))
      }
    }
  }
}

// What a Writer need not repeat with each fragment: that of whichever came with it first.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StatedOnce {
  pub source_timestamp: Option<Timestamp>,
  pub instance_change: Option<InstanceChange>,
}

impl StatedOnce {
  fn or(self, later: Self) -> Self {
    Self {
      source_timestamp: self.source_timestamp.or(later.source_timestamp),
      instance_change: self.instance_change.or(later.instance_change),
    }
  }
}

// This is for the assembly of a single object
struct AssemblyBuffer {
  memory: Memory,
  // Bytes of the whole, of each fragment but the last, and the fragments: as the
  // first one that came had them.
  data_size: usize,
  fragment_size: u16,
  fragment_count: usize,
  received_bitmap: BitVec,
  // The fragments before the first one that is missing.
  complete_fragments: usize,

  stated: StatedOnce,

  // Not of the system's clock, which may be set meanwhile.
  modified_at: Instant,
}

impl AssemblyBuffer {
  pub fn new(datafrag: &DataFrag, is_key: bool, lender: &Lender) -> Option<Self> {
    let data_size: usize = datafrag.data_size.try_into().ok()?;
    let fragment_size: u16 = datafrag.fragment_size;
    debug!("new AssemblyBuffer data_size={data_size} frag_size={fragment_size}");

    if fragment_size == 0 || fragment_size as usize > data_size {
      error!("Cannot create AssemblyBuffer: fragment_size={fragment_size} data_size={data_size}");
      return None;
    }

    let fragment_count = usize::from(datafrag.total_number_of_fragments());
    if fragment_count == 0 {
      error!("Cannot create AssemblyBuffer: zero fragment count");
      return None;
    }

    if fragment_count > MAX_FRAGMENTS {
      debug!("DATAFRAG of a sample of {fragment_count} fragments, more than {MAX_FRAGMENTS}");
      return None;
    }

    // The size is what the sender claims.
    let lend = |len| if is_key { None } else { lender.lend(len) };
    let lent = data_size.checked_sub(ENCAPSULATION_LEN).and_then(lend);
    let max_bytes = lender.limits().max_sample_bytes;
    let memory = match lent {
      Some(payload) => Memory::Lent {
        encapsulation: [0; ENCAPSULATION_LEN],
        payload,
      },
      None if data_size > max_bytes => {
        debug!("DATAFRAG of a sample of {data_size} bytes, more than {max_bytes}");
        return None;
      }
      // Zeroed memory costs nothing until it is written to.
      None => Memory::Own(BytesMut::zeroed(data_size)),
    };

    Some(Self {
      memory,
      data_size,
      fragment_size,
      fragment_count,
      received_bitmap: BitVec::from_elem(fragment_count, false),
      complete_fragments: 0,
      stated: StatedOnce::default(),
      modified_at: Instant::now(),
    })
  }

  /// Returns `false` if the fragment run is invalid, out of bounds, or not what
  /// the first one of this sample promised. All bytes of a run that is accepted
  /// are written, except those of fragments that have arrived before: their bytes may
  /// have been read already.
  pub fn insert_frags(&mut self, datafrag: &DataFrag) -> bool {
    // Constant for each sample, and by RTPS spec v2.5 Section 8.4.14.1.1 "How to
    // select the fragment size" for each writer.
    if datafrag.fragment_size != self.fragment_size
      || usize::try_from(datafrag.data_size) != Ok(self.data_size)
    {
      error!(
        "insert_frags: fragment of {} of {} bytes, not of {} of {}",
        datafrag.fragment_size, datafrag.data_size, self.fragment_size, self.data_size
      );
      return false;
    }
    let frag_size = usize::from(self.fragment_size);
    let frags_in_submessage = usize::from(datafrag.fragments_in_submessage);
    if frags_in_submessage == 0 {
      error!("insert_frags: fragments_in_submessage is zero");
      return false;
    }
    let fragment_starting_num: usize = match u32::from(datafrag.fragment_starting_num).try_into() {
      Ok(n) if n >= 1 => n,
      _ => {
        error!(
          "insert_frags: invalid fragment_starting_num {:?}",
          datafrag.fragment_starting_num
        );
        return false;
      }
    };
    let start_frag_from_0 = fragment_starting_num - 1;
    if start_frag_from_0 + frags_in_submessage > self.fragment_count {
      error!(
        "insert_frags: fragment span out of bounds: start={fragment_starting_num} \
         count={frags_in_submessage} total={}",
        self.fragment_count
      );
      return false;
    }

    // The last fragment of a sample may be smaller than the others.
    let from_byte = start_frag_from_0 * frag_size;
    let to_before_byte = min(from_byte + frags_in_submessage * frag_size, self.data_size);
    let Some(data) = to_before_byte
      .checked_sub(from_byte)
      .and_then(|len| datafrag.serialized_payload.get(..len))
    else {
      error!(
        "Received DATAFRAG too small. fragment_starting_num={} out of fragment_count={}, \
         frags_in_submessage={}, frag_size={} but payload length = {}. Original data_size={}",
        fragment_starting_num,
        self.fragment_count,
        frags_in_submessage,
        frag_size,
        datafrag.serialized_payload.len(),
        datafrag.data_size,
      );
      return false;
    };
    let mut is_new = false;
    for (fragment, bytes) in data.chunks(frag_size).enumerate() {
      if self.received_bitmap.get(start_frag_from_0 + fragment) == Some(false) {
        self
          .memory
          .write(from_byte + fragment * frag_size, bytes);
        self.received_bitmap.set(start_frag_from_0 + fragment, true);
        is_new = true;
      }
    }
    if is_new {
      self.modified_at = Instant::now();
    }
    true
  }

  // Memory of the library that the unfinished sample takes.
  fn own_bytes(&self) -> usize {
    let data = match self.memory {
      Memory::Own(_) => self.data_size,
      Memory::Lent { .. } => 0,
    };
    BUFFER_BYTES + self.fragment_count / 8 + data
  }

  pub fn is_complete(&self) -> bool {
    self.received_bitmap.all() // return if all are received
  }

  // Tells the owner of lent memory how far the sample is without a gap, if that is further
  // than before.
  fn report_arrival(&mut self, writer: GUID, sequence_number: SequenceNumber) {
    let Memory::Lent {
      encapsulation,
      payload,
    } = &mut self.memory
    else {
      return;
    };
    let before = self.complete_fragments;
    while self.received_bitmap.get(self.complete_fragments) == Some(true) {
      self.complete_fragments += 1;
    }
    let bytes = self.complete_fragments * usize::from(self.fragment_size);
    if self.complete_fragments > before && bytes > ENCAPSULATION_LEN {
      payload.arrived(&PartialArrival {
        writer,
        sequence_number,
        source_timestamp: self.stated.source_timestamp,
        encapsulation: *encapsulation,
        complete_bytes: bytes.min(self.data_size) - ENCAPSULATION_LEN,
      });
    }
  }
}

// Upper bound on the number of concurrent (incomplete) reassembly buffers kept
// per writer. Fragments belonging to one sample normally arrive back-to-back,
// so only a handful of samples are ever mid-reassembly at once; this cap is far
// above that. Its purpose is to bound memory when samples never complete, e.g.
// under best-effort overload where fragments are dropped: without it, one
// incomplete `AssemblyBuffer` (a full sample-sized allocation) accrues per lost
// sample and is only reclaimed by a 10 s idle timeout, growing to gigabytes.
// When exceeded we evict the oldest (lowest sequence number) buffer, which
// under best effort is lost anyway and under reliable will be re-requested.
const MAX_ASSEMBLY_BUFFERS: usize = 128;

// What each unfinished sample counts at least: then a Reader has at most 1,024 of 4 MiB,
// and to look for the Writer with the most takes microseconds.
const BUFFER_BYTES: usize = 4096;

// A bitmap of 1 MiB. A sample of 4 GiB in fragments of 1 KiB has half as many.
const MAX_FRAGMENTS: usize = 8 * 1024 * 1024;

// Assembles fragments from a single (remote) Writer
// So there is only one sequence of SNs
pub(crate) struct FragmentAssembler {
  assembly_buffers: BTreeMap<SequenceNumber, AssemblyBuffer>,
  // Whether the owning reader is Reliable. This decides which buffer to drop
  // when a limit is exceeded (see `evict`).
  reliable: bool,
  // The sum of the buffers' `own_bytes`.
  own_bytes: usize,
}

impl fmt::Debug for FragmentAssembler {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    f.debug_struct("FragmentAssembler - fields omitted")
      // insert field printing here, if you really need it.
      .finish()
  }
}

impl FragmentAssembler {
  pub fn new(reliable: bool) -> Self {
    debug!("new FragmentAssembler. reliable = {reliable}");
    Self {
      assembly_buffers: BTreeMap::new(),
      reliable,
      own_bytes: 0,
    }
  }

  // Returns completed DDSData and what was stated with it, when complete, and
  // disposes the assembly buffer. A writer need not repeat that with each
  // fragment: Cyclone DDS omits the timestamp when it repairs, and sends the inline
  // QoS with the first fragment only.
  pub fn new_datafrag(
    &mut self,
    writer: GUID,
    datafrag: &DataFrag,
    flags: BitFlags<DATAFRAG_Flags>,
    stated: StatedOnce,
    lender: &Lender,
  ) -> Option<(DDSData, StatedOnce)> {
    let writer_sn = datafrag.writer_sn;
    let is_key = flags.contains(DATAFRAG_Flags::Key);

    let sn = datafrag.writer_sn;
    let is_first = match self.assembly_buffers.entry(sn) {
      Entry::Vacant(v) => {
        let Some(buf) = AssemblyBuffer::new(datafrag, is_key, lender) else {
          error!("new_datafrag: failed to create AssemblyBuffer for {sn:?}");
          return None;
        };
        self.own_bytes += buf.own_bytes();
        v.insert(buf);
        true
      }
      Entry::Occupied(_) => false,
    };

    let Some(assembly_buffer) = self.assembly_buffers.get_mut(&sn) else {
      error!("new_datafrag: AssemblyBuffer missing for {sn:?}");
      return None;
    };

    if !assembly_buffer.insert_frags(datafrag) {
      error!("new_datafrag: rejected invalid DATAFRAG for {sn:?}");
      // What it claimed about its sample is not to be relied on.
      if is_first {
        self.remove(sn);
      }
      return None;
    }

    assembly_buffer.stated = assembly_buffer.stated.or(stated);

    if assembly_buffer.is_complete() {
      debug!("new_datafrag: COMPLETED FRAGMENT");
      if let Some(assembly_buffer) = self.remove(writer_sn) {
        // Return what we have assembled.
        let stated = assembly_buffer.stated;
        let dds_data = assembly_buffer
          .memory
          .into_dds_data(assembly_buffer.data_size, is_key)
          .inspect_err(|e| error!("Deserializing SerializedPayload from DATAFRAG: {e:?}"))
          .ok()?;
        Some((dds_data, stated)) // completed data from fragments
      } else {
        error!("Assembly buffer mysteriously lost");
        None
      }
    } else {
      debug!("new_dataFrag: FRAGMENT NOT COMPLETED YET");
      assembly_buffer.report_arrival(writer, sn);
      None
    }
  }

  fn remove(&mut self, sn: SequenceNumber) -> Option<AssemblyBuffer> {
    let removed = self.assembly_buffers.remove(&sn)?;
    self.own_bytes -= removed.own_bytes();
    Some(removed)
  }

  // Discards one unfinished sample.
  //
  // Which one depends on reliability:
  //  * Reliable: the reader delivers strictly in order, so it must complete the
  //    LOWEST sequence number first; that buffer is exactly the one blocking
  //    progress. Dropping it would livelock, because a writer that bursts many
  //    large samples ahead (e.g. Connext) would make the reader perpetually evict
  //    the very sample it is waiting for. So evict the HIGHEST (newest) sequence
  //    number instead; the writer keeps unacked samples in its history and
  //    re-sends them once we catch up.
  //  * Best effort: there is no retransmission, so a low incomplete buffer is
  //    lost anyway. Evict the OLDEST (lowest SN) to free room for newer samples
  //    that may still complete.
  fn evict(&mut self) {
    let evicted = if self.reliable {
      self.assembly_buffers.pop_last()
    } else {
      self.assembly_buffers.pop_first()
    };
    self.own_bytes -= evicted.map_or(0, |(_, buffer)| buffer.own_bytes());
  }

  // Discards the unfinished samples before this one.
  fn discard_before(&mut self, first: SequenceNumber) {
    let kept = self.assembly_buffers.split_off(&first);
    for discarded in std::mem::replace(&mut self.assembly_buffers, kept).into_values() {
      self.own_bytes -= discarded.own_bytes();
    }
  }

  // Whether there are more unfinished samples than a Writer may have.
  fn has_too_many(&self) -> bool {
    self.assembly_buffers.len() > MAX_ASSEMBLY_BUFFERS
  }

  /// Whether there is no unfinished sample.
  pub fn is_empty(&self) -> bool {
    self.assembly_buffers.is_empty()
  }

  pub fn garbage_collect(&mut self, max_age: Duration) {
    let own_bytes = &mut self.own_bytes;
    self.assembly_buffers.retain(|sn, ab| {
      let retain = ab.modified_at.elapsed() < max_age;
      if !retain {
        info!("AssemblyBuffer dropping {sn:?}");
        *own_bytes -= ab.own_bytes();
      }
      retain
    });
  }

  // pub fn partially_received_sequence_numbers_iterator(&self) -> Box<dyn
  // Iterator<Item=SequenceNumber>> {   // Since we should only know about SNs
  // via DATAFRAG messages   // and AssemblyBuffers are removed immediately on
  // completion,   // the list should be just the list of current
  // AssemblyBuffers   self.assembly_buffers.keys()
  // }

  pub fn is_partially_received(&self, sn: SequenceNumber) -> bool {
    self.assembly_buffers.contains_key(&sn)
    // assembly buffers map contains a key (SN) if and only if we have some
    // frags but not all
  }

  pub fn missing_frags_for(
    &self,
    seq: SequenceNumber,
  ) -> Box<dyn '_ + Iterator<Item = FragmentNumber>> {
    match self.assembly_buffers.get(&seq) {
      None => Box::new(iter::empty()),
      Some(ab) => {
        let iter = (0..ab.fragment_count)
          .filter(move |f| !ab.received_bitmap.get(*f).unwrap_or(true))
          .map(|f| FragmentNumber::new((f + 1).try_into().unwrap()));
        Box::new(iter)
      }
    }
  }
}

/// The fragment assemblers of a Reader, with a limit for all of them together.
#[derive(Debug, Default)]
pub(crate) struct FragmentAssemblers {
  by_writer: BTreeMap<GUID, FragmentAssembler>,
  own_bytes: usize,
  // Unfinished samples that were discarded for a limit of a Writer or of the Reader, until
  // `take_evicted`.
  evicted: usize,
}

impl FragmentAssemblers {
  /// As [`FragmentAssembler::new_datafrag`], for a Reader that is Reliable or not.
  ///
  /// When the unfinished samples need more than the limit of `lender`, the Writer with
  /// the most of it loses one: what one Writer claims does not cost another its samples.
  pub fn new_datafrag(
    &mut self,
    writer: GUID,
    reliable: bool,
    datafrag: &DataFrag,
    flags: BitFlags<DATAFRAG_Flags>,
    stated: StatedOnce,
    lender: impl FnOnce() -> Lender,
  ) -> Option<(DDSData, StatedOnce)> {
    let assembler = self
      .by_writer
      .entry(writer)
      .or_insert_with(|| FragmentAssembler::new(reliable));
    let is_first = !assembler.is_partially_received(datafrag.writer_sn);
    let lender = if is_first { lender() } else { Lender::default() };
    let before = assembler.own_bytes;
    let completed = assembler.new_datafrag(writer, datafrag, flags, stated, &lender);
    // Only a new sample can exceed a limit.
    if is_first && assembler.has_too_many() {
      assembler.evict();
      self.evicted += 1;
    }
    self.own_bytes = self.own_bytes - before + assembler.own_bytes;
    if assembler.is_empty() {
      self.by_writer.remove(&writer);
    }
    if is_first {
      self.evict_down_to(lender.limits().max_total_bytes);
    }
    completed
  }

  fn evict_down_to(&mut self, max_bytes: usize) {
    while self.own_bytes > max_bytes {
      if self.evict() == 0 {
        break;
      }
      self.evicted += 1;
    }
  }

  /// Discards an unfinished sample of the Writer with the most memory, and returns the
  /// bytes that this frees.
  pub fn evict(&mut self) -> usize {
    let most = self
      .by_writer
      .iter_mut()
      .max_by_key(|(_, fa)| fa.own_bytes);
    let Some((&writer, fa)) = most else { return 0 };
    let before = fa.own_bytes;
    fa.evict();
    let freed = before - fa.own_bytes;
    self.own_bytes -= freed;
    if fa.is_empty() {
      self.by_writer.remove(&writer);
    }
    freed
  }

  /// How many unfinished samples [`new_datafrag`](Self::new_datafrag) has discarded for a
  /// limit since the last call.
  pub fn take_evicted(&mut self) -> usize {
    std::mem::take(&mut self.evicted)
  }

  pub fn own_bytes(&self) -> usize {
    self.own_bytes
  }

  /// The unfinished samples.
  pub fn count(&self) -> usize {
    self.by_writer.values().map(|fa| fa.assembly_buffers.len()).sum()
  }

  pub fn get(&self, writer: GUID) -> Option<&FragmentAssembler> {
    self.by_writer.get(&writer)
  }

  /// Discards the unfinished samples of a Writer before this one: the Writer does not
  /// offer them any more, or the Reader has them.
  pub fn discard_before(&mut self, writer: GUID, first: SequenceNumber) {
    let Some(fa) = self.by_writer.get_mut(&writer) else {
      return;
    };
    let before = fa.own_bytes;
    fa.discard_before(first);
    self.own_bytes -= before - fa.own_bytes;
    if fa.is_empty() {
      self.by_writer.remove(&writer);
    }
  }

  pub fn remove(&mut self, writer: GUID) {
    let removed = self.by_writer.remove(&writer);
    self.own_bytes -= removed.map_or(0, |fa| fa.own_bytes);
  }

  pub fn garbage_collect(&mut self, max_age: Duration) {
    self.by_writer.retain(|writer, fa| {
      debug!("AssemblyBuffer GC writer {writer:?}");
      fa.garbage_collect(max_age);
      // Also of Writers that are not matched and therefore never removed: those of
      // builtin topics, of which everything is accepted.
      !fa.is_empty()
    });
    self.own_bytes = self.by_writer.values().map(|fa| fa.own_bytes).sum();
  }
}

#[cfg(test)]
mod tests {
  use std::{sync::Arc, time::Duration};

  use bytes::Bytes;
  use enumflags2::BitFlags;

  use super::{AssemblyBuffer, FragmentAssembler, FragmentAssemblers, Memory, StatedOnce};
  use crate::{
    dds::{
      ddsdata::DDSData,
      lent::{Lender, LentMemory, SampleMemory},
    },
    messages::submessages::submessages::{DATAFRAG_Flags, DataFrag},
    structure::{
      guid::{EntityId, GuidPrefix, GUID},
      sequence_number::{FragmentNumber, SequenceNumber},
    },
  };

  // Build a DATAFRAG submessage carrying the contiguous run of `k` fragments
  // starting at 1-based `start`, with the given payload bytes.
  fn datafrag(start: u32, k: u16, frag_size: u16, data_size: u32, payload: Vec<u8>) -> DataFrag {
    DataFrag {
      fragment_starting_num: FragmentNumber::new(start),
      fragments_in_submessage: k,
      fragment_size: frag_size,
      data_size,
      serialized_payload: Bytes::from(payload),
      ..Default::default()
    }
  }

  fn own(buffer: AssemblyBuffer) -> Vec<u8> {
    match buffer.memory {
      Memory::Own(bytes) => bytes.to_vec(),
      Memory::Lent { .. } => panic!("lent"),
    }
  }

  #[test]
  fn an_unfinished_sample_expires_when_no_fragment_came_for_too_long() {
    let mut assemblers = FragmentAssemblers::default();
    let writer = GUID::new(GuidPrefix::UNKNOWN, EntityId::MIN);
    let first = DataFrag {
      writer_sn: SequenceNumber::new(1),
      ..datafrag(1, 1, 1024, 2048, vec![7; 1024])
    };
    let flags = BitFlags::<DATAFRAG_Flags>::empty();
    let is_unfinished = |assemblers: &FragmentAssemblers| {
      let assembler = assemblers.get(writer);
      assembler.is_some_and(|assembler| assembler.is_partially_received(SequenceNumber::new(1)))
    };
    assemblers.new_datafrag(writer, true, &first, flags, StatedOnce::default(), Lender::default);
    assemblers.garbage_collect(Duration::from_secs(10));
    assert!(is_unfinished(&assemblers));
    std::thread::sleep(Duration::from_millis(2));
    assemblers.garbage_collect(Duration::from_millis(1));
    assert!(!is_unfinished(&assemblers));
    assert_eq!(assemblers.own_bytes, 0);
  }

  // A DATAFRAG that packs K > 1 fragments in one submessage must reassemble the
  // same bytes as one-fragment-per-submessage would. This exercises the
  // adaptive-packing writer path against the (unchanged) receiver.
  #[test]
  fn reassemble_multi_fragment_datafrag() {
    let frag_size = 1024u16;
    let data_size = 2600u32; // 3 fragments: 1024, 1024, 552
    let whole: Vec<u8> = (0..data_size as usize).map(|i| (i % 251) as u8).collect();

    // First submessage packs fragments 1 and 2 (K = 2, 2048 payload bytes).
    let first = datafrag(1, 2, frag_size, data_size, whole[0..2048].to_vec());
    let mut ab = AssemblyBuffer::new(&first, false, &Lender::default()).expect("valid first fragment");
    assert!(!ab.is_complete());
    ab.insert_frags(&first);
    assert!(!ab.is_complete(), "still missing the tail fragment");

    // Trailing submessage carries the shorter final fragment 3 (552 bytes).
    let tail = datafrag(3, 1, frag_size, data_size, whole[2048..2600].to_vec());
    ab.insert_frags(&tail);
    assert!(ab.is_complete(), "all fragments received");
    assert_eq!(own(ab), whole, "reassembled bytes must match the original sample");
  }

  // A single DATAFRAG carrying the whole sample in one multi-fragment run.
  #[test]
  fn reassemble_single_submessage_all_fragments() {
    let frag_size = 512u16;
    let data_size = 1500u32; // 3 fragments: 512, 512, 476
    let whole: Vec<u8> = (0..data_size as usize).map(|i| (i % 97) as u8).collect();

    let all = datafrag(1, 3, frag_size, data_size, whole.clone());
    let mut ab = AssemblyBuffer::new(&all, false, &Lender::default()).expect("valid fragment set");
    ab.insert_frags(&all);
    assert!(ab.is_complete());
    assert_eq!(own(ab), whole);
  }

  // Malformed span (starting at last fragment but claiming multiple fragments)
  // must not panic and must not falsely complete reassembly.
  #[test]
  fn reject_fragment_span_beyond_total() {
    let frag_size = 256u16;
    let data_size = 512u32; // 2 fragments total
    let bad = datafrag(2, 2, frag_size, data_size, vec![0u8; 256]);
    let mut ab = AssemblyBuffer::new(&bad, false, &Lender::default()).expect("buffer for valid data_size");
    assert!(!ab.insert_frags(&bad));
    assert!(!ab.is_complete());
  }

  #[test]
  fn fragment_assembler_rejects_span_beyond_total() {
    let frag_size = 256u16;
    let data_size = 512u32;
    let bad = datafrag(2, 2, frag_size, data_size, vec![0u8; 256]);
    let mut fa = FragmentAssembler::new(true);
    assert!(fa
      .new_datafrag(GUID::GUID_UNKNOWN, &bad, BitFlags::<DATAFRAG_Flags>::empty(), StatedOnce::default(), &Lender::default())
      .is_none());
  }

  // The first of several fragments of sample `number`.
  fn first_of(number: i64, frag_size: u16, data_size: u32) -> DataFrag {
    DataFrag {
      writer_sn: SequenceNumber::new(number),
      ..datafrag(1, 1, frag_size, data_size, vec![7; frag_size.into()])
    }
  }

  fn insert(fas: &mut FragmentAssemblers, writer: GUID, reliable: bool, fragment: &DataFrag) {
    let none = BitFlags::<DATAFRAG_Flags>::empty();
    let completed = fas.new_datafrag(writer, reliable, fragment, none, StatedOnce::default(), Lender::default);
    assert!(completed.is_none());
  }

  fn writer(number: u8) -> GUID {
    GUID::new(GuidPrefix::new(&[number; 12]), EntityId::UNKNOWN)
  }

  // One fragment each of samples that claim 60 MiB take two samples' memory at most.
  #[test]
  fn what_unfinished_samples_claim_is_bounded_in_bytes() {
    for reliable in [false, true] {
      let mut fas = FragmentAssemblers::default();
      for number in 1..=10 {
        insert(&mut fas, writer(1), reliable, &first_of(number, 60_000, 60 << 20));
      }
      let kept: Vec<i64> = (1..=10)
        .filter(|number| {
          let sn = SequenceNumber::new(*number);
          fas.get(writer(1)).unwrap().is_partially_received(sn)
        })
        .collect();
      // A Reliable reader needs the oldest first, and the others come again.
      assert_eq!(kept, if reliable { [1, 2] } else { [9, 10] });
    }
  }

  // The bound is for all writers together, the bitmap of small fragments counts, and
  // the writer that claims most is the one that loses a sample.
  #[test]
  fn what_many_writers_claim_is_bounded_and_costs_no_other_writer_its_sample() {
    let mut fas = FragmentAssemblers::default();
    insert(&mut fas, writer(1), true, &first_of(1, 1_000, 2_000));
    for number in 2..=200 {
      for sample in 1..=2 {
        insert(&mut fas, writer(number), true, &first_of(sample, 10, 50 << 20));
      }
      let max = Lender::default().limits().max_total_bytes;
      assert!(fas.own_bytes <= max, "{} bytes", fas.own_bytes);
      let sum: usize = fas.by_writer.values().map(|fa| fa.own_bytes).sum();
      assert_eq!(fas.own_bytes, sum);
    }
    let first = fas.get(writer(1)).expect("no writer but the first one has less");
    assert!(first.is_partially_received(SequenceNumber::new(1)));
    for number in 1..=200 {
      fas.remove(writer(number));
    }
    assert_eq!(fas.own_bytes, 0);
    assert!(fas.by_writer.is_empty());
  }

  // Anybody can send fragments to the built-in readers.
  #[test]
  fn fragments_of_discovery_data_take_4_mib_at_most() {
    let mut fas = FragmentAssemblers::default();
    let none = BitFlags::<DATAFRAG_Flags>::empty();
    for number in 1..=250 {
      for (sample, size) in [(1, 300 << 10), (2, 200 << 10), (3, 100)] {
        let fragment = first_of(sample, 50, size);
        fas.new_datafrag(writer(number), true, &fragment, none, StatedOnce::default(), Lender::built_in);
      }
      assert!(fas.own_bytes <= 4 << 20, "{} bytes", fas.own_bytes);
    }
    let mut kept = fas.by_writer.values();
    assert!(kept.all(|fa| !fa.is_partially_received(SequenceNumber::new(1))), "too large");
  }

  // A sample of any length, of which the application wants nothing but to know of it.
  #[test]
  fn a_sample_that_the_application_discards_takes_no_memory() {
    struct Discards;

    impl LentMemory for Discards {
      fn bytes(&mut self) -> &mut [u8] {
        &mut []
      }

      fn write(&mut self, _from: usize, _data: &[u8]) {}

      fn finish(self: Box<Self>) {}
    }

    impl SampleMemory for Discards {
      fn lend(&self, _len: usize) -> Option<Box<dyn LentMemory>> {
        Some(Box::new(Discards))
      }
    }

    let lender = || Lender(Some(Arc::new(Discards)));
    let mut fas = FragmentAssemblers::default();
    let count = 100_u32;
    let data_size = count << 20;
    for number in 1..=count * 32 {
      let fragment = datafrag(number, 1, 1 << 15, data_size, vec![7; 1 << 15]);
      let none = BitFlags::<DATAFRAG_Flags>::empty();
      let completed = fas.new_datafrag(writer(1), true, &fragment, none, StatedOnce::default(), lender);
      assert_eq!(completed.is_some(), number == count * 32);
      if let Some((data, _)) = completed {
        assert_eq!(data.payload_size(), data_size as usize);
      }
      assert!(fas.own_bytes < 8192);
    }
  }

  // Memory of an application, with what an older sample left in it.
  struct Used(Vec<u8>);

  impl LentMemory for Used {
    fn bytes(&mut self) -> &mut [u8] {
      &mut self.0
    }

    fn finish(self: Box<Self>) {}
  }

  struct Lends;

  impl SampleMemory for Lends {
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
      Some(Box::new(Used(vec![0xEE; len])))
    }
  }

  fn lends() -> Lender {
    Lender(Some(Arc::new(Lends)))
  }

  fn lent(data: &DDSData) -> ([u8; 2], [u8; 2], Vec<u8>) {
    let DDSData::Data {
      serialized_payload,
      lent: Some(lent),
    } = data
    else {
      panic!("not lent");
    };
    let payload = lent.with(|memory| memory.take().unwrap().bytes().to_vec());
    (
      serialized_payload.representation_identifier.bytes,
      serialized_payload.representation_options,
      payload,
    )
  }

  #[test]
  fn a_sample_is_put_together_in_memory_that_is_lent() {
    // Fragments that end before, within and after the encapsulation, in any order.
    for frag_size in [1, 2, 3, 4, 5, 7, 64, 100] {
      let whole: Vec<u8> = (0..100).collect();
      let count = 100_u32.div_ceil(u32::from(frag_size));
      let mut fa = FragmentAssembler::new(true);
      let mut done = None;
      for number in (1..=count).rev() {
        let from = (number as usize - 1) * usize::from(frag_size);
        let to = (from + usize::from(frag_size)).min(100);
        let fragment = datafrag(number, 1, frag_size, 100, whole[from..to].to_vec());
        assert!(done.is_none());
        done = fa.new_datafrag(GUID::GUID_UNKNOWN, &fragment, BitFlags::empty(), StatedOnce::default(), &lends());
      }
      let (data, _) = done.expect("complete");
      assert_eq!(data.payload_size(), 100);
      assert_eq!(lent(&data), ([0, 1], [2, 3], whole[4..].to_vec()));
      assert!(fa.assembly_buffers.is_empty());
    }
  }

  #[test]
  fn unfinished_samples_that_the_writer_withdraws_are_discarded() {
    let mut fas = FragmentAssemblers::default();
    let (one, other) = (writer(1), writer(2));
    for number in 1..=3 {
      insert(&mut fas, one, true, &first_of(number, 50, 100));
    }
    insert(&mut fas, other, true, &first_of(1, 50, 100));
    let each = fas.own_bytes / 4;
    fas.discard_before(one, SequenceNumber::new(3));
    assert_eq!(fas.own_bytes, 2 * each);
    fas.discard_before(one, SequenceNumber::new(4));
    assert!(fas.get(one).is_none() && fas.get(other).is_some());
    fas.discard_before(one, SequenceNumber::new(9));
    assert_eq!(fas.own_bytes, each);
  }

  #[test]
  fn nothing_of_an_older_sample_is_left_in_memory_that_is_lent() {
    let mut fa = FragmentAssembler::new(true);
    let mut insert = |fragment: &DataFrag| {
      fa.new_datafrag(GUID::GUID_UNKNOWN, fragment, BitFlags::empty(), StatedOnce::default(), &lends())
        .is_some()
    };
    assert!(!insert(&datafrag(1, 1, 50, 100, vec![1; 50])));
    // Too short, of another size, of another sample size: each would leave a hole.
    assert!(!insert(&datafrag(2, 1, 50, 100, vec![1; 49])));
    assert!(!insert(&datafrag(2, 1, 49, 100, vec![1; 49])));
    assert!(!insert(&datafrag(1, 1, 50, 50, vec![1; 50])));
    assert!(insert(&datafrag(2, 1, 50, 100, vec![1; 50])));
    // And one that begins a sample with a lie is forgotten with it.
    assert!(!insert(&datafrag(1, 2, 50, 100, vec![1; 99])));
    assert!(fa.assembly_buffers.is_empty());
  }

  // Its bytes may have been sent on before the sample is complete.
  #[test]
  fn a_fragment_that_comes_again_changes_no_byte() {
    let mut fa = FragmentAssembler::new(true);
    let mut insert = |start, count, content| {
      let fragment = datafrag(start, count, 50, 150, vec![content; 50 * usize::from(count)]);
      fa.new_datafrag(GUID::GUID_UNKNOWN, &fragment, BitFlags::empty(), StatedOnce::default(), &lends())
    };
    assert!(insert(2, 1, 1).is_none());
    assert!(insert(1, 2, 2).is_none());
    let (data, _) = insert(1, 3, 3).expect("complete");
    let payload = [vec![2; 46], vec![1; 50], vec![3; 50]].concat();
    assert_eq!(lent(&data), ([2, 2], [2, 2], payload));
  }

  #[test]
  fn a_key_and_a_sample_without_an_encapsulation_are_not_put_into_lent_memory() {
    struct Refuses;

    impl SampleMemory for Refuses {
      fn lend(&self, _len: usize) -> Option<Box<dyn LentMemory>> {
        panic!("asked for memory")
      }
    }

    let refuse = Lender(Some(Arc::new(Refuses)));
    let mut fa = FragmentAssembler::new(true);
    let key = datafrag(1, 1, 50, 50, vec![1; 50]);
    let (data, _) = fa
      .new_datafrag(GUID::GUID_UNKNOWN, &key, DATAFRAG_Flags::Key.into(), StatedOnce::default(), &refuse)
      .expect("complete");
    assert!(matches!(data, DDSData::DisposeByKey { .. }));
    let short = datafrag(1, 1, 3, 3, vec![1; 3]);
    assert!(fa
      .new_datafrag(GUID::GUID_UNKNOWN, &short, BitFlags::empty(), StatedOnce::default(), &refuse)
      .is_none());
  }
}
