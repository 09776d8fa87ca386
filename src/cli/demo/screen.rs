//! The display of a running demo: on a terminal a table that is redrawn in place, elsewhere a line every two
//! seconds, nothing with `--json`. 80 columns wide.

use std::io::{self, IsTerminal, Write};

use super::children::Role;
use super::tally::{Figures, Tally, Window};
use super::{RATE_HZ, Setup};
use crate::model::MonotonicNs;

/// The period of lines when stdout is no terminal.
const LINE_EVERY_MS: u64 = 2_000;
/// The time over which a displayed rate is measured.
const RATE_OVER_MS: u64 = 1_000;
/// During a phase, a scan counts as missed only when it has not arrived this long after it was due.
const ARRIVAL_GRACE_MS: u64 = 100;
/// The highest number of characters of a timeline.
const TIMELINE_CELLS: u64 = 40;
/// The shortest time that a character of a timeline covers.
const CELL_MIN_MS: u64 = 500;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Style {
    InPlace,
    Lines,
    Quiet,
}

#[derive(Debug)]
pub(super) struct Screen {
    style: Style,
    /// The number of lines of the table on the terminal.
    table_lines: usize,
    next_line_at: MonotonicNs,
    /// Whether a write to stdout has failed.
    pub closed: bool,
}

impl Screen {
    pub fn new(quiet: bool) -> Self {
        let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
        let style = match quiet {
            true => Style::Quiet,
            false if io::stdout().is_terminal() && !dumb => Style::InPlace,
            false => Style::Lines,
        };
        Self { style, table_lines: 0, next_line_at: MonotonicNs(0), closed: false }
    }

    /// Prints text that later updates do not overwrite.
    pub fn print(&mut self, text: &str) {
        self.table_lines = 0;
        self.next_line_at = MonotonicNs(0);
        if self.style != Style::Quiet {
            self.write(&format!("{text}\n"));
        }
    }

    pub fn draw(
        &mut self,
        setup: Setup,
        tally: &Tally,
        window: &Window,
        stalled_since: Option<MonotonicNs>,
        now: MonotonicNs,
    ) {
        let first = window.start().plus_ms(LINE_EVERY_MS);
        let view = || View::of(tally, window, stalled_since, now);
        match self.style {
            Style::InPlace => {
                let lines = view().table(setup, tally, window, now);
                // Moves the cursor up to the start of the table. Wrapping is off, so that a line of the table
                // stays one line on a narrow terminal.
                let mut text = String::from("\x1b[?7l");
                if self.table_lines > 0 {
                    text.push_str(&format!("\x1b[{}A", self.table_lines));
                }
                for line in &lines {
                    text.push_str(&format!("\r\x1b[2K{line}\n"));
                }
                text.push_str("\x1b[?7h");
                self.table_lines = lines.len();
                self.write(&text);
            }
            Style::Lines if now >= window.end() || now >= self.next_line_at.max(first) => {
                self.next_line_at = now.plus_ms(LINE_EVERY_MS);
                self.write(&format!("{}\n", view().line()));
            }
            Style::Lines | Style::Quiet => {}
        }
    }

    fn write(&mut self, text: &str) {
        let mut stdout = io::stdout().lock();
        self.closed |= stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()).is_err();
    }
}

/// The state of a phase at an instant.
struct View {
    figures: Figures,
    /// The scans of the last second that the publisher wrote, and that each subscriber received.
    publisher_hz: usize,
    critical_hz: usize,
    remote_hz: usize,
    silent_s: f64,
    stalled_s: Option<f64>,
    elapsed_s: u64,
}

impl View {
    fn of(tally: &Tally, window: &Window, stalled_since: Option<MonotonicNs>, now: MonotonicNs) -> Self {
        // At the end of a phase every scan counts, because the last ones had time to arrive.
        let grace_ms = if now >= window.end() { 0 } else { ARRIVAL_GRACE_MS };
        let settled = MonotonicNs(now.0.saturating_sub(grace_ms * 1_000_000));
        let second = MonotonicNs(settled.0.saturating_sub(RATE_OVER_MS * 1_000_000))..settled;
        Self {
            figures: tally.figures(window, &[], settled),
            publisher_hz: tally.written_in(window, second.clone()),
            critical_hz: tally.arrived_in(Role::Critical, window, second.clone()),
            remote_hz: tally.arrived_in(Role::Remote, window, second),
            silent_s: tally.silent_ns(window, now) as f64 / 1e9,
            stalled_s: stalled_since.map(|since| now.since(since) as f64 / 1e9),
            elapsed_s: now.min(window.end()).since(window.start()) / 1_000_000_000,
        }
    }

