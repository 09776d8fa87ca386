//! DDS readers of raw payloads that give access to each payload in the receive buffer, without a copy, and
//! the flag that the DDS library raises when a sample arrives.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::thread::{self, Thread};

use bytes::Bytes;

use super::rustdds::no_key::{Decode, DeserializerAdapter, SimpleDataReader};
use super::rustdds::{DataReaderStatus, InstancePayload, RepresentationIdentifier, StatusEvented};
use crate::model::{Encapsulation, Guid, KeyedPayload, PartialSample, SampleKey, SourceTimestamp};

pub use super::rustdds::{AssemblyLimits, LentMemory, PartialArrival, SampleMemory};

/// One take in so many tries the last reader first, so that a flood of samples at the first reader cannot
/// block it.
const LAST_READER_FIRST_EVERY: u64 = 32;

/// The payload of a sample that was taken from a reader.
pub enum Payload {
    /// In the library's receive buffer, which it keeps in memory until it is dropped.
    Bytes(Bytes),
    /// In memory that was [lent](RawReader::lend_memory) for it, in which the DDS library assembles a large
    /// sample; that saves a copy.
    Lent(Box<dyn LentMemory>),
}

impl Payload {
    /// The bytes of the payload.
    pub fn bytes(&mut self) -> &[u8] {
        match self {
            Self::Bytes(bytes) => bytes,
            Self::Lent(memory) => memory.bytes(),
        }
    }
}

/// The largest sample of a topic whose samples have at most some KiB.
const SMALL_SAMPLE_BYTES: usize = 1 << 20;

/// The complete samples of such a topic that the DDS library keeps, whether they were taken or not: the
/// newest of this size. With the depth of the reader's history alone, forged ones would take 512 MiB.
pub(super) const KEPT_SMALL_SAMPLES_BYTES: usize = 4 << 20;

/// The limits of topics whose samples have at most some KiB: graph entries, probes and their responses,
/// requests. Any host on the network can send fragments that claim larger samples.
struct SmallSamples {
    max_bytes: usize,
    max_kept_bytes: Option<usize>,
}

impl SampleMemory for SmallSamples {
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
        (len > self.max_bytes).then(|| Box::new(Discarded) as _)
    }

    fn limits(&self) -> AssemblyLimits {
        AssemblyLimits {
            // With the encapsulation header.
            max_sample_bytes: self.max_bytes + 4,
            max_total_bytes: 4 * self.max_bytes,
            max_kept_bytes: self.max_kept_bytes,
        }
    }
}

/// Memory for a sample that is too large: its bytes are discarded as they arrive. It becomes complete like
/// any other, or its RELIABLE writer would send it for ever, and nothing that it writes later would be taken.
struct Discarded;

impl LentMemory for Discarded {
    fn bytes(&mut self) -> &mut [u8] {
        &mut []
    }

    fn write(&mut self, _from: usize, _data: &[u8]) {}

    fn finish(self: Box<Self>) {}
}

/// The writer of a sample, its sequence number there, its source timestamp, and what it says of its key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOrigin {
    /// The time at which the publisher wrote the sample, by the publisher's clock.
    pub source_timestamp: SourceTimestamp,
    /// The publisher's writer.
    pub writer: Guid,
    /// The writer's sequence number of the sample.
    pub sequence: i64,
    /// What it says of its key. A sample that disposes or unregisters a key has the key as its payload, or
    /// none.
    pub key: SampleKey,
}

/// The result of [`RawReader::take`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Take {
    /// A sample, whose payload was passed to the callback.
    Sample(SampleOrigin),
    /// A sample whose encapsulation DDS does not define; it was discarded without a call of the callback.
    Malformed,
    /// No sample was waiting.
    Empty,
}

/// The result of [`RawReader::take_payload`].
pub enum TakePayload {
    /// A sample, its payload and the payload's encapsulation.
    Sample(SampleOrigin, Payload, Encapsulation),
    /// A sample whose encapsulation DDS does not define; it was discarded.
    Malformed,
    /// No sample was waiting.
    Empty,
}

impl TakePayload {
    /// Calls `read` with the payload, if there is one.
    pub fn read(self, read: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        match self {
            Self::Sample(origin, mut payload, encapsulation) => {
                read(payload.bytes(), encapsulation);
                Take::Sample(origin)
            }
            Self::Malformed => Take::Malformed,
            Self::Empty => Take::Empty,
        }
    }
}

