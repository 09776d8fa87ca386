//! The processes of a demo: all are its children, and none outlives it, however it ends.

use std::fs::{self, OpenOptions};
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
use super::report::Report;
use super::sandbox::Sandbox;
use crate::clock;

/// How long the bridge has to exit before it is killed. It needs a second, of which its processes have 900
/// ms.
const BRIDGE_GRACE_MS: u64 = 3_000;

/// Environment variables that would change the behaviour of the demo's processes, and so are removed.
const REMOVED_VARIABLES: [&str; 10] = [
    "ROS_DOMAIN_ID",
    "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "ROS_SECURITY_ENABLE",
    "RMW_IMPLEMENTATION",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISTRO",
    "ADAPTIVE_BRIDGE_CONFIG",
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Publisher,
    Critical,
    Remote,
    Bridge,
}

impl Role {
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

/// The processes of one phase, which end when this is dropped.
pub(super) struct Children<'a> {
    sandbox: &'a Sandbox,
    children: Vec<(Role, Child)>,
    sender: Sender<(Role, Report)>,
    reports: Receiver<(Role, Report)>,
}

impl<'a> Children<'a> {
    pub fn new(sandbox: &'a Sandbox) -> Self {
        let (sender, reports) = channel();
        Self { sandbox, children: Vec::with_capacity(4), sender, reports }
    }

    /// Starts a process that runs this program. The calling thread must live as long as the demo: when it
    /// ends, the kernel sends the parent-death signal (PR_SET_PDEATHSIG).
    pub fn start(&mut self, role: Role, arguments: &[&str]) -> Result<(), DemoError> {
        let mut child =
            self.spawn(role, arguments).map_err(|error| DemoError::Start { name: role.name(), error })?;
        if let Some(stdout) = child.stdout.take() {
            let sender = self.sender.clone();
            thread::spawn(move || forward_reports(role, stdout, &sender));
        }
        self.children.push((role, child));
        Ok(())
    }

    fn spawn(&self, role: Role, arguments: &[&str]) -> io::Result<Child> {
        let log = OpenOptions::new().create(true).append(true).open(self.sandbox.log(role.name()))?;
        let parent_death_signal = match role {
            // Lets it stop its own processes and remove its files.
            Role::Bridge => Signal::SIGTERM,
            // The only signal that also ends a stopped process.
            _ => Signal::SIGKILL,
        };
        let demo = Pid::this();
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
        for variable in REMOVED_VARIABLES {
            command.env_remove(variable);
        }
        // A process group of its own: Ctrl-C in the terminal signals only the demo, which then ends the
        // others.
        command.process_group(0);
        // SAFETY: between fork and exec only async-signal-safe functions may be called and no memory may be
        // allocated. This makes the system calls prctl and getppid, and `Errno` becomes an `io::Error`
        // without an allocation.
        unsafe {
            command.pre_exec(move || {
                set_pdeathsig(parent_death_signal)?;
                if getppid() == demo { Ok(()) } else { Err(io::ErrorKind::BrokenPipe.into()) }
            });
        }
        command.spawn()
    }

    /// The next report of a process; `None` after the timeout.
    #[allow(clippy::disallowed_methods, reason = "the demo is no part of the bridge")]
    pub fn next_report(&self, timeout: Duration) -> Option<(Role, Report)> {
        // `self` holds a sender too, so the only possible error is the timeout.
        self.reports.recv_timeout(timeout).ok()
    }

    /// Stops a process with SIGSTOP, or continues it with SIGCONT.
    pub fn set_stopped(&self, role: Role, stopped: bool) {
        let signal = if stopped { Signal::SIGSTOP } else { Signal::SIGCONT };
        for (_, child) in self.children.iter().filter(|(other, _)| *other == role) {
            let _ = kill(pid_of(child), signal);
        }
    }

    /// The first process found that has exited, which none should.
    pub fn exited(&mut self) -> Option<(Role, ExitStatus)> {
        self.children.iter_mut().find_map(|(role, child)| Some((*role, child.try_wait().ok()??)))
    }
}

impl Drop for Children<'_> {
    fn drop(&mut self) {
        for (role, child) in &mut self.children {
            if *role == Role::Bridge {
                let _ = kill(pid_of(child), Signal::SIGTERM);
            } else {
                // They have nothing to clean up, and SIGKILL also ends a stopped process.
                let _ = child.kill();
            }
        }
        let deadline = clock::monotonic().plus_ms(BRIDGE_GRACE_MS);
        for (role, child) in &mut self.children {
            while *role == Role::Bridge
                && matches!(child.try_wait(), Ok(None))
                && clock::monotonic() < deadline
            {
                #[allow(clippy::disallowed_methods, reason = "waits for a child to end")]
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

/// The process id of a child; Linux process ids are below 2^22.
fn pid_of(child: &Child) -> Pid {
    Pid::from_raw(i32::try_from(child.id()).unwrap_or(i32::MAX))
}

/// Sends each report that a process prints on its stdout to the channel.
fn forward_reports(role: Role, stdout: ChildStdout, sender: &Sender<(Role, Report)>) {
    for line in BufReader::new(stdout).lines().map_while(Result::ok) {
        if let Ok(report) = serde_json::from_str(&line)
            && sender.send((role, report)).is_err()
        {
            return;
        }
    }
}

/// The last lines of the log of each process, to print when a demo failed.
pub(super) fn last_log_lines(sandbox: &Sandbox) -> String {
    const LINES: usize = 12;
    let mut text = String::new();
    for role in Role::ALL {
        let log = fs::read(sandbox.log(role.name())).unwrap_or_default();
        let log = String::from_utf8_lossy(&log);
        let lines: Vec<&str> = log.lines().collect();
        if !lines.is_empty() {
            let last = lines[lines.len().saturating_sub(LINES)..].join("\n");
            text.push_str(&format!("--- the last lines of the {}'s log\n{last}\n", role.name()));
        }
    }
    text
}
