//! The words that a configuration file may have for a value, and what each means.

use super::settings::{DropPolicy, SchedulingPolicy, TrustMode, Verbosity};
use crate::model::{Durability, Reliability, SubscriberState};

pub(super) const RELIABILITIES: &[(&str, Reliability)] =
    &[("RELIABLE", Reliability::Reliable), ("BEST_EFFORT", Reliability::BestEffort)];
pub(super) const DURABILITIES: &[(&str, Durability)] =
    &[("VOLATILE", Durability::Volatile), ("TRANSIENT_LOCAL", Durability::TransientLocal)];
pub(super) const HISTORIES: &[(&str, HistoryKind)] =
    &[("KEEP_LAST", HistoryKind::KeepLast), ("KEEP_ALL", HistoryKind::KeepAll)];

/// The kind of a history, without its depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum HistoryKind {
    KeepLast,
    KeepAll,
}

pub(super) const DROP_POLICIES: &[(&str, DropPolicy)] = &[
    ("drop_oldest", DropPolicy::DropOldest),
    ("drop_latest", DropPolicy::DropLatest),
    ("drop_stale", DropPolicy::DropStale),
];

pub(super) const SCHEDULING_POLICIES: &[(&str, SchedulingPolicy)] = &[
    ("other", SchedulingPolicy::Other),
    ("fifo", SchedulingPolicy::Fifo),
    ("rr", SchedulingPolicy::RoundRobin),
];

pub(super) const TRUST_MODES: &[(&str, TrustMode)] = &[
    ("default_deny", TrustMode::DefaultDeny),
    ("permissive", TrustMode::Permissive),
    ("off", TrustMode::Off),
];

pub(super) const VERBOSITIES: &[(&str, Verbosity)] = &[
    ("error", Verbosity::Error),
    ("warn", Verbosity::Warn),
    ("info", Verbosity::Info),
    ("debug", Verbosity::Debug),
    ("trace", Verbosity::Trace),
];

pub(super) const STATES: &[(&str, SubscriberState)] = &[
    ("UNKNOWN", SubscriberState::Unknown),
    ("CRITICAL", SubscriberState::Critical),
    ("NONCRITICAL", SubscriberState::Noncritical),
];
