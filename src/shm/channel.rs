//! The channel of a route: one publisher (ingress), the lanes and taps as subscribers, a pool of slots.

use std::sync::OnceLock;
use std::thread;
use std::time::Duration;

use iceoryx2::prelude::AttributeVerifier;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError as CreateError, PublishSubscribeOpenError as OpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::header::publish_subscribe::Header as IceoryxHeader;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use nix::unistd::{SysconfVar, sysconf};

use super::error::ShmError;
use super::header::WireHeader;
use super::node::{NodeShared, StartLock};
use super::service::Service;
use crate::config::{Lane, Settings, Standby};
use crate::model::{RouteId, fnv1a};

/// The most samples that the DDS library assembles in the pool at the same time; others are copied into it
/// when they are complete. A publisher sends all fragments of a sample before those of the next one; the
/// second slot is for another publisher, or for a sample that waits for a retransmitted fragment.
pub(super) const LENT_SLOTS: usize = 2;

/// The most slots that ingress holds before it publishes them: one that it copies into, and those in which
/// the DDS library assembles samples.
pub(super) const LOANED_SLOTS: usize = 1 + LENT_SLOTS;
pub(super) const TAP: QueueLimits = QueueLimits { queue_depth: 4, max_borrowed: 2 };
/// Samples that wait in the queue of ingress itself, which takes each one after it has published it.
const BACKLOG_QUEUE: usize = 4;
/// The most publishers of a route: ingress and its standby.
const PUBLISHERS: usize = 2;
/// Attempts to open a service whose creator has died or whose last user is removing it, and the pause between
/// them.
const OPEN_ATTEMPTS: usize = 20;
const OPEN_PAUSE: Duration = Duration::from_millis(25);

/// Shared memory beside the pools: boards, and iceoryx2's data of services and connections.
pub const OTHER_SHARED_BYTES: u64 = 4 << 20;

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
    /// The queues of the lanes that serve the route. A lane with a standby has two: after a take-over that of
    /// the dead process remains until the next process starts and cleans up.
    pub lanes: Vec<QueueLimits>,
    /// The most taps of the route at the same time.
    pub max_taps: usize,
    /// Samples that are retained for subscribers that join later.
    pub retained_samples: usize,
    /// The most samples that ingress keeps in addition for a lane that restarts; 0 for none.
    pub backlog_samples: usize,
}

/// The size of a page of memory: 4 KiB, or 16 or 64 KiB on some computers with arm64. A file in shared memory
/// consists of pages.
pub(super) fn page_bytes() -> u64 {
    static PAGE_BYTES: OnceLock<u64> = OnceLock::new();
    *PAGE_BYTES.get_or_init(|| match sysconf(SysconfVar::PAGE_SIZE) {
        Ok(Some(bytes)) => bytes.unsigned_abs(),
        _ => 4096,
    })
}

/// The layout of a slot in iceoryx2: its header, the bridge's header, the payload, each aligned, and the slot
/// aligned to the largest of them.
const SLOT_ALIGN: usize = if align_of::<IceoryxHeader>() > align_of::<WireHeader>() {
    align_of::<IceoryxHeader>()
} else {
    align_of::<WireHeader>()
};

/// The bytes that iceoryx2 needs of a pool for its own description, rounded up: it takes some 150.
const SEGMENT_BYTES: u64 = 256;

/// The bytes before the bridge's header of a slot.
pub(super) const ICEORYX_HEADER_BYTES: usize =
    size_of::<IceoryxHeader>().next_multiple_of(align_of::<WireHeader>());

/// The bytes before the payload of a slot.
pub(super) const SLOT_HEADER_BYTES: usize = ICEORYX_HEADER_BYTES + size_of::<WireHeader>();

