//! Restarts of a killed ingress while samples flow: no sample is published twice or out of order, and each
//! publisher's account counts the lost samples. Uses real processes, signals and DDS peers.

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, outputs};
use support::peer::{Peer, Received, Sent};
use support::process::signal;
use support::ros;

const RATE_HZ: f64 = 200.0;
const KILLS: usize = 5;
/// Samples that the subscriber receives between two kills.
const SAMPLES_BETWEEN: u64 = 300;

/// Kills ingress five times while `publisher` writes at 200 Hz, and checks the accounts. Returns the
/// publisher's summary and the route in the status.
fn kill_ingress_five_times(bed: &Bed, publisher: Peer) -> (Sent, Value) {
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
    let publisher = bed.publish(publisher.rate_hz(RATE_HZ), INPUT);
    subscriber.wait_received(SAMPLES_BETWEEN);
    for kills in 1..=KILLS {
        signal(bed.pid("ingress"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("ingress").len() == kills + 1);
        subscriber.wait_received(subscriber.received() + SAMPLES_BETWEEN);
    }
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    let number = |value: &Value| value.as_u64().unwrap_or_else(|| panic!("{value}"));
    bed.bridge.wait_status("the last sample received by ingress", |status| {
        let publishers = &status["routes"][0]["publishers"];
        publishers[0]["last_sequence"].as_u64() == Some(sent.ok)
    });
    let status = bed.wait_accounted();
    let route = status["routes"][0].clone();
    assert_eq!(route["whole"], true, "{route}");
    let [account] = route["publishers"].as_array().unwrap().as_slice() else { panic!("{route}") };
    let before_first = number(&account["first_sequence"]) - 1;
    let received = number(&account["received"]);
    assert_eq!(before_first + received + number(&account["lost_upstream"]), sent.ok, "{sent:?} {route}");
    assert_eq!(account["received"], route["received"], "{route}");
    assert_eq!(account["lost_upstream"], route["lost_upstream"], "{route}");
    assert_eq!(account["repeated"], route["repeated"], "{route}");

    let lane = outputs(&status).find(|output| output["lane"] == "critical").unwrap();
    let forwarded = number(&lane["forwarded"]);
    let dropped: u64 = lane["drops"].as_object().unwrap().values().map(number).sum();
    assert_eq!(forwarded + dropped, received, "{lane}");
    subscriber.wait_received(forwarded);
    let received: Received = subscriber.end();
    received.assert_sound();
    assert_eq!(received.received, forwarded, "{received:?} {lane}");
    // Samples were written while there was no ingress.
    assert!(received.max_gap_ms > 2.0 * 1e3 / RATE_HZ, "{received:?}");
    let summary = format!(
        "{} sent, {} received; repeated {}, lost_upstream {}, dropped by the lane {dropped}",
        sent.ok, received.received, route["repeated"], route["lost_upstream"]
    );
    println!("{summary}");
    (sent, route)
}

#[test]
fn a_reliable_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed() {
    let test = "a_reliable_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed";
    // A publisher retains 1,000 samples, which are 5 s, for the killed ingress. The next one takes what was
    // written meanwhile, before it declares its predecessor gone a second after its start: on a busy machine
    // it may not have discovered the publisher by then.
    support::attempts(|| {
        let Some(bed) = Bed::start(test, SCAN) else { return Ok(()) };
        let (_, route) = kill_ingress_five_times(&bed, Peer::cyclone().keep_last(1000));
        bed.end();
        if route["lost_upstream"] == 0 { Ok(()) } else { Err(format!("lost, although retained: {route}")) }
    });
}

#[test]
fn samples_beyond_the_history_of_a_publisher_are_counted_as_lost_upstream() {
    let test = "samples_beyond_the_history_of_a_publisher_are_counted_as_lost_upstream";
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return;
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    // Ten samples are 50 ms; ingress is down for longer.
    let (_, route) = kill_ingress_five_times(&bed, Peer::rclpy("scanner").keep_last(10));
    assert!(route["lost_upstream"].as_u64() > Some(0), "{route}");
    bed.end();
}

#[test]
fn a_best_effort_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed() {
    let test = "a_best_effort_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let (_, route) = kill_ingress_five_times(&bed, Peer::cyclone().best_effort().keep_last(10));
    assert!(route["lost_upstream"].as_u64() > Some(0), "{route}");
    bed.end();
}
