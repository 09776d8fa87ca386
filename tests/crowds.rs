//! Crowds of bad subscribers of the critical lane: eight ways to be bad, all at once, beside subscribers of
//! three libraries that keep up. Each test is one rate and size.

mod support;

use std::time::Duration;

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, outputs};
use support::impairment::Impairment;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// The mean loss of the link to a bad subscriber is 28 %, in bursts.
const LOSS: &str = "--level mild --reading as-run --delay-ms 0 --jitter-ms 0 --seed 24";
const DELAY: &str = "--level clean --delay-ms 200 --jitter-ms 0 --seed 24 --queue 1";

/// What flows.
struct Flow {
    rate_hz: f64,
    bytes: usize,
    /// Bytes that a sample may have in the configuration.
    max_sample_bytes: usize,
    /// The history of a subscriber.
    depth: u32,
    /// Which libraries a kind of bad subscriber has.
    bad: Bad,
    /// Whether the subscribers are on the bridge's host, but for the one behind a lossy link. Each remote
    /// subscriber of 1 MiB at 30 Hz is 23,000 packets a second; two CPUs carry two such subscribers.
    on_robot: bool,
}

/// Which libraries a kind of bad subscriber has.
#[derive(Clone, Copy)]
enum Bad {
    /// Each of the three.
    OfEach,
    /// One: that of the kind's number and this one. 24 subscribers at 200 Hz overload two CPUs by themselves,
    /// and so would tell nothing of the bridge.
    Rotated(usize),
}

impl Flow {
    fn peer(&self, library: Library, node: &str) -> Peer {
        let peer = match library {
            Library::Rclpy => Peer::rclpy(node),
            other => Peer::on(other),
        };
        peer.keep_last(self.depth).size(self.bytes)
    }

    /// The libraries of the bad subscribers of that kind.
    fn libraries(&self, kind: usize) -> Vec<Library> {
        match self.bad {
            Bad::OfEach => LIBRARIES.to_vec(),
            Bad::Rotated(by) => vec![LIBRARIES[(kind + by) % LIBRARIES.len()]],
        }
    }

    fn subscribe(&self, bed: &Bed, libraries: &[Library], host: &str, node: &str) -> Vec<RunningPeer> {
        let one = |library: &Library| bed.subscribe(host, self.peer(*library, node), CRITICAL);
        libraries.iter().map(one).collect()
    }
}

/// Waits until so many more samples have come to each.
fn all_receive(subscribers: &[RunningPeer], more: u64) {
    let goals: Vec<u64> = subscribers.iter().map(|subscriber| subscriber.received() + more).collect();
    for (subscriber, goal) in subscribers.iter().zip(goals) {
        subscriber.wait_received(goal);
    }
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap_or_else(|| panic!("{status}"))
}

/// Lets no acknowledgement of the host arrive. The announcements of its participants do: they are multicast.
fn mute(bed: &Bed, host: &str) {
    let bridge = bed.host("bridge").address().to_string();
    bed.host(host).run("iptables", &["-A", "OUTPUT", "-p", "udp", "-d", &bridge, "-j", "DROP"]);
}

