//! DDS readers that wake their role.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::thread::Thread;

use crate::dds::{Payload, RawReader, Take};
use crate::model::{Encapsulation, Guid};

/// Rung by the DDS library when a sample has arrived.
pub(super) struct Bell {
    rung: AtomicBool,
    /// To be woken; none where the library's own thread looks.
    thread: Option<Thread>,
}

impl Bell {
    /// One that wakes nobody.
    pub fn silent() -> Self {
        Self { rung: AtomicBool::new(false), thread: None }
    }

    pub fn ring(&self) {
        self.rung.store(true, Ordering::Release);
        if let Some(thread) = &self.thread {
            thread.unpark();
        }
    }

    pub fn silence(&self) {
        self.rung.store(false, Ordering::Release);
    }

    pub fn is_rung(&self) -> bool {
        self.rung.load(Ordering::Acquire)
    }
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.ring();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.ring();
    }
}

/// A share of one in so many samples is taken from the last reader first, so that a flood at the first one
/// cannot hold up the last.
const TURN_OF_THE_LAST: u64 = 32;

/// The one or two readers of a topic with a bell, so that looking costs next to nothing while nothing has
/// come.
pub(super) struct Inbox {
    /// In the order in which they are read.
    readers: Vec<RawReader>,
    bell: Arc<Bell>,
    waker: Waker,
    takes: Cell<u64>,
}

impl Inbox {
    /// With one reader, for the thread that calls this, which is the one that is woken.
    pub fn new(reader: RawReader) -> Self {
        let thread = Some(std::thread::current());
        let mut inbox = Self::with_bell(Arc::new(Bell { rung: AtomicBool::new(false), thread }));
        inbox.add(reader);
        inbox
    }

    /// Without a reader yet, for threads that look at that bell.
    pub fn with_bell(bell: Arc<Bell>) -> Self {
        Self { readers: Vec::new(), waker: Waker::from(Arc::clone(&bell)), bell, takes: Cell::new(0) }
    }

    /// Adds a reader, which is read after the others.
    pub fn add(&mut self, reader: RawReader) {
        self.readers.push(reader);
        // A new reader rings nobody yet: it is looked at first.
        self.bell.ring();
    }

    /// Takes a reader out.
    pub fn remove(&mut self, reader: Guid) -> Option<RawReader> {
        let place = self.readers.iter().position(|known| known.guid() == reader)?;
        Some(self.readers.remove(place))
    }

    /// The readers.
    pub fn readers(&self) -> &[RawReader] {
        &self.readers
    }

    /// As [`RawReader::take`]. After [`Take::Empty`] the thread may `park`: an arrival after this look keeps
    /// it from sleeping.
    pub fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        self.take_with(|reader| reader.take(lend))
    }

    /// The same for [`RawReader::take_payload`].
    pub fn take_payload(&self, receive: &mut dyn FnMut(Payload<'_>, Encapsulation)) -> Take {
        self.take_with(|reader| reader.take_payload(receive))
    }

    fn take_with(&self, mut take_one: impl FnMut(&RawReader) -> Take) -> Take {
        if !self.bell.is_rung() {
            return Take::Empty;
        }
        let take = self.take_first(&mut take_one);
        if take != Take::Empty {
            return take;
        }
        // Nothing there, so ask to be rung, and look again in case something came in between.
        self.bell.silence();
        for reader in &self.readers {
            reader.arm(&self.waker);
        }
        let take = self.take_first(&mut take_one);
        if take != Take::Empty {
            self.bell.rung.store(true, Ordering::Release);
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
        let order = if takes.is_multiple_of(TURN_OF_THE_LAST) { [last, first] } else { [first, last] };
        order.into_iter().map(take_one).find(|take| *take != Take::Empty).unwrap_or(Take::Empty)
    }
}
