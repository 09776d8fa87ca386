//! Errors when shared memory is set up.

use std::fmt;
use std::path::PathBuf;

use crate::model::{InstanceName, RouteId};

/// Why shared memory could not be set up. `Display` names what failed, where, and what to do next.
#[derive(Debug)]
pub enum ShmError {
    /// The folder could not be created or made private.
    CannotCreateRoot {
        /// The folder.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The folder belongs to another user, or other users may write to it.
    RootNotOurs {
        /// The folder.
        path: PathBuf,
        /// Why the folder is refused.
        reason: String,
    },
    /// The folder's path is too long for the files below it.
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// Its length in bytes.
        length: usize,
        /// The longest length that is allowed.
        max: usize,
    },
    /// Another process already serves the role.
    AlreadyServed {
        /// The role.
        role: String,
        /// The process that serves it; 0 when it has not written its process id yet.
        pid: u32,
    },
    /// The whole bridge is to be started, but processes of its instance are running.
    AlreadyRuns {
        /// The instance.
        instance: InstanceName,
        /// One of these processes, preferably `up`; 0 when it has not written its process id yet.
        pid: u32,
    },
    /// Shared memory has less free space than the bridge needs.
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
    /// The operating system refused access.
    Permission {
        /// The operation, as `to` and a verb.
        what: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// Running processes of this instance use another version or another configuration.
    Incompatible {
        /// What does not match.
        what: String,
        /// The folder of the instance.
        path: PathBuf,
    },
    /// A route has as many taps or lanes as it allows.
    TooManySubscribers {
        /// The route.
        route: RouteId,
        /// The most that the route allows.
        max: usize,
    },
    /// Another process has held a lock for longer than a start takes; it may be stopped.
    Busy {
        /// The lock file.
        path: PathBuf,
        /// The process that holds it; 0 if unknown.
        pid: u32,
    },
    /// An operation of iceoryx2 or of the operating system failed for another reason.
    Failed {
        /// The operation, as `to` and a verb.
        what: String,
        /// The file or folder.
        path: PathBuf,
        /// The error that was reported.
        reason: String,
    },
}

impl fmt::Display for ShmError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::CannotCreateRoot { path, source } => write!(
                f,
                "cannot create the folder {}: {source}; choose another with shared_memory.root_path",
                path.display()
            ),
            Self::RootNotOurs { path, reason } => write!(
                f,
                "the folder {} is not safe to use: {reason}; run as its owner, or choose another with \
                 shared_memory.root_path",
                path.display()
            ),
            Self::PathTooLong { path, length, max } => write!(
                f,
                "the path {} has {length} bytes, at most {max} are allowed; choose a shorter \
                 shared_memory.root_path",
                path.display()
            ),
            Self::AlreadyServed { role, pid } => {
                write!(f, "{role} is served already, by process {pid}; stop it first")
            }
            Self::AlreadyRuns { instance, pid } => {
                write!(f, "the bridge runs already as instance {instance}, process {pid}; stop it first")
            }
            Self::NoRoom { what, needed_bytes, free_bytes, path } => write!(
                f,
                "{what} needs {needed_bytes} bytes of shared memory, but {} has {free_bytes} free; enlarge \
                 it (mount -o remount,size=… {0}; docker run --shm-size=…), or lower max_sample_bytes, \
                 queue_depth or max_taps",
                path.display()
            ),
            Self::Permission { what, path } => write!(
                f,
                "not permitted {what} ({}); all processes of a bridge must run as the same user",
                path.display()
            ),
            Self::Incompatible { what, path } => write!(
                f,
                "{what} ({}); stop all processes of this instance, then start them again",
                path.display()
            ),
            Self::TooManySubscribers { route, max } => write!(
                f,
                "all {max} places on route {route} are taken; raise shared_memory.max_taps, or stop a tap"
            ),
            Self::Busy { path, pid } => write!(
                f,
                "process {pid} has held the lock {} for longer than a start takes; if that process is \
                 stopped, continue or kill it",
                path.display()
            ),
            Self::Failed { what, path, reason } => write!(f, "failed {what} ({}): {reason}", path.display()),
        }
    }
}

impl std::error::Error for ShmError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::CannotCreateRoot { source, .. } => Some(source),
            _ => None,
        }
    }
}
