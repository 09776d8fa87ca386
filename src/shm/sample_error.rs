//! Errors when a sample is copied in, published or taken.

use super::header::HeaderError;

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
    /// iceoryx2 failed.
    #[error("cannot get a slot: {0}")]
    Failed(&'static str),
}

/// Why a sample could not be published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// iceoryx2 failed; the sample was delivered to some of the subscribers or to none.
    #[error("not published to all subscribers: {0}")]
    Failed(&'static str),
}

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
