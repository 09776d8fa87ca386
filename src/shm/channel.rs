//! The samples of one route: one publisher, the lanes, and taps, over a pool of fixed size.

use std::fmt;
use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::port::{LoanError as IceoryxLoanError, ReceiveError, update_connections::UpdateConnections};
use iceoryx2::prelude::{AllocationStrategy, AttributeVerifier, BackpressureStrategy};
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::header::publish_subscribe::Header as IceoryxHeader;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::error::ShmError;
use super::header::{self, HeaderError, WireHeader};
use super::node::{NodeShared, ShmNode, StartLock, failed};
use super::root::RoleLock;
use super::sample_error::{LoanError, TakeError};
use super::service::Service;
use super::slot::{LENT_SLOTS, LentPlace, LentSlot, Slot};
use crate::config::{Lane, Settings};
use crate::model::{RouteId, SampleHeader, fnv1a};

/// Slots that ingress may hold at once before they are published: the one that it copies into, and those that
/// it has the DDS library put samples together in.
const LOANED_SLOTS: usize = 1 + LENT_SLOTS;
/// The share of one tap.
const TAP: LaneQueue = LaneQueue { queue_depth: 4, max_borrowed: 2 };
/// Ingress, and the standby that may come beside it one day.
const PUBLISHERS: usize = 2;
/// Attempts to open a service whose creator died, or that its last user removes just now, and the pause.
const OPEN_ATTEMPTS: usize = 20;
const OPEN_PAUSE: Duration = Duration::from_millis(25);

/// What one lane may hold of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneQueue {
    /// Samples that wait for the lane.
    pub queue_depth: usize,
    /// Samples that the lane holds while DDS sends them.
    pub max_borrowed: usize,
}

impl LaneQueue {
    /// The share of a configured lane.
    pub fn of(lane: &Lane) -> Self {
        Self { queue_depth: lane.queue_depth, max_borrowed: lane.max_borrowed_in_all() }
    }
}

/// The fixed parameters of the samples of one route. All processes of an instance must agree on them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteChannel {
    /// The route.
    pub route: RouteId,
    /// The largest payload.
    pub max_sample_bytes: usize,
    /// Each lane that serves the route.
    pub lanes: Vec<LaneQueue>,
    /// Local programs that may tap the route at once.
    pub max_taps: usize,
    /// Samples kept for subscribers that come later.
    pub retained_samples: usize,
}

/// What the pool of a route takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolSize {
    /// Slots.
    pub slots: usize,
    /// Bytes of one slot, headers included.
    pub slot_bytes: usize,
    /// Bytes of shared memory for the pool.
    pub bytes: u64,
}

impl RouteChannel {
    /// The channel of a configured route; one queue for each lane that serves it.
    ///
    /// # Panics
    /// When there is no route of that number.
    pub fn of(settings: &Settings, route: usize) -> Self {
        let serves = |lane: &&Lane| lane.outputs.iter().any(|output| output.route == route);
        let configured = &settings.routes[route];
        Self {
            route: configured.id.clone(),
            max_sample_bytes: configured.max_sample_bytes,
            lanes: settings.lanes.iter().filter(serves).map(LaneQueue::of).collect(),
            max_taps: settings.shared_memory.max_taps,
            retained_samples: configured.retained_samples,
        }
    }

    /// What the pool takes; ingress allocates it at its start, all of it.
    ///
    /// Every slot is in the queue of a lane or tap, borrowed by one, retained, or loaned to ingress; so as
    /// many as all of those together suffice, whatever the lanes do.
    pub fn pool_size(&self) -> PoolSize {
        let share = |queue: LaneQueue| self.depth(queue) + queue.max_borrowed.max(1);
        let lanes: usize = self.lanes.iter().map(|&queue| share(queue)).sum();
        let slots = lanes + self.max_taps * share(TAP) + self.retained_samples + LOANED_SLOTS;
        // As iceoryx2 lays it out: its header, ours, the payload, each aligned, all aligned to the largest.
        let align = align_of::<IceoryxHeader>().max(align_of::<WireHeader>());
        let headers =
            size_of::<IceoryxHeader>().next_multiple_of(align_of::<WireHeader>()) + size_of::<WireHeader>();
        let slot_bytes = (headers + self.max_sample_bytes).next_multiple_of(align);
        // Beside the slots there is a free list of 4 bytes for each, and what describes the segment.
        let bytes = (slots * (slot_bytes + 4) + 1024).next_multiple_of(4096) as u64;
        PoolSize { slots, slot_bytes, bytes }
    }

