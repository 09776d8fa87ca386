//! Finds the processes that serve the roles of an instance, and the files of an instance.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::ShmError;
use super::root::{InstanceDir, LOCK_SUFFIX, ROLE_PREFIX, read_pid};
use crate::model::InstanceName;

/// The file in which Linux lists held locks (proc_locks(5)).
const LOCKS: &str = "/proc/locks";

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
        let failed = |path: &Path, error: io::Error| ShmError::Failed {
            what: "to find the processes of the bridge".to_owned(),
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let locks = fs::read_to_string(LOCKS).map_err(|error| failed(Path::new(LOCKS), error))?;
        let entries = fs::read_dir(&dir.path).map_err(|error| failed(&dir.path, error))?;
        let mut holders: Vec<Self> = entries
            .flatten()
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                let role = name.strip_prefix(ROLE_PREFIX)?.strip_suffix(LOCK_SUFFIX)?;
                // A tap also has a lock, but is not a process of the bridge.
                let is_process = matches!(role, "ingress" | "control") || role.starts_with("egress-");
                let (path, inode) = (entry.path(), entry.metadata().ok()?.ino());
                let pid = read_pid(&path);
                (is_process && holds(&locks, pid, inode)).then(|| Self {
                    role: role.to_owned(),
                    pid,
                    note: super::root::note_path(&path),
                })
            })
            .collect();
        holders.sort_by(|one, other| one.role.cmp(&other.role));
        Ok(holders)
    }
}

/// Whether the process holds a lock on the file with that inode number.
pub(super) fn is_locked_by(pid: u32, inode: u64) -> bool {
    fs::read_to_string(LOCKS).is_ok_and(|locks| holds(&locks, pid, inode))
}

/// Lists the files of an instance in the shared-memory file system.
pub fn instance_files(root: &Path, instance: &InstanceName) -> Vec<PathBuf> {
    match InstanceDir::find(root, instance) {
        Ok(Some(dir)) => dir.shm_files(),
        Ok(None) | Err(_) => Vec::new(),
    }
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
