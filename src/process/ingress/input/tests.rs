//! The account of a route's input and its readers, with real shared memory and real DDS.

use std::time::Duration;

use bytes::Bytes;

use super::*;
use crate::dds::{Payload, RawWriter};
use crate::model::{Encapsulation, MAX_PUBLISHERS, QosProfile, SampleKey, SourceTimestamp, TypeHash};
use crate::policy::Location;
use crate::process::ingress::prepared::PreparedPools;
use crate::process::role::participant_options;
use crate::process::test_role::{self, SCAN, TYPE, wait_until};
use crate::shm::ProcessRole;

const RELIABLE: Reliability = Reliability::Reliable;
const BEST_EFFORT: Reliability = Reliability::BestEffort;
const ONE: Guid = Guid([1; 16]);
const TWO: Guid = Guid([4; 16]);

/// The process of ingress.
struct Host {
    participant: Participant,
    role: Role,
    settings: Settings,
    _folder: tempfile::TempDir,
}

impl Host {
    fn start(domain_id: u16, yaml: &str) -> Self {
        let (folder, role, settings) = test_role::open(ProcessRole::Ingress, "ingress", domain_id, yaml);
        let participant =
            Participant::open(&participant_options(&settings, &settings.input, "ingress")).unwrap();
        Self { participant, role, settings, _folder: folder }
    }

    fn open(&self) -> Input {
        let (node, boards) = (&self.role.node, &self.role.boards);
        let publisher = PreparedPools::None.finish(node, &self.settings).unwrap().remove(0);
        let pool = Input::open_pool(node, boards, &self.settings, 0, publisher).unwrap();
        Input::open(&self.role, &self.settings, 0, &ArrivalFlag::passive(), pool)
    }

    fn housekeeping(&mut self, input: &mut Input) {
        input.housekeeping(&mut self.participant, clock::monotonic()).unwrap();
    }

    fn counters(&self) -> IngressCounters {
        self.role.boards.ingress(0).unwrap()
    }

    fn info(&self) -> RouteInfo {
        self.role.boards.route_info(0).unwrap()
    }

    /// Creates a publisher with a node of its own.
    fn publisher(&self, qos: &QosProfile) -> (RawWriter, Participant) {
        let options = participant_options(&self.settings, &self.settings.input, "publisher");
        let mut participant = Participant::open(&options).unwrap();
        (participant.create_writer("rt/scan", TYPE, qos, 64).unwrap(), participant)
    }
}

fn endpoint(guid: Guid, reliability: Reliability, durability: Durability) -> Endpoint {
    Endpoint {
        guid,
        topic: "rt/scan".to_owned(),
        dds_type: TYPE.to_owned(),
        type_hash: TypeHash([6; 32]),
        reliability,
        durability,
        location: Location::default(),
    }
}

fn reliable(guid: Guid) -> Endpoint {
    endpoint(guid, RELIABLE, Durability::Volatile)
}

fn origin(writer: Guid, sequence: i64) -> SampleOrigin {
    SampleOrigin { source_timestamp: SourceTimestamp::NONE, writer, sequence, key: SampleKey::NONE }
}

fn filled(input: &mut Input) -> Filled {
    input.pool.fill(Payload::Bytes(Bytes::from_static(&[7; 10])))
}

/// Publishes 10 bytes; returns whether that was done.
fn publish(input: &mut Input, writer: Guid, sequence: i64) -> bool {
    let filled = filled(input);
    matches!(input.publish(filled, Encapsulation::CDR_LE, &origin(writer, sequence)), Step::Published)
}

#[test]
fn the_lanes_that_follow_a_sample_are_the_critical_ones_of_its_route() {
    let yaml = "topics: [{id: a, input_topic: /a}, {id: b, input_topic: /b, lanes: [noncritical]}]";
    let host = Host::start(150, yaml);
    let lanes = [0, 1].map(|route| critical_lanes(&host.role, &host.settings, route).len());
    assert_eq!(lanes, [1, 0]);
}