    /// A queue that is given what is retained must have room for it.
    fn depth(&self, queue: LaneQueue) -> usize {
        queue.queue_depth.max(self.retained_samples).max(1)
    }

    fn everybody(&self) -> impl Iterator<Item = LaneQueue> + '_ {
        self.lanes.iter().copied().chain((self.max_taps > 0).then_some(TAP))
    }

    /// All parameters as text: iceoryx2 lets only processes meet that agree on it.
    fn parameters(&self) -> String {
        let mut text = format!(
            "bytes={} taps={} retained={}",
            self.max_sample_bytes, self.max_taps, self.retained_samples
        );
        for lane in &self.lanes {
            text.push_str(&format!(" {}+{}", lane.queue_depth, lane.max_borrowed));
        }
        text
    }

    /// Opens the route's service, or creates it: whoever comes first.
    fn open(&self, shared: &NodeShared, start: &StartLock) -> Result<Factory, ShmError> {
        let what = format!("to open route {}", self.route);
        let say = |error: &dyn fmt::Display| failed(shared.dir(), &what, error);
        let name = format!("ab1/samples/{}", self.route);
        let name = name.as_str().try_into().map_err(|error| say(&error))?;
        // An attribute has at most 255 bytes, which many lanes exceed.
        let parameters = format!("{:016x}", fnv1a(self.parameters().as_bytes()));
        let key = "ab1".try_into().map_err(|error| failed(shared.dir(), &what, &format!("{error:?}")))?;
        let value = parameters.as_str().try_into();
        let value = value.map_err(|error| failed(shared.dir(), &what, &format!("{error:?}")))?;
        let verifier = AttributeVerifier::new()
            .require(&key, &value)
            .map_err(|error| failed(shared.dir(), &what, &format!("{error:?}")))?;
        let subscribers = (self.lanes.len() + self.max_taps).max(1);
        let mut attempt = 0;
        loop {
            attempt += 1;
            shared.require_free(0, &format!("route {}", self.route))?;
            let opened = shared
                .node()
                .service_builder(&name)
                .publish_subscribe::<[u8]>()
                .user_header::<WireHeader>()
                .enable_safe_overflow(true)
                .max_publishers(PUBLISHERS)
                .max_subscribers(subscribers)
                .max_nodes(subscribers + PUBLISHERS)
                .history_size(self.retained_samples)
                .subscriber_max_buffer_size(self.everybody().map(|q| self.depth(q)).max().unwrap_or(1))
                .subscriber_max_borrowed_samples(
                    self.everybody().map(|queue| queue.max_borrowed).max().unwrap_or(1).max(1),
                )
                .open_or_create_with_attributes(&verifier);
            let error = match opened {
                Ok(factory) => return Ok(factory),
                Err(error) => error,
            };
            if attempt < OPEN_ATTEMPTS && is_passing(error) {
                // Its creator may have died within, or the last user removes it at this moment.
                shared.clean_up(start);
                thread::sleep(OPEN_PAUSE);
                continue;
            }
            return Err(match error {
                OpenOrCreateError::PublishSubscribeOpenError(OpenError::InsufficientPermissions)
                | OpenOrCreateError::PublishSubscribeCreateError(CreateError::InsufficientPermissions) => {
                    ShmError::Permission { what, path: shared.dir().path.clone() }
                }
                OpenOrCreateError::PublishSubscribeOpenError(OpenError::ExceedsMaxNumberOfNodes) => {
                    ShmError::TooManySubscribers { route: self.route.clone(), max: subscribers }
                }
                OpenOrCreateError::PublishSubscribeOpenError(
                    OpenError::IncompatibleAttributes
                    | OpenError::IncompatibleTypes
                    | OpenError::IncompatibleMessagingPattern
                    | OpenError::IncompatibleOverflowBehavior
                    | OpenError::VersionMismatch
                    | OpenError::DoesNotSupportRequestedAmountOfNodes
                    | OpenError::DoesNotSupportRequestedAmountOfPublishers
                    | OpenError::DoesNotSupportRequestedAmountOfSubscribers
                    | OpenError::DoesNotSupportRequestedMinBufferSize
                    | OpenError::DoesNotSupportRequestedMinHistorySize
                    | OpenError::DoesNotSupportRequestedMinSubscriberBorrowedSamples,
                ) => ShmError::Incompatible {
                    what: format!(
                        "route {} is in use with other sizes, or by another version ({error})",
                        self.route
                    ),
                    path: shared.dir().path.clone(),
                },
                other => say(&other),
            });
        }
    }
}

