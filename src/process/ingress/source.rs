//! The discovered publishers of a route, and the readers that match them. Pure: no I/O.

use crate::config::InputQos;
use crate::dds::{Endpoint, ReaderQos};
use crate::model::{DdsType, Durability, Guid, History, Reliability, TypeHash};

/// Bytes that may wait in the DDS library for ingress on one route. The library limits the number of samples,
/// so the history depth is this divided by the size of the largest sample allowed.
const WAITING_BYTES: usize = 32 << 20;

/// The publishers of one route, as discovery knows them.
#[derive(Debug, Default)]
pub(super) struct Source {
    writers: Vec<Endpoint>,
}

/// Bytes that the DDS library keeps of a route at most, whatever the depth: 10 full-HD images, a third of a
/// second at 30 Hz. The depth is for samples of the largest size, and the least one is for large samples.
const KEPT_BYTES: usize = 64 << 20;

/// The readers that a route needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum ReaderPlan {
    /// No publisher is known, and the configuration does not set type, reliability and durability.
    Unknown,
    /// Two publishers use the topic with different types, of which this is one, and the configuration sets
    /// none.
    TypeConflict(String),
    /// At least one of these readers. A RELIABLE reader does not match BEST_EFFORT publishers, and a
    /// BEST_EFFORT one does not recover lost samples, so publishers of both kinds need both readers.
    Readers { dds_type: String, reliable: Option<ReaderQos>, best_effort: Option<ReaderQos> },
}

