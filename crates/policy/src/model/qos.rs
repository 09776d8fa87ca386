//! The DDS Quality of Service policies that the configuration can set for a route (DDS 1.4 clause 2.2.3).

use serde::{Deserialize, Serialize};

/// RELIABILITY.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Reliability {
    /// A lost sample stays lost.
    BestEffort,
    /// A lost sample is sent again while it is in the writer's history.
    Reliable,
}

/// HISTORY.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum History {
    /// The last `depth` samples; at least 1.
    KeepLast {
        /// Samples.
        depth: u32,
    },
    /// All samples, up to the resource limits.
    KeepAll,
}

/// DURABILITY.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Durability {
    /// A late joiner receives what is published from then on.
    Volatile,
    /// A late joiner also receives the writer's history.
    TransientLocal,
}

/// The policies of one reader or writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct QosProfile {
    /// RELIABILITY.
    pub reliability: Reliability,
    /// HISTORY.
    pub history: History,
    /// DURABILITY.
    pub durability: Durability,
    /// LIFESPAN in milliseconds; `None` is infinite.
    pub lifespan_ms: Option<u64>,
    /// DEADLINE in milliseconds; `None` is infinite.
    pub deadline_ms: Option<u64>,
}

impl QosProfile {
    /// The paper's critical writer (section III-B): RELIABLE, KEEP_LAST 10, VOLATILE.
    pub const CRITICAL: Self = Self {
        reliability: Reliability::Reliable,
        history: History::KeepLast { depth: 10 },
        durability: Durability::Volatile,
        lifespan_ms: None,
        deadline_ms: None,
    };

    /// The paper's noncritical writer (section III-B): BEST_EFFORT, KEEP_LAST 5, VOLATILE.
    pub const NONCRITICAL: Self = Self {
        reliability: Reliability::BestEffort,
        history: History::KeepLast { depth: 5 },
        ..Self::CRITICAL
    };

    /// The writer of a noncritical lane whose file gives no RELIABILITY: RELIABLE, because a RELIABLE reader
    /// does not match a BEST_EFFORT writer, with a history that is 0.2 s at the lane's default rate
    /// (docs/decisions/0017-reliable-noncritical.md).
    pub const NONCRITICAL_RELIABLE: Self = Self { history: History::KeepLast { depth: 2 }, ..Self::CRITICAL };

    /// HISTORY depth in samples; `None` for KEEP_ALL.
    pub const fn depth(&self) -> Option<u32> {
        match self.history {
            History::KeepLast { depth } => Some(depth),
            History::KeepAll => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_classes_have_the_qos_of_the_paper() {
        let (critical, noncritical) = (QosProfile::CRITICAL, QosProfile::NONCRITICAL);
        assert_eq!((critical.reliability, critical.depth()), (Reliability::Reliable, Some(10)));
        assert_eq!((noncritical.reliability, noncritical.depth()), (Reliability::BestEffort, Some(5)));
        assert_eq!(
            (critical.durability, noncritical.durability),
            (Durability::Volatile, Durability::Volatile)
        );
        let repaired = QosProfile::NONCRITICAL_RELIABLE;
        assert_eq!((repaired.reliability, repaired.depth()), (Reliability::Reliable, Some(2)));
        assert_eq!(QosProfile { history: History::KeepAll, ..critical }.depth(), None);
    }
}
