//! `status`: shows the state of the running bridge, read from its boards in shared memory.

use std::io::{self, IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, value_parser};

use super::{ConfigArguments, failed, no_bridge, output_ended, pause, running_bridge};
use crate::config::Settings;
use crate::process::Stop;
use crate::shm::{ShmError, root_of};
use crate::telemetry::{ProcessState, Report, Snapshot};

/// Allowed values of `--interval-ms`: from 10 ms, one period of 100 Hz, to an hour.
const INTERVALS_MS: RangeInclusive<u64> = 10..=3_600_000;

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Print JSON (docs/status-json.md): one object; with --watch one object per line
    #[arg(long)]
    json: bool,
    /// Repeat until Ctrl-C; on a terminal, redraw in place
    #[arg(long, short)]
    watch: bool,
    /// The time over which rates and latencies are measured, and with --watch the time between two reports
    #[arg(long, value_name = "N", default_value_t = 1_000)]
    #[arg(value_parser = value_parser!(u64).range(INTERVALS_MS))]
    interval_ms: u64,
    /// Print no report; exit with 0 if the process runs and does not hang: `ingress`, `control`,
    /// `egress-LANE`
    #[arg(long, value_name = "PROCESS", conflicts_with_all = ["json", "watch"])]
    require: Option<String>,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let settings = arguments.config.in_force()?;
    let root = root_of(&settings);
    let first = running_bridge(&root, &settings)?;
    if let Some(process) = &arguments.require {
        return Ok(require(&first, process));
    }
    if arguments.watch {
        return watch(arguments, root, settings, first);
    }
    #[allow(clippy::disallowed_methods, reason = "a subcommand handles no samples of the bridge")]
    std::thread::sleep(std::time::Duration::from_millis(arguments.interval_ms));
    let second = running_bridge(&root, &settings)?;
    show(&second.report_since(&first), arguments.json).map_err(|error| output_ended(&error))?;
    Ok(ExitCode::SUCCESS)
}

/// Checks that a process runs, for health checks.
fn require(bridge: &Snapshot, process: &str) -> ExitCode {
    match bridge.processes.iter().find(|reading| reading.name == process) {
        Some(reading) if reading.state == ProcessState::Running => ExitCode::SUCCESS,
        Some(reading) => failed(&format!("{process} is {}", reading.state.label())),
        None => {
            let names: Vec<&str> = bridge.processes.iter().map(|reading| reading.name.as_str()).collect();
            failed(&format!("the bridge has no process {process}; it has: {}", names.join(", ")))
        }
    }
}

/// Shows one report after the other. Waits for a bridge that has ended: it may be restarted, perhaps with
/// other settings.
fn watch(
    arguments: &Arguments,
    mut root: PathBuf,
    mut settings: Settings,
    first: Snapshot,
) -> Result<ExitCode, ExitCode> {
    let stop = Stop::on_signals().map_err(|error| failed(&error))?;
    let in_place = !arguments.json && io::stdout().is_terminal();
    let mut last = Some(first);
    while pause(arguments.interval_ms, &stop) {
        if last.is_none()
            && let Some(restarted) = arguments.config.running()
        {
            settings = restarted;
            root = root_of(&settings);
        }
        // A bridge that was restarted as a whole since the last snapshot may have other lanes or routes.
        let next = match Snapshot::take(&root, &settings) {
            Ok(next) => next,
            Err(ShmError::Incompatible { .. }) if arguments.config.running().is_some() => None,
            Err(error) => return Err(failed(&error)),
        };
        let shown = match (&next, &last) {
            (Some(next), before) => {
                let report = next.report_since(before.as_ref().unwrap_or(next));
                if in_place { redraw(&report.to_string()) } else { show(&report, arguments.json) }
            }
            (None, Some(_)) => {
                no_bridge(&settings, &root);
                Ok(())
            }
            (None, None) => Ok(()),
        };
        shown.map_err(|error| output_ended(&error))?;
        last = next;
    }
    Ok(ExitCode::SUCCESS)
}

fn show(report: &Report, json: bool) -> io::Result<()> {
    write(&if json { serde_json::to_string(report)? + "\n" } else { report.to_string() })
}

fn write(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}

fn redraw(text: &str) -> io::Result<()> {
    let (columns, lines) = match terminal_size::terminal_size() {
        Some((terminal_size::Width(columns), terminal_size::Height(lines))) => (columns, lines),
        None => (80, 24),
    };
    write(&frame(text, usize::from(columns), usize::from(lines)))
}

/// The escape sequences and text that overwrite the previous report: from the upper left corner, each line is
/// cleared behind its text, then everything below. The text is cut to the terminal, because a line that wraps
/// or scrolls would displace the next frame.
fn frame(text: &str, columns: usize, lines: usize) -> String {
    let mut frame = String::from("\x1b[H");
    // The cursor needs the last line.
    for line in text.lines().take(lines.saturating_sub(1)) {
        frame.extend(line.chars().take(columns));
        frame.push_str("\x1b[K\n");
    }
    frame.push_str("\x1b[J");
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_fits_the_terminal_and_clears_the_previous_one() {
        assert_eq!(frame("one\ntwo µs\nthree", 5, 10), "\x1b[Hone\x1b[K\ntwo µ\x1b[K\nthree\x1b[K\n\x1b[J");
        assert_eq!(frame("one\ntwo\nthree", 80, 3), "\x1b[Hone\x1b[K\ntwo\x1b[K\n\x1b[J");
        assert_eq!(frame("one", 0, 0), "\x1b[H\x1b[J");
    }
}
