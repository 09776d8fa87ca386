//! What a killed process of a lane that keeps its identity leaves to the next one.

use super::*;
use crate::dds::Take;
use crate::model::ProcessIdentity;

/// The next process of the lane continues the participant of this one.
fn keep_identity(host: &mut Host) {
    let identity = ProcessIdentity { participant: host.participant.guid(), ..ProcessIdentity::default() };
    host.role.boards.identity_writer(ProcessRole::Egress(CRITICAL)).set(identity.sealed());
    host.role.former.participant = identity.participant;
}

/// Opens the output of the next process, which collects the samples of the former one.
fn open_next(host: &mut Host) -> Output {
    let mut next = host.open();
    wait_until("the former samples", || {
        host.publisher.connect_subscribers();
        next.collect_former(&mut host.participant, &mut host.arena);
        !next.collects_former()
    });
    next
}

/// The account of processes of a lane that keeps its identity. Each of the first three leaves a sample that
/// is in the log and not counted; the last one has another writer.
#[test]
fn a_killed_process_leaves_its_samples_with_their_numbers() {
    let mut host = Host::start(150, CRITICAL, SCAN);
    host.announce_type();
    keep_identity(&mut host);
    let mut first = host.open();
    for sequence in 11..=14 {
        host.publish_next(sequence);
    }
    for _ in 11..=13 {
        host.send(&mut first);
    }
    assert_eq!(dropped(&first, DropReason::NoReader), 3);
    // Of the fourth one it records the number, begins to send it, and is killed.
    let log = host.role.boards.send_log(CRITICAL, 0);
    log.record(4, 14);
    assert_eq!(log.samples(), [(1, 11), (2, 12), (3, 13), (4, 14)]);
    drop(first);

    let mut second = host.open();
    assert!(second.writer.is_none() && second.take().is_none(), "it collects the samples first");
    wait_until("the former samples", || {
        host.publisher.connect_subscribers();
        second.collect_former(&mut host.participant, &mut host.arena);
        !second.collects_former()
    });
    assert!(second.writer.is_some());
    let counters = *second.counters.get();
    assert_eq!((counters.received(), counters.forwarded, counters.accounted_number), (4, 0, 4));
    assert_eq!(dropped(&second, DropReason::NoReader), 4, "none is lost with the process");
    assert!(counters.is_accounted_for());
    host.publish_next(15);
    assert_eq!(second.take().unwrap().header().sequence, 15);
    host.publish_next(16);
    host.send(&mut second);
    assert_eq!(log.samples().last(), Some(&(5, 16)), "the numbers go on");
    drop(second);

    // The next one was sent by half, and the one after it was not taken from shared memory. A former reader
    // may lack them.
    log.record(6, 0);
    log.record(7, 17);
    host.publish_next(17);
    host.publish_next(18);
    let mut board = OutputReaders::default();
    board.former[0] = Guid([8; 16]);
    host.role.boards.output_readers_writer(CRITICAL, 0).set(board);
    let mut next = open_next(&mut host);
    assert!(next.take().is_none() && next.count_sent(), "the former reader has not matched");
    wait_until("the sample that was not counted", || {
        next.writer.as_ref().is_some_and(|writer| writer.sent_through() == 7)
    });
    next.end_hold();
    assert!(!next.count_sent());
    let counters = *next.counters.get();
    assert_eq!((counters.last_sequence, counters.forwarded, counters.accounted_number), (17, 1, 7));
    assert!(counters.is_accounted_for(), "{counters:?}");
    assert_eq!(dropped(&next, DropReason::LaneDown), 1, "15 was taken and not sent");
    assert_eq!(next.take().unwrap().header().sequence, 18);
    drop(next);

    // Another type is another writer: nothing is repeated, and what was not counted is lost.
    log.record(8, 19);
    host.announce(|info| info.dds_type = FixedText::new("test::msg::dds_::Other_"));
    let mut third = host.open();
    wait_until("the end of the wait", || {
        third.collect_former(&mut host.participant, &mut host.arena);
        !third.collects_former()
    });
    let counters = *third.counters.get();
    assert!(counters.is_accounted_for(), "{counters:?}");
    assert_eq!((counters.last_sequence, counters.waiting, counters.accounted_number), (19, 0, 0));
    assert_eq!((log.highest(), log.samples()), (0, vec![]));
    drop(third);

    // So is that of another participant, also if its type is the same.
    log.record(1, 18);
    host.role.former.participant = Guid([9; 16]);
    assert!(!host.open().collects_former());
}

