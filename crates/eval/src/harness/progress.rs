//! The progress on stderr: a line for each run, updated in place on a terminal.

use std::io::{IsTerminal, Write, stderr};

use adaptive_bridge::model::MonotonicNs;

/// The progress line of the current run.
pub(super) struct Progress {
    head: String,
    in_place: bool,
    shown: String,
}

impl Progress {
    /// Starts the line of run `number` of `all`.
    pub fn begin(number: usize, all: usize, run: &str) -> Self {
        let progress = Self {
            head: format!("[{number}/{all}] {run}"),
            in_place: stderr().is_terminal(),
            shown: String::new(),
        };
        if !progress.in_place {
            eprintln!("{}", progress.head);
        }
        progress
    }

    /// Shows the phase of the run.
    pub fn phase(&mut self, what: &str) {
        self.show(what);
    }

    /// Shows the time in the measured window.
    pub fn time(&mut self, begin: MonotonicNs, now: MonotonicNs, duration_s: f64) {
        let seconds = now.since(begin) / 1_000_000_000;
        self.show(&format!("{seconds} of {duration_s:.0} s"));
    }

    /// Ends the line with the outcome of the run.
    pub fn end(&mut self, outcome: &str) {
        if self.in_place {
            eprintln!("\r\x1b[K{}: {outcome}", self.head);
        } else {
            eprintln!("{}: {outcome}", self.head);
        }
    }

    fn show(&mut self, what: &str) {
        if self.in_place && self.shown != what {
            what.clone_into(&mut self.shown);
            eprint!("\r\x1b[K{}: {what}", self.head);
            let _ = stderr().flush();
        }
    }
}
