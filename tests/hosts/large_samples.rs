//! Large samples between stock nodes: Fast DDS leaves its receive buffer at the kernel's 208 KiB, a fifth of
//! a sample, and loses some of most samples, also without the bridge.

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, STANDBYS, outputs};
use support::pacer::paced;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::signal;
use support::ros;

const YAML: &str = "topics:\n  - {id: cloud, input_topic: /cloud, message_type: sensor_msgs/msg/PointCloud2, \
                    max_sample_bytes: 2097152}\nrouting_policy: {noncritical_max_rate_hz: 30}\n";
const DIRECT: &str = "rt/direct";
const INPUT: &str = "rt/cloud";
const OUTPUTS: [&str; 2] = ["rt/adaptive_bridge/critical/cloud", "rt/adaptive_bridge/noncritical/cloud"];
const SAMPLES: u64 = 100;

fn peer(library: Library, node: &str) -> Peer {
    let peer = match library {
        Library::Rclpy => Peer::rclpy(node),
        other => Peer::on(other),
    };
    peer.type_name("sensor_msgs::msg::dds_::PointCloud2_").size(1_000_000).keep_last(10)
}

fn print(what: &str, received: &Received) {
    let latency = received.latency_us.unwrap();
    let [p50, p95, max] = [latency.p50, latency.p95, latency.max].map(|us| us / 1e3);
    println!("{what}: {} received, age p50 {p50:.1}, p95 {p95:.1}, max {max:.1} ms", received.received);
}

#[test]
fn a_full_hd_image_and_a_map_of_4_mb_pass_with_the_default_configuration() {
    let test = "a_full_hd_image_and_a_map_of_4_mb_pass_by_default";
    let yaml = "topics:\n  - {id: image, input_topic: /image, message_type: sensor_msgs/msg/Image}\n  \
                - {id: map, input_topic: /map, message_type: nav_msgs/msg/OccupancyGrid}\n";
    let Some(bed) = Bed::start(test, &format!("{yaml}{STANDBYS}")) else { return };
    for (id, kind, bytes) in [
        ("image", "sensor_msgs::msg::dds_::Image_", 6_220_800),
        ("map", "nav_msgs::msg::dds_::OccupancyGrid_", 4_000_000),
    ] {
        let peer = || Peer::cyclone().keep_all().type_name(kind).size(bytes);
        let subscriber = bed.subscribe("critical", peer(), &format!("rt/adaptive_bridge/critical/{id}"));
        let sent: Sent = bed.publish(peer().rate_hz(5.0).count(10), &format!("rt/{id}")).finish();
        subscriber.wait_received(sent.ok);
        subscriber.end::<Received>().assert_all_of(&sent);
    }
    bed.wait_accounted();
    bed.assert_no_take_over();
    bed.end();
}

/// Of what the lane sends at once after the stop, its writer would discard what is more than 32 MiB.
#[test]
fn a_lane_that_was_stopped_sends_every_image() {
    let test = "a_lane_that_was_stopped_sends_every_image";
    // It asserts that no sample is lost.
    let _alone = support::exclusive();
    let yaml = "topics:\n  - {id: image, input_topic: /image, message_type: sensor_msgs/msg/Image}\n";
    let Some(bed) = Bed::start_without_watchdog(test, yaml) else { return };
    let peer = || Peer::cyclone().keep_all().type_name("sensor_msgs::msg::dds_::Image_").size(6_220_800);
    let subscriber = bed.subscribe("critical", peer(), "rt/adaptive_bridge/critical/image");
    let publisher = bed.publish(peer().rate_hz(15.0), "rt/image");
    // A busy machine may carry fewer than 15 a second, and the safety mode stops a lane that is 2 s behind.
    paced(&publisher, [&subscriber], 12, || {
        for _ in 0..3 {
            subscriber.wait_received(publisher.written() + 10);
            let lane = bed.pid("egress-critical");
            signal(lane, Signal::SIGSTOP);
            #[allow(clippy::disallowed_methods, reason = "twelve periods of the publisher")]
            std::thread::sleep(std::time::Duration::from_millis(800));
            signal(lane, Signal::SIGCONT);
        }
    });
    let sent: Sent = publisher.end();
    subscriber.wait_received(sent.ok);
    subscriber.end::<Received>().assert_all_of(&sent);
    let status = bed.wait_accounted();
    let output = outputs(&status).find(|output| output["lane"] == "critical").unwrap();
    assert_eq!(output["reader_overrun"], 0, "{output}");
    bed.end();
}

#[test]
fn a_sample_without_room_in_shared_memory_is_logged_and_a_problem_with_its_reason() {
    let test = "a_sample_without_room_in_shared_memory_is_logged";
    let yaml = "topics:\n  - {id: image, input_topic: /image}\nshared_memory: {budget_bytes: 4194304}\n";
    let Some(bed) = Bed::start(test, yaml) else { return };
    let image = Peer::cyclone().keep_all().type_name("sensor_msgs::msg::dds_::Image_").size(6_220_800);
    let publisher = image.rate_hz(5.0).publisher().topic("rt/image").start_on(bed.host("publisher"));
    let is_told = |status: &Value| {
        let problems = status["problems"].to_string();
        status["routes"][0]["drops"]["over_budget"].as_u64() > Some(0)
            && problems.contains("route image: dropped")
            && problems.contains("shared_memory.budget_bytes is used up")
    };
    bed.bridge.wait_status("the refusal", is_told);
    bed.up.wait_for_log("over_budget");
    let log = bed.up.log();
    let mut lines = log.lines();
    let line = lines.find(|line| line.contains("samples dropped") && line.contains("over_budget"));
    let line = line.unwrap_or_else(|| panic!("{log}"));
    assert!(line.contains("image") && line.contains("shared_memory.budget_bytes"), "{line}");
    let _: Sent = publisher.end();
    bed.end();
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn samples_of_1_mb_reach_stock_nodes_of_both_lanes() {
        let test = "samples_of_1_mb_reach_stock_nodes_of_both_lanes";
        if let Some(reason) = ros::missing() {
            return support::skip(test, &reason);
        }
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, YAML) else { return };
        for library in [Library::Rclpy, Library::Fast, Library::Cyclone] {
            let publish = |topic| -> Sent {
                let publisher = peer(library, "camera").rate_hz(10.0).count(SAMPLES);
                bed.publish(publisher, topic).finish()
            };
            let direct = peer(library, "viewer").subscriber().topic(DIRECT).start_on(bed.host("critical"));
            publish(DIRECT);
            print(&format!("{library:?}, without the bridge"), &direct.end());
            // A noncritical lane repairs a sample until the second one after it: for 0.2 s.
            support::attempts(|| {
                let subscribers =
                    OUTPUTS.map(|topic| bed.subscribe("critical", peer(library, "viewer"), topic));
                let sent = publish(INPUT);
                assert_eq!(sent.ok, SAMPLES);
                bed.wait_accounted();
                subscribers[0].wait_received(sent.ok);
                let [critical, noncritical] = subscribers.map(RunningPeer::end::<Received>);
                print(&format!("{library:?}, critical"), &critical);
                print(&format!("{library:?}, noncritical"), &noncritical);
                critical.assert_all_of(&sent);
                noncritical.assert_sound();
                let missing = sent.ok - noncritical.received;
                (missing == 0)
                    .then_some(())
                    .ok_or_else(|| format!("{library:?}: {missing} noncritical missing"))
            });
        }
        bed.wait_accounted();
        bed.end();
    }
}