/// The flow past subscribers that are killed, that stop for 1 s, for 10 s and past their lease, that lose
/// 28 % in bursts, that are 200 ms away, that read nothing, and whose acknowledgements never arrive.
fn crowd(test: &str, flow: &Flow) {
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let yaml = format!(
        "topics:\n  - {{id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
         max_sample_bytes: {}}}\n",
        flow.max_sample_bytes
    );
    let Some(bed) = Bed::start_with(test, &yaml, &["lossy", "far", "mute"]) else { return };
    let bridge = bed.host("bridge");
    let [near, slow] = if flow.on_robot { ["bridge"; 2] } else { ["critical", "slow"] };
    let healthy = flow.subscribe(&bed, &LIBRARIES, near, "planner");
    let bad = [
        (slow, "killed"),
        (slow, "stopped_1s"),
        (slow, "stopped_10s"),
        (slow, "stopped_25s"),
        ("lossy", "lossy"),
        ("far", "far"),
        ("mute", "mute"),
    ];
    let mut kind = 0;
    let [killed, short, long, beyond_lease, lossy, far, muted] = bad.map(|(host, node)| {
        kind += 1;
        if flow.on_robot && ["far", "mute"].contains(&host) {
            return Vec::new();
        }
        flow.subscribe(&bed, &flow.libraries(kind), host, node)
    });
    let idle = flow.libraries(0).into_iter().map(|library| {
        let peer = flow.peer(library, "idle").keep_all().stall(1.0, 1_000.0);
        bed.subscribe(slow, peer, CRITICAL)
    });
    let idle: Vec<RunningPeer> = idle.collect();
    let publisher = flow.peer(Library::Cyclone, "").keep_last(1_000).rate_hz(flow.rate_hz);
    let publisher = bed.publish(publisher, INPUT);
    let crowd = [&killed, &short, &long, &beyond_lease, &lossy, &far, &muted];
    for subscribers in crowd.into_iter().chain([&healthy]) {
        all_receive(subscribers, 5);
    }
    let _loss = Impairment::start(bed.host("lossy"), bridge, LOSS);
    let _delay = Impairment::start(bed.host("far"), bridge, DELAY);
    mute(&bed, "mute");
    for mut victim in killed {
        victim.kill9();
    }
    for victim in [&short, &long, &beyond_lease].into_iter().flatten() {
        victim.stop();
    }
    // The lease of a participant is 20 s in Fast DDS and 10 s in Cyclone DDS.
    for (stopped, after_s) in [(&short, 1), (&long, 9), (&beyond_lease, 12)] {
        std::thread::sleep(Duration::from_secs(after_s));
        for victim in stopped {
            victim.cont();
        }
    }
    for returned in [&short, &long, &beyond_lease, &lossy, &far] {
        all_receive(returned, 5);
    }
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "no call of the publisher waited in vain: {sent:?}");
    for subscriber in healthy {
        subscriber.wait_received(sent.ok);
        subscriber.end::<Received>().assert_all_of(&sent);
    }
    let status = bed.wait_whole();
    assert_eq!(critical(&status)["forwarded"], sent.ok, "{status}");
    for subscriber in [short, long, beyond_lease, lossy, far, muted].into_iter().flatten() {
        let received: Received = subscriber.end();
        received.assert_sound();
        println!("{} of {} samples", received.received, sent.ok);
    }
    for mut one in idle {
        one.kill9();
    }
    bed.end();
}

#[test]
fn a_crowd_at_30_hz_costs_the_others_no_sample() {
    let flow = Flow {
        rate_hz: 30.0,
        bytes: 2_948,
        max_sample_bytes: 65_536,
        depth: 1_000,
        on_robot: false,
        bad: Bad::OfEach,
    };
    crowd("a_crowd_at_30_hz_costs_the_others_no_sample", &flow);
}

#[test]
fn a_crowd_at_200_hz_costs_the_others_no_sample() {
    let flow = Flow {
        rate_hz: 200.0,
        bytes: 2_948,
        max_sample_bytes: 65_536,
        depth: 1_000,
        on_robot: false,
        bad: Bad::Rotated(0),
    };
    crowd("a_crowd_at_200_hz_costs_the_others_no_sample", &flow);
}

#[test]
fn a_crowd_at_1_khz_costs_the_others_no_sample() {
    let flow = Flow {
        rate_hz: 1_000.0,
        bytes: 1_000,
        max_sample_bytes: 65_536,
        depth: 1_000,
        on_robot: false,
        bad: Bad::Rotated(1),
    };
    crowd("a_crowd_at_1_khz_costs_the_others_no_sample", &flow);
}

#[test]
fn a_crowd_at_30_hz_of_1_mib_costs_the_others_no_sample() {
    let flow = Flow {
        rate_hz: 30.0,
        bytes: 1 << 20,
        max_sample_bytes: 2 << 20,
        depth: 60,
        on_robot: true,
        bad: Bad::Rotated(2),
    };
    crowd("a_crowd_at_30_hz_of_1_mib_costs_the_others_no_sample", &flow);
}