/// A change of the writers that a reader is matched with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReaderEvent {
    /// A writer was matched or unmatched.
    Matched {
        /// The number of writers that are matched now.
        writers: u64,
    },
    /// A writer offers a weaker QoS than the reader requests.
    Incompatible {
        /// The writer.
        writer: Guid,
    },
}

/// A DDS reader of raw payloads.
pub struct RawReader {
    pub(super) inner: SimpleDataReader<Received, PayloadDecoder>,
    pub(super) guid: Guid,
}

impl RawReader {
    /// The reader's GUID.
    pub fn guid(&self) -> Guid {
        self.guid
    }

    /// Makes the next arrival wake `waker` once, and clears the arrivals that are signalled so far. After
    /// this call take until [`Take::Empty`] before the thread sleeps; otherwise it sleeps although a sample
    /// waits.
    pub fn arm(&self, waker: &Waker) {
        self.inner.set_waker(Some(waker.clone()));
        self.inner.drain_read_notifications();
    }

    /// Makes this BEST_EFFORT reader ignore each RELIABLE writer as soon as the RELIABLE reader of the same
    /// topic in this participant receives from that writer.
    pub fn ignore_reliable_writers(&self) {
        self.inner.ignore_reliable_writers();
    }

    /// Makes the DDS library assemble fragmented samples of the topic in memory that `memory` lends; when it
    /// lends none, the library uses its own. The setting applies to the topic: of two readers of the topic in
    /// one participant, one must [ignore](Self::ignore_reliable_writers) the samples that the other takes.
    pub fn lend_memory(&self, memory: Arc<dyn SampleMemory>) {
        self.inner.set_sample_memory(memory);
    }

    /// Limits the memory for unfinished samples of the topic to 1 MiB a sample and 4 MiB in all, and that for
    /// complete ones to 4 MiB. A larger sample is taken without its bytes, as an empty [`Payload::Lent`].
    pub fn expect_small_samples(&self) {
        self.lend_memory(Arc::new(SmallSamples {
            max_bytes: SMALL_SAMPLE_BYTES,
            max_kept_bytes: Some(KEPT_SMALL_SAMPLES_BYTES),
        }));
    }

    /// Limits the memory for unfinished samples of the topic to `max_bytes` a sample and four times that in
    /// all; the history of the reader limits complete ones. A larger sample is taken without its bytes, as an
    /// empty [`Payload::Lent`].
    pub fn expect_samples_up_to(&self, max_bytes: usize) {
        self.lend_memory(Arc::new(SmallSamples { max_bytes, max_kept_bytes: None }));
    }

    /// Takes the next sample, if one waits, and calls `read` once with its payload and encapsulation.
    ///
    /// Samples of one RELIABLE writer are returned in order and once each.
    pub fn take(&self, read: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_payload().read(read)
    }

    /// Takes the next sample, and returns its payload, also one in [lent memory](Self::lend_memory).
    pub fn take_payload(&self) -> TakePayload {
        match self.inner.try_take_one_with(PayloadDecoder) {
            Ok(Some(change)) => {
                let origin = SampleOrigin {
                    source_timestamp: change
                        .write_options
                        .source_timestamp()
                        .map_or(SourceTimestamp::NONE, |time| SourceTimestamp(time.to_ticks())),
                    writer: Guid(change.writer_guid.to_bytes()),
                    sequence: i64::from(change.sequence_number),
                    key: change.write_options.instance_change().map_or(SampleKey::NONE, |change| {
                        let payload = match change.payload {
                            InstancePayload::Data => KeyedPayload::Data,
                            InstancePayload::Key => KeyedPayload::Key,
                            InstancePayload::Absent => KeyedPayload::Absent,
                        };
                        SampleKey::new(change.key_hash, change.status_info, payload)
                    }),
                };
                let (payload, encapsulation) = change.sample;
                TakePayload::Sample(origin, payload, encapsulation)
            }
            Ok(None) => TakePayload::Empty,
            Err(_) => TakePayload::Malformed,
        }
    }

