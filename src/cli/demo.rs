//! `demo`: why the bridge exists, on this machine, in under a minute, with neither ROS 2 nor root.
//!
//! A laser publishes to a critical and to a remote subscriber. The remote one's link dies now and then: its
//! process is stopped (SIGSTOP), so that it acknowledges nothing. In the first phase both read from the
//! publisher's writer, in the second each from a lane of the bridge, which runs as on a robot. All are real
//! processes with real DDS writers; nothing but the stop signal is made up, and all figures are measured.

mod children;
mod outcome;
mod peers;
mod phase;
mod place;
mod report;
mod scan;
mod screen;
mod tally;

use std::fmt;
use std::io;
use std::process::{ExitCode, ExitStatus};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::model::MonotonicNs;
use crate::shm::ShmError;
use outcome::{Outcome, wrapped};
use phase::Way;
use place::Place;
use screen::Screen;

pub(super) use peers::{PublisherArguments, SubscriberArguments, publisher, subscriber};

/// Scans per second.
const RATE_HZ: u64 = 30;
/// Scans that the publisher's writer keeps while they are unacknowledged. So few that a stall of 3 s, 90
/// scans, fills it; with 200 it would take 7 s.
const HISTORY_SCANS: usize = 50;
/// How long a publish call waits for room: the default of ROS 2's publishers (DDS 1.4 clause 2.2.3.14).
const MAX_BLOCKING_MS: u64 = 100;
/// The remote subscriber's link dies once in this time,
const STALL_EVERY_MS: u64 = 6_000;
/// this long after the time began,
const STALL_AFTER_MS: u64 = 2_000;
/// and for so long.
const STALL_MS: u64 = 3_000;
/// The laser's topic, in the demo's own DDS domain.
const INPUT_TOPIC: &str = "/scan";

/// What `demo` is asked.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Seconds of each of the two phases
    #[arg(long, value_name = "N", default_value_t = 18)]
    #[arg(value_parser = clap::value_parser!(u64).range(6..=600))]
    seconds: u64,
    /// Print the result as JSON, and nothing else
    #[arg(long)]
    json: bool,
}

/// When a scan is due.
const fn due_at(began_at: MonotonicNs, number: u64) -> MonotonicNs {
    began_at.plus_ns(number * 1_000_000_000 / RATE_HZ)
}

/// The first scan that is due at an instant or later.
fn first_due_after(began_at: MonotonicNs, instant: MonotonicNs) -> u64 {
    let mut number = instant.since(began_at) * RATE_HZ / 1_000_000_000;
    while due_at(began_at, number) < instant {
        number += 1;
    }
    number
}

/// Why a demo ended early.
#[derive(Debug)]
enum DemoError {
    /// The user wants it to.
    Interrupted,
    /// No DDS domain is free.
    NoDomain { from: u16, to: u16 },
    /// A process could not be started.
    Start { name: &'static str, error: io::Error },
    /// A process ended, which none should.
    Ended { who: &'static str, status: ExitStatus },
    /// Somebody gets no scans.
    NothingArrives { who: &'static str, patience_ms: u64 },
    /// The bridge refuses what the demo configured.
    Config(String),
    /// Shared memory.
    Shm(ShmError),
    /// The operating system refused something else.
    Os { what: &'static str, error: io::Error },
}

impl DemoError {
    fn os(what: &'static str, error: io::Error) -> Self {
        Self::Os { what, error }
    }
}

impl From<ShmError> for DemoError {
    fn from(error: ShmError) -> Self {
        Self::Shm(error)
    }
}

impl fmt::Display for DemoError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Interrupted => f.write_str("stopped"),
            Self::NoDomain { from, to } => {
                write!(f, "the DDS domains {from} to {to} are all in use, by other demos perhaps")
            }
            Self::Start { name, error } => write!(f, "cannot start the {name}: {error}"),
            Self::Ended { who, status } => write!(f, "the {who} ended unasked ({status})"),
            Self::NothingArrives { who, patience_ms } => write!(
                f,
                "nothing comes from or to the {who} for {} s; if no log above says why: DDS discovery needs \
                 UDP multicast on the loopback interface, which a firewall may block",
                patience_ms / 1_000
            ),
            Self::Config(what) => write!(f, "the demo's configuration: {what}"),
            Self::Shm(error) => error.fmt(f),
            Self::Os { what, error } => write!(f, "{what}: {error}"),
        }
    }
}

/// The wish to stop: Ctrl-C, SIGTERM, or a terminal that was closed.
struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    fn on_signals() -> Result<Self, DemoError> {
        let flag = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            signal_hook::flag::register(signal, Arc::clone(&flag))
                .map_err(|error| DemoError::os("cannot handle signals", error))?;
        }
        Ok(Self(flag))
    }

    fn is_requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let mut screen = Screen::new(arguments.json);
    match show(arguments, &mut screen) {
        Ok(outcome) if arguments.json => print_json(&outcome),
        Ok(outcome) => {
            screen.say(&outcome.text());
            ExitCode::SUCCESS
        }
        Err(DemoError::Interrupted) => {
            screen.say("\nStopped. Nothing is left behind.");
            ExitCode::SUCCESS
        }
        Err(error) => super::failed(&error),
    }
}

