//! What a process leaves to the next one, with real boards, and when the next one takes it.

use super::super::join;
use super::*;
use crate::process::role::participant_options;
use crate::process::test_role::{self, SCAN, TYPE};
use crate::shm::ProcessRole;

const LANE: usize = 0;
const DDS_TYPE: DdsType<'static> =
    DdsType { name: TYPE, hash: crate::model::TypeHash::UNKNOWN, has_keys: false };

fn record(role: &Role) -> WriterRecord {
    WriterRecord {
        board: role.boards.writer_identity_writer(LANE, 0),
        log: role.boards.send_log(LANE, 0),
        route: 0,
        writing: Arc::default(),
        is_first: true,
        may_continue: true,
    }
}

#[test]
fn a_writer_continues_the_numbers_of_the_former_process_if_it_is_the_same_writer() {
    let (_folder, role, ..) = test_role::open(ProcessRole::Egress(LANE), "egress", 71, SCAN);
    let (ours, others) = (Guid([1; 16]), Guid([2; 16]));
    let (qos, other_qos) =
        (QosProfile::CRITICAL, QosProfile { deadline_ms: Some(5), ..QosProfile::CRITICAL });
    let next = |record: &mut WriterRecord, participant, topic, qos| {
        record.next(participant, topic, &DDS_TYPE, qos).continuation
    };

    let first = next(&mut record(&role), ours, "rt/a", &qos);
    assert_eq!(first.highest_number, 0);
    for number in 1..=41 {
        (first.on_number)(number, true);
    }
    // The process was killed. Each record is that of a next process.
    let second = next(&mut record(&role), ours, "rt/a", &qos);
    assert_eq!((second.key, second.highest_number), (first.key, 41));
    (second.on_number)(42, true);
    let third = next(&mut record(&role), ours, "rt/a", &qos);
    assert_eq!((third.key, third.highest_number), (first.key, 42));

    // Another participant, topic or QoS is another writer.
    let mut keys = vec![first.key];
    for (participant, topic, qos) in
        [(others, "rt/a", &qos), (others, "rt/b", &qos), (others, "rt/b", &other_qos), (ours, "rt/a", &qos)]
    {
        let other = next(&mut record(&role), participant, topic, qos);
        assert_eq!(other.highest_number, 0, "{topic}");
        assert!(!keys.contains(&other.key), "{topic}");
        (other.on_number)(7, true);
        keys.push(other.key);
    }

    // So is the next one of the same process, and of the next process, after a goodbye.
    let mut process = record(&role);
    let continued = next(&mut process, ours, "rt/a", &qos);
    assert_eq!(continued.highest_number, 7);
    let again = next(&mut process, ours, "rt/a", &qos);
    assert_eq!(again.highest_number, 0);
    assert_ne!(again.key, continued.key);
    process.removed();
    let after = next(&mut record(&role), ours, "rt/a", &qos);
    assert_ne!(after.key, again.key);

    // A number that no process writes.
    role.boards.send_log(LANE, 0).record(i64::MIN, 1);
    assert_eq!(next(&mut record(&role), ours, "rt/a", &qos).highest_number, 0);
}

#[test]
fn readers_are_told_of_a_writer_that_is_not_continued() {
    let (_folder, role, settings) = test_role::open(ProcessRole::Egress(LANE), "egress", 75, SCAN);
    let ours = Guid([1; 16]);
    let next = |mut record: WriterRecord, qos| record.next(ours, "rt/a", &DDS_TYPE, qos);
    let (qos, other) = (QosProfile::CRITICAL, QosProfile { deadline_ms: Some(5), ..QosProfile::CRITICAL });
    let first = next(record(&role), &qos);
    assert_eq!((first.superseded, next(record(&role), &qos).superseded), (None, None));
    let second = next(record(&role), &other);
    assert_eq!(second.superseded, Some(first.continuation.key));
    // An output whose writers are never continued.
    let third = next(WriterRecord { may_continue: false, ..record(&role) }, &other);
    assert_eq!((third.superseded, third.continuation.highest_number), (Some(second.continuation.key), 0));
    // Those of another participant are gone with that one; and one has said goodbye itself.
    assert_eq!(next(WriterRecord { is_first: false, ..record(&role) }, &qos).superseded, None);
    let mut process = record(&role);
    process.next(ours, "rt/a", &DDS_TYPE, &qos);
    process.removed();
    assert_eq!(next(record(&role), &qos).superseded, None);

    let output = &settings.lanes[LANE].outputs[0];
    assert!(may_be_continued(&role, output));
    let latched = QosProfile { durability: Durability::TransientLocal, ..output.qos };
    assert!(may_be_continued(&role, &Output { qos: latched, ..output.clone() }));
    let best_effort = QosProfile { reliability: Reliability::BestEffort, ..latched };
    assert!(!may_be_continued(&role, &Output { qos: best_effort, ..output.clone() }));
    role.boards.route_info_writer(0).update(|info| info.transient_local = 1);
    assert!(!may_be_continued(&role, &Output { latched_qos: Some(best_effort), ..output.clone() }));
    role.boards.route_info_writer(0).update(|info| info.transient_local = 0);
    assert!(may_be_continued(&role, &Output { latched_qos: Some(best_effort), ..output.clone() }));
    role.boards.route_info_writer(0).update(|info| info.has_keys = 1);
    assert!(!may_be_continued(&role, output));
}

#[test]
fn the_log_has_the_last_samples_that_were_written() {
    let (_folder, role, ..) = test_role::open(ProcessRole::Egress(LANE), "egress", 73, SCAN);
    let log = role.boards.send_log(LANE, 0);
    let mut process = record(&role);
    let writer = process.next(Guid([1; 16]), "rt/a", &DDS_TYPE, &QosProfile::CRITICAL).continuation;
    for number in 1..=300 {
        process.writing(number as u64 * 2);
        // Of each tenth number only the beginning was sent.
        (writer.on_number)(number, number % 10 != 0);
    }
    let logged = record(&role).logged();
    let expected = (46..=300).filter(|number| number % 10 != 0).map(|number| (number, number as u64 * 2));
    assert_eq!(logged, expected.collect::<Vec<_>>());
    assert!(process.logged().is_empty(), "it is the one that has written them");
    // What no process writes.
    for (number, sequence) in [(301, 2), (i64::MIN, 1), (-1, 1), (i64::MAX, 1)] {
        log.record(number, sequence);
        assert!(record(&role).logged().is_empty(), "{number}");
    }
}

#[test]
fn keys_are_those_of_no_other_writer() {
    let keys = [key(0, 1), key(0, 2), key(1, 1), key(1_023, 1), key(1_023, 1_023)];
    for (place, one) in keys.iter().enumerate() {
        assert!((0x80..=0xbf).contains(&one[0]), "{one:?}");
        assert!(!keys[..place].contains(one), "{one:?}");
    }
}

#[test]
fn a_noncritical_lane_keeps_no_identity() {
    let (_folder, mut role, settings) = test_role::open(ProcessRole::Egress(1), "egress", 72, SCAN);
    let options = participant_options(&settings, &settings.lanes[1].network, "egress");
    let (participant, identity) =
        join(&mut role, &settings.lanes[1], ProcessRole::Egress(1), "egress-noncritical", &options).unwrap();
    assert!(identity.is_none());
    assert!(WriterRecord::of(&role, &participant, 1, &settings.lanes[1].outputs[0]).is_none());
}
