//! The publisher of a route's channel, and the slots of its pool that ingress loans: it writes a payload,
//! then publishes the slot.

use std::mem::MaybeUninit;
use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::{LoanError as IceoryxLoanError, update_connections::UpdateConnections};
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy};
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;

use super::budget::{NoMemory, PoolBudget, PoolUse, SlotMemory};
use super::channel::{LENT_SLOTS, LOANED_SLOTS, RouteChannel, SLOT_HEADER_BYTES};
use super::error::ShmError;
use super::header::WireHeader;
use super::node::{NodeShared, ShmNode, StartLock};
use super::segment::{free_bytes, no_room};
use super::service::Service;
use crate::model::{Backlog, FixedText, MonotonicNs, SampleHeader};

/// The free slots that are tried for a payload until one has the memory or gets it. A slot that was refused
/// memory returns to the top of the free ones, so without further tries the next payload gets the same one,
/// also if others have the memory already. Eight take some microseconds.
const TRIED_SLOTS: usize = 8;

/// The memory that a pool gives back in one housekeeping at most. Its route waits meanwhile, some 0.4 ms; and
/// the memory of an image of 6.2 MB is back after 0.4 s.
const GIVE_BACK_BYTES: u64 = 2 << 20;

/// A slot without a payload.
type EmptySlot = SampleMutUninit<Service, [MaybeUninit<u8>], WireHeader>;

/// Why a sample could not be copied into shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LoanError {
    /// The payload is larger than the route allows.
    #[error("the sample has {len} bytes, at most {max} are allowed")]
    TooLarge {
        /// The size of the payload in bytes.
        len: usize,
        /// The largest size that the route allows.
        max: usize,
    },
    /// No slot is free: a process holds more slots than its limit.
    #[error("no free slot in the route's pool")]
    PoolExhausted,
    /// There is no shared memory for a payload of this size.
    #[error("no shared memory for the sample: {0}")]
    NoMemory(NoMemory),
    /// iceoryx2 failed.
    #[error("cannot get a slot: {0}")]
    Failed(&'static str),
}

/// iceoryx2 failed; the sample was delivered to some of the subscribers or to none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not published to all subscribers: a connection of iceoryx2 is broken")]
pub struct PublishError;

/// The publisher of a route's channel, which ingress holds.
#[derive(Debug)]
pub struct SamplePublisher {
    // Declared first, so that the port is dropped before the membership that it needs.
    port: Publisher<Service, [u8], WireHeader>,
    max_sample_bytes: usize,
    slots: SlotMemory,
    /// The slots that ingress holds, and those of them that are lent.
    loaned: Arc<AtomicUsize>,
    lent: Arc<AtomicUsize>,
    node: Arc<NodeShared>,
}

impl SamplePublisher {
    /// Creates a pool with a budget of its own, which allows every slot the largest sample.
    pub fn create(node: &ShmNode, channel: &RouteChannel) -> Result<Self, ShmError> {
        let budget = PoolBudget::of_channels(std::slice::from_ref(channel), u64::MAX);
        Self::create_within(node, channel, &budget, 0)
    }

    /// Creates the pool of a route, whose samples get shared memory within the budget, and connects to the
    /// present subscribers. `route` is the number of the route in the budget.
    pub fn create_within(
        node: &ShmNode,
        channel: &RouteChannel,
        budget: &Arc<PoolBudget>,
        route: usize,
    ) -> Result<Self, ShmError> {
        let shared = node.shared();
        let pool = channel.pool_size();
        let what = format!("the sample pool of route {} ({} slots)", channel.route, pool.slots);
        let start = StartLock::take(shared.dir())?;
        let factory = channel.open(shared, &start)?;
        shared.require_free(pool.first_bytes, &what, &start)?;
        let create = || {
            factory
                .publisher_builder()
                .initial_max_slice_len(pool.stride_bytes as usize - SLOT_HEADER_BYTES)
                .allocation_strategy(AllocationStrategy::Static)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                // `loaned` bounds those that are filled; others are held for a moment, to search for memory.
                .max_loaned_samples(pool.slots)
                // By default iceoryx2 reserves the largest queue for every subscriber.
                .override_sample_preallocation(move |_| pool.slots)
                .create()
        };
        let port = match create() {
            // A dead former process counts until it is cleaned up.
            Err(PublisherCreateError::ExceedsMaxSupportedPublishers) => {
                shared.clean_up(&start);
                create()
            }
            other => other,
        };
        let port = port.map_err(|error| match error {
            PublisherCreateError::UnableToCreateDataSegment => no_room(&what, pool.first_bytes, free_bytes()),
            other => ShmError::failed(format!("to create {what}"), shared.folder(), other),
        })?;
        shared.commit(&what)?;
        let first = address_of_first_slot(&port).ok_or_else(|| {
            ShmError::failed(format!("to use {what}"), shared.folder(), "it has no free slot")
        })?;
        Ok(Self {
            slots: SlotMemory::find(first, pool, budget, route, &what)?,
            port,
            max_sample_bytes: channel.max_sample_bytes,
            loaned: Arc::default(),
            lent: Arc::default(),
            node: shared.clone(),
        })
    }

