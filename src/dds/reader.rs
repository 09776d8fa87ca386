//! A DDS reader of raw payloads that gives access to each payload in the receive buffer, without a copy.

use std::sync::Arc;
use std::task::Waker;

use super::lent::{Payload, SampleMemory, SmallSamples};
use super::payload::{PayloadDecoder, RawAdapter, Received};
use super::rustdds::no_key::SimpleDataReader;
use super::rustdds::{DataReaderStatus, StatusEvented};
use crate::model::{Encapsulation, Guid, SourceTimestamp};

/// The writer of a sample, its sequence number there, and its source timestamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOrigin {
    /// The time at which the publisher wrote the sample, by the publisher's clock.
    pub source_timestamp: SourceTimestamp,
    /// The publisher's writer.
    pub writer: Guid,
    /// The writer's sequence number of the sample.
    pub sequence: i64,
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
    /// Whether no sample was waiting.
    pub fn is_empty(&self) -> bool {
        matches!(self, Self::Empty)
    }

    /// Calls `read` with the payload, if there is one.
    pub fn read(self, read: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        match self {
            Self::Sample(origin, payload, encapsulation) => {
                match payload {
                    Payload::Bytes(bytes) => read(&bytes, encapsulation),
                    Payload::Lent(mut memory) => read(memory.bytes(), encapsulation),
                }
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
    pub(super) inner: SimpleDataReader<Received, RawAdapter>,
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

    /// Limits the memory for unfinished samples of the topic to 1 MiB a sample and 4 MiB in all.
    pub fn expect_small_samples(&self) {
        self.lend_memory(Arc::new(SmallSamples));
    }

    /// Takes the next sample, if one waits, and calls `read` once with its payload and encapsulation.
    ///
    /// Samples of one RELIABLE writer are returned in order and once each.
    pub fn take(&self, read: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_payload().read(read)
    }

    /// Like [`take`](Self::take), but returns the payload, also one in [lent memory](Self::lend_memory).
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
