//! Logs, on stderr.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;

/// Without `RUST_LOG`: ourselves in full; of the libraries what is an error. A RELIABLE writer of RustDDS
/// warns of each sample that its full window refuses; those are counted and named here.
const DEFAULT_FILTER: &str = "info,rustdds=error,ros2_client=error,iceoryx2=error";

/// Starts logging to stderr, filtered by `RUST_LOG`. What the libraries log through the `log` crate comes
/// too.
pub fn start_logs() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    let outcome = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        // It would say on stderr that stderr is gone, a closed terminal say, and panic because it cannot.
        .log_internal_errors(false)
        .with_ansi(std::io::stderr().is_terminal())
        .try_init();
    if let Err(error) = outcome {
        eprintln!("no logs: {error}");
    }
}
