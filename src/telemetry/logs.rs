//! Logs, on stderr or in the journal.

use std::io::IsTerminal;
use std::sync::OnceLock;

use tracing::warn;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry, reload};

use super::journal::Journal;
use crate::config::Verbosity;

/// The filter, where `RUST_LOG` leaves it to the configuration.
static CONFIGURED: OnceLock<reload::Handle<EnvFilter, Registry>> = OnceLock::new();

/// Starts logging to stderr, or to the journal where stderr leads there, as that of a systemd service does;
/// filtered by `RUST_LOG`, without it as [`set_verbosity`] says, and until then as [`Verbosity::Info`]. What
/// the libraries log through the `log` crate comes too.
pub fn start_logs() {
    let environment = std::env::var(EnvFilter::DEFAULT_ENV).ok().filter(|text| !text.is_empty());
    let asked_for = environment.and_then(|text| EnvFilter::try_new(text).ok());
    let is_configured = asked_for.is_none();
    let (filter, handle) = reload::Layer::new(asked_for.unwrap_or_else(|| filter(Verbosity::Info)));
    let journal = Journal::behind(std::io::stderr(), std::env::var_os("JOURNAL_STREAM"));
    let lines = journal.is_none().then(|| {
        tracing_subscriber::fmt::layer()
            .with_writer(std::io::stderr)
            // It would say on stderr that stderr is gone, a closed terminal say, and panic because it cannot.
            .log_internal_errors(false)
            .with_ansi(std::io::stderr().is_terminal())
    });
    match tracing_subscriber::registry().with(filter).with(journal).with(lines).try_init() {
        Ok(()) if is_configured => {
            // It is set once: logs cannot be started twice.
            let _ = CONFIGURED.set(handle);
        }
        Ok(()) => {}
        Err(error) => eprintln!("no logs: {error}"),
    }
}

/// From now on logs what the configuration asks for (`diagnostics.verbosity`). Does nothing where `RUST_LOG`
/// says what to log.
pub fn set_verbosity(verbosity: Verbosity) {
    if let Some(handle) = CONFIGURED.get()
        && let Err(error) = handle.reload(filter(verbosity))
    {
        warn!(%error, "the verbosity of the log stays as it is");
    }
}

/// Ourselves as asked; of the libraries what is an error. A RELIABLE writer of RustDDS warns of each sample
/// that its full window refuses; those are counted and named here.
fn filter(verbosity: Verbosity) -> EnvFilter {
    let own = match verbosity {
        Verbosity::Error => "error",
        Verbosity::Warn => "warn",
        Verbosity::Info => "info",
        Verbosity::Debug => "debug",
        Verbosity::Trace => "trace",
    };
    EnvFilter::new(format!("error,adaptive_bridge={own},adaptive_bridge_eval={own}"))
}
