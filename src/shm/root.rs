//! The folder of an instance, and the locks in it: of the instance, and of each role.

use std::ffi::OsString;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use nix::unistd::{AccessFlags, access, geteuid};

use super::error::ShmError;
use super::{holders, in_force};
use crate::clock;
use crate::model::{InstanceName, fnv1a};

/// The folder of POSIX shared memory on Linux.
pub(super) const SHM_DIR: &str = "/dev/shm";

/// The longest path of iceoryx2, which panics on a longer one. Its longest file name after the bridge's
/// prefix is that of a connection: a type hash (28), `_`, two port ids joined by `_` (79), and `.connection`
/// (11).
const ICEORYX_PATH_MAX: usize = 255;
const ICEORYX_NAME_MAX: usize = 28 + 1 + 79 + 11;

/// How long a start waits for another start of the same instance, which takes a few milliseconds.
const START_TIMEOUT_MS: u64 = 5_000;

/// Returns the root, the folder that contains the folders of the instances: the configured one, else the
/// first entry of `$RUNTIME_DIRECTORY` (systemd), else `/run/adaptive-bridge` if this user owns it and may
/// write to it, else `$XDG_RUNTIME_DIR/adaptive-bridge`, else `/tmp/adaptive-bridge-UID`. `env` looks up
/// environment variables.
pub fn default_root(configured: Option<&Path>, env: impl Fn(&str) -> Option<OsString>) -> PathBuf {
    if let Some(path) = configured {
        return path.to_owned();
    }
    if let Some(list) = env("RUNTIME_DIRECTORY")
        && let Some(first) = std::env::split_paths(&list).find(|path| path.is_absolute())
    {
        return first;
    }
    let system = Path::new("/run/adaptive-bridge");
    if let Ok(metadata) = fs::symlink_metadata(system)
        && metadata.is_dir()
        && metadata.uid() == geteuid().as_raw()
        && access(system, AccessFlags::W_OK | AccessFlags::X_OK).is_ok()
    {
        return system.to_owned();
    }
    match env("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|path| path.is_absolute()) {
        Some(path) => path.join("adaptive-bridge"),
        None => PathBuf::from(format!("/tmp/adaptive-bridge-{}", geteuid())),
    }
}

/// The folder of one instance, private to its user.
#[derive(Clone, Debug)]
pub(super) struct InstanceDir {
    pub(super) path: PathBuf,
    /// The prefix of the names of this instance's files. It keeps them apart in [`SHM_DIR`], which the
    /// instances of all users share: the version of the layout, the instance, and a hash of the folder.
    pub(super) prefix: String,
}

impl InstanceDir {
    /// Creates the folder if it is missing, and refuses one to which another user may write.
    pub(super) fn prepare(root: &Path, instance: &InstanceName) -> Result<Self, ShmError> {
        if !root.is_absolute() {
            return Err(ShmError::RootNotOurs {
                path: root.to_owned(),
                reason: "it is not an absolute path".to_owned(),
            });
        }
        make_private(root)?;
        let real = fs::canonicalize(root)
            .map_err(|source| ShmError::CannotCreateRoot { path: root.to_owned(), source })?;
        let found = Self::at(&real, instance)?;
        make_private(&found.path)?;
        // Other users may list the root, but not the instance's folder.
        fs::set_permissions(&found.path, fs::Permissions::from_mode(0o700))
            .map_err(|source| ShmError::CannotCreateRoot { path: found.path.clone(), source })?;
        Ok(found)
    }

    /// Finds the folder; `None` if it does not exist.
    pub(super) fn find(root: &Path, instance: &InstanceName) -> Result<Option<Self>, ShmError> {
        match fs::canonicalize(root) {
            Ok(real) => {
                let found = Self::at(&real, instance)?;
                if found.path.is_dir() {
                    check_owner(&found.path)?;
                    Ok(Some(found))
                } else {
                    Ok(None)
                }
            }
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(source) => Err(ShmError::CannotCreateRoot { path: root.to_owned(), source }),
        }
    }

    fn at(real_root: &Path, instance: &InstanceName) -> Result<Self, ShmError> {
        let path = real_root.join(instance.as_str());
        let hash = fnv1a(path.as_os_str().as_encoded_bytes());
        let prefix = format!("ab1_{instance}_{:08x}_", (hash >> 32) as u32 ^ hash as u32);
        let length = path.as_os_str().len();
        let max = ICEORYX_PATH_MAX - ICEORYX_NAME_MAX - prefix.len() - 1;
        if length > max {
            return Err(ShmError::PathTooLong { path, length, max });
        }
        Ok(Self { path, prefix })
    }

