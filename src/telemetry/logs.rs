//! Sets up logging to stderr or to the journal.

use std::io::IsTerminal;
use std::sync::OnceLock;

use tracing::warn;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry, reload};

use super::journal::Journal;
use super::log_limit::LogLimit;
use super::log_writer::LogLines;
use crate::config::Verbosity;

/// The handle that changes the filter; set only when `RUST_LOG` is unset and the configuration decides.
static CONFIGURED: OnceLock<reload::Handle<EnvFilter, Registry>> = OnceLock::new();

/// Starts logging to stderr, or to the journal when stderr is connected to it, as in a systemd service.
///
/// `RUST_LOG` sets the filter. Without it, [`set_verbosity`] does, and [`Verbosity::Info`] applies until
/// then. Events of libraries that use the `log` crate are logged, too. A program calls
/// [`flush_logs`](super::flush_logs) before it ends.
pub fn start_logs() {
    let environment = std::env::var(EnvFilter::DEFAULT_ENV).ok().filter(|text| !text.is_empty());
    let from_environment = environment.and_then(|text| EnvFilter::try_new(text).ok());
    let is_configured = from_environment.is_none();
    let (filter, handle) = reload::Layer::new(from_environment.unwrap_or_else(|| filter(Verbosity::Info)));
    let journal = Journal::for_log(std::io::stderr(), std::env::var_os("JOURNAL_STREAM"));
    let lines = journal.is_none().then(|| {
        tracing_subscriber::fmt::layer()
            .with_writer(|| LogLines)
            // Otherwise the layer reports a closed stderr, such as that of a closed terminal, on stderr
            // itself, which fails and panics.
            .log_internal_errors(false)
            .with_ansi(std::io::stderr().is_terminal())
    });
    match tracing_subscriber::registry().with(filter).with(LogLimit).with(journal).with(lines).try_init() {
        Ok(()) if is_configured => {
            // `try_init` succeeds only once, so this is set only once.
            let _ = CONFIGURED.set(handle);
        }
        Ok(()) => {}
        Err(error) => eprintln!("cannot start logging: {error}"),
    }
}

/// Applies `diagnostics.verbosity` to the log. Does nothing when `RUST_LOG` sets the filter.
pub fn set_verbosity(verbosity: Verbosity) {
    if let Some(handle) = CONFIGURED.get()
        && let Err(error) = handle.reload(filter(verbosity))
    {
        warn!(%error, "cannot change the log verbosity (diagnostics.verbosity); the previous one stays");
    }
}

/// The filter for a verbosity of the bridge; libraries log errors only. A RELIABLE writer of RustDDS would
/// warn about each sample that its full window refuses, which the bridge counts and reports itself.
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
