//! The membership of a process in a bridge instance, and the clean-up after dead processes.

use std::collections::{BTreeSet, HashSet};
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder, NodeState, NodeView};
use iceoryx2::prelude::{
    CallbackProgression, FileName, LogLevel, SemanticString, SignalHandlingMode, set_log_level,
};
use nix::fcntl::FlockArg;

use super::board::{Boards, BridgeShape};
use super::error::ShmError;
use super::lock::FileLock;
use super::membership::Membership;
use super::root::{InstanceDir, make_private};
use super::segment::{commit_files, require_free};
use super::service::Service;
use crate::model::InstanceName;

/// The bytes that a service, a connection or the boards of a small bridge need in addition to the pool.
const SMALL_BYTES: u64 = 512 * 1024;

/// The result of a clean-up after dead processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CleanUp {
    /// Dead processes whose ports, queues and pools were removed.
    pub dead_processes: usize,
    /// Dead processes whose clean-up failed; the next clean-up retries.
    pub failed: usize,
    /// Removed files that belonged to no process: incomplete ones, and all files when no process was alive.
    pub stray_files: usize,
}

/// The membership of this process in a bridge instance. A process has one.
#[derive(Clone, Debug)]
pub struct ShmNode {
    shared: Arc<NodeShared>,
    cleaned_up: CleanUp,
}

/// The part of [`ShmNode`] that every port and every sample keeps alive. The fields are dropped in this
/// order: first the node with its files, then the membership.
#[derive(Debug)]
pub(super) struct NodeShared {
    pub(super) node: Node<Service>,
    membership: Membership,
    /// The files whose pages are allocated. With 60 routes, to open each file again after each port took a
    /// third of the time of a take-over.
    committed: Mutex<BTreeSet<u64>>,
}

impl ShmNode {
    /// Cleans up after dead processes of the instance in `root`, then joins the instance.
    ///
    /// Only the arguments configure iceoryx2: no `iceoryx2.toml` of the working folder, of the user or of the
    /// system is read. iceoryx2 installs no signal handler.
    pub fn open(root: &Path, instance: &InstanceName, process: &str) -> Result<Self, ShmError> {
        limit_iceoryx_log();
        let (membership, stray_files) = Membership::join(root, instance)?;
        let dir = &membership.dir;
        require_free(SMALL_BYTES, "joining the bridge")?;
        let start = StartLock::take(dir)?;
        for folder in ["nodes", "services"] {
            // Created here because iceoryx2 creates them with mode 0755.
            make_private(&dir.path.join(folder))?;
        }
        let config = config_of(dir)?;
        let mut cleaned_up = clean_up_dead(dir, &config, &start);
        cleaned_up.stray_files += stray_files;
        let name =
            process.try_into().map_err(|error| ShmError::failed("to name the process", &dir.path, error))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|error| ShmError::failed("to join the bridge", &dir.path, error))?;
        // iceoryx2 creates its count of nodes with mode 0666.
        restrict(&dir.shm_files());
        drop(start);
        let committed = Mutex::default();
        Ok(Self { shared: Arc::new(NodeShared { node, membership, committed }), cleaned_up })
    }

    /// The result of the clean-up in [`open`](Self::open).
    pub fn cleaned_up(&self) -> CleanUp {
        self.cleaned_up
    }

    /// Cleans up after processes that have died since the last clean-up. Long-running processes call it about
    /// once a second. Never waits: while another process starts or cleans up, it does nothing. It reads
    /// folders, which takes some 0.5 ms, so do not call it on the thread that handles samples.
    pub fn clean_up(&self) -> CleanUp {
        match StartLock::try_take(self.shared.dir()) {
            Some(start) => self.shared.clean_up(&start),
            None => CleanUp::default(),
        }
    }

    /// Opens the boards of the instance; the first process creates them.
    pub fn boards(&self, shape: &BridgeShape) -> Result<Boards, ShmError> {
        let _start = StartLock::take(self.shared.dir())?;
        Boards::open_or_create(self.shared.dir(), shape)
    }

    pub(super) fn shared(&self) -> &Arc<NodeShared> {
        &self.shared
    }
}

impl NodeShared {
    pub(super) fn dir(&self) -> &InstanceDir {
        &self.membership.dir
    }

    pub(super) fn folder(&self) -> &Path {
        &self.dir().path
    }

    pub(super) fn clean_up(&self, start: &StartLock) -> CleanUp {
        clean_up_dead(self.dir(), self.node.config(), start)
    }

    /// Allocates all pages of the instance's files in shared memory.
    pub(super) fn commit(&self, what: &str) -> Result<(), ShmError> {
        #[allow(clippy::disallowed_methods, reason = "only while ports are created")]
        let mut committed = self.committed.lock().unwrap_or_else(PoisonError::into_inner);
        commit_files(&self.dir().shm_inodes(), &mut committed, what)
    }

    /// Returns an error if shared memory has no room for that many bytes and the overhead of a port, not even
    /// without what dead processes have left: a standby takes over before that is removed.
    pub(super) fn require_free(&self, bytes: u64, what: &str, start: &StartLock) -> Result<(), ShmError> {
        if require_free(bytes + SMALL_BYTES, what).is_err() {
            self.clean_up(start);
        }
        require_free(bytes + SMALL_BYTES, what)
    }
}