/// Whether the same call may succeed a little later.
fn is_passing(error: OpenOrCreateError) -> bool {
    match error {
        OpenOrCreateError::SystemInFlux => true,
        OpenOrCreateError::PublishSubscribeOpenError(error) => matches!(
            error,
            OpenError::DoesNotExist
                | OpenError::HangsInCreation
                | OpenError::IsMarkedForDestruction
                | OpenError::ServiceInCorruptedState
                | OpenError::ExceedsMaxNumberOfNodes
                | OpenError::Interrupt
                | OpenError::InternalFailure
                | OpenError::UnableToCreateServiceTag
        ),
        OpenOrCreateError::PublishSubscribeCreateError(error) => matches!(
            error,
            CreateError::AlreadyExists
                | CreateError::HangsInCreation
                | CreateError::IsBeingCreatedByAnotherInstance
                | CreateError::ServiceInCorruptedState
                | CreateError::Interrupt
                | CreateError::InternalFailure
                | CreateError::UnableToCreateServiceTag
        ),
    }
}

type Factory = PortFactory<Service, [u8], WireHeader>;

/// The one publisher of a route: ingress.
#[derive(Debug)]
pub struct SamplePublisher {
    // The port goes before the membership that it lives in.
    port: Publisher<Service, [u8], WireHeader>,
    max_sample_bytes: usize,
    lent: Arc<AtomicUsize>,
    node: Arc<NodeShared>,
}

impl SamplePublisher {
    /// Allocates the pool, all of it at once, and connects to the subscribers that are there.
    pub fn create(node: &ShmNode, channel: &RouteChannel) -> Result<Self, ShmError> {
        let shared = node.shared();
        let pool = channel.pool_size();
        let what = format!("the sample pool of route {} ({} slots)", channel.route, pool.slots);
        let start = StartLock::take(shared.dir())?;
        let factory = channel.open(shared, &start)?;
        shared.require_free(pool.bytes, &what)?;
        let create = || {
            factory
                .publisher_builder()
                .initial_max_slice_len(channel.max_sample_bytes)
                .allocation_strategy(AllocationStrategy::Static)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .max_loaned_samples(LOANED_SLOTS)
                // iceoryx2 would reserve the largest queue for every subscriber.
                .override_sample_preallocation(move |_| pool.slots)
                .create()
        };
        let port = match create() {
            // A dead predecessor takes the place until it is cleaned up.
            Err(PublisherCreateError::ExceedsMaxSupportedPublishers) => {
                shared.clean_up(&start);
                create()
            }
            other => other,
        };
        let port = port.map_err(|error| match error {
            PublisherCreateError::UnableToCreateDataSegment => ShmError::NoRoom {
                what: what.clone(),
                needed_bytes: pool.bytes,
                free_bytes: super::segment::free_bytes(),
                path: super::root::SHM_DIR.into(),
            },
            other => failed(shared.dir(), &format!("to create {what}"), &other),
        })?;
        shared.commit(&what)?;
        Ok(Self {
            port,
            max_sample_bytes: channel.max_sample_bytes,
            lent: Arc::default(),
            node: shared.clone(),
        })
    }

    /// Copies a payload into a free slot: the one copy on the way in. No allocation, no waiting.
    pub fn copy_in(&self, payload: &[u8]) -> Result<Slot, LoanError> {
        let too_large = LoanError::TooLarge { len: payload.len(), max: self.max_sample_bytes };
        if payload.len() > self.max_sample_bytes {
            return Err(too_large);
        }
        match self.port.loan_slice_uninit(payload.len()) {
            Ok(slot) => Ok(Slot { sample: slot.write_from_slice(payload) }),
            Err(IceoryxLoanError::OutOfMemory) => Err(LoanError::PoolExhausted),
            Err(IceoryxLoanError::ExceedsMaxLoanSize) => Err(too_large),
            Err(IceoryxLoanError::ExceedsMaxLoans) => {
                Err(LoanError::Failed("too many slots held unpublished"))
            }
            Err(IceoryxLoanError::InternalFailure) => Err(LoanError::Failed("iceoryx2: internal failure")),
        }
    }

