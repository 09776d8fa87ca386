//! The writers of a route, and the last sample that came of each.

use std::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering};

use crate::model::Guid;

/// Writers whose sequence is followed on one route; more than publish one topic on any robot we know. With
/// more, the one followed longest is forgotten, and its gaps are not counted.
const WRITERS_FOLLOWED: usize = 32;

/// The last sequence number of each writer, to know what never reached us.
///
/// Whoever has the route notes; anybody may ask meanwhile, without a lock. One who asks in the instant in
/// which a writer takes the place of another may mistake it for a third: a lane gets up for nothing, or as
/// late as without being told.
pub(super) struct Followed {
    writers: [Writer; WRITERS_FOLLOWED],
    oldest: AtomicUsize,
}

struct Writer {
    guid: [AtomicU64; 2],
    last: AtomicI64,
}

impl Default for Followed {
    fn default() -> Self {
        let vacant = |_| Writer { guid: Default::default(), last: AtomicI64::new(i64::MAX) };
        Self { writers: std::array::from_fn(vacant), oldest: AtomicUsize::new(0) }
    }
}

impl Followed {
    /// Whether `writer` is one whose samples came before, and this one of it has not.
    pub fn awaits(&self, writer: Guid, sequence: i64) -> bool {
        self.find(writer).is_some_and(|writer| sequence > writer.last.load(Ordering::Relaxed))
    }

    /// Samples that `writer` numbered between the last one we got and `sequence`. What came before we began
    /// to follow is not missing.
    pub fn missing_before(&self, writer: Guid, sequence: i64) -> u64 {
        if let Some(writer) = self.find(writer) {
            let last = writer.last.load(Ordering::Relaxed);
            writer.last.store(sequence.max(last), Ordering::Relaxed);
            return sequence.saturating_sub(last).saturating_sub(1).max(0).unsigned_abs();
        }
        let oldest = self.oldest.load(Ordering::Relaxed);
        self.oldest.store((oldest + 1) % WRITERS_FOLLOWED, Ordering::Relaxed);
        let place = &self.writers[oldest];
        for (word, half) in place.guid.iter().zip(halves(writer)) {
            word.store(half, Ordering::Relaxed);
        }
        place.last.store(sequence, Ordering::Relaxed);
        0
    }

    fn find(&self, guid: Guid) -> Option<&Writer> {
        let halves = halves(guid);
        self.writers.iter().find(|writer| {
            writer.guid.iter().zip(halves).all(|(word, half)| word.load(Ordering::Relaxed) == half)
        })
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
    fn gaps_are_counted_for_each_writer_by_itself() {
        let followed = Followed::default();
        assert_eq!(followed.missing_before(Guid([1; 16]), 10), 0);
        assert_eq!(followed.missing_before(Guid([2; 16]), 500), 0);
        assert!(!followed.awaits(Guid([1; 16]), 10), "a second copy, from another address");
        assert!(followed.awaits(Guid([1; 16]), 11) && !followed.awaits(Guid([3; 16]), 11));
        assert_eq!(followed.missing_before(Guid([1; 16]), 11), 0);
        assert_eq!(followed.missing_before(Guid([1; 16]), 15), 3);
        assert_eq!(followed.missing_before(Guid([1; 16]), 12), 0);
        assert_eq!(followed.missing_before(Guid([1; 16]), 16), 0);
        assert_eq!(followed.missing_before(Guid([2; 16]), i64::MAX), (i64::MAX - 501) as u64);
    }

    #[test]
    fn of_many_writers_the_oldest_is_forgotten() {
        let followed = Followed::default();
        for writer in 1..=255 {
            assert_eq!(followed.missing_before(Guid([writer; 16]), 1), 0);
        }
        let of_these = (1..=255).filter(|writer| followed.awaits(Guid([*writer; 16]), 2)).count();
        assert_eq!(of_these, WRITERS_FOLLOWED);
        assert!(followed.awaits(Guid([255; 16]), 2));
    }

    #[test]
    fn nobody_waits_for_a_writer_without_a_name() {
        let followed = Followed::default();
        assert!(!followed.awaits(Guid([0; 16]), i64::MAX));
    }
}
