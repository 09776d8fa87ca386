//! The folder of an instance, which is private to its user.

use std::ffi::OsString;
use std::fs::{self, DirBuilder};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, DirEntryExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use nix::unistd::{AccessFlags, access, geteuid};

use super::error::ShmError;
use crate::config::Settings;
use crate::model::{InstanceName, fnv1a};

/// The folder of POSIX shared memory on Linux.
pub(super) const SHM_DIR: &str = "/dev/shm";

/// The longest path of iceoryx2, which panics on a longer one. Its longest file name after the bridge's
/// prefix is that of a connection: a type hash (28), `_`, two port ids joined by `_` (79), and `.connection`
/// (11).
const ICEORYX_PATH_MAX: usize = 255;
const ICEORYX_NAME_MAX: usize = 28 + 1 + 79 + 11;

/// Returns the root of the bridge with these settings, in this environment.
pub fn root_of(settings: &Settings) -> PathBuf {
    default_root(settings.shared_memory.root_path.as_deref(), |name| std::env::var_os(name))
}

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
        let real = fs::canonicalize(root).map_err(cannot_create(root))?;
        let found = Self::at(&real, instance)?;
        make_private(&found.path)?;
        // Other users may list the root, but not the instance's folder.
        fs::set_permissions(&found.path, fs::Permissions::from_mode(0o700))
            .map_err(cannot_create(&found.path))?;
        Ok(found)
    }

    /// Finds the folder; `None` if it does not exist.
    pub(super) fn find(root: &Path, instance: &InstanceName) -> Result<Option<Self>, ShmError> {
        let real = match fs::canonicalize(root) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            real => real.map_err(cannot_create(root))?,
        };
        let found = Self::at(&real, instance)?;
        if !found.path.is_dir() {
            return Ok(None);
        }
        check_owner(&found.path)?;
        Ok(Some(found))
    }

    /// Prepares the folder and calls `attempt`, again while that returns `None`, because another process that
    /// left as the last one has removed the folder. `what` is `to` and a verb.
    pub(super) fn prepare_until<T>(
        root: &Path,
        instance: &InstanceName,
        what: &str,
        mut attempt: impl FnMut(Self) -> Result<Option<T>, ShmError>,
    ) -> Result<T, ShmError> {
        for _ in 0..100 {
            if let Some(done) = attempt(Self::prepare(root, instance)?)? {
                return Ok(done);
            }
        }
        Err(ShmError::failed(what, root, "other processes removed the folder in 100 attempts"))
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
        self.shm_inodes().into_iter().map(|(_, path)| path).collect()
    }

    /// This instance's files in [`SHM_DIR`], with their inode numbers, which no later file has.
    pub(super) fn shm_inodes(&self) -> Vec<(u64, PathBuf)> {
        let Ok(entries) = fs::read_dir(SHM_DIR) else { return Vec::new() };
        let ours = |name: &OsString| name.as_encoded_bytes().starts_with(self.prefix.as_bytes());
        let entries = entries.flatten().map(|entry| (entry.ino(), entry.file_name()));
        let ours = entries.filter(|(_, name)| ours(name));
        ours.map(|(inode, name)| (inode, Path::new(SHM_DIR).join(name))).collect()
    }
}

/// Creates a folder with mode 0700, and its parents, or checks the owner and mode of an existing one.
pub(super) fn make_private(path: &Path) -> Result<(), ShmError> {
    match DirBuilder::new().recursive(true).mode(0o700).create(path) {
        Ok(()) => check_owner(path),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            Err(ShmError::RootNotOurs { path: path.to_owned(), reason: "it is not a folder".to_owned() })
        }
        Err(error) => Err(cannot_create(path)(error)),
    }
}

fn cannot_create(path: &Path) -> impl FnOnce(io::Error) -> ShmError {
    |source| ShmError::CannotCreateRoot { path: path.to_owned(), source }
}

fn check_owner(path: &Path) -> Result<(), ShmError> {
    let refuse = |reason: String| Err(ShmError::RootNotOurs { path: path.to_owned(), reason });
    let metadata = fs::symlink_metadata(path).map_err(cannot_create(path))?;
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
