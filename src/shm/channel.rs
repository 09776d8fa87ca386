//! The samples of one route: one publisher, the lanes, and taps, over a pool of fixed size.

use std::fmt;

use super::error::ShmError;
use super::header::HeaderError;
use super::node::ShmNode;
use crate::config::Settings;
use crate::model::{RouteId, SampleHeader};

/// What one lane may hold of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneQueue {
    /// Samples that wait for the lane.
    pub queue_depth: usize,
    /// Samples that the lane holds while DDS sends them.
    pub max_borrowed: usize,
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
    /// The channel of a configured route.
    pub fn of(settings: &Settings, route: usize) -> Self {
        let _ = (settings, route);
        todo!()
    }

    /// What the pool takes; the same as `ingress` allocates at its start.
    pub fn pool_size(&self) -> PoolSize {
        todo!()
    }
}

/// Why a sample could not be copied into shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LoanError {
    /// The payload is larger than the route allows.
    TooLarge {
        /// Its bytes.
        len: usize,
        /// Bytes allowed.
        max: usize,
    },
    /// No slot is free: someone holds more than its share.
    PoolExhausted,
    /// iceoryx2 failed.
    Failed(&'static str),
}

/// Why a sample could not be published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PublishError {
    /// iceoryx2 failed; the sample reached some subscribers at most.
    Failed(&'static str),
}

/// Why no sample could be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TakeError {
    /// The subscriber holds as many samples as it may. Nothing is lost: drop one and take again.
    BorrowLimit,
    /// The header or the length of a sample makes no sense; the sample is gone.
    Malformed(HeaderError),
    /// iceoryx2 failed.
    Failed(&'static str),
}

impl fmt::Display for LoanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLarge { len, max } => write!(f, "a sample of {len} bytes, at most {max} are allowed"),
            Self::PoolExhausted => f.write_str("no free slot in the route's pool"),
            Self::Failed(reason) => write!(f, "no slot: {reason}"),
        }
    }
}

impl fmt::Display for PublishError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Failed(reason) = self;
        write!(f, "not published to everybody: {reason}")
    }
}

impl fmt::Display for TakeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BorrowLimit => f.write_str("as many samples are held as may be"),
            Self::Malformed(error) => write!(f, "{error}"),
            Self::Failed(reason) => write!(f, "nothing taken: {reason}"),
        }
    }
}

impl std::error::Error for LoanError {}
impl std::error::Error for PublishError {}
impl std::error::Error for TakeError {}

/// The one publisher of a route: ingress.
#[derive(Debug)]
pub struct SamplePublisher {}

impl SamplePublisher {
    /// Allocates the pool, all of it at once, and connects to the subscribers that are there.
    pub fn create(node: &ShmNode, channel: &RouteChannel) -> Result<Self, ShmError> {
        let _ = (node, channel);
        todo!()
    }

    /// Copies a payload into a free slot: the one copy on the way in. No allocation, no waiting.
    pub fn copy_in(&self, payload: &[u8]) -> Result<Slot, LoanError> {
        let _ = payload;
        todo!()
    }

    /// Connects to subscribers that came since, and gives them what is retained. Publishing does so too; where
    /// nothing is published for long, call it now and then (10 times a second, say).
    pub fn attend(&self) {
        todo!()
    }
}

/// A payload in shared memory that is not published yet; dropping it frees the slot.
#[derive(Debug)]
pub struct Slot {}

impl Slot {
    /// Publishes the payload to all subscribers, and says how many got it. Never waits: in a full queue the
    /// oldest sample gives way.
    pub fn publish(self, header: SampleHeader) -> Result<usize, PublishError> {
        let _ = header;
        todo!()
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
pub struct SampleSubscriber {}

impl SampleSubscriber {
    /// Subscribes; with `history`, what is retained comes first. There need not be a publisher yet.
    pub fn open(
        node: &ShmNode,
        channel: &RouteChannel,
        role: SubscriberRole,
        history: bool,
    ) -> Result<Self, ShmError> {
        let _ = (node, channel, role, history);
        todo!()
    }

    /// Takes the oldest sample that waits, if any.
    pub fn take(&self) -> Result<Option<ShmSample>, TakeError> {
        todo!()
    }

    /// Samples taken and not dropped yet.
    pub fn borrowed(&self) -> usize {
        todo!()
    }

    /// Samples that may be borrowed at once.
    pub fn max_borrowed(&self) -> usize {
        todo!()
    }
}

/// A sample in shared memory. Its slot is free again when it is dropped, on whatever thread.
#[derive(Debug)]
pub struct ShmSample {}

impl ShmSample {
    /// The header, checked.
    pub fn header(&self) -> &SampleHeader {
        todo!()
    }

    /// The payload.
    pub fn payload(&self) -> &[u8] {
        todo!()
    }
}

impl AsRef<[u8]> for ShmSample {
    fn as_ref(&self) -> &[u8] {
        self.payload()
    }
}
