//! The roles of an instance: the lock of each, and the processes that serve them.

use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::fcntl::FlockArg;

use super::error::ShmError;
use super::lock::{FileLock, LOCK_SUFFIX, read_pid};
use super::root::InstanceDir;
use crate::model::InstanceName;

/// The file in which Linux lists held locks (proc_locks(5)).
const LOCKS: &str = "/proc/locks";

/// How often the list is read before a lock that is not in it counts as not held. The kernel hands the list
/// out in pieces of at most 4 KiB, some 70 locks, and goes on at a position: a lock that is released between
/// two pieces hides another one. Among 400 locks that come and go, 14 of 10,000 readings missed a given one.
const READINGS: usize = 10;

const ROLE_PREFIX: &str = "role-";

/// What the name of the lock of a standby begins with, before the role that it waits for.
const STANDBY_PREFIX: &str = "standby-";

/// The right to serve a role of an instance, such as `ingress` or `egress-critical`. Held until it is
/// dropped; the kernel releases it when the process ends, in any way.
#[derive(Debug)]
pub struct RoleLock {
    lock: FileLock,
}

impl RoleLock {
    /// Takes the role; if another process has it, the error names that process.
    pub fn acquire(root: &Path, instance: &InstanceName, role: &str) -> Result<Self, ShmError> {
        let what = format!("to lock the role {role}");
        InstanceDir::prepare_until(root, instance, &what, |dir| {
            let path = Self::path(&dir, role);
            match Self::try_acquire(&dir, role) {
                Ok(Some(lock)) => Ok(Some(lock)),
                Ok(None) => Err(ShmError::AlreadyServed { role: role.to_owned(), pid: read_pid(&path) }),
                Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
                Err(error) => Err(ShmError::os("to lock", &path, &error)),
            }
        })
    }

    /// Takes the right to wait for a role: a role has one standby.
    ///
    /// # Errors
    /// As for [`acquire`](Self::acquire): another process waits for the role already.
    pub fn acquire_standby(root: &Path, instance: &InstanceName, role: &str) -> Result<Self, ShmError> {
        Self::acquire(root, instance, &format!("{STANDBY_PREFIX}{role}"))
    }

    /// The path of the socket of the role's standby, for the lock of the role and for that of the standby.
    pub fn standby_socket(&self) -> PathBuf {
        let name = self.lock.path.file_stem().unwrap_or_default().to_string_lossy();
        let role = name.strip_prefix(ROLE_PREFIX).unwrap_or(&name);
        let role = role.strip_prefix(STANDBY_PREFIX).unwrap_or(role);
        self.lock.path.with_file_name(format!("{STANDBY_PREFIX}{role}.socket"))
    }

    /// The path of a file beside the lock, in which the holder reports the result of its last reload
    /// ([`RoleHolder`]). The file is removed with the instance.
    pub fn note_path(&self) -> PathBuf {
        note_path(&self.lock.path)
    }

    /// The id of the process that holds the role; `None` when no process does. Takes no lock.
    pub(super) fn holder(root: &Path, instance: &InstanceName, role: &str) -> Option<u32> {
        let path = Self::path(&InstanceDir::find(root, instance).ok()??, role);
        let inode = fs::metadata(&path).ok()?.ino();
        let pid = read_pid(&path);
        let mut locks = fs::read_to_string(LOCKS).ok()?;
        holds_in_any(&mut locks, pid, inode).then_some(pid)
    }

    /// Takes the role; `None` when another process has it.
    pub(super) fn try_acquire(dir: &InstanceDir, role: &str) -> io::Result<Option<Self>> {
        let taken = FileLock::take(&Self::path(dir, role), FlockArg::LockExclusiveNonblock)?;
        let Some(mut lock) = taken else { return Ok(None) };
        lock.write_pid()?;
        Ok(Some(Self { lock }))
    }

    fn path(dir: &InstanceDir, role: &str) -> PathBuf {
        let safe = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        let name: String = role.chars().map(|c| if safe(c) { c } else { '_' }).collect();
        dir.path.join(format!("{ROLE_PREFIX}{name}{LOCK_SUFFIX}"))
    }
}

/// The path of the reload note beside the lock of a role.
fn note_path(lock: &Path) -> PathBuf {
    lock.with_extension("reload")
}

impl Drop for RoleLock {
    fn drop(&mut self) {
        self.lock.remove();
        if let Some(folder) = self.lock.path.parent() {
            // Succeeds only for the last process of the instance.
            let _ = fs::remove_dir(folder);
        }
    }
}

/// A process that serves a role of an instance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RoleHolder {
    /// The role: `ingress`, `control`, `egress-critical`, …
    pub role: String,
    /// Its process id. The kernel reports that this process holds the role's lock, so it is not another
    /// process that got the id of a dead one.
    pub pid: u32,
    /// The path of the file in which it reports the result of its last reload.
    pub note: PathBuf,
}

