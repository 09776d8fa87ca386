//! A child process that writes JSON to stdout, one object per line, and its log to a file.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::model::MonotonicNs;
use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::Pid;
use serde_json::Value;

use crate::error::EvalError;

/// How often [`Program::wait_for_last`] reads the output, every 10 ms.
const LAST_LINE_TRIES: u32 = 100;

/// A line of output and its time of arrival.
pub(super) type TimedLine = (MonotonicNs, Value);

/// A running child, the leader of a process group. Dropping it kills the group.
pub(super) struct Program {
    pub name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Receiver<TimedLine>,
    /// The latest line of each event.
    latest: BTreeMap<String, TimedLine>,
    ended: Option<ExitStatus>,
}

impl Program {
    /// Starts the program. Must be called on a thread that lives as long as the run, as the thread's end
    /// kills the child.
    pub fn start(name: &str, mut command: Command, logs: &Path) -> Result<Self, EvalError> {
        let log = logs.join(format!("{name}.log"));
        // Append: the same program may have been started before.
        let log = File::options().append(true).create(true).open(&log);
        let log = log.map_err(|error| EvalError::file(logs, &error))?;
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log).process_group(0);
        let program = format!("{command:?}");
        let mut child = command.spawn().map_err(|error| EvalError::new(format!("{program}: {error}")))?;
        let (sender, lines) = channel();
        if let Some(stdout) = child.stdout.take() {
            thread::spawn(move || read(stdout, &sender));
        }
        let stdin = child.stdin.take();
        Ok(Self { name: name.to_owned(), child, stdin, lines, latest: BTreeMap::new(), ended: None })
    }

    /// The process id of the child.
    pub fn pid(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.child.id()).unwrap_or(0))
    }

    /// Reads the lines since the last call: keeps the latest line of each event, and returns lines without an
    /// event.
    pub fn read_lines(&mut self) -> Vec<TimedLine> {
        let mut plain = Vec::new();
        for (time, value) in self.lines.try_iter() {
            match value["event"].as_str().map(str::to_owned) {
                Some(event) => {
                    self.latest.insert(event, (time, value));
                }
                None => plain.push((time, value)),
            }
        }
        plain
    }

    /// The latest line of an event so far.
    pub fn latest(&mut self, event: &str) -> Option<&Value> {
        self.read_lines();
        self.latest.get(event).map(|(_, value)| value)
    }

    /// Removes and returns the latest line of an event, so that the next call does not return the same one.
    pub fn take_latest(&mut self, event: &str) -> Option<TimedLine> {
        self.read_lines();
        self.latest.remove(event)
    }

    /// The last line of an event after the program has ended. Waits up to 1 s, as the thread that reads the
    /// output may be late.
    pub fn wait_for_last(&mut self, event: &str) -> Option<Value> {
        for _ in 0..LAST_LINE_TRIES {
            if let Some(line) = self.latest(event) {
                return Some(line.clone());
            }
            #[allow(clippy::disallowed_methods, reason = "the harness handles no samples")]
            thread::sleep(Duration::from_millis(10));
        }
        None
    }

    /// Writes a line to the program's stdin. Ignores errors: [`Self::ended`] finds a program that has ended.
    pub fn send_line(&mut self, line: &str) {
        if let Some(stdin) = &mut self.stdin {
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Sends a signal to the program, unless it has ended.
    pub fn signal(&self, signal: Signal) {
        if self.ended.is_none() {
            let _ = kill(self.pid(), signal);
        }
    }

    /// The exit status of the program, once it has ended.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        if self.ended.is_none() {
            self.ended = self.child.try_wait().unwrap_or(None);
        }
        self.ended
    }

    /// Ends the program with SIGTERM, and kills it after a timeout; returns whether it ended with success.
    pub fn end(&mut self, timeout: Duration) -> bool {
        self.signal(Signal::SIGCONT);
        self.signal(Signal::SIGTERM);
        let deadline = clock::monotonic().plus_ns(u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX));
        while self.ended().is_none() {
            if clock::monotonic() >= deadline {
                self.kill();
                return false;
            }
            #[allow(clippy::disallowed_methods, reason = "the harness handles no samples")]
            thread::sleep(Duration::from_millis(5));
        }
        self.ended.is_some_and(|status| status.success())
    }

    fn kill(&mut self) {
        let _ = killpg(self.pid(), Signal::SIGKILL);
        // A process cannot ignore SIGKILL, so this wait is short.
        self.ended = self.child.wait().ok();
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        if self.ended().is_none() {
            self.kill();
        }
    }
}

/// Sends each line of JSON to the receiver; ignores other lines.
fn read(stdout: ChildStdout, sender: &Sender<TimedLine>) {
    for line in BufReader::new(stdout).lines().map_while(Result::ok) {
        if let Ok(value) = serde_json::from_str(&line)
            && sender.send((clock::monotonic(), value)).is_err()
        {
            return;
        }
    }
}
