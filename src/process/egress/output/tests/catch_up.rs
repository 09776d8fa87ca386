//! A lane that restarts receives what ingress keeps for it, as fast as its readers can.

use super::*;
use crate::model::ReaderRecord;

/// Takes all samples that wait.
fn take_all(output: &mut Output) -> Vec<u64> {
    let mut sequences = Vec::new();
    while let Some(sample) = output.take() {
        assert_eq!(sample.payload(), [7; 8]);
        sequences.push(sample.header().sequence);
    }
    sequences
}

#[test]
fn a_critical_lane_takes_from_the_backlog_what_its_queue_has_lost() {
    for (domain, lane) in [(156, CRITICAL), (157, NONCRITICAL)] {
        let mut host = Host::start(domain, lane, SCAN);
        let mut keeper = host.keeper();
        let mut publish = |host: &Host, sequences: std::ops::RangeInclusive<u64>| {
            for sequence in sequences {
                host.publish_next(sequence);
                keeper.keep_published();
            }
        };
        host.role.boards.lane_writer(lane, 0).update(|counters| {
            (counters.first_sequence, counters.last_sequence, counters.forwarded) = (1, 10, 10);
        });
        // The channel retains 8 samples, and the queue of the lane has room for 64.
        publish(&host, 1..=30);
        let mut output = host.open();
        publish(&host, 31..=130);
        if lane == NONCRITICAL {
            assert_eq!(take_all(&mut output).len(), output.subscriber.queue_depth());
            continue;
        }
        assert_eq!(take_all(&mut output), (11..=130).collect::<Vec<_>>(), "after a restart");
        publish(&host, 131..=300);
        assert_eq!(take_all(&mut output), (131..=300).collect::<Vec<_>>(), "after a stall");
        assert_eq!(output.counters.get().drops.total(), 0);
        // A lane that stays behind goes on with its queue.
        output.catch_up = CatchUp::of_critical(256, [], MonotonicNs(0));
        (0..=20).for_each(|turn| output.catch_up.turn(|| MonotonicNs(0).plus_ms(100 * turn)));
        publish(&host, 301..=400);
        assert_eq!(take_all(&mut output), (337..=400).collect::<Vec<_>>());
        assert_eq!(output.counters.get().drops.total(), 36);
    }
}

#[test]
fn a_lane_that_has_never_run_takes_what_the_channel_retains() {
    let mut host = Host::start(170, CRITICAL, SCAN);
    let mut keeper = host.keeper();
    for sequence in 1..=30 {
        host.publish_next(sequence);
        keeper.keep_published();
    }
    let mut output = host.open();
    host.publish_next(31);
    assert_eq!(take_all(&mut output), (23..=31).collect::<Vec<_>>());
}

