//! Slots of a route's pool that ingress holds: it writes a payload and then publishes it.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::sample_mut::SampleMut;

use super::header::WireHeader;
use super::node::NodeShared;
use super::sample_error::PublishError;
use super::service::Service;
use crate::model::SampleHeader;

/// Samples that are put together in the pool at the same time; any others are copied into it when they are
/// complete. One publisher's fragments come one sample after the other; two, for one more publisher, or for a
/// sample that waits for a fragment to be sent again.
pub(super) const LENT_SLOTS: usize = 2;

/// A payload in shared memory that is not published yet; dropping it frees the slot.
#[derive(Debug)]
pub struct Slot {
    pub(super) sample: SampleMut<Service, [u8], WireHeader>,
}

impl Slot {
    /// Publishes the payload to all subscribers, and says how many got it. Never waits: in a full queue the
    /// oldest sample gives way.
    pub fn publish(mut self, header: SampleHeader) -> Result<usize, PublishError> {
        *self.sample.user_header_mut() = WireHeader(header);
        self.sample.send().map_err(|_| PublishError::Failed("a connection of iceoryx2 is broken"))
    }
}

/// A slot that is lent to who writes its payload; dropping it frees the slot.
#[derive(Debug)]
pub struct LentSlot {
    payload: NonNull<u8>,
    length: usize,
    slot: Slot,
    // After the slot: who is let in by this finds a slot free.
    _place: LentPlace,
    // The slot may outlive the publisher.
    _node: Arc<NodeShared>,
}

// SAFETY: the pointer is the one field that is not `Send` by itself; the bytes are in a mapping that `slot`
// keeps, not in memory of a thread, and nobody but the owner reaches them.
unsafe impl Send for LentSlot {}

impl LentSlot {
    /// Remembers where the payload is: iceoryx2 takes a lock each time that it is asked.
    pub(super) fn new(
        mut sample: SampleMut<Service, [u8], WireHeader>,
        place: LentPlace,
        node: Arc<NodeShared>,
    ) -> Self {
        let payload = sample.payload_mut();
        let length = payload.len();
        // Of an empty payload it is only an address.
        let payload = NonNull::from(payload).cast();
        Self { payload, length, slot: Slot { sample }, _place: place, _node: node }
    }

    /// The payload, to be written.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `slot` lives, and which nobody else
        // reads or writes before it is published, for which `self` is used up.
        unsafe { std::slice::from_raw_parts_mut(self.payload.as_ptr(), self.length) }
    }

    /// The slot, with its payload.
    pub fn into_slot(self) -> Slot {
        self.slot
    }
}

/// One of the [`LENT_SLOTS`]; given back when dropped.
#[derive(Debug)]
pub(super) struct LentPlace(Arc<AtomicUsize>);

impl LentPlace {
    pub(super) fn take(lent: &Arc<AtomicUsize>) -> Option<Self> {
        if lent.fetch_add(1, Ordering::Acquire) >= LENT_SLOTS {
            lent.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        Some(Self(lent.clone()))
    }
}

impl Drop for LentPlace {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Release);
    }
}
