//! Slots of a route's pool that ingress has loaned: it writes a payload, then publishes the slot.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::sample_mut::SampleMut;

use super::header::WireHeader;
use super::node::NodeShared;
use super::sample_error::PublishError;
use super::service::Service;
use crate::model::SampleHeader;

/// The most samples that the DDS library assembles in the pool at the same time; others are copied into it
/// when they are complete. A publisher sends all fragments of a sample before those of the next one; the
/// second slot is for another publisher, or for a sample that waits for a retransmitted fragment.
pub(super) const LENT_SLOTS: usize = 2;

/// A slot with a complete payload that is not published yet. Dropping it frees the slot.
#[derive(Debug)]
pub struct Slot {
    pub(super) sample: SampleMut<Service, [u8], WireHeader>,
}

impl Slot {
    /// Publishes the payload and returns the number of subscribers that received it. Never waits: a full
    /// queue drops its oldest sample.
    pub fn publish(mut self, header: SampleHeader) -> Result<usize, PublishError> {
        *self.sample.user_header_mut() = WireHeader(header);
        self.sample.send().map_err(|_| PublishError::Failed("a connection of iceoryx2 is broken"))
    }
}

/// A slot that is lent to the DDS library, which writes its payload. Dropping it frees the slot.
#[derive(Debug)]
pub struct LentSlot {
    payload: NonNull<u8>,
    length: usize,
    slot: Slot,
    // Declared after `slot`, so that the slot is free before the permit is returned.
    _permit: LentPermit,
    // Keeps the membership, because the slot may outlive the publisher.
    _node: Arc<NodeShared>,
}

// SAFETY: the pointer is the only field that is not `Send` by itself; the bytes are in a mapping that `slot`
// keeps, not in memory of a thread, and only the owner accesses them.
unsafe impl Send for LentSlot {}

impl LentSlot {
    /// Stores the address of the payload, because iceoryx2 takes a lock for each access to it.
    pub(super) fn new(
        mut sample: SampleMut<Service, [u8], WireHeader>,
        permit: LentPermit,
        node: Arc<NodeShared>,
    ) -> Self {
        let payload = sample.payload_mut();
        let length = payload.len();
        // For an empty payload this is a dangling address.
        let payload = NonNull::from(payload).cast();
        Self { payload, length, slot: Slot { sample }, _permit: permit, _node: node }
    }

    /// The payload, for writing.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `slot` lives, and which no other
        // code accesses before it is published, which consumes `self`.
        unsafe { std::slice::from_raw_parts_mut(self.payload.as_ptr(), self.length) }
    }

    /// Returns the slot, with its payload, for publishing.
    pub fn into_slot(self) -> Slot {
        self.slot
    }
}

/// The permission to lend one of the [`LENT_SLOTS`]; returned when dropped.
#[derive(Debug)]
pub(super) struct LentPermit(Arc<AtomicUsize>);

impl LentPermit {
    pub(super) fn take(lent: &Arc<AtomicUsize>) -> Option<Self> {
        if lent.fetch_add(1, Ordering::Acquire) >= LENT_SLOTS {
            lent.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        Some(Self(lent.clone()))
    }
}

impl Drop for LentPermit {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Release);
    }
}
