//! ROS 2 nodes of the next release, Kilted with Fast DDS 3, beside those of Jazzy with Fast DDS 2.14.

use serde_json::json;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, outputs};
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::ros;

const SAMPLES: u64 = 100;

#[test]
fn nodes_of_kilted_and_jazzy_reach_each_other_through_both_lanes() {
    let test = "nodes_of_kilted_and_jazzy_reach_each_other_through_both_lanes";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let nodes = |name: &str| [Peer::rclpy(name), Peer::rclpy(name).on_kilted()];
    for publisher in nodes("lidar") {
        let critical = nodes("planner").map(|node| bed.subscribe("critical", node.keep_all(), CRITICAL));
        let noncritical = nodes("rviz").map(|node| bed.subscribe("slow", node, NONCRITICAL));
        let sent: Sent = bed.publish(publisher.keep_all().rate_hz(30.0).count(SAMPLES), INPUT).finish();
        assert!(sent.acknowledged, "{sent:?}");
        let status = bed.wait_accounted();
        let nothing_is_wrong = |output: &serde_json::Value| output["unmatched_readers"] == json!([]);
        assert!(outputs(&status).all(nothing_is_wrong), "{status}");
        let hash = ros::type_hash("sensor_msgs/msg/LaserScan");
        assert_eq!(status["routes"][0]["type_hash"], hash);
        for subscriber in critical {
            subscriber.wait_received(SAMPLES);
            subscriber.end::<Received>().assert_all_of(&sent);
        }
        for subscriber in noncritical {
            // 10 Hz for 3.3 s.
            subscriber.wait_received(20);
            subscriber.end::<Received>().assert_sound();
        }
    }
    let mut client: RunningPeer = Peer::parameters("rqt").on_kilted().start_on(bed.host("slow"));
    let node = format!("/adaptive_bridge/{}/control", bed.bridge.instance());
    client.say(json!({ "call": "get", "names": ["instance"], "node": node }).to_string());
    let reply = client.wait_for("the value of a parameter", |event| event["event"] == "reply");
    assert_eq!(reply["reply"]["values"], json!([bed.bridge.instance()]), "{reply}");
    bed.end();
}
