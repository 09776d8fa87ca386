//! The channel of a route: one publisher (ingress), the lanes and taps as subscribers, a pool of fixed size.

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
use super::roles::RoleLock;
use super::sample_error::{LoanError, TakeError};
use super::service::Service;
use super::slot::{LENT_SLOTS, LentPermit, LentSlot, Slot};
use crate::config::{Lane, Settings};
use crate::model::{RouteId, SampleHeader, fnv1a};

/// The most slots that ingress holds before it publishes them: one that it copies into, and those in which
/// the DDS library assembles samples.
const LOANED_SLOTS: usize = 1 + LENT_SLOTS;
/// The queue of a tap.
const TAP: QueueLimits = QueueLimits { queue_depth: 4, max_borrowed: 2 };
/// The most publishers of a route: ingress, and one for a future standby.
const PUBLISHERS: usize = 2;
/// Attempts to open a service whose creator has died or whose last user is removing it, and the pause between
/// them.
const OPEN_ATTEMPTS: usize = 20;
const OPEN_PAUSE: Duration = Duration::from_millis(25);

/// The most samples of a route that a lane may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueLimits {
    /// Samples that wait in the queue of the lane.
    pub queue_depth: usize,
    /// Samples that the lane holds while DDS sends them.
    pub max_borrowed: usize,
}

impl QueueLimits {
    /// The limits of a configured lane.
    pub fn of(lane: &Lane) -> Self {
        Self { queue_depth: lane.queue_depth, max_borrowed: lane.max_borrowed_in_all() }
    }
}

/// The fixed parameters of the channel of a route. They must be the same in all processes of an instance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteChannel {
    /// The route.
    pub route: RouteId,
    /// The largest payload that the route allows.
    pub max_sample_bytes: usize,
    /// The queues of the lanes that serve the route.
    pub lanes: Vec<QueueLimits>,
    /// The most taps of the route at the same time.
    pub max_taps: usize,
    /// Samples that are retained for subscribers that join later.
    pub retained_samples: usize,
}

/// The size of the pool of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolSize {
    /// The number of slots.
    pub slots: usize,
    /// Bytes of one slot, headers included.
    pub slot_bytes: usize,
    /// Bytes of shared memory for the pool.
    pub bytes: u64,
}

impl RouteChannel {
    /// The channel of a configured route, with one queue for each lane that serves it.
    ///
    /// # Panics
    /// If there is no route with that number.
    pub fn of(settings: &Settings, route: usize) -> Self {
        let serves = |lane: &&Lane| lane.outputs.iter().any(|output| output.route == route);
        let configured = &settings.routes[route];
        Self {
            route: configured.id.clone(),
            max_sample_bytes: configured.max_sample_bytes,
            lanes: settings.lanes.iter().filter(serves).map(QueueLimits::of).collect(),
            max_taps: settings.shared_memory.max_taps,
            retained_samples: configured.retained_samples,
        }
    }

    /// The size of the pool. Ingress allocates the whole pool when it starts.
    ///
    /// Every used slot is in the queue of a lane or tap, borrowed by one, retained, or loaned to ingress. So
    /// the sum of these limits is enough, whatever the lanes do.
    pub fn pool_size(&self) -> PoolSize {
        let share = |queue: QueueLimits| self.depth(queue) + queue.max_borrowed.max(1);
        let lanes: usize = self.lanes.iter().map(|&queue| share(queue)).sum();
        let slots = lanes + self.max_taps * share(TAP) + self.retained_samples + LOANED_SLOTS;
        // The layout of iceoryx2: its header, the bridge's header, the payload, each aligned, and the slot
        // aligned to the largest of them.
        let align = align_of::<IceoryxHeader>().max(align_of::<WireHeader>());
        let headers =
            size_of::<IceoryxHeader>().next_multiple_of(align_of::<WireHeader>()) + size_of::<WireHeader>();
        let slot_bytes = (headers + self.max_sample_bytes).next_multiple_of(align);
        // In addition, a free list of 4 bytes for each slot, and the description of the segment.
        let bytes = (slots * (slot_bytes + 4) + 1024).next_multiple_of(4096) as u64;
        PoolSize { slots, slot_bytes, bytes }
    }

    /// The depth of a queue; it must have room for the retained samples, which a new subscriber receives
    /// first.
    fn depth(&self, queue: QueueLimits) -> usize {
        queue.queue_depth.max(self.retained_samples).max(1)
    }

