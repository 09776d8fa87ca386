//! A child process of a test: keeps its output, can be stopped and killed, and never outlives its test.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::Instant;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::Pid;

use super::patience;

/// The number of output lines that are printed when a test fails.
const TAIL_LINES: usize = 20;

/// A figure of `/proc/PID/status` in KiB: `VmRSS`, the resident memory, or `RssAnon`, its anonymous part.
pub fn memory_kib(pid: i32, field: &str) -> i64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(field)).unwrap();
    line.trim_start_matches(':').trim().trim_end_matches(" kB").parse().unwrap()
}

/// The lines of one output stream that have been read so far.
#[derive(Default)]
struct Lines {
    state: Mutex<LinesState>,
    changed: Condvar,
    /// While it is locked, the thread does not read the stream.
    reading: Mutex<()>,
}

#[derive(Default)]
struct LinesState {
    lines: Vec<String>,
    ended: bool,
}

impl Lines {
    fn read_from(stream: impl Read + Send + 'static) -> Arc<Lines> {
        let lines = Arc::new(Lines::default());
        let sink = Arc::clone(&lines);
        std::thread::spawn(move || {
            // Invalid UTF-8 is replaced, so that a log never makes a test fail.
            let mut stream = BufReader::new(stream);
            let mut line = Vec::new();
            loop {
                drop(sink.reading.lock());
                if !matches!(stream.read_until(b'\n', &mut line), Ok(count) if count > 0) {
                    break;
                }
                let text = String::from_utf8_lossy(&line).trim_end().to_owned();
                sink.state.lock().unwrap().lines.push(text);
                sink.changed.notify_all();
                line.clear();
            }
            sink.state.lock().unwrap().ended = true;
            sink.changed.notify_all();
        });
        lines
    }
}

/// Keeps a [`Process`]'s stderr from being read.
pub struct UnreadLog<'a>(#[allow(dead_code, reason = "holds the lock")] MutexGuard<'a, ()>);

/// A child process, the leader of its own process group.
///
/// Dropping it kills the whole group. The kernel kills the child when the test's thread or process ends. If
/// the test fails, the child's log and the end of its output are printed.
pub struct Process {
    name: String,
    child: Child,
    stdout: Arc<Lines>,
    stderr: Arc<Lines>,
}

impl Process {
    /// Starts a process with an empty stdin. Must be called on the test's own thread: the kernel kills the
    /// child when the thread that started it ends.
    pub fn spawn(name: &str, command: Command) -> Process {
        Self::spawn_piped(name, command, Stdio::null())
    }

    /// Like [`Process::spawn`], with a stdin for [`Process::write_stdin`], which [`Process::wait`] closes.
    pub fn spawn_with_stdin(name: &str, command: Command) -> Process {
        Self::spawn_piped(name, command, Stdio::piped())
    }

    fn spawn_piped(name: &str, mut command: Command, stdin: Stdio) -> Process {
        command.stdin(stdin).stdout(Stdio::piped()).stderr(Stdio::piped()).process_group(0);
        // SAFETY: between fork and exec the closure makes one system call (prctl), which is
        // async-signal-safe; it neither allocates nor takes a lock.
        unsafe {
            command
                .pre_exec(|| nix::sys::prctl::set_pdeathsig(Signal::SIGKILL).map_err(std::io::Error::from));
        }
        let mut child =
            command.spawn().unwrap_or_else(|error| panic!("{name}: {command:?} cannot be started: {error}"));
        let stdout = Lines::read_from(child.stdout.take().unwrap());
        let stderr = Lines::read_from(child.stderr.take().unwrap());
        Process { name: name.to_owned(), child, stdout, stderr }
    }

    /// Writes to its stdin.
    pub fn write_stdin(&mut self, bytes: &[u8]) {
        let stdin = self.child.stdin.as_mut().unwrap_or_else(|| panic!("{} has no stdin", self.name));
        stdin.write_all(bytes).unwrap_or_else(|error| panic!("cannot write to {}: {error}", self.name));
    }

    /// The process id.
    pub fn pid(&self) -> Pid {
        Pid::from_raw(self.child.id() as i32)
    }

    /// Sends a signal to the process, not to its children.
    pub fn signal(&self, signal: Signal) {
        kill(self.pid(), signal).unwrap_or_else(|error| panic!("{signal} to {}: {error}", self.name));
    }

