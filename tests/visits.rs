//! Subscribers of the critical lane that join and leave at 1 kHz, a hundred of them, on this network and
//! behind 100 ms of delay: no other subscriber misses or repeats a sample, a VOLATILE visitor begins with the
//! present, a TRANSIENT_LOCAL one with its history and without a gap behind it.

mod support;

use support::bed::{Bed, CRITICAL, INPUT, outputs};
use support::impairment::Impairment;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const RATE_HZ: f64 = 1_000.0;
const VISITS: usize = 100;
/// Visitors that are there at the same time.
const AT_ONCE: usize = 4;
/// Of the history that a lane keeps for late joiners.
const DEPTH: u64 = 50;
const DELAY: &str = "--level clean --delay-ms 100 --jitter-ms 0 --seed 24";
/// rclpy takes half a second to start, and Cyclone DDS a fifth of it: most visitors are C++ programs.
const VISITORS: [Library; 8] = [
    Library::Cyclone,
    Library::Fast,
    Library::Fast,
    Library::Cyclone,
    Library::Cyclone,
    Library::Fast,
    Library::Fast,
    Library::Rclpy,
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Durability {
    Volatile,
    TransientLocal,
}

fn peer(library: Library, node: &str) -> Peer {
    match library {
        Library::Rclpy => Peer::rclpy(node),
        other => Peer::on(other),
    }
}

fn visitor(bed: &Bed, library: Library, durability: Durability) -> RunningPeer {
    let peer = peer(library, "visitor").keep_last(4_000);
    let peer = if durability == Durability::TransientLocal { peer.transient_local() } else { peer };
    bed.subscribe("slow", peer, CRITICAL)
}

/// Starts [`AT_ONCE`] visitors; half of them leave in due form, the others are killed. Of a lane that keeps
/// its history two of three visitors want it.
fn visit(bed: &Bed, lane: Durability, batch: usize, published: &RunningPeer) {
    let before = published.received();
    let visitors: Vec<_> = (0..AT_ONCE)
        .map(|place| {
            let number = batch * AT_ONCE + place;
            let wants = if number.is_multiple_of(3) { Durability::Volatile } else { lane };
            (number, wants, visitor(bed, VISITORS[number % VISITORS.len()], wants))
        })
        .collect();
    for (number, wants, mut visitor) in visitors {
        visitor.wait_received(DEPTH + 10);
        // Neighbours in the list are not of the same library.
        if (number / 2).is_multiple_of(2) {
            visitor.kill9();
            continue;
        }
        let received: Received = visitor.end();
        received.assert_sound();
        assert_eq!(received.missing_count, 0, "a gap, {wants:?} visitor {number}: {received:?}");
        let oldest = if wants == Durability::TransientLocal { before.saturating_sub(DEPTH) } else { before };
        assert!(received.first >= Some(oldest), "{wants:?} visitor {number} after {before}: {received:?}");
    }
}

fn visits(test: &str, lane: Durability, delay: Option<&str>) {
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let durability = if lane == Durability::TransientLocal { "TRANSIENT_LOCAL" } else { "VOLATILE" };
    let yaml = format!(
        "topics:\n  - {{id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
         max_sample_bytes: 65536, qos_overrides: {{critical: {{durability: {durability}, depth: {DEPTH}}}}}}}\n\
         lanes:\n  critical: {{queue_depth: 1024, window_samples: 4096}}\n"
    );
    let Some(bed) = Bed::start(test, &yaml) else { return };
    // What is tested is not whether the machine has time for a hundred programs to start: the lane and the
    // subscribers have room for four seconds.
    let healthy = [Library::Rclpy, Library::Fast, Library::Cyclone]
        .map(|library| bed.subscribe("critical", peer(library, "planner").keep_last(4_000), CRITICAL));
    let publisher = Peer::cyclone().keep_last(4_000).rate_hz(RATE_HZ);
    let publisher = bed.publish(publisher, INPUT);
    healthy[1].wait_received(200);
    let link = delay.map(|delay| Impairment::start(bed.host("slow"), bed.host("bridge"), delay));
    for batch in 0..VISITS / AT_ONCE {
        visit(&bed, lane, batch, &healthy[1]);
    }
    drop(link);

    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "no call of the publisher waited in vain: {sent:?}");
    for subscriber in healthy {
        subscriber.wait_received(sent.ok);
        subscriber.end::<Received>().assert_all_of(&sent);
    }
    let status = bed.wait_whole();
    let critical = outputs(&status).find(|output| output["lane"] == "critical").unwrap();
    assert_eq!(critical["forwarded"], sent.ok, "{critical}");
    println!("{} samples, reader_overrun {}", sent.ok, critical["reader_overrun"]);

    // Now that nothing is written a late joiner gets the history alone, and all of it.
    if lane == Durability::TransientLocal {
        for library in [Library::Rclpy, Library::Fast, Library::Cyclone] {
            let late = visitor(&bed, library, lane);
            late.wait_received(DEPTH);
            let received: Received = late.end();
            received.assert_sound();
            assert_eq!(
                (received.received, received.first, received.last),
                (DEPTH, Some(sent.last + 1 - DEPTH), Some(sent.last)),
                "{library:?}: {received:?}"
            );
        }
    }
    bed.end();
}

#[test]
fn a_hundred_visits_at_1_khz_cost_the_others_no_sample() {
    let test = "a_hundred_visits_at_1_khz_cost_the_others_no_sample";
    visits(test, Durability::Volatile, None);
}

#[test]
fn a_hundred_visits_behind_100_ms_cost_the_others_no_sample() {
    let test = "a_hundred_visits_behind_100_ms_cost_the_others_no_sample";
    visits(test, Durability::Volatile, Some(DELAY));
}

#[test]
fn a_hundred_visits_to_a_history_at_1_khz_cost_the_others_no_sample() {
    let test = "a_hundred_visits_to_a_history_at_1_khz_cost_the_others_no_sample";
    visits(test, Durability::TransientLocal, None);
}

#[test]
fn a_hundred_visits_to_a_history_behind_100_ms_cost_the_others_no_sample() {
    let test = "a_hundred_visits_to_a_history_behind_100_ms_cost_the_others_no_sample";
    visits(test, Durability::TransientLocal, Some(DELAY));
}
