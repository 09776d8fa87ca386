//! A DDS reader that wakes its role.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::thread::Thread;

use crate::dds::{Payload, RawReader, Take};
use crate::model::Encapsulation;

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

/// A reader with a bell, so that looking costs next to nothing while nothing has come.
pub(super) struct Inbox {
    reader: RawReader,
    bell: Arc<Bell>,
    waker: Waker,
}

impl Inbox {
    /// For the thread that calls this, which is the one that is woken.
    pub fn new(reader: RawReader) -> Self {
        let thread = Some(std::thread::current());
        Self::with_bell(reader, Arc::new(Bell { rung: AtomicBool::new(false), thread }))
    }

    /// For those who look at that bell.
    pub fn with_bell(reader: RawReader, bell: Arc<Bell>) -> Self {
        // A new reader rings nobody yet: it is looked at first.
        bell.ring();
        Self { reader, waker: Waker::from(Arc::clone(&bell)), bell }
    }

    /// Its reader.
    pub fn reader(&self) -> &RawReader {
        &self.reader
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
        let take = take_one(&self.reader);
        if take != Take::Empty {
            return take;
        }
        // Nothing there, so ask to be rung, and look again in case something came in between.
        self.bell.silence();
        self.reader.arm(&self.waker);
        let take = take_one(&self.reader);
        if take != Take::Empty {
            self.bell.rung.store(true, Ordering::Release);
        }
        take
    }
}
