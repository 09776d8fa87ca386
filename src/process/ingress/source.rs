//! What the publishers of a route offer, and what to ask of them therefore. Pure.

use crate::config::InputQos;
use crate::dds::{Endpoint, ReaderQos};
use crate::model::{Durability, Guid, History, Reliability};

/// Bytes that may wait between the DDS library and ingress on one route. The library counts samples, so the
/// depth follows from the largest sample allowed.
const WAITING_BYTES: usize = 32 << 20;

/// The publishers of one route, as discovery knows them.
#[derive(Debug, Default)]
pub(super) struct Source {
    writers: Vec<Endpoint>,
}

/// What a route's reader should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// No publisher is known, and the configuration does not say enough to do without one.
    Unknown,
    /// Two publishers claim the topic with different types, and the configuration does not decide.
    TypeConflict(String, String),
    /// This reader.
    Reader {
        /// DDS type.
        dds_type: String,
        /// Policies.
        qos: ReaderQos,
    },
}

impl Source {
    /// Takes in a publisher, new or changed; whether it was unknown.
    pub fn found(&mut self, writer: &Endpoint) -> bool {
        match self.writers.iter_mut().find(|known| known.guid == writer.guid) {
            Some(known) => {
                *known = writer.clone();
                false
            }
            None => {
                self.writers.push(writer.clone());
                true
            }
        }
    }

    /// A publisher is gone.
    pub fn gone(&mut self, guid: Guid) {
        self.writers.retain(|writer| writer.guid != guid);
    }

    /// A participant is gone; whether it had publishers of the route.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) -> bool {
        let before = self.writers.len();
        self.writers.retain(|writer| writer.guid.prefix() != prefix);
        self.writers.len() < before
    }

    /// A publisher of another type than `dds_type`.
    pub fn of_other_type(&self, dds_type: &str) -> Option<&Endpoint> {
        self.writers.iter().find(|writer| writer.dds_type != dds_type)
    }

    /// The reader that suits all publishers: RELIABLE if each offers that, TRANSIENT_LOCAL likewise. What the
    /// configuration fixes stays fixed. A reader that asks for more than a publisher offers is not matched.
    pub fn wanted(&self, configured_type: Option<&str>, input: &InputQos, max_sample_bytes: usize) -> Wanted {
        let dds_type = match (configured_type, self.writers.first()) {
            (Some(configured), _) => configured,
            (None, Some(first)) => match self.of_other_type(&first.dds_type) {
                Some(other) => {
                    return Wanted::TypeConflict(first.dds_type.clone(), other.dds_type.clone());
                }
                None => &first.dds_type,
            },
            (None, None) => return Wanted::Unknown,
        };
        let offers = || self.writers.iter().filter(|writer| writer.dds_type == dds_type);
        let reliability = input.reliability.or_else(|| offers().map(|writer| writer.reliability).min());
        let durability = input.durability.or_else(|| offers().map(|writer| writer.durability).min());
        let (Some(reliability), Some(durability)) = (reliability, durability) else {
            return Wanted::Unknown;
        };
        let depth = match input.history {
            Some(History::KeepLast { depth }) => depth,
            _ => waiting_depth(max_sample_bytes),
        };
        Wanted::Reader {
            dds_type: dds_type.to_owned(),
            qos: ReaderQos { reliability, durability, depth, deadline_ms: input.deadline_ms },
        }
    }
}

/// 1,024 samples at most: a fifth of a second at 5 kHz, far more than ingress is ever away. 16 at least.
fn waiting_depth(max_sample_bytes: usize) -> u32 {
    let depth = (WAITING_BYTES / max_sample_bytes.max(1)).clamp(16, 1024);
    depth as u32
}

/// Whether a reader with `current` may stay although `wanted` would suit better: one that asks for less than
/// all publishers offer is matched with each of them, and replacing it would lose samples.
pub(super) fn still_suits(current: &ReaderQos, wanted: &ReaderQos) -> bool {
    let reliability_ok = current.reliability <= wanted.reliability;
    let durability_ok = current.durability <= wanted.durability;
    reliability_ok && durability_ok
}

