//! `demo`: demonstrates the bridge on this machine in under a minute, without ROS 2 and without root.
//!
//! A laser publishes to a critical and to a remote subscriber. The link of the remote subscriber fails
//! periodically: SIGSTOP stops its process, so that it acknowledges nothing. In the first phase both
//! subscribers match the publisher's writer, in the second each matches the writer of a lane of the bridge,
//! which runs as on a robot. All processes and DDS writers are real: only the failing link is simulated, and
//! all figures are measured.

mod children;
mod outcome;
mod peers;
mod phase;
mod picture;
mod report;
mod sandbox;
mod scan;
mod screen;
mod tally;

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::{ExitCode, ExitStatus};

use clap::Args;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::model::MonotonicNs;
use crate::process::Stop;
use crate::shm::ShmError;
use outcome::{Outcome, wrapped};
use sandbox::Sandbox;
use screen::Screen;

pub(super) use peers::{PeerArguments, SubscriberArguments, publisher, subscriber};

/// Scans that the laser publishes per second.
const RATE_HZ: u64 = 30;
/// Unacknowledged scans that the publisher's writer keeps. A stall of 3 s, 90 scans, fills this history; with
/// 200 it would take 7 s.
const HISTORY_SCANS: usize = 50;
/// How long a publish call waits for space in the history: the default of ROS 2's publishers (DDS 1.4 clause
/// 2.2.3.14).
const MAX_BLOCKING_MS: u64 = 100;
/// The period of the stalls of the remote subscriber.
const STALL_EVERY_MS: u64 = 6_000;
/// The time from the start of a period to its stall.
const STALL_AFTER_MS: u64 = 2_000;
const STALL_MS: u64 = 3_000;
/// The laser's topic, in the demo's own DDS domain.
const INPUT_TOPIC: &str = "/scan";

/// How the subscribers receive the scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Setup {
    /// Both directly from the publisher's writer.
    Direct,
    /// Each from a lane of the bridge.
    Bridge,
}

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Duration of each of the two phases, in seconds
    #[arg(long, value_name = "N", default_value_t = 18)]
    #[arg(value_parser = clap::value_parser!(u64).range(6..=600))]
    seconds: u64,
    /// Print only the result, as JSON
    #[arg(long)]
    json: bool,
    /// Write a picture of the result to this file, as SVG
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

const fn due_at(began_at: MonotonicNs, number: u64) -> MonotonicNs {
    began_at.plus_ns(number * 1_000_000_000 / RATE_HZ)
}

/// The number of the first scan that is due at an instant or later.
fn first_due_after(began_at: MonotonicNs, instant: MonotonicNs) -> u64 {
    let mut number = instant.since(began_at) * RATE_HZ / 1_000_000_000;
    while due_at(began_at, number) < instant {
        number += 1;
    }
    number
}

#[derive(Debug, thiserror::Error)]
enum DemoError {
    /// The user stopped it.
    #[error("stopped")]
    Interrupted,
    #[error("the DDS domains {from} to {to} are all in use, perhaps by other demos")]
    NoDomain { from: u16, to: u16 },
    #[error("cannot start the {name}: {error}")]
    Start { name: &'static str, error: io::Error },
    #[error("the {name} exited unexpectedly ({status})")]
    Ended { name: &'static str, status: ExitStatus },
    /// A subscriber receives no scans, or the publisher publishes none.
    #[error(
        "the {name} exchanged no scans for {} s; if the logs above show no cause, check that no firewall blocks UDP \
         multicast on the loopback interface, which DDS discovery needs",
        .timeout_ms / 1_000
    )]
    NothingArrives { name: &'static str, timeout_ms: u64 },
    #[error("the demo's configuration: {0}")]
    Config(String),
    #[error(transparent)]
    Shm(#[from] ShmError),
    #[error("{action}: {error}")]
    Os { action: &'static str, error: io::Error },
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let mut screen = Screen::new(arguments.json);
    match show(arguments, &mut screen) {
        Ok(outcome) => match print(&outcome, arguments, &mut screen) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => super::failed(&error),
        },
        Err(DemoError::Interrupted) => {
            screen.print("\nStopped. All processes and files of the demo are removed.");
            ExitCode::SUCCESS
        }
        Err(error) => super::failed(&error),
    }
}

fn show(arguments: &Arguments, screen: &mut Screen) -> Result<Outcome, DemoError> {
    // Ctrl-C, a request, or a closed terminal.
    let stop = Stop::on(&[SIGINT, SIGTERM, SIGHUP])
        .map_err(|error| DemoError::Os { action: "cannot handle signals", error })?;
    let sandbox = Sandbox::create()?;
    screen.print(&introduction(arguments.seconds, sandbox.settings.input.domain_id));
    let mut phase = |setup, title: &str| {
        screen.print(title);
        let figures = phase::run(&sandbox, setup, arguments.seconds, &stop, screen);
        if let Err(error) = &figures
            && !matches!(error, DemoError::Interrupted)
        {
            eprint!("{}", children::last_log_lines(&sandbox));
        }
        figures
    };
    let without_bridge = phase(
        Setup::Direct,
        "\nPhase 1: both subscribers read the publisher's topic (RELIABLE, the default)\n",
    )?;
    let with_bridge =
        phase(Setup::Bridge, "\nPhase 2: the same stalls through the bridge (remote: BEST_EFFORT, 10 Hz)\n")?;
    screen.print("");
    Ok(Outcome::new(arguments.seconds, without_bridge, with_bridge))
}

fn introduction(seconds: u64, domain: u16) -> String {
    let scenario = format!(
        "A laser publishes {RATE_HZ} scans a second to two subscribers: a critical one on the robot, and a \
         remote one whose link fails for {} s in every {}. The demo simulates that by stopping its process \
         (SIGSTOP): the publisher's DDS writer gets no acknowledgements, as over a dead Wi-Fi link.",
        STALL_MS / 1_000,
        STALL_EVERY_MS / 1_000,
    );
    let publisher = format!(
        "The publisher is an ordinary one: it is RELIABLE, its history keeps {HISTORY_SCANS} unacknowledged scans \
         ({} s fill it; 200 scans would take {:.0} s), and a publish call waits at most {MAX_BLOCKING_MS} ms for \
         space in it. Each of the two phases takes {seconds} s, on loopback, in DDS domain {domain}.",
        STALL_MS / 1_000,
        200.0 / RATE_HZ as f64,
    );
    format!("{}\n\n{}", wrapped(&scenario), wrapped(&publisher))
}

/// Prints the result, and writes its picture if there is a file for it.
fn print(outcome: &Outcome, arguments: &Arguments, screen: &mut Screen) -> Result<(), String> {
    if arguments.json {
        let json = serde_json::to_string_pretty(outcome).map_err(|error| error.to_string())?;
        writeln!(io::stdout(), "{json}").map_err(|error| error.to_string())?;
    } else {
        screen.print(&outcome.text());
    }
    let Some(path) = &arguments.svg else { return Ok(()) };
    std::fs::write(path, picture::picture(outcome)).map_err(|error| format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scans_are_due_at_a_constant_rate() {
        let began_at = MonotonicNs(123_456_789);
        assert_eq!(due_at(began_at, 18_000), began_at.plus_ms(600_000));
        for number in [0, 1, 2, 29, 30, 31, 17_999] {
            let due = due_at(began_at, number);
            assert_eq!(first_due_after(began_at, due), number);
            assert_eq!(first_due_after(began_at, due.plus_ns(1)), number + 1);
        }
    }
}
