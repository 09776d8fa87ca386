//! Samples that ingress misses: which of them it requests from a publisher, and how often the publisher sends
//! them.

use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, STANDBYS};
use support::flow::lane;
use support::peer::{Peer, Received, RunningPeer, Sent};

use super::standby::wait_standby;

const RATE_HZ: f64 = 500.0;
/// What the publisher keeps. Cyclone DDS and Fast DDS keep samples that ingress has received as long as they
/// have not asked whether it has, which may take seconds.
const KEPT: u32 = 2_000;
const KEPT_FOR_OUTAGES: u32 = 10_000;
const TAKE_OVERS: u64 = 3;
const OUTAGES: u64 = 3;
/// Fast DDS needs up to 3 s more until it sends a HEARTBEAT, after which the missing samples are requested.
const OUTAGE: Duration = Duration::from_millis(1_500);
/// The most that a publisher sends for what it writes, repairs of lost samples included, as a multiple of
/// what it sends while none is lost.
const MAX_RATIO: f64 = 1.5;

struct Sending<'b> {
    bed: &'b Bed,
    publisher: &'b RunningPeer,
    bytes: u64,
    written: u64,
}

impl<'b> Sending<'b> {
    fn begin(bed: &'b Bed, publisher: &'b RunningPeer) -> Self {
        Self { bed, publisher, bytes: bed.host("publisher").sent_bytes(), written: publisher.written() }
    }

    /// The bytes that the publisher's host has sent since the begin for each written sample.
    fn bytes_for_each(&self) -> f64 {
        let bytes = self.bed.host("publisher").sent_bytes() - self.bytes;
        bytes as f64 / (self.publisher.written() - self.written) as f64
    }
}

/// Beside a BEST_EFFORT publisher ingress has a second reader of the topic, which begins with what is sent
/// from now on.
#[test]
fn a_take_over_of_ingress_requests_no_sample_that_ingress_has_received() {
    let test = "a_take_over_of_ingress_requests_no_sample_that_ingress_has_received";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &format!("{SCAN}{STANDBYS}")) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_last(KEPT).rate_hz(RATE_HZ), INPUT);
    let other = Peer::cyclone().best_effort().rate_hz(1.0).first_seq(1 << 32);
    let other = bed.publish(other, INPUT);
    bed.bridge.wait_status("both publishers", |status| status["routes"][0]["writers"] == 2);
    subscriber.wait_received(u64::from(KEPT));
    let undisturbed = Sending::begin(&bed, &publisher);
    subscriber.wait_received(u64::from(KEPT) + 400);
    let undisturbed = undisturbed.bytes_for_each();

    let disturbed = Sending::begin(&bed, &publisher);
    for _ in 0..TAKE_OVERS {
        kill(Pid::from_raw(wait_standby(&bed, "ingress")), Signal::SIGKILL).unwrap();
        subscriber.wait_received(subscriber.received() + 300);
    }
    let ratio = disturbed.bytes_for_each() / undisturbed;
    println!("{ratio:.2} times the bytes with {TAKE_OVERS} take-overs");
    let _: Sent = other.end();
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    let status = bed.wait_accounted();
    assert_eq!(status["routes"][0]["lost_upstream"], 0, "{status}");
    assert!(ratio < MAX_RATIO, "{ratio}\n{}", bed.up.log());
    let received: Received = subscriber.end();
    assert_eq!((received.bad, received.duplicates), (0, 0), "{received:?}");
    bed.end();
}

/// With each sample that a publisher repairs comes a HEARTBEAT, to which ingress must not answer with one
/// more request for all that is missing.
#[test]
fn a_publisher_sends_each_sample_that_ingress_missed_about_once() {
    let test = "a_publisher_sends_each_sample_that_ingress_missed_about_once";
    let _alone = support::exclusive();
    for (vendor, peer) in [("Cyclone DDS", Peer::cyclone()), ("Fast DDS", Peer::fast())] {
        let Some(bed) = Bed::start(test, SCAN) else { return };
        let subscriber = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
        let publisher = bed.publish(peer.keep_last(KEPT_FOR_OUTAGES).rate_hz(RATE_HZ), INPUT);
        subscriber.wait_received(100);
        let undisturbed = Sending::begin(&bed, &publisher);
        subscriber.wait_received(500);
        let undisturbed = undisturbed.bytes_for_each();

        let disturbed = Sending::begin(&bed, &publisher);
        for _ in 0..OUTAGES {
            bed.host("publisher").set_link(false);
            std::thread::sleep(OUTAGE);
            bed.host("publisher").set_link(true);
            std::thread::sleep(OUTAGE);
        }
        let written = publisher.written();
        bed.bridge.wait_status("the missing samples", |status| {
            status["routes"][0]["received"].as_u64() >= Some(written)
        });
        let ratio = disturbed.bytes_for_each() / undisturbed;
        println!("{vendor}: {ratio:.2} times the bytes with {OUTAGES} outages");
        let sent: Sent = publisher.end();
        sent.assert_not_blocked();
        let status = bed.wait_accounted();
        assert_eq!(status["routes"][0]["lost_upstream"], 0, "{vendor}: {status}");
        assert!(ratio < MAX_RATIO, "{vendor}: {ratio}\n{}", bed.up.log());
        // More samples at once than the queue of a lane has places for may cost some of them.
        let forwarded = lane(&status, "critical")["forwarded"].as_u64().unwrap();
        subscriber.wait_received(forwarded);
        let received: Received = subscriber.end();
        received.assert_sound();
        assert_eq!(received.received, forwarded, "{vendor}: {status}");
        bed.end();
    }
}
