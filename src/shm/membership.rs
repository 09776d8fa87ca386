//! The membership of a process in an instance, and the removal of what dead processes left.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use nix::fcntl::FlockArg;

use super::error::ShmError;
use super::in_force;
use super::lock::{FileLock, LOCK_SUFFIX};
use super::root::InstanceDir;
use crate::model::InstanceName;

const INSTANCE_LOCK: &str = "instance.lock";

/// The shared lock by which a process belongs to an instance. A process that gets it exclusively knows that
/// no other process of the instance is alive, and that all its files are left over.
#[derive(Debug)]
pub(super) struct Membership {
    pub(super) dir: InstanceDir,
    lock: FileLock,
}

impl Membership {
    /// Joins the instance. The first process removes left-over files, and their number is returned.
    pub(super) fn join(root: &Path, instance: &InstanceName) -> Result<(Self, usize), ShmError> {
        InstanceDir::prepare_until(root, instance, "to join the instance", |dir| {
            let path = dir.path.join(INSTANCE_LOCK);
            let join_others = || FileLock::take_soon(&path, FlockArg::LockSharedNonblock);
            let (lock, swept) = match FileLock::take(&path, FlockArg::LockExclusiveNonblock) {
                Ok(Some(lock)) => {
                    let swept = sweep(&dir);
                    // This may release the lock for an instant, in which another process may remove all
                    // files; this process has none yet.
                    if lock.relock(FlockArg::LockSharedNonblock).is_ok() {
                        (lock, swept)
                    } else {
                        drop(lock);
                        (join_others()?, swept)
                    }
                }
                Ok(None) => (join_others()?, 0),
                Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
                Err(error) => return Err(ShmError::os("to lock", &path, &error)),
            };
            let is_current = lock.is_current().unwrap_or(false);
            Ok(is_current.then(|| (Self { dir, lock }, swept)))
        })
    }
}

impl Drop for Membership {
    /// The last process that leaves removes all files of the instance.
    fn drop(&mut self) {
        if self.lock.relock(FlockArg::LockExclusiveNonblock).is_ok()
            && self.lock.is_current().unwrap_or(false)
        {
            sweep(&self.dir);
            self.lock.remove();
            // Fails while a role lock is held there; its release retries.
            let _ = fs::remove_dir(&self.dir.path);
        }
    }
}

/// Removes every file of the instance except held locks, and returns the number of removed files. Call it
/// only while the instance's lock is held exclusively: then no process of the instance is alive.
fn sweep(dir: &InstanceDir) -> usize {
    let mut removed = 0;
    in_force::sweep(&dir.path);
    for file in dir.shm_files() {
        removed += usize::from(fs::remove_file(file).is_ok());
    }
    for entry in fs::read_dir(&dir.path).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        let name = name.as_encoded_bytes();
        if name == INSTANCE_LOCK.as_bytes() || in_force::owns(name) {
            continue;
        } else if name.ends_with(LOCK_SUFFIX.as_bytes()) {
            if let Ok(Some(lock)) = FileLock::take(&path, FlockArg::LockExclusiveNonblock) {
                lock.remove();
            }
        } else if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            let inside = count_files(&path);
            if fs::remove_dir_all(&path).is_ok() {
                removed += inside;
            }
        } else {
            removed += usize::from(fs::remove_file(&path).is_ok());
        }
    }
    removed
}

fn count_files(folder: &Path) -> usize {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| match entry.file_type() {
            Ok(kind) if kind.is_dir() => count_files(&entry.path()),
            _ => 1,
        })
        .sum()
}
