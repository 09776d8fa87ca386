//! A DDS reader that lends each payload while it is still in the receive buffer.

use std::cell::RefCell;
use std::sync::Arc;
use std::task::Waker;

use super::lent::{Lender, Payload, SampleMemory};
use super::payload::{Lend, Raw};
use super::rustdds::no_key::SimpleDataReader;
use super::rustdds::{DataReaderStatus, StatusEvented};
use crate::model::{Encapsulation, Guid, SourceTimestamp};

/// Where a sample comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOrigin {
    /// When the publisher says it was written.
    pub source_timestamp: SourceTimestamp,
    /// The publisher's writer.
    pub writer: Guid,
    /// The sample's number with that writer.
    pub sequence: i64,
}

/// What [`RawReader::take`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Take {
    /// A sample, whose payload was lent.
    Sample(SampleOrigin),
    /// A sample whose encapsulation DDS does not define; nothing was lent, and it is gone.
    Malformed,
    /// Nothing there.
    Empty,
}

/// A change of who a reader is matched with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReaderEvent {
    /// Writers matched at present.
    Matched {
        /// How many.
        writers: u64,
    },
    /// A writer offers less than the reader asks for.
    Incompatible {
        /// The writer.
        writer: Guid,
    },
}

/// A DDS reader of raw payloads.
pub struct RawReader {
    pub(super) inner: SimpleDataReader<(), Raw>,
    pub(super) guid: Guid,
}

impl RawReader {
    /// The reader's GUID.
    pub fn guid(&self) -> Guid {
        self.guid
    }

    /// Arranges for `waker` to be woken once by the next arrival, and forgets arrivals signalled so far. Take
    /// until [`Take::Empty`] after this and before sleeping, or an arrival in between is slept through.
    pub fn arm(&self, waker: &Waker) {
        self.inner.set_waker(Some(waker.clone()));
        self.inner.drain_read_notifications();
    }

    /// Leaves RELIABLE writers to the RELIABLE reader of the same topic in this participant from now on, each
    /// one as soon as that reader receives from it; for a BEST_EFFORT reader.
    pub fn ignore_reliable_writers(&self) {
        self.inner.ignore_reliable_writers();
    }

    /// From now on samples of the topic that arrive in fragments are put together in memory of `memory`, as
    /// far as it lends any. Of two readers of a topic in one participant, one
    /// [ignores](Self::ignore_reliable_writers) what the other takes.
    pub fn lend_memory(&self, memory: Arc<dyn SampleMemory>) {
        self.inner.set_sample_memory(Arc::new(Lender(memory)));
    }

    /// Takes the next sample, lending its payload and encapsulation to `lend` exactly once if there is one.
    ///
    /// Samples of one RELIABLE writer come in order and without repetition. The library's lock on the topic
    /// is held while `lend` runs: it must copy and return.
    pub fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_payload(&mut |payload, encapsulation| {
            payload.with_bytes(|bytes| lend(bytes, encapsulation));
        })
    }

    /// Like [`take`](Self::take), for one who has [lent memory](Self::lend_memory) and wants it back.
    pub fn take_payload(&self, receive: &mut dyn FnMut(Payload<'_>, Encapsulation)) -> Take {
        let lend = RefCell::new(receive);
        match self.inner.try_take_one_with(Lend(&lend)) {
            Ok(Some(change)) => Take::Sample(SampleOrigin {
                source_timestamp: change
                    .write_options
                    .source_timestamp()
                    .map_or(SourceTimestamp::NONE, |time| SourceTimestamp(time.to_ticks())),
                writer: Guid(change.writer_guid.to_bytes()),
                sequence: i64::from(change.sequence_number),
            }),
            Ok(None) => Take::Empty,
            Err(_) => Take::Malformed,
        }
    }

    /// The next change of matching, if there is one.
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