    /// The largest payload that the route allows, in bytes.
    pub fn max_sample_bytes(&self) -> usize {
        self.max_sample_bytes
    }

    /// Where the slots of the pool are, for a backlog of which no sample is kept yet.
    pub(super) fn empty_backlog(&self) -> Backlog {
        self.slots.empty_backlog()
    }

    /// What the pool takes of the budget.
    pub fn memory(&self) -> PoolUse {
        self.slots.usage()
    }

    /// Copies a payload into a free slot, which is the only copy in ingress. Waits for nothing; the kernel
    /// allocates memory while the slots in use have had no sample of that size.
    pub fn copy_in(&self, payload: &[u8]) -> Result<Slot, LoanError> {
        if payload.len() > self.max_sample_bytes {
            return Err(LoanError::TooLarge { len: payload.len(), max: self.max_sample_bytes });
        }
        self.slots.note_sample(payload.len());
        let (slot, permit) = self.loan(payload.len())?;
        Ok(Slot { sample: slot.write_from_slice(payload), length: payload.len(), _permit: permit })
    }

    /// Takes a free slot with the memory for a payload of that length. Without memory for it, tries a few
    /// others, and returns the first refusal.
    fn loan(&self, len: usize) -> Result<(EmptySlot, Permit), LoanError> {
        let permit = Permit::take(&self.loaned, LOANED_SLOTS)
            .ok_or(LoanError::Failed("ingress holds too many unpublished slots"))?;
        let (mut slot, refusal) = self.loan_one(len)?;
        let Some(refusal) = refusal else { return Ok((slot, permit)) };
        // Held until the end, so that each try gets another slot.
        let mut refused = [const { None }; TRIED_SLOTS - 1];
        for place in &mut refused {
            let Ok((next, refusal)) = self.loan_one(len) else { break };
            *place = Some(std::mem::replace(&mut slot, next));
            if refusal.is_none() {
                return Ok((slot, permit));
            }
        }
        Err(LoanError::NoMemory(refusal))
    }

    /// Takes a free slot, and returns why it has no memory for a payload of that length if it has none.
    fn loan_one(&self, len: usize) -> Result<(EmptySlot, Option<NoMemory>), LoanError> {
        let mut slot = self.port.loan_slice_uninit(len).map_err(|error| match error {
            IceoryxLoanError::OutOfMemory => LoanError::PoolExhausted,
            IceoryxLoanError::ExceedsMaxLoanSize => LoanError::TooLarge { len, max: self.max_sample_bytes },
            IceoryxLoanError::ExceedsMaxLoans => {
                LoanError::Failed("ingress holds too many unpublished slots")
            }
            IceoryxLoanError::InternalFailure => LoanError::Failed("internal failure of iceoryx2"),
        })?;
        let refusal = self.slots.ensure(slot.payload_mut().as_ptr().addr(), len).err();
        Ok((slot, refusal))
    }

    /// Notes that a payload of that length is complete in a slot that was lent.
    pub fn note_sample(&self, len: usize) {
        self.slots.note_sample(len);
    }

    /// Lends a free slot for a payload of `len` bytes that is yet to be written; `None` if no slot or memory
    /// is free, too many are lent, or the route does not allow that length. The slot contains bytes of an
    /// older sample.
    ///
    /// May be called on any thread. It waits for no other process, but iceoryx2 takes a lock, so it waits for
    /// a thread of this process that is in [`connect_subscribers`](Self::connect_subscribers).
    pub fn lend(&self, len: usize) -> Option<LentSlot> {
        if len > self.max_sample_bytes {
            return None;
        }
        let lent = Permit::take(&self.lent, LENT_SLOTS)?;
        let (slot, permit) = self.loan(len).ok()?;
        // SAFETY: any byte is a valid `u8`, and the bytes of the slot, pages of a mapped file, are
        // initialised: by the kernel with zeros, or by an older sample.
        let mut sample = unsafe { slot.assume_init() };
        // The address is stored, because iceoryx2 takes a lock for each access to the payload.
        let payload = sample.payload_mut();
        let length = payload.len();
        // For an empty payload this is a dangling address.
        let payload = NonNull::from(payload).cast::<u8>();
        let place = self.slots.place(payload.as_ptr().addr());
        let slot = Slot { sample, length, _permit: permit };
        Some(LentSlot { payload, length, place, slot, _lent: lent, _node: self.node.clone() })
    }