#[test]
fn a_process_reads_the_samples_of_the_former_one_before_ingress_delivers_them() {
    let mut host = Host::start(169, CRITICAL, SCAN);
    host.announce_type();
    keep_identity(&mut host);
    let mut keeper = host.keeper();
    let mut first = host.open();
    for sequence in 11..=14 {
        host.publish_next(sequence);
        keeper.keep_published();
    }
    for _ in 11..=13 {
        host.send(&mut first);
    }
    host.role.boards.send_log(CRITICAL, 0).record(4, 14);
    drop(first);

    let mut second = host.open();
    assert!(second.collects_former());
    // Ingress has not connected to its queue.
    second.collect_former(&mut host.participant, &mut host.arena);
    assert!(!second.collects_former());
    assert_eq!((dropped(&second, DropReason::NoReader), dropped(&second, DropReason::LaneDown)), (4, 0));
}

#[test]
fn the_writer_of_a_place_is_continued_if_the_place_has_the_same_topic() {
    let mut host = Host::start(174, CRITICAL, "topics: [{id: any, input_topic: /a/**, max_routes: 1}]");
    let bind = |host: &Host, topic, after| {
        host.announce(|info| {
            (info.bound_topic, info.dds_type) = (FixedText::new(topic), FixedText::new(TYPE));
            (info.bound_after, info.bound_count) = (after, info.bound_count + 1);
        });
    };
    let writer = |output: &Output| output.writer.as_ref().unwrap().guid();
    bind(&host, "/a/x", 10);
    keep_identity(&mut host);
    let mut first = host.open();
    let first_writer = writer(&first);
    host.publish_next(11);
    host.send(&mut first);
    drop(first);
    let mut board = OutputReaders::default();
    board.former[0] = Guid([8; 16]);
    host.role.boards.output_readers_writer(CRITICAL, 0).set(board);

    let second = open_next(&mut host);
    assert_eq!((writer(&second), second.former_readers.missing()), (first_writer, &[Guid([8; 16])][..]));
    drop(second);

    // Its readers were readers of the former topic.
    bind(&host, "/a/y", 11);
    let third = open_next(&mut host);
    assert_ne!(writer(&third), first_writer);
    assert!(third.former_readers.is_empty());
    assert!(third.counters.get().is_accounted_for(), "{:?}", third.counters.get());
}

/// The history of a latched output: the last sample of each publisher.
#[test]
fn a_latched_output_is_continued_with_its_history() {
    let yaml = "topics: [{id: scan, input_topic: /scan, retained_samples: 8, \
                qos_overrides: {critical: {durability: TRANSIENT_LOCAL, depth: 1}}}]";
    let mut host = Host::start(175, CRITICAL, yaml);
    host.announce_type();
    keep_identity(&mut host);
    let mut first = host.open();
    let writer = |output: &Output| output.writer.as_ref().unwrap().guid();
    let first_writer = writer(&first);
    for (sequence, publisher) in [(11, 1), (12, 2), (13, 2)] {
        host.publish(SampleHeader { writer_guid: Guid([publisher; 16]), ..header(sequence) }, 8);
        host.send(&mut first);
    }
    drop(first);

    let mut second = open_next(&mut host);
    assert_eq!(writer(&second), first_writer);
    // Ingress may deliver what was read from its backlog.
    host.publish(SampleHeader { published_at: MonotonicNs(second.started_at.0 - 1), ..header(13) }, 8);
    assert!(second.take().is_none());
    let log = host.role.boards.send_log(CRITICAL, 0);
    assert_eq!(log.samples(), [(1, 11), (2, 12), (3, 13)], "none is written again");
    assert!(second.counters.get().is_accounted_for(), "{:?}", second.counters.get());
    let late = host.subscribe(Durability::TransientLocal);
    let mut numbers = Vec::new();
    wait_until("the history", || {
        while let Take::Sample(sample) = late.reader.take(&mut |_, _| {}) {
            numbers.push(sample.sequence);
        }
        numbers == [1, 3]
    });
    drop(second);

    // The last sample is not there when the wait ends, and may come later: it would be written again.
    log.record(4, 14);
    let third = open_next(&mut host);
    assert_ne!(writer(&third), first_writer);
}
