//! The error type of the evaluation harness.

use std::fmt;
use std::io;
use std::path::Path;

use super::impairment::ImpairmentError;

/// Why a command of the evaluation harness failed.
#[derive(Debug)]
pub enum EvalError {
    /// A failure, with a message for the user.
    Failed(String),
    /// SIGINT or SIGTERM arrived.
    Interrupted,
}

impl EvalError {
    /// Creates a failure with this message.
    pub fn new(message: impl Into<String>) -> Self {
        Self::Failed(message.into())
    }

    /// Creates a failure of an operation on a file or folder.
    pub fn file(path: &Path, error: &io::Error) -> Self {
        Self::Failed(format!("{}: {error}", path.display()))
    }
}

impl fmt::Display for EvalError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed(message) => f.write_str(message),
            Self::Interrupted => f.write_str("interrupted"),
        }
    }
}

impl std::error::Error for EvalError {}

impl From<ImpairmentError> for EvalError {
    fn from(error: ImpairmentError) -> Self {
        Self::Failed(error.to_string())
    }
}
