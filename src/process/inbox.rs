//! The DDS readers of one topic, with a flag that the DDS library raises when a sample arrives.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::thread::Thread;

use crate::dds::{Payload, RawReader, Take};
use crate::model::{Encapsulation, Guid};

/// A flag that the DDS library raises when a sample has arrived, and the thread to wake then.
pub(super) struct ArrivalFlag {
    raised: AtomicBool,
    /// The thread to unpark; `None` where the DDS library's own thread checks the flag.
    thread: Option<Thread>,
}

impl ArrivalFlag {
    /// Creates a flag that wakes no thread.
    pub fn passive() -> Self {
        Self { raised: AtomicBool::new(false), thread: None }
    }

    pub fn raise(&self) {
        self.raised.store(true, Ordering::Release);
        if let Some(thread) = &self.thread {
            thread.unpark();
        }
    }

    pub fn clear(&self) {
        self.raised.store(false, Ordering::Release);
    }

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
        let thread = Some(std::thread::current());
        let mut inbox = Self::with_flag(Arc::new(ArrivalFlag { raised: AtomicBool::new(false), thread }));
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
    pub fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_with(|reader| reader.take(lend))
    }

    /// Takes the next sample, like [`RawReader::take_payload`].
    pub fn take_payload(&self, receive: &mut dyn FnMut(Payload<'_>, Encapsulation)) -> Take {
        self.take_with(|reader| reader.take_payload(receive))
    }

    fn take_with(&self, mut take_one: impl FnMut(&RawReader) -> Take) -> Take {
        if !self.flag.is_raised() {
            return Take::Empty;
        }
        let take = self.take_first(&mut take_one);
        if take != Take::Empty {
            return take;
        }
        // Arm the readers, then poll once more for a sample that arrived before they were armed.
        self.flag.clear();
        for reader in &self.readers {
            reader.arm(&self.waker);
        }
        let take = self.take_first(&mut take_one);
        if take != Take::Empty {
            self.flag.raised.store(true, Ordering::Release);
        }
        take
    }

    /// Takes from the first reader that has a sample.
    fn take_first(&self, take_one: &mut impl FnMut(&RawReader) -> Take) -> Take {
        let [first, last] = self.readers.as_slice() else {
            return self.readers.first().map_or(Take::Empty, take_one);
        };
        let takes = self.takes.get().wrapping_add(1);
        self.takes.set(takes);
        let order = if takes.is_multiple_of(LAST_READER_FIRST_EVERY) { [last, first] } else { [first, last] };
        order.into_iter().map(take_one).find(|take| *take != Take::Empty).unwrap_or(Take::Empty)
    }
}
