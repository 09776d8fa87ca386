//! Why a process ends with an error.

use crate::dds::DdsError;
use crate::shm::ShmError;

/// Why a process could not start, or had to end.
#[derive(Debug, thiserror::Error)]
pub enum RoleError {
    /// The configuration has no lane of that name.
    #[error("there is no lane {name}; the configuration has: {}", .lanes.join(", "))]
    NoSuchLane {
        /// The name.
        name: String,
        /// The lanes that the configuration has.
        lanes: Vec<String>,
    },
    /// No process serves the lane.
    #[error(
        "no process serves lane {lane} of instance {instance}; start it with \
         `adaptive-bridge egress --lane {lane}` or `adaptive-bridge up`"
    )]
    NotRunning {
        /// The instance.
        instance: String,
        /// The lane.
        lane: String,
    },
    /// Shared memory failed.
    #[error(transparent)]
    Shm(#[from] ShmError),
    /// DDS failed.
    #[error(transparent)]
    Dds(#[from] DdsError),
    /// Another operating system call failed.
    #[error(transparent)]
    Os(#[from] std::io::Error),
}
