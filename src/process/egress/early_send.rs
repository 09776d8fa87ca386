//! Sends a large sample of a critical lane while the rest of it arrives.
//!
//! The DDS library sends what ingress has received from the slot in shared memory, but never the last
//! fragment before the lane has taken the sample from its queue: only then it is accounted for, and the slot
//! cannot be reused. So no reader has a sample that ingress has not published. If another sample comes first,
//! or the sample never becomes complete, the lane withdraws it; one that becomes complete later is sent as a
//! whole. The other samples of the route never wait.

use std::sync::Arc;

use bytes::Bytes;
use tracing::warn;

use crate::dds::RawWriter;
use crate::model::{FixedText, MonotonicNs, PartialSample, SampleHeader};
use crate::policy::begins_early;
use crate::shm::PoolView;

/// The sample of one output that was begun early.
#[derive(Default)]
pub(super) struct EarlySend {
    begun: Option<PartialSample>,
    /// The number of the last sample that was begun: none is begun twice.
    last_begun: u64,
    /// The pool of the route, and the name of its file: a restart of ingress creates another one.
    pool: Option<(FixedText, Arc<PoolView>)>,
    /// The pool that could not be mapped, whose samples are not begun.
    unusable: Option<FixedText>,
}

/// What [`EarlySend::follow`] did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Followed {
    Nothing,
    Began,
    Withdrew,
    /// Withdrew one sample and began another.
    WithdrewAndBegan,
}

impl EarlySend {
    /// Whether a sample that was taken is the one that was begun.
    pub fn is_begun(&self, header: &SampleHeader, len: usize) -> bool {
        self.begun.is_some_and(|begun| {
            begun.writer_guid == header.writer_guid
                && begun.writer_sequence == header.writer_sequence
                && begun.source_timestamp == header.source_timestamp
                && begun.encapsulation == header.encapsulation
                && begun.len == len as u64
        })
    }

    /// Whether the slot of the sample that was begun has held that sample ever since, as the board shows
    /// after the sample was taken. A sample that ingress gave up may arrive again in another slot, and the
    /// lane may have sent bytes of a later one from the former slot.
    pub fn is_of_same_slot(&self, board: Option<PartialSample>) -> bool {
        board.zip(self.begun).is_some_and(|(board, begun)| board.taken_number == begun.number)
    }

    /// Forgets the pool of a former ingress, so that its memory is free.
    pub fn forget_pool(&mut self) {
        (self.pool, self.unusable) = (None, None);
    }

    /// The sample that was begun is written or withdrawn.
    pub fn end(&mut self) -> bool {
        self.begun.take().is_some()
    }

    /// Follows the board of the route, as it was before the lane took all samples that were published.
    /// `present` is the board now, if the output may begin a sample: the sample on it may have been taken
    /// meanwhile, by a lane that is late.
    pub fn follow(
        &mut self,
        partial: &PartialSample,
        writer: &RawWriter,
        present: Option<PartialSample>,
        now: MonotonicNs,
    ) -> Followed {
        let mut withdrew = false;
        if let Some(begun) = &mut self.begun {
            if begun.number == partial.number {
                if partial.available > begun.available {
                    begun.available = partial.available;
                    writer.extend_early(begun.available as usize);
                }
                if partial.ended == 0 {
                    return Followed::Nothing;
                }
            }
            // It never becomes complete; or the next one is on the board, and it was not among those taken
            // before, because it was a repetition or was dropped.
            self.begun = None;
            writer.withdraw_early();
            withdrew = true;
        }
        let began = present.is_some_and(|present| self.begin(&present, writer, now));
        match (withdrew, began) {
            (false, false) => Followed::Nothing,
            (false, true) => Followed::Began,
            (true, false) => Followed::Withdrew,
            (true, true) => Followed::WithdrewAndBegan,
        }
    }

    fn begin(&mut self, partial: &PartialSample, writer: &RawWriter, now: MonotonicNs) -> bool {
        if partial.ended != 0 || partial.number <= self.last_begun.max(partial.taken_number) {
            return false;
        }
        if !begins_early(partial.len, partial.available, now.since(partial.began_at)) {
            return false;
        }
        let payload = self.pool(partial.pool).and_then(|pool| pool.payload(partial.pool_offset, partial.len));
        let Some(payload) = payload else { return false };
        let payload = Bytes::from_owner(payload);
        let available = partial.available.min(partial.len) as usize;
        if !writer.begin_early(payload, partial.encapsulation, partial.source_timestamp, available) {
            return false;
        }
        self.begun = Some(*partial);
        self.last_begun = partial.number;
        true
    }

    fn pool(&mut self, name: FixedText) -> Option<Arc<PoolView>> {
        if self.unusable == Some(name) {
            return None;
        }
        if self.pool.as_ref().is_none_or(|(mapped, _)| *mapped != name) {
            self.pool = None;
            match PoolView::open(name.as_str()) {
                Ok(view) => self.pool = Some((name, view)),
                Err(error) => {
                    self.unusable = Some(name);
                    warn!(%error, "large samples of a route are sent only when they are complete");
                }
            }
        }
        self.pool.as_ref().map(|(_, view)| view.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_completed_only_from_the_slot_that_it_was_begun_in() {
        let partial = PartialSample { number: 3, writer_sequence: 7, len: 9, ..PartialSample::default() };
        let mut early = EarlySend { begun: Some(partial), ..EarlySend::default() };
        let header = SampleHeader { writer_sequence: 7, ..SampleHeader::default() };
        assert!(early.is_begun(&header, 9) && !early.is_begun(&header, 8));
        let taken = |number, taken_number| Some(PartialSample { number, taken_number, ..partial });
        assert!(early.is_of_same_slot(taken(3, 3)) && early.is_of_same_slot(taken(4, 3)));
        assert!(!early.is_of_same_slot(taken(3, 2)), "given up, and received again in another slot");
        assert!(!early.is_of_same_slot(taken(4, 4)), "not known any more");
        assert!(!early.is_of_same_slot(None));
        assert!(early.end() && !early.end());
    }
}
