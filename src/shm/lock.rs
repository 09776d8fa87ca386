//! Files that are locked with `flock`.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};

use super::error::ShmError;
use crate::clock;

pub(super) const LOCK_SUFFIX: &str = ".lock";

/// How long a start waits for another start of the same instance, which takes a few milliseconds.
const START_TIMEOUT_MS: u64 = 5_000;

/// A file that is locked with `flock`. The kernel releases the lock when the process ends, in any way.
#[derive(Debug)]
pub(super) struct FileLock {
    lock: Flock<File>,
    pub(super) path: PathBuf,
}

impl FileLock {
    /// Takes a lock; `None` when another process holds it.
    ///
    /// Another process may remove the file before the lock is taken, and the lock of a removed file protects
    /// nothing. So the locked file is compared with the file at the path.
    pub(super) fn take(path: &Path, how: FlockArg) -> io::Result<Option<Self>> {
        loop {
            let file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .open(path)?;
            let lock = match Flock::lock(file, how) {
                Ok(lock) => lock,
                Err((_, Errno::EWOULDBLOCK)) => return Ok(None),
                Err((_, Errno::EINTR)) => continue,
                Err((_, errno)) => return Err(errno.into()),
            };
            let taken = Self { lock, path: path.to_owned() };
            if taken.is_current()? {
                return Ok(Some(taken));
            }
        }
    }

    /// Waits for a lock that other processes hold for milliseconds only, and takes it.
    pub(super) fn take_soon(path: &Path, how: FlockArg) -> Result<Self, ShmError> {
        let start = clock::monotonic();
        loop {
            match Self::take(path, how) {
                Ok(Some(lock)) => return Ok(lock),
                Ok(None) => {}
                Err(error) => return Err(ShmError::os("to lock", path, &error)),
            }
            if clock::monotonic() > start.plus_ms(START_TIMEOUT_MS) {
                return Err(ShmError::Busy { path: path.to_owned(), pid: read_pid(path) });
            }
            #[allow(clippy::disallowed_methods, reason = "waits for a lock file at the start of a process")]
            thread::sleep(Duration::from_millis(2));
        }
    }

    pub(super) fn relock(&self, how: FlockArg) -> Result<(), Errno> {
        self.lock.relock(how)
    }

    /// Whether the path still names the locked file, which another process may have removed while the lock
    /// changed.
    pub(super) fn is_current(&self) -> io::Result<bool> {
        let locked = self.lock.metadata()?;
        match fs::symlink_metadata(&self.path) {
            Ok(named) => Ok(named.ino() == locked.ino() && named.dev() == locked.dev()),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Writes the id of this process to the file, for messages of other processes.
    pub(super) fn write_pid(&mut self) -> io::Result<()> {
        let mut file: &File = &self.lock;
        file.set_len(0)?;
        file.rewind()?;
        writeln!(file, "{}", std::process::id())
    }

    /// Removes the file of a lock that is exclusive and about to be dropped.
    pub(super) fn remove(&self) {
        // The next process creates a new file; one that waits for this lock detects that the file is removed.
        let _ = fs::remove_file(&self.path);
    }
}

/// The process id in a lock file; 0 if there is none.
pub(super) fn read_pid(path: &Path) -> u32 {
    let mut text = String::new();
    let read = File::open(path).and_then(|file| file.take(16).read_to_string(&mut text));
    read.ok().and_then(|_| text.trim().parse().ok()).unwrap_or(0)
}
