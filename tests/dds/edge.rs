//! The DDS module of the bridge: two participants of this process exchange samples over real sockets.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::Waker;
use std::time::{Duration, Instant};

use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{
    Arrival, ArrivalFlag, Discovery, DiscoveryTurn, Kept, LentMemory, Participant, ParticipantOptions,
    Payload, RawReader, RawWriter, ReaderEvent, ReaderQos, SampleMemory, Take, TakePayload, WriteError,
    WriterEvent,
};
use adaptive_bridge::model::{
    DdsType, Durability, Encapsulation, Guid, History, KeyedPayload, QosProfile, Reliability, SampleKey,
    SourceTimestamp,
};
use bytes::Bytes;

const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";

fn options<'a>(name: &str, network: &'a DdsNetwork) -> ParticipantOptions<'a> {
    let (namespace, node_name) = ("/adaptive_bridge".into(), name.into());
    ParticipantOptions { network, namespace, node_name, graph_gid_bytes: 16, dscp: 0 }
}

fn participant(name: &str, domain_id: u16) -> Participant {
    Participant::open(&options(name, &DdsNetwork::of_domain(domain_id))).unwrap()
}

fn reader_qos(reliability: Reliability, durability: Durability) -> ReaderQos {
    ReaderQos { reliability, durability, depth: 64, deadline_ms: None }
}

