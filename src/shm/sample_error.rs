//! What can go wrong with one sample.

use std::fmt;

use super::header::HeaderError;

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
