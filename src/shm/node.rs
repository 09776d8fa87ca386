//! The membership of one process in one bridge instance.

use std::path::Path;

use super::board::{Boards, BridgeShape};
use super::error::ShmError;
use crate::model::InstanceName;

/// What a process found and removed of dead ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CleanUp {
    /// Dead processes whose ports, queues and pools were removed.
    pub dead_processes: usize,
    /// Dead processes that could not be cleaned up now.
    pub failed: usize,
    /// Stray files that were removed because no process of the instance was alive.
    pub stray_files: usize,
}

/// The membership of this process in one bridge instance; one for each process.
#[derive(Debug)]
pub struct ShmNode {}

impl ShmNode {
    /// Joins the instance in `root`, and first cleans up what dead processes of the instance left behind.
    pub fn open(root: &Path, instance: &InstanceName, process: &str) -> Result<Self, ShmError> {
        let _ = (root, instance, process);
        todo!()
    }

    /// What `open` cleaned up.
    pub fn cleaned_up(&self) -> CleanUp {
        todo!()
    }

    /// Cleans up after processes that died since: for processes that run for long, once a second, say.
    pub fn clean_up(&self) -> CleanUp {
        todo!()
    }

    /// The boards of the instance; the first process creates them, the others find them.
    pub fn boards(&self, shape: &BridgeShape) -> Result<Boards, ShmError> {
        let _ = shape;
        todo!()
    }
}
