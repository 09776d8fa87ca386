//! The words that a configuration file may have for a value, and what each means.

use super::settings::{DropPolicy, SchedulingPolicy, Standby, TrustMode, Verbosity};
use crate::model::{Durability, Reliability, SubscriberState};

type Words<T> = &'static [(&'static str, T)];

/// A value that is one of a few words in the file.
pub(super) trait Choice: Copy + PartialEq + 'static {
    const WORDS: Words<Self>;
}

pub(super) fn words<T: Choice>() -> Vec<&'static str> {
    T::WORDS.iter().map(|(word, _)| *word).collect()
}

impl Choice for Reliability {
    const WORDS: Words<Self> = &[("RELIABLE", Self::Reliable), ("BEST_EFFORT", Self::BestEffort)];
}

impl Choice for Durability {
    const WORDS: Words<Self> = &[("VOLATILE", Self::Volatile), ("TRANSIENT_LOCAL", Self::TransientLocal)];
}

/// The kind of a history, without its depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum HistoryKind {
    KeepLast,
    KeepAll,
}

impl Choice for HistoryKind {
    const WORDS: Words<Self> = &[("KEEP_LAST", Self::KeepLast), ("KEEP_ALL", Self::KeepAll)];
}

impl Choice for DropPolicy {
    const WORDS: Words<Self> = &[
        ("drop_oldest", Self::DropOldest),
        ("drop_latest", Self::DropLatest),
        ("drop_stale", Self::DropStale),
    ];
}

impl Choice for SchedulingPolicy {
    const WORDS: Words<Self> = &[("other", Self::Other), ("fifo", Self::Fifo), ("rr", Self::RoundRobin)];
}

impl Choice for Standby {
    const WORDS: Words<Self> = &[("none", Self::None), ("warm", Self::Warm)];
}

impl Choice for TrustMode {
    const WORDS: Words<Self> =
        &[("default_deny", Self::DefaultDeny), ("permissive", Self::Permissive), ("off", Self::Off)];
}

impl Choice for Verbosity {
    const WORDS: Words<Self> = &[
        ("error", Self::Error),
        ("warn", Self::Warn),
        ("info", Self::Info),
        ("debug", Self::Debug),
        ("trace", Self::Trace),
    ];
}

impl Choice for SubscriberState {
    const WORDS: Words<Self> =
        &[("UNKNOWN", Self::Unknown), ("CRITICAL", Self::Critical), ("NONCRITICAL", Self::Noncritical)];
}
