//! The file with the configuration in force of an instance, the file with the parameters that were set while
//! it runs, and the lock that shows whether they are valid.
//!
//! Every process of a running bridge holds the lock shared; a tap does not. The process that gets it
//! exclusively is the first one, and writes the file. A file whose lock no process holds was left by a killed
//! bridge, and is overwritten, or removed. The caller encodes and decodes the content.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use nix::fcntl::FlockArg;
use serde::{Deserialize, Serialize};

use super::error::ShmError;
use super::lock::{FileLock, read_pid};
use super::roles::{RoleHolder, RoleLock};
use super::root::{InstanceDir, make_private};
use crate::clock;
use crate::model::{InstanceName, fnv1a};

const LOCK: &str = "in-force.lock";
const FILE: &str = "in-force.json";
const PARAMETERS: &str = "parameters.json";

/// The most bytes that are read of a file. A configuration file has 1 MiB at most.
const MAX_BYTES: u64 = 8 << 20;

/// How long a start waits for the first process to write the file, which takes a few milliseconds.
const JOIN_TIMEOUT_MS: u64 = 5_000;

/// The share of a process in the configuration in force, which exists as long as any process of the instance
/// has a share.
#[derive(Debug)]
pub struct InForceShare {
    lock: Option<FileLock>,
    dir: PathBuf,
}

impl InForceShare {
    /// Joins a running bridge and returns its configuration in force; `None` when no process is running.
    ///
    /// # Errors
    /// The folder of the instance belongs to another user, or a file in it cannot be read.
    pub fn join_running(root: &Path, instance: &InstanceName) -> Result<Option<(Self, Vec<u8>)>, ShmError> {
        let Some(dir) = InstanceDir::find(root, instance)? else { return Ok(None) };
        match Self::attempt(&dir, None) {
            Ok(joined) => Ok(joined.map(|(share, bytes, _)| (share, bytes))),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(ShmError::failed("to join the running bridge", &dir.path, error)),
        }
    }

    /// Joins a running bridge, or puts `first` in force when no process is running. Returns the configuration
    /// in force, which is `first` in the second case.
    ///
    /// # Errors
    /// As for [`join_running`](Self::join_running), or the file cannot be written.
    pub fn join(root: &Path, instance: &InstanceName, first: &[u8]) -> Result<(Self, Vec<u8>), ShmError> {
        let (share, bytes, _) = Self::join_or_begin(root, instance, first)?;
        Ok((share, bytes))
    }

    /// Puts `first` in force as the first process of the instance.
    ///
    /// # Errors
    /// [`ShmError::AlreadyRuns`] if a process of the instance is running; otherwise as for
    /// [`join`](Self::join).
    pub fn begin(root: &Path, instance: &InstanceName, first: &[u8]) -> Result<Self, ShmError> {
        let (share, _, is_first) = Self::join_or_begin(root, instance, first)?;
        if is_first {
            return Ok(share);
        }
        // The first process may have no role yet, but it has written its process id to the lock file.
        let pid = running_pid(root, instance).unwrap_or_else(|| read_pid(&share.dir.join(LOCK)));
        Err(ShmError::AlreadyRuns { instance: instance.clone(), pid })
    }

    /// Like [`join`](Self::join), and also returns whether this is the first process.
    fn join_or_begin(
        root: &Path,
        instance: &InstanceName,
        first: &[u8],
    ) -> Result<(Self, Vec<u8>, bool), ShmError> {
        let what = "to put a configuration in force";
        InstanceDir::prepare_until(root, instance, what, |dir| match Self::attempt(&dir, Some(first)) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            joined => joined.map_err(|error| ShmError::failed(what, &dir.path, error)),
        })
    }

    /// The file, for putting another configuration in force.
    pub fn file(&self) -> InForceFile {
        InForceFile { dir: self.dir.clone() }
    }

    /// Joins once; also returns the content of the file, and whether this is the first process. `first` is
    /// `None` if the caller does not start a bridge; then the result is `None` if no process is running.
    fn attempt(dir: &InstanceDir, first: Option<&[u8]>) -> io::Result<Option<(Self, Vec<u8>, bool)>> {
        let path = dir.path.join(LOCK);
        let file = InForceFile { dir: dir.path.clone() };
        let joined = |lock, bytes, is_first| {
            Ok(Some((Self { lock: Some(lock), dir: dir.path.clone() }, bytes, is_first)))
        };
        let give_up_at = clock::monotonic().plus_ms(JOIN_TIMEOUT_MS);
        loop {
            if let Some(mut lock) = FileLock::take(&path, FlockArg::LockExclusiveNonblock)? {
                let Some(first) = first else {
                    file.remove();
                    lock.remove();
                    return Ok(None);
                };
                file.remove();
                file.write(first)?;
                lock.write_pid()?;
                // The kernel may give the lock to another process during the change from exclusive to shared.
                // That process is then the first one, and has removed or overwritten the file.
                if lock.relock(FlockArg::LockSharedNonblock).is_ok()
                    && lock.is_current().unwrap_or(false)
                    && let Some(bytes) = file.read()?
                {
                    return joined(lock, bytes, true);
                }
            } else if let Some(lock) = FileLock::take(&path, FlockArg::LockSharedNonblock)?
                && let Some(bytes) = file.read()?
            {
                return joined(lock, bytes, false);
            }
            if clock::monotonic() > give_up_at {
                return Err(io::Error::other(format!(
                    "process {} has held the lock for longer than a start takes",
                    read_pid(&path)
                )));
            }
            #[allow(clippy::disallowed_methods, reason = "waits for a lock file at the start of a process")]
            thread::sleep(Duration::from_millis(2));
        }
    }
}

