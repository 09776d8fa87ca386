//! What can go wrong at start-up, in the words of someone who has to mend it.

use std::fmt;
use std::path::PathBuf;

use crate::model::{InstanceName, RouteId};

/// Why shared memory could not be set up. `Display` says what failed, where, and what to do about it.
#[derive(Debug)]
pub enum ShmError {
    /// The folder could not be created, or not be made private.
    CannotCreateRoot {
        /// The folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// The folder belongs to another user, or others may write to it.
    RootNotOurs {
        /// The folder.
        path: PathBuf,
        /// Why it is refused.
        reason: String,
    },
    /// The folder's path is too long for the files that live below it.
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// Its length in bytes.
        length: usize,
        /// The longest that works.
        max: usize,
    },
    /// Another process serves the role already.
    AlreadyServed {
        /// The role.
        role: String,
        /// The process that serves it; 0 when it has not said yet.
        pid: u32,
    },
    /// The bridge is to be started as a whole, and processes of its instance run.
    AlreadyRuns {
        /// The instance.
        instance: InstanceName,
        /// One of the processes: that of `up` if there is one; 0 when it has not said yet.
        pid: u32,
    },
    /// Shared memory has less room than the bridge needs.
    NoRoom {
        /// What it is for.
        what: String,
        /// The bytes that are needed.
        needed_bytes: u64,
        /// The bytes that are free, where the file system tells.
        free_bytes: u64,
        /// The file system.
        path: PathBuf,
    },
    /// Access was refused.
    Permission {
        /// What was to be done.
        what: String,
        /// Where.
        path: PathBuf,
    },
    /// Running processes of this instance use another version or another configuration.
    Incompatible {
        /// What does not match.
        what: String,
        /// The folder of the instance.
        path: PathBuf,
    },
    /// All places for taps, or for a lane, on a route are taken.
    TooManySubscribers {
        /// The route.
        route: RouteId,
        /// Places that there are.
        max: usize,
    },
    /// Another process holds a lock for longer than a start-up takes: it is stopped, perhaps.
    Busy {
        /// The lock file.
        path: PathBuf,
        /// The process that holds it; 0 when unknown.
        pid: u32,
    },
    /// An operation of iceoryx2 or of the operating system failed for a reason of its own.
    Failed {
        /// What was to be done.
        what: String,
        /// Where.
        path: PathBuf,
        /// What was said.
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
                "the path {} has {length} bytes, at most {max} work; choose a shorter \
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
                "{what} needs {needed_bytes} bytes of shared memory, {} has {free_bytes} free; enlarge it \
                 (mount -o remount,size=… {0}; docker run --shm-size=…), or lower max_sample_bytes, \
                 queue_depth or max_taps",
                path.display()
            ),
            Self::Permission { what, path } => write!(
                f,
                "not permitted: {what} ({}); all processes of a bridge must run as the same user",
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
                "the lock {} is held by process {pid} for longer than a start takes; if that process is \
                 stopped, continue or kill it",
                path.display()
            ),
            Self::Failed { what, path, reason } => write!(f, "{what} failed ({}): {reason}", path.display()),
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