    /// The queues of all lanes, and one of a tap if taps are allowed.
    fn queues(&self) -> impl Iterator<Item = QueueLimits> + '_ {
        self.lanes.iter().copied().chain((self.max_taps > 0).then_some(TAP))
    }

    /// All parameters as text. iceoryx2 refuses to open the service with another text.
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

    /// Opens the route's service; the first process creates it.
    fn open(&self, shared: &NodeShared, start: &StartLock) -> Result<Factory, ShmError> {
        let what = format!("to open route {}", self.route);
        let failure = |error: &dyn fmt::Display| failed(shared.dir(), &what, error);
        let name = format!("ab1/samples/{}", self.route);
        let name = name.as_str().try_into().map_err(|error| failure(&error))?;
        // A hash, because an attribute has at most 255 bytes and the text of many lanes is longer.
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
                .subscriber_max_buffer_size(self.queues().map(|q| self.depth(q)).max().unwrap_or(1))
                .subscriber_max_borrowed_samples(
                    self.queues().map(|queue| queue.max_borrowed).max().unwrap_or(1).max(1),
                )
                .open_or_create_with_attributes(&verifier);
            let error = match opened {
                Ok(factory) => return Ok(factory),
                Err(error) => error,
            };
            if attempt < OPEN_ATTEMPTS && is_transient(error) {
                // Its creator may have died during the creation, or its last user is removing it.
                shared.clean_up(start);
                #[allow(clippy::disallowed_methods, reason = "a process that starts waits for a clean-up")]
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
                        "route {} is in use with other sizes or by another version ({error})",
                        self.route
                    ),
                    path: shared.dir().path.clone(),
                },
                other => failure(&other),
            });
        }
    }
}

/// Whether the same call may succeed a little later.
fn is_transient(error: OpenOrCreateError) -> bool {
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

/// The publisher of a route's channel, which ingress holds.
#[derive(Debug)]
pub struct SamplePublisher {
    // Declared first, so that the port is dropped before the membership that it needs.
    port: Publisher<Service, [u8], WireHeader>,
    max_sample_bytes: usize,
    lent: Arc<AtomicUsize>,
    node: Arc<NodeShared>,
}

impl SamplePublisher {
    /// Allocates the whole pool and connects to the present subscribers.
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
                // By default iceoryx2 reserves the largest queue for every subscriber.
                .override_sample_preallocation(move |_| pool.slots)
                .create()
        };
        let port = match create() {
            // A dead predecessor counts until it is cleaned up.
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

    /// The largest payload that the route allows, in bytes.
    pub fn max_sample_bytes(&self) -> usize {
        self.max_sample_bytes
    }

    /// Copies a payload into a free slot, which is the only copy in ingress. Neither allocates nor waits.
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
                Err(LoanError::Failed("ingress holds too many unpublished slots"))
            }
            Err(IceoryxLoanError::InternalFailure) => Err(LoanError::Failed("internal failure of iceoryx2")),
        }
    }

    /// Lends a free slot for a payload of `len` bytes that is yet to be written; `None` if no slot is free,
    /// too many are lent, or the route does not allow that length. The slot contains bytes of an older
    /// sample.
    ///
    /// May be called on any thread. It waits for no other process, but iceoryx2 takes a lock, so it waits for
    /// a thread of this process that is in [`connect_subscribers`](Self::connect_subscribers).
    pub fn lend(&self, len: usize) -> Option<LentSlot> {
        if len > self.max_sample_bytes {
            return None;
        }
        let permit = LentPermit::take(&self.lent)?;
        let slot = self.port.loan_slice_uninit(len).ok()?;
        // SAFETY: any byte is a valid `u8`, and the bytes of the pool, a mapped file with all its pages, are
        // initialised: by the kernel with zeros, or by an older sample.
        let sample = unsafe { slot.assume_init() };
        Some(LentSlot::new(sample, permit, self.node.clone()))
    }

    /// Connects to new subscribers, delivers the retained samples to them, and reclaims the slots of
    /// subscribers that have left. Publishing does the same; on a route where nothing is published, call this
    /// periodically, for example 10 times a second. Cheap when nothing has changed.
    pub fn connect_subscribers(&self) {
        // iceoryx2 logs a failed connection to a subscriber, and still connects to the others.
        let _ = self.port.update_connections();
    }
}

/// The kind of a subscriber, which determines its queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SubscriberRole {
    /// A lane, with its queue and borrow limit.
    Lane(QueueLimits),
    /// A tap: a queue of 4 samples, at most 2 borrowed.
    Tap,
}

