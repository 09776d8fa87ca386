//! What can go wrong at the RTPS edge.

use std::fmt;
use std::io;

/// Why a participant, reader or writer could not be made.
#[derive(Debug)]
pub enum DdsError {
    /// A configured interface or address is not one of this host's.
    NoSuchInterface {
        /// What was configured.
        asked: String,
        /// What the host has, as `name address`.
        present: Vec<String>,
    },
    /// The host's interfaces could not be listed.
    Interfaces(io::Error),
    /// The DDS library refused.
    Library {
        /// What was being made.
        what: String,
        /// The library's reason.
        reason: String,
    },
}

impl fmt::Display for DdsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoSuchInterface { asked, present } => write!(
                f,
                "network interface {asked} is not on this host or has no IPv4 address; it has: {}",
                present.join(", ")
            ),
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
