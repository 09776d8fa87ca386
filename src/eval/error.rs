//! Why an evaluation did not go on.

use std::fmt;
use std::io;
use std::path::Path;

use super::impairment::ImpairmentError;

/// Why something of an evaluation could not be done.
#[derive(Debug)]
pub enum EvalError {
    /// What failed, for who has to mend it.
    Failed(String),
    /// A signal asked to end.
    Interrupted,
}

impl EvalError {
    /// A failure in a sentence.
    pub fn new(what: impl Into<String>) -> Self {
        Self::Failed(what.into())
    }

    /// A file or folder could not be used.
    pub fn file(path: &Path, error: &io::Error) -> Self {
        Self::Failed(format!("{}: {error}", path.display()))
    }
}

impl fmt::Display for EvalError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed(what) => f.write_str(what),
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
