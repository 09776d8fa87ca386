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
fn a_restarted_critical_lane_takes_from_the_backlog_what_its_queue_has_lost() {
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
        assert_eq!(take_all(&mut output), (11..=130).collect::<Vec<_>>());
        assert_eq!(output.counters.get().drops.total(), 0);
        // It has caught up.
        publish(&host, 131..=200);
        assert_eq!(take_all(&mut output), (137..=200).collect::<Vec<_>>());
        assert_eq!(output.counters.get().drops.total(), 6);
    }
}

#[test]
fn samples_that_waited_for_a_lane_wait_until_those_before_are_sent() {
    let mut host = Host::start(158, CRITICAL, SCAN);
    let mut output = host.open();
    host.publish_next(1);
    let most = output.offer.window_samples as i64 / 2;
    for number in 1..=most {
        output.unsent.push(unsent(number));
    }
    assert!(output.take().is_none() && output.is_paced());
    output.unsent.pop_sent(1);
    assert_eq!(take_all(&mut output), [1]);
    assert!(!output.is_paced());
    // Not for longer than a second after the hold, and not once it has caught up.
    output.unsent.push(unsent(most + 1));
    host.publish_next(2);
    output.may_be_behind = true;
    output.former_readers = FormerReaders::of(&OutputReaders::default(), MonotonicNs(0));
    assert_eq!(take_all(&mut output), [2]);
    output.former_readers = FormerReaders::of(&OutputReaders::default(), clock::monotonic());
    host.publish_next(3);
    assert!(!output.may_be_behind);
    assert_eq!(take_all(&mut output), [3]);
}