    /// A free slot for a payload of `len` bytes that is yet to be written, if so many may be had. On any
    /// thread: waits for no process, but for a thread of this one that is in [`attend`](Self::attend), for
    /// iceoryx2 takes a lock. What is in it is what an older sample left.
    pub fn lend(&self, len: usize) -> Option<LentSlot> {
        if len > self.max_sample_bytes {
            return None;
        }
        let place = LentPlace::take(&self.lent)?;
        let slot = self.port.loan_slice_uninit(len).ok()?;
        // SAFETY: any byte is a valid `u8`, and those of the pool, a mapped file whose pages are all there,
        // are initialised: by the kernel with zeros, or by an older sample.
        let sample = unsafe { slot.assume_init() };
        Some(LentSlot::new(sample, place, self.node.clone()))
    }

    /// Connects to subscribers that came since, gives them what is retained, and takes back the slots of
    /// those that are gone. Publishing does so too; where nothing is published for long, call it now and then
    /// (10 times a second, say). Cheap when nothing has changed.
    pub fn attend(&self) {
        // A subscriber that cannot be reached is logged by iceoryx2; the others are connected all the same.
        let _ = self.port.update_connections();
    }
}

/// As what a subscriber comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SubscriberRole {
    /// A lane, with its share of the pool.
    Lane(LaneQueue),
    /// A tap: a queue of 4, 2 borrowed.
    Tap,
}

/// One subscriber of a route: a lane or a tap.
#[derive(Debug)]
pub struct SampleSubscriber {
    // The port goes before the membership that it lives in, which `borrowed` holds.
    port: Subscriber<Service, [u8], WireHeader>,
    max_borrowed: usize,
    max_sample_bytes: usize,
    borrowed: Arc<Borrowed>,
    _tap: Option<RoleLock>,
}

/// How many samples of a subscriber are out, and the membership that they need.
#[derive(Debug)]
struct Borrowed {
    count: AtomicUsize,
    _node: Arc<NodeShared>,
}

/// One of a subscriber's borrows; given back when dropped.
#[derive(Debug)]
struct Borrow(Arc<Borrowed>);

impl Drop for Borrow {
    fn drop(&mut self) {
        self.0.count.fetch_sub(1, Ordering::Release);
    }
}

impl SampleSubscriber {
    /// Subscribes; with `history`, what is retained comes first. There need not be a publisher yet.
    pub fn open(
        node: &ShmNode,
        channel: &RouteChannel,
        role: SubscriberRole,
        history: bool,
    ) -> Result<Self, ShmError> {
        let shared = node.shared();
        let (queue, tap) = match role {
            SubscriberRole::Lane(queue) => (queue, None),
            SubscriberRole::Tap => (TAP, Some(take_tap_place(shared, channel)?)),
        };
        let start = StartLock::take(shared.dir())?;
        let factory = channel.open(shared, &start)?;
        let what = format!("a queue of route {}", channel.route);
        shared.require_free(0, &what)?;
        let create = || {
            factory
                .subscriber_builder()
                .buffer_size(channel.depth(queue))
                .history_request(if history { channel.retained_samples } else { 0 })
                .create()
        };
        let port = match create() {
            // A dead predecessor takes the place until it is cleaned up.
            Err(SubscriberCreateError::ExceedsMaxSupportedSubscribers) => {
                shared.clean_up(&start);
                create()
            }
            other => other,
        };
        let port = port.map_err(|error| match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => ShmError::TooManySubscribers {
                route: channel.route.clone(),
                max: channel.lanes.len() + channel.max_taps,
            },
            other => failed(shared.dir(), &format!("to create {what}"), &other),
        })?;
        shared.commit(&what)?;
        Ok(Self {
            port,
            max_borrowed: queue.max_borrowed.max(1),
            max_sample_bytes: channel.max_sample_bytes,
            borrowed: Arc::new(Borrowed { count: AtomicUsize::new(0), _node: shared.clone() }),
            _tap: tap,
        })
    }

    /// Takes the oldest sample that waits, if any. No allocation.
    pub fn take(&self) -> Result<Option<ShmSample>, TakeError> {
        if self.borrowed.count.fetch_add(1, Ordering::Acquire) >= self.max_borrowed {
            self.borrowed.count.fetch_sub(1, Ordering::Relaxed);
            return Err(TakeError::BorrowLimit);
        }
        let borrow = Borrow(self.borrowed.clone());
        match self.port.receive() {
            Ok(Some(sample)) => ShmSample::new(sample, self.max_sample_bytes, borrow).map(Some),
            Ok(None) => Ok(None),
            Err(ReceiveError::ExceedsMaxBorrows) => Err(TakeError::BorrowLimit),
            Err(ReceiveError::ConnectionFailure(_)) => {
                Err(TakeError::Failed("the publisher's memory cannot be mapped"))
            }
        }
    }

    /// Samples taken and not dropped yet.
    pub fn borrowed(&self) -> usize {
        self.borrowed.count.load(Ordering::Acquire)
    }

    /// Samples that may be borrowed at once.
    pub fn max_borrowed(&self) -> usize {
        self.max_borrowed
    }
}

