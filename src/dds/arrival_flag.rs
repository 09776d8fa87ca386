//! A flag that the DDS library raises when a sample has arrived.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Wake;
use std::thread::{self, Thread};

/// A flag that the DDS library raises when a sample has arrived, and the thread to wake then. As a waker it
/// arms readers ([`RawReader::arm`](super::RawReader::arm)).
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

    /// Raises the flag without a wake-up, for the thread that checks it.
    pub fn raise_quietly(&self) {
        self.raised.store(true, Ordering::Release);
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
