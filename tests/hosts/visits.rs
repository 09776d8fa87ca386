//! A hundred subscribers of the critical lane that join and leave (visitors) while samples flow at 1 kHz,
//! with and without 100 ms of delay. No other subscriber misses or repeats a sample. A VOLATILE visitor
//! receives no history; a TRANSIENT_LOCAL one receives the history and no gap after it.

use support::bed::{Bed, CRITICAL, INPUT, outputs};
use support::impairment::Impairment;
use support::pacer::paced;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const RATE_HZ: f64 = 1_000.0;
const VISITS: usize = 100;
/// Visitors at the same time.
const AT_ONCE: usize = 4;
/// Depth of the history that a lane keeps for late joiners.
const DEPTH: u64 = 50;
const DELAY: &str = "--level clean --delay-ms 100 --jitter-ms 0 --seed 24";
/// The libraries of the visitors. rclpy takes half a second to start, and Cyclone DDS a fifth of that, so
/// that most visitors are C++ programs.
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

/// Starts [`AT_ONCE`] visitors; half of them leave normally, the others are killed. On a TRANSIENT_LOCAL lane
/// two of three visitors are TRANSIENT_LOCAL.
fn visit(bed: &Bed, lane: Durability, batch: usize, published: &RunningPeer, link: &mut Option<Impairment>) {
    let before = published.received();
    let visitors: Vec<_> = (0..AT_ONCE)
        .map(|place| {
            let number = batch * AT_ONCE + place;
            let requested = if number.is_multiple_of(3) { Durability::Volatile } else { lane };
            (number, requested, visitor(bed, VISITORS[number % VISITORS.len()], requested))
        })
        .collect();
    for (number, requested, mut visitor) in visitors {
        visitor.wait_received(DEPTH + 10);
        // Both killed and leaving visitors are of all libraries.
        if (number / 2).is_multiple_of(2) {
            visitor.kill9();
            continue;
        }
        let received: Received = visitor.end();
        received.assert_sound();
        if received.missing_count > 0 {
            let link = link.as_mut().map(Impairment::counters);
            panic!("a gap, {requested:?} visitor {number}: {received:?}, the link: {link:?}");
        }
        let oldest =
            if requested == Durability::TransientLocal { before.saturating_sub(DEPTH) } else { before };
        assert!(
            received.first >= Some(oldest),
            "{requested:?} visitor {number} after {before}: {received:?}"
        );
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
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &yaml) else { return };
    // Starting a hundred programs delays the others on the machine, so that the lane and the subscribers have
    // room for four seconds.
    let healthy = [Library::Rclpy, Library::Fast, Library::Cyclone]
        .map(|library| bed.subscribe("critical", peer(library, "planner").keep_last(4_000), CRITICAL));
    let publisher = Peer::cyclone().keep_last(4_000).rate_hz(RATE_HZ);
    let publisher = bed.publish(publisher, INPUT);
    healthy[1].wait_received(200);
    let mut link = delay.map(|delay| Impairment::start(bed.host("slow"), bed.host("bridge"), delay));
    paced(&publisher, &healthy, 1_000, || {
        for batch in 0..VISITS / AT_ONCE {
            visit(&bed, lane, batch, &healthy[1], &mut link);
        }
    });
    if let Some(link) = link {
        link.end_without_overflow();
    }

    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    for subscriber in healthy {
        subscriber.wait_received(sent.ok);
        subscriber.end::<Received>().assert_all_of(&sent);
    }
    let status = bed.wait_accounted();
    let critical = outputs(&status).find(|output| output["lane"] == "critical").unwrap();
    assert_eq!(critical["forwarded"], sent.ok, "{critical}");
    println!("{} samples, reader_overrun {}", sent.ok, critical["reader_overrun"]);

    // After the last sample a late joiner receives exactly the history.
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

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn a_hundred_visits_with_100_ms_delay_cost_the_others_no_sample() {
        let test = "a_hundred_visits_with_100_ms_delay_cost_the_others_no_sample";
        visits(test, Durability::Volatile, Some(DELAY));
    }

    #[test]
    fn a_hundred_visits_to_a_transient_local_lane_at_1_khz_cost_the_others_no_sample() {
        let test = "a_hundred_visits_to_a_transient_local_lane_at_1_khz_cost_the_others_no_sample";
        visits(test, Durability::TransientLocal, None);
    }

    #[test]
    fn a_hundred_visits_to_a_transient_local_lane_with_100_ms_delay_cost_the_others_no_sample() {
        let test = "a_hundred_visits_to_a_transient_local_lane_with_100_ms_delay_cost_the_others_no_sample";
        visits(test, Durability::TransientLocal, Some(DELAY));
    }
}
