//! The pool of a route: ingress copies small samples into it, and the DDS library assembles fragmented
//! samples in it.
//!
//! The library borrows and drops slots on the receiving thread, which never waits, not even for the main
//! thread while that connects a lane to the pool.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::arrival_progress::{ArrivalProgress, SampleProgress};
use super::source::kept_bytes;
use crate::dds::{AssemblyLimits, LentMemory, PartialArrival, Payload, SampleMemory};
use crate::model::MonotonicNs;
use crate::shm::{BacklogKeeper, LentSlot, LoanError, PoolUse, SamplePublisher, Slot};

/// The pool, as the main thread and the DDS library share it.
pub(super) struct Pool {
    publisher: SamplePublisher,
    /// Locked while lanes are connected. A borrower does not wait for it: it gets no slot meanwhile.
    connecting: Mutex<()>,
    abandoned: Sender<LentSlot>,
    progress: Option<Arc<ArrivalProgress>>,
    /// The result of a loan that has ended, which `fill` takes immediately.
    finished: Finished,
}

type Finished = Arc<Mutex<Option<Result<Slot, LoanError>>>>;

/// The most unfinished samples of a route in the DDS library's own memory, which it uses because only two
/// slots are lent at a time: the samples of half a second at 30 Hz while fragments are repaired.
const UNFINISHED_SAMPLES: usize = 16;
/// The most memory of the DDS library for unfinished samples of a reader; two always have room.
const UNFINISHED_BYTES: usize = 128 << 20;
/// The most memory of the DDS library for unfinished samples of all routes: two readers at their bound. A
/// route of full-HD images needs 100 MB to repair half a second at 30 Hz; sixty routes that may have images
/// would be allowed 15 GiB without it.
pub(super) const UNFINISHED_IN_ALL_BYTES: usize = 2 * UNFINISHED_BYTES;

/// The pool, as the input of the route owns it.
pub(super) struct PoolOwner {
    pool: Arc<Pool>,
    /// `None` for a route without one.
    backlog: Option<BacklogKeeper>,
    /// Slots that the DDS library has dropped, for the main thread to free.
    abandoned: Receiver<LentSlot>,
}

impl PoolOwner {
    /// Owns the pool of a route. `progress` tells the lanes of samples that arrive in parts.
    pub fn new(
        publisher: SamplePublisher,
        backlog: Option<BacklogKeeper>,
        progress: Option<ArrivalProgress>,
    ) -> Self {
        let (sender, abandoned) = channel();
        let finished = Arc::new(Mutex::new(None));
        let progress = progress.map(Arc::new);
        let pool =
            Arc::new(Pool { publisher, connecting: Mutex::new(()), abandoned: sender, progress, finished });
        Self { pool, backlog, abandoned }
    }

    /// The pool, for the DDS library to borrow slots from.
    pub fn lender(&self) -> Arc<dyn SampleMemory> {
        self.pool.clone()
    }

    /// Connects new lanes, frees the slots that the DDS library has dropped and those of lanes that have
    /// ended, and gives the memory of idle slots back; on the main thread, while no other one calls `fill`.
    pub fn housekeeping(&self, now: MonotonicNs) {
        #[allow(clippy::disallowed_methods, reason = "housekeeping; receiving threads only try this lock")]
        let _connecting = self.pool.connecting.lock().unwrap_or_else(PoisonError::into_inner);
        while let Ok(slot) = self.abandoned.try_recv() {
            drop(slot);
        }
        self.pool.publisher.connect_subscribers();
        self.pool.publisher.give_back_idle(now);
    }

    /// Keeps the sample that was published last for a lane that restarts. To be called when the lanes are
    /// awake, which need not wait for this.
    pub fn keep_published(&mut self) {
        if let Some(backlog) = &mut self.backlog {
            backlog.keep_published();
        }
    }

    /// What the pool takes of the budget.
    pub fn memory(&self) -> PoolUse {
        self.pool.publisher.memory()
    }