#[test]
fn each_sample_is_counted_by_what_became_of_it() {
    let host = Host::start(151, SCAN);
    let mut input = host.open();
    assert!(publish(&mut input, ONE, 1));
    assert!(!publish(&mut input, ONE, 1), "repeated");
    assert!(publish(&mut input, ONE, 5));
    let in_place = Filled { in_place: true, ..filled(&mut input) };
    input.publish(in_place, Encapsulation::CDR_LE, &origin(ONE, 6));
    let counters = host.counters();
    assert_eq!((counters.received, counters.received_bytes, counters.published), (3, 30, 3));
    assert_eq!((counters.in_place, counters.repeated, counters.lost_upstream), (1, 1, 3));
    assert_eq!(host.role.boards.publisher(0, 0).unwrap().repeated, 1);

    for (number, (error, reason)) in [
        (LoanError::TooLarge { len: 9, max: 8 }, DropReason::TooLarge),
        (LoanError::NoMemory(NoMemory::Quota), DropReason::OverQuota),
        (LoanError::NoMemory(NoMemory::Budget), DropReason::OverBudget),
        (LoanError::NoMemory(NoMemory::FileSystem), DropReason::ShmFull),
        (LoanError::PoolExhausted, DropReason::PoolExhausted),
    ]
    .into_iter()
    .enumerate()
    {
        let filled = Filled { slot: Err(error), bytes: 9, in_place: false };
        input.publish(filled, Encapsulation::CDR_LE, &origin(ONE, 7 + number as i64));
        let counters = host.counters();
        assert_eq!(counters.drops.get(reason), 1, "{error}");
        assert_eq!((counters.received, counters.published), (4 + number as u64, 3));
    }
    assert_eq!(host.counters().received_bytes, 30 + 5 * 9);

    // The last one finds no account free.
    for number in 1..=MAX_PUBLISHERS as u8 {
        assert!(publish(&mut input, Guid([100 + number; 16]), 1));
    }
    let counters = host.counters();
    assert_eq!((counters.unmarked, counters.published), (1, 3 + MAX_PUBLISHERS as u64));
}

#[test]
fn a_sample_of_an_undefined_encapsulation_is_malformed() {
    let mut host = Host::start(152, SCAN);
    let mut input = host.open();
    input.writer_found(&reliable(ONE));
    host.housekeeping(&mut input);
    let (writer, _publisher) = host.publisher(&QosProfile::CRITICAL);
    wait_until("the reader matches", || writer.matched_readers().next().is_some());
    let payload = Bytes::from_static(&[7; 8]);
    for encapsulation in [Encapsulation([0x77, 0x77, 0, 0]), Encapsulation::CDR_LE] {
        writer.write(payload.clone(), encapsulation, SourceTimestamp::NONE).unwrap();
    }
    wait_until("both arrive", || {
        input.step();
        host.counters().published == 1
    });
    let counters = host.counters();
    assert_eq!((counters.received, counters.drops.get(DropReason::Malformed)), (2, 1));
    wait_until("the publisher is counted", || {
        host.housekeeping(&mut input);
        host.counters().writers == 1
    });
}

#[test]
fn only_writers_of_the_topic_are_followed_until_they_are_gone() {
    let host = Host::start(153, SCAN);
    let mut former = host.open();
    assert!(publish(&mut former, ONE, 1));
    drop(former);
    let mut input = host.open();
    input.source_changed = false;
    input.writer_found(&Endpoint { topic: "rt/other".to_owned(), ..reliable(TWO) });
    assert_eq!((input.source_changed, input.source.reliability_of(TWO)), (false, None));
    input.writer_found(&reliable(ONE));
    input.writer_found(&reliable(TWO));
    assert_eq!((input.source_changed, input.source.reliability_of(ONE)), (true, Some(RELIABLE)));

    // The first one wrote to the former process, and is expected to go on.
    assert!(input.publishers.expected() != 0);
    input.participant_gone(TWO.prefix());
    assert!(input.source_changed && input.publishers.expected() != 0);
    input.source_changed = false;
    input.participant_gone(ONE.prefix());
    assert!(input.source_changed && input.publishers.expected() == 0);
    assert_eq!([ONE, TWO].map(|writer| input.source.reliability_of(writer)), [None; 2]);
    input.source_changed = false;
    input.participant_gone(ONE.prefix());
    assert!(!input.source_changed, "it was gone before");
    input.writer_found(&reliable(ONE));
    assert!(input.publishers.expected() != 0, "it is there again");
    input.source_changed = false;
    input.writer_gone(ONE);
    assert!(input.source_changed && input.publishers.expected() == 0);
}

