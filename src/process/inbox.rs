//! The DDS readers of one topic, with a flag that the DDS library raises when a sample arrives.

use std::cell::Cell;
use std::sync::Arc;
use std::task::Waker;

use crate::dds::{ArrivalFlag, RawReader, Take, TakePayload};
use crate::model::{Encapsulation, Guid};

/// One take in so many tries the last reader first, so that a flood of samples at the first reader cannot
/// block it.
const LAST_READER_FIRST_EVERY: u64 = 32;

/// The one or two readers of a topic, and the flag that makes a poll nearly free while no sample has
/// arrived.
pub(super) struct Inbox {
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
        self.take_payload().read(read)
    }

    /// Takes the next sample, like [`RawReader::take_payload`].
    pub fn take_payload(&self) -> TakePayload {
        if !self.flag.is_raised() {
            return TakePayload::Empty;
        }
        let take = self.take_first();
        if !take.is_empty() {
            return take;
        }
        // Arm the readers, then poll once more for a sample that arrived before they were armed.
        self.flag.clear();
        for reader in &self.readers {
            reader.arm(&self.waker);
        }
        let take = self.take_first();
        if !take.is_empty() {
            self.flag.raise_quietly();
        }
        take
    }

    /// Takes from the first reader that has a sample.
    fn take_first(&self) -> TakePayload {
        let [first, last] = self.readers.as_slice() else {
            return self.readers.first().map_or(TakePayload::Empty, RawReader::take_payload);
        };
        let takes = self.takes.get().wrapping_add(1);
        self.takes.set(takes);
        let order = if takes.is_multiple_of(LAST_READER_FIRST_EVERY) { [last, first] } else { [first, last] };
        let mut takes = order.into_iter().map(RawReader::take_payload);
        takes.find(|take| !take.is_empty()).unwrap_or(TakePayload::Empty)
    }
}