    fn table(&self, setup: Setup, tally: &Tally, window: &Window, now: MonotonicNs) -> Vec<String> {
        let Figures { publisher, critical, remote, .. } = &self.figures;
        let silence = if self.silent_s > 0.3 {
            format!("silent for {:.1} s!", self.silent_s)
        } else {
            format!("longest silence {:.2} s", critical.silence_max_ms / 1e3)
        };
        let link = match self.stalled_s {
            Some(stalled_s) => format!("link down for {stalled_s:.1} s"),
            None => "link up".to_owned(),
        };
        let missed = |scans: u64| publisher.due.saturating_sub(scans).to_string();
        let remote_missed = match setup {
            Setup::Direct => missed(remote.received),
            // The remote lane is rate-limited, so the remote subscriber does not receive every scan.
            Setup::Bridge => "-".to_owned(),
        };
        let row = |name: &str, hz: usize, scans: u64, missed: &str, note: &str| {
            format!("  {name:<12}{hz:>6} Hz {scans:>8} {missed:>9}   {note}")
        };
        let seconds = window.end().since(window.start()) / 1_000_000_000;
        let progress = format!("{} of {seconds} s", self.elapsed_s);
        let call = format!("longest publish call {:.1} ms", publisher.call_max_ms);
        let mut lines = vec![
            format!("  {:<12}{:>9} {:>8} {:>9}{progress:>36}", "", "now", "scans", "missed"),
            row("publisher", self.publisher_hz, publisher.written, &missed(publisher.written), &call),
            row("critical", self.critical_hz, critical.received, &missed(critical.received), &silence),
            row("remote", self.remote_hz, remote.received, &remote_missed, &link),
            String::new(),
        ];
        lines.extend(timelines(tally, window, now));
        lines
    }

    fn line(&self) -> String {
        let link = if self.stalled_s.is_some() { "down" } else { "up" };
        format!(
            "  {:>3} s  publisher {:>2} Hz   critical {:>2} Hz, missed {:>3}   remote {:>2} Hz, link {link}",
            self.elapsed_s, self.publisher_hz, self.critical_hz, self.figures.critical.lost, self.remote_hz,
        )
    }
}

/// The timelines of link, publisher and critical subscriber, a character for each half second or more.
fn timelines(tally: &Tally, window: &Window, now: MonotonicNs) -> [String; 3] {
    let seconds = window.end().since(window.start()) / 1_000_000_000;
    let cell_ms = (seconds * 1_000).div_ceil(TIMELINE_CELLS).next_multiple_of(CELL_MIN_MS);
    let in_cell = (cell_ms * RATE_HZ / 1_000) as usize;
    let mut link = String::from("  remote link ");
    let mut publisher = String::from("  publisher   ");
    let mut critical = String::from("  critical    ");
    for cell in 0..(seconds * 1_000).div_ceil(cell_ms) {
        let from = window.start().plus_ms(cell * cell_ms);
        let to = window.start().plus_ms((cell + 1) * cell_ms);
        if to > now || to > window.end() {
            break;
        }
        // Stalls begin and end at multiples of half a second.
        let halves = (0..cell_ms / CELL_MIN_MS).map(|half| from.plus_ms(half * CELL_MIN_MS));
        let up = halves.filter(|half| !window.is_stalled(*half)).count();
        link.push(shade(up, (cell_ms / CELL_MIN_MS) as usize));
        publisher.push(shade(tally.written_in(window, from..to), in_cell));
        critical.push(shade(tally.arrived_in(Role::Critical, window, from..to), in_cell));
    }
    link = format!("{link:<55}# all   + some   . none");
    [link, publisher, critical]
}

/// The character of a timeline cell: all, some or none of the expected scans.
fn shade(scans: usize, expected: usize) -> char {
    match scans {
        0 => '.',
        few if few * 5 < expected * 4 => '+',
        _ => '#',
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::demo::due_at;
    use crate::cli::demo::report::Report;

    #[test]
    fn every_line_fits_a_terminal_of_80_columns() {
        for seconds in [6, 18, 600] {
            let began_at = MonotonicNs(5_000_000_000);
            let window = Window { began_at, numbers: 30..30 + seconds * RATE_HZ };
            let mut tally = Tally::default();
            for number in window.numbers.clone() {
                let taken_at = due_at(began_at, number);
                tally.add(Role::Publisher, Report::Published { number, call_ns: 100_123_456, written: true });
                for role in [Role::Critical, Role::Remote] {
                    tally.add(role, Report::Arrived { number, taken_at, arrived_at: taken_at });
                }
            }
            for stalled_since in [None, Some(window.start())] {
                let view = View::of(&tally, &window, stalled_since, window.end());
                let mut lines = view.table(Setup::Direct, &tally, &window, window.end());
                lines.push(view.line());
                for line in lines {
                    assert!(line.chars().count() < 80, "{} columns: {line}", line.chars().count());
                }
            }
        }
    }

    #[test]
    fn a_timeline_shows_when_nothing_arrived() {
        assert_eq!([0, 1, 11, 12, 15, 40].map(|scans| shade(scans, 15)), ['.', '+', '+', '#', '#', '#']);
    }
}
