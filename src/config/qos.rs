//! Reads QoS policies. Each may be missing in the file; the next layer of defaults then supplies it.

use std::collections::BTreeMap;

use super::choices::HistoryKind;
use super::field::Field;
use super::settings::InputQos;
use crate::model::{Durability, History, QosProfile, Reliability, TrafficClass};

/// The depth of KEEP_LAST without a depth in the file: that of ROS 2's default profile.
const DEFAULT_DEPTH: u32 = 10;

/// The depth of an output that follows TRANSIENT_LOCAL publishers.
const LATCHED_DEPTH: u32 = 1;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PartialQos {
    reliability: Option<Reliability>,
    history: Option<HistoryKind>,
    depth: Option<u32>,
    durability: Option<Durability>,
    lifespan_ms: Option<u64>,
    deadline_ms: Option<u64>,
}

impl PartialQos {
    /// Reads a mapping of policies, all of which are optional.
    pub fn read(field: &Field<'_>) -> Self {
        field.entries();
        Self {
            reliability: field.get("reliability").choice(),
            history: field.get("history").choice(),
            depth: field.get("depth").count(),
            durability: field.get("durability").choice(),
            lifespan_ms: field.get("lifespan_ms").count(),
            deadline_ms: field.get("deadline_ms").count(),
        }
    }

    /// These policies, with missing ones from `base`.
    pub fn over(self, base: Self) -> Self {
        Self {
            reliability: self.reliability.or(base.reliability),
            history: self.history.or(base.history),
            depth: self.depth.or(base.depth),
            durability: self.durability.or(base.durability),
            lifespan_ms: self.lifespan_ms.or(base.lifespan_ms),
            deadline_ms: self.deadline_ms.or(base.deadline_ms),
        }
    }

    /// The profile of a writer: missing policies are those of the lane's class.
    pub fn complete(self, class: TrafficClass) -> QosProfile {
        let default = match (class, self.reliability) {
            (TrafficClass::Critical, _) => QosProfile::CRITICAL,
            (TrafficClass::Noncritical, Some(Reliability::BestEffort)) => QosProfile::NONCRITICAL,
            (TrafficClass::Noncritical, _) => QosProfile::NONCRITICAL_RELIABLE,
        };
        QosProfile {
            reliability: self.reliability.unwrap_or(default.reliability),
            history: match (self.history, self.depth) {
                (Some(HistoryKind::KeepAll), _) => History::KeepAll,
                (_, Some(depth)) => History::KeepLast { depth },
                (_, None) => default.history,
            },
            durability: self.durability.unwrap_or(default.durability),
            lifespan_ms: self.lifespan_ms,
            deadline_ms: self.deadline_ms,
        }
    }

    /// The profile of a writer that follows TRANSIENT_LOCAL publishers; `None` if a durability is given.
    /// Discovery does not announce their depth, so a depth that is not given is that of latched ROS 2 topics.
    pub fn latched(self, class: TrafficClass) -> Option<QosProfile> {
        let (durability, depth) = (Some(Durability::TransientLocal), self.depth.or(Some(LATCHED_DEPTH)));
        self.durability.is_none().then(|| Self { durability, depth, ..self }.complete(class))
    }

    /// The QoS that ingress requests: missing policies follow the publisher's offer.
    pub fn input(self) -> InputQos {
        let history = match (self.history, self.depth) {
            (Some(HistoryKind::KeepAll), _) => Some(History::KeepAll),
            (Some(HistoryKind::KeepLast), None) => Some(History::KeepLast { depth: DEFAULT_DEPTH }),
            (_, depth) => depth.map(|depth| History::KeepLast { depth }),
        };
        let Self { reliability, durability, deadline_ms, .. } = self;
        InputQos { reliability, durability, history, deadline_ms }
    }
}

/// The section `qos_profiles`, by name.
pub(super) struct Profiles<'a>(BTreeMap<&'a str, PartialQos>);

impl<'a> Profiles<'a> {
    /// Reads all profiles, used or not.
    pub fn read(root: &Field<'a>) -> Self {
        let entries = root.get("qos_profiles").entries();
        Self(entries.into_iter().map(|(name, field)| (name, PartialQos::read(&field))).collect())
    }

    /// The profile that a field names; `None` if the field has no value.
    pub fn named(&self, field: &Field<'_>) -> Option<PartialQos> {
        if !field.is_given() {
            return None;
        }
        let names: Vec<&str> = self.0.keys().copied().collect();
        field.reference("the name of a profile in qos_profiles", &names, |name| self.0.get(name).copied())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_output_follows_latched_publishers_unless_the_file_gives_its_durability() {
        let latched = |given: PartialQos| given.latched(TrafficClass::Critical);
        let history = |depth| History::KeepLast { depth };
        let qos = QosProfile { durability: Durability::TransientLocal, ..QosProfile::CRITICAL };
        let none = PartialQos::default();
        assert_eq!(latched(none), Some(QosProfile { history: history(1), ..qos }));
        let deep = PartialQos { depth: Some(7), ..none };
        assert_eq!(latched(deep), Some(QosProfile { history: history(7), ..qos }));
        for given in [Durability::Volatile, Durability::TransientLocal] {
            assert_eq!(latched(PartialQos { durability: Some(given), ..none }), None);
        }
    }
}
