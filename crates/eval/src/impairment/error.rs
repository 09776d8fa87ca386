//! The error type of impairments.

use std::fmt;
use std::path::PathBuf;

/// A mistake in a line of a trace file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TraceProblem {
    /// The number of the line, from 1.
    pub line: usize,
    /// The message for the user.
    pub what: String,
}

/// Why a link could not be impaired.
#[derive(Debug)]
pub enum ImpairmentError {
    /// A parameter is out of its range.
    BadParameter {
        /// The parameter's name.
        name: &'static str,
        /// Its value.
        value: String,
        /// The allowed range.
        allowed: &'static str,
    },
    /// A file is no valid trace of a link.
    BadTrace {
        /// The file.
        path: PathBuf,
        /// The mistakes in it, at least one.
        problems: Vec<TraceProblem>,
    },
    /// A program that sets up the network failed, or is not installed.
    Command {
        /// Its command line.
        command: String,
        /// Its error message.
        message: String,
    },
    /// Another program listens on the queue.
    QueueTaken {
        /// The number of the queue.
        queue: u16,
    },
    /// An operation of the operating system failed.
    System {
        /// The operation, or the file.
        what: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// The kernel or a program returned something that cannot be interpreted.
    Unexpected {
        /// What was returned, and by what.
        what: String,
    },
    /// The machine lacks what the back end needs.
    NoBackend {
        /// The back end's name.
        backend: &'static str,
        /// What is missing.
        reason: String,
    },
}

impl ImpairmentError {
    pub(crate) fn system(what: impl Into<String>, source: impl Into<std::io::Error>) -> Self {
        Self::System { what: what.into(), source: source.into() }
    }
}

impl fmt::Display for ImpairmentError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadParameter { name, value, allowed } => {
                write!(f, "{name} is {value}, but must be {allowed}")
            }
            Self::BadTrace { path, problems } => {
                for (at, TraceProblem { line, what }) in problems.iter().enumerate() {
                    let end = if at > 0 { "\n" } else { "" };
                    write!(f, "{end}{}:{line}: {what}", path.display())?;
                }
                Ok(())
            }
            Self::Command { command, message } => write!(f, "`{command}` failed: {message}"),
            Self::QueueTaken { queue } => {
                write!(
                    f,
                    "another program listens on NFQUEUE {queue} in this network namespace; choose another number"
                )
            }
            Self::System { what, source } => {
                write!(f, "{what}: {source}")?;
                if source.kind() == std::io::ErrorKind::PermissionDenied {
                    write!(f, " (this needs root or CAP_NET_ADMIN)")?;
                }
                Ok(())
            }
            Self::Unexpected { what } => write!(f, "unexpected: {what}"),
            Self::NoBackend { backend, reason } => {
                write!(f, "this machine cannot impair a link with {backend}: {reason}")
            }
        }
    }
}

impl std::error::Error for ImpairmentError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::System { source, .. } => Some(source),
            _ => None,
        }
    }
}
