//! A route's pool: samples are copied into it, or put together in it by the DDS library.
//!
//! The library borrows slots and lets go of them on the thread that receives, which waits for nobody: not for
//! the main thread either, which may be connecting a lane to the pool just then.

use std::any::Any;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};

use crate::dds::{LentMemory, Payload, SampleMemory};
use crate::shm::{LentSlot, LoanError, SamplePublisher, Slot};

/// The pool, as the main thread and the DDS library share it.
pub(super) struct Pool {
    publisher: SamplePublisher,
    /// Held while lanes are connected, which no borrower waits for.
    attending: Mutex<()>,
    abandoned: Sender<LentSlot>,
}

/// A route's end of its pool.
pub(super) struct PoolOwner {
    pool: Arc<Pool>,
    abandoned: Receiver<LentSlot>,
}

impl PoolOwner {
    pub fn new(publisher: SamplePublisher) -> Self {
        let (sender, abandoned) = channel();
        let pool = Arc::new(Pool { publisher, attending: Mutex::new(()), abandoned: sender });
        Self { pool, abandoned }
    }

    /// What the DDS library borrows from.
    pub fn lender(&self) -> Arc<dyn SampleMemory> {
        self.pool.clone()
    }

    /// Connects to lanes that came, and takes back what nobody needs any more; on the main thread.
    pub fn attend(&self) {
        let _attending = self.pool.attending.lock().unwrap_or_else(PoisonError::into_inner);
        while let Ok(slot) = self.abandoned.try_recv() {
            drop(slot);
        }
        self.pool.publisher.attend();
    }

    /// The slot that was lent for the payload, or one that it is copied into.
    pub fn fill(&self, payload: Payload<'_>) -> Filled {
        match payload {
            Payload::Bytes(bytes) => {
                Filled { slot: self.pool.publisher.copy_in(bytes), bytes: bytes.len(), in_place: false }
            }
            Payload::Lent(mut memory) => {
                let bytes = memory.bytes().len();
                let memory: Box<dyn Any> = memory;
                let slot = memory.downcast::<Borrowed>().ok().and_then(|borrowed| borrowed.into_slot());
                // Nobody else lends memory to this reader.
                Filled { slot: slot.ok_or(LoanError::Failed("not of the pool")), bytes, in_place: true }
            }
        }
    }
}

/// A slot with a payload.
pub(super) struct Filled {
    pub slot: Result<Slot, LoanError>,
    pub bytes: usize,
    /// Whether the DDS library has put the payload there, so that it was not copied.
    pub in_place: bool,
}

impl SampleMemory for Pool {
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
        let _not_attending = self.attending.try_lock().ok()?;
        let slot = self.publisher.lend(len)?;
        Some(Box::new(Borrowed { slot: Some(slot), abandoned: self.abandoned.clone() }))
    }
}

/// A slot while the DDS library has it. One that it drops goes to the main thread: giving it back could have
/// to wait.
struct Borrowed {
    /// There until it is taken out.
    slot: Option<LentSlot>,
    abandoned: Sender<LentSlot>,
}

impl Borrowed {
    fn into_slot(mut self) -> Option<Slot> {
        self.slot.take().map(LentSlot::into_slot)
    }
}

impl LentMemory for Borrowed {
    fn bytes(&mut self) -> &mut [u8] {
        self.slot.as_mut().map_or(&mut [], LentSlot::payload_mut)
    }
}

impl Drop for Borrowed {
    fn drop(&mut self) {
        if let Some(slot) = self.slot.take() {
            // Without a route's end nobody waits for anything any more.
            let _ = self.abandoned.send(slot);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{InstanceName, RouteId};
    use crate::shm::{LaneQueue, RouteChannel, ShmNode};

    /// The pool of a route for samples of 100 bytes; it goes with the folder and the node.
    fn owner() -> (PoolOwner, ShmNode, tempfile::TempDir) {
        let root = tempfile::tempdir().unwrap();
        let node = ShmNode::open(root.path(), &InstanceName::try_from("pool").unwrap(), "test").unwrap();
        let lanes = vec![LaneQueue { queue_depth: 4, max_borrowed: 2 }];
        let route = RouteId::try_from("scan").unwrap();
        let channel = RouteChannel { route, max_sample_bytes: 100, lanes, max_taps: 0, retained_samples: 0 };
        (PoolOwner::new(SamplePublisher::create(&node, &channel).unwrap()), node, root)
    }

    #[test]
    fn what_is_lent_comes_back_filled_or_goes_to_the_main_thread() {
        let (owner, _node, _root) = owner();
        let lender = owner.lender();
        assert!(lender.lend(101).is_none(), "longer than the route allows");
        for _ in 0..10 {
            let mut memory = lender.lend(100).unwrap();
            memory.bytes().fill(7);
            let filled = owner.fill(Payload::Lent(memory));
            assert!(filled.slot.is_ok() && filled.in_place && filled.bytes == 100);
        }
        // Two are out, and given up: they are had again when the main thread has looked.
        let given_up = [lender.lend(10).unwrap(), lender.lend(10).unwrap()];
        assert!(lender.lend(10).is_none());
        drop(given_up);
        assert!(lender.lend(10).is_none());
        owner.attend();
        assert!(lender.lend(10).is_some());
        let filled = owner.fill(Payload::Bytes(&[1; 100]));
        assert!(filled.slot.is_ok() && !filled.in_place);
    }

    #[test]
    fn nobody_waits_for_the_main_thread_to_connect_a_lane() {
        let (owner, _node, _root) = owner();
        let attending = owner.pool.attending.lock().unwrap();
        assert!(owner.lender().lend(10).is_none());
        drop(attending);
        assert!(owner.lender().lend(10).is_some());
    }
}