/// The size of the pool of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolSize {
    /// The number of slots.
    pub slots: usize,
    /// The bytes from one slot to the next.
    pub stride_bytes: u64,
    /// Whether the payloads of the slots are allocated when samples need them, not at the start.
    pub is_sparse: bool,
    /// Bytes of shared memory for the pool when it is created.
    pub first_bytes: u64,
    /// Bytes of shared memory for the pool if each slot has the largest sample.
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
        let queues = |lane: &Lane| {
            let processes = if lane.standby == Standby::Warm { 2 } else { 1 };
            std::iter::repeat_n(QueueLimits::of(lane), processes)
        };
        Self {
            route: configured.id.clone(),
            max_sample_bytes: configured.max_sample_bytes,
            lanes: settings.lanes.iter().filter(serves).flat_map(queues).collect(),
            max_taps: settings.shared_memory.max_taps,
            retained_samples: configured.retained_samples,
            backlog_samples: if settings.is_critical(route) { configured.backlog_samples } else { 0 },
        }
    }

    /// The size of the pool. At the start, ingress allocates the header of each slot. Slots of at most
    /// a page are allocated completely: each needs that page anyway.
    ///
    /// Every used slot is in the queue of a lane or tap, borrowed by one, retained, or loaned to ingress. All
    /// queues get each sample, and a full one loses its oldest: they hold the last samples, as many as the
    /// deepest has room for, and so do the retained samples and the backlog. So the sum of that number, of
    /// what may be borrowed and of what may be loaned is enough, whatever the lanes do.
    pub fn pool_size(&self) -> PoolSize {
        let last = self.queues().map(|queue| self.depth(queue)).max().unwrap_or(self.retained_samples);
        let last = last.max(self.backlog().map_or(0, |queue| queue.max_borrowed));
        let borrowed: usize = self.lanes.iter().map(|lane| lane.max_borrowed.max(1)).sum();
        let slots = last + borrowed + self.max_taps * TAP.max_borrowed + LOANED_SLOTS;
        let stride = (SLOT_HEADER_BYTES + self.max_sample_bytes).next_multiple_of(SLOT_ALIGN) as u64;
        let is_sparse = stride > page_bytes();
        // Each slot begins at the same place of a page, so that its header is on one page.
        let stride_bytes = if is_sparse { stride.next_multiple_of(page_bytes()) } else { stride };
        // In addition, a free list of 4 bytes for each slot.
        let of_slots = |slot_bytes: u64| {
            (slots as u64 * (slot_bytes + 4) + SEGMENT_BYTES).next_multiple_of(page_bytes())
        };
        let bytes = of_slots(stride_bytes);
        let first_bytes = if is_sparse { of_slots(page_bytes()) } else { bytes };
        PoolSize { slots, stride_bytes, is_sparse, first_bytes, bytes }
    }

    /// The depth of a queue, with room for the retained samples that a new subscriber receives first.
    pub(super) fn depth(&self, queue: QueueLimits) -> usize {
        queue.queue_depth.max(self.retained_samples).max(1)
    }

    /// The queues of all lanes, and one of a tap if taps are allowed.
    fn queues(&self) -> impl Iterator<Item = QueueLimits> + '_ {
        self.lanes.iter().copied().chain((self.max_taps > 0).then_some(TAP))
    }

    /// The queue of ingress itself, which takes each sample after it has published it.
    pub(super) fn backlog(&self) -> Option<QueueLimits> {
        (self.backlog_samples > 0).then_some(QueueLimits {
            queue_depth: BACKLOG_QUEUE,
            max_borrowed: self.backlog_samples + BACKLOG_QUEUE,
        })
    }

    /// All parameters as text. iceoryx2 refuses to open the service with another text.
    fn parameters(&self) -> String {
        let lanes = self.lanes.iter().map(|lane| format!(" {}+{}", lane.queue_depth, lane.max_borrowed));
        let (bytes, taps) = (self.max_sample_bytes, self.max_taps);
        let (retained, backlog) = (self.retained_samples, self.backlog_samples);
        let lanes = lanes.collect::<String>();
        format!("bytes={bytes} taps={taps} retained={retained} backlog={backlog}{lanes}")
    }

    /// Opens the route's service; the first process creates it.
    pub(super) fn open(&self, shared: &NodeShared, start: &StartLock) -> Result<Factory, ShmError> {
        let what = format!("to open route {}", self.route);
        let failure = |reason: String| ShmError::failed(&*what, shared.folder(), reason);
        let name = format!("ab1/samples/{}", self.route);
        let name = name.as_str().try_into().map_err(|error| failure(format!("{error}")))?;
        // A hash, because an attribute has at most 255 bytes and the text of many lanes is longer.
        let parameters = format!("{:016x}", fnv1a(self.parameters().as_bytes()));
        let key = "ab1".try_into().map_err(|error| failure(format!("{error:?}")))?;
        let value = parameters.as_str().try_into().map_err(|error| failure(format!("{error:?}")))?;
        let verifier = AttributeVerifier::new().require(&key, &value);
        let verifier = verifier.map_err(|error| failure(format!("{error:?}")))?;
        let backlog = self.backlog();
        let queues = || self.queues().chain(backlog);
        let subscribers = (self.lanes.len() + self.max_taps + usize::from(backlog.is_some())).max(1);
        let mut attempt = 0;
        loop {
            attempt += 1;
            shared.require_free(0, &format!("route {}", self.route), start)?;
            let opened = shared
                .node
                .service_builder(&name)
                .publish_subscribe::<[u8]>()
                .user_header::<WireHeader>()
                .enable_safe_overflow(true)
                .max_publishers(PUBLISHERS)
                .max_subscribers(subscribers)
                .max_nodes(subscribers + PUBLISHERS)
                .history_size(self.retained_samples)
                .subscriber_max_buffer_size(queues().map(|queue| self.depth(queue)).max().unwrap_or(1))
                .subscriber_max_borrowed_samples(
                    queues().map(|queue| queue.max_borrowed).max().unwrap_or(1).max(1),
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
                    ShmError::Permission { what, path: shared.folder().to_owned() }
                }
                OpenOrCreateError::PublishSubscribeOpenError(OpenError::ExceedsMaxNumberOfNodes) => {
                    ShmError::TooManySubscribers { route: self.route.clone(), max: subscribers }
                }
                OpenOrCreateError::PublishSubscribeOpenError(_) if !is_transient(error) => {
                    ShmError::Incompatible {
                        what: format!(
                            "route {} is in use with other sizes or by another version ({error})",
                            self.route
                        ),
                        path: shared.folder().to_owned(),
                    }
                }
                other => failure(other.to_string()),
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

/// The service of a route.
pub(super) type Factory = PortFactory<Service, [u8], WireHeader>;
