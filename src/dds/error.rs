//! Errors when DDS entities are created.

use std::fmt;
use std::io;

/// Why a participant, reader or writer could not be created.
#[derive(Debug, thiserror::Error)]
pub enum DdsError {
    /// The host's interfaces could not be listed.
    #[error("cannot list the network interfaces: {0}")]
    Interfaces(io::Error),
    /// The DDS library returned an error.
    #[error("cannot create {what}: {reason}")]
    Library {
        /// The entity that was to be created.
        what: String,
        /// The library's reason.
        reason: String,
    },
}

impl DdsError {
    pub(super) fn library(what: impl Into<String>, reason: impl fmt::Debug) -> Self {
        Self::Library { what: what.into(), reason: format!("{reason:?}") }
    }
}