    /// Sends a signal to the process and to its children in the same group.
    pub fn signal_group(&self, signal: Signal) {
        killpg(self.pid(), signal).unwrap_or_else(|error| panic!("{signal} to {}: {error}", self.name));
    }

    /// Stops it (SIGSTOP).
    pub fn stop(&self) {
        self.signal(Signal::SIGSTOP);
    }

    /// Continues it (SIGCONT).
    pub fn cont(&self) {
        self.signal(Signal::SIGCONT);
    }

    /// Kills it (SIGKILL) and reaps it; returns its exit status.
    pub fn kill9(&mut self) -> ExitStatus {
        self.signal(Signal::SIGKILL);
        self.wait()
    }

    /// Terminates it (SIGTERM) and waits for its end.
    pub fn terminate(&mut self) -> ExitStatus {
        if self.is_running() {
            self.signal(Signal::SIGTERM);
        }
        self.wait()
    }

    /// Whether it has not ended yet; a stopped process counts as running.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Closes its stdin and waits until it has ended and its output has been read.
    pub fn wait(&mut self) -> ExitStatus {
        self.child.stdin = None;
        let what = format!("the end of {}", self.name);
        let status = super::wait_for(&what, || self.child.try_wait().unwrap());
        // A grandchild may keep the pipe open, so that waiting for the end of the output has a limit of 1 s.
        let deadline = Instant::now() + std::time::Duration::from_secs(1);
        for lines in [&self.stdout, &self.stderr] {
            let mut state = lines.state.lock().unwrap();
            while !state.ended && Instant::now() < deadline {
                let left = deadline.saturating_duration_since(Instant::now());
                state = lines.changed.wait_timeout(state, left).unwrap().0;
            }
        }
        status
    }

    /// What it is, for messages: such as `Cyclone sub on laptop`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The lines of its stdout so far.
    pub fn stdout_lines(&self) -> Vec<String> {
        self.stdout.state.lock().unwrap().lines.clone()
    }

    /// Searches the lines of its stdout so far from the last one back.
    pub fn find_last_line<T>(&self, find: impl FnMut(&String) -> Option<T>) -> Option<T> {
        self.stdout.state.lock().unwrap().lines.iter().rev().find_map(find)
    }

    /// Its output on stderr so far.
    pub fn log(&self) -> String {
        self.stderr.state.lock().unwrap().lines.join("\n")
    }

    /// Nobody reads its stderr while the returned guard exists.
    pub fn leave_log_unread(&self) -> UnreadLog<'_> {
        UnreadLog(self.stderr.reading.lock().unwrap())
    }

    /// Waits until `find` returns a value for a line of stdout, from line `from` on; returns the value and
    /// the number of the next line. Panics with the last lines if the output ends or after [`patience`].
    pub fn wait_for_line<T>(
        &self,
        what: &str,
        from: usize,
        mut find: impl FnMut(&str) -> Option<T>,
    ) -> (T, usize) {
        let deadline = Instant::now() + patience();
        let mut at = from;
        let mut state = self.stdout.state.lock().unwrap();
        loop {
            while at < state.lines.len() {
                at += 1;
                if let Some(value) = find(&state.lines[at - 1]) {
                    return (value, at);
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if state.ended || left.is_zero() {
                let why = if state.ended { "its output ended" } else { "timed out" };
                let tail = state.lines[state.lines.len().saturating_sub(TAIL_LINES)..].join("\n");
                drop(state);
                panic!("{}: {why} while waiting for: {what}; its last lines:\n{tail}", self.name);
            }
            state = self.stdout.changed.wait_timeout(state, left).unwrap().0;
        }
    }

    /// Waits until a line of its log contains `text`.
    pub fn wait_for_log(&self, text: &str) {
        super::wait_until(format!("'{text}' in the log of {}", self.name), || self.log().contains(text));
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // The only expected error is that the group no longer exists.
        let _ = killpg(self.pid(), Signal::SIGKILL);
        let _ = self.child.wait();
        if std::thread::panicking() {
            let lines = self.stdout_lines();
            let tail = lines[lines.len().saturating_sub(TAIL_LINES)..].join("\n");
            eprintln!("--- {}, end of its output:\n{tail}\n--- its log:\n{}\n---", self.name, self.log());
        }
    }
}

/// Sends a signal to a process that the test did not start itself, such as a child of `up`.
pub fn signal(pid: i32, signal: Signal) {
    nix::sys::signal::kill(Pid::from_raw(pid), signal)
        .unwrap_or_else(|error| panic!("{signal} to {pid}: {error}"));
}
