//! Latched topics with the configuration of the tutorial: the outputs follow the publishers' TRANSIENT_LOCAL.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, is_accounted_and_idle, outputs};
use support::bridge::Bridge;
use support::netns::Net;
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::ros;

const MAP: &str = "topics:\n  - id: map\n    input_topic: /map\n";
const OUTPUTS: [&str; 2] = ["rt/adaptive_bridge/critical/map", "rt/adaptive_bridge/noncritical/map"];

/// A publisher of a latched topic, which publishes `samples` from `first` on as soon as it is up, or matched.
fn publisher(node: &str, first: u64, samples: u64) -> Peer {
    let peer = Peer::rclpy(node).publisher().topic("rt/map").transient_local().keep_last(1);
    peer.first_seq(first).count(samples).rate_hz(20.0).linger_s(600.0)
}

fn late_joiners(bed: &Bed) -> [RunningPeer; 2] {
    OUTPUTS.map(|topic| {
        let peer = Peer::rclpy("late").subscriber().topic(topic).transient_local().keep_last(100);
        peer.start_on(bed.host("critical"))
    })
}

/// Fourteen publishers in one process, as of a robot's static transforms, which publish one sample each, all
/// at once. The first of them publishes another one at [`RunningPeer::go`].
fn static_publishers(bed: &Bed) -> RunningPeer {
    let peer = publisher("static_transforms", 0, 15).rate_hz(0.0).option("--writers", 14);
    peer.hold().option("--hold-after", 14).start_on(bed.host("publisher"))
}

/// Waits until both lanes have handled so many samples.
fn wait_handled(bed: &Bed, samples: u64) {
    bed.bridge.wait_status("all samples handled by both lanes", |status| {
        outputs(status).all(|output| output["received"] == samples) && is_accounted_and_idle(status)
    });
}

/// Checks that each subscriber gets these samples once, in whatever order ingress discovered the publishers.
fn assert_history(late: [RunningPeer; 2], first: u64, last: u64) {
    let samples = last - first + 1;
    for subscriber in late {
        subscriber.wait_received(samples);
        let received: Received = subscriber.end();
        let summary = (received.received, received.first, received.last, received.duplicates, received.bad);
        assert_eq!(summary, (samples, Some(first), Some(last), 0, 0), "{received:?}");
    }
}

/// Kills the processes of both lanes, and waits until they are back and have taken the retained samples.
fn kill_lanes(bed: &Bed) {
    for child in ["egress-critical", "egress-noncritical"] {
        let before = bed.pids(child).len();
        support::process::signal(bed.pid(child), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids(child).len() > before);
        // The first turn is reported before the lane takes samples, and the third after.
        bed.bridge.wait_status("the history restored", |status| {
            let mut processes = status["processes"].as_array().into_iter().flatten();
            processes.any(|process| {
                process["pid"] == bed.pid(child) && process["turns"].as_u64().is_some_and(|turns| turns >= 3)
            })
        });
    }
}

#[test]
fn a_late_joiner_of_either_lane_gets_the_last_sample_without_a_configured_durability() {
    let test = "a_late_joiner_of_either_lane_gets_the_last_sample_without_a_configured_durability";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, MAP) else { return };
    let publisher = publisher("map_server", 0, 3).start_on(bed.host("publisher"));
    publisher.wait_sent();
    bed.bridge.wait_status("all samples handled by both lanes", |status| {
        // Ingress need not get all three of a KEEP_LAST 1 publisher that it discovers while that publishes.
        let published = &status["routes"][0]["published"];
        published.as_u64() > Some(0)
            && outputs(status).all(|output| output["received"] == *published)
            && is_accounted_and_idle(status)
    });
    for round in 0..2 {
        for subscriber in late_joiners(&bed) {
            subscriber.wait_received(1);
            let received: Received = subscriber.end();
            received.assert_sound();
            assert_eq!((received.received, received.last), (1, Some(2)), "round {round}: {received:?}");
        }
        if round == 0 {
            kill_lanes(&bed);
        }
    }
    let status = bed.bridge.status();
    assert!(
        outputs(&status).all(|output| output["unmatched_readers"].as_array().unwrap().is_empty()),
        "{status}"
    );
    let _: Sent = publisher.end();
    bed.end();
}

#[test]
fn a_late_joiner_of_either_lane_gets_the_last_sample_of_each_publisher() {
    let test = "a_late_joiner_of_either_lane_gets_the_last_sample_of_each_publisher";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, MAP) else { return };
    let publishers = static_publishers(&bed);
    wait_handled(&bed, 14);
    assert_history(late_joiners(&bed), 0, 13);
    // It replaces the sample of its publisher, and no other.
    publishers.go();
    wait_handled(&bed, 15);
    assert_history(late_joiners(&bed), 1, 14);
    let _: Sent = publishers.end();
    bed.bridge.wait_status("the publishers gone", |status| status["routes"][0]["writers"] == 0);
    let cyclone = OUTPUTS.map(|topic| {
        let peer = Peer::cyclone().subscriber().topic(topic).transient_local().keep_last(100);
        peer.start_on(bed.host("critical"))
    });
    assert_history(cyclone, 1, 14);
    bed.end();
}

