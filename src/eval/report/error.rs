//! What can go wrong with a report, in the words of someone who has to mend it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// Why there is no report, or why a run is not in it.
#[derive(Debug)]
pub enum ReportError {
    /// A file or folder could not be read or written.
    File {
        /// Which one.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file does not say what docs/eval-results.md promises.
    Content {
        /// Which one.
        path: PathBuf,
        /// The line, counted from 1; 0 for the whole file.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
    /// There is nothing to report.
    NoRuns {
        /// The folder that was looked in.
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
                "{} has no finished run; `adaptive-bridge-eval run` or `matrix` makes some",
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
