//! A segment of shared memory, made of 64-bit words, which outlives the processes that map it.

use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions};
use std::io::ErrorKind;
use std::num::NonZeroUsize;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU32, AtomicU64};

use nix::errno::Errno;
use nix::fcntl::posix_fallocate;
use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};
use nix::sys::statvfs::statvfs;

use super::error::ShmError;
use super::root::SHM_DIR;

/// A mapped segment of shared memory. All access is atomic, so that concurrent writes of other processes are
/// not undefined behaviour.
#[derive(Debug)]
pub(super) struct Segment {
    start: NonNull<u64>,
    words: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread, and is accessed by atomics only.
unsafe impl Send for Segment {}
// SAFETY: as above.
unsafe impl Sync for Segment {}

impl Segment {
    /// Opens the segment at `path`, which must have `words` words; `None` when there is none.
    pub(super) fn open(path: &Path, words: usize) -> Result<Option<Self>, ShmError> {
        let file = match OpenOptions::new().read(true).write(true).open(path) {
            Ok(file) => file,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(ShmError::os("to open shared memory", path, &error)),
        };
        let metadata = file
            .metadata()
            .map_err(|error| ShmError::os("to get the size of shared memory", path, &error))?;
        if metadata.len() != words as u64 * 8 {
            return Err(ShmError::Incompatible {
                what: format!("the boards have {} bytes, not {}", metadata.len(), words * 8),
                path: path.to_owned(),
            });
        }
        Self::map(&file, path, words).map(Some)
    }

    /// Creates the segment, with the words of `first` followed by zeroes, or opens the one that another
    /// process created first. It gets its name when it is complete, so no process opens an incomplete one.
    pub(super) fn create(path: &Path, words: usize, first: &[u64]) -> Result<Self, ShmError> {
        let draft = path.with_extension(format!("draft{}", std::process::id()));
        let made =
            Self::create_at(&draft, words, first).and_then(|segment| match fs::hard_link(&draft, path) {
                Ok(()) => Ok(Some(segment)),
                Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(None),
                Err(error) => Err(ShmError::os("to name shared memory", path, &error)),
            });
        let _ = fs::remove_file(&draft);
        match made? {
            Some(segment) => Ok(segment),
            None => Self::open(path, words)?.ok_or_else(|| {
                ShmError::failed("to open shared memory", path, "another process removed it at the same time")
            }),
        }
    }

    fn create_at(path: &Path, words: usize, first: &[u64]) -> Result<Self, ShmError> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(path)
            .map_err(|error| ShmError::os("to create shared memory", path, &error))?;
        commit(&file, words as u64 * 8, "the boards of the bridge")?;
        let segment = Self::map(&file, path, words)?;
        for (at, &word) in first.iter().enumerate() {
            segment.word(at).store(word, std::sync::atomic::Ordering::Relaxed);
        }
        Ok(segment)
    }

    fn map(file: &File, path: &Path, words: usize) -> Result<Self, ShmError> {
        let length = NonZeroUsize::new(words * 8)
            .ok_or_else(|| ShmError::failed("to map shared memory", path, "it is empty"))?;
        let protection = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        // SAFETY: a new mapping at an address that the kernel chooses, of a file that has that length.
        let start = unsafe { mmap(None, length, protection, MapFlags::MAP_SHARED, file, 0) }
            .map_err(|errno| ShmError::os("to map shared memory", path, &errno.into()))?;
        Ok(Self { start: start.cast(), words })
    }

    /// The word at that offset. Panics for an offset outside, which is a defect, because offsets are computed
    /// from the layout.
    pub(super) fn word(&self, at: usize) -> &AtomicU64 {
        assert!(at < self.words, "word {at} of {}", self.words);
        // SAFETY: the word is within the mapping, which lives as long as `self`; mappings are aligned to a
        // page, so each word to 8 bytes; and every access, in every process, is atomic.
        unsafe { AtomicU64::from_ptr(self.start.add(at).as_ptr()) }
    }

    /// The lower-addressed half of the word at that offset.
    pub(super) fn half(&self, at: usize) -> &AtomicU32 {
        assert!(at < self.words, "word {at} of {}", self.words);
        // SAFETY: as for `word`; a word that is used by halves is never accessed as a whole.
        unsafe { AtomicU32::from_ptr(self.start.add(at).as_ptr().cast()) }
    }
}

impl Drop for Segment {
    fn drop(&mut self) {
        // SAFETY: `map` mapped exactly this range, and all references into it borrow `self`.
        let _ = unsafe { munmap(self.start.cast(), self.words * 8) };
    }
}

/// The free bytes in [`SHM_DIR`]; 0 when the file system does not report them.
pub(super) fn free_bytes() -> u64 {
    statvfs(SHM_DIR).map_or(0, |stat| stat.blocks_available() * stat.fragment_size())
}

/// Returns an error if shared memory has fewer free bytes: a process that touches a page for which there is
/// no memory is killed by SIGBUS.
pub(super) fn require_free(needed_bytes: u64, what: &str) -> Result<(), ShmError> {
    let free_bytes = free_bytes();
    if free_bytes < needed_bytes { Err(no_room(what, needed_bytes, free_bytes)) } else { Ok(()) }
}

/// The error of shared memory that has fewer free bytes than `what` needs.
pub(super) fn no_room(what: &str, needed_bytes: u64, free_bytes: u64) -> ShmError {
    ShmError::NoRoom { what: what.to_owned(), needed_bytes, free_bytes, path: SHM_DIR.into() }
}

/// Allocates all pages of a file in shared memory.
fn commit(file: &File, bytes: u64, what: &str) -> Result<(), ShmError> {
    loop {
        return match posix_fallocate(file, 0, bytes.cast_signed()) {
            Ok(()) => Ok(()),
            Err(Errno::EINTR) => continue,
            Err(Errno::ENOSPC) => Err(no_room(what, bytes, free_bytes())),
            Err(errno) => Err(ShmError::os("to reserve shared memory", Path::new(SHM_DIR), &errno.into())),
        };
    }
}

/// How the name of a pool ends, of which ingress allocates what it uses.
const POOL_SUFFIX: &str = "data";

/// Allocates all pages of files in shared memory, but not those of pools, nor of files that are `committed`.
/// iceoryx2 only sets the length of its segments; if the file system is full when a page is first touched,
/// SIGBUS kills the process while it handles a sample.
pub(super) fn commit_files(
    files: &[(u64, PathBuf)],
    committed: &mut BTreeSet<u64>,
    what: &str,
) -> Result<(), ShmError> {
    let before = std::mem::take(committed);
    for (inode, path) in files {
        if path.extension().is_some_and(|suffix| suffix == POOL_SUFFIX) {
            continue;
        }
        if !before.contains(inode) {
            // A file that is missing or not readable yet belongs to a process that is starting or ending.
            let Ok(file) = OpenOptions::new().read(true).write(true).open(path) else { continue };
            let Ok(metadata) = file.metadata() else { continue };
            if metadata.len() == 0 {
                continue;
            }
            if metadata.blocks() * 512 < metadata.len() {
                commit(&file, metadata.len(), what)?;
            }
        }
        committed.insert(*inode);
    }
    Ok(())
}
