//! `impair`: an impaired link in the present network namespace, switched by words on stdin.

use std::fmt;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::net::Ipv4Addr;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::process::ExitCode;

use clap::Args;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::{TimeSpec, TimeValLike};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};

use super::failed;
use crate::clock;
use crate::eval::impairment::{
    self, Backend, BackendChoice, Counters, GilbertElliott, Impairment, ImpairmentError, Level, LinkState,
    NormalDelay, Opened, Reading,
};

/// The longest line that is read from stdin.
const LINE_MAX_BYTES: usize = 256;

/// What `impair` is asked.
#[derive(Args, Debug)]
#[command(
    after_help = "On stdin: `on`, `off` and `down` (every packet is lost) switch the link, `counters` \
                        shows what it has done."
)]
pub(super) struct Arguments {
    /// The IPv4 address of the host whose packets are lost and delayed
    #[arg(long, value_name = "ADDRESS")]
    source: Ipv4Addr,
    /// On a host that passes packets on: only those for this address (NFQUEUE only)
    #[arg(long, value_name = "ADDRESS")]
    destination: Option<Ipv4Addr>,
    /// Loss by a row of the paper's Table I
    #[arg(long, value_enum, default_value = "clean")]
    level: Level,
    /// Which reading of Table I: its last columns, or what the paper's harness made of them
    #[arg(long, value_enum, required_if_eq_any = [("level", "mild"), ("level", "moderate"), ("level", "strong")])]
    reading: Option<Reading>,
    /// Loss by the four probabilities of a Gilbert-Elliott chain: good to bad, bad to good, lost in good,
    /// lost in bad; 0 to 1 each
    #[arg(long, num_args = 4, value_names = ["P", "R", "GOOD", "BAD"], conflicts_with_all = ["level", "reading"])]
    gilbert_elliott: Option<Vec<f64>>,
    /// Mean delay
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    delay_ms: f64,
    /// Standard deviation of the delay
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    jitter_ms: f64,
    /// The same losses and delays for the same seed (NFQUEUE only)
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// State of the link to begin with
    #[arg(long, value_name = "on|off|down", default_value_t = LinkState::On)]
    state: LinkState,
    /// What does it
    #[arg(long, value_enum, default_value = "auto")]
    backend: BackendChoice,
    /// A number of an NFQUEUE (or of an ifb) that no other program in this network namespace uses
    #[arg(long, value_name = "N", default_value_t = 0)]
    queue: u16,
    /// Print JSON (docs/eval-json.md), one object on each line
    #[arg(long)]
    json: bool,
}

impl Arguments {
    fn impairment(&self) -> Result<Impairment, ImpairmentError> {
        let loss = match self.gilbert_elliott.as_deref() {
            Some(&[p, r, good, bad]) => GilbertElliott::new(p, r, good, bad)?,
            // A reading is there for every level that has two.
            _ => self.level.model(self.reading.unwrap_or(Reading::AsPrinted)),
        };
        Ok(Impairment { loss, delay: NormalDelay::new(self.delay_ms, self.jitter_ms)?, seed: self.seed })
    }
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let impairment = match arguments.impairment() {
        Ok(impairment) => impairment,
        Err(error) => {
            failed(&error);
            return ExitCode::from(2);
        }
    };
    match impair(arguments, &impairment) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&error),
    }
}

fn impair(arguments: &Arguments, impairment: &Impairment) -> Result<(), ImpairmentError> {
    // Before anything is set up, so that a signal always finds who removes it.
    let signals = signals().map_err(|error| ImpairmentError::system("signal handlers", error))?;
    let Opened { backend, reason } = {
        let Arguments { backend, source, destination, queue, .. } = arguments;
        impairment::open(*backend, *source, *destination, *queue, impairment)?
    };
    let mut link = Running { arguments, impairment, backend, reason };
    if arguments.state != LinkState::On {
        link.backend.switch(arguments.state)?;
    }
    if link.show(Event::Ready)? {
        link.serve(&signals)?;
        link.show(Event::Ended)?;
    }
    Ok(())
}

