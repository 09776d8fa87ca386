//! A lane that restarts receives what ingress keeps for it, as fast as its readers can.

use super::*;
use crate::shm::BacklogKeeper;

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
        let channel = RouteChannel::of(&host.settings, 0);
        let board = host.role.boards.backlog_writer(0);
        let keeper = BacklogKeeper::open(&host.role.node, &channel, &host.publisher, 1 << 20, board);
        let mut keeper = keeper.unwrap().unwrap();
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
        publish(&host, 301..=400);
        assert_eq!(take_all(&mut output), (337..=400).collect::<Vec<_>>());
        assert_eq!(output.counters.get().drops.total(), 36);
    }
}

#[test]
fn samples_wait_until_the_library_has_sent_those_before() {
    let mut host = Host::start(158, CRITICAL, SCAN);
    host.announce_type();
    let mut output = host.open();
    output.catch_up.end();
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
    // Large ones count by their bytes.
    output.unsent.clear();
    host.publish_next(3);
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
        output.catch_up.is_on(clock::monotonic)
    };
    assert!(take(&mut output, 1), "a lane that starts");
    assert!(output.take().is_none());
    let burst = output.catch_up.burst_samples();
    assert!(!take(&mut output, burst - 1));
    assert!(output.take().is_none());
    assert!(!take(&mut output, 1), "the queue was empty before");
    assert!(take(&mut output, burst - 1));
    assert!(output.take().is_none());
    assert!(!output.catch_up.is_on(clock::monotonic));
}
