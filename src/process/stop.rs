//! What ends a process: the request to stop, which SIGINT and SIGTERM set, and a panic.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

/// Flag that requests the process to stop. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Creates a flag that SIGINT and SIGTERM set.
    ///
    /// # Errors
    /// The operating system refused the signal handlers.
    pub fn on_signals() -> io::Result<Self> {
        Self::on(&[SIGINT, SIGTERM])
    }

    /// As [`Stop::on_signals`], for other signals.
    ///
    /// # Errors
    /// The operating system refused the signal handlers.
    pub fn on(signals: &[i32]) -> io::Result<Self> {
        let stop = Self::default();
        for &signal in signals {
            signal_hook::flag::register(signal, Arc::clone(&stop.0))?;
        }
        Ok(stop)
    }

    /// Requests the stop.
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the stop was requested.
    pub fn is_requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// Ends this process with SIGABRT when any of its threads panics, after the message of the panic, so that its
/// supervisor restarts it. By default a panic ends only its thread: a process without the receiving thread of
/// the DDS library runs on, and forwards nothing.
pub fn abort_on_panic() {
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        print(panic);
        std::process::abort();
    }));
}