    /// Returns the next change of the matched writers, if there is one.
    pub fn poll_event(&self) -> Option<ReaderEvent> {
        loop {
            match self.inner.try_recv_status()? {
                DataReaderStatus::SubscriptionMatched { current, .. } => {
                    return Some(ReaderEvent::Matched {
                        writers: u64::try_from(current.count()).unwrap_or(0),
                    });
                }
                DataReaderStatus::RequestedIncompatibleQos { writer, .. } => {
                    return Some(ReaderEvent::Incompatible { writer: Guid(writer.to_bytes()) });
                }
                _ => {}
            }
        }
    }
}

/// A flag that the DDS library raises when a sample has arrived, and the thread to wake then. As a waker it
/// arms readers ([`RawReader::arm`]).
#[derive(Debug)]
pub struct ArrivalFlag {
    raised: AtomicBool,
    /// The thread to unpark; `None` where another thread checks the flag.
    thread: Option<Thread>,
}

impl ArrivalFlag {
    /// Creates a flag that wakes no thread.
    pub fn passive() -> Arc<Self> {
        Arc::new(Self { raised: AtomicBool::new(false), thread: None })
    }

    /// Creates a flag that unparks the calling thread.
    pub fn of_this_thread() -> Arc<Self> {
        Arc::new(Self { raised: AtomicBool::new(false), thread: Some(thread::current()) })
    }

    /// Raises the flag and unparks its thread.
    pub fn raise(&self) {
        self.raised.store(true, Ordering::Release);
        if let Some(thread) = &self.thread {
            thread.unpark();
        }
    }

    /// Clears the flag, and returns whether it was raised.
    pub fn clear(&self) -> bool {
        self.raised.swap(false, Ordering::AcqRel)
    }

    /// Whether the flag is raised.
    pub fn is_raised(&self) -> bool {
        self.raised.load(Ordering::Acquire)
    }
}

impl Wake for ArrivalFlag {
    fn wake(self: Arc<Self>) {
        self.raise();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.raise();
    }
}

/// The one or two readers of a topic, and the flag that makes a poll nearly free while no sample has
/// arrived.
pub struct Inbox {
    /// In the order in which samples are taken from them.
    readers: Vec<RawReader>,
    flag: Arc<ArrivalFlag>,
    waker: Waker,
    takes: Cell<u64>,
}

impl Inbox {
    /// Creates an inbox with one reader; arrivals wake the calling thread.
    pub fn new(reader: RawReader) -> Self {
        let mut inbox = Self::with_flag(ArrivalFlag::of_this_thread());
        inbox.add(reader);
        inbox
    }

    /// Creates an inbox without readers; arrivals raise `flag`, which the caller checks.
    pub fn with_flag(flag: Arc<ArrivalFlag>) -> Self {
        Self { readers: Vec::new(), waker: Waker::from(Arc::clone(&flag)), flag, takes: Cell::new(0) }
    }

    /// Adds a reader, from which samples are taken after the others.
    pub fn add(&mut self, reader: RawReader) {
        self.readers.push(reader);
        // A new reader is not armed yet, so the next take must poll it.
        self.flag.raise();
    }

    /// Removes a reader and returns it.
    pub fn remove(&mut self, reader: Guid) -> Option<RawReader> {
        let place = self.readers.iter().position(|known| known.guid() == reader)?;
        Some(self.readers.remove(place))
    }

    /// The readers.
    pub fn readers(&self) -> &[RawReader] {
        &self.readers
    }

    /// Takes the next sample, like [`RawReader::take`]. After [`Take::Empty`] the thread may `park`: a later
    /// arrival unparks it.
    pub fn take(&self, read: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_from_any().read(read)
    }

    /// Takes the next sample of any reader, like [`RawReader::take_payload`].
    pub fn take_from_any(&self) -> TakePayload {
        if !self.flag.is_raised() {
            return TakePayload::Empty;
        }
        // Once armed, the readers are polled again, for a sample that arrived before they were armed.
        for is_armed in [false, true] {
            let takes = self.takes.get().wrapping_add(1);
            self.takes.set(takes);
            let last_first = takes.is_multiple_of(LAST_READER_FIRST_EVERY);
            for place in 0..self.readers.len() {
                let place = if last_first { self.readers.len() - 1 - place } else { place };
                let take = self.readers[place].take_payload();
                if !matches!(take, TakePayload::Empty) {
                    if is_armed {
                        // Without a wake-up, because this thread checks the flag.
                        self.flag.raised.store(true, Ordering::Release);
                    }
                    return take;
                }
            }
            if !is_armed {
                self.flag.clear();
                self.readers.iter().for_each(|reader| reader.arm(&self.waker));
            }
        }
        TakePayload::Empty
    }
}

