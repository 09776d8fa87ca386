//! One value in shared memory that its one writer changes and any process reads without waiting.
//!
//! A value is kept in several copies. The writer fills the next copy, then shows it by counting up the
//! version. A writer that dies within an update therefore leaves the former value, whole. A reader takes the
//! copy that is shown, and reads again if the writer has begun to fill that copy meanwhile: it never waits
//! and never sees half a value.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::sync::atomic::{Ordering, fence};

use super::segment::Segment;
use crate::model::{
    AbsenceRecord, ControlRecord, IngressCounters, IntruderRecord, LaneCounters, LanePolicy,
    LatencyHistogram, NamedEndpoint, OutputReaders, ProbeRefusal, ProcessHealth, PublisherAccount, RouteInfo,
    SubscriberRecord,
};

/// Words of a cache line, on which every value begins, so that two writers never share one.
pub(super) const LINE: usize = 8;
/// Copies of a value. A reader, which takes some 100 ns when the writer is on another CPU, starts again only
/// if more than `COPIES - 2` updates came meanwhile.
const COPIES: u64 = 4;
/// Attempts of a reader, so that a writer that changes the value without pause cannot hold it.
const READ_ATTEMPTS: usize = 1_000;

/// A type that may be copied through shared memory word by word.
///
/// # Safety
/// `repr(C)`, without padding, of a size that is a multiple of 8 bytes, and every bit pattern is a value.
pub(super) unsafe trait Plain: Copy + Default {
    /// Its size in words.
    const WORDS: usize = {
        assert!(size_of::<Self>().is_multiple_of(8));
        size_of::<Self>() / 8
    };
}

// SAFETY: `repr(C)`; words of 8 bytes, then `mode` and 7 reserved bytes, then a word; integers only.
unsafe impl Plain for ProcessHealth {}
// SAFETY: `repr(C)`, 64-bit integers and a GUID of 16 bytes at a multiple of 8.
unsafe impl Plain for IngressCounters {}
// SAFETY: `repr(C)`, a GUID of 16 bytes, then 64-bit integers only.
unsafe impl Plain for PublisherAccount {}
// SAFETY: `repr(C)`, 64-bit integers and a GUID of 16 bytes at a multiple of 8.
unsafe impl Plain for LaneCounters {}
// SAFETY: `repr(C)`; records of a GUID of 16 bytes and four 64-bit integers.
unsafe impl Plain for OutputReaders {}
// SAFETY: `repr(C)`; a GUID of 16 bytes, then twice 128 bytes of text, which is checked when it is read.
unsafe impl Plain for NamedEndpoint {}
// SAFETY: `repr(C)`; four words, then 8 single bytes; integers only.
unsafe impl Plain for LanePolicy {}
// SAFETY: `repr(C)`; words, 8 single bytes, 128 bytes of text, which is checked when it is looked at.
unsafe impl Plain for ControlRecord {}
// SAFETY: `repr(C)`; 128 bytes of text, nine words, 8 single bytes, 128 bytes of text.
unsafe impl Plain for SubscriberRecord {}
// SAFETY: `repr(C)`; four times 128 bytes of text, then a word.
unsafe impl Plain for IntruderRecord {}
// SAFETY: `repr(C)`; three words, then three times 128 bytes of text.
unsafe impl Plain for AbsenceRecord {}
// SAFETY: `repr(C)`, 128 bytes of text, which is checked when it is looked at.
unsafe impl Plain for RouteInfo {}
// SAFETY: `repr(C)`, 64-bit integers only.
unsafe impl Plain for LatencyHistogram {}

const _: () = {
    assert!(size_of::<ProcessHealth>() == 12 * 8);
    assert!(size_of::<ControlRecord>() == (7 + ProbeRefusal::COUNT + 1 + 16) * 8);
    assert!(size_of::<SubscriberRecord>() == (16 + 9 + 1 + 16) * 8);
    assert!(size_of::<IntruderRecord>() == (4 * 16 + 1) * 8);
    assert!(size_of::<AbsenceRecord>() == (3 + 3 * 16) * 8);
    assert!(size_of::<NamedEndpoint>() == (2 + 2 * 16) * 8);
    assert!(size_of::<PublisherAccount>() == 9 * 8);
    assert!(size_of::<LanePolicy>() == 5 * 8);
    assert!(size_of::<RouteInfo>() == 16 * 8);
};

/// A value in its copies: a line for the version, then the copies, each on lines of its own.
#[derive(Debug)]
pub(super) struct Cell<T> {
    at: usize,
    _type: PhantomData<T>,
}

impl<T> Clone for Cell<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Cell<T> {}

impl<T: Plain> Cell<T> {
    /// Words that it takes, copies and version.
    pub(super) const WORDS: usize = LINE + COPIES as usize * Self::COPY_WORDS;
    const COPY_WORDS: usize = T::WORDS.next_multiple_of(LINE);

    /// The value at a word of a segment, a multiple of [`LINE`].
    pub(super) fn at(at: usize) -> Self {
        Self { at, _type: PhantomData }
    }

    fn copy_at(self, version: u64) -> usize {
        self.at + LINE + (version % COPIES) as usize * Self::COPY_WORDS
    }

    /// The value; `None` when its writer changes it faster than it can be read.
    pub(super) fn read(self, segment: &Segment) -> Option<T> {
        for _ in 0..READ_ATTEMPTS {
            let version = segment.word(self.at).load(Ordering::Acquire);
            let value = load(segment, self.copy_at(version));
            // The writer begins to fill this copy again, as version `version + COPIES`, only after it has
            // shown the one before that. If we have read a word of it, this fence makes us see that it was
            // shown.
            fence(Ordering::Acquire);
            let now = segment.word(self.at).load(Ordering::Relaxed);
            if now.wrapping_sub(version) < COPIES - 1 {
                return Some(value);
            }
        }
        None
    }

    /// Shows another value. One writer at a time.
    pub(super) fn write(self, segment: &Segment, value: &T) {
        let version = segment.word(self.at).load(Ordering::Relaxed).wrapping_add(1);
        // Whoever reads a word of what follows also sees that the version was counted up before.
        fence(Ordering::Release);
        let to = self.copy_at(version);
        for word in 0..T::WORDS {
            // SAFETY: `T` has `WORDS` words, all of them initialised, as `Plain` promises.
            let word_value = unsafe { (&raw const *value).cast::<u64>().add(word).read_unaligned() };
            segment.word(to + word).store(word_value, Ordering::Relaxed);
        }
        segment.word(self.at).store(version, Ordering::Release);
    }
}

pub(super) fn load<T: Plain>(segment: &Segment, at: usize) -> T {
    let mut value = MaybeUninit::<T>::uninit();
    for word in 0..T::WORDS {
        let word_value = segment.word(at + word).load(Ordering::Relaxed);
        // SAFETY: `T` has `WORDS` words.
        unsafe { value.as_mut_ptr().cast::<u64>().add(word).write_unaligned(word_value) };
    }
    // SAFETY: all words are written, and every bit pattern is a value, as `Plain` promises.
    unsafe { value.assume_init() }
}
