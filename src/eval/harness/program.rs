//! A child process that speaks JSON, one object on each line of its stdout, and logs to a file.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::Pid;
use serde_json::Value;

use crate::clock;
use crate::eval::error::EvalError;
use crate::model::MonotonicNs;

/// How often it is looked for the last line of a program, 10 ms apart.
const LAST_WORDS_TRIES: u32 = 100;

/// A line of output and when it came.
pub(super) type Said = (MonotonicNs, Value);

/// A running child, the leader of a process group. Dropping it kills the group.
pub(super) struct Program {
    pub name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Receiver<Said>,
    /// The latest line of each event; a line without one is of event "".
    latest: BTreeMap<String, Said>,
    ended: Option<ExitStatus>,
}

impl Program {
    /// Starts it. Call it on a thread that lives as long as the run: its end kills the child.
    pub fn start(name: &str, mut command: Command, logs: &Path) -> Result<Self, EvalError> {
        let log = logs.join(format!("{name}.log"));
        // It may be a second start of the same program.
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

    /// Its process id.
    pub fn pid(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.child.id()).unwrap_or(0))
    }

    /// Takes in what it has said; yields the lines without an event.
    pub fn listen(&mut self) -> Vec<Said> {
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
    pub fn said(&mut self, event: &str) -> Option<&Value> {
        self.listen();
        self.latest.get(event).map(|(_, value)| value)
    }

    /// Takes the latest line of an event and when it came, so that the next one is another.
    pub fn take(&mut self, event: &str) -> Option<Said> {
        self.listen();
        self.latest.remove(event)
    }

    /// The last line of an event of one that has ended; some of what it said may still be on its way.
    pub fn last_words(&mut self, event: &str) -> Option<Value> {
        for _ in 0..LAST_WORDS_TRIES {
            if let Some(said) = self.said(event) {
                return Some(said.clone());
            }
            thread::sleep(Duration::from_millis(10));
        }
        None
    }

    /// Writes a line to its stdin. One that has gone does not hear it, which is found elsewhere.
    pub fn tell(&mut self, line: &str) {
        if let Some(stdin) = &mut self.stdin {
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) {
        if self.ended.is_none() {
            let _ = kill(self.pid(), signal);
        }
    }

    /// How it ended, once it has.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        if self.ended.is_none() {
            self.ended = self.child.try_wait().unwrap_or(None);
        }
        self.ended
    }

    /// Asks it to end (SIGTERM), and kills it after a patience; whether it ended as asked.
    pub fn end(&mut self, patience: Duration) -> bool {
        self.signal(Signal::SIGCONT);
        self.signal(Signal::SIGTERM);
        let deadline = clock::monotonic().plus_ns(u64::try_from(patience.as_nanos()).unwrap_or(u64::MAX));
        while self.ended().is_none() {
            if clock::monotonic() >= deadline {
                self.kill();
                return false;
            }
            thread::sleep(Duration::from_millis(5));
        }
        self.ended.is_some_and(|status| status.success())
    }

    fn kill(&mut self) {
        let _ = killpg(self.pid(), Signal::SIGKILL);
        // SIGKILL can't be refused, so this wait is short.
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

/// Passes on each line that is JSON. Programs say nothing else there.
fn read(stdout: ChildStdout, sender: &Sender<Said>) {
    for line in BufReader::new(stdout).lines().map_while(Result::ok) {
        if let Ok(value) = serde_json::from_str(&line)
            && sender.send((clock::monotonic(), value)).is_err()
        {
            return;
        }
    }
}
