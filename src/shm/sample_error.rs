//! Errors when a sample is copied in, published or taken.

use std::fmt;

use super::header::HeaderError;

/// Why a sample could not be copied into shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LoanError {
    /// The payload is larger than the route allows.
    TooLarge {
        /// The size of the payload in bytes.
        len: usize,
        /// The largest size that the route allows.
        max: usize,
    },
    /// No slot is free: a process holds more slots than its limit.
    PoolExhausted,
    /// iceoryx2 failed.
    Failed(&'static str),
}

/// Why a sample could not be published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PublishError {
    /// iceoryx2 failed; the sample was delivered to some of the subscribers or to none.
    Failed(&'static str),
}

/// Why no sample could be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TakeError {
    /// The subscriber has borrowed as many samples as it may. The sample stays in the queue: drop a borrowed
    /// one and take again.
    BorrowLimit,
    /// The header or the length of a sample is invalid; the sample is dropped.
    Malformed(HeaderError),
    /// iceoryx2 failed.
    Failed(&'static str),
}

impl fmt::Display for LoanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLarge { len, max } => write!(f, "the sample has {len} bytes, at most {max} are allowed"),
            Self::PoolExhausted => f.write_str("no free slot in the route's pool"),
            Self::Failed(reason) => write!(f, "cannot get a slot: {reason}"),
        }
    }
}

impl fmt::Display for PublishError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Failed(reason) = self;
        write!(f, "not published to all subscribers: {reason}")
    }
}

impl fmt::Display for TakeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BorrowLimit => f.write_str("the subscriber holds as many samples as it may borrow"),
            Self::Malformed(error) => write!(f, "{error}"),
            Self::Failed(reason) => write!(f, "cannot take a sample: {reason}"),
        }
    }
}

impl std::error::Error for LoanError {}
impl std::error::Error for PublishError {}
impl std::error::Error for TakeError {}
