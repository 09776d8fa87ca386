//! Topics with keys: the outputs have keys, and samples that dispose or unregister a key pass.

use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, SCAN_TYPE, outputs};
use support::peer::{Peer, Received, RunningPeer, Sent};

const KEYS: u32 = 4;
/// Data of each key in turn; then key 1 is disposed and key 2 unregistered.
const SAMPLES: u64 = 12;

fn with_keys(peer: Peer) -> Peer {
    peer.type_name(SCAN_TYPE).size(300).keys(KEYS)
}

/// A publisher that publishes at [`RunningPeer::go`], slower than the noncritical lane forwards.
fn publisher(bed: &Bed, peer: Peer) -> RunningPeer {
    let peer = with_keys(peer).hold().rate_hz(5.0).count(SAMPLES).linger_s(600.0);
    let running = bed.publish(peer, INPUT);
    // A subscriber with keys matches an output that has them, too.
    bed.bridge.wait_status("outputs with keys", |status| status["routes"][0]["has_keys"] == true);
    running
}

/// Passes samples of each publisher to subscribers of both lanes, and compares them with a subscriber of the
/// input.
fn compare_with_input(
    test: &str,
    publisher_of: fn() -> Peer,
    subscriber_of: fn() -> Peer,
    ends: Option<[&str; 2]>,
) {
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let publisher = publisher(&bed, publisher_of());
    let subscribed =
        [CRITICAL, NONCRITICAL].map(|topic| bed.subscribe("critical", with_keys(subscriber_of()), topic));
    let direct = with_keys(subscriber_of()).subscriber().topic(INPUT).start_on(bed.host("critical"));
    direct.wait_matched(1);
    publisher.wait_matched(2);
    publisher.go();
    publisher.wait_sent();
    // The samples that dispose and unregister count as any other.
    let all = SAMPLES + 2;
    bed.bridge.wait_status("all samples forwarded", |status| {
        status["routes"][0]["received"] == all
            && outputs(status).all(|output| output["forwarded"] == all && output["whole"] == true)
    });
    for subscriber in [&direct, &subscribed[0], &subscribed[1]] {
        subscriber.wait_received(SAMPLES);
        for (key, state) in [1, 2].into_iter().zip(ends.into_iter().flatten()) {
            subscriber.wait_for("the end of a key", |event| event["key"] == key && event["state"] == state);
        }
    }
    let direct: Received = direct.end();
    for subscriber in subscribed {
        let received: Received = subscriber.end();
        received.assert_sound();
        assert_eq!((received.received, &received.keys), (SAMPLES, &direct.keys), "{received:?}");
    }
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0);
    bed.end();
}

#[test]
fn a_keyed_publisher_on_fast_dds_reaches_keyed_subscribers_on_fast_dds() {
    let test = "a_keyed_publisher_on_fast_dds_reaches_keyed_subscribers_on_fast_dds";
    compare_with_input(test, Peer::fast, Peer::fast, Some(["disposed", "no_writers"]));
}

#[test]
fn a_keyed_publisher_on_fast_dds_reaches_keyed_subscribers_on_cyclone_dds() {
    let test = "a_keyed_publisher_on_fast_dds_reaches_keyed_subscribers_on_cyclone_dds";
    compare_with_input(test, Peer::fast, Peer::cyclone, Some(["disposed", "no_writers"]));
}

#[test]
fn a_keyed_publisher_on_cyclone_dds_reaches_keyed_subscribers_on_fast_dds() {
    let test = "a_keyed_publisher_on_cyclone_dds_reaches_keyed_subscribers_on_fast_dds";
    compare_with_input(test, Peer::cyclone, Peer::fast, None);
}

#[test]
fn a_keyed_publisher_on_cyclone_dds_reaches_keyed_subscribers_on_cyclone_dds() {
    let test = "a_keyed_publisher_on_cyclone_dds_reaches_keyed_subscribers_on_cyclone_dds";
    compare_with_input(test, Peer::cyclone, Peer::cyclone, Some(["disposed", "no_writers"]));
}

#[test]
fn a_publisher_with_keys_beside_one_without_is_a_problem() {
    let test = "a_publisher_with_keys_beside_one_without_is_a_problem";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let stock = Peer::fast().type_name(SCAN_TYPE).size(300).rate_hz(20.0).linger_s(600.0);
    let stock = bed.publish(stock, INPUT);
    let subscribers =
        [CRITICAL, NONCRITICAL].map(|topic| bed.subscribe("critical", Peer::cyclone().size(300), topic));
    let keyed = with_keys(Peer::fast()).publisher().topic(INPUT).hold().start_on(bed.host("publisher"));
    bed.bridge.wait_status("a named problem", |status| {
        let mut problems = status["problems"].as_array().into_iter().flatten();
        problems.any(|problem| problem.as_str().is_some_and(|text| text.contains(" with keys, ")))
    });
    // The topic stays as it was, and its subscribers receive.
    assert_eq!(bed.bridge.status()["routes"][0]["has_keys"], false);
    for subscriber in subscribers {
        subscriber.wait_received(10);
        subscriber.end::<Received>().assert_sound();
    }
    // When the one without keys is gone, the route changes over.
    stock.end::<Sent>();
    bed.bridge.wait_status("outputs with keys", |status| status["routes"][0]["has_keys"] == true);
    keyed.end::<Sent>();
    bed.end();
}
