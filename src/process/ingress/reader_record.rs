//! What a reader of ingress leaves to that of the next process: its entity id.

use std::hash::{DefaultHasher, Hash, Hasher};

use super::super::role::Role;
use crate::dds::ReaderQos;
use crate::model::{DdsType, EndpointIdentity, Guid, Reliability};
use crate::shm::BoardWriter;

/// The identity of the DDS reader of a route for the publishers of a reliability.
pub(super) struct ReaderRecord {
    board: BoardWriter<EndpointIdentity>,
    route: usize,
    reliability: Reliability,
    /// Whether the next reader may be that of the former process: this process has had none, which would have
    /// said goodbye.
    may_continue: bool,
}

impl ReaderRecord {
    /// That of a route.
    pub fn of(role: &Role, route: usize, reliability: Reliability) -> Self {
        let board = role.boards.reader_identity_writer(route, reliability);
        Self { board, route, reliability, may_continue: true }
    }

    /// A part of the entity id of the next reader: that of the former process if it is the first one, of the
    /// same participant, and requests the same; else one of its own, because publishers keep what they know
    /// of a GUID.
    pub fn next(
        &mut self,
        participant: Guid,
        topic: &str,
        dds_type: &DdsType<'_>,
        qos: &ReaderQos,
    ) -> [u8; 3] {
        let mut hasher = DefaultHasher::new();
        (participant, topic, dds_type.name, dds_type.has_keys, qos).hash(&mut hasher);
        let offer = hasher.finish();
        let former = *self.board.get();
        let may_continue = std::mem::replace(&mut self.may_continue, false);
        if !(may_continue && former.is_intact() && former.count > 0 && former.offer == offer) {
            let count = former.count.wrapping_add(1).max(1);
            self.board.set(EndpointIdentity { count, offer, ..EndpointIdentity::default() }.sealed());
        }
        key(self.route, self.reliability, self.board.get().count)
    }

    /// The reader says goodbye.
    pub fn removed(&mut self) {
        let count = self.board.get().count;
        self.board.set(EndpointIdentity { count, ..EndpointIdentity::default() });
    }
}

/// The part of the entity id of the `count`-th reader: 0x80 to 0xbf first, 12 bits of the route, one of the
/// reliability, and 9 of the count.
fn key(route: usize, reliability: Reliability, count: u64) -> [u8; 3] {
    let (route, count) = (route as u32 & 0xfff, count as u32 & 0x1ff);
    let number = 0x80_0000 | route << 10 | (reliability as u32) << 9 | count;
    let [_, high, middle, low] = number.to_be_bytes();
    [high, middle, low]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Durability, TypeHash};
    use crate::process::test_role::{self, SCAN, TYPE};
    use crate::shm::ProcessRole;

    #[test]
    fn a_reader_is_that_of_the_former_process_if_it_requests_the_same_and_has_said_no_goodbye() {
        let (_folder, role, ..) = test_role::open(ProcessRole::Ingress, "ingress", 74, SCAN);
        let (ours, others) = (Guid([1; 16]), Guid([2; 16]));
        let dds_type = DdsType { name: TYPE, hash: TypeHash::UNKNOWN, has_keys: false };
        let qos = |depth| ReaderQos {
            depth,
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            deadline_ms: None,
        };
        let record = || ReaderRecord::of(&role, 0, Reliability::Reliable);
        let next = |record: &mut ReaderRecord, participant, depth| {
            record.next(participant, "rt/a", &dds_type, &qos(depth))
        };
        let first = next(&mut record(), ours, 10);
        let mut process = record();
        assert_eq!(next(&mut process, ours, 10), first);
        let mut keys = vec![first];
        // The second reader of a process, one of another participant or QoS, and one after a goodbye.
        keys.push(next(&mut process, ours, 10));
        keys.push(next(&mut record(), others, 10));
        keys.push(next(&mut record(), others, 11));
        let mut process = record();
        assert_eq!(next(&mut process, others, 11), keys[3]);
        process.removed();
        keys.push(next(&mut record(), others, 11));
        keys.push(ReaderRecord::of(&role, 0, Reliability::BestEffort).next(
            ours,
            "rt/a",
            &dds_type,
            &qos(10),
        ));
        for (place, key) in keys.iter().enumerate() {
            assert!((0x80..=0xbf).contains(&key[0]), "{key:?}");
            assert!(!keys[..place].contains(key), "{keys:?}");
        }
    }
}