#[test]
fn readers_come_with_the_first_publisher_of_their_kind_and_a_reliable_one_stays() {
    let mut host = Host::start(154, SCAN);
    let mut input = host.open();
    let readers = |input: &Input| -> Vec<_> {
        input.readers.iter().map(|(reliability, reader)| (*reliability, reader.idle)).collect()
    };
    host.housekeeping(&mut input);
    assert!(input.has_topic() && !input.is_connected() && readers(&input).is_empty());
    let best_effort = endpoint(TWO, BEST_EFFORT, Durability::Volatile);
    for (writer, expected) in [(reliable(ONE), vec![RELIABLE]), (best_effort, vec![BEST_EFFORT, RELIABLE])] {
        input.writer_found(&writer);
        host.housekeeping(&mut input);
        let mut found: Vec<_> = readers(&input).into_iter().map(|(reliability, _)| reliability).collect();
        found.sort_by_key(|reliability| *reliability == RELIABLE);
        assert_eq!(found, expected);
        assert!(input.is_connected() && input.readers.values().all(|reader| !reader.has_keys));
    }
    assert_eq!(input.inbox.readers().len(), 2);
    for gone in [ONE, TWO] {
        input.writer_gone(gone);
        host.housekeeping(&mut input);
    }
    assert_eq!(readers(&input), [(RELIABLE, true)]);
    assert!(!input.is_connected() && input.inbox.readers().len() == 1);
    input.close();
    assert!(input.readers.is_empty() && input.inbox.readers().is_empty());
}

#[test]
fn a_reader_is_replaced_only_if_another_one_receives_more() {
    use Durability::{TransientLocal, Volatile};
    let mut host = Host::start(155, SCAN);
    let mut input = host.open();
    let qos = |durability| ReaderQos { reliability: RELIABLE, durability, depth: 8, deadline_ms: None };
    let guid = |input: &mut Input, host: &mut Host, durability| {
        input.update_reader(&mut host.participant, RELIABLE, TYPE, Some(qos(durability))).unwrap();
        let reader = &input.readers[&RELIABLE];
        assert!(!reader.idle);
        reader.guid
    };
    for (present, idle, required, stays) in [
        (Volatile, false, Volatile, true),
        (Volatile, true, Volatile, true),
        (Volatile, false, TransientLocal, true),
        (Volatile, true, TransientLocal, false),
        (TransientLocal, false, Volatile, false),
        (TransientLocal, true, Volatile, false),
        (TransientLocal, false, TransientLocal, true),
        (TransientLocal, true, TransientLocal, true),
    ] {
        input.remove_reader(&mut host.participant, RELIABLE);
        let before = guid(&mut input, &mut host, present);
        input.readers.get_mut(&RELIABLE).unwrap().idle = idle;
        let after = guid(&mut input, &mut host, required);
        assert_eq!(after == before, stays, "{present:?} {idle} {required:?}");
    }
    let before = guid(&mut input, &mut host, TransientLocal);
    input.info.update(|info| info.has_keys = 1);
    assert_ne!(guid(&mut input, &mut host, TransientLocal), before, "one with keys matches no other");
    assert!(input.readers[&RELIABLE].has_keys);
    input.update_reader(&mut host.participant, RELIABLE, TYPE, None).unwrap();
    assert!(input.readers[&RELIABLE].idle);
    input.close();
}

#[test]
fn a_publisher_that_both_readers_match_counts_once() {
    let mut host = Host::start(156, SCAN);
    let mut input = host.open();
    let active = |writers| ActiveReader {
        guid: Guid::default(),
        has_keys: false,
        qos: ReaderQos {
            reliability: RELIABLE,
            durability: Durability::Volatile,
            depth: 8,
            deadline_ms: None,
        },
        writers,
        idle: false,
    };
    input.writer_found(&endpoint(ONE, BEST_EFFORT, Durability::Volatile));
    assert_eq!(input.matched_writers(), 0);
    // RELIABLE publishers came before there was a reader for them.
    input.readers.insert(BEST_EFFORT, active(3));
    assert_eq!(input.matched_writers(), 3);
    input.readers.insert(RELIABLE, active(2));
    assert_eq!(input.matched_writers(), 2 + 1);
    input.readers.clear();
    host.housekeeping(&mut input);
    input.close();
}

