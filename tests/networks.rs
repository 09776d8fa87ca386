//! Networks that come, go and change while samples flow: a link that is down for shorter and longer than the
//! leases of discovery, another address, an address that comes after the bridge. By the peers' own counts.

mod support;

use std::net::Ipv4Addr;
use std::time::Duration;

use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN};
use support::bridge::Bridge;
use support::netns::Net;
use support::peer::{Peer, Received, RunningPeer, Sent};

/// Waits until each has received that many more samples than before.
fn all_receive(subscribers: &[RunningPeer], more: u64, what: &str) {
    let before: Vec<u64> = subscribers.iter().map(RunningPeer::received).collect();
    support::wait_until(what, || {
        subscribers.iter().zip(&before).all(|(subscriber, before)| subscriber.received() >= before + more)
    });
}

/// Remote subscribers of both libraries and both lanes.
fn remote_subscribers(bed: &Bed) -> Vec<RunningPeer> {
    vec![
        bed.subscribe("slow", Peer::cyclone().best_effort(), NONCRITICAL),
        bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL),
        bed.subscribe("slow", Peer::cyclone(), CRITICAL),
        bed.subscribe("slow", Peer::fast(), CRITICAL),
    ]
}

/// A link that is down for so long, first that of the subscribers, then that of the bridge.
fn outage(test: &str, seconds: u64) {
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscribers = remote_subscribers(&bed);
    let local = bed.subscribe("bridge", Peer::fast().keep_all(), CRITICAL);
    let publisher = Peer::fast().publisher().topic(INPUT).wait_match(1).rate_hz(30.0);
    let publisher = publisher.start_on(bed.host("bridge"));
    all_receive(&subscribers, 5, "samples before the outage");
    for host in ["slow", "bridge"] {
        bed.host(host).set_link(false);
        std::thread::sleep(Duration::from_secs(seconds));
        bed.host(host).set_link(true);
        all_receive(&subscribers, 10, &format!("samples after the link of {host} is back"));
    }
    // One that comes afterwards is found, so built-in endpoints are served, too.
    let late = bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL);
    late.wait_received(5);
    let first = local.received();
    let sent: Sent = publisher.end();
    local.wait_received(first);
    let received: Received = local.end();
    received.assert_sound();
    let status = bed.wait_whole();
    assert_eq!(received.missing_count, 0, "a local subscriber, with {sent:?}: {status}");
    for subscriber in subscribers {
        subscriber.end::<Received>().assert_sound();
    }
    bed.end();
}

#[test]
fn an_outage_of_1_s_ends_with_the_link() {
    outage("an_outage_of_1_s_ends_with_the_link", 1);
}

#[test]
fn an_outage_of_5_s_ends_with_the_link() {
    outage("an_outage_of_5_s_ends_with_the_link", 5);
}

/// The peers' lease for the bridge ends, that of the bridge for Fast DDS (20 s) does not.
#[test]
fn an_outage_of_17_s_ends_with_the_link() {
    outage("an_outage_of_17_s_ends_with_the_link", 17);
}

#[test]
fn an_outage_of_60_s_ends_with_the_link() {
    outage("an_outage_of_60_s_ends_with_the_link", 60);
}

#[test]
fn another_address_of_the_robot_disturbs_no_local_subscriber_and_is_announced() {
    let test = "another_address_of_the_robot_disturbs_no_local_subscriber_and_is_announced";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let robot = bed.host("bridge").clone();
    let subscribers = remote_subscribers(&bed);
    let local = bed.subscribe("bridge", Peer::fast().keep_all(), CRITICAL);
    let publisher = Peer::fast().publisher().topic(INPUT).wait_match(1).rate_hz(30.0);
    let publisher = publisher.start_on(&robot);
    all_receive(&subscribers, 5, "samples before");

    robot.set_address(None);
    local.wait_received(local.received() + 60);
    let [a, b, c, d] = robot.address().octets();
    robot.set_address(Some(Ipv4Addr::new(a, b, c, d + 100)));
    all_receive(&subscribers, 30, "samples from the new address");
    // What joins now has to find the built-in endpoints at the new address.
    let late = bed.subscribe("slow", Peer::fast(), CRITICAL);
    late.wait_received(30);

    let sent: Sent = publisher.end();
    local.wait_received(sent.ok);
    local.end::<Received>().assert_all_of(&sent);
    bed.end();
}

#[test]
fn an_address_that_comes_after_the_bridge_is_used() {
    let test = "an_address_that_comes_after_the_bridge_is_used";
    if let Some(reason) = support::testbed_missing() {
        support::skip(test, &reason);
        return;
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let robot = net.host("bridge").clone();
    robot.set_address(None);
    // The interface by its name, although it has no address yet.
    let bridge = Bridge::new(&format!("instance: {{instance}}\nros: {{networks: [lo, eth0]}}\n{SCAN}"));
    let up = bridge.start_on(&robot, "up");
    let bed = Bed { up, bridge, net };
    bed.wait_up();
    bed.up.wait_for_log("network interface eth0 is not on this host or has no IPv4 address");
    let publisher = Peer::fast().publisher().topic(INPUT).wait_match(1).rate_hz(30.0);
    let remote = [
        Peer::fast().best_effort().subscriber().topic(NONCRITICAL).start_on(bed.host("slow")),
        Peer::cyclone().best_effort().subscriber().topic(NONCRITICAL).start_on(bed.host("slow")),
    ];

    robot.set_address(Some(robot.address()));
    let publisher = publisher.start_on(&robot);
    all_receive(&remote, 10, "samples after the address has come");
    let _: Sent = publisher.end();
    bed.end();
}
