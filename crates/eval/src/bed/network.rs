//! A network namespace and the commands that run in it.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;

use nix::sched::{CloneFlags, setns};

use crate::error::EvalError;
use crate::impairment::system;

/// The network namespace of a host or of the switch, identified by its file.
#[derive(Clone, Debug)]
pub struct Network(PathBuf);

impl Network {
    /// Refers to the namespace of a file such as `/run/netns/NAME` or `/proc/PID/ns/net`.
    pub fn new(file: impl Into<PathBuf>) -> Self {
        Self(file.into())
    }

    /// The command prefix that runs a program in the namespace.
    pub fn entry(&self) -> Vec<String> {
        vec!["nsenter".to_owned(), format!("--net={}", self.0.display())]
    }

    /// Builds a command that runs a program in this network namespace, and in the harness's other namespaces.
    pub fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.arg(format!("--net={}", self.0.display()));
        command.args(["setpriv", "--pdeathsig", "KILL"]).arg(program);
        command
    }

    /// Runs a command line without quotes in the namespace and waits for its end; returns its stdout.
    ///
    /// # Errors
    /// The program is not installed, or failed.
    pub fn run(&self, line: &str) -> Result<String, EvalError> {
        let words: Vec<String> = self.entry().into_iter().chain(system::words(line)).collect();
        Ok(system::run(&words)?)
    }

    /// Calls a function in the namespace, on a separate thread. Files of `/proc/thread-self/net` and sockets
    /// that it opens stay in the namespace.
    ///
    /// # Errors
    /// The namespace cannot be entered, or the function failed.
    pub fn within<T: Send>(
        &self,
        call: impl FnOnce() -> Result<T, EvalError> + Send,
    ) -> Result<T, EvalError> {
        let enter = || {
            let file = File::open(&self.0).map_err(|error| EvalError::file(&self.0, &error))?;
            setns(file, CloneFlags::CLONE_NEWNET)
                .map_err(|error| EvalError::new(format!("{}: {error}", self.0.display())))?;
            call()
        };
        let joined = thread::scope(|scope| scope.spawn(enter).join());
        joined.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    }
}