fn show(arguments: &Arguments, screen: &mut Screen) -> Result<Outcome, DemoError> {
    let interrupt = Interrupt::on_signals()?;
    let place = Place::find()?;
    screen.say(&introduction(arguments.seconds, place.domain()));
    let mut phase = |way, title: &str| {
        screen.say(title);
        let figures = phase::run(&place, way, arguments.seconds, &interrupt, screen);
        if let Err(error) = &figures
            && !matches!(error, DemoError::Interrupted)
        {
            eprint!("{}", children::last_log_lines(&place));
        }
        figures
    };
    let without_bridge = phase(
        Way::Direct,
        "\nPhase 1: both subscribers read the publisher's topic (RELIABLE, the default)\n",
    )?;
    let with_bridge =
        phase(Way::Bridge, "\nPhase 2: the same stalls through the bridge (remote: BEST_EFFORT, 10 Hz)\n")?;
    screen.say("");
    Ok(Outcome::new(arguments.seconds, without_bridge, with_bridge))
}

fn introduction(seconds: u64, domain: u16) -> String {
    let what = format!(
        "A laser publishes {RATE_HZ} scans a second to two subscribers: a critical one on the robot, and a \
         remote one whose link dies for {} s in every {}. For that its process is stopped (SIGSTOP): to the \
         publisher's DDS writer that is a dead Wi-Fi link, no acknowledgements.",
        STALL_MS / 1_000,
        STALL_EVERY_MS / 1_000,
    );
    let how = format!(
        "The publisher is an ordinary one: RELIABLE, a history of {HISTORY_SCANS} unacknowledged scans (so \
         small that {} s fill it; 200 would take {:.0} s), and a publish call waits {MAX_BLOCKING_MS} ms for \
         room at most. Each of the two phases takes {seconds} s, on loopback, in DDS domain {domain}.",
        STALL_MS / 1_000,
        200.0 / RATE_HZ as f64,
    );
    format!("{}\n\n{}", wrapped(&what), wrapped(&how))
}

fn print_json(outcome: &Outcome) -> ExitCode {
    use io::Write;
    let printed = serde_json::to_string_pretty(outcome)
        .map_err(io::Error::from)
        .and_then(|json| writeln!(io::stdout().lock(), "{json}"));
    match printed {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => super::failed(&error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scans_are_due_at_their_rate_for_ever() {
        let began_at = MonotonicNs(123_456_789);
        assert_eq!(due_at(began_at, 18_000), began_at.plus_ms(600_000));
        for number in [0, 1, 2, 29, 30, 31, 17_999] {
            let due = due_at(began_at, number);
            assert_eq!(first_due_after(began_at, due), number);
            assert_eq!(first_due_after(began_at, due.plus_ns(1)), number + 1);
        }
    }
}
