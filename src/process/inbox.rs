//! A DDS reader that wakes its role.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};
use std::thread::Thread;

use crate::dds::{RawReader, Take};
use crate::model::Encapsulation;

/// Rung by the DDS library's thread when a sample arrives; wakes the thread of the role.
struct Bell {
    rung: AtomicBool,
    thread: Thread,
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.rung.store(true, Ordering::Release);
        self.thread.unpark();
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
        // A new reader rings nobody yet: it is looked at first.
        let bell = Arc::new(Bell { rung: AtomicBool::new(true), thread: std::thread::current() });
        Self { reader, waker: Waker::from(Arc::clone(&bell)), bell }
    }

    /// Its reader.
    pub fn reader(&self) -> &RawReader {
        &self.reader
    }

    /// As [`RawReader::take`]. After [`Take::Empty`] the thread may `park`: an arrival after this look keeps
    /// it from sleeping.
    pub fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Take {
        if !self.bell.rung.load(Ordering::Acquire) {
            return Take::Empty;
        }
        let take = self.reader.take(lend);
        if take != Take::Empty {
            return take;
        }
        // Nothing there, so ask to be rung, and look again in case something came in between.
        self.bell.rung.store(false, Ordering::Release);
        self.reader.arm(&self.waker);
        let take = self.reader.take(lend);
        if take != Take::Empty {
            self.bell.rung.store(true, Ordering::Release);
        }
        take
    }
}
