//! What ROS 2 nodes (rclpy) see of the bridge, beyond the samples.

use support::bed::{Bed, CRITICAL, INPUT, SCAN};
use support::peer::{Peer, Received};
use support::ros;

/// Nodes that publish one sample each.
const NODES: u64 = 50;

#[test]
fn the_sample_of_a_node_that_publishes_once_and_ends_reaches_the_subscriber() {
    let test = "the_sample_of_a_node_that_publishes_once_and_ends_reaches_the_subscriber";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let critical = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    // Five at a time, because each takes half a second to start.
    for first in (0..NODES).step_by(5) {
        let nodes = (first..first + 5).map(|number| {
            // As `ros2 topic pub --once`, which ends 0.1 s after it has published.
            let node = Peer::rclpy("once").option("--keep-alive", 0.1).first_seq(number).count(1);
            bed.publish(node, INPUT)
        });
        for mut node in nodes.collect::<Vec<_>>() {
            node.wait();
        }
    }
    critical.wait_received(NODES);
    let received: Received = critical.end();
    received.assert_sound();
    bed.wait_accounted();
    bed.end();
}