impl Drop for InForceShare {
    /// The last process that leaves removes the file.
    fn drop(&mut self) {
        if let Some(lock) = self.lock.take()
            && lock.relock(FlockArg::LockExclusiveNonblock).is_ok()
            && lock.is_current().unwrap_or(false)
        {
            self.file().remove();
            lock.remove();
            // Fails while another file is there, whose removal tries again.
            let _ = fs::remove_dir(&self.dir);
        }
    }
}

/// Removes the file and its lock if no process has a share, for the clean-up of an instance.
pub(super) fn sweep(dir: &Path) {
    if let Ok(Some(lock)) = FileLock::take(&dir.join(LOCK), FlockArg::LockExclusiveNonblock) {
        InForceFile { dir: dir.to_owned() }.remove();
        lock.remove();
    }
}

/// Whether this module creates, and removes, the file with that name.
pub(super) fn owns(name: &[u8]) -> bool {
    [LOCK, FILE, PARAMETERS].iter().any(|own| own.as_bytes() == name)
}

/// The id of a running process of the instance, preferably `up`.
fn running_pid(root: &Path, instance: &InstanceName) -> Option<u32> {
    let up = RoleLock::holder(root, instance, "up");
    up.or_else(|| RoleHolder::all(root, instance).ok()?.first().map(|holder| holder.pid))
}

/// The file with the configuration in force.
#[derive(Clone, Debug)]
pub struct InForceFile {
    dir: PathBuf,
}

impl InForceFile {
    /// Finds the file of an instance, running or not, for commands that only read. Takes no lock.
    ///
    /// # Errors
    /// The folder of the instance belongs to another user.
    pub fn find(root: &Path, instance: &InstanceName) -> Result<Option<Self>, ShmError> {
        Ok(InstanceDir::find(root, instance)?.map(|dir| Self { dir: dir.path }))
    }

    /// Reads the content; `None` when there is no file.
    ///
    /// # Errors
    /// The operating system cannot read the file.
    pub fn read(&self) -> io::Result<Option<Vec<u8>>> {
        self.read_file(FILE)
    }

    /// Reads the parameters that were set; `None` when none was.
    ///
    /// # Errors
    /// The operating system cannot read the file.
    pub fn read_parameters(&self) -> io::Result<Option<Vec<u8>>> {
        self.read_file(PARAMETERS)
    }

    /// Replaces the parameters that were set, atomically. Only control calls this.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn write_parameters(&self, bytes: &[u8]) -> io::Result<()> {
        write_privately(&self.dir.join(PARAMETERS), bytes)
    }

    fn read_file(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        let file = match File::open(self.dir.join(name)) {
            Ok(file) => file,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let mut bytes = Vec::new();
        file.take(MAX_BYTES).read_to_end(&mut bytes)?;
        Ok(Some(bytes))
    }

    /// Replaces the content atomically. Only the owner may read the file, because it may contain a secret.
    ///
    /// # Errors
    /// The operating system cannot write the file; `NotFound` if the bridge is ending and has removed the
    /// folder.
    pub fn write(&self, bytes: &[u8]) -> io::Result<()> {
        write_privately(&self.dir.join(FILE), bytes)
    }

    fn remove(&self) {
        for name in [FILE, PARAMETERS] {
            let _ = fs::remove_file(self.dir.join(name));
        }
    }
}

/// Replaces a file atomically by one of mode 0600.
fn write_privately(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let draft = path.with_extension(format!("draft{}", std::process::id()));
    // A draft that a dead process with the same id left may have another mode.
    let _ = fs::remove_file(&draft);
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&draft)?;
    file.write_all(bytes)?;
    drop(file);
    fs::rename(&draft, path)
}

/// The root and instance of the bridge that was started with a configuration file. It is stored under the
/// path of that file, so that a process finds its bridge even if the file is invalid, missing, or names
/// another instance.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BridgeAddress {
    /// The configuration file, as an absolute path.
    file: PathBuf,
    /// The folder that contains the folder of the instance.
    pub root: PathBuf,
    /// The instance.
    pub instance: InstanceName,
}

