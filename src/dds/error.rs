//! Errors when DDS entities are created.

use std::fmt;
use std::io;

/// Why a participant, reader or writer could not be created.
#[derive(Debug)]
pub enum DdsError {
    /// The host's interfaces could not be listed.
    Interfaces(io::Error),
    /// The DDS library returned an error.
    Library {
        /// The entity that was to be created.
        what: String,
        /// The library's reason.
        reason: String,
    },
}

impl fmt::Display for DdsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Interfaces(error) => write!(f, "cannot list the network interfaces: {error}"),
            Self::Library { what, reason } => write!(f, "cannot create {what}: {reason}"),
        }
    }
}

impl std::error::Error for DdsError {}

impl DdsError {
    pub(super) fn library(what: impl Into<String>, reason: impl fmt::Debug) -> Self {
        Self::Library { what: what.into(), reason: format!("{reason:?}") }
    }
}