#[test]
fn a_restarted_lane_has_the_last_sample_of_each_publisher_among_the_retained_ones() {
    let test = "a_restarted_lane_has_the_last_sample_of_each_publisher_among_the_retained_ones";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let best_effort = "    qos_overrides: {noncritical: {reliability: BEST_EFFORT}}\n";
    let Some(bed) = Bed::start(test, &format!("{MAP}    retained_samples: 16\n{best_effort}")) else {
        return;
    };
    let publishers = static_publishers(&bed);
    wait_handled(&bed, 14);
    for round in 0..2 {
        if round == 1 {
            publishers.go();
            wait_handled(&bed, 15);
            kill_lanes(&bed);
        }
        let [reliable, noncritical] = OUTPUTS
            .map(|topic| Peer::rclpy("late").subscriber().topic(topic).transient_local().keep_last(100));
        let late = [reliable, noncritical.best_effort()].map(|peer| peer.start_on(bed.host("critical")));
        assert_history(late, round, 13 + round);
    }
    let _: Sent = publishers.end();
    bed.end();
}

#[test]
fn a_latched_sample_from_before_the_bridge_reaches_late_joiners_of_both_lanes() {
    let test = "a_latched_sample_from_before_the_bridge_reaches_late_joiners_of_both_lanes";
    if let Some(reason) = ros::missing().or_else(support::testbed_missing) {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["publisher", "bridge", "critical"]);
    // Ten times as old as a noncritical sample of a VOLATILE publisher may be.
    let map = Peer::cyclone().transient_local().keep_last(1).source_age_ms(2_000).count(1).linger_s(600.0);
    let publisher = map.publisher().topic("rt/map").start_on(net.host("publisher"));
    publisher.wait_sent();
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{MAP}"));
    let up = bridge.start_on(net.host("bridge"), "up");
    let bed = Bed { up, bridge, net };
    bed.wait_up();
    wait_handled(&bed, 1);
    for subscriber in late_joiners(&bed) {
        subscriber.wait_received(1);
        let received: Received = subscriber.end();
        received.assert_sound();
        assert_eq!((received.received, received.last), (1, Some(0)), "{received:?}");
    }
    let _: Sent = publisher.end();
    bed.end();
}

#[test]
fn a_writer_with_subscribers_stays_volatile_until_they_leave() {
    let test = "a_writer_with_subscribers_stays_volatile_until_they_leave";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    // The type is configured, so the writers exist, VOLATILE, before there is a publisher.
    let Some(bed) = Bed::start(test, &format!("{MAP}    message_type: sensor_msgs/msg/LaserScan\n")) else {
        return;
    };
    let present =
        OUTPUTS.map(|topic| bed.subscribe("critical", Peer::rclpy("present").keep_last(100), topic));
    let late = late_joiners(&bed);
    let are_named = |status: &Value| {
        outputs(status).all(|output| output["unmatched_readers"][0]["policy"] == "DURABILITY")
    };
    bed.bridge.wait_status("the subscribers that get nothing are named", are_named);
    // It publishes until the test ends it.
    let publisher =
        publisher("map_server", 0, 1_000_000).wait_match(1).hold().start_on(bed.host("publisher"));
    let is_matched = |status: &Value| status["routes"][0]["writers"] == 1;
    bed.bridge.wait_status("the publisher matched by ingress", is_matched);
    publisher.go();
    for subscriber in &present {
        subscriber.wait_received(20);
    }
    let status = bed.bridge.status();
    assert!(are_named(&status), "{status}");
    for (lane, subscriber) in ["critical", "noncritical"].into_iter().zip(present) {
        let received: Received = subscriber.end();
        received.assert_sound();
        // A noncritical lane drops samples: the publisher is faster than its rate.
        if lane == "critical" {
            assert_eq!((received.first, received.missing_count), (Some(0), 0), "{received:?}");
        }
    }
    for subscriber in late {
        subscriber.wait_received(1);
        let received: Received = subscriber.end();
        received.assert_sound();
    }
    let status = bed.bridge.status();
    assert!(
        outputs(&status).all(|output| output["unmatched_readers"].as_array().unwrap().is_empty()),
        "{status}"
    );
    let _: Sent = publisher.end();
    bed.wait_accounted();
    bed.end();
}

#[test]
fn a_map_that_is_too_large_is_a_problem_for_as_long_as_nothing_was_forwarded() {
    let small = format!("{MAP}    max_sample_bytes: 1048576\n");
    let Some(bed) = Bed::start("a_map_that_is_too_large_is_a_problem", &small) else { return };
    // It has the size of a map of 2,000 by 2,000 cells, and is published once.
    let map = Peer::cyclone().transient_local().keep_last(1).size(4_000_000).count(1).linger_s(600.0);
    let map = map.type_name("nav_msgs::msg::dds_::OccupancyGrid_");
    let publisher = map.publisher().topic("rt/map").start_on(bed.host("publisher"));
    publisher.wait_sent();
    let refused = |status: &Value| status["routes"][0]["drops"]["too_large"] == 1;
    bed.bridge.wait_status("the map refused", refused);
    // The drop itself is a problem only of the status that sees it.
    std::thread::sleep(Duration::from_secs(3));
    let problems = bed.bridge.status()["problems"].to_string();
    assert!(
        problems.contains("route map: nothing is forwarded") && problems.contains("max_sample_bytes"),
        "{problems}"
    );
    let _: Sent = publisher.end();
    bed.end();
}
