//! The account of an output, with real shared memory and a real DDS writer.

mod catch_up;
mod former;
mod late_joiners;
mod missing;

use super::*;
use crate::config::DropPolicy;
use crate::dds::{RawReader, ReaderQos};
use crate::model::{
    Encapsulation, FixedText, KeyedPayload, MAX_UNMATCHED_READERS, Reliability, RouteInfo, SampleHeader,
    SampleKey,
};
use crate::process::role::participant_options;
use crate::process::test_role::{self, SCAN, TYPE, wait_until};
use crate::shm::{BacklogKeeper, SamplePublisher};

/// A sample that the lane may begin to send before it is complete.
const LARGE: usize = 1 << 20;
/// The DDS topic of the critical lane's first output.
const OUTPUT: &str = "rt/adaptive_bridge/critical/scan";
/// The lanes by their number.
const CRITICAL: usize = 0;
const NONCRITICAL: usize = 1;

/// A lane's process, and the channel from which the first output takes samples.
struct Host {
    participant: Participant,
    publisher: SamplePublisher,
    arena: CopyArena,
    role: Role,
    lane: usize,
    settings: Settings,
    _folder: tempfile::TempDir,
}

impl Host {
    fn start(domain_id: u16, lane: usize, yaml: &str) -> Self {
        let (folder, role, settings) = test_role::open(ProcessRole::Egress(lane), "egress", domain_id, yaml);
        let options = participant_options(&settings, &settings.lanes[lane].network, "egress");
        let participant = Participant::open(&options).unwrap();
        let publisher = SamplePublisher::create(&role.node, &RouteChannel::of(&settings, 0)).unwrap();
        Self { participant, publisher, arena: CopyArena::new(), role, lane, settings, _folder: folder }
    }

    /// What keeps samples of the route for a lane that restarts.
    fn keeper(&self) -> BacklogKeeper {
        let channel = RouteChannel::of(&self.settings, 0);
        let board = self.role.boards.backlog_writer(0);
        BacklogKeeper::open(&self.role.node, &channel, &self.publisher, 1 << 20, board).unwrap().unwrap()
    }

    fn open(&mut self) -> Output {
        let output = &self.settings.lanes[self.lane].outputs[0];
        let lane = &self.settings.lanes[self.lane];
        let queue = Output::open_queue(&self.role.node, &self.settings, lane, output.route).unwrap();
        Output::open(&self.role, &mut self.participant, &self.settings, self.lane, output, queue).unwrap()
    }

    /// Changes what ingress publishes of the route.
    fn announce(&self, change: impl FnOnce(&mut RouteInfo)) {
        self.role.boards.route_info_writer(0).update(change);
    }

    fn announce_type(&self) {
        self.announce(|info| info.dds_type = FixedText::new(TYPE));
    }

    fn publish(&self, header: SampleHeader, bytes: usize) {
        self.publisher.copy_in(&vec![7; bytes]).unwrap().publish(header).unwrap();
    }

    /// Publishes a small sample now.
    fn publish_next(&self, sequence: u64) {
        self.publish(header(sequence), 8);
    }

    fn send(&mut self, output: &mut Output) {
        // A lane that catches up may wait for acknowledgements.
        let mut taken = None;
        wait_until("a sample", || {
            taken = output.take();
            taken.is_some()
        });
        let sample = taken.unwrap();
        output.send(sample, &mut self.participant, &mut self.arena);
    }

    fn subscribe(&self, durability: Durability) -> Subscriber {
        self.subscribe_with(Reliability::Reliable, durability)
    }

    fn subscribe_with(&self, reliability: Reliability, durability: Durability) -> Subscriber {
        let options = participant_options(&self.settings, &self.settings.lanes[self.lane].network, "reader");
        let mut participant = Participant::open(&options).unwrap();
        let qos = ReaderQos { reliability, durability, depth: 16, deadline_ms: None };
        let reader = participant.create_reader(OUTPUT, TYPE, &qos).unwrap();
        Subscriber { reader, qos, participant }
    }
}

struct Subscriber {
    reader: RawReader,
    qos: ReaderQos,
    participant: Participant,
}