/// Limits iceoryx2's log, which goes to `tracing`, to warnings, because iceoryx2 also logs failures that are
/// expected. A log filter that enables debug messages of `iceoryx2_bb_loggers::tracing` lifts this limit.
fn limit_iceoryx_log() {
    let debug = tracing::enabled!(target: "iceoryx2_bb_loggers::tracing", tracing::Level::DEBUG);
    set_log_level(if debug { LogLevel::Debug } else { LogLevel::Warn });
}

fn config_of(dir: &InstanceDir) -> Result<Config, ShmError> {
    let path = iceoryx2::prelude::Path::new(dir.path.as_os_str().as_encoded_bytes())
        .map_err(|error| ShmError::failed("to use the folder's path", &dir.path, format!("{error:?}")))?;
    let prefix = FileName::new(dir.prefix.as_bytes())
        .map_err(|error| ShmError::failed("to use the instance's name", &dir.path, format!("{error:?}")))?;
    let mut config = Config::default();
    config.global.set_root_path(&path);
    config.global.prefix = prefix;
    // `clean_up_dead` does all clean-ups.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// The lock that a process must hold to create anything in shared memory.
///
/// iceoryx2 0.10 waits for ever for a segment whose creator was killed before it set its length, and refuses
/// for ever a service whose creator was killed before it wrote its description. Only the holder of this lock
/// creates either, so an incomplete one that the holder finds belongs to a dead process. The code that
/// forwards samples never takes this lock.
pub(super) struct StartLock {
    _lock: FileLock,
}

impl StartLock {
    fn path(dir: &InstanceDir) -> PathBuf {
        dir.path.join("start.lock")
    }

    pub(super) fn take(dir: &InstanceDir) -> Result<Self, ShmError> {
        let mut lock = FileLock::take_soon(&Self::path(dir), FlockArg::LockExclusiveNonblock)?;
        // For the error message of processes that wait for the lock, so a failure is ignored.
        let _ = lock.write_pid();
        Ok(Self { _lock: lock })
    }

    fn try_take(dir: &InstanceDir) -> Option<Self> {
        let lock = FileLock::take(&Self::path(dir), FlockArg::LockExclusiveNonblock).ok()??;
        Some(Self { _lock: lock })
    }
}

/// Removes the ports of dead processes, with queues and pools, and services that no process uses any more.
///
/// The clean-up of iceoryx2 itself is not used: for a process that died after its details were removed or
/// before they were written, it falls back to the configuration file of the working folder.
fn clean_up_dead(dir: &InstanceDir, config: &Config, _start: &StartLock) -> CleanUp {
    let mut result = CleanUp::default();
    result.stray_files += remove_incomplete(dir);
    let mut known = HashSet::new();
    let listed = Node::<Service>::list(config, |state| {
        let id = state.node_id().value().to_string();
        match state {
            NodeState::Dead(dead) if dead.details().is_some() => {
                let cleaned = dead.try_remove_stale_resources().is_ok();
                result.dead_processes += usize::from(cleaned);
                result.failed += usize::from(!cleaned);
                known.insert(id);
            }
            NodeState::Dead(_) => {}
            _ => {
                known.insert(id);
            }
        }
        CallbackProgression::Continue
    });
    match listed {
        Ok(()) => result.stray_files += remove_unknown_nodes(dir, &known),
        Err(_) => result.failed += 1,
    }
    result
}

/// Removes segments and service descriptions that a process, dead now, did not complete.
fn remove_incomplete(dir: &InstanceDir) -> usize {
    let segment = |metadata: &fs::Metadata| metadata.len() == 0 || metadata.mode() & 0o400 == 0;
    // iceoryx2 removes the write permission when the description is complete.
    let description = |metadata: &fs::Metadata| metadata.mode() & 0o200 != 0;
    let services = fs::read_dir(dir.path.join("services")).into_iter().flatten().flatten();
    let segments = dir.shm_files().into_iter().map(|path| (path, segment as fn(&_) -> _));
    let files = segments.chain(services.map(|entry| (entry.path(), description as fn(&_) -> _)));
    files
        .filter(|(path, is_incomplete)| {
            let incomplete = fs::symlink_metadata(path).is_ok_and(|metadata| is_incomplete(&metadata));
            incomplete && fs::remove_file(path).is_ok()
        })
        .count()
}

/// Removes the files of nodes that iceoryx2 lists neither as alive nor as dead, which means that the process
/// died while it joined or that its clean-up was interrupted. Such a node has no ports any more, or never
/// had.
fn remove_unknown_nodes(dir: &InstanceDir, known: &HashSet<String>) -> usize {
    let entries = fs::read_dir(dir.path.join("nodes")).into_iter().flatten().flatten();
    entries
        .filter(|entry| {
            let name = entry.file_name();
            let Some(name) = name.to_str() else { return false };
            let name = name.strip_prefix(&dir.prefix).unwrap_or(name);
            let id = name.split('.').next().unwrap_or(name);
            let is_id = !id.is_empty() && id.bytes().all(|byte| byte.is_ascii_digit());
            if !is_id || known.contains(id) {
                return false;
            }
            let path = entry.path();
            if path.is_dir() { fs::remove_dir_all(path).is_ok() } else { fs::remove_file(path).is_ok() }
        })
        .count()
}

/// Removes the permissions of other users on files in shared memory.
fn restrict(files: &[PathBuf]) {
    for path in files {
        // A missing file belonged to a process that is ending.
        if let Ok(metadata) = fs::symlink_metadata(path)
            && metadata.permissions().mode() & 0o077 != 0
        {
            let _ = fs::set_permissions(path, fs::Permissions::from_mode(0o600));
        }
    }
}
