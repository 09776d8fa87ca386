//! A subscriber of a route's channel: a lane or a tap.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::sample::Sample;

use super::channel::{QueueLimits, RouteChannel, TAP};
use super::error::ShmError;
use super::header::{HeaderError, WireHeader};
use super::node::{NodeShared, ShmNode, StartLock};
use super::roles::RoleLock;
use super::service::Service;
use crate::model::SampleHeader;

/// Why no sample could be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TakeError {
    /// The subscriber has borrowed as many samples as it may. The sample stays in the queue: drop a borrowed
    /// one and take again.
    #[error("the subscriber holds as many samples as it may borrow")]
    BorrowLimit,
    /// The header or the length of a sample is invalid; the sample is dropped.
    #[error("{0}")]
    Malformed(HeaderError),
    /// iceoryx2 failed.
    #[error("cannot take a sample: {0}")]
    Failed(&'static str),
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
    queue_depth: usize,
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
        shared.require_free(0, &what, &start)?;
        let create = || {
            factory
                .subscriber_builder()
                .buffer_size(channel.depth(queue))
                .history_request(if history { channel.retained_samples } else { 0 })
                .create()
        };
        let port = match create() {
            // A dead former process counts until it is cleaned up.
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
            other => ShmError::failed(format!("to create {what}"), shared.folder(), other),
        })?;
        shared.commit(&what)?;
        Ok(Self {
            port,
            queue_depth: channel.depth(queue),
            max_borrowed: queue.max_borrowed.max(1),
            max_sample_bytes: channel.max_sample_bytes,
            borrowed: Arc::new(BorrowCount { count: AtomicUsize::new(0), _node: shared.clone() }),
            _tap: tap,
        })
    }

    /// Takes the oldest waiting sample, if there is one, and validates what another process wrote. Does not
    /// allocate.
    pub fn take(&self) -> Result<Option<ShmSample>, TakeError> {
        if self.borrowed.count.fetch_add(1, Ordering::Acquire) >= self.max_borrowed {
            self.borrowed.count.fetch_sub(1, Ordering::Relaxed);
            return Err(TakeError::BorrowLimit);
        }
        let borrow = Borrow(self.borrowed.clone());
        let slot = match self.port.receive() {
            Ok(Some(slot)) => slot,
            Ok(None) => return Ok(None),
            Err(ReceiveError::ExceedsMaxBorrows) => return Err(TakeError::BorrowLimit),
            Err(ReceiveError::ConnectionFailure(_)) => {
                return Err(TakeError::Failed("the publisher's memory cannot be mapped"));
            }
        };
        let header = slot.user_header().sample;
        // The address and the length are stored, so that a later access takes no lock and reads no length
        // that may have changed.
        let payload: *const [u8] = slot.payload();
        let length = payload.len();
        if length > self.max_sample_bytes {
            return Err(TakeError::Malformed(HeaderError::PayloadTooLong));
        }
        if header.sequence == 0 {
            return Err(TakeError::Malformed(HeaderError::SequenceZero));
        }
        // A reference is never null; for an empty payload it is a dangling address.
        let Some(payload) = NonNull::new(payload.cast_mut().cast()) else {
            return Err(TakeError::Failed("a payload at address 0"));
        };
        let kept = Kept::InSlot { _slot: slot, _borrow: borrow };
        Ok(Some(ShmSample { header, payload, length, _kept: kept }))
    }

    /// The most samples that wait in the queue.
    pub fn queue_depth(&self) -> usize {
        self.queue_depth
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
            Err(error) => return Err(ShmError::failed("to take a tap's lock", shared.folder(), error)),
        }
    }
    Err(ShmError::TooManySubscribers { route: channel.route.clone(), max: channel.max_taps })
}

/// A sample in shared memory, or a copy of one. Dropping it, on any thread, frees its slot.
#[derive(Debug)]
pub struct ShmSample {
    header: SampleHeader,
    payload: NonNull<u8>,
    length: usize,
    _kept: Kept,
}

/// What keeps the payload.
#[derive(Debug)]
enum Kept {
    InSlot {
        // Declared before `_borrow`, so that the slot is returned before the count is decremented.
        _slot: Sample<Service, [u8], WireHeader>,
        _borrow: Borrow,
    },
    Copied {
        _bytes: Box<[u8]>,
    },
}

// SAFETY: a shared reference gives access to the header, which is a copy, and to the bytes of the payload,
// which no process writes while they are borrowed or copied. `_slot`, the field that is not `Sync`, is not
// accessed until it is dropped, and may be dropped on any thread: `Sample` of a thread-safe service is
// `Send`. The bytes are in a mapping that `_slot` keeps or in a copy, not in memory of a thread.
unsafe impl Sync for ShmSample {}
// SAFETY: as above; the pointer is the only field that is not `Send` by itself.
unsafe impl Send for ShmSample {}

impl ShmSample {
    /// A copy of a sample whose slot may be reused.
    pub(super) fn copied(header: SampleHeader, bytes: Box<[u8]>) -> Self {
        let (payload, length) = (NonNull::from(&*bytes).cast(), bytes.len());
        Self { header, payload, length, _kept: Kept::Copied { _bytes: bytes } }
    }

    /// The header, which has been validated.
    pub fn header(&self) -> &SampleHeader {
        &self.header
    }

    /// The payload.
    pub fn payload(&self) -> &[u8] {
        // SAFETY: `length` bytes of the slot, which is mapped as long as `_slot` lives, and which ingress
        // does not write before the slot is returned; or of a copy, which lives as long as the sample.
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
    use super::super::SamplePublisher;
    use super::*;
    use crate::model::{InstanceName, RouteId};

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
            backlog_samples: 0,
        };
        let publisher = SamplePublisher::create(&node, &channel).unwrap();
        let mut subscriber =
            SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(lane), false).unwrap();
        // Processes with different sizes cannot open the same service. A faulty publisher is simulated by a
        // smaller limit at the subscriber.
        subscriber.max_sample_bytes = 50;
        let header = SampleHeader { sequence: 1, ..SampleHeader::default() };
        for length in [51, 50] {
            publisher.copy_in(&vec![7; length]).unwrap().publish(header).unwrap();
        }
        let refused = subscriber.take().unwrap_err();
        assert_eq!(refused, TakeError::Malformed(HeaderError::PayloadTooLong));
        assert_eq!(subscriber.borrowed(), 0);
        assert_eq!(subscriber.take().unwrap().unwrap().payload(), [7; 50]);
    }
}