    /// This instance's files in [`SHM_DIR`].
    pub(super) fn shm_files(&self) -> Vec<PathBuf> {
        let Ok(entries) = fs::read_dir(SHM_DIR) else { return Vec::new() };
        let ours = |name: &OsString| name.as_encoded_bytes().starts_with(self.prefix.as_bytes());
        entries
            .flatten()
            .filter(|entry| ours(&entry.file_name()))
            .map(|entry| Path::new(SHM_DIR).join(entry.file_name()))
            .collect()
    }

    /// Removes every file of the instance except held locks, and returns the number of removed files. Call it
    /// only while the instance's lock is held exclusively: then no process of the instance is alive.
    pub(super) fn sweep(&self) -> usize {
        let mut removed = 0;
        in_force::sweep(&self.path);
        for file in self.shm_files() {
            removed += usize::from(fs::remove_file(file).is_ok());
        }
        for entry in fs::read_dir(&self.path).into_iter().flatten().flatten() {
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

/// Creates a folder with mode 0700, and its parents, or checks the owner and mode of an existing one.
pub(super) fn make_private(path: &Path) -> Result<(), ShmError> {
    match DirBuilder::new().recursive(true).mode(0o700).create(path) {
        Ok(()) => check_owner(path),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            Err(ShmError::RootNotOurs { path: path.to_owned(), reason: "it is not a folder".to_owned() })
        }
        Err(source) => Err(ShmError::CannotCreateRoot { path: path.to_owned(), source }),
    }
}

fn check_owner(path: &Path) -> Result<(), ShmError> {
    let refuse = |reason: String| Err(ShmError::RootNotOurs { path: path.to_owned(), reason });
    let metadata = fs::symlink_metadata(path)
        .map_err(|source| ShmError::CannotCreateRoot { path: path.to_owned(), source })?;
    let ours = geteuid().as_raw();
    if !metadata.is_dir() {
        refuse("it is not a folder".to_owned())
    } else if metadata.uid() != ours {
        refuse(format!("it belongs to user {}, but this process runs as user {ours}", metadata.uid()))
    } else if metadata.mode() & 0o022 != 0 {
        refuse(format!("other users may write to it (mode {:o})", metadata.mode() & 0o7777))
    } else {
        Ok(())
    }
}

pub(super) const LOCK_SUFFIX: &str = ".lock";
pub(super) const ROLE_PREFIX: &str = "role-";
const INSTANCE_LOCK: &str = "instance.lock";

/// A file that is locked with `flock`. The kernel releases the lock when the process ends, in any way.
#[derive(Debug)]
pub(super) struct FileLock {
    lock: Flock<File>,
    path: PathBuf,
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
            let locked = lock.metadata()?;
            match fs::symlink_metadata(path) {
                Ok(named) if named.ino() == locked.ino() && named.dev() == locked.dev() => {
                    return Ok(Some(Self { lock, path: path.to_owned() }));
                }
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => return Err(error),
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
                Err(error) => return Err(lock_failed(path, &error)),
            }
            if clock::monotonic() > start.plus_ms(START_TIMEOUT_MS) {
                return Err(ShmError::Busy { path: path.to_owned(), pid: read_pid(path) });
            }
            #[allow(clippy::disallowed_methods, reason = "waits for a lock file at the start of a process")]
            thread::sleep(Duration::from_millis(2));
        }
    }

    /// Changes the lock between shared and exclusive.
    pub(super) fn relock(&self, how: FlockArg) -> Result<(), Errno> {
        self.lock.relock(how)
    }

    /// Writes the id of this process to the file, for messages of other processes.
    pub(super) fn write_pid(&mut self) -> io::Result<()> {
        let mut file: &File = &self.lock;
        file.set_len(0)?;
        file.rewind()?;
        writeln!(file, "{}", std::process::id())
    }

    /// Removes the file and releases the lock, which must be exclusive.
    pub(super) fn remove(self) {
        // The next process creates a new file; one that waits for this lock detects that the file is removed.
        let _ = fs::remove_file(&self.path);
    }
}

fn lock_failed(path: &Path, error: &io::Error) -> ShmError {
    match error.kind() {
        ErrorKind::PermissionDenied => {
            ShmError::Permission { what: "to lock".to_owned(), path: path.to_owned() }
        }
        _ => {
            ShmError::Failed { what: "to lock".to_owned(), path: path.to_owned(), reason: error.to_string() }
        }
    }
}

/// The process id in a lock file; 0 if there is none.
pub(super) fn read_pid(path: &Path) -> u32 {
    let mut text = String::new();
    let read = File::open(path).and_then(|file| file.take(16).read_to_string(&mut text));
    read.ok().and_then(|_| text.trim().parse().ok()).unwrap_or(0)
}

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
                    let swept = dir.sweep();
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

/// Whether the path still names the locked file, which another process may have removed while the lock
/// changed.
pub(super) fn lock_is_current(lock: &FileLock) -> bool {
    match (lock.lock.metadata(), fs::symlink_metadata(&lock.path)) {
        (Ok(locked), Ok(named)) => locked.ino() == named.ino() && locked.dev() == named.dev(),
        _ => false,
    }
}

