//! What can go wrong with an impairment, in the words of someone who has to mend it.

use std::fmt;
use std::path::PathBuf;

use super::trace::TraceProblem;

/// Why a link could not be impaired.
#[derive(Debug)]
pub enum ImpairmentError {
    /// A parameter is out of its range.
    BadParameter {
        /// Which one.
        name: &'static str,
        /// What it was.
        value: String,
        /// What it may be.
        allowed: &'static str,
    },
    /// A file is no trace of a link.
    BadTrace {
        /// Which one.
        path: PathBuf,
        /// What is wrong with it, line by line; at least one.
        problems: Vec<TraceProblem>,
    },
    /// A program that sets up the network said no, or is not there.
    Command {
        /// Its command line.
        command: String,
        /// What it said.
        said: String,
    },
    /// Another program listens on the queue.
    QueueTaken {
        /// The number of the queue.
        queue: u16,
    },
    /// The operating system refused something.
    System {
        /// What was to be done.
        what: String,
        /// What it said.
        source: std::io::Error,
    },
    /// An answer of the kernel or of a program made no sense.
    Unexpected {
        /// What it was about, and what came.
        what: String,
    },
    /// The kernel lacks what the back end needs.
    NoBackend {
        /// Its name.
        backend: &'static str,
        /// What is missing.
        reason: String,
    },
}

impl ImpairmentError {
    pub(in crate::eval) fn system(what: impl Into<String>, source: impl Into<std::io::Error>) -> Self {
        Self::System { what: what.into(), source: source.into() }
    }
}

impl fmt::Display for ImpairmentError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadParameter { name, value, allowed } => {
                write!(f, "{name} is {value}, and may be {allowed}")
            }
            Self::BadTrace { path, problems } => {
                for (at, TraceProblem { line, what }) in problems.iter().enumerate() {
                    let end = if at > 0 { "\n" } else { "" };
                    write!(f, "{end}{}:{line}: {what}", path.display())?;
                }
                Ok(())
            }
            Self::Command { command, said } => write!(f, "`{command}` failed: {said}"),
            Self::QueueTaken { queue } => {
                write!(
                    f,
                    "another program listens on NFQUEUE {queue} in this network namespace; choose another number"
                )
            }
            Self::System { what, source } => {
                write!(f, "{what}: {source}")?;
                if source.kind() == std::io::ErrorKind::PermissionDenied {
                    write!(f, " (it needs root, or CAP_NET_ADMIN)")?;
                }
                Ok(())
            }
            Self::Unexpected { what } => write!(f, "unexpected: {what}"),
            Self::NoBackend { backend, reason } => {
                write!(f, "this machine can't impair a link by {backend}: {reason}")
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
