//! The bridge between DDS libraries: Cyclone DDS and Fast DDS programs as publishers and subscribers on hosts of
//! their own (network namespaces), the bridge on a third one. Every payload is compared by hash.

mod support;

use serde_json::Value;
use support::bridge::Bridge;
use support::netns::{Host, Net};
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::Process;

const LIBRARIES: [Library; 2] = [Library::Cyclone, Library::Fast];

/// A bridge that runs on the host `bridge`, and the hosts around it.
struct Bed {
    // Dropped in this order: the processes before the hosts they run on.
    up: Process,
    bridge: Bridge,
    net: Net,
}

impl Bed {
    /// Starts a bridge with these `topics` and further keys, or records that the machine can't.
    fn start(test: &str, yaml: &str) -> Option<Self> {
        if let Some(reason) = support::testbed_missing() {
            support::skip(test, &reason);
            return None;
        }
        let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
        let bridge = Bridge::new(&format!("instance: {{instance}}\n{yaml}"));
        let up = bridge.start_on(net.host("bridge"), "up");
        up.wait_for_log("ingress is up");
        Some(Self { up, bridge, net })
    }

    fn host(&self, name: &str) -> &Host {
        self.net.host(name)
    }

    /// A subscriber on a lane's output of a topic, matched with the bridge's writer when the publisher is.
    fn subscribe(&self, host: &str, peer: Peer, topic: &str) -> RunningPeer {
        peer.subscriber().topic(topic).start_on(self.host(host))
    }

    /// Asks the bridge to end, and checks that it does so as it should.
    fn end(mut self) {
        let status = self.up.terminate();
        assert!(status.success(), "up ended with {status}\n{}", self.up.log());
    }
}

/// Whether every lane and route accounts for every sample, and none waits.
fn is_whole_and_quiet(status: &Value) -> bool {
    let lanes = status["lanes"].as_array().into_iter().flatten();
    let mut routes = lanes.flat_map(|lane| lane["routes"].as_array().into_iter().flatten()).peekable();
    routes.peek().is_some() && routes.all(|route| route["whole"] == true && route["waiting"] == 0)
}

/// What a subscriber missed from sample `first` on. What came before, while the endpoints found each other, is
/// nobody's loss: the writers are VOLATILE.
fn missing_from(received: &Received, first: u64) -> Vec<(u64, u64)> {
    received.missing.iter().copied().filter(|(_, last)| *last >= first).collect()
}

const SCAN: &str = "topics:\n  - {id: scan, input_topic: /scan, max_sample_bytes: 65536}\n";
const CRITICAL: &str = "rt/adaptive_bridge/critical/scan";
const NONCRITICAL: &str = "rt/adaptive_bridge/noncritical/scan";

#[test]
fn every_library_reaches_every_library_through_both_lanes() {
    let test = "every_library_reaches_every_library_through_both_lanes";
    for from in LIBRARIES {
        for to in LIBRARIES {
            let Some(bed) = Bed::start(test, SCAN) else { return };
            let peer = |library| Peer::on(library).keep_all().seed(11).size(2948);
            let critical = bed.subscribe("critical", peer(to), CRITICAL);
            let noncritical = bed.subscribe("slow", peer(to).best_effort(), NONCRITICAL);
            // A sample now and then until both lanes are through, because the type is found by discovery.
            let first = peer(from).publisher().topic("rt/scan").rate_hz(20.0).count(4_000);
            let scout = first.wait_match(1).start_on(bed.host("publisher"));
            critical.wait_received(1);
            noncritical.wait_received(1);
            let _: Sent = scout.end();

            let again = peer(from).publisher().topic("rt/scan").rate_hz(200.0).count(400).wait_match(1);
            let publisher = again.first_seq(10_000).start_on(bed.host("publisher"));
            let sent: Sent = publisher.finish();
            assert_eq!((sent.ok, sent.failed), (400, 0), "{from:?} to {to:?}");
            let critical_last = critical.wait_for("the last sample", |event| event["last"] == 10_399);
            assert!(critical_last["received"].as_u64() > Some(400), "{critical_last}");
            // bed.bridge.wait_status("every lane whole and quiet", is_whole_and_quiet);

            let received: Received = critical.end();
            received.assert_sound();
            assert!(missing_from(&received, 10_000).is_empty(), "{from:?} to {to:?}: {received:?}");
            assert_eq!(received.source_timestamps_changed, 0, "{from:?} to {to:?}: {received:?}");
            let slow: Received = noncritical.end();
            slow.assert_sound();
            assert_eq!(slow.headers, received.headers.clone().into_keys().zip([slow.received]).collect());
            assert_eq!(slow.source_timestamps_changed, 0);
            bed.end();
        }
    }
}
