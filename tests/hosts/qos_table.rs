//! Which ROS 2 subscribers receive what a publisher offers, with and without the bridge: the table of
//! `docs/ros2.md`.

use std::time::Duration;

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, outputs};
use support::peer::{Peer, RunningPeer, Sent};
use support::ros;

/// The topics in the order of the table: without the bridge, and of both lanes.
const TOPICS: [&str; 3] = [INPUT, CRITICAL, NONCRITICAL];

/// A node of one release of ROS 2.
type Node = fn(&str) -> Peer;

fn offers(node: Node) -> Vec<(&'static str, Peer)> {
    let node = || node("lidar").rate_hz(10.0);
    vec![
        ("RELIABLE, VOLATILE", node()),
        ("BEST_EFFORT, VOLATILE", node().best_effort()),
        ("RELIABLE, TRANSIENT_LOCAL", node().transient_local()),
        ("RELIABLE, deadline 200 ms", node().option("--deadline-ms", 200)),
        ("RELIABLE, liveliness by topic, 500 ms", node().option("--liveliness-ms", 500)),
        ("RELIABLE, lifespan 200 ms", node().option("--lifespan-ms", 200)),
    ]
}

fn requests(node: Node, name: &str) -> Vec<(&'static str, Peer)> {
    let node = |number: usize| node(&format!("{name}_{number}")).subscriber();
    vec![
        ("RELIABLE", node(0)),
        ("BEST_EFFORT, depth 1", node(1).best_effort().keep_last(1)),
        ("RELIABLE, TRANSIENT_LOCAL", node(2).transient_local()),
        ("RELIABLE, deadline 200 ms", node(3).option("--deadline-ms", 200)),
        ("RELIABLE, liveliness by topic, 500 ms", node(4).option("--liveliness-ms", 500)),
    ]
}

/// The policy for which `status` names a node among those that get nothing.
fn named(status: &Value, node: &str) -> Option<String> {
    let unmatched =
        outputs(status).flat_map(|output| output["unmatched_readers"].as_array().unwrap().clone());
    let mut policies = unmatched.filter(|reader| reader["node"] == format!("/{node}"));
    policies.next().map(|reader| reader["policy"].as_str().unwrap().to_owned())
}

const PAGE: &str = include_str!("../../docs/ros2.md");

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn every_subscriber_that_receives_without_the_bridge_receives_or_is_named() {
        fill_table("every_subscriber_that_receives_without_the_bridge_receives_or_is_named", Peer::rclpy);
    }

    #[test]
    fn the_table_is_the_same_with_nodes_of_kilted() {
        fill_table("the_table_is_the_same_with_nodes_of_kilted", |name| Peer::rclpy(name).on_kilted());
    }
}

/// Compares the table of the page with what nodes receive.
fn fill_table(test: &str, node: Node) {
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let mut table = vec![
        "| The publisher offers | The subscriber requests | Without the bridge | Critical lane | Noncritical lane |"
            .to_owned(),
        "|---|---|---|---|---|".to_owned(),
    ];
    for (offered, publisher) in offers(node) {
        let Some(bed) = Bed::start(test, SCAN) else { return };
        let publisher = publisher.publisher().topic(INPUT).start_on(bed.host("publisher"));
        // Both lanes know the publisher, so that their writers offer its durability, before a subscriber
        // holds them.
        bed.bridge.wait_status("the first sample on both lanes", |status| {
            outputs(status).all(|output| output["drops"]["no_reader"].as_u64() > Some(0))
        });
        let subscribers: Vec<(&str, [RunningPeer; 3])> = requests(node, "x")
            .into_iter()
            .enumerate()
            .map(|(number, (requested, _))| {
                let start = |place: usize| {
                    let name = ["direct", "critical", "noncritical"][place];
                    let (_, peer) = requests(node, name).swap_remove(number);
                    peer.topic(TOPICS[place]).start_on(bed.host("critical"))
                };
                (requested, [0, 1, 2].map(start))
            })
            .collect();
        let is_settled = |number: usize, lane: &str, subscriber: &RunningPeer| {
            let named = named(&bed.bridge.status(), &format!("{lane}_{number}"));
            named.is_some() || subscriber.received() > 0
        };
        for (number, (_, [_, critical, noncritical])) in subscribers.iter().enumerate() {
            for (lane, subscriber) in [("critical", critical), ("noncritical", noncritical)] {
                support::wait_until(format!("{lane}_{number} receives or is named"), || {
                    is_settled(number, lane, subscriber)
                });
            }
        }
        // Those subscribers without the bridge that the page has as served are waited for. The others have
        // had 2 s since all that use the bridge were served or named.
        for (requested, [direct, ..]) in &subscribers {
            if PAGE.contains(&format!("| {offered} | {requested} | yes |")) {
                direct.wait_received(1);
            }
        }
        std::thread::sleep(Duration::from_secs(2));
        let status = bed.bridge.status();
        for (number, (requested, [direct, critical, noncritical])) in subscribers.into_iter().enumerate() {
            let receives = |subscriber: &RunningPeer| subscriber.received() > 0;
            let through = |lane: &str, subscriber: &RunningPeer| {
                let policy = named(&status, &format!("{lane}_{number}"));
                policy.map_or_else(
                    || if receives(subscriber) { "yes" } else { "no" }.to_owned(),
                    |policy| format!("`status` names {policy}"),
                )
            };
            let direct = if receives(&direct) { "yes" } else { "no" };
            let [critical, noncritical] =
                [through("critical", &critical), through("noncritical", &noncritical)];
            table.push(format!("| {offered} | {requested} | {direct} | {critical} | {noncritical} |"));
        }
        let _: Sent = publisher.end();
        bed.end();
    }
    let table = table.join("\n") + "\n";
    println!("{table}");
    assert!(PAGE.contains(&table), "docs/ros2.md does not have this table:\n{table}");
}