/// The folder of the addresses in the default root. Names of instances cannot begin with a dot.
const ADDRESSES: &str = ".addresses";

impl BridgeAddress {
    /// Creates the address of the instance in `root` that was started with `file`.
    pub fn new(file: &Path, root: &Path, instance: &InstanceName) -> Self {
        Self { file: file.to_owned(), root: root.to_owned(), instance: instance.clone() }
    }

    /// Writes the address below `default_root`, and removes addresses of bridges whose folders are gone.
    ///
    /// # Errors
    /// The folder cannot be created or belongs to another user, or the file cannot be written.
    pub fn write(&self, default_root: &Path) -> Result<(), ShmError> {
        let folder = default_root.join(ADDRESSES);
        make_private(&folder)?;
        for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            let is_draft = path.extension().is_some_and(|extension| extension != "json");
            let is_stale =
                read_address(&path).is_none_or(|old| !old.root.join(old.instance.as_str()).is_dir());
            if is_stale && !is_draft {
                let _ = fs::remove_file(path);
            }
        }
        let failed =
            |error: io::Error| ShmError::failed("to write the address of the bridge", &folder, error);
        let bytes = serde_json::to_vec(self).map_err(|error| failed(error.into()))?;
        write_privately(&address_path(default_root, &self.file), &bytes).map_err(failed)
    }

    /// Finds the address of the bridge that was started with `file`; `None` when there is none. The bridge
    /// may have ended.
    pub fn find(default_root: &Path, file: &Path) -> Option<Self> {
        let found = read_address(&address_path(default_root, file))?;
        (found.file == file).then_some(found)
    }
}

fn address_path(default_root: &Path, file: &Path) -> PathBuf {
    let hash = fnv1a(file.as_os_str().as_encoded_bytes());
    default_root.join(ADDRESSES).join(format!("{hash:016x}.json"))
}

fn read_address(path: &Path) -> Option<BridgeAddress> {
    let mut bytes = Vec::new();
    File::open(path).ok()?.take(MAX_BYTES).read_to_end(&mut bytes).ok()?;
    serde_json::from_slice(&bytes).ok()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn instance() -> InstanceName {
        InstanceName::try_from("kept").unwrap()
    }

    #[test]
    fn the_first_configuration_stays_in_force_until_the_last_process_has_left() {
        let root = tempfile::tempdir().unwrap();
        let join = |first: &[u8]| InForceShare::join(root.path(), &instance(), first).unwrap();
        let running = || InForceShare::join_running(root.path(), &instance()).unwrap();
        assert!(running().is_none());
        let (one, bytes) = join(b"one");
        assert_eq!(bytes, b"one");
        let (two, bytes) = join(b"two");
        assert_eq!(bytes, b"one");
        let mode = fs::metadata(root.path().join("kept").join(FILE)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        one.file().write(b"changed").unwrap();
        drop(one);
        assert_eq!(running().unwrap().1, b"changed");
        drop(two);
        assert!(running().is_none());
        assert!(!root.path().join("kept").exists());
        assert_eq!(join(b"three").1, b"three");
    }

    #[test]
    fn the_file_of_a_killed_bridge_is_not_in_force() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("kept");
        let (mut share, _) = InForceShare::join(root.path(), &instance(), b"old").unwrap();
        // A process that dies leaves its files, and the kernel releases its lock.
        drop(share.lock.take());
        assert!(folder.join(FILE).exists());
        assert_eq!(InForceShare::join(root.path(), &instance(), b"new").unwrap().1, b"new");
    }

    #[test]
    fn a_second_first_process_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let _first = InForceShare::begin(root.path(), &instance(), b"one").unwrap();
        match InForceShare::begin(root.path(), &instance(), b"two") {
            Err(ShmError::AlreadyRuns { pid, .. }) => assert_eq!(pid, std::process::id()),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn an_address_is_found_by_the_configuration_file_until_the_bridge_folder_is_removed() {
        let root = tempfile::tempdir().unwrap();
        let other = tempfile::tempdir().unwrap();
        let find = |file: &str| BridgeAddress::find(root.path(), Path::new(file));
        let address = BridgeAddress::new(Path::new("/a.yaml"), other.path(), &instance());
        fs::create_dir(other.path().join("kept")).unwrap();
        address.write(root.path()).unwrap();
        assert_eq!(find("/a.yaml"), Some(address));
        assert_eq!(find("/b.yaml"), None);
        fs::remove_dir(other.path().join("kept")).unwrap();
        BridgeAddress::new(Path::new("/b.yaml"), other.path(), &instance()).write(root.path()).unwrap();
        assert_eq!(find("/a.yaml"), None);
        assert!(find("/b.yaml").is_some());
    }
}