impl Subscriber {
    /// Creates another reader of the same participant.
    fn add_reader(&mut self) -> RawReader {
        self.participant.create_reader(OUTPUT, TYPE, &self.qos).unwrap()
    }
}

fn header(sequence: u64) -> SampleHeader {
    SampleHeader {
        sequence,
        published_at: clock::monotonic(),
        writer_guid: Guid([1; 16]),
        encapsulation: Encapsulation::CDR_LE,
        ..SampleHeader::default()
    }
}

fn keyed(sequence: u64) -> SampleHeader {
    SampleHeader { key: SampleKey::new(Some([3; 16]), 0, KeyedPayload::Data), ..header(sequence) }
}

/// Waits until the output has so many readers.
fn wait_readers(output: &mut Output, readers: u64) {
    wait_until("the readers match", || {
        output.follow_matching(clock::monotonic());
        output.counters.get().readers == readers
    });
}

fn dropped(output: &Output, reason: DropReason) -> u64 {
    output.counters.get().drops.get(reason)
}

fn unsent(number: i64) -> Forwarded {
    let written_at = clock::monotonic();
    Forwarded { number, bytes: 7, by_reference: false, caught_up: false, written_at }
}

#[test]
fn what_a_killed_process_held_is_counted_as_lost_with_it() {
    let mut host = Host::start(130, CRITICAL, SCAN);
    host.role.boards.lane_writer(CRITICAL, 0).update(|counters| {
        (counters.first_sequence, counters.last_sequence) = (10, 30);
        (counters.forwarded, counters.waiting, counters.readers) = (5, 12, 2);
        counters.drops.add(DropReason::Stopped, 3);
    });
    let output = host.open();
    let counters = host.role.boards.lane(CRITICAL, 0).unwrap();
    assert_eq!(counters.drops.get(DropReason::LaneDown), 12);
    assert_eq!((counters.waiting, counters.readers), (0, 0));
    assert!(counters.is_accounted_for());
    assert_eq!((output.tracker.first(), output.tracker.last()), (10, 30));
}

#[test]
fn a_gap_has_the_reason_of_the_mode_and_of_the_drop_policy() {
    let mut host = Host::start(132, NONCRITICAL, SCAN);
    let mut output = host.open();
    let Forwarding::Limited(mut rates) = host.settings.lanes[NONCRITICAL].forwarding.clone() else {
        panic!()
    };
    for (drop_policy, reason) in
        [(DropPolicy::DropOldest, DropReason::Superseded), (DropPolicy::DropStale, DropReason::QueueFull)]
    {
        rates.normal.drop_policy = drop_policy;
        output.set_forwarding(&Forwarding::Limited(rates));
        for (mode, reason) in [
            (LaneMode::Stopped, DropReason::Stopped),
            (LaneMode::Suspended, DropReason::Suspended),
            (LaneMode::Degraded, reason),
            (LaneMode::Normal, reason),
        ] {
            output.set_mode(mode);
            assert_eq!(output.gap_reason, reason, "{mode}");
        }
    }
}

#[test]
fn a_configured_type_is_announced_at_the_start_except_for_a_place() {
    let message_type = "message_type: std_msgs/msg/UInt8MultiArray";
    let yaml = format!("topics: [{{id: scan, input_topic: /scan, {message_type}}}]");
    let mut host = Host::start(133, CRITICAL, &yaml);
    let output = host.open();
    assert!(output.writer.is_some() && !output.has_keys());
    drop(output);
    host.announce(|info| info.has_keys = 1);
    let output = host.open();
    assert!(output.writer.is_some() && output.has_keys());

    let yaml = format!("topics: [{{id: any, input_topic: /a/**, max_routes: 1, {message_type}}}]");
    let mut host = Host::start(134, CRITICAL, &yaml);
    assert!(host.open().writer.is_none());
}