    /// Returns the slot in which the DDS library assembled the payload, or copies the payload into a new one.
    pub fn fill(&mut self, payload: Payload) -> Filled {
        match payload {
            Payload::Bytes(bytes) => {
                let mut slot = self.pool.publisher.copy_in(&bytes);
                // A sample that can be forwarded goes before those that a lane may lack when it restarts.
                if let (Err(LoanError::NoMemory(_)), Some(backlog)) = (&slot, &mut self.backlog)
                    && backlog.free_all()
                {
                    slot = self.pool.publisher.copy_in(&bytes);
                }
                Filled { slot, bytes: bytes.len(), in_place: false }
            }
            Payload::Lent(mut memory) => {
                let assembled = memory.bytes().len();
                // Only this pool lends memory to the reader: it has the slot as soon as the loan ends.
                memory.finish();
                let finished = lock(&self.pool.finished).take();
                let slot = finished.unwrap_or(Err(LoanError::Failed("not of the pool")));
                if slot.is_ok() {
                    self.pool.publisher.note_sample(assembled);
                }
                let bytes = match &slot {
                    Err(LoanError::TooLarge { len, .. }) => *len,
                    _ => assembled,
                };
                Filled { slot, bytes, in_place: true }
            }
        }
    }
}

/// A slot with a payload, or why there is none.
pub(super) struct Filled {
    pub slot: Result<Slot, LoanError>,
    pub bytes: usize,
    /// Whether the DDS library assembled the payload in the slot, so that it was not copied.
    pub in_place: bool,
}

impl SampleMemory for Pool {
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
        let finished = self.finished.clone();
        let max = self.publisher.max_sample_bytes();
        if len > max {
            return Some(Box::new(Refused { error: LoanError::TooLarge { len, max }, finished }));
        }
        let _not_connecting = self.connecting.try_lock().ok()?;
        let slot = self.publisher.lend(len)?;
        let abandoned = self.abandoned.clone();
        let sample_progress = SampleProgress::default();
        let progress = self.progress.clone();
        Some(Box::new(Loan { slot: Some(slot), progress, sample_progress, abandoned, finished }))
    }

    fn limits(&self) -> AssemblyLimits {
        assembly_limits(self.publisher.max_sample_bytes())
    }
}

/// The memory of the DDS library for unfinished samples at a reader of a route.
pub(super) fn assembly_limits(max_sample_bytes: usize) -> AssemblyLimits {
    // With the encapsulation header.
    let max_sample_bytes = max_sample_bytes + 4;
    let max_total_bytes = (UNFINISHED_SAMPLES * max_sample_bytes).min(UNFINISHED_BYTES);
    AssemblyLimits {
        max_sample_bytes,
        // Three, because the library counts some KiB more for each: two always have room.
        max_total_bytes: max_total_bytes.max(3 * max_sample_bytes),
        max_kept_bytes: Some(kept_bytes(max_sample_bytes)),
    }
}

/// A sample that the route does not allow: its bytes are discarded as they arrive. It becomes complete like
/// any other, so that a RELIABLE publisher has its acknowledgement, and is counted as too large.
struct Refused {
    error: LoanError,
    finished: Finished,
}

impl LentMemory for Refused {
    fn bytes(&mut self) -> &mut [u8] {
        &mut []
    }

    fn write(&mut self, _from: usize, _data: &[u8]) {}

    fn finish(self: Box<Self>) {
        *lock(&self.finished) = Some(Err(self.error));
    }
}

/// A slot while the DDS library holds it. If the library drops it, the main thread frees the slot, because
/// that may have to wait for a lock.
struct Loan {
    /// `Some` until `finish` takes it.
    slot: Option<LentSlot>,
    progress: Option<Arc<ArrivalProgress>>,
    sample_progress: SampleProgress,
    abandoned: Sender<LentSlot>,
    finished: Finished,
}

impl LentMemory for Loan {
    fn bytes(&mut self) -> &mut [u8] {
        self.slot.as_mut().map_or(&mut [], LentSlot::payload_mut)
    }

