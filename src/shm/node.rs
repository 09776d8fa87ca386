//! The membership of one process in one bridge instance.

use std::collections::HashSet;
use std::fs;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder, NodeState, NodeView};
use iceoryx2::prelude::{
    CallbackProgression, FileName, LogLevel, SemanticString, SignalHandlingMode, set_log_level,
};
use nix::fcntl::FlockArg;

use super::board::{Boards, BridgeShape};
use super::error::ShmError;
use super::root::{FileLock, InstanceDir, Membership};
use super::segment::{commit_files, require_free};
use super::service::Service;
use crate::model::InstanceName;

/// What a service, a connection or the boards of a small bridge take beside the pool.
const SMALL_BYTES: u64 = 512 * 1024;

/// What a process found and removed of dead ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CleanUp {
    /// Dead processes whose ports, queues and pools were removed.
    pub dead_processes: usize,
    /// Dead processes that could not be cleaned up now; the next clean-up tries again.
    pub failed: usize,
    /// Files removed that belonged to nobody: half made ones, and all of them when no process was alive.
    pub stray_files: usize,
}

/// The membership of this process in one bridge instance; one for each process.
#[derive(Clone, Debug)]
pub struct ShmNode {
    shared: Arc<NodeShared>,
    cleaned_up: CleanUp,
}

/// What every port and every sample keeps alive. The fields are dropped in this order: the node's own files
/// go first, then the membership.
#[derive(Debug)]
pub(super) struct NodeShared {
    node: Node<Service>,
    membership: Membership,
}

impl ShmNode {
    /// Joins the instance in `root`, and first cleans up what dead processes of the instance left behind.
    ///
    /// Nothing but the arguments configures iceoryx2: no `iceoryx2.toml` of the working folder, of the user
    /// or of the system is read. It installs no signal handler.
    pub fn open(root: &Path, instance: &InstanceName, process: &str) -> Result<Self, ShmError> {
        quieten();
        let (membership, stray_files) = Membership::join(root, instance)?;
        let dir = membership.dir();
        require_free(SMALL_BYTES, "joining the bridge")?;
        let start = StartLock::take(dir)?;
        for folder in ["nodes", "services"] {
            // iceoryx2 would create them with mode 0755.
            private_folder(&dir.path.join(folder))?;
        }
        let config = config_of(dir)?;
        let mut cleaned_up = clean_up_dead(dir, &config, &start);
        cleaned_up.stray_files += stray_files;
        let name = process.try_into().map_err(|error| failed(dir, "to name the process", &error))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|error| failed(dir, "to join the bridge", &error))?;
        // iceoryx2 lets everybody read and write its count of nodes.
        make_private(&dir.shm_files());
        drop(start);
        Ok(Self { shared: Arc::new(NodeShared { node, membership }), cleaned_up })
    }

    /// What `open` cleaned up.
    pub fn cleaned_up(&self) -> CleanUp {
        self.cleaned_up
    }

    /// Cleans up after processes that died since; for processes that run for long, once a second, say. Never
    /// waits: while another process starts or cleans up it does nothing. It reads folders, which takes some
    /// 0.5 ms, so it is not for the thread that handles samples.
    pub fn clean_up(&self) -> CleanUp {
        match StartLock::try_take(self.shared.dir()) {
            Some(start) => self.shared.clean_up(&start),
            None => CleanUp::default(),
        }
    }

    /// The boards of the instance; the first process creates them, the others find them.
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
        self.membership.dir()
    }

    pub(super) fn clean_up(&self, start: &StartLock) -> CleanUp {
        clean_up_dead(self.dir(), self.node.config(), start)
    }

    pub(super) fn node(&self) -> &Node<Service> {
        &self.node
    }

    /// Gives everything that iceoryx2 set up in shared memory its pages.
    pub(super) fn commit(&self, what: &str) -> Result<(), ShmError> {
        commit_files(&self.dir().shm_files(), what)
    }

    /// Fails when shared memory has no room for that many bytes and what comes with every port.
    pub(super) fn require_free(&self, bytes: u64, what: &str) -> Result<(), ShmError> {
        require_free(bytes + SMALL_BYTES, what)
    }
}

/// The log of iceoryx2 goes to `tracing`. It reports every operation that fails, also those that are expected
/// to, so it is warnings only, unless somebody asks for more under the name of its crate.
fn quieten() {
    let debug = tracing::enabled!(target: "iceoryx2_bb_loggers::tracing", tracing::Level::DEBUG);
    set_log_level(if debug { LogLevel::Debug } else { LogLevel::Warn });
}