/// Takes one sample. Waits for it for up to 20 s, and checks again only when the reader's waker was called.
fn take_one(reader: &RawReader) -> Option<(Vec<u8>, Encapsulation, SourceTimestamp)> {
    let flag = ArrivalFlag::passive();
    let waker = Waker::from(Arc::clone(&flag));
    let give_up = Instant::now() + Duration::from_secs(20);
    loop {
        reader.arm(&waker);
        let mut taken = None;
        match reader.take(&mut |payload, encapsulation| taken = Some((payload.to_vec(), encapsulation))) {
            Take::Sample(origin) => {
                let (payload, encapsulation) = taken?;
                return Some((payload, encapsulation, origin.source_timestamp));
            }
            Take::Malformed => panic!("malformed"),
            Take::Empty => {}
        }
        while !flag.clear() {
            if Instant::now() > give_up {
                return None;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn wait_for_reader(writer: &RawWriter) {
    let give_up = Instant::now() + Duration::from_secs(20);
    while writer.matched_readers().next().is_none() {
        assert!(Instant::now() < give_up, "no reader was matched");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Waits until the reader has matched a writer. The writer matches the reader earlier, and DDS does not
/// signal to a BEST_EFFORT writer when the reader has matched it.
fn wait_for_writer(reader: &RawReader) {
    let give_up = Instant::now() + Duration::from_secs(20);
    while reader.poll_event() != Some(ReaderEvent::Matched { writers: 1 }) {
        assert!(Instant::now() < give_up, "no writer was matched");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_payload_arrives_bit_for_bit_with_its_encapsulation_and_timestamp() {
    let mut here = participant("here", 70);
    let mut there = participant("there", 70);
    let reader = there
        .create_reader("rt/blob", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/blob", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    let kinds = [[0, 1, 0, 0], [0, 0, 0, 3], [0, 7, 0, 2], [0, 0x0b, 0, 1], [0, 1, 0, 0]];
    for (length, kind) in [0, 4, 2_948, 65_536, 4 << 20].into_iter().zip(kinds) {
        let payload: Vec<u8> = (0..length).map(|at: usize| (at * 7 + length) as u8).collect();
        let timestamp = SourceTimestamp(0x6900_0000_1234_5678 + length as u64);
        writer.write(Bytes::from(payload.clone()), Encapsulation(kind), timestamp).unwrap();
        let (taken, encapsulation, taken_timestamp) = take_one(&reader).expect("nothing arrived");
        assert_eq!(taken.len(), payload.len());
        assert!(taken == *payload, "{length} bytes changed on the way");
        assert_eq!(encapsulation, Encapsulation(kind));
        assert_eq!(taken_timestamp, timestamp);
    }
}

#[test]
fn a_sample_is_announced_before_it_is_received() {
    let (arrived, received) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicUsize::new(0)));
    let expected = Arc::new(Mutex::new(None));
    let on_arriving = {
        let (arrived, expected) = (Arc::clone(&arrived), Arc::clone(&expected));
        move |writer: [u8; 16], sequence: i64, left_bytes: usize| {
            let is_expected = expected.lock().unwrap().is_some_and(|expected| expected == Guid(writer));
            if is_expected {
                arrived.lock().unwrap().push((sequence, left_bytes));
            }
        }
    };
    let on_received = {
        let received = Arc::clone(&received);
        move || {
            received.fetch_add(1, Ordering::AcqRel);
            false
        }
    };
    let network = DdsNetwork::of_domain(69);
    let mut there = Participant::open_receiving(
        &options("there", &network),
        Kept::default(),
        usize::MAX,
        [],
        on_arriving,
        on_received,
    )
    .unwrap();
    let mut here = participant("here", 69);
    let reader = there
        .create_reader("rt/blob", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/blob", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    *expected.lock().unwrap() = Some(writer.guid());
    let send = |length: usize| {
        let payload = Bytes::from(vec![7; length]);
        writer.write(payload, Encapsulation([0, 1, 0, 0]), SourceTimestamp(1)).unwrap();
        assert_eq!(take_one(&reader).expect("nothing arrived").0.len(), length);
    };
    let left_bytes_of = |sequence: i64| {
        let arrived = arrived.lock().unwrap();
        let left: Vec<usize> =
            arrived.iter().filter(|(of, _)| *of == sequence).map(|(_, left)| *left).collect();
        left
    };
    for sequence in 1..=20 {
        send(2_948);
        assert!(left_bytes_of(sequence).contains(&0), "sample {sequence} was not announced");
    }
    // A sample in fragments, each of which is announced with the bytes that are still missing after it.
    send(1 << 20);
    let left = left_bytes_of(21);
    assert!(left.len() > 10 && left.contains(&0), "{left:?}");
    assert!(left.is_sorted_by(|one, next| one >= next) && left[0] > 900_000, "{left:?}");
    assert!(received.load(Ordering::Acquire) > 20);
}

/// Lends memory that is filled with 0xEE, as if by an older sample, and counts the pieces that are lent and
/// not dropped.
#[derive(Default)]
struct Lender {
    lent: Arc<AtomicUsize>,
    refuses: AtomicBool,
}

struct Lent {
    bytes: Vec<u8>,
    lent: Arc<AtomicUsize>,
}

impl SampleMemory for Lender {
    fn lend(&self, len: usize) -> Option<Box<dyn LentMemory>> {
        if self.refuses.load(Ordering::Acquire) {
            return None;
        }
        self.lent.fetch_add(1, Ordering::AcqRel);
        Some(Box::new(Lent { bytes: vec![0xEE; len], lent: Arc::clone(&self.lent) }))
    }
}

impl LentMemory for Lent {
    fn bytes(&mut self) -> &mut [u8] {
        &mut self.bytes
    }

    fn finish(self: Box<Self>) {}
}

impl Drop for Lent {
    fn drop(&mut self) {
        self.lent.fetch_sub(1, Ordering::AcqRel);
    }
}

#[test]
fn a_watch_of_arrivals_sees_samples_and_takes_none() {
    let network = DdsNetwork::of_domain(66);
    // Holds up the receiving thread, so that the watching thread peeks first.
    let hold = Arc::new(Mutex::new(()));
    let on_received = support::waits_for(&hold);
    let mut there = Participant::open_receiving(
        &options("there", &network),
        Kept::default(),
        usize::MAX,
        [],
        |_, _, _| {},
        on_received,
    )
    .unwrap();
    let mut here = participant("here", 66);
    // BEST_EFFORT: a RELIABLE reader would receive a sample again that the watching thread had taken.
    let reader = there
        .create_reader("rt/blob", TYPE, &reader_qos(Reliability::BestEffort, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/blob", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    wait_for_writer(&reader);
    let arrivals = there.arrivals().unwrap();
    let closer = arrivals.closer();
    let (sender, seen) = std::sync::mpsc::channel();
    let watching = std::thread::spawn(move || {
        loop {
            match arrivals.wait() {
                Arrival::Closed => return,
                arrival => sender.send(arrival).unwrap(),
            }
        }
    });
    let mut sequence = 0;
    let is_seen = |sequence| {
        let expected = Arrival::Sample { writer: writer.guid(), sequence, left_bytes: 0 };
        let give_up = Instant::now() + Duration::from_secs(1);
        while let Ok(arrival) = seen.recv_timeout(give_up - Instant::now()) {
            if arrival == expected {
                return true;
            }
        }
        false
    };
    // The watch peeks only at the first of several waiting datagrams, which may be a heartbeat.
    let times = (0..20).filter(|_| {
        let held = hold.lock().unwrap();
        there.ring();
        std::thread::sleep(Duration::from_millis(50));
        writer.write(Bytes::from(vec![7; 2_948]), Encapsulation([0, 1, 0, 0]), SourceTimestamp(1)).unwrap();
        sequence += 1;
        let seen = is_seen(sequence);
        drop(held);
        assert_eq!(take_one(&reader).expect("the watch took it").0.len(), 2_948);
        seen
    });
    assert!(times.count() > 10, "seen too seldom");
    closer.close();
    watching.join().unwrap();
}

#[test]
fn a_fragmented_sample_is_assembled_in_lent_memory() {
    let mut here = participant("here", 68);
    let mut there = participant("there", 68);
    let reader = there
        .create_reader("rt/lent", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let lender = Arc::new(Lender::default());
    let lent = Arc::clone(&lender.lent);
    reader.lend_memory(lender.clone());
    let writer = here.create_writer("rt/lent", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    let pass = |length: usize, refuses: bool| {
        lender.refuses.store(refuses, Ordering::Release);
        let payload: Vec<u8> = (0..length).map(|at| (at * 7 + length) as u8).collect();
        let encapsulation = Encapsulation([0, 1, 0, 3]);
        writer.write(Bytes::from(payload.clone()), encapsulation, SourceTimestamp(5)).unwrap();
        let give_up = Instant::now() + Duration::from_secs(20);
        let mut taken = None;
        while taken.is_none() {
            assert!(Instant::now() < give_up, "nothing arrived");
            match reader.take_payload() {
                TakePayload::Empty => {}
                TakePayload::Malformed => panic!("malformed"),
                TakePayload::Sample(_, received, its_encapsulation) => {
                    assert_eq!(its_encapsulation, encapsulation);
                    taken = Some(match received {
                        Payload::Bytes(bytes) => (bytes.to_vec(), false),
                        Payload::Lent(mut memory) => (memory.bytes().to_vec(), true),
                    });
                }
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        let (bytes, is_lent) = taken.unwrap();
        assert!(bytes == payload, "{length} bytes changed on the way");
        assert_eq!(lent.load(Ordering::Acquire), 0, "all memory came back");
        is_lent
    };
    // A sample of one datagram borrows no memory. A fragmented one is assembled in lent memory, or in that of
    // the library if none is lent.
    assert!(!pass(2_948, false));
    for length in [100_001, 1 << 20, 4 << 20, (4 << 20) - 3] {
        assert!(pass(length, false));
        assert!(!pass(length, true));
    }
    // `take` passes a payload in lent memory as bytes.
    lender.refuses.store(false, Ordering::Release);
    writer.write(Bytes::from(vec![9; 200_000]), Encapsulation([0, 1, 0, 0]), SourceTimestamp(6)).unwrap();
    assert!(take_one(&reader).expect("nothing arrived").0 == vec![9; 200_000]);
    // A sample that is not taken returns its memory when its reader is dropped.
    writer.write(Bytes::from(vec![9; 200_000]), Encapsulation([0, 1, 0, 0]), SourceTimestamp(7)).unwrap();
    let give_up = Instant::now() + Duration::from_secs(20);
    while lent.load(Ordering::Acquire) == 0 {
        assert!(Instant::now() < give_up, "nothing was lent");
        std::thread::sleep(Duration::from_millis(1));
    }
    drop((reader, writer, there, here));
    assert_eq!(lent.load(Ordering::Acquire), 0);
}

#[test]
fn a_writer_reports_the_present_reader_after_many_that_are_gone() {
    let mut here = participant("here", 79);
    let mut there = participant("there", 79);
    let mut writer = there.create_writer("rt/many", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    let qos = reader_qos(Reliability::Reliable, Durability::Volatile);
    let give_up = Instant::now() + Duration::from_secs(20);
    let mut present = None;
    for _ in 0..16 {
        drop(present.take());
        let reader = here.create_reader("rt/many", TYPE, &qos).unwrap();
        while reader.poll_event() != Some(ReaderEvent::Matched { writers: 1 }) {
            assert!(Instant::now() < give_up, "no writer was matched");
            std::thread::sleep(Duration::from_millis(5));
        }
        present = Some(reader);
    }
    // The writer's events were not polled until now. The reader stays, because a reader that is gone before
    // its event is read is not reported.
    let reader = present.unwrap();
    let present = reader.guid();
    let mut events = Vec::new();
    loop {
        match writer.poll_event() {
            Some(WriterEvent::Matched { reader, joined: true, readers: 1, .. }) if reader == present => {
                return;
            }
            Some(event) => events.push(event),
            None => std::thread::sleep(Duration::from_millis(5)),
        }
        assert!(Instant::now() < give_up, "the present reader {present:?} was not reported: {events:#?}");
    }
}

#[test]
fn readers_that_are_gone_are_not_announced_to_a_new_participant() {
    let mut here = participant("here", 81);
    let qos = reader_qos(Reliability::Reliable, Durability::Volatile);
    for _ in 0..16 {
        drop(here.create_reader("rt/gone", TYPE, &qos).unwrap());
    }
    let present = here.create_reader("rt/present", TYPE, &qos).unwrap();
    // The thread of discovery removes them, perhaps only after the newcomer is there.
    std::thread::sleep(Duration::from_millis(300));
    let mut newcomer = participant("newcomer", 81);
    let give_up = Instant::now() + Duration::from_secs(20);
    let mut announced = Vec::new();
    // SEDP announces readers in the order of their creation, so the present one comes last.
    while announced.last() != Some(&present.guid()) {
        assert!(Instant::now() < give_up, "the present reader was not announced");
        match newcomer.poll_discovery(&mut DiscoveryTurn::new(adaptive_bridge::clock::monotonic())) {
            Some(Discovery::Reader(reader)) if reader.topic.starts_with("rt/") => announced.push(reader.guid),
            Some(_) => {}
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    }
    assert_eq!(announced, [present.guid()]);
}

#[test]
fn a_change_that_discovery_reports_ends_the_wait_for_it() {
    let mut here = participant("here", 63);
    let mut there = None;
    loop {
        let mut turn = DiscoveryTurn::new(adaptive_bridge::clock::monotonic());
        let changes: Vec<_> = std::iter::from_fn(|| here.poll_discovery(&mut turn)).collect();
        let is_it =
            |change: &Discovery| matches!(change, Discovery::Writer(writer) if writer.topic == "rt/wakes");
        if changes.iter().any(is_it) {
            return;
        }
        if there.is_none() {
            let mut participant = participant("there", 63);
            let writer = participant.create_writer("rt/wakes", TYPE, &QosProfile::CRITICAL, 1).unwrap();
            there = Some((writer, participant));
        }
        let most = Duration::from_secs(20);
        let began = Instant::now();
        here.wait_for_discovery(most);
        assert!(began.elapsed() < most, "nothing has ended the wait");
    }
}

#[test]
fn a_writer_takes_every_sample_and_the_reader_that_lags_misses_the_oldest() {
    let mut here = participant("here", 71);
    let mut there = participant("there", 71);
    let reader = there
        .create_reader("rt/full", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/full", TYPE, &QosProfile::CRITICAL, 4).unwrap();
    wait_for_reader(&writer);
    let mut written = 0_u16;
    // A reader that has the CPU for itself may keep up with one batch.
    for _ in 0..20 {
        // 200 MiB at once: more than any socket buffer holds, and far more than the writer retains.
        for _ in 0..200 {
            let mut payload = vec![0; 1 << 20];
            payload[..2].copy_from_slice(&written.to_be_bytes());
            let sample = writer.write(payload.into(), Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
            assert_eq!(sample.readers, 1);
            written += 1;
        }
        let mut last = None;
        while last != Some(written - 1) {
            let (payload, ..) = take_one(&reader).expect("the last sample");
            let number = u16::from_be_bytes([payload[0], payload[1]]);
            assert!(last.is_none_or(|last| last < number), "{number} after {last:?}");
            last = Some(number);
        }
        let give_up = Instant::now() + Duration::from_secs(20);
        while writer.matched_readers().any(|reader| reader.unacknowledged > 0) {
            assert!(Instant::now() < give_up, "not acknowledged: {:?}", writer.matched_readers().next());
            std::thread::sleep(Duration::from_millis(10));
        }
        let progress = writer.matched_readers().next().unwrap();
        assert_eq!((progress.reader, progress.offered), (reader.guid(), u64::from(written)));
        if progress.overrun > 0 {
            return;
        }
    }
    panic!("the reader has kept up with {written} samples of 1 MiB: {:?}", writer.matched_readers().next());
}

#[test]
fn a_keep_all_writer_that_may_wait_reports_a_full_window() {
    let mut here = participant("here", 71);
    let mut there = participant("there", 71);
    let qos = reader_qos(Reliability::Reliable, Durability::Volatile);
    let _reader = there.create_reader("rt/full_all", TYPE, &qos).unwrap();
    let keep_all = QosProfile { history: History::KeepAll, ..QosProfile::CRITICAL };
    let writer =
        here.create_blocking_writer("rt/full_all", TYPE, &keep_all, 4, std::time::Duration::ZERO).unwrap();
    wait_for_reader(&writer);
    let payload = Bytes::from(vec![0; 1 << 20]);
    let outcomes =
        (0..200).map(|_| writer.write(payload.clone(), Encapsulation::CDR_LE, SourceTimestamp::NONE));
    let refused = outcomes.filter(|outcome| *outcome == Err(WriteError::WindowFull)).count();
    assert!(refused > 0, "200 MiB were taken with a window of four samples");
}

#[test]
fn a_late_joiner_of_a_best_effort_writer_can_be_given_the_last_sample() {
    let mut here = participant("here", 72);
    let qos = QosProfile { durability: Durability::TransientLocal, ..QosProfile::NONCRITICAL };
    let mut writer = here.create_writer("rt/map", TYPE, &qos, 64).unwrap();
    writer.write(Bytes::from_static(b"a map..."), Encapsulation::CDR_LE, SourceTimestamp(1)).unwrap();
    let mut there = participant("there", 72);
    let reader = there
        .create_reader("rt/map", TYPE, &reader_qos(Reliability::BestEffort, Durability::TransientLocal))
        .unwrap();
    let give_up = Instant::now() + Duration::from_secs(20);
    let joined = loop {
        if let Some(WriterEvent::Matched { reader, joined: true, .. }) = writer.poll_event() {
            break reader;
        }
        assert!(Instant::now() < give_up);
        std::thread::sleep(Duration::from_millis(5));
    };
    wait_for_writer(&reader);
    writer
        .write_to(
            joined,
            Bytes::from_static(b"map again..."),
            Encapsulation::CDR_LE,
            SourceTimestamp(1),
            SampleKey::default(),
        )
        .unwrap();
    assert_eq!(take_one(&reader).unwrap().0, b"map again...");
}

#[test]
fn a_late_joiner_of_a_reliable_transient_local_writer_gets_its_history() {
    let mut here = participant("here", 73);
    let qos = QosProfile {
        durability: Durability::TransientLocal,
        history: History::KeepLast { depth: 1 },
        ..QosProfile::CRITICAL
    };
    let writer = here.create_writer("rt/tf_static", TYPE, &qos, 64).unwrap();
    writer.write(Bytes::from_static(b"kept"), Encapsulation::CDR_LE, SourceTimestamp(1)).unwrap();
    let mut there = participant("there", 73);
    let reader = there
        .create_reader("rt/tf_static", TYPE, &reader_qos(Reliability::Reliable, Durability::TransientLocal))
        .unwrap();
    assert_eq!(take_one(&reader).unwrap().0, b"kept");
}

#[test]
fn a_second_reader_of_a_participant_costs_the_first_no_sample() {
    let (mut here, mut there) = (participant("here", 77), participant("there", 77));
    let writer = here.create_writer("rt/twins", TYPE, &QosProfile::CRITICAL, 1024).unwrap();
    let qos = ReaderQos { depth: 1024, ..reader_qos(Reliability::Reliable, Durability::Volatile) };
    let best_effort = ReaderQos { reliability: Reliability::BestEffort, ..qos };
    let first = there.create_reader("rt/twins", TYPE, &qos).unwrap();
    wait_for_reader(&writer);
    let mut numbers: Vec<u64> = Vec::new();
    let take_all = |numbers: &mut Vec<u64>| {
        let mut lend = |payload: &[u8], _| numbers.push(u64::from_le_bytes(payload[..8].try_into().unwrap()));
        while first.take(&mut lend) != Take::Empty {}
    };
    let stop = AtomicBool::new(false);
    let written = std::thread::scope(|threads| {
        let publisher = threads.spawn(|| {
            let mut number = 0u64;
            while !stop.load(Ordering::Relaxed) {
                // In fragments, so that another thread sends it, some time after it is written.
                let mut payload = vec![0; 100_000];
                payload[..8].copy_from_slice(&number.to_le_bytes());
                writer.write(payload.into(), Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
                number += 1;
                // In bursts: some are yet to be sent when a reader is matched.
                if number.is_multiple_of(8) {
                    std::thread::sleep(Duration::from_millis(8));
                }
            }
            number
        });
        for _ in 0..150 {
            // BEST_EFFORT: the library has one record of what is missing for all RELIABLE readers of a topic.
            let second = there.create_reader("rt/twins", TYPE, &best_effort).unwrap();
            let until = Instant::now() + Duration::from_millis(12);
            while Instant::now() < until {
                take_all(&mut numbers);
                std::thread::sleep(Duration::from_millis(1));
            }
            let guid = second.guid();
            drop(second);
            there.remove_endpoint(guid);
        }
        stop.store(true, Ordering::Relaxed);
        publisher.join().unwrap()
    });
    let give_up = Instant::now() + Duration::from_secs(20);
    while numbers.last() != Some(&(written - 1)) && Instant::now() < give_up {
        take_all(&mut numbers);
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(numbers.iter().copied().eq(0..written), "{} of {written}", numbers.len());
}

/// A payload that sets a flag when it is dropped.
struct Held(Arc<AtomicBool>);

impl AsRef<[u8]> for Held {
    fn as_ref(&self) -> &[u8] {
        &[7; 4096]
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

#[test]
fn what_a_new_writer_writes_at_once_is_sent() {
    let mut here = participant("here", 67);
    let mut there = participant("there", 67);
    // All samples may arrive before the first one is taken.
    let latched = ReaderQos { depth: 256, ..reader_qos(Reliability::Reliable, Durability::TransientLocal) };
    let reader = there.create_reader("rt/latched", TYPE, &latched).unwrap();
    let qos = QosProfile { durability: Durability::TransientLocal, ..QosProfile::CRITICAL };
    let mut expected = BTreeSet::new();
    // 200 writers, so that the event loop is still busy with the discovery of earlier writers when the next
    // one is created and writes.
    let writers: Vec<_> = (0..200_u32)
        .map(|number| {
            let writer = here.create_writer("rt/latched", TYPE, &qos, 64).unwrap();
            let payload = Bytes::copy_from_slice(&number.to_le_bytes());
            writer.write(payload, Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
            expected.insert(number);
            writer
        })
        .collect();
    while !expected.is_empty() {
        let (payload, _, _) = take_one(&reader).unwrap_or_else(|| panic!("never sent: {expected:?}"));
        expected.remove(&u32::from_le_bytes(payload.try_into().unwrap()));
    }
    drop(writers);
}

#[test]
fn an_acknowledged_sample_is_released_before_the_cache_cleaning() {
    let mut here = participant("here", 74);
    let mut there = participant("there", 74);
    let reader = there
        .create_reader("rt/held", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/held", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    let released: Vec<_> = (0..1000).map(|_| Arc::new(AtomicBool::new(false))).collect();
    for flag in &released {
        let payload = Bytes::from_owner(Held(Arc::clone(flag)));
        while writer.write(payload.clone(), Encapsulation::CDR_LE, SourceTimestamp::NONE).is_err() {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(take_one(&reader).is_some());
    }
    // All but the last 64, the window, are acknowledged. The cleaning that comes every 6 s would have
    // released none of them yet, or some on a machine so slow that this took longer.
    let held = released[..936].iter().filter(|flag| !flag.load(Ordering::Acquire)).count();
    assert_eq!(held, 0, "acknowledged samples are still held");
}

#[test]
fn a_new_reader_of_a_topic_does_not_get_what_a_former_one_has_taken() {
    let mut here = participant("here", 75);
    let mut there = participant("there", 75);
    let qos = reader_qos(Reliability::Reliable, Durability::Volatile);
    let former = there.create_reader("rt/again", TYPE, &qos).unwrap();
    let writer = here.create_writer("rt/again", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    let write = |payload: &'static [u8]| {
        writer.write(Bytes::from_static(payload), Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
    };
    write(b"one.");
    assert_eq!(take_one(&former).unwrap().0, b"one.");
    drop(former);
    let reader = there.create_reader("rt/again", TYPE, &qos).unwrap();
    let give_up = Instant::now() + Duration::from_secs(20);
    while !writer.matched_readers().any(|matched| matched.reader == reader.guid()) {
        assert!(Instant::now() < give_up, "the new reader was not matched");
        std::thread::sleep(Duration::from_millis(5));
    }
    write(b"two.");
    assert_eq!(take_one(&reader).unwrap().0, b"two.");
}

#[test]
fn a_process_that_was_stopped_and_continued_goes_on_receiving() {
    let mut here = participant("here", 76);
    let mut there = participant("there", 76);
    let reader = there
        .create_reader("rt/stopped", TYPE, &reader_qos(Reliability::Reliable, Durability::Volatile))
        .unwrap();
    let writer = here.create_writer("rt/stopped", TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    // A stopped process cannot continue itself: a shell stops and continues it.
    let stopped_and_continued = std::process::Command::new("sh")
        .args(["-c", "kill -STOP $0; sleep 0.2; kill -CONT $0", &std::process::id().to_string()])
        .status()
        .unwrap();
    assert!(stopped_and_continued.success());
    for number in 0..10 {
        let payload = Bytes::from(vec![number; 100]);
        writer.write(payload, Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
        assert_eq!(take_one(&reader).expect("nothing arrived").0, vec![number; 100]);
    }
}

/// Takes a sample within 20 s, with its payload and what it says of its key.
fn take_keyed(reader: &RawReader) -> (Vec<u8>, SampleKey) {
    let give_up = Instant::now() + Duration::from_secs(20);
    loop {
        match reader.take_payload() {
            TakePayload::Sample(origin, mut payload, _) => return (payload.bytes().to_vec(), origin.key),
            TakePayload::Malformed => panic!("malformed"),
            TakePayload::Empty => std::thread::sleep(Duration::from_millis(1)),
        }
        assert!(Instant::now() < give_up, "nothing arrived");
    }
}

#[test]
fn what_a_sample_says_of_its_key_passes_unchanged() {
    let (mut here, mut there) = (participant("here", 83), participant("there", 83));
    let mut elsewhere = participant("elsewhere", 83);
    let keyed = DdsType { has_keys: true, ..TYPE.into() };
    let qos = reader_qos(Reliability::Reliable, Durability::Volatile);
    // Of a participant of its own: readers of one topic of a participant share its samples.
    let stock = elsewhere.create_reader("rt/keyed", TYPE, &qos).unwrap();
    let reader = there.create_reader("rt/keyed", keyed, &qos).unwrap();
    let writer = here.create_writer("rt/keyed", keyed, &QosProfile::CRITICAL, 64).unwrap();
    wait_for_reader(&writer);
    assert!(reader.guid().has_keys() && writer.guid().has_keys() && !stock.guid().has_keys());
    let mut sent = Vec::new();
    for hash in [None, Some([7; 16])] {
        // Of one datagram, and of several.
        for length in [12, 200_000] {
            sent.push((vec![1; length], SampleKey::new(hash, 0, KeyedPayload::Data)));
            sent.push((vec![2; length], SampleKey::new(hash, 1, KeyedPayload::Data)));
            sent.push((vec![3; length], SampleKey::new(hash, 2, KeyedPayload::Key)));
            sent.push((vec![4; length], SampleKey::new(hash, 3, KeyedPayload::Key)));
        }
    }
    sent.push((Vec::new(), SampleKey::new(Some([9; 16]), 1, KeyedPayload::Absent)));
    for (payload, key) in &sent {
        let bytes = Bytes::from(payload.clone());
        writer.write_from(None, bytes, Encapsulation::CDR_LE, SourceTimestamp(5), *key).unwrap();
        let (taken, its_key) = take_keyed(&reader);
        assert!(taken == *payload, "{key:?}");
        assert_eq!(its_key, *key);
    }
    // A reader without keys does not match the writer.
    assert_eq!(writer.matched_readers().count(), 1);
    assert!(matches!(stock.take(&mut |_, _| {}), Take::Empty));
}