/// A stream that becomes readable with SIGINT and SIGTERM.
fn signals() -> io::Result<UnixStream> {
    let (reader, writer) = UnixStream::pair()?;
    for signal in [SIGINT, SIGTERM] {
        signal_hook::low_level::pipe::register(signal, writer.try_clone()?)?;
    }
    Ok(reader)
}

struct Running<'a> {
    arguments: &'a Arguments,
    impairment: &'a Impairment,
    backend: Box<dyn Backend>,
    reason: String,
}

impl Running<'_> {
    /// Works until a signal comes, or who reads stdout has gone.
    fn serve(&mut self, signals: &UnixStream) -> Result<(), ImpairmentError> {
        // Without a buffer, in which a line could wait while poll sees nothing.
        let stdin = io::stdin().as_fd().try_clone_to_owned();
        let mut stdin = File::from(stdin.map_err(|error| ImpairmentError::system("stdin", error))?);
        let mut commands = Some(Commands::default());
        loop {
            let (signal, input) = {
                let mut fds = vec![PollFd::new(signals.as_fd(), PollFlags::POLLIN)];
                if commands.is_some() {
                    fds.push(PollFd::new(stdin.as_fd(), PollFlags::POLLIN));
                }
                let own = fds.len();
                fds.extend(self.backend.fd().map(|fd| PollFd::new(fd, PollFlags::POLLIN)));
                match ppoll(&mut fds, self.timeout(), None) {
                    Ok(_) | Err(Errno::EINTR) => {}
                    Err(error) => return Err(ImpairmentError::system("poll", error)),
                }
                // An end of file and an error are found by reading.
                let ready = |fd: Option<&PollFd>| fd.and_then(PollFd::any).unwrap_or(false);
                (ready(fds.first()), ready(fds[..own].get(1)))
            };
            self.backend.work(clock::monotonic())?;
            if signal {
                return Ok(());
            }
            if let Some(reader) = commands.as_mut().filter(|_| input) {
                let lines = reader.read(&mut stdin);
                if lines.is_none() {
                    // Whoever gave the commands has gone or gives none: the link stays as it is.
                    commands = None;
                }
                for line in lines.unwrap_or_default() {
                    if !self.obey(line.trim())? {
                        return Ok(());
                    }
                }
            }
        }
    }

    fn timeout(&self) -> Option<TimeSpec> {
        let wait_ns = self.backend.next_release()?.since(clock::monotonic());
        Some(TimeSpec::nanoseconds(i64::try_from(wait_ns).unwrap_or(i64::MAX)))
    }

    /// Obeys a line of stdin; `false` when nobody reads the answer.
    fn obey(&mut self, line: &str) -> Result<bool, ImpairmentError> {
        match (line, line.parse()) {
            ("", _) => Ok(true),
            ("counters", _) => self.show(Event::Counters),
            (_, Ok(state)) => {
                self.backend.switch(state)?;
                self.show(Event::Changed)
            }
            (_, Err(_)) => {
                eprintln!("adaptive-bridge-eval: '{line}' is not one of on, off, down, counters");
                Ok(true)
            }
        }
    }

    /// Prints what the link does; `false` when nobody reads it.
    fn show(&mut self, event: Event) -> Result<bool, ImpairmentError> {
        let report = Report {
            event,
            backend: self.backend.name(),
            reason: &self.reason,
            source: self.arguments.source,
            destination: self.arguments.destination,
            state: self.backend.state(),
            seed: self.backend.is_seeded().then_some(self.impairment.seed),
            p: self.impairment.loss.p(),
            r: self.impairment.loss.r(),
            loss_good: self.impairment.loss.loss_good(),
            loss_bad: self.impairment.loss.loss_bad(),
            delay_ms: self.impairment.delay.mean_ms(),
            jitter_ms: self.impairment.delay.sigma_ms(),
            counters: self.backend.counters()?,
            kernel_dropped: self.backend.kernel_dropped()?,
            loss: Loss::default(),
        };
        let report = Report { loss: Loss::of(&self.impairment.loss, &report.counters), ..report };
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

/// Why something is shown.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(rename_all = "lowercase")]
enum Event {
    /// The link is in place.
    Ready,
    /// It was switched.
    Changed,
    /// It was asked for.
    Counters,
    /// The link is about to be removed.
    Ended,
}

/// A line of output; docs/eval-json.md describes it.
#[derive(Debug, Serialize)]
struct Report<'a> {
    event: Event,
    backend: &'static str,
    reason: &'a str,
    source: Ipv4Addr,
    destination: Option<Ipv4Addr>,
    state: LinkState,
    seed: Option<u64>,
    p: f64,
    r: f64,
    loss_good: f64,
    loss_bad: f64,
    delay_ms: f64,
    jitter_ms: f64,
    #[serde(flatten)]
    counters: Counters,
    kernel_dropped: u64,
    #[serde(flatten)]
    loss: Loss,
}

