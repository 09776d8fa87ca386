//! What the terminal shows while runs are made: a line for each, in place where it is a terminal.

use std::io::{IsTerminal, Write, stderr};

use crate::model::MonotonicNs;

/// The line of the present run.
pub(super) struct Progress {
    head: String,
    in_place: bool,
    shown: String,
}

impl Progress {
    /// Begins the line of run `number` of `all`.
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

    /// Shows what is being done.
    pub fn phase(&mut self, what: &str) {
        self.show(what);
    }

    /// Shows how far the measured window is.
    pub fn time(&mut self, begin: MonotonicNs, now: MonotonicNs, duration_s: f64) {
        let seconds = now.since(begin) / 1_000_000_000;
        self.show(&format!("{seconds} of {duration_s:.0} s"));
    }

    /// Ends the line.
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