#[test]
fn samples_wait_until_the_library_has_sent_those_before() {
    let mut host = Host::start(158, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    output.catch_up.end([]);
    host.publish_next(1);
    for number in 1..=output.offer.window_samples as i64 / 2 {
        output.unsent.push(unsent(number));
    }
    assert!(output.take().is_none() && output.is_paced());
    output.unsent.pop_sent(1);
    assert_eq!(take_all(&mut output), [1]);
    assert!(!output.is_paced());

    // It has sent them since the last turn, in which another output kept the lane busy.
    host.publish_next(2);
    output.unsent.clear();
    for _ in 0..output.offer.window_samples / 2 {
        output.unsent.push(unsent(0));
    }
    assert_eq!(take_all(&mut output), [2]);
    // Only the first of them.
    host.publish_next(3);
    output.unsent.clear();
    for number in 0..output.offer.window_samples as i64 / 2 {
        output.unsent.push(unsent(number));
    }
    assert_eq!(take_all(&mut output), [3]);
    // Large ones count by their bytes.
    output.unsent.clear();
    host.publish_next(4);
    for number in 1..=4 {
        assert!(!output.is_to_be_paced(), "{number}");
        output.unsent.push(Forwarded { bytes: 4 << 20, ..unsent(number) });
    }
    assert!(output.take().is_none() && output.is_paced());
}

#[test]
fn a_lane_that_takes_many_samples_in_a_row_catches_up() {
    let mut host = Host::start(166, CRITICAL, SCAN);
    let mut output = host.open();
    let mut taken = 0;
    let mut take = |output: &mut Output, count: u64| {
        (taken + 1..=taken + count).for_each(|sequence| host.publish_next(sequence));
        taken += count;
        for _ in 0..count {
            output.take().unwrap();
        }
        output.catch_up.is_on()
    };
    assert!(take(&mut output, 1), "a lane that starts");
    assert!(output.take().is_none());
    let burst = output.offer.window_samples as u64 / 4;
    assert!(!take(&mut output, burst - 1));
    assert!(output.take().is_none());
    assert!(!take(&mut output, 1), "the queue was empty before");
    assert!(take(&mut output, burst - 1));
    assert!(output.take().is_none());
    assert!(!output.catch_up.is_on());
}

/// Sets how many samples wait for the output, and the first one that ingress keeps of the 100 before them.
fn set_waiting(host: &Host, output: &mut Output, waiting: u64, first_kept: u64) {
    output.tracker = SequenceTracker::resume(1, 100);
    host.role.boards.ingress_writer(0).update(|ingress| ingress.published = 100 + waiting);
    host.role.boards.backlog_writer(0).update(|backlog| backlog.first_sequence = first_kept);
}

#[test]
fn a_lane_does_not_wait_until_samples_are_lost() {
    let mut host = Host::start(167, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    assert_eq!(output.subscriber.queue_depth(), 64);
    let mut board = OutputReaders::default();
    board.former[0] = Guid([9; 16]);
    let behind = ReaderRecord { reliable: 1, unacknowledged: 1_000, ..ReaderRecord::default() };
    // Far from their end, however long this test is held up.
    let far = clock::monotonic().plus_ms(60_000);
    output.former_readers = FormerReaders::of(&board, far);
    output.catch_up = CatchUp::of_critical(output.offer.window_samples, [], far);
    for _ in 0..output.offer.window_samples {
        output.catch_up.wrote(1);
    }
    for (waiting, first_kept, are_nearly_lost) in
        [(55, 0, false), (56, 0, true), (56, 1, false), (56, 68, false), (56, 69, true)]
    {
        set_waiting(&host, &mut output, waiting, first_kept);
        let what = format!("{waiting} {first_kept}");
        assert_eq!(output.are_samples_nearly_lost(), are_nearly_lost, "{what}");
        assert_eq!(output.waits_for_any([behind].into_iter()), !are_nearly_lost, "{what}");
        for readers in [0, 1] {
            output.counters.update(|counters| counters.readers = readers);
            // No reader has matched, so a sample that the lane sends reaches none.
            assert_eq!(output.is_still_held(), readers == 0 || !are_nearly_lost, "{what} {readers}");
        }
    }
}

#[test]
fn a_lane_that_catches_up_waits_for_readers_that_lack_samples() {
    let mut host = Host::start(168, CRITICAL, SCAN);
    let mut output = host.open();
    let lacks = |unacknowledged| ReaderRecord { reliable: 1, unacknowledged, ..ReaderRecord::default() };
    let best_effort = ReaderRecord { reliable: 0, ..lacks(1_000) };
    // Of a former process, each sample that is not counted yet.
    let lack_former = |output: &Output| {
        [lacks(0), lacks(1), best_effort].map(|reader| output.lack_former([lacks(0), reader].into_iter()))
    };
    assert_eq!(lack_former(&output), [false; 3]);
    output.unsent.push(unsent(1));
    assert_eq!(lack_former(&output), [false, true, false]);

    // Of its own, half of what the writer retains.
    let half = output.offer.window_samples as u64 / 2;
    output.catch_up =
        CatchUp::of_critical(output.offer.window_samples, [], clock::monotonic().plus_ms(60_000));
    for _ in 0..half {
        output.catch_up.wrote(1);
    }
    let waits = |output: &Output| {
        [lacks(half - 1), lacks(half), best_effort]
            .map(|reader| output.waits_for_any([lacks(0), reader].into_iter()))
    };
    assert_eq!(waits(&output), [false, true, false]);
    output.history = Some(History::new(None));
    assert_eq!(waits(&output), [false; 3], "a history needs no wait");
    output.history = None;
    output.catch_up.end([]);
    assert_eq!(waits(&output), [false; 3], "the lane is not behind");
}