/// Lanes have their places by their role; taps have to share a fixed number, so that none takes a lane's
/// place.
fn take_tap_place(shared: &NodeShared, channel: &RouteChannel) -> Result<RoleLock, ShmError> {
    for place in 0..channel.max_taps {
        let name = format!("tap-{}-{place}", channel.route);
        match RoleLock::try_acquire(shared.dir(), &name) {
            Ok(Some(lock)) => return Ok(lock),
            Ok(None) => {}
            Err(error) => return Err(failed(shared.dir(), "to take a tap's place", &error)),
        }
    }
    Err(ShmError::TooManySubscribers { route: channel.route.clone(), max: channel.max_taps })
}

/// A sample in shared memory. Its slot is free again when it is dropped, on whatever thread.
#[derive(Debug)]
pub struct ShmSample {
    header: SampleHeader,
    payload: NonNull<u8>,
    length: usize,
    // The slot is given back before it is no longer counted.
    _slot: Sample<Service, [u8], WireHeader>,
    _borrow: Borrow,
}

// SAFETY: a shared reference gives access to the header, which is a copy, and to the bytes of the payload,
// which nobody writes while they are borrowed. `_slot`, which is what is not `Sync`, is reached by nobody
// until it is dropped, and may be dropped on any thread: `Sample` of a thread-safe service is `Send`. The
// bytes are in a mapping that `_slot` keeps, not in memory of a thread.
unsafe impl Sync for ShmSample {}
// SAFETY: as above; the pointer is the one field that is not `Send` by itself.
unsafe impl Send for ShmSample {}

impl ShmSample {
    /// Checks what another process wrote, and remembers where the payload is, so that looking at it later
    /// takes no lock and reads no length that might have changed.
    fn new(
        slot: Sample<Service, [u8], WireHeader>,
        max_bytes: usize,
        borrow: Borrow,
    ) -> Result<Self, TakeError> {
        let header = slot.user_header().0;
        let payload: *const [u8] = slot.payload();
        let length = payload.len();
        if length > max_bytes {
            return Err(TakeError::Malformed(HeaderError::PayloadTooLong));
        }
        header::check(&header).map_err(TakeError::Malformed)?;
        // A reference is never null; of an empty payload it is only an address.
        let Some(payload) = NonNull::new(payload.cast_mut().cast()) else {
            return Err(TakeError::Failed("a payload at address 0"));
        };
        Ok(Self { header, payload, length, _slot: slot, _borrow: borrow })
    }

    /// The header, checked.
    pub fn header(&self) -> &SampleHeader {
        &self.header
    }

    /// The payload.
    pub fn payload(&self) -> &[u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `_slot` lives, and which ingress
        // does not write before it is given back.
        unsafe { std::slice::from_raw_parts(self.payload.as_ptr(), self.length) }
    }
}

impl AsRef<[u8]> for ShmSample {
    fn as_ref(&self) -> &[u8] {
        self.payload()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::InstanceName;

    #[test]
    fn a_payload_longer_than_its_route_allows_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let instance = InstanceName::try_from("unit").unwrap();
        let node = ShmNode::open(root.path(), &instance, "test").unwrap();
        let lane = LaneQueue { queue_depth: 4, max_borrowed: 2 };
        let route = RouteId::try_from("scan").unwrap();
        let channel = RouteChannel {
            route,
            max_sample_bytes: 100,
            lanes: vec![lane],
            max_taps: 0,
            retained_samples: 0,
        };
        let publisher = SamplePublisher::create(&node, &channel).unwrap();
        let mut subscriber =
            SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(lane), false).unwrap();
        // Processes that say different sizes do not meet; one that lies does.
        subscriber.max_sample_bytes = 50;
        let mut header = WireHeader::default().0;
        header.sequence = 1;
        for length in [51, 50] {
            publisher.copy_in(&vec![7; length]).unwrap().publish(header).unwrap();
        }
        let refused = subscriber.take().unwrap_err();
        assert_eq!(refused, TakeError::Malformed(HeaderError::PayloadTooLong));
        assert_eq!(subscriber.borrowed(), 0);
        assert_eq!(subscriber.take().unwrap().unwrap().payload(), [7; 50]);
    }
}