/// The samples of a RELIABLE publisher, beside a BEST_EFFORT one that comes before or after it, arrive once.
#[test]
fn two_readers_take_no_sample_twice() {
    for (domain_id, order) in [(157, [RELIABLE, BEST_EFFORT]), (158, [BEST_EFFORT, RELIABLE])] {
        let mut host = Host::start(domain_id, SCAN);
        let mut input = host.open();
        let mut publishers = Vec::new();
        for reliability in order {
            let (writer, participant) = host.publisher(&QosProfile { reliability, ..QosProfile::CRITICAL });
            input.writer_found(&endpoint(writer.guid(), reliability, Durability::Volatile));
            host.housekeeping(&mut input);
            wait_until("the reader matches", || writer.matched_readers().next().is_some());
            publishers.push((writer, participant));
        }
        let reliable = order.iter().position(|reliability| *reliability == RELIABLE).unwrap();
        let (writer, _) = &publishers[reliable];
        wait_until("both readers match", || {
            host.housekeeping(&mut input);
            input.readers[&RELIABLE].writers == 1 && writer.matched_readers().count() == 2
        });
        // The readers of this route keep 16 samples that are not taken.
        for round in 1..=5 {
            for _ in 0..10 {
                let sample = Bytes::from_static(&[7; 8]);
                writer.write(sample, Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
                std::thread::sleep(Duration::from_millis(2));
            }
            wait_until("all arrive", || {
                input.step();
                host.counters().received == 10 * round && matches!(input.step(), Step::Empty)
            });
        }
        assert_eq!((host.counters().published, host.counters().repeated), (50, 0), "{order:?}");
        input.close();
    }
}

#[test]
fn the_board_has_what_the_publishers_announce_also_when_they_are_gone() {
    let yaml = "topics: [{id: scan, input_topic: /scan, message_type: std_msgs/msg/UInt8MultiArray}]";
    let mut host = Host::start(159, yaml);
    let mut input = host.open();
    let keyed = Guid([2; 16]);
    for (durability, transient_local) in [(Durability::Volatile, 0), (Durability::TransientLocal, 1)] {
        input.writer_found(&endpoint(keyed, RELIABLE, durability));
        host.housekeeping(&mut input);
        let info = host.info();
        assert_eq!((info.dds_type.as_str(), info.type_hash), (TYPE, TypeHash([6; 32])));
        assert_eq!((info.has_keys, info.transient_local), (1, transient_local));
    }
    input.writer_gone(keyed);
    host.housekeeping(&mut input);
    let info = host.info();
    assert_eq!((info.has_keys, info.transient_local, info.type_hash), (1, 1, TypeHash([6; 32])));
    input.close();
}

#[test]
fn a_place_has_no_reader_before_its_topic_and_leaves_it_for_the_next() {
    let yaml = "topics: [{id: any, input_topic: /a/**, max_routes: 1, message_type: \
                std_msgs/msg/UInt8MultiArray, qos_overrides: {input: {reliability: RELIABLE, durability: VOLATILE}}}]";
    let mut host = Host::start(160, yaml);
    let mut input = host.open();
    host.housekeeping(&mut input);
    assert!(!input.has_topic() && input.readers.is_empty());
    assert_eq!((input.bound(), host.info()), (None, RouteInfo::default()));
    for (count, name, after) in [(1, "/a/x", 0), (2, "/a/y", 2)] {
        let topic = TopicName::try_from(name).unwrap();
        input.bind(&mut host.participant, &topic);
        assert!(input.has_topic() && input.readers.is_empty() && input.source_changed);
        host.housekeeping(&mut input);
        let info = host.info();
        assert_eq!((info.bound_topic.as_str(), info.bound_count, info.bound_after), (name, count, after));
        assert!(!info.dds_type.as_str().is_empty() && input.is_connected());
        assert_eq!(input.bound(), Some((topic, 0)));
        assert!(publish(&mut input, ONE, after as i64 + 1) && publish(&mut input, ONE, after as i64 + 2));
        assert_eq!(input.bound().unwrap().1, 2);
    }
    input.close();
}
