//! Reading access to a route's pool beside its channel: for samples that ingress has not published yet, and
//! for those that it keeps.

use std::fs::File;
use std::num::NonZeroUsize;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::Arc;

use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};

use super::error::ShmError;
use super::header::WireHeader;
use super::root::SHM_DIR;

/// A pool's file, of which parts are copied: to read them in a mapping takes a page fault for each slot,
/// 2.5 ms for 600 samples, for which a take-over waits.
pub(super) struct PoolFile {
    path: PathBuf,
    file: File,
}

impl PoolFile {
    /// Opens the pool whose file has this name.
    pub fn open(name: &str) -> Result<Self, ShmError> {
        let path = Path::new(SHM_DIR).join(name);
        if name.contains('/') {
            return Err(ShmError::failed("to open a pool", &path, "it is not the name of a file"));
        }
        match File::open(&path) {
            Ok(file) => Ok(Self { path, file }),
            Err(error) => Err(ShmError::os("to open a pool", &path, &error)),
        }
    }

    /// The header at that place; `None` if the pool does not contain it.
    pub fn header(&self, offset: u64) -> Option<WireHeader> {
        let mut bytes = [0; size_of::<WireHeader>()];
        self.file.read_exact_at(&mut bytes, offset).ok()?;
        // SAFETY: the array has the size of a header, and every bit pattern is a valid one.
        Some(unsafe { bytes.as_ptr().cast::<WireHeader>().read_unaligned() })
    }

    /// The payload at that place; `None` if the pool does not contain it.
    pub fn payload(&self, offset: u64, len: u64) -> Option<Box<[u8]>> {
        // Before memory is taken for it.
        if offset.checked_add(len)? > self.file.metadata().ok()?.len() {
            return None;
        }
        let mut bytes = vec![0; usize::try_from(len).ok()?];
        self.file.read_exact_at(&mut bytes, offset).ok()?;
        Some(bytes.into_boxed_slice())
    }
}

/// A read-only mapping of a pool's file.
#[derive(Debug)]
pub struct PoolView {
    start: NonNull<u8>,
    len: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread, and is only read.
unsafe impl Send for PoolView {}
// SAFETY: as above.
unsafe impl Sync for PoolView {}

impl PoolView {
    /// Maps the pool whose file has this name, which a [`PartialSample`](crate::model::PartialSample) tells.
    ///
    /// # Errors
    /// There is no such file, or it cannot be mapped.
    pub fn open(name: &str) -> Result<Arc<Self>, ShmError> {
        let PoolFile { path, file } = PoolFile::open(name)?;
        let metadata = file.metadata().map_err(|error| ShmError::os("to open a pool", &path, &error))?;
        let len = usize::try_from(metadata.len()).ok().and_then(NonZeroUsize::new);
        let len = len.ok_or_else(|| ShmError::failed("to map a pool", &path, "it is empty"))?;
        // SAFETY: a new mapping at an address that the kernel chooses, of a file that has that length.
        let start = unsafe { mmap(None, len, ProtFlags::PROT_READ, MapFlags::MAP_SHARED, &file, 0) }
            .map_err(|errno| ShmError::os("to map a pool", &path, &errno.into()))?;
        Ok(Arc::new(Self { start: start.cast(), len: len.get() }))
    }

    /// The payload at that place; `None` if the pool does not contain it.
    pub fn payload(self: &Arc<Self>, offset: u64, len: u64) -> Option<PoolPayload> {
        let (offset, len) = (usize::try_from(offset).ok()?, usize::try_from(len).ok()?);
        let end = offset.checked_add(len)?;
        (end <= self.len).then(|| PoolPayload { view: self.clone(), offset, len })
    }
}

impl Drop for PoolView {
    fn drop(&mut self) {
        // SAFETY: `open` mapped exactly this range, and every payload holds the view.
        let _ = unsafe { munmap(self.start.cast(), self.len) };
    }
}

/// A payload that ingress may still write. Whoever reads it reads only the bytes that the board shows as
/// complete, and takes what it has read for the sample only if ingress publishes that sample afterwards:
/// until then ingress may reuse the slot.
#[derive(Debug)]
pub struct PoolPayload {
    view: Arc<PoolView>,
    offset: usize,
    len: usize,
}

impl AsRef<[u8]> for PoolPayload {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: the range is within the mapping, which lives as long as `view`. Another process may write
        // to the bytes; they are only passed to the kernel, which copies them to a socket, and no decision
        // of this process depends on them.
        unsafe { std::slice::from_raw_parts(self.view.start.as_ptr().add(self.offset), self.len) }
    }
}
