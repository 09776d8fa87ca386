//! Converts between the bridge's QoS and the QoS policies of RustDDS.

use super::rustdds::policy;
use super::rustdds::qos::QosPolicyId;
use super::rustdds::{Duration, QosPolicies, QosPolicyBuilder};
use crate::model::{Durability, History, QosProfile, Reliability, TypeHash, UnmatchedPolicy};

/// Data representation identifiers (XTypes 1.3 clause 7.6.3.1.1).
const XCDR1: i16 = 0;
const XML: i16 = 1;
const XCDR2: i16 = 2;

/// The QoS that a reader requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ReaderQos {
    /// The requested RELIABILITY.
    pub reliability: Reliability,
    /// The requested DURABILITY.
    pub durability: Durability,
    /// The most samples that the DDS library keeps until they are taken; at least 1.
    pub depth: u32,
    /// The requested DEADLINE in milliseconds; `None` is infinite.
    pub deadline_ms: Option<u64>,
}

/// The policies of a reader. It accepts every data representation, because the bridge does not decode
/// payloads.
pub(super) fn of_reader(qos: &ReaderQos) -> QosPolicies {
    let depth = i32::try_from(qos.depth).unwrap_or(i32::MAX);
    let mut builder = QosPolicyBuilder::new()
        .durability(durability(qos.durability))
        .history(policy::History::KeepLast { depth })
        .resource_limits(resource_limits(depth));
    if let Some(ms) = qos.deadline_ms {
        builder = builder.deadline(policy::Deadline(duration_ms(ms)));
    }
    builder = match qos.reliability {
        Reliability::BestEffort => builder.best_effort(),
        Reliability::Reliable => builder.reliable(Duration::ZERO),
    };
    builder.build().with_data_representation(policy::DataRepresentation { value: vec![XCDR1, XCDR2, XML] })
}

/// The policies of a writer that waits for no reader. It retains `window_samples` for retransmission, also
/// where KEEP_ALL is configured: HISTORY is not matched between writers and readers (DDS 1.4 clause
/// 2.2.3.18), and a KEEP_ALL writer would refuse samples as soon as one reader does not acknowledge.
pub(super) fn of_writer(qos: &QosProfile, window_samples: usize) -> QosPolicies {
    let depth = u32::try_from(window_samples).unwrap_or(u32::MAX);
    let history = match qos.history {
        History::KeepAll => History::KeepLast { depth },
        keep_last @ History::KeepLast { .. } => keep_last,
    };
    of_blocking_writer(&QosProfile { history, ..*qos }, window_samples, std::time::Duration::ZERO)
}

/// Like [`of_writer`], but a KEEP_ALL writer waits for acknowledgements while its window is full
/// (`max_blocking_time`, DDS 1.4 clause 2.2.3.14).
pub(super) fn of_blocking_writer(
    qos: &QosProfile,
    window_samples: usize,
    max_blocking: std::time::Duration,
) -> QosPolicies {
    let window = i32::try_from(window_samples).unwrap_or(i32::MAX);
    let mut builder = QosPolicyBuilder::new()
        .durability(durability(qos.durability))
        .history(match qos.history {
            History::KeepLast { depth } => {
                policy::History::KeepLast { depth: i32::try_from(depth).unwrap_or(i32::MAX) }
            }
            History::KeepAll => policy::History::KeepAll,
        })
        .resource_limits(resource_limits(window));
    if let Some(ms) = qos.lifespan_ms {
        builder = builder.lifespan(policy::Lifespan { duration: duration_ms(ms) });
    }
    if let Some(ms) = qos.deadline_ms {
        builder = builder.deadline(policy::Deadline(duration_ms(ms)));
    }
    match qos.reliability {
        Reliability::BestEffort => builder.best_effort(),
        Reliability::Reliable => builder.reliable(Duration::from_std(max_blocking)),
    }
    .build()
}

/// The USER_DATA of a participant, as ROS 2 announces it: its enclave. Nodes without SROS 2 are in `/`.
pub(super) fn enclave() -> policy::UserData {
    policy::UserData { value: b"enclave=/;".to_vec() }
}

/// The USER_DATA with the hash of the endpoint's type, as ROS 2 announces it; empty if it is unknown.
pub(super) fn user_data(type_hash: TypeHash) -> policy::UserData {
    let pair = type_hash.is_known().then(|| format!("typehash={type_hash};"));
    policy::UserData { value: pair.unwrap_or_default().into_bytes() }
}

/// The RELIABILITY that an endpoint announced; `default` if it announced none, because the DDS default (DDS
/// 1.4 clause 2.2.3) differs between readers and writers.
pub(super) fn reliability_of(qos: &QosPolicies, default: Reliability) -> Reliability {
    match qos.reliability() {
        Some(policy::Reliability::BestEffort) => Reliability::BestEffort,
        Some(policy::Reliability::Reliable { .. }) => Reliability::Reliable,
        None => default,
    }
}

/// The DURABILITY that an endpoint announced; VOLATILE, the DDS default, if it announced none.
pub(super) fn durability_of(qos: &QosPolicies) -> Durability {
    match qos.durability() {
        Some(policy::Durability::Volatile) | None => Durability::Volatile,
        Some(_) => Durability::TransientLocal,
    }
}

/// The policy for which endpoints do not match.
pub(super) fn unmatched_policy(policy: QosPolicyId) -> UnmatchedPolicy {
    match policy {
        QosPolicyId::Reliability => UnmatchedPolicy::Reliability,
        QosPolicyId::Durability => UnmatchedPolicy::Durability,
        QosPolicyId::Deadline => UnmatchedPolicy::Deadline,
        QosPolicyId::Liveliness => UnmatchedPolicy::Liveliness,
        QosPolicyId::Ownership => UnmatchedPolicy::Ownership,
        QosPolicyId::Presentation => UnmatchedPolicy::Presentation,
        QosPolicyId::LatencyBudget => UnmatchedPolicy::LatencyBudget,
        QosPolicyId::DestinationOrder => UnmatchedPolicy::DestinationOrder,
        QosPolicyId::Representation => UnmatchedPolicy::DataRepresentation,
        _ => UnmatchedPolicy::Other,
    }
}

fn durability(durability: Durability) -> policy::Durability {
    match durability {
        Durability::Volatile => policy::Durability::Volatile,
        Durability::TransientLocal => policy::Durability::TransientLocal,
    }
}

fn resource_limits(max_samples: i32) -> policy::ResourceLimits {
    policy::ResourceLimits { max_samples, max_instances: 1, max_samples_per_instance: max_samples }
}

fn duration_ms(ms: u64) -> Duration {
    Duration::from_std(std::time::Duration::from_millis(ms))
}
