//! `impair`: an impaired link in the current network namespace, controlled by commands on stdin.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::net::Ipv4Addr;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use adaptive_bridge::clock;
use adaptive_bridge::model::MonotonicNs;
use clap::Args;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::{TimeSpec, TimeValLike};
use signal_hook::consts::{SIGINT, SIGTERM};

use super::failed;
use super::impair_report::{Event, Loss, Report, TraceReport};
use crate::impairment::{
    self, Backend, BackendChoice, GilbertElliott, Impairment, ImpairmentError, Level, LinkState, NormalDelay,
    Opened, Reading, Replay, Trace, TraceRow,
};

/// The longest command that is read from stdin; the rest of a longer line is discarded.
const LINE_MAX_BYTES: usize = 256;

/// Command-line arguments of `impair`.
#[derive(Args, Debug)]
#[command(
    after_help = "Commands on stdin: `on`, `off` (every packet passes) and `down` (every packet is lost) \
                        switch the link; `counters` prints its counters."
)]
pub(super) struct Arguments {
    /// The IPv4 address of the host whose packets are dropped and delayed
    #[arg(long, value_name = "ADDRESS")]
    source: Ipv4Addr,
    /// On a host that forwards packets: impair only those for this address (NFQUEUE only)
    #[arg(long, value_name = "ADDRESS")]
    destination: Option<Ipv4Addr>,
    /// Loss of a row of the paper's Table I
    #[arg(long, value_enum, default_value = "clean")]
    level: Level,
    /// Reading of Table I's loss columns: as printed, or swapped, as the paper's harness ran them
    #[arg(long, value_enum, required_if_eq_any = [("level", "mild"), ("level", "moderate"), ("level", "strong")])]
    reading: Option<Reading>,
    /// Loss of a Gilbert-Elliott chain with these four probabilities, 0 to 1 each: from good to bad, from
    /// bad to good, loss in the good state, loss in the bad state
    #[arg(long, num_args = 4, value_names = ["P", "R", "GOOD", "BAD"], conflicts_with_all = ["level", "reading"])]
    gilbert_elliott: Option<Vec<f64>>,
    /// Mean delay
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    delay_ms: f64,
    /// Standard deviation of the delay
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    jitter_ms: f64,
    /// Loss and delay that change over time by a trace of a link, a CSV file with the columns time_s, loss,
    /// delay_ms and, optionally, jitter_ms (config/scenarios/README.md). It starts when the link is first on
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with_all = ["level", "reading", "gilbert_elliott", "delay_ms", "jitter_ms"]
    )]
    trace: Option<PathBuf>,
    /// Restart the trace at its end instead of staying in its last row
    #[arg(long, requires = "trace")]
    trace_repeat: bool,
    /// Replay the trace this many times faster than its times, 0.001 to 100000
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = speed, requires = "trace")]
    trace_speed: f64,
    /// Seed of losses and delays: the same seed gives the same ones (NFQUEUE only)
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// State of the link at the start
    #[arg(long, value_name = "on|off|down", default_value_t = LinkState::On)]
    state: LinkState,
    /// Back end that impairs the link
    #[arg(long, value_enum, default_value = "auto")]
    backend: BackendChoice,
    /// Number of the NFQUEUE (or of the ifb); no other program in this network namespace may use it
    #[arg(long, value_name = "N", default_value_t = 0)]
    queue: u16,
    /// Print JSON (docs/eval-json.md), one object on each line
    #[arg(long)]
    json: bool,
}

/// Parses the factor by which a trace is sped up or slowed down.
fn speed(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(speed) if (0.001..=100_000.0).contains(&speed) => Ok(speed),
        _ => Err("must be 0.001 to 100000".to_owned()),
    }
}

impl Arguments {
    fn replay(&self) -> Result<Option<Replay>, ImpairmentError> {
        let Some(path) = &self.trace else { return Ok(None) };
        let (trace, _) = Trace::load(path)?;
        Ok(Some(Replay::new(trace.at_speed(self.trace_speed), self.trace_repeat)))
    }

    fn impairment(&self) -> Result<Impairment, ImpairmentError> {
        let loss = match self.gilbert_elliott.as_deref() {
            Some(&[p, r, good, bad]) => GilbertElliott::new(p, r, good, bad)?,
            // clap requires --reading for every level for which the readings differ.
            _ => self.level.model(self.reading.unwrap_or(Reading::AsPrinted)),
        };
        Ok(Impairment { loss, delay: NormalDelay::new(self.delay_ms, self.jitter_ms)?, seed: self.seed })
    }
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let (impairment, replay) = match (arguments.impairment(), arguments.replay()) {
        (Ok(impairment), Ok(replay)) => (impairment, replay),
        (Err(error), _) | (_, Err(error)) => {
            failed(&error);
            return ExitCode::from(2);
        }
    };
    match impair(arguments, impairment, replay) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&error),
    }
}

