//! Late joiners of a BEST_EFFORT, TRANSIENT_LOCAL output.

use super::super::super::late_joiners::{LateJoiners, MAX_WAITING};
use super::*;
use std::collections::BTreeSet;

const YAML: &str = "topics: [{id: scan, input_topic: /scan, qos_overrides: \
                    {critical: {reliability: BEST_EFFORT, durability: TRANSIENT_LOCAL}}}]";

/// The late joiners of the output.
fn waiting(output: &mut Output) -> &mut LateJoiners {
    output.history.as_mut().unwrap().late_joiners.as_mut().unwrap()
}

#[test]
fn a_best_effort_late_joiner_waits_for_the_history_until_it_leaves() {
    let mut host = Host::start(143, CRITICAL, YAML);
    host.announce_type();
    let mut output = host.open();
    let due = |output: &mut Output| {
        waiting(output).next_due(clock::monotonic().plus_ms(60_000), &mut 1).map(|(reader, _)| reader)
    };
    let first = host.subscribe_with(Reliability::BestEffort, Durability::TransientLocal);
    wait_readers(&mut output, 1);
    assert_eq!(due(&mut output), Some(first.reader.guid()));
    let second = host.subscribe_with(Reliability::BestEffort, Durability::TransientLocal);
    wait_readers(&mut output, 2);
    drop(second);
    wait_readers(&mut output, 1);
    assert_eq!(due(&mut output), None);
}

#[test]
fn a_late_joiner_for_which_no_place_is_free_is_counted() {
    let mut host = Host::start(148, CRITICAL, YAML);
    host.announce_type();
    let mut output = host.open();
    let now = clock::monotonic();
    for number in 1..MAX_WAITING {
        assert!(waiting(&mut output).joined(Guid((number as u128).to_be_bytes()), now));
    }
    let unserved = |output: &Output| output.counters.get().late_joiners_unserved;
    let _last_place = host.subscribe_with(Reliability::BestEffort, Durability::TransientLocal);
    wait_readers(&mut output, 1);
    assert_eq!(unserved(&output), 0);
    let _no_place = host.subscribe_with(Reliability::BestEffort, Durability::TransientLocal);
    wait_readers(&mut output, 2);
    assert_eq!(unserved(&output), 1);
}

#[test]
fn more_late_joiners_at_once_than_events_can_wait_are_all_served() {
    const READERS: u64 = 300;
    let mut host = Host::start(173, CRITICAL, YAML);
    host.announce_type();
    let mut output = host.open();
    let mut subscriber = host.subscribe_with(Reliability::BestEffort, Durability::TransientLocal);
    let matched = |output: &Output| output.writer.as_ref().unwrap().matched_readers().count() as u64;
    let mut others = Vec::new();
    for joined in (50..=READERS).step_by(50) {
        // The library refuses a reader while too many others wait for its event loop.
        others.extend((others.len() as u64 + 1..joined).map(|_| subscriber.add_reader()));
        wait_until("the DDS library matches the readers", || matched(&output) == joined);
    }
    output.follow_matching(clock::monotonic());
    assert_eq!(output.counters.get().readers, READERS);
    let mut due = BTreeSet::new();
    while let Some((reader, _)) = waiting(&mut output).next_due(clock::monotonic().plus_ms(60_000), &mut 1) {
        due.insert(reader);
    }
    assert_eq!(due.len() as u64, READERS);

    drop((subscriber, others));
    wait_until("the DDS library forgets the readers", || matched(&output) == 0);
    output.follow_matching(clock::monotonic());
    assert_eq!(output.counters.get().readers, 0);
}