impl Source {
    /// Adds a publisher, or replaces its entry. Returns whether it is new.
    pub fn insert(&mut self, writer: &Endpoint) -> bool {
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

    pub fn remove(&mut self, guid: Guid) {
        self.writers.retain(|writer| writer.guid != guid);
    }

    /// Removes the publishers of a participant. Returns whether there were any.
    pub fn remove_participant(&mut self, prefix: [u8; 12]) -> bool {
        let before = self.writers.len();
        self.writers.retain(|writer| writer.guid.prefix() != prefix);
        self.writers.len() < before
    }

    /// Returns a publisher of another type than `dds_type`, of another definition of it, or with keys where
    /// the others have none or the reverse, if there is one.
    pub fn find_other_type(&self, dds_type: DdsType) -> Option<&Endpoint> {
        self.writers.iter().find(|writer| {
            writer.dds_type != dds_type.name
                || writer.type_hash.contradicts(&dds_type.hash)
                || writer.guid.has_keys() != dds_type.has_keys
        })
    }

    /// Whether this type has keys: if all present publishers announce that, or `current` if there is none. So
    /// no announcement with keys takes a route from publishers of a stock ROS 2 type, which has none.
    pub fn has_keys(&self, dds_type: &str, current: bool) -> bool {
        let writers = self.writers.iter().filter(|writer| writer.dds_type == dds_type);
        let mut kinds = writers.map(|writer| writer.guid.has_keys()).peekable();
        if kinds.peek().is_none() { current } else { kinds.all(|has_keys| has_keys) }
    }

    /// The hash of this type: `current` as long as a publisher announces it, or none announces any; else that
    /// of the first publisher that announces one.
    pub fn type_hash(&self, dds_type: &str, current: TypeHash) -> TypeHash {
        let writers = self.writers.iter().filter(|writer| writer.dds_type == dds_type);
        let mut hashes = writers.map(|writer| writer.type_hash).filter(TypeHash::is_known);
        let first = hashes.clone().next().unwrap_or(current);
        if hashes.any(|hash| hash == current) { current } else { first }
    }

    /// The durability of outputs of this type for which the configuration gives none: what all present
    /// publishers offer, or `current` if there is none.
    pub fn durability(&self, dds_type: DdsType, current: Durability) -> Durability {
        let writers = self.writers.iter().filter(|writer| is_of(writer, dds_type));
        writers.map(|writer| writer.durability).min().unwrap_or(current)
    }

    pub fn reliability_of(&self, writer: Guid) -> Option<Reliability> {
        self.writers.iter().find(|known| known.guid == writer).map(|known| known.reliability)
    }

    pub fn best_effort_writers(&self) -> u64 {
        let offers = |writer: &&Endpoint| writer.reliability == Reliability::BestEffort;
        self.writers.iter().filter(offers).count() as u64
    }

    /// Chooses the readers for the known publishers: one for the RELIABLE ones and one for the BEST_EFFORT
    /// ones, each of them TRANSIENT_LOCAL if all its publishers offer that. If the configuration sets the
    /// reliability, one reader is for all publishers. A reader that requests more than a publisher offers
    /// does not match it. `had_keys` is what [`has_keys`](Self::has_keys) returned last.
    pub fn plan(
        &self,
        configured_type: Option<&str>,
        had_keys: bool,
        input: &InputQos,
        max_sample_bytes: usize,
    ) -> ReaderPlan {
        let dds_type = match (configured_type, self.writers.first()) {
            (Some(configured), _) => configured,
            (None, Some(first)) if self.writers.iter().any(|other| other.dds_type != first.dds_type) => {
                return ReaderPlan::TypeConflict(first.dds_type.clone());
            }
            (None, Some(first)) => &first.dds_type,
            (None, None) => return ReaderPlan::Unknown,
        };
        let depth = match input.history {
            Some(History::KeepLast { depth }) => depth,
            _ => history_depth(max_sample_bytes),
        };
        let is_for = |reader: Reliability, writer: &Endpoint| match input.reliability {
            Some(configured) => reader == configured,
            None => reader == writer.reliability,
        };
        let has_keys = self.has_keys(dds_type, had_keys);
        let of_route = DdsType { has_keys, ..dds_type.into() };
        let reader = |reliability| {
            let writers = self.writers.iter().filter(|writer| is_of(writer, of_route));
            let writers = writers.filter(|writer| is_for(reliability, writer));
            let durability = match writers.map(|writer| writer.durability).min() {
                Some(offered) => input.durability.unwrap_or(offered),
                // Without a publisher there is a reader only if the configuration sets the complete QoS.
                None => input.durability.filter(|_| input.reliability == Some(reliability))?,
            };
            Some(ReaderQos { reliability, durability, depth, deadline_ms: input.deadline_ms })
        };
        let [reliable, best_effort] = [Reliability::Reliable, Reliability::BestEffort].map(reader);
        if reliable.is_none() && best_effort.is_none() {
            return ReaderPlan::Unknown;
        }
        ReaderPlan::Readers { dds_type: dds_type.to_owned(), reliable, best_effort }
    }
}

/// Whether a publisher announces this type, with keys or without as it has them.
fn is_of(writer: &Endpoint, dds_type: DdsType) -> bool {
    writer.dds_type == dds_type.name && writer.guid.has_keys() == dds_type.has_keys
}

/// The most bytes that may wait in the DDS library for ingress on a route.
pub(super) fn most_waiting_bytes(input: &InputQos, max_sample_bytes: usize) -> usize {
    let of_samples = |samples: usize| samples.saturating_mul(max_sample_bytes);
    let of_depth = match input.history {
        Some(History::KeepLast { depth }) => of_samples(depth as usize),
        _ => WAITING_BYTES.clamp(of_samples(MIN_DEPTH), of_samples(MAX_DEPTH)),
    };
    of_depth.min(kept_bytes(max_sample_bytes))
}

/// The most bytes of complete samples that the DDS library keeps of a route; two always have room.
pub(super) const fn kept_bytes(max_sample_bytes: usize) -> usize {
    let of_two = max_sample_bytes.saturating_mul(2);
    if of_two > KEPT_BYTES { of_two } else { KEPT_BYTES }
}

/// The least history depth of a reader.
const MIN_DEPTH: usize = 16;
/// The most: 0.2 s at 5 kHz, far longer than ingress ever takes to come back to a route.
const MAX_DEPTH: usize = 1024;

/// The history depth of a reader.
fn history_depth(max_sample_bytes: usize) -> u32 {
    let depth = (WAITING_BYTES / max_sample_bytes.max(1)).clamp(MIN_DEPTH, MAX_DEPTH);
    depth as u32
}

/// The name of a QoS in the log.
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
            type_hash: TypeHash::UNKNOWN,
            reliability,
            durability,
            location: Location::default(),
        }
    }

    fn plan(source: &Source, configured_type: Option<&str>) -> ReaderPlan {
        source.plan(configured_type, false, &InputQos::default(), 1 << 20)
    }

    #[test]
    fn no_reader_is_planned_before_a_publisher_is_known() {
        assert_eq!(plan(&Source::default(), None), ReaderPlan::Unknown);
        assert_eq!(plan(&Source::default(), Some("T")), ReaderPlan::Unknown);
    }

    /// Durability of the RELIABLE and of the BEST_EFFORT reader.
    fn durabilities(plan: ReaderPlan) -> [Option<Durability>; 2] {
        let ReaderPlan::Readers { reliable, best_effort, .. } = plan else { panic!("{plan:?}") };
        for (qos, reliability) in [(reliable, Reliability::Reliable), (best_effort, Reliability::BestEffort)]
        {
            assert!(qos.is_none_or(|qos| qos.reliability == reliability));
        }
        [reliable, best_effort].map(|qos| qos.map(|qos| qos.durability))
    }

    #[test]
    fn a_complete_input_qos_needs_no_publisher() {
        let input = InputQos {
            reliability: Some(Reliability::Reliable),
            durability: Some(Durability::Volatile),
            ..InputQos::default()
        };
        let mut source = Source::default();
        let one = [Some(Durability::Volatile), None];
        assert_eq!(durabilities(source.plan(Some("T"), false, &input, 1 << 20)), one);
        // It also applies when a publisher does not match it.
        source.insert(&writer(1, "T", Reliability::BestEffort, Durability::TransientLocal));
        assert_eq!(durabilities(source.plan(Some("T"), false, &input, 1 << 20)), one);
    }

    #[test]
    fn a_configured_best_effort_reliability_gives_one_reader_for_all_publishers() {
        let input = InputQos { reliability: Some(Reliability::BestEffort), ..InputQos::default() };
        let mut source = Source::default();
        assert_eq!(source.plan(Some("T"), false, &input, 1 << 20), ReaderPlan::Unknown);
        source.insert(&writer(1, "T", Reliability::Reliable, Durability::TransientLocal));
        source.insert(&writer(5, "T", Reliability::BestEffort, Durability::Volatile));
        let plan = source.plan(Some("T"), false, &input, 1 << 20);
        assert_eq!(durabilities(plan), [None, Some(Durability::Volatile)]);
    }

    #[test]
    fn publishers_of_each_reliability_get_a_reader_of_their_own() {
        let mut source = Source::default();
        source.insert(&writer(1, "T", Reliability::Reliable, Durability::TransientLocal));
        let [reliable, best_effort] = durabilities(plan(&source, None));
        assert_eq!((reliable, best_effort), (Some(Durability::TransientLocal), None));
        source.insert(&writer(5, "T", Reliability::BestEffort, Durability::Volatile));
        let both = [Some(Durability::TransientLocal), Some(Durability::Volatile)];
        assert_eq!(durabilities(plan(&source, None)), both);
        assert_eq!(source.reliability_of(Guid([5; 16])), Some(Reliability::BestEffort));
        // A reader requests the weakest durability that its publishers offer.
        source.insert(&writer(3, "T", Reliability::Reliable, Durability::Volatile));
        assert_eq!(durabilities(plan(&source, None)), [Some(Durability::Volatile); 2]);
        source.remove(Guid([1; 16]));
        source.remove(Guid([3; 16]));
        assert_eq!(durabilities(plan(&source, None)), [None, Some(Durability::Volatile)]);
    }

    #[test]
    fn outputs_are_transient_local_while_all_present_publishers_of_the_type_are() {
        let (volatile, latched) = (Durability::Volatile, Durability::TransientLocal);
        let mut source = Source::default();
        assert_eq!([volatile, latched].map(|last| source.durability("T".into(), last)), [volatile, latched]);
        source.insert(&writer(1, "T", Reliability::Reliable, latched));
        source.insert(&writer(5, "U", Reliability::Reliable, volatile));
        assert_eq!(source.durability("T".into(), volatile), latched);
        source.insert(&writer(3, "T", Reliability::Reliable, volatile));
        assert_eq!(source.durability("T".into(), volatile), volatile);
        assert_eq!(source.durability("T".into(), latched), volatile);
        source.remove(Guid([3; 16]));
        assert_eq!(source.durability("T".into(), volatile), latched);
    }

    #[test]
    fn publishers_with_keys_and_without_do_not_share_a_reader() {
        let (reliable, volatile) = (Reliability::Reliable, Durability::Volatile);
        let keyed = |id: u8, reliability| {
            let mut writer = writer(id, "T", reliability, volatile);
            writer.guid.0[15] = 0x02;
            writer
        };
        let mut source = Source::default();
        assert_eq!([true, false].map(|last| source.has_keys("T", last)), [true, false]);
        source.insert(&keyed(1, reliable));
        assert_eq!([true, false].map(|last| source.has_keys("T", last)), [true, true]);
        // One without keys gets the reader, whenever it comes, and the other one is named.
        source.insert(&writer(3, "T", Reliability::BestEffort, volatile));
        assert_eq!([true, false].map(|last| source.has_keys("T", last)), [false, false]);
        assert_eq!(
            durabilities(source.plan(None, true, &InputQos::default(), 1 << 20)),
            [None, Some(volatile)]
        );
        let other = source.find_other_type("T".into());
        assert_eq!(other.map(|writer| writer.guid), Some(keyed(1, reliable).guid));
        // When it is gone, the one with keys gets it again.
        source.remove(Guid([3; 16]));
        assert_eq!([true, false].map(|last| source.has_keys("T", last)), [true, true]);
        assert_eq!(
            durabilities(source.plan(None, false, &InputQos::default(), 1 << 20)),
            [Some(volatile), None]
        );
    }

    #[test]
    fn removing_a_participant_removes_its_publishers() {
        let mut source = Source::default();
        source.insert(&writer(1, "T", Reliability::Reliable, Durability::Volatile));
        source.insert(&writer(5, "U", Reliability::Reliable, Durability::Volatile));
        assert!(!source.remove_participant([3; 12]));
        assert!(source.remove_participant([1; 12]));
        assert!(source.find_other_type("U".into()).is_none());
    }

    #[test]
    fn two_types_are_a_conflict_unless_the_configuration_sets_one() {
        let mut source = Source::default();
        source.insert(&writer(1, "T", Reliability::Reliable, Durability::Volatile));
        source.insert(&writer(5, "U", Reliability::BestEffort, Durability::Volatile));
        assert_eq!(plan(&source, None), ReaderPlan::TypeConflict("T".into()));
        let decided = plan(&source, Some("T"));
        assert!(matches!(&decided, ReaderPlan::Readers { dds_type, .. } if dds_type == "T"), "{decided:?}");
        assert_eq!(durabilities(decided), [Some(Durability::Volatile), None]);
    }

    #[test]
    fn the_type_hash_in_force_changes_only_when_no_publisher_announces_it_any_more() {
        let mut source = Source::default();
        assert_eq!(source.type_hash("T", TypeHash([1; 32])), TypeHash([1; 32]));
        for (id, hash) in [(1, TypeHash::UNKNOWN), (5, TypeHash([2; 32])), (3, TypeHash([3; 32]))] {
            let writer = writer(id, "T", Reliability::Reliable, Durability::Volatile);
            source.insert(&Endpoint { type_hash: hash, ..writer });
        }
        let other = writer(4, "U", Reliability::Reliable, Durability::Volatile);
        source.insert(&Endpoint { type_hash: TypeHash([4; 32]), ..other });
        assert_eq!(source.type_hash("T", TypeHash::UNKNOWN), TypeHash([2; 32]));
        assert_eq!(source.type_hash("T", TypeHash([3; 32])), TypeHash([3; 32]));
        assert_eq!(source.type_hash("T", TypeHash([4; 32])), TypeHash([2; 32]));
        let find = |source: &Source, hash| {
            let found = source.find_other_type(DdsType { hash: TypeHash([hash; 32]), .."T".into() });
            found.map(|writer| writer.guid)
        };
        assert_eq!(find(&source, 2), Some(Guid([3; 16])));
        source.remove(Guid([4; 16]));
        assert_eq!(find(&source, 0), None);
        source.remove(Guid([3; 16]));
        assert_eq!(find(&source, 2), None);
        assert_eq!(source.type_hash("T", TypeHash([3; 32])), TypeHash([2; 32]));
    }

    #[test]
    fn the_history_is_bounded_in_bytes() {
        assert_eq!(history_depth(1), 1024);
        assert_eq!(history_depth(1 << 20), 32);
        assert_eq!(history_depth(64 << 20), 16);
        for bytes in [1, 30_000, 1_000_000, 3_000_000, 64 << 20] {
            let most = most_waiting_bytes(&InputQos::default(), bytes);
            assert!((history_depth(bytes) as usize * bytes).min(kept_bytes(bytes)) <= most, "{bytes}");
        }
        assert_eq!(most_waiting_bytes(&InputQos::default(), 16 << 20), 64 << 20);
        assert_eq!(most_waiting_bytes(&InputQos::default(), 64 << 20), 128 << 20);
        let of_depth = |depth| InputQos { history: Some(History::KeepLast { depth }), ..InputQos::default() };
        assert_eq!(most_waiting_bytes(&of_depth(3), 1_000), 3_000);
        assert_eq!(most_waiting_bytes(&of_depth(100), 16 << 20), 64 << 20);
    }
}
