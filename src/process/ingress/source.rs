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

/// What a route's readers should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// No publisher is known, and the configuration does not say enough to do without one.
    Unknown,
    /// Two publishers claim the topic with different types, and the configuration does not decide.
    TypeConflict(String, String),
    /// At least one of these readers. A RELIABLE reader matches no BEST_EFFORT publisher, and a BEST_EFFORT
    /// one repairs nothing, so publishers of both kinds take both readers.
    Readers {
        /// DDS type.
        dds_type: String,
        /// A RELIABLE reader.
        reliable: Option<ReaderQos>,
        /// A BEST_EFFORT reader.
        best_effort: Option<ReaderQos>,
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

    /// What the publisher offers, if it is known.
    pub fn reliability_of(&self, writer: Guid) -> Option<Reliability> {
        self.writers.iter().find(|known| known.guid == writer).map(|known| known.reliability)
    }

    /// How many publishers offer BEST_EFFORT.
    pub fn best_effort_writers(&self) -> u64 {
        let offers = |writer: &&Endpoint| writer.reliability == Reliability::BestEffort;
        self.writers.iter().filter(offers).count() as u64
    }

    /// The readers that suit the publishers: one for the RELIABLE ones, one for the BEST_EFFORT ones, and
    /// each TRANSIENT_LOCAL if each of its publishers offers that. Where the configuration fixes the
    /// reliability, one reader is for all. A reader that asks for more than a publisher offers is not
    /// matched.
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
        let depth = match input.history {
            Some(History::KeepLast { depth }) => depth,
            _ => waiting_depth(max_sample_bytes),
        };
        let is_for = |reader: Reliability, writer: &Endpoint| match input.reliability {
            Some(configured) => reader == configured,
            None => reader == writer.reliability,
        };
        let reader = |reliability| {
            let writers = self.writers.iter().filter(|writer| writer.dds_type == dds_type);
            let writers = writers.filter(|writer| is_for(reliability, writer));
            let durability = match writers.map(|writer| writer.durability).min() {
                Some(offered) => input.durability.unwrap_or(offered),
                // Without a publisher only where the configuration says it all.
                None => input.durability.filter(|_| input.reliability == Some(reliability))?,
            };
            Some(ReaderQos { reliability, durability, depth, deadline_ms: input.deadline_ms })
        };
        let [reliable, best_effort] = [Reliability::Reliable, Reliability::BestEffort].map(reader);
        if reliable.is_none() && best_effort.is_none() {
            return Wanted::Unknown;
        }
        Wanted::Readers { dds_type: dds_type.to_owned(), reliable, best_effort }
    }
}

/// 1,024 samples at most: a fifth of a second at 5 kHz, far more than ingress is ever away. 16 at least.
fn waiting_depth(max_sample_bytes: usize) -> u32 {
    let depth = (WAITING_BYTES / max_sample_bytes.max(1)).clamp(16, 1024);
    depth as u32
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

    /// Durability of the RELIABLE and of the BEST_EFFORT reader.
    fn durabilities(wanted: Wanted) -> [Option<Durability>; 2] {
        let Wanted::Readers { reliable, best_effort, .. } = wanted else { panic!("{wanted:?}") };
        for (qos, reliability) in [(reliable, Reliability::Reliable), (best_effort, Reliability::BestEffort)]
        {
            assert!(qos.is_none_or(|qos| qos.reliability == reliability));
        }
        [reliable, best_effort].map(|qos| qos.map(|qos| qos.durability))
    }

    #[test]
    fn a_configuration_that_says_all_needs_no_publisher() {
        let input = InputQos {
            reliability: Some(Reliability::Reliable),
            durability: Some(Durability::Volatile),
            ..InputQos::default()
        };
        let mut source = Source::default();
        let one = [Some(Durability::Volatile), None];
        assert_eq!(durabilities(source.wanted(Some("T"), &input, 1 << 20)), one);
        // And is obeyed, also where it leaves a publisher without a reader.
        source.found(&writer(1, "T", Reliability::BestEffort, Durability::TransientLocal));
        assert_eq!(durabilities(source.wanted(Some("T"), &input, 1 << 20)), one);
    }

    #[test]
    fn one_best_effort_reader_is_for_all_where_the_configuration_says_so() {
        let input = InputQos { reliability: Some(Reliability::BestEffort), ..InputQos::default() };
        let mut source = Source::default();
        assert_eq!(source.wanted(Some("T"), &input, 1 << 20), Wanted::Unknown);
        source.found(&writer(1, "T", Reliability::Reliable, Durability::TransientLocal));
        source.found(&writer(2, "T", Reliability::BestEffort, Durability::Volatile));
        let wanted = source.wanted(Some("T"), &input, 1 << 20);
        assert_eq!(durabilities(wanted), [None, Some(Durability::Volatile)]);
    }

    #[test]
    fn publishers_of_each_reliability_have_a_reader_of_their_own() {
        let mut source = Source::default();
        source.found(&writer(1, "T", Reliability::Reliable, Durability::TransientLocal));
        let [reliable, best_effort] = durabilities(wanted(&source, None));
        assert_eq!((reliable, best_effort), (Some(Durability::TransientLocal), None));
        source.found(&writer(2, "T", Reliability::BestEffort, Durability::Volatile));
        let both = [Some(Durability::TransientLocal), Some(Durability::Volatile)];
        assert_eq!(durabilities(wanted(&source, None)), both);
        assert_eq!(source.reliability_of(Guid([2; 16])), Some(Reliability::BestEffort));
        // It asks for what the weakest of its publishers offers.
        source.found(&writer(3, "T", Reliability::Reliable, Durability::Volatile));
        assert_eq!(durabilities(wanted(&source, None)), [Some(Durability::Volatile); 2]);
        source.gone(Guid([1; 16]));
        source.gone(Guid([3; 16]));
        assert_eq!(durabilities(wanted(&source, None)), [None, Some(Durability::Volatile)]);
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
        let decided = wanted(&source, Some("T"));
        assert!(matches!(&decided, Wanted::Readers { dds_type, .. } if dds_type == "T"), "{decided:?}");
        assert_eq!(durabilities(decided), [Some(Durability::Volatile), None]);
    }

    #[test]
    fn what_may_wait_is_bounded_in_bytes() {
        assert_eq!(waiting_depth(1), 1024);
        assert_eq!(waiting_depth(1 << 20), 32);
        assert_eq!(waiting_depth(64 << 20), 16);
    }
}