    /// Gives the memory of free slots that have been idle for long back to the budget, and returns the bytes.
    /// For periodic housekeeping. It takes all free slots for a moment, so no other thread may take one
    /// meanwhile. The slots that a steady flow uses are the first free ones afterwards, as before.
    pub fn give_back_idle(&self, now: MonotonicNs) -> u64 {
        let Some(idle_ticks) = self.slots.find_idle(now) else { return 0 };
        let mut held = Vec::new();
        let mut given_back = 0;
        while given_back < GIVE_BACK_BYTES
            && let Ok(mut slot) = self.port.loan_slice_uninit(1)
        {
            let payload = slot.payload_mut().as_ptr().addr();
            given_back += self.slots.give_back(payload, idle_ticks, GIVE_BACK_BYTES - given_back);
            held.push(slot);
        }
        // The free slots are a stack.
        while held.pop().is_some() {}
        given_back
    }

    /// Connects to new subscribers, delivers the retained samples to them, and reclaims the slots of
    /// subscribers that have left. Publishing does the same; on a route where nothing is published, call this
    /// periodically, for example 10 times a second. Cheap when nothing has changed.
    pub fn connect_subscribers(&self) {
        // iceoryx2 logs a failed connection to a subscriber, and still connects to the others.
        let _ = self.port.update_connections();
    }
}

/// The address of the payload in the slot that a new pool lends first.
fn address_of_first_slot(port: &Publisher<Service, [u8], WireHeader>) -> Option<usize> {
    // With a length, because an empty payload has no address of its own.
    let mut slot = port.loan_slice_uninit(1).ok()?;
    Some(slot.payload_mut().as_ptr().addr())
}

/// A slot with a complete payload that is not published yet. Dropping it frees the slot.
#[derive(Debug)]
pub struct Slot {
    sample: SampleMut<Service, [u8], WireHeader>,
    /// The length of the payload, stored because iceoryx2 takes a lock for each access to it.
    length: usize,
    // Declared after `sample`, so that the slot is free before the permit is returned.
    _permit: Permit,
}

impl Slot {
    /// Publishes the payload and returns the number of subscribers that received it. Never waits: a full
    /// queue drops its oldest sample.
    pub fn publish(mut self, header: SampleHeader) -> Result<usize, PublishError> {
        *self.sample.user_header_mut() = WireHeader { sample: header, payload_bytes: self.length as u64 };
        self.sample.send().map_err(|_| PublishError)
    }
}

/// A slot that is lent to the DDS library, which writes its payload. Dropping it frees the slot.
#[derive(Debug)]
pub struct LentSlot {
    payload: NonNull<u8>,
    length: usize,
    place: (FixedText, u64),
    slot: Slot,
    // Declared after `slot`, so that the slot is free before the permit is returned.
    _lent: Permit,
    // Keeps the membership, because the slot may outlive the publisher.
    _node: Arc<NodeShared>,
}

// SAFETY: the pointer is the only field that is not `Send` by itself; the bytes are in a mapping that `slot`
// keeps, not in memory of a thread, and only the owner accesses them.
unsafe impl Send for LentSlot {}

impl LentSlot {
    /// The payload, for writing.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `slot` lives, and which no other
        // code accesses before it is published, which consumes `self`.
        unsafe { std::slice::from_raw_parts_mut(self.payload.as_ptr(), self.length) }
    }

    /// The length of the payload in bytes.
    #[expect(clippy::len_without_is_empty, reason = "a length that was asked for")]
    pub const fn len(&self) -> usize {
        self.length
    }

    /// The file of the pool in shared memory, and where the payload begins in it.
    pub const fn place(&self) -> (FixedText, u64) {
        self.place
    }

    /// Returns the slot, with its payload, for publishing.
    pub fn into_slot(self) -> Slot {
        self.slot
    }
}

/// The permission to hold one of a limited number of slots; returned when dropped.
#[derive(Debug)]
struct Permit(Arc<AtomicUsize>);

impl Permit {
    fn take(held: &Arc<AtomicUsize>, limit: usize) -> Option<Self> {
        if held.fetch_add(1, Ordering::Acquire) >= limit {
            held.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        Some(Self(held.clone()))
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Release);
    }
}
