//! A DDS peer on RustDDS, through the bridge's own DDS module, with the command line and the output of those
//! on Cyclone DDS and Fast DDS. `tests/peers/README.md` describes it. It is an example of the package and not
//! a program of it, so that it is never installed.

mod options;
mod payload;
mod publisher;
mod record;
mod subscriber;

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use adaptive_bridge::telemetry::start_logs;
use clap::Parser;
use serde_json::{Value, json};
use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1};

use options::{Options, Role};

/// The requests that signals have made.
#[derive(Default)]
struct Signals {
    /// SIGINT, SIGTERM.
    stop: Arc<AtomicBool>,
    /// SIGUSR1.
    go: Arc<AtomicBool>,
}

impl Signals {
    fn listen(&self) -> std::io::Result<()> {
        for signal in [SIGINT, SIGTERM] {
            signal_hook::flag::register(signal, Arc::clone(&self.stop))?;
        }
        signal_hook::flag::register(SIGUSR1, Arc::clone(&self.go))?;
        Ok(())
    }

    fn stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Forgets the SIGUSR1 that has come, so that `go` waits for another one.
    fn await_go_again(&self) {
        self.go.store(false, Ordering::Relaxed);
    }

    fn go(&self) -> bool {
        self.go.load(Ordering::Relaxed)
    }
}

/// Prints an event as one line of JSON to stdout and flushes it.
fn emit(event: &Value) {
    let mut out = std::io::stdout().lock();
    // An error means that the pipe is closed; nothing can be reported then.
    let _ = writeln!(out, "{event}").and_then(|()| out.flush());
}

/// The manifest of the library, which has its version.
const RUSTDDS: &str = include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/third_party/rustdds/Cargo.toml"));

/// Reports that the endpoints exist.
fn emit_ready() {
    let version = RUSTDDS.lines().find_map(|line| line.strip_prefix("version = "));
    let library = format!("RustDDS {}", version.unwrap_or_default().trim_matches('"'));
    emit(&json!({"event": "ready", "library": library}));
}

/// Converts to microseconds, rounded to a tenth.
fn microseconds(ns: i64) -> f64 {
    (ns as f64 / 100.0).round() / 10.0
}

/// Order statistics in microseconds; null without values.
fn distribution(ns: &[i64]) -> Value {
    let mut sorted = ns.to_vec();
    sorted.sort_unstable();
    let Some(last) = sorted.len().checked_sub(1) else { return Value::Null };
    let quantile = |fraction: f64| microseconds(sorted[(fraction * last as f64).round() as usize]);
    json!({"min": quantile(0.0), "p50": quantile(0.5), "p95": quantile(0.95), "p99": quantile(0.99),
           "max": quantile(1.0)})
}

fn main() -> ExitCode {
    let options = Options::parse();
    start_logs();
    let signals = Signals::default();
    let outcome = signals.listen().map_err(|error| error.to_string()).and_then(|()| match options.role {
        Role::Pub => publisher::publish(&options, &signals),
        Role::Sub => subscriber::subscribe(&options, &signals),
    });
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            emit(&json!({"event": "error", "message": message}));
            ExitCode::FAILURE
        }
    }
}