#[test]
fn samples_wait_until_they_are_sent_or_the_lane_ends() {
    let mut host = Host::start(135, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    let counted = |output: &Output| (output.counters.get().forwarded, output.counters.get().waiting);
    assert!(!output.count_sent());
    output.set_queued(2);
    assert_eq!(counted(&output), (0, 2));
    // One that was sent, and one that never is.
    output.unsent.push(unsent(0));
    output.unsent.push(unsent(i64::MAX));
    assert!(output.count_sent());
    assert_eq!(counted(&output), (1, 3));
    assert!(output.count_sent());
    output.set_queued(3);
    assert_eq!(counted(&output), (1, 4));
    output.tracker.record(5);
    output.set_queued(3);
    assert_eq!((output.counters.get().first_sequence, output.counters.get().last_sequence), (4, 5));
    output.shut_down();
    assert_eq!((counted(&output), dropped(&output, DropReason::Shutdown)), ((1, 3), 1));
    output.unsent.push(unsent(0));
    assert!(!output.count_sent());
    assert_eq!(counted(&output), (2, 3));
}

#[test]
fn a_payload_is_passed_by_reference_while_one_borrow_stays_free() {
    let mut host = Host::start(136, CRITICAL, SCAN);
    let mut output = host.open();
    let least = output.by_reference_min_bytes;
    assert!(output.may_pass_by_reference(least) && !output.may_pass_by_reference(least - 1));
    output.history = Some(History::new(None));
    assert!(!output.may_pass_by_reference(least));
    output.history = None;
    let most = output.subscriber.max_borrowed();
    let mut taken = Vec::new();
    for sequence in 1..=most as u64 {
        host.publish_next(sequence);
        taken.push(output.take().unwrap());
        assert_eq!(output.may_pass_by_reference(least), taken.len() < most, "{}", taken.len());
    }
}

/// A sample of which ingress has received the half.
fn half(number: u64, (pool, pool_offset): (FixedText, u64)) -> PartialSample {
    PartialSample {
        number,
        writer_guid: Guid([1; 16]),
        writer_sequence: number as i64,
        began_at: clock::monotonic().plus_ms(60_000),
        pool_offset,
        len: LARGE as u64,
        available: LARGE as u64 / 2,
        encapsulation: Encapsulation::CDR_LE,
        pool,
        ..PartialSample::default()
    }
}

/// Shows a partial sample on the board, and returns how many were begun and withdrawn by now.
fn follow(host: &Host, output: &mut Output, partial: PartialSample) -> (u64, u64) {
    host.role.boards.partial_writer(0).update(|board| *board = partial);
    output.read_progress();
    output.follow_progress();
    (output.counters.get().begun_early, output.counters.get().withdrawn)
}

#[test]
fn a_sample_is_begun_early_unless_something_may_hold_it_up() {
    let mut host = Host::start(137, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    let mut number = 0;
    let place = host.publisher.lend(LARGE).unwrap().place();
    let mut begins = |output: &mut Output| {
        number += 1;
        output.withdraw_early();
        let before = output.counters.get().begun_early;
        follow(&host, output, half(number, place)).0 > before
    };
    assert!(!begins(&mut output), "no reader");
    output.counters.update(|counters| counters.readers = 1);
    assert!(begins(&mut output));

    output.history = Some(History::new(None));
    assert!(!begins(&mut output), "the writer may have to send it again");
    output.history = None;
    output.has_keys = true;
    assert!(!begins(&mut output), "the sample has a key");
    output.has_keys = false;
    output.durability.set(Durability::TransientLocal);
    assert!(!begins(&mut output), "the writer is replaced");
    output.durability.set(Durability::Volatile);
    output.set_mode(LaneMode::Stopped);
    assert!(!begins(&mut output), "the lane is stopped");
    output.set_mode(LaneMode::Normal);
    let mut board = OutputReaders::default();
    board.former[0] = Guid([9; 16]);
    output.former_readers = FormerReaders::of(&board, clock::monotonic());
    assert!(!begins(&mut output), "a former reader has not matched");
    output.former_readers = FormerReaders::default();
    output.is_held = true;
    assert!(!begins(&mut output), "samples before it wait for former readers");
    (output.is_held, output.is_paced) = (false, true);
    assert!(!begins(&mut output), "samples before it wait for acknowledgements");
    output.is_paced = false;
    assert!(begins(&mut output));
}

#[test]
fn samples_that_were_begun_early_are_completed_from_their_slot_or_withdrawn() {
    let mut host = Host::start(138, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    output.counters.update(|counters| counters.readers = 1);
    // What was begun and withdrawn.
    let mut expected = (0, 0);
    // The number of the sample on the board, the bytes and the publisher's number of the next one that the
    // lane takes, and the number that the board has as the last one taken.
    for (number, bytes, writer_sequence, taken_number, is_completed) in [
        (1, LARGE, 1, 1, true),
        (2, LARGE, 2, 1, false),
        (3, LARGE, 99, 3, false),
        (4, LARGE / 2, 4, 4, false),
        (5, LARGE, 5, 5, true),
    ] {
        let mut slot = host.publisher.lend(LARGE).unwrap();
        slot.payload_mut().fill(7);
        let partial = half(number, slot.place());
        expected.0 += 1;
        assert_eq!(follow(&host, &mut output, partial), expected);
        let header = SampleHeader { writer_sequence, ..header(number) };
        match bytes {
            LARGE => drop(slot.into_slot().publish(header).unwrap()),
            bytes => host.publish(header, bytes),
        }
        host.role.boards.partial_writer(0).update(|board| board.taken_number = taken_number);
        host.send(&mut output);
        expected.1 += u64::from(!is_completed);
        assert_eq!(output.counters.get().withdrawn, expected.1, "{number}");
    }

    // The next one on the board, another ingress, and a mode that drops all withdraw it.
    let place = host.publisher.lend(LARGE).unwrap().place();
    assert_eq!(follow(&host, &mut output, half(6, place)), (6, 3));
    assert_eq!(follow(&host, &mut output, half(7, place)), (7, 4));
    output.housekeeping(&mut host.participant, clock::monotonic());
    assert_eq!(output.counters.get().withdrawn, 4);
    host.role.boards.health_writer(ProcessRole::Ingress).update(|health| health.starts += 1);
    output.housekeeping(&mut host.participant, clock::monotonic());
    assert_eq!(output.counters.get().withdrawn, 5);
    output.counters.update(|counters| counters.readers = 1);
    assert_eq!(follow(&host, &mut output, half(8, place)), (8, 5));
    output.housekeeping(&mut host.participant, clock::monotonic());
    assert_eq!(output.counters.get().withdrawn, 5);
    output.set_mode(LaneMode::Stopped);
    assert_eq!(output.counters.get().withdrawn, 6);
}

#[test]
fn a_sample_follows_the_type_and_the_durability_that_are_on_the_board_before_it() {
    let mut host = Host::start(139, CRITICAL, SCAN);
    let mut output = host.open();
    let without_writer = |output: &Output| dropped(output, DropReason::NoWriter);
    let without_reader = |output: &Output| dropped(output, DropReason::NoReader);
    host.publish_next(1);
    host.send(&mut output);
    assert_eq!((without_writer(&output), without_reader(&output)), (1, 0));
    host.announce_type();
    host.publish_next(2);
    host.send(&mut output);
    assert_eq!((without_writer(&output), without_reader(&output)), (1, 1));
    host.announce(|info| info.transient_local = 1);
    host.publish(SampleHeader { writer_guid: Guid([2; 16]), ..header(3) }, 8);
    let sample = output.take().unwrap();
    assert_eq!(output.durability.get(), Durability::TransientLocal);
    output.send(sample, &mut host.participant, &mut host.arena);
    assert_eq!(output.offer.qos.durability, Durability::TransientLocal);
    host.announce(|info| info.has_keys = 1);
    host.publish(keyed(4), 8);
    host.send(&mut output);
    assert!(output.has_keys());
    assert_eq!((without_writer(&output), without_reader(&output)), (1, 3));
    host.publish_next(5);
    host.send(&mut output);
    assert_eq!((without_writer(&output), without_reader(&output)), (2, 3));
    output.set_mode(LaneMode::Stopped);
    host.publish(keyed(6), 8);
    host.send(&mut output);
    assert_eq!(dropped(&output, DropReason::Stopped), 1);
    assert!(output.counters.get().is_accounted_for(), "{:?}", output.counters.get());
}

#[test]
fn a_sample_counts_as_forwarded_when_it_was_sent_to_all_that_have_to_get_it() {
    let mut host = Host::start(140, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    let _subscriber = host.subscribe(Durability::Volatile);
    wait_readers(&mut output, 1);
    let started = output.started_at;
    let counted = |output: &Output| (output.counters.get().forwarded, output.counters.get().caught_up);
    host.publish(SampleHeader { published_at: MonotonicNs(started.0 - 1), ..header(1) }, 8);
    host.send(&mut output);
    assert_eq!(counted(&output), (1, 1));
    host.publish(SampleHeader { published_at: started, ..header(2) }, 8);
    host.send(&mut output);
    assert_eq!(counted(&output), (2, 1));

    // A former reader has not matched; then it has, and no housekeeping has seen it.
    let second = host.subscribe(Durability::Volatile);
    let mut board = OutputReaders::default();
    board.former[0] = second.reader.guid();
    board.former[1] = Guid([9; 16]);
    output.former_readers = FormerReaders::of(&board, clock::monotonic());
    host.publish_next(3);
    host.send(&mut output);
    assert_eq!((counted(&output), dropped(&output, DropReason::NoReader)), ((2, 1), 1));
    output.former_readers.matched(Guid([9; 16]));
    let mut last = 3;
    wait_until("the second reader matches", || {
        last += 1;
        host.publish_next(last);
        host.send(&mut output);
        output.counters.get().forwarded == 3
    });
    assert!(output.counters.get().is_accounted_for());

    // Another thread of the library sends the fragments of a large one, mostly later.
    output.set_queued(2);
    let has_waited = (1..=50).any(|number| {
        host.publish(header(last + number), 4 * LARGE);
        host.send(&mut output);
        let (forwarded, waiting) = (output.counters.get().forwarded, output.counters.get().waiting);
        assert_eq!(forwarded + waiting, 3 + number + 2, "{:?}", output.counters.get());
        wait_until("the sample is sent", || !output.count_sent());
        assert_eq!((output.counters.get().forwarded, output.counters.get().waiting), (3 + number, 2));
        waiting == 3
    });
    assert!(has_waited);
}

#[test]
fn readers_that_request_more_are_on_the_board_until_they_are_gone() {
    let mut host = Host::start(141, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    let strict = [(); 2].map(|()| host.subscribe(Durability::TransientLocal));
    wait_until("both are known", || {
        output.follow_matching(clock::monotonic());
        output.unmatched.len() == 2
    });
    let _fitting = host.subscribe(Durability::Volatile);
    wait_readers(&mut output, 1);
    output.record_readers(clock::monotonic());
    let board = host.role.boards.output_readers(CRITICAL, 0).unwrap();
    let [one, other] =
        strict.each_ref().map(|subscriber| (subscriber.reader.guid(), UnmatchedPolicy::Durability));
    let unmatched: Vec<_> = board.unmatched().collect();
    assert_eq!((board.iter().count(), unmatched.len()), (1, 2));
    assert!(unmatched.contains(&one) && unmatched.contains(&other), "{unmatched:?}");
    output.forget_unmatched(|reader| reader == one.0);
    assert_eq!(output.unmatched, [other]);

    // Those beyond the room on the board are not kept. One that changes gives up its place first.
    let third = host.subscribe(Durability::TransientLocal);
    let changed = (third.reader.guid(), UnmatchedPolicy::Reliability);
    let others = (0..MAX_UNMATCHED_READERS as u8).map(|number| (Guid([number + 10; 16]), changed.1));
    output.unmatched = others.chain([changed]).collect();
    wait_until("it has changed", || {
        output.follow_matching(clock::monotonic());
        !output.unmatched.contains(&changed)
    });
    assert_eq!(output.unmatched.len(), MAX_UNMATCHED_READERS);
}

#[test]
fn only_what_a_former_process_forwarded_is_written_again() {
    let yaml =
        "topics: [{id: scan, input_topic: /scan, qos_overrides: {critical: {durability: TRANSIENT_LOCAL}}}]";
    let mut host = Host::start(142, CRITICAL, yaml);
    host.announce_type();
    host.role.boards.lane_writer(CRITICAL, 0).update(|counters| {
        (counters.last_sequence, counters.forwarded) = (3, 3);
    });
    let mut output = host.open();
    let former = MonotonicNs(output.started_at.0 - 1);
    host.publish(SampleHeader { published_at: former, ..keyed(1) }, 8);
    host.publish(SampleHeader { published_at: former, ..header(2) }, 8);
    host.publish(SampleHeader { published_at: former, ..header(3) }, 8);
    host.publish(SampleHeader { published_at: former, ..header(4) }, 8);
    assert_eq!(output.take().unwrap().header().sequence, 4);
    assert!(!output.caught_up);
    // Writes one more, and returns how many were written before.
    let written = |output: &Output| {
        let payload = Bytes::from_static(&[0; 8]);
        let writer = output.writer.as_ref().unwrap();
        writer.write(payload, Encapsulation::CDR_LE, header(0).source_timestamp).unwrap().sequence - 1
    };
    assert_eq!(written(&output), 2, "the first one has a key, and the writer is one without");
    host.publish_next(5);
    assert_eq!(output.take().unwrap().header().sequence, 5);
    assert!(output.caught_up);
    host.publish_next(2);
    assert!(output.take().is_none());
    assert_eq!(written(&output), 3);
}

#[test]
fn samples_of_a_critical_lane_wait_for_the_former_readers() {
    let former = Guid([9; 16]);
    let mut board = OutputReaders::default();
    board.former[0] = former;
    let latched =
        "topics: [{id: scan, input_topic: /scan, qos_overrides: {critical: {durability: TRANSIENT_LOCAL}}}]";
    for (domain, lane, yaml, holds) in
        [(144, CRITICAL, SCAN, true), (145, CRITICAL, latched, false), (146, NONCRITICAL, SCAN, false)]
    {
        let mut host = Host::start(domain, lane, yaml);
        host.announce_type();
        host.role.boards.output_readers_writer(lane, 0).set(board);
        let mut output = host.open();
        // Far from its end, however long this test is held up.
        output.former_readers = FormerReaders::of(&board, clock::monotonic().plus_ms(60_000));
        host.publish_next(1);
        assert_eq!((output.take().is_none(), output.is_held()), (holds, holds), "{yaml}");
        if holds {
            output.former_readers.matched(former);
            assert_eq!((output.take().unwrap().header().sequence, output.is_held()), (1, false));
            (output.former_readers, output.is_held) = (FormerReaders::of(&board, MonotonicNs(0)), true);
            host.publish_next(2);
            assert_eq!(output.take().unwrap().header().sequence, 2, "they have not matched in time");
        }
    }
}

#[test]
fn a_critical_lane_leaves_out_what_is_too_old_to_catch_up_with() {
    let mut host = Host::start(147, CRITICAL, SCAN);
    let mut output = host.open();
    output.catch_up = CatchUp::of_critical(256, [], MonotonicNs(0).plus_ms(100_000));
    host.role.boards.ingress_writer(0).update(|ingress| ingress.published = 20);
    let published = |ms| MonotonicNs(0).plus_ms(ms);
    // When the sample was published, its number, the LIFESPAN, and whether it is too old. Each was taken at
    // the boot of the machine.
    for (published_at, sequence, lifespan_ms, is_too_old) in [
        (published(90_000), 12, None, false),
        (published(89_999), 12, None, true),
        (published(0), 13, None, false),
        (published(90_000), 20, Some(1), true),
        (published(90_000), 20, Some(u64::MAX), false),
    ] {
        output.offer.qos.lifespan_ms = lifespan_ms;
        let header = SampleHeader { published_at, ..header(sequence) };
        let header = SampleHeader { taken_at: MonotonicNs(0), ..header };
        assert_eq!(output.is_too_old(&header), is_too_old, "{published_at:?} {sequence} {lifespan_ms:?}");
    }
    output.offer.qos.lifespan_ms = None;
    let oldest = SampleHeader { published_at: published(0), ..header(1) };
    assert!(output.is_too_old(&oldest));
    output.history = Some(History::new(None));
    assert!(!output.is_too_old(&oldest), "late joiners may need it");
    output.history = None;
    output.catch_up.end([]);
    assert!(!output.is_too_old(&oldest), "the lane is not behind");
}
