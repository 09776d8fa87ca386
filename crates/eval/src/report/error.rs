//! The error type of the report.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// Why a report cannot be written, or why a run is not in it.
#[derive(Debug)]
pub enum ReportError {
    /// A file or folder could not be read or written.
    File {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The content of a file does not follow docs/eval-results.md.
    Content {
        /// The file.
        path: PathBuf,
        /// The line, counted from 1; 0 for the whole file.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
    /// A folder has no results.
    NoRuns {
        /// The folder.
        folder: PathBuf,
    },
}

impl ReportError {
    pub(super) fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |source| Self::File { path, source }
    }

    pub(super) fn content(path: &Path, line: usize, problem: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), line, problem: problem.into() }
    }
}

impl fmt::Display for ReportError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, source } => write!(f, "{}: {source}", path.display()),
            Self::Content { path, line: 0, problem } => write!(f, "{}: {problem}", path.display()),
            Self::Content { path, line, problem } => write!(f, "{}:{line}: {problem}", path.display()),
            Self::NoRuns { folder } => write!(
                f,
                "{} has no finished run; first record some with `adaptive-bridge-eval run` or `matrix`",
                folder.display()
            ),
        }
    }
}

impl std::error::Error for ReportError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::File { source, .. } => Some(source),
            _ => None,
        }
    }
}