fn impair(
    arguments: &Arguments,
    model: Impairment,
    mut replay: Option<Replay>,
) -> Result<(), ImpairmentError> {
    // Before the link is set up, so that a signal never ends this process without removing the link.
    let signals = signals().map_err(|error| ImpairmentError::system("signal handlers", error))?;
    let Opened { backend, reason } = {
        let Arguments { backend, source, destination, queue, .. } = arguments;
        // A trace stays in its first row until it starts.
        let first_row = replay.as_ref().map(|replay| *replay.current_row());
        let initial =
            first_row.map_or(model, |TraceRow { loss, delay, .. }| Impairment { loss, delay, ..model });
        impairment::open(*backend, *source, *destination, *queue, &initial)?
    };
    if let Some(replay) = replay.as_mut().filter(|_| arguments.state == LinkState::On) {
        replay.start(clock::monotonic());
    }
    let mut link = RunningLink { arguments, model, replay, backend, reason };
    if arguments.state != LinkState::On {
        link.backend.switch(arguments.state)?;
    }
    if link.print(Event::Ready)? {
        link.serve(&signals)?;
        link.print(Event::Ended)?;
    }
    Ok(())
}

/// Returns a stream that becomes readable when SIGINT or SIGTERM arrives.
fn signals() -> io::Result<UnixStream> {
    let (reader, writer) = UnixStream::pair()?;
    for signal in [SIGINT, SIGTERM] {
        signal_hook::low_level::pipe::register(signal, writer.try_clone()?)?;
    }
    Ok(reader)
}

struct RunningLink<'a> {
    arguments: &'a Arguments,
    /// The impairment when there is no trace.
    model: Impairment,
    replay: Option<Replay>,
    backend: Box<dyn Backend>,
    reason: String,
}