impl RoleHolder {
    /// Lists the processes that serve a role of the instance now, sorted by role; empty when the bridge is
    /// not running. Takes no lock, so that it never makes the start of a role fail.
    ///
    /// # Errors
    /// The folder of the instance belongs to another user, or the list of locks cannot be read.
    pub fn all(root: &Path, instance: &InstanceName) -> Result<Vec<Self>, ShmError> {
        let Some(dir) = InstanceDir::find(root, instance)? else { return Ok(Vec::new()) };
        let what = "to find the processes of the bridge";
        let mut locks =
            fs::read_to_string(LOCKS).map_err(|error| ShmError::failed(what, Path::new(LOCKS), error))?;
        let entries = fs::read_dir(&dir.path).map_err(|error| ShmError::failed(what, &dir.path, error))?;
        let mut holders: Vec<Self> = entries
            .flatten()
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                let role = name.strip_prefix(ROLE_PREFIX)?.strip_suffix(LOCK_SUFFIX)?;
                // A tap also has a lock, but is not a process of the bridge.
                let is_process = matches!(role, "ingress" | "control") || role.starts_with("egress-");
                let (path, inode) = (entry.path(), entry.metadata().ok()?.ino());
                let pid = read_pid(&path);
                (is_process && holds_in_any(&mut locks, pid, inode)).then(|| Self {
                    role: role.to_owned(),
                    pid,
                    note: note_path(&path),
                })
            })
            .collect();
        holders.sort_by(|one, other| one.role.cmp(&other.role));
        Ok(holders)
    }
}

/// Lists the files of an instance in the shared-memory file system.
pub fn instance_files(root: &Path, instance: &InstanceName) -> Vec<PathBuf> {
    match InstanceDir::find(root, instance) {
        Ok(Some(dir)) => dir.shm_files(),
        Ok(None) | Err(_) => Vec::new(),
    }
}

/// Whether a process holds a lock: by the list `locks`, or by one of the next readings, which replace it.
fn holds_in_any(locks: &mut String, pid: u32, inode: u64) -> bool {
    let read_again = |locks: &mut String| {
        if let Ok(read) = fs::read_to_string(LOCKS) {
            *locks = read;
        }
        holds(locks, pid, inode)
    };
    holds(locks, pid, inode) || (pid != 0 && (1..READINGS).any(|_| read_again(locks)))
}

/// Whether the list of locks has an exclusive one of that process on the file with that inode number: a line
/// such as `1: FLOCK  ADVISORY  WRITE 708 00:1a:2389 0 EOF`. The device is not compared, because on some file
/// systems it differs from that of `stat`.
fn holds(locks: &str, pid: u32, inode: u64) -> bool {
    pid != 0
        && locks.lines().any(|line| {
            let mut fields = line.split_ascii_whitespace().skip(1);
            fields.next() == Some("FLOCK")
                && fields.nth(1) == Some("WRITE")
                && fields.next().and_then(|field| field.parse().ok()) == Some(pid)
                && fields.next().and_then(|file| file.rsplit(':').next()?.parse().ok()) == Some(inode)
        })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::shm::RoleLock;

    #[test]
    fn only_a_process_with_an_exclusive_flock_holds_a_role() {
        let locks = "1: POSIX  ADVISORY  WRITE 7 00:1a:23 0 EOF\n\
                     2: FLOCK  ADVISORY  WRITE 708 fe:00:2389 0 EOF\n\
                     2: -> FLOCK  ADVISORY  WRITE 709 fe:00:2389 0 EOF\n\
                     3: FLOCK  ADVISORY  READ 710 fe:00:2389 0 EOF\n";
        assert!(holds(locks, 708, 2389));
        for (pid, inode) in [(708, 238), (7, 23), (709, 2389), (710, 2389), (0, 2389)] {
            assert!(!holds(locks, pid, inode), "{pid} {inode}");
        }
        assert!(!holds("nonsense\n\n1: FLOCK\n", 1, 1));
    }

    #[test]
    fn a_process_is_listed_while_other_locks_come_and_go() {
        let (root, others) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let instance = InstanceName::try_from("holders").unwrap();
        let _ingress = RoleLock::acquire(root.path(), &instance, "ingress").unwrap();
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    let lock = |index: usize| {
                        let path = others.path().join(index.to_string());
                        FileLock::take(&path, FlockArg::LockExclusiveNonblock).unwrap()
                    };
                    let _locks: Vec<_> = (0..100).map(lock).collect();
                }
            });
            let missed = (0..8_000).filter(|_| {
                let found = RoleHolder::all(root.path(), &instance);
                !found.is_ok_and(|found| found.len() == 1)
            });
            let missed = missed.count();
            done.store(true, Ordering::Relaxed);
            assert_eq!(missed, 0);
        });
    }

    #[test]
    fn only_living_processes_with_a_role_are_listed() {
        let root = tempfile::tempdir().unwrap();
        let instance = InstanceName::try_from("holders").unwrap();
        let all = || RoleHolder::all(root.path(), &instance).unwrap();
        assert_eq!(all(), []);
        let _ingress = RoleLock::acquire(root.path(), &instance, "ingress").unwrap();
        let _lane = RoleLock::acquire(root.path(), &instance, "egress-rviz").unwrap();
        let _tap = RoleLock::acquire(root.path(), &instance, "tap-scan-0").unwrap();
        // A process that was killed leaves a file with a process id that is not locked.
        let folder = root.path().join("holders");
        fs::write(folder.join("role-egress-dead.lock"), std::process::id().to_string()).unwrap();
        let found = all();
        let roles: Vec<&str> = found.iter().map(|holder| holder.role.as_str()).collect();
        assert_eq!(roles, ["egress-rviz", "ingress"]);
        assert!(found.iter().all(|holder| holder.pid == std::process::id()));
        assert_eq!(found[1].note, folder.join("role-ingress.reload"));
    }
}