/// A subscriber of a route's channel: a lane or a tap.
#[derive(Debug)]
pub struct SampleSubscriber {
    // Declared first, so that the port is dropped before the membership that it needs, which `borrowed`
    // holds.
    port: Subscriber<Service, [u8], WireHeader>,
    max_borrowed: usize,
    max_sample_bytes: usize,
    borrowed: Arc<BorrowCount>,
    _tap: Option<RoleLock>,
}

/// The number of samples that a subscriber has borrowed, and the membership that they need.
#[derive(Debug)]
struct BorrowCount {
    count: AtomicUsize,
    _node: Arc<NodeShared>,
}

/// One borrowed sample in [`BorrowCount`]; dropping it decrements the count.
#[derive(Debug)]
struct Borrow(Arc<BorrowCount>);

impl Drop for Borrow {
    fn drop(&mut self) {
        self.0.count.fetch_sub(1, Ordering::Release);
    }
}

impl SampleSubscriber {
    /// Subscribes to a route. With `history`, the retained samples are delivered first. The publisher may
    /// come later.
    pub fn open(
        node: &ShmNode,
        channel: &RouteChannel,
        role: SubscriberRole,
        history: bool,
    ) -> Result<Self, ShmError> {
        let shared = node.shared();
        let (queue, tap) = match role {
            SubscriberRole::Lane(queue) => (queue, None),
            SubscriberRole::Tap => (TAP, Some(acquire_tap_lock(shared, channel)?)),
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
            // A dead predecessor counts until it is cleaned up.
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
            borrowed: Arc::new(BorrowCount { count: AtomicUsize::new(0), _node: shared.clone() }),
            _tap: tap,
        })
    }

    /// Takes the oldest waiting sample, if there is one. Does not allocate.
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

    /// The number of samples that were taken and are not dropped yet.
    pub fn borrowed(&self) -> usize {
        self.borrowed.count.load(Ordering::Acquire)
    }

    /// The most samples that may be borrowed at the same time.
    pub fn max_borrowed(&self) -> usize {
        self.max_borrowed
    }
}

/// Takes one of the `max_taps` tap locks of a route, so that taps cannot use up the connections of lanes. A
/// lane needs no such lock, because its role lock admits one process.
fn acquire_tap_lock(shared: &NodeShared, channel: &RouteChannel) -> Result<RoleLock, ShmError> {
    for number in 0..channel.max_taps {
        let name = format!("tap-{}-{number}", channel.route);
        match RoleLock::try_acquire(shared.dir(), &name) {
            Ok(Some(lock)) => return Ok(lock),
            Ok(None) => {}
            Err(error) => return Err(failed(shared.dir(), "to take a tap's lock", &error)),
        }
    }
    Err(ShmError::TooManySubscribers { route: channel.route.clone(), max: channel.max_taps })
}

/// A sample in shared memory. Dropping it, on any thread, frees its slot.
#[derive(Debug)]
pub struct ShmSample {
    header: SampleHeader,
    payload: NonNull<u8>,
    length: usize,
    // Declared before `_borrow`, so that the slot is returned before the count is decremented.
    _slot: Sample<Service, [u8], WireHeader>,
    _borrow: Borrow,
}

// SAFETY: a shared reference gives access to the header, which is a copy, and to the bytes of the payload,
// which no process writes while they are borrowed. `_slot`, the field that is not `Sync`, is not accessed
// until it is dropped, and may be dropped on any thread: `Sample` of a thread-safe service is `Send`. The
// bytes are in a mapping that `_slot` keeps, not in memory of a thread.
unsafe impl Sync for ShmSample {}
// SAFETY: as above; the pointer is the only field that is not `Send` by itself.
unsafe impl Send for ShmSample {}

impl ShmSample {
    /// Validates what another process wrote, and stores the address and length of the payload, so that a
    /// later access takes no lock and reads no length that may have changed.
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
        // A reference is never null; for an empty payload it is a dangling address.
        let Some(payload) = NonNull::new(payload.cast_mut().cast()) else {
            return Err(TakeError::Failed("a payload at address 0"));
        };
        Ok(Self { header, payload, length, _slot: slot, _borrow: borrow })
    }

    /// The header, which has been validated.
    pub fn header(&self) -> &SampleHeader {
        &self.header
    }

    /// The payload.
    pub fn payload(&self) -> &[u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `_slot` lives, and which ingress
        // does not write before the slot is returned.
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
    fn a_payload_longer_than_the_route_allows_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let instance = InstanceName::try_from("unit").unwrap();
        let node = ShmNode::open(root.path(), &instance, "test").unwrap();
        let lane = QueueLimits { queue_depth: 4, max_borrowed: 2 };
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
        // Processes with different sizes cannot open the same service. A faulty publisher is simulated by a
        // smaller limit at the subscriber.
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