    fn arrived(&mut self, arrival: &PartialArrival) {
        if let (Some(progress), Some(slot)) = (&self.progress, &self.slot) {
            progress.advance(&mut self.sample_progress, slot.place(), slot.len(), arrival);
        }
    }

    fn finish(mut self: Box<Self>) {
        if let Some(slot) = self.slot.take() {
            if let Some(progress) = &self.progress {
                progress.taken(&self.sample_progress);
            }
            *lock(&self.finished) = Some(Ok(slot.into_slot()));
        }
    }
}

impl Drop for Loan {
    fn drop(&mut self) {
        if let Some(slot) = self.slot.take() {
            if let Some(progress) = &self.progress {
                progress.given_up(&self.sample_progress);
            }
            // Fails only after the owner is dropped; then the slot is dropped here.
            let _ = self.abandoned.send(slot);
        }
    }
}

#[allow(
    clippy::disallowed_methods,
    reason = "the thread that takes samples locks it, which is one at a time"
)]
fn lock(finished: &Finished) -> MutexGuard<'_, Option<Result<Slot, LoanError>>> {
    finished.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::model::{InstanceName, MonotonicNs, RouteId};
    use crate::shm::{QueueLimits, RouteChannel, ShmNode};

    /// A pool for samples of 100 bytes, after the folder and the node that it needs, which are dropped later.
    fn owner() -> (tempfile::TempDir, ShmNode, PoolOwner) {
        let root = tempfile::tempdir().unwrap();
        let node = ShmNode::open(root.path(), &InstanceName::try_from("pool").unwrap(), "test").unwrap();
        let lanes = vec![QueueLimits { queue_depth: 4, max_borrowed: 2 }];
        let route = RouteId::try_from("scan").unwrap();
        let channel = RouteChannel {
            route,
            max_sample_bytes: 100,
            lanes,
            max_taps: 0,
            retained_samples: 0,
            backlog_samples: 0,
        };
        let owner = PoolOwner::new(SamplePublisher::create(&node, &channel).unwrap(), None, None);
        (root, node, owner)
    }

    #[test]
    fn a_lent_slot_is_filled_or_freed_by_the_main_thread() {
        let (_root, _node, mut owner) = owner();
        let lender = owner.lender();
        for _ in 0..10 {
            let mut memory = lender.lend(100).unwrap();
            memory.bytes().fill(7);
            let filled = owner.fill(Payload::Lent(memory));
            assert!(filled.slot.is_ok() && filled.in_place && filled.bytes == 100);
        }
        // Two lent slots that are dropped can be lent again only after the main thread has freed them.
        let dropped = [lender.lend(10).unwrap(), lender.lend(10).unwrap()];
        assert!(lender.lend(10).is_none());
        drop(dropped);
        assert!(lender.lend(10).is_none());
        owner.housekeeping(MonotonicNs(0));
        assert!(lender.lend(10).is_some());
        let filled = owner.fill(Payload::Bytes(Bytes::from_static(&[1; 100])));
        assert!(filled.slot.is_ok() && !filled.in_place);
    }

    #[test]
    fn a_sample_that_the_route_does_not_allow_is_discarded_and_its_size_is_known() {
        let (_root, _node, mut owner) = owner();
        for len in [101, 4 << 30] {
            let mut memory = owner.lender().lend(len).unwrap();
            memory.write(len - 3, &[1; 3]);
            let filled = owner.fill(Payload::Lent(memory));
            assert_eq!(filled.slot.unwrap_err(), LoanError::TooLarge { len, max: 100 });
            assert_eq!(filled.bytes, len);
        }
    }

    #[test]
    fn lending_does_not_wait_while_a_lane_is_connected() {
        let (_root, _node, owner) = owner();
        let connecting = owner.pool.connecting.lock().unwrap();
        assert!(owner.lender().lend(10).is_none());
        drop(connecting);
        assert!(owner.lender().lend(10).is_some());
    }
}
