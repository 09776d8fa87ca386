//! Restarts of a killed ingress while samples flow: no sample is published twice or out of order, and each
//! publisher's account counts the lost samples. Uses real processes, signals and DDS peers.

use std::fs;
use std::path::PathBuf;

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
/// Samples that it receives after the last one, in 12 s. The next process drops an endpoint that does not
/// announce itself within 10 s.
const SAMPLES_AFTER: u64 = 2_400;

/// What became of a publisher's samples over five kills.
struct Kept {
    sent: Sent,
    /// The route in the status.
    route: Value,
    /// How often a reader was matched by the publisher, and unmatched.
    matches: (usize, usize),
    received: Received,
}

/// Kills ingress five times while `publisher` writes at 200 Hz, each time after `before_kill`, and checks the
/// accounts.
fn kill_ingress_five_times(bed: &Bed, publisher: Peer, before_kill: impl Fn()) -> Kept {
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
    let publisher = bed.publish(publisher.rate_hz(RATE_HZ), INPUT);
    subscriber.wait_received(SAMPLES_BETWEEN);
    for kills in 1..=KILLS {
        before_kill();
        signal(bed.pid("ingress"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("ingress").len() == kills + 1);
        subscriber.wait_received(subscriber.received() + SAMPLES_BETWEEN);
    }
    subscriber.wait_received(subscriber.received() + SAMPLES_AFTER);
    let matches = publisher.matches();
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
    println!(
        "{} sent, {} received; repeated {}, lost_upstream {}, dropped by the lane {dropped}; longest gap {:.0} ms; \
         matched, unmatched {matches:?}",
        sent.ok, received.received, route["repeated"], route["lost_upstream"], received.max_gap_ms
    );
    Kept { sent, route, matches, received }
}

/// Samples were kept in the sockets of ingress, or by the publisher, and its reader was the same for it.
fn assert_kept(kept: &Kept, most_lost: u64) {
    let Kept { sent, route, matches, received } = kept;
    let lost = route["lost_upstream"].as_u64().unwrap();
    assert!(lost <= most_lost, "{route}");
    assert_eq!(*matches, (1, 0), "the publisher has matched another reader");
    assert_eq!(received.missing_count, lost, "{sent:?} {received:?}");
}

#[test]
fn a_reliable_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed() {
    let test = "a_reliable_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    assert_kept(&kill_ingress_five_times(&bed, Peer::cyclone().keep_last(1000), || {}), 0);
    bed.end();
}

#[test]
fn nothing_of_a_short_history_is_lost_when_ingress_is_killed() {
    let test = "nothing_of_a_short_history_is_lost_when_ingress_is_killed";
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return;
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    // Ten samples are 50 ms; ingress is down for longer.
    assert_kept(&kill_ingress_five_times(&bed, Peer::rclpy("scanner").keep_last(10), || {}), 0);
    bed.end();
}

#[test]
fn a_best_effort_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed() {
    let test = "a_best_effort_publisher_is_forwarded_once_and_in_order_when_ingress_is_killed";
    for peer in [Peer::cyclone(), Peer::fast()] {
        let Some(bed) = Bed::start(test, SCAN) else { return };
        // A sample that ingress had received and not published when it was killed is lost.
        let kept = kill_ingress_five_times(&bed, peer.best_effort().keep_last(10), || {});
        assert_kept(&kept, KILLS as u64);
        bed.end();
    }
}

/// With a damaged journal of discovery the next process is another participant to the publisher.
#[test]
fn samples_beyond_the_history_of_a_publisher_are_counted_as_lost_upstream() {
    let test = "samples_beyond_the_history_of_a_publisher_are_counted_as_lost_upstream";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let damage = || {
        let files = fs::read_dir("/dev/shm").unwrap().map(|file| file.unwrap().path());
        let is_journal = |path: &PathBuf| {
            let name = path.to_string_lossy();
            name.contains(bed.bridge.instance()) && name.ends_with("journal-ingress")
        };
        fs::write(files.into_iter().find(is_journal).unwrap(), "damaged").unwrap();
    };
    let Kept { route, matches, .. } = kill_ingress_five_times(&bed, Peer::cyclone().keep_last(10), damage);
    assert!(route["lost_upstream"].as_u64() > Some(0), "{route}");
    assert!(matches.0 > 1, "{matches:?}");
    bed.end();
}