/// The loss that was applied while the link was on, and that of the model.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Loss {
    loss: Option<f64>,
    loss_expected: f64,
    loss_standard_error: Option<f64>,
}

impl Loss {
    fn of(model: &GilbertElliott, counters: &Counters) -> Self {
        let any = counters.judged > 0;
        Self {
            loss: any.then(|| counters.lost as f64 / counters.judged as f64),
            loss_expected: model.stationary_loss(),
            loss_standard_error: any.then(|| model.loss_standard_error(counters.judged)),
        }
    }
}

impl fmt::Display for Report<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { counters, loss, .. } = self;
        if let Event::Ready = self.event {
            let expected = loss.loss_expected * 100.0;
            return write!(
                f,
                "{} from {}: {expected:.2} % lost in the long run, {} ± {} ms, by {} ({})",
                self.state, self.source, self.delay_ms, self.jitter_ms, self.backend, self.reason
            );
        }
        write!(f, "{}: {} packets seen, {} passed", self.state, counters.seen, counters.passed)?;
        if let (Some(share), Some(error)) = (loss.loss, loss.loss_standard_error) {
            let [share, error, expected] =
                [share, 1.96 * error, loss.loss_expected].map(|share| share * 100.0);
            let (lost, judged) = (counters.lost, counters.judged);
            write!(f, ", {lost} of {judged} lost ({share:.2} % ± {error:.2}, {expected:.2} % expected)")?;
        }
        for (count, what) in [
            (counters.cut, "lost while down"),
            (counters.overflowed, "dropped as too many were on their way"),
            (counters.held, "on their way"),
            (self.kernel_dropped, "dropped by the kernel before the link"),
        ] {
            if count > 0 {
                write!(f, ", {count} {what}")?;
            }
        }
        Ok(())
    }
}

/// Lines from stdin, of which only whole ones count.
#[derive(Default)]
struct Commands {
    begun: Vec<u8>,
}

impl Commands {
    /// Reads what there is; `None` at its end.
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
                lines.push(String::from_utf8_lossy(&self.begun).into_owned());
                self.begun.clear();
            } else if self.begun.len() < LINE_MAX_BYTES {
                self.begun.push(*byte);
            }
        }
        Some(lines)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_come_in_pieces_and_several_at_once() {
        let mut commands = Commands::default();
        assert_eq!(commands.read(&mut &b"of"[..]), Some(vec![]));
        assert_eq!(commands.read(&mut &b"f\non\ndo"[..]), Some(vec!["off".to_owned(), "on".to_owned()]));
        assert_eq!(commands.read(&mut &b"wn\n"[..]), Some(vec!["down".to_owned()]));
        assert_eq!(commands.read(&mut &b""[..]), None);
        for _ in 0..100 {
            assert_eq!(commands.read(&mut &[b'x'; LINE_MAX_BYTES][..]), Some(vec![]));
        }
        assert_eq!(commands.begun.len(), LINE_MAX_BYTES);
    }
}