/// What the DDS library tells of a sample of which only a part has arrived; number, place and times are to be
/// added.
pub fn partial_sample(arrival: &PartialArrival) -> PartialSample {
    PartialSample {
        writer_guid: Guid(arrival.writer.to_bytes()),
        writer_sequence: arrival.sequence_number.into(),
        source_timestamp: arrival
            .source_timestamp
            .map_or(SourceTimestamp::NONE, |time| SourceTimestamp(time.to_ticks())),
        available: arrival.complete_bytes as u64,
        encapsulation: Encapsulation(arrival.encapsulation),
        ..PartialSample::default()
    }
}

/// Every encapsulation that RTPS and XTypes define (RTPS 2.5 table 10.3, XTypes 1.3 table 60). RustDDS
/// rejects any other, and the bridge counts such a sample as malformed.
static ENCAPSULATIONS: [RepresentationIdentifier; 17] = [
    RepresentationIdentifier::CDR_LE,
    RepresentationIdentifier::CDR_BE,
    RepresentationIdentifier::PL_CDR_LE,
    RepresentationIdentifier::PL_CDR_BE,
    RepresentationIdentifier::XCDR2_LE,
    RepresentationIdentifier::XCDR2_BE,
    RepresentationIdentifier::D_CDR2_LE,
    RepresentationIdentifier::D_CDR2_BE,
    RepresentationIdentifier::PL_XCDR2_LE,
    RepresentationIdentifier::PL_XCDR2_BE,
    RepresentationIdentifier::CDR2_LE,
    RepresentationIdentifier::CDR2_BE,
    RepresentationIdentifier::PL_CDR2_LE,
    RepresentationIdentifier::PL_CDR2_BE,
    RepresentationIdentifier::D_CDR_LE,
    RepresentationIdentifier::D_CDR_BE,
    RepresentationIdentifier::XML,
];

type Received = (Payload, Encapsulation);

/// Passes payloads through RustDDS' deserialization traits: returns the payload, either in the receive buffer
/// or in the memory that was lent for it.
#[derive(Clone, Copy)]
pub(super) struct PayloadDecoder;

/// Another reader of the topic has taken the memory in which the sample was.
#[derive(Debug, thiserror::Error)]
#[error("another reader has taken the payload")]
pub(super) struct MemoryTaken;

impl Decode<'_, Received> for PayloadDecoder {
    type Error = MemoryTaken;

    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> Result<Received, MemoryTaken> {
        self.decode_encapsulated(&Bytes::copy_from_slice(bytes), encoding, [0, 0])
    }

    fn decode_encapsulated(
        self,
        bytes: &Bytes,
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<Received, MemoryTaken> {
        Ok((Payload::Bytes(bytes.clone()), encapsulation(encoding, options)))
    }

    fn decode_lent(
        self,
        memory: &mut Option<Box<dyn LentMemory>>,
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<Received, MemoryTaken> {
        let memory = memory.take().ok_or(MemoryTaken)?;
        Ok((Payload::Lent(memory), encapsulation(encoding, options)))
    }
}

fn encapsulation(encoding: RepresentationIdentifier, options: [u8; 2]) -> Encapsulation {
    let [high, low] = encoding.to_bytes();
    Encapsulation([high, low, options[0], options[1]])
}

impl DeserializerAdapter<Received> for PayloadDecoder {
    type Error = MemoryTaken;
    type Decoded = Received;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCAPSULATIONS
    }

    fn transform_decoded(received: Received) -> Received {
        received
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_small_samples_4_mib_are_assembled_and_larger_ones_are_discarded() {
        let small = SmallSamples { max_bytes: SMALL_SAMPLE_BYTES, max_kept_bytes: None };
        assert_eq!(small.limits().max_total_bytes, 4 << 20);
        assert!(small.lend(SMALL_SAMPLE_BYTES).is_none());
        let mut too_large = small.lend(SMALL_SAMPLE_BYTES + 1).unwrap();
        too_large.write(SMALL_SAMPLE_BYTES, &[7]);
        assert!(too_large.bytes().is_empty());
    }
}
