//! The membership of a process in an instance, and the removal of what dead processes left.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use nix::fcntl::FlockArg;

use super::error::ShmError;
use super::in_force;
use super::lock::{FileLock, LOCK_SUFFIX, lock_failed, lock_is_current};
use super::root::InstanceDir;
use crate::model::InstanceName;

const INSTANCE_LOCK: &str = "instance.lock";

/// The shared lock by which a process belongs to an instance. A process that gets it exclusively knows that
/// no other process of the instance is alive, and that all its files are left over.
#[derive(Debug)]
pub(super) struct Membership {
    dir: InstanceDir,
    lock: Option<FileLock>,
}

impl Membership {
    /// Joins the instance. The first process removes left-over files, and their number is returned.
    pub(super) fn join(root: &Path, instance: &InstanceName) -> Result<(Self, usize), ShmError> {
        // A process that leaves as the last one may remove the folder at the same time; then retry.
        for _ in 0..100 {
            let dir = InstanceDir::prepare(root, instance)?;
            let path = dir.path.join(INSTANCE_LOCK);
            let exclusive = FileLock::take(&path, FlockArg::LockExclusiveNonblock);
            let (lock, swept) = match exclusive {
                Ok(Some(lock)) => {
                    let swept = sweep(&dir);
                    // This may release the lock for an instant, in which another process may remove all
                    // files; this process has none yet.
                    match lock.relock(FlockArg::LockSharedNonblock) {
                        Ok(()) => (lock, swept),
                        Err(_) => {
                            drop(lock);
                            (FileLock::take_soon(&path, FlockArg::LockSharedNonblock)?, swept)
                        }
                    }
                }
                Ok(None) => (FileLock::take_soon(&path, FlockArg::LockSharedNonblock)?, 0),
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(error) => return Err(lock_failed(&path, &error)),
            };
            if lock_is_current(&lock) {
                return Ok((Self { dir, lock: Some(lock) }, swept));
            }
        }
        Err(ShmError::Failed {
            what: "to join the instance".to_owned(),
            path: root.to_owned(),
            reason: "other processes removed its folder in 100 attempts".to_owned(),
        })
    }

    pub(super) fn dir(&self) -> &InstanceDir {
        &self.dir
    }
}

impl Drop for Membership {
    /// The last process that leaves removes all files of the instance.
    fn drop(&mut self) {
        if let Some(lock) = self.lock.take()
            && lock.relock(FlockArg::LockExclusiveNonblock).is_ok()
            && lock_is_current(&lock)
        {
            sweep(&self.dir);
            lock.remove();
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