impl Drop for Membership {
    /// The last process that leaves removes all files of the instance.
    fn drop(&mut self) {
        if let Some(lock) = self.lock.take()
            && lock.relock(FlockArg::LockExclusiveNonblock).is_ok()
            && lock_is_current(&lock)
        {
            self.dir.sweep();
            lock.remove();
            // Fails while a role lock is held there; its release retries.
            let _ = fs::remove_dir(&self.dir.path);
        }
    }
}

/// The right to serve a role of an instance, such as `ingress` or `egress-critical`. Held until it is
/// dropped; the kernel releases it when the process ends, in any way.
#[derive(Debug)]
pub struct RoleLock {
    lock: Option<FileLock>,
}

impl RoleLock {
    /// Takes the role; if another process has it, the error names that process.
    pub fn acquire(root: &Path, instance: &InstanceName, role: &str) -> Result<Self, ShmError> {
        for _ in 0..100 {
            let dir = InstanceDir::prepare(root, instance)?;
            match Self::try_acquire(&dir, role) {
                Ok(Some(lock)) => return Ok(lock),
                Ok(None) => {
                    let pid = read_pid(&Self::path(&dir, role));
                    return Err(ShmError::AlreadyServed { role: role.to_owned(), pid });
                }
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(error) => return Err(lock_failed(&Self::path(&dir, role), &error)),
            }
        }
        Err(ShmError::Failed {
            what: format!("to lock the role {role}"),
            path: root.to_owned(),
            reason: "other processes removed the folder in 100 attempts".to_owned(),
        })
    }

    /// The path of a file beside the lock, in which the holder reports the result of its last reload
    /// ([`RoleHolder`](super::RoleHolder)). The file is removed with the instance.
    pub fn note_path(&self) -> Option<PathBuf> {
        self.lock.as_ref().map(|lock| note_path(&lock.path))
    }

    /// The id of the process that holds the role; `None` when no process does. Takes no lock.
    pub(super) fn holder(root: &Path, instance: &InstanceName, role: &str) -> Option<u32> {
        let path = Self::path(&InstanceDir::find(root, instance).ok()??, role);
        let inode = fs::metadata(&path).ok()?.ino();
        let pid = read_pid(&path);
        holders::is_locked_by(pid, inode).then_some(pid)
    }

    /// Takes the role; `None` when another process has it.
    pub(super) fn try_acquire(dir: &InstanceDir, role: &str) -> io::Result<Option<Self>> {
        let taken = FileLock::take(&Self::path(dir, role), FlockArg::LockExclusiveNonblock)?;
        taken
            .map(|mut lock| {
                lock.write_pid()?;
                Ok(Self { lock: Some(lock) })
            })
            .transpose()
    }

    fn path(dir: &InstanceDir, role: &str) -> PathBuf {
        let safe = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        let name: String = role.chars().map(|c| if safe(c) { c } else { '_' }).collect();
        dir.path.join(format!("{ROLE_PREFIX}{name}{LOCK_SUFFIX}"))
    }
}

/// The path of the reload note beside the lock of a role.
pub(super) fn note_path(lock: &Path) -> PathBuf {
    lock.with_extension("reload")
}

impl Drop for RoleLock {
    fn drop(&mut self) {
        if let Some(lock) = self.lock.take() {
            let folder = lock.path.parent().map(Path::to_owned);
            lock.remove();
            if let Some(folder) = folder {
                // Succeeds only for the last process of the instance.
                let _ = fs::remove_dir(folder);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn env(values: &'static [(&'static str, &'static str)]) -> impl Fn(&str) -> Option<OsString> {
        move |name| values.iter().find(|(key, _)| *key == name).map(|(_, value)| OsString::from(value))
    }

    #[test]
    fn the_root_is_the_configured_one_or_the_first_runtime_folder_that_is_set() {
        let systemd = &[("RUNTIME_DIRECTORY", "/run/ab:/run/other"), ("XDG_RUNTIME_DIR", "/run/user/7")];
        assert_eq!(default_root(Some(Path::new("/x")), env(systemd)), Path::new("/x"));
        assert_eq!(default_root(None, env(systemd)), Path::new("/run/ab"));
        if !Path::new("/run/adaptive-bridge").exists() {
            let session = &[("RUNTIME_DIRECTORY", ""), ("XDG_RUNTIME_DIR", "/run/user/7")];
            assert_eq!(default_root(None, env(session)), Path::new("/run/user/7/adaptive-bridge"));
            let relative = &[("XDG_RUNTIME_DIR", "here")];
            let fallback = PathBuf::from(format!("/tmp/adaptive-bridge-{}", geteuid()));
            assert_eq!(default_root(None, env(relative)), fallback);
            assert_eq!(default_root(None, env(&[])), fallback);
        }
    }
}