impl RunningLink<'_> {
    /// Runs the link until a signal arrives or the reader of stdout has closed it.
    fn serve(&mut self, signals: &UnixStream) -> Result<(), ImpairmentError> {
        // Unbuffered: a line in a buffer would not wake poll.
        let stdin = io::stdin().as_fd().try_clone_to_owned();
        let mut stdin = File::from(stdin.map_err(|error| ImpairmentError::system("stdin", error))?);
        let mut commands = Some(Commands::default());
        loop {
            let (signal, input) = {
                let mut fds = vec![PollFd::new(signals.as_fd(), PollFlags::POLLIN)];
                if commands.is_some() {
                    fds.push(PollFd::new(stdin.as_fd(), PollFlags::POLLIN));
                }
                let before_backend = fds.len();
                fds.extend(self.backend.fd().map(|fd| PollFd::new(fd, PollFlags::POLLIN)));
                match ppoll(&mut fds, self.timeout(), None) {
                    Ok(_) | Err(Errno::EINTR) => {}
                    Err(error) => return Err(ImpairmentError::system("poll", error)),
                }
                // Reading finds out whether it is data, the end of the file or an error.
                let ready = |fd: Option<&PollFd>| fd.and_then(PollFd::any).unwrap_or(false);
                (ready(fds.first()), ready(fds[..before_backend].get(1)))
            };
            let now = clock::monotonic();
            self.advance_trace(now)?;
            self.backend.work()?;
            if signal {
                return Ok(());
            }
            if let Some(reader) = commands.as_mut().filter(|_| input) {
                let lines = reader.read(&mut stdin);
                if lines.is_none() {
                    // stdin has ended: the link keeps its state.
                    commands = None;
                }
                for line in lines.unwrap_or_default() {
                    if !self.execute(line.trim())? {
                        return Ok(());
                    }
                }
            }
        }
    }

    /// Applies the row of the trace that is in force at `now`.
    fn advance_trace(&mut self, now: MonotonicNs) -> Result<(), ImpairmentError> {
        let Some(replay) = &mut self.replay else { return Ok(()) };
        if replay.next_change().is_some_and(|change| change <= now) {
            replay.count(&self.backend.counters()?);
            let TraceRow { loss, delay, .. } = *replay.advance(now);
            self.backend.set(loss, delay)?;
        }
        Ok(())
    }

    fn timeout(&self) -> Option<TimeSpec> {
        let change = self.replay.as_ref().and_then(Replay::next_change);
        let next = [self.backend.next_release(), change].into_iter().flatten().min()?;
        let wait_ns = next.since(clock::monotonic());
        Some(TimeSpec::nanoseconds(i64::try_from(wait_ns).unwrap_or(i64::MAX)))
    }

    /// Executes a command from stdin; returns `false` when the reader of stdout has closed it.
    fn execute(&mut self, line: &str) -> Result<bool, ImpairmentError> {
        match (line, line.parse()) {
            ("", _) => Ok(true),
            ("counters", _) => self.print(Event::Counters),
            (_, Ok(state)) => {
                self.backend.switch(state)?;
                if let Some(replay) = self.replay.as_mut().filter(|_| state == LinkState::On) {
                    replay.start(clock::monotonic());
                }
                self.print(Event::Changed)
            }
            (_, Err(_)) => {
                eprintln!(
                    "adaptive-bridge-eval: unknown command '{line}'; must be on, off, down or counters"
                );
                Ok(true)
            }
        }
    }

    /// Prints the link's state and counters; returns `false` when the reader of stdout has closed it.
    fn print(&mut self, event: Event) -> Result<bool, ImpairmentError> {
        let counters = self.backend.counters()?;
        if let Some(replay) = &mut self.replay {
            replay.count(&counters);
        }
        let (loss, delay) = match &self.replay {
            Some(replay) => (replay.current_row().loss, replay.current_row().delay),
            None => (self.model.loss, self.model.delay),
        };
        let file = self.arguments.trace.as_deref().and_then(Path::file_name).unwrap_or_default();
        let file = file.to_string_lossy();
        let speed = self.arguments.trace_speed;
        let report = Report {
            event,
            backend: self.backend.name(),
            reason: &self.reason,
            source: self.arguments.source,
            destination: self.arguments.destination,
            state: self.backend.state(),
            seed: self.backend.is_seeded().then_some(self.model.seed),
            p: loss.p(),
            r: loss.r(),
            loss_good: loss.loss_good(),
            loss_bad: loss.loss_bad(),
            delay_ms: delay.mean_ms(),
            jitter_ms: delay.sigma_ms(),
            trace: self.replay.as_ref().map(|replay| TraceReport::of(replay, &file, speed, event)),
            counters,
            kernel_dropped: self.backend.kernel_dropped()?,
            loss: match &self.replay {
                Some(replay) => Loss::of_trace(replay, &counters),
                None => Loss::of_chain(&loss, &counters),
            },
        };
        let text = if self.arguments.json {
            serde_json::to_string(&report)
                .map_err(|error| ImpairmentError::Unexpected { what: format!("JSON: {error}") })?
        } else {
            report.to_string()
        };
        let mut stdout = io::stdout().lock();
        match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
            Err(error) => Err(ImpairmentError::system("stdout", error)),
        }
    }
}

/// Assembles whole lines from the pieces that stdin delivers.
#[derive(Default)]
struct Commands {
    partial_line: Vec<u8>,
}

impl Commands {
    /// Reads the available bytes; returns the lines that they complete, `None` at the end of the input.
    fn read(&mut self, input: &mut impl Read) -> Option<Vec<String>> {
        let mut bytes = [0; LINE_MAX_BYTES];
        let count = match input.read(&mut bytes) {
            Ok(0) => return None,
            Ok(count) => count,
            Err(error) if error.kind() == ErrorKind::Interrupted => 0,
            Err(_) => return None,
        };
        let mut lines = Vec::new();
        for byte in &bytes[..count] {
            if *byte == b'\n' {
                lines.push(String::from_utf8_lossy(&self.partial_line).into_owned());
                self.partial_line.clear();
            } else if self.partial_line.len() < LINE_MAX_BYTES {
                self.partial_line.push(*byte);
            }
        }
        Some(lines)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_read_may_return_part_of_a_command_or_several() {
        let mut commands = Commands::default();
        assert_eq!(commands.read(&mut &b"of"[..]), Some(vec![]));
        assert_eq!(commands.read(&mut &b"f\non\ndo"[..]), Some(vec!["off".to_owned(), "on".to_owned()]));
        assert_eq!(commands.read(&mut &b"wn\n"[..]), Some(vec!["down".to_owned()]));
        assert_eq!(commands.read(&mut &b""[..]), None);
        for _ in 0..100 {
            assert_eq!(commands.read(&mut &[b'x'; LINE_MAX_BYTES][..]), Some(vec![]));
        }
        assert_eq!(commands.partial_line.len(), LINE_MAX_BYTES);
    }
}
