//! The high-water marks of a route's publishers, readable without the lock of the route.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

use crate::model::{Guid, MAX_PUBLISHERS};

/// The highest sequence number taken of each publisher.
///
/// The thread that holds the route's lock writes; any thread may read meanwhile, without a lock. A read while
/// a publisher replaces another may see a mix of both, so that a lane is woken in vain, or only when the
/// sample is published.
pub(super) struct WriterSequences {
    marks: [Mark; MAX_PUBLISHERS],
}

struct Mark {
    writer: [AtomicU64; 2],
    last: AtomicI64,
}

impl Default for WriterSequences {
    fn default() -> Self {
        let vacant = |_| Mark { writer: Default::default(), last: AtomicI64::new(i64::MAX) };
        Self { marks: std::array::from_fn(vacant) }
    }
}

impl WriterSequences {
    /// Whether `writer` has a mark, and `sequence` is above it.
    pub fn is_new(&self, writer: Guid, sequence: i64) -> bool {
        self.position(writer).is_some_and(|place| sequence > self.marks[place].last.load(Ordering::Relaxed))
    }

    /// The place of the mark of `writer`.
    pub fn position(&self, writer: Guid) -> Option<usize> {
        let halves = halves(writer);
        self.marks.iter().position(|mark| {
            mark.writer.iter().zip(halves).all(|(word, half)| word.load(Ordering::Relaxed) == half)
        })
    }

    /// Sets the mark at a place below [`MAX_PUBLISHERS`].
    pub fn set(&self, place: usize, writer: Guid, last: i64) {
        let mark = &self.marks[place];
        for (word, half) in mark.writer.iter().zip(halves(writer)) {
            word.store(half, Ordering::Relaxed);
        }
        mark.last.store(last, Ordering::Relaxed);
    }
}

fn halves(guid: Guid) -> [u64; 2] {
    let bytes = u128::from_ne_bytes(guid.0);
    [bytes as u64, (bytes >> 64) as u64]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_above_the_mark_of_its_publisher_is_awaited() {
        let writer_sequences = WriterSequences::default();
        assert!(!writer_sequences.is_new(Guid([1; 16]), 1), "a publisher without a mark");
        assert!(!writer_sequences.is_new(Guid([0; 16]), i64::MAX), "a vacant place");
        writer_sequences.set(3, Guid([1; 16]), 10);
        assert!(!writer_sequences.is_new(Guid([1; 16]), 10), "a second copy, from another address");
        assert!(writer_sequences.is_new(Guid([1; 16]), 11) && !writer_sequences.is_new(Guid([3; 16]), 11));
        writer_sequences.set(3, Guid([3; 16]), 10);
        assert!(!writer_sequences.is_new(Guid([1; 16]), 11) && writer_sequences.is_new(Guid([3; 16]), 11));
    }
}
