//! A value in shared memory with one writer, which any process reads without waiting.
//!
//! A value is kept in several copies. The writer fills the next copy, then publishes it by incrementing the
//! version. If a writer dies during an update, the previous value therefore stays complete. A reader reads
//! the published copy, and reads again if the writer has begun to overwrite that copy during the read: it
//! never waits and never returns a partly written value.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::sync::atomic::{Ordering, fence};

use super::segment::Segment;
use crate::model::{
    AbsenceRecord, Backlog, ControlRecord, DropReason, EndpointIdentity, IngressCounters, IntruderRecord,
    LaneCounters, LanePolicy, LatencyHistogram, MAX_OUTPUT_READERS, MAX_UNMATCHED_READERS, NamedEndpoint,
    NetworkRefusal, OutputReaders, PartialSample, PatternRecord, ProbeRefusal, ProcessHealth,
    ProcessIdentity, PublisherAccount, RouteInfo, StandbyRecord, SubscriberRecord,
};

/// Words of a cache line. Every value begins on a new line, so that two writers never share a line.
pub(super) const LINE: usize = 8;
/// Copies of a value. A read, which takes some 100 ns when the writer is on another CPU, is repeated only if
/// more than `COPIES - 2` updates happened during it.
const COPIES: u64 = 4;
/// The most attempts of one read, so that a writer that updates without pause cannot block a reader.
const READ_ATTEMPTS: usize = 1_000;

/// A type that can be copied to and from shared memory word by word.
///
/// # Safety
/// The type is `repr(C)`, has no padding and a size that is a multiple of 8 bytes, and every bit pattern is a
/// valid value.
pub(super) unsafe trait Plain: Copy + Default {
    /// The size of the type in words.
    const WORDS: usize = {
        assert!(size_of::<Self>().is_multiple_of(8));
        size_of::<Self>() / 8
    };
}

/// Implements [`Plain`] for the types of the boards, with the size in words that the layout relies on.
macro_rules! plain {
    ($($type:ident: $words:expr,)+) => {
        $(
            // SAFETY: `repr(C)`; integers, arrays of them, GUIDs of 16 bytes at a multiple of 8, single bytes
            // in groups of 8, and 128 bytes of text, which its reader validates. The assertion excludes
            // padding at the end.
            unsafe impl Plain for $type {}
            const _: () = assert!(size_of::<$type>() == ($words) * 8);
        )+
    };
}

plain! {
    StandbyRecord: 6 + 1,
    ProcessHealth: 12 + NetworkRefusal::COUNT,
    ControlRecord: 7 + ProbeRefusal::COUNT + 5 + 1 + 16,
    SubscriberRecord: 16 + 9 + 1 + 16,
    IntruderRecord: 4 * 16 + 1,
    AbsenceRecord: 3 + 3 * 16,
    NamedEndpoint: 2 + 2 * 16,
    PublisherAccount: 9,
    LanePolicy: 5,
    RouteInfo: 3 * 16 + 2 * 4 + 6,
    PatternRecord: 4 + 16,
    PartialSample: 11 + 16,
    Backlog: 4 + 16,
    IngressCounters: 4 + DropReason::COUNT + 4 + 9 + 5 + 3 + 2,
    LaneCounters: 6 + DropReason::COUNT + 9,
    OutputReaders: MAX_OUTPUT_READERS * (6 + 2) + MAX_UNMATCHED_READERS * 3 + 2,
    ProcessIdentity: 10,
    EndpointIdentity: 3,
    LatencyHistogram: size_of::<LatencyHistogram>().div_ceil(8),
}

/// The location of a value in a segment: a cache line for the version, then the copies, each on its own
/// lines.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cell<T> {
    pub(super) at: usize,
    _type: PhantomData<T>,
}

impl<T: Plain> Cell<T> {
    /// The size in words, with version and copies.
    pub(super) const WORDS: usize = LINE + COPIES as usize * Self::COPY_WORDS;
    const COPY_WORDS: usize = T::WORDS.next_multiple_of(LINE);

    /// The value at a word offset of a segment, which must be a multiple of [`LINE`].
    pub(super) fn at(at: usize) -> Self {
        Self { at, _type: PhantomData }
    }

    fn copy_at(self, version: u64) -> usize {
        self.at + LINE + (version % COPIES) as usize * Self::COPY_WORDS
    }

    /// Reads the value; `None` when its writer changes it faster than it can be read.
    pub(super) fn read(self, segment: &Segment) -> Option<T> {
        for _ in 0..READ_ATTEMPTS {
            let version = segment.word(self.at).load(Ordering::Acquire);
            let value = load(segment, self.copy_at(version));
            // The writer begins to overwrite this copy, with version `version + COPIES`, only after it has
            // published the version before that. If `load` has read a word of the new version, this fence
            // makes the load below see that earlier version number.
            fence(Ordering::Acquire);
            let now = segment.word(self.at).load(Ordering::Relaxed);
            if now.wrapping_sub(version) < COPIES - 1 {
                return Some(value);
            }
        }
        None
    }

    /// Publishes a new value. One writer at a time.
    pub(super) fn write(self, segment: &Segment, value: &T) {
        let version = segment.word(self.at).load(Ordering::Relaxed).wrapping_add(1);
        // A reader that reads one of the words stored below also sees the version number of the previous
        // update.
        fence(Ordering::Release);
        let to = self.copy_at(version);
        for word in 0..T::WORDS {
            // SAFETY: `T` has `WORDS` words, all of them initialised, as `Plain` requires.
            let word_value = unsafe { (&raw const *value).cast::<u64>().add(word).read_unaligned() };
            segment.word(to + word).store(word_value, Ordering::Relaxed);
        }
        segment.word(self.at).store(version, Ordering::Release);
    }
}

/// Copies a value out of a segment, word by word.
pub(super) fn load<T: Plain>(segment: &Segment, at: usize) -> T {
    let mut value = MaybeUninit::<T>::uninit();
    for word in 0..T::WORDS {
        let word_value = segment.word(at + word).load(Ordering::Relaxed);
        // SAFETY: `value` has room for `WORDS` words.
        unsafe { value.as_mut_ptr().cast::<u64>().add(word).write_unaligned(word_value) };
    }
    // SAFETY: all words are written, and every bit pattern is a valid value, as `Plain` requires.
    unsafe { value.assume_init() }
}
