//! What ends a process: the request to stop, which SIGINT and SIGTERM set, and a panic.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::telemetry::flush_logs;

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

    /// Creates a flag that `signals` set.
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
        flush_logs();
        print(panic);
        std::process::abort();
    }));
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt;
    use std::process::Command;

    use nix::sys::resource::{Resource, setrlimit};
    use nix::sys::signal::Signal;

    use super::*;

    /// Set in the child process of the test.
    const CHILD_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_PANIC";

    #[test]
    fn a_panic_of_a_second_thread_ends_the_process_by_sigabrt() {
        let name = "process::stop::tests::a_panic_of_a_second_thread_ends_the_process_by_sigabrt";
        if std::env::var_os(CHILD_VARIABLE).is_some() {
            // No dump of the memory.
            setrlimit(Resource::RLIMIT_CORE, 0, 0).unwrap();
            abort_on_panic();
            let _ = std::thread::spawn(|| panic!("as the receiving thread")).join();
            // Without the hook, the panic ends only its thread, and the process succeeds.
            return;
        }
        let mut child = Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", name, "--nocapture"]).env(CHILD_VARIABLE, "1");
        let output = child.output().unwrap();
        assert_eq!(output.status.signal(), Some(Signal::SIGABRT as i32), "{output:?}");
        let log = String::from_utf8_lossy(&output.stderr);
        assert!(log.contains("as the receiving thread"), "{log}");
    }
}
