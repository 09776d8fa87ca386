//! Errors when shared memory is set up.

use std::fmt::Display;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use crate::model::{InstanceName, RouteId};

/// Why shared memory could not be set up. `Display` names what failed, where, and what to do next.
#[derive(Debug, thiserror::Error)]
pub enum ShmError {
    /// The folder could not be created or made private.
    #[error("cannot create the folder {path}: {source}; choose another with shared_memory.root_path")]
    CannotCreateRoot {
        /// The folder.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The folder belongs to another user, or other users may write to it.
    #[error(
        "the folder {path} is not safe to use: {reason}; run as its owner, or choose another with \
         shared_memory.root_path"
    )]
    RootNotOurs {
        /// The folder.
        path: PathBuf,
        /// Why the folder is refused.
        reason: String,
    },
    /// The folder's path is too long for the files below it.
    #[error(
        "the path {path} has {length} bytes, at most {max} are allowed; choose a shorter \
         shared_memory.root_path"
    )]
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// Its length in bytes.
        length: usize,
        /// The longest length that is allowed.
        max: usize,
    },
    /// Another process already serves the role.
    #[error("{role} is served already, by process {pid}; stop it first")]
    AlreadyServed {
        /// The role.
        role: String,
        /// The process that serves it; 0 when it has not written its process id yet.
        pid: u32,
    },
    /// The whole bridge is to be started, but processes of its instance are running.
    #[error("the bridge runs already as instance {instance}, process {pid}; stop it first")]
    AlreadyRuns {
        /// The instance.
        instance: InstanceName,
        /// One of these processes, preferably `up`; 0 when it has not written its process id yet.
        pid: u32,
    },
    /// Shared memory has less free space than the bridge needs.
    #[error(
        "{what} needs {needed_bytes} bytes of shared memory, but {path} has {free_bytes} free; enlarge \
         it (mount -o remount,size=… {path}; docker run --shm-size=…), or lower max_sample_bytes, \
         queue_depth or max_taps"
    )]
    NoRoom {
        /// What the memory is for.
        what: String,
        /// The bytes that are needed.
        needed_bytes: u64,
        /// The bytes that are free; 0 when the file system does not report them.
        free_bytes: u64,
        /// The file system.
        path: PathBuf,
    },
    /// The pools take more at the start than the budget allows.
    #[error(
        "the pools need {needed_bytes} bytes of shared memory at the start, and shared_memory.budget_bytes is \
         {budget_bytes}; raise it, or lower max_sample_bytes of routes with small samples, queue_depth or max_taps"
    )]
    BudgetTooSmall {
        /// What all pools need.
        needed_bytes: u64,
        /// The budget.
        budget_bytes: u64,
    },
    /// The operating system refused access.
    #[error("not permitted {what} ({path}); all processes of a bridge must run as the same user")]
    Permission {
        /// The operation, as `to` and a verb.
        what: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// Running processes of this instance use another version or another configuration.
    #[error("{what} ({path}); stop all processes of this instance, then start them again")]
    Incompatible {
        /// What does not match.
        what: String,
        /// The folder of the instance.
        path: PathBuf,
    },
    /// A route has as many taps or lanes as it allows.
    #[error("all {max} places on route {route} are taken; raise shared_memory.max_taps, or stop a tap")]
    TooManySubscribers {
        /// The route.
        route: RouteId,
        /// The most that the route allows.
        max: usize,
    },
    /// Another process has held a lock for longer than a start takes; it may be stopped.
    #[error(
        "process {pid} has held the lock {path} for longer than a start takes; if that process is \
         stopped, continue or kill it"
    )]
    Busy {
        /// The lock file.
        path: PathBuf,
        /// The process that holds it; 0 if unknown.
        pid: u32,
    },
    /// An operation of iceoryx2 or of the operating system failed for another reason.
    #[error("failed {what} ({path}): {reason}")]
    Failed {
        /// The operation, as `to` and a verb.
        what: String,
        /// The file or folder.
        path: PathBuf,
        /// The error that was reported.
        reason: String,
    },
}

impl ShmError {
    /// An operation, as `to` and a verb, that failed.
    pub(crate) fn failed(what: impl Into<String>, path: &Path, reason: impl Display) -> Self {
        Self::Failed { what: what.into(), path: path.to_owned(), reason: reason.to_string() }
    }

    /// An operation that the operating system did not permit, or that failed.
    pub(super) fn os(what: &str, path: &Path, error: &io::Error) -> Self {
        match error.kind() {
            ErrorKind::PermissionDenied => Self::Permission { what: what.to_owned(), path: path.to_owned() },
            _ => Self::failed(what, path, error),
        }
    }
}