fn config_of(dir: &InstanceDir) -> Result<Config, ShmError> {
    let path = iceoryx2::prelude::Path::new(dir.path.as_os_str().as_encoded_bytes())
        .map_err(|error| failed(dir, "to use the folder's path", &format!("{error:?}")))?;
    let prefix = FileName::new(dir.prefix.as_bytes())
        .map_err(|error| failed(dir, "to use the instance's name", &format!("{error:?}")))?;
    let mut config = Config::default();
    config.global.set_root_path(&path);
    config.global.prefix = prefix;
    // All cleaning up is done by `clean_up_dead`.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// Held by whoever sets something up in shared memory: one process at a time.
///
/// iceoryx2 0.10 waits for ever for a segment whose creator was killed before it set its length, and refuses
/// for ever a service whose creator was killed before it wrote its description. Nobody but the holder of this
/// lock creates either, so that whatever its holder finds half made belongs to a process that is dead.
/// Nothing on the way of a sample takes it.
pub(super) struct StartLock {
    _lock: FileLock,
}

impl StartLock {
    fn path(dir: &InstanceDir) -> PathBuf {
        dir.path.join("start.lock")
    }

    pub(super) fn take(dir: &InstanceDir) -> Result<Self, ShmError> {
        let mut lock = FileLock::take_soon(&Self::path(dir), FlockArg::LockExclusiveNonblock)?;
        // For the message of those who wait in vain; not worth failing for.
        let _ = lock.write_pid();
        Ok(Self { _lock: lock })
    }

    fn try_take(dir: &InstanceDir) -> Option<Self> {
        let lock = FileLock::take(&Self::path(dir), FlockArg::LockExclusiveNonblock).ok()??;
        Some(Self { _lock: lock })
    }
}

/// Removes what dead processes left: their ports with queues and pools, and services that nobody uses any
/// more.
///
/// This is done here and not by iceoryx2 itself because, for a process that died after its details were
/// removed or before they were written, iceoryx2 falls back to the configuration file of the working folder.
fn clean_up_dead(dir: &InstanceDir, config: &Config, _start: &StartLock) -> CleanUp {
    let mut result = CleanUp::default();
    result.stray_files += remove_half_made(dir);
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

/// Removes what its creator, dead now, did not finish.
fn remove_half_made(dir: &InstanceDir) -> usize {
    let segment = |metadata: &fs::Metadata| metadata.len() == 0 || metadata.mode() & 0o400 == 0;
    // iceoryx2 takes away the right to write when the description is complete.
    let description = |metadata: &fs::Metadata| metadata.mode() & 0o200 != 0;
    let services = fs::read_dir(dir.path.join("services")).into_iter().flatten().flatten();
    let segments = dir.shm_files().into_iter().map(|path| (path, segment as fn(&_) -> _));
    let files = segments.chain(services.map(|entry| (entry.path(), description as fn(&_) -> _)));
    files
        .filter(|(path, is_half_made)| {
            let half_made = fs::symlink_metadata(path).is_ok_and(|metadata| is_half_made(&metadata));
            half_made && fs::remove_file(path).is_ok()
        })
        .count()
}

/// Removes the files of processes that died while they joined, or while they were cleaned up after: those
/// that iceoryx2 does not know as alive or dead. All their ports are gone by then, or were never there.
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

/// Takes away what other users may do with files in shared memory.
fn make_private(files: &[PathBuf]) {
    for path in files {
        // A file that is gone belongs to a process that ends just now.
        if let Ok(metadata) = fs::symlink_metadata(path)
            && metadata.permissions().mode() & 0o077 != 0
        {
            let _ = fs::set_permissions(path, fs::Permissions::from_mode(0o600));
        }
    }
}

fn private_folder(path: &Path) -> Result<(), ShmError> {
    match fs::DirBuilder::new().recursive(true).mode(0o700).create(path) {
        Ok(()) => Ok(()),
        Err(source) => Err(ShmError::CannotCreateRoot { path: path.to_owned(), source }),
    }
}

pub(super) fn failed(dir: &InstanceDir, what: &str, error: &dyn std::fmt::Display) -> ShmError {
    ShmError::Failed { what: what.to_owned(), path: dir.path.clone(), reason: error.to_string() }
}
