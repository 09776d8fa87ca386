//! The processes of a demo: all are children of it, and none outlives it, however it ends.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::Duration;

use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::{Pid, getppid};

use super::DemoError;
use super::place::Place;
use super::report::Report;
use crate::clock;

/// The bridge has a second to end, of which its processes have 900 ms; then it is killed.
const BRIDGE_GRACE_MS: u64 = 3_000;

/// Variables that would change what the demo's processes do.
const FOREIGN_VARIABLES: [&str; 6] = [
    "ROS_DOMAIN_ID",
    "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_DISTRO",
    "ADAPTIVE_BRIDGE_CONFIG",
];

/// A process of the demo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Who {
    Publisher,
    Critical,
    Remote,
    Bridge,
}

impl Who {
    pub const ALL: [Self; 4] = [Self::Publisher, Self::Critical, Self::Remote, Self::Bridge];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Publisher => "publisher",
            Self::Critical => "critical-subscriber",
            Self::Remote => "remote-subscriber",
            Self::Bridge => "bridge",
        }
    }
}

/// The processes of one phase. Dropping them ends them.
pub(super) struct Children<'a> {
    place: &'a Place,
    children: Vec<(Who, Child)>,
    sender: Sender<(Who, Report)>,
    reports: Receiver<(Who, Report)>,
}

impl<'a> Children<'a> {
    pub fn new(place: &'a Place) -> Self {
        let (sender, reports) = channel();
        Self { place, children: Vec::with_capacity(4), sender, reports }
    }

    /// Starts a process of this program. To be called by a thread that lives as long as the demo: the kernel
    /// takes its death for that of the parent.
    pub fn start(&mut self, who: Who, arguments: &[&str]) -> Result<(), DemoError> {
        let mut child =
            self.spawn(who, arguments).map_err(|error| DemoError::Start { name: who.name(), error })?;
        if let Some(stdout) = child.stdout.take() {
            let sender = self.sender.clone();
            thread::spawn(move || pass_on(who, stdout, &sender));
        }
        self.children.push((who, child));
        Ok(())
    }

    fn spawn(&self, who: Who, arguments: &[&str]) -> io::Result<Child> {
        let log = OpenOptions::new().create(true).append(true).open(self.place.log(who.name()))?;
        let at_our_death = match who {
            // So that it ends its own processes and clears up.
            Who::Bridge => Signal::SIGTERM,
            // The only one that a stopped process obeys.
            _ => Signal::SIGKILL,
        };
        let demo = Pid::this();
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
        for variable in FOREIGN_VARIABLES {
            command.env_remove(variable);
        }
        // A process group of its own: Ctrl-C in the terminal is for the demo alone, which then ends the
        // others.
        command.process_group(0);
        // SAFETY: between fork and exec only async-signal-safe functions may be called and no memory may be
        // allocated. This makes the system calls prctl and getppid, and `Errno` becomes an `io::Error`
        // without an allocation.
        unsafe {
            command.pre_exec(move || {
                set_pdeathsig(at_our_death)?;
                if getppid() == demo { Ok(()) } else { Err(io::ErrorKind::BrokenPipe.into()) }
            });
        }
        command.spawn()
    }

    /// The next report, waited for at most that long.
    pub fn next_report(&self, patience: Duration) -> Option<(Who, Report)> {
        // We hold a sender ourselves, so that this can only time out.
        self.reports.recv_timeout(patience).ok()
    }

    /// Stops a process where it is, or lets it go on.
    pub fn set_stopped(&self, who: Who, stopped: bool) {
        let signal = if stopped { Signal::SIGSTOP } else { Signal::SIGCONT };
        for (_, child) in self.children.iter().filter(|(other, _)| *other == who) {
            let _ = kill(pid_of(child), signal);
        }
    }

    /// A process that has ended by itself, which none should.
    pub fn ended(&mut self) -> Option<(Who, ExitStatus)> {
        self.children.iter_mut().find_map(|(who, child)| Some((*who, child.try_wait().ok()??)))
    }
}

impl Drop for Children<'_> {
    fn drop(&mut self) {
        for (who, child) in &mut self.children {
            if *who == Who::Bridge {
                let _ = kill(pid_of(child), Signal::SIGTERM);
            } else {
                // They have nothing to clear up, and this one is obeyed by a stopped process too.
                let _ = child.kill();
            }
        }
        let deadline = clock::monotonic().plus_ms(BRIDGE_GRACE_MS);
        for (who, child) in &mut self.children {
            while *who == Who::Bridge && matches!(child.try_wait(), Ok(None)) && clock::monotonic() < deadline
            {
                thread::sleep(Duration::from_millis(5));
            }
            if matches!(child.try_wait(), Ok(None)) {
                // The bridge's own children are in its process group.
                let _ = killpg(pid_of(child), Signal::SIGKILL);
            }
            let _ = child.wait();
        }
    }
}

/// Linux process ids are below 2^22.
fn pid_of(child: &Child) -> Pid {
    Pid::from_raw(i32::try_from(child.id()).unwrap_or(i32::MAX))
}

fn pass_on(who: Who, stdout: ChildStdout, sender: &Sender<(Who, Report)>) {
    for line in BufReader::new(stdout).lines() {
        let Ok(line) = line else { return };
        if let Some(report) = Report::parse(&line)
            && sender.send((who, report)).is_err()
        {
            return;
        }
    }
}

/// The last lines of each process' log, for a demo that failed.
pub(super) fn last_log_lines(place: &Place) -> String {
    const LINES: usize = 12;
    let mut text = String::new();
    for who in Who::ALL {
        let Ok(log) = File::open(place.log(who.name())) else { continue };
        let lines: Vec<String> = BufReader::new(log).lines().map_while(Result::ok).collect();
        if !lines.is_empty() {
            text.push_str(&format!("--- the last lines of the {}'s log\n", who.name()));
        }
        for line in &lines[lines.len().saturating_sub(LINES)..] {
            text.push_str(line);
            text.push('\n');
        }
    }
    text
}