/// How a policy is called in the log.
pub(super) const fn label(reliability: Reliability, durability: Durability) -> &'static str {
    match (reliability, durability) {
        (Reliability::BestEffort, Durability::Volatile) => "BEST_EFFORT, VOLATILE",
        (Reliability::BestEffort, Durability::TransientLocal) => "BEST_EFFORT, TRANSIENT_LOCAL",
        (Reliability::Reliable, Durability::Volatile) => "RELIABLE, VOLATILE",
        (Reliability::Reliable, Durability::TransientLocal) => "RELIABLE, TRANSIENT_LOCAL",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::Location;

    fn writer(id: u8, dds_type: &str, reliability: Reliability, durability: Durability) -> Endpoint {
        Endpoint {
            guid: Guid([id; 16]),
            topic: "rt/x".into(),
            dds_type: dds_type.into(),
            reliability,
            durability,
            location: Location::default(),
        }
    }

    fn wanted(source: &Source, configured_type: Option<&str>) -> Wanted {
        source.wanted(configured_type, &InputQos::default(), 1 << 20)
    }

    #[test]
    fn nothing_is_wanted_before_a_publisher_is_known() {
        assert_eq!(wanted(&Source::default(), None), Wanted::Unknown);
        assert_eq!(wanted(&Source::default(), Some("T")), Wanted::Unknown);
    }

    #[test]
    fn a_configuration_that_says_all_needs_no_publisher() {
        let input = InputQos {
            reliability: Some(Reliability::Reliable),
            durability: Some(Durability::Volatile),
            ..InputQos::default()
        };
        let wanted = Source::default().wanted(Some("T"), &input, 1 << 20);
        assert!(matches!(wanted, Wanted::Reader { .. }), "{wanted:?}");
    }

    #[test]
    fn the_reader_asks_for_what_the_weakest_publisher_offers() {
        let mut source = Source::default();
        source.found(&writer(1, "T", Reliability::Reliable, Durability::TransientLocal));
        let Wanted::Reader { qos, .. } = wanted(&source, None) else { panic!() };
        assert_eq!((qos.reliability, qos.durability), (Reliability::Reliable, Durability::TransientLocal));
        source.found(&writer(2, "T", Reliability::BestEffort, Durability::Volatile));
        let Wanted::Reader { qos: weaker, .. } = wanted(&source, None) else { panic!() };
        assert_eq!((weaker.reliability, weaker.durability), (Reliability::BestEffort, Durability::Volatile));
        assert!(!still_suits(&qos, &weaker));
        source.gone(Guid([2; 16]));
        let Wanted::Reader { qos: stronger, .. } = wanted(&source, None) else { panic!() };
        assert!(still_suits(&weaker, &stronger));
    }

    #[test]
    fn publishers_leave_with_their_participant() {
        let mut source = Source::default();
        source.found(&writer(1, "T", Reliability::Reliable, Durability::Volatile));
        source.found(&writer(2, "U", Reliability::Reliable, Durability::Volatile));
        assert!(!source.participant_gone([3; 12]));
        assert!(source.participant_gone([1; 12]));
        assert!(source.of_other_type("U").is_none());
    }

    #[test]
    fn two_types_are_a_conflict_unless_the_configuration_decides() {
        let mut source = Source::default();
        source.found(&writer(1, "T", Reliability::Reliable, Durability::Volatile));
        source.found(&writer(2, "U", Reliability::BestEffort, Durability::Volatile));
        assert_eq!(wanted(&source, None), Wanted::TypeConflict("T".into(), "U".into()));
        let Wanted::Reader { dds_type, qos } = wanted(&source, Some("T")) else { panic!() };
        assert_eq!((dds_type.as_str(), qos.reliability), ("T", Reliability::Reliable));
    }

    #[test]
    fn what_may_wait_is_bounded_in_bytes() {
        assert_eq!(waiting_depth(1), 1024);
        assert_eq!(waiting_depth(1 << 20), 32);
        assert_eq!(waiting_depth(64 << 20), 16);
    }
}
