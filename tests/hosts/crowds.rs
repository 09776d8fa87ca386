//! Crowds of bad subscribers of the critical lane: eight kinds of bad subscribers at the same time, beside
//! subscribers of three libraries that keep up. Each test has one rate and sample size.

use std::time::Duration;

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, STANDBYS, outputs};
use support::impairment::Impairment;
use support::netns::Host;
use support::pacer::paced;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// The impairment of the link to the lossy subscribers: a mean loss of 28 %, in bursts.
const LOSS: &str = "--level mild --reading as-run --delay-ms 0 --jitter-ms 0 --seed 24";
/// The impairment of the link to the far subscribers.
const DELAY: &str = "--level clean --delay-ms 200 --jitter-ms 0 --seed 24 --queue 1";

/// The history of the subscribers that keep up: more samples than a test sends at 30 Hz. A sample of which
/// fragments are missing holds back the later ones. On a busy machine a reader with a history of 60 samples
/// of 1 MiB then discards some of them, also without the bridge, and no writer can repair what it has
/// acknowledged.
const HEALTHY_DEPTH: u32 = 1_000;

/// The samples of a flow and its subscribers.
struct Flow {
    rate_hz: f64,
    bytes: usize,
    /// `max_sample_bytes` in the configuration.
    max_sample_bytes: usize,
    /// The history of a bad subscriber. Those that keep up have [`HEALTHY_DEPTH`].
    depth: u32,
    /// The samples that a subscriber that keeps up may lack before the publisher waits for it. The lane
    /// retains 256 samples and 32 MiB for a subscriber that does not acknowledge.
    lag: u64,
    bad: BadLibraries,
    /// Whether the subscribers are on the bridge's host, except the one behind a lossy link. Each remote
    /// subscriber of 1 MiB at 30 Hz takes 23,000 packets a second; two CPUs can handle two such subscribers.
    on_robot: bool,
    /// The kinds of bad subscribers that there are.
    kinds: &'static [&'static str],
}

/// The libraries of the bad subscribers of one kind.
#[derive(Clone, Copy)]
enum BadLibraries {
    /// Each of the three.
    All,
    /// One: the sum of the kind's number and this number selects it. 24 subscribers at 200 Hz alone would
    /// overload two CPUs, so that the test would not measure the bridge.
    Rotated(usize),
}

const ALL_KINDS: &[&str] =
    &["killed", "stopped_1s", "stopped_10s", "stopped_25s", "lossy", "far", "mute", "idle"];

impl Flow {
    fn peer(&self, library: Library, node: &str) -> Peer {
        let peer = match library {
            Library::Rclpy if self.bytes > 64 << 10 => Peer::rclpy(node).large_socket_buffers(),
            Library::Rclpy => Peer::rclpy(node),
            other => Peer::on(other),
        };
        peer.size(self.bytes)
    }

    /// The libraries of the bad subscribers of a kind.
    fn libraries(&self, kind: usize) -> Vec<Library> {
        match self.bad {
            BadLibraries::All => LIBRARIES.to_vec(),
            BadLibraries::Rotated(by) => vec![LIBRARIES[(kind + by) % LIBRARIES.len()]],
        }
    }

    fn subscribe(
        &self,
        bed: &Bed,
        libraries: &[Library],
        (host, node): (&str, &str),
        depth: u32,
    ) -> Vec<RunningPeer> {
        let one =
            |library: &Library| bed.subscribe(host, self.peer(*library, node).keep_last(depth), CRITICAL);
        libraries.iter().map(one).collect()
    }
}

/// Waits until each subscriber has received so many more samples.
fn wait_more(subscribers: &[RunningPeer], more: u64) {
    let goals: Vec<u64> = subscribers.iter().map(|subscriber| subscriber.received() + more).collect();
    for (subscriber, goal) in subscribers.iter().zip(goals) {
        subscriber.wait_received(goal);
    }
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap_or_else(|| panic!("{status}"))
}

/// Drops the acknowledgements of a host. The announcements of its participants still arrive: they are
/// multicast.
fn mute(bed: &Bed, host: &str) {
    let bridge = bed.host("bridge").address().to_string();
    bed.host(host).run("iptables", &["-A", "OUTPUT", "-p", "udp", "-d", &bridge, "-j", "DROP"]);
}

/// Compares the lane's account of the readers on a host with the counts of its subscribers: a reader that was
/// offered every sample and has no overrun belongs to a subscriber that received every sample.
///
/// An overrun is exact only for a reader that is less than 256 samples behind, so that it is not compared.
fn assert_account(status: &Value, host: &Host, subscribers: &[RunningPeer], sent: &Sent) {
    let address = host.address().to_string();
    let readers = critical(status)["matched_readers"].as_array().unwrap().iter();
    let readers: Vec<&Value> = readers.filter(|reader| reader["host"] == address).collect();
    println!("readers on {}: {readers:?}", host.name());
    let is_whole = |reader: &&&Value| reader["offered"] == sent.ok && reader["overrun"] == 0;
    let whole = readers.iter().filter(is_whole).count();
    support::wait_until(format!("every sample at {whole} subscribers on {}", host.name()), || {
        subscribers.iter().filter(|subscriber| subscriber.received() == sent.ok).count() >= whole
    });
}

/// Waits until the readers on some hosts have acknowledged what is retained; returns the status.
fn wait_acknowledged(bed: &Bed, hosts: &[&Host]) -> Value {
    let addresses: Vec<String> = hosts.iter().map(|host| host.address().to_string()).collect();
    bed.bridge.wait_status("all samples acknowledged", |status| {
        let mut readers = critical(status)["matched_readers"].as_array().unwrap().iter();
        readers.all(|reader| {
            reader["unacknowledged"] == 0 || addresses.iter().all(|address| reader["host"] != *address)
        })
    })
}

/// Runs a flow to subscribers that are killed, that stop for 1 s, for 10 s and beyond their lease, that lose
/// 28 % in bursts, that are 200 ms away, that read nothing, and whose acknowledgements never arrive; and to
/// subscribers that keep up, which must receive every sample.
fn crowd(test: &str, flow: &Flow) {
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let yaml = format!(
        "topics:\n  - {{id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
         max_sample_bytes: {}}}\n{STANDBYS}",
        flow.max_sample_bytes
    );
    let _alone = support::exclusive();
    let Some(bed) = Bed::start_with(test, &yaml, &["lossy", "far", "mute", "short"]) else { return };
    let bridge = bed.host("bridge");
    let [near, slow, short] = if flow.on_robot { ["bridge"; 3] } else { ["critical", "slow", "short"] };
    let healthy = flow.subscribe(&bed, &LIBRARIES, (near, "planner"), HEALTHY_DEPTH);
    let bad = [
        (slow, "killed"),
        (short, "stopped_1s"),
        (slow, "stopped_10s"),
        (slow, "stopped_25s"),
        ("lossy", "lossy"),
        ("far", "far"),
        ("mute", "mute"),
    ];
    let mut kind = 0;
    let [killed, short, long, beyond_lease, lossy, far, muted] = bad.map(|(host, node)| {
        kind += 1;
        if !flow.kinds.contains(&node) {
            return Vec::new();
        }
        flow.subscribe(&bed, &flow.libraries(kind), (host, node), flow.depth)
    });
    let idle_libraries = if flow.kinds.contains(&"idle") { flow.libraries(0) } else { Vec::new() };
    let idle = idle_libraries.into_iter().map(|library| {
        let peer = flow.peer(library, "idle").keep_all().stall(1.0, 1_000.0);
        bed.subscribe(slow, peer, CRITICAL)
    });
    let idle: Vec<RunningPeer> = idle.collect();
    let publisher = flow.peer(Library::Cyclone, "").keep_last(1_000).rate_hz(flow.rate_hz);
    let publisher = bed.publish(publisher, INPUT);
    let (mut loss, _delay) = paced(&publisher, &healthy, flow.lag, || {
        let crowd = [&killed, &short, &long, &beyond_lease, &lossy, &far, &muted];
        for subscribers in crowd.into_iter().chain([&healthy]) {
            wait_more(subscribers, 5);
        }
        let loss = Impairment::start(bed.host("lossy"), bridge, LOSS);
        let delay = Impairment::start(bed.host("far"), bridge, DELAY);
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
            wait_more(returned, 5);
        }
        (loss, delay)
    });
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    for subscriber in healthy {
        subscriber.wait_received(sent.ok);
        let received: Received = subscriber.end();
        println!("{:?}", received.latency_us);
        received.assert_all_of(&sent);
    }
    let status = bed.wait_accounted();
    assert_eq!(critical(&status)["forwarded"], sent.ok, "{status}");
    // A subscriber with a shorter history may itself discard samples that it has acknowledged.
    if f64::from(flow.depth) >= 5.0 * flow.rate_hz {
        loss.off();
        let never_unmatched = [("short", &short), ("lossy", &lossy), ("far", &far)];
        let hosts = never_unmatched.map(|(host, _)| bed.host(host));
        let status = wait_acknowledged(&bed, &hosts);
        for (host, (_, subscribers)) in hosts.into_iter().zip(never_unmatched) {
            assert_account(&status, host, subscribers, &sent);
        }
    }
    for subscriber in [short, long, beyond_lease, lossy, far, muted].into_iter().flatten() {
        let received: Received = subscriber.end();
        received.assert_sound();
        println!("{} of {} samples", received.received, sent.ok);
    }
    for mut subscriber in idle {
        subscriber.kill9();
    }
    bed.assert_no_take_over();
    bed.end();
}

#[test]
fn a_crowd_at_200_hz_costs_the_others_no_sample() {
    let flow = Flow {
        rate_hz: 200.0,
        bytes: 2_948,
        max_sample_bytes: 65_536,
        depth: 1_000,
        lag: 100,
        on_robot: false,
        kinds: ALL_KINDS,
        bad: BadLibraries::Rotated(0),
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
        lag: 200,
        on_robot: false,
        kinds: ALL_KINDS,
        bad: BadLibraries::Rotated(1),
    };
    crowd("a_crowd_at_1_khz_costs_the_others_no_sample", &flow);
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn a_crowd_at_30_hz_costs_the_others_no_sample() {
        let flow = Flow {
            rate_hz: 30.0,
            bytes: 2_948,
            max_sample_bytes: 65_536,
            depth: 1_000,
            lag: 100,
            on_robot: false,
            kinds: ALL_KINDS,
            bad: BadLibraries::All,
        };
        crowd("a_crowd_at_30_hz_costs_the_others_no_sample", &flow);
    }

    #[test]
    fn a_crowd_at_30_hz_of_1_mib_costs_the_others_no_sample() {
        let flow = Flow {
            rate_hz: 30.0,
            bytes: 1 << 20,
            max_sample_bytes: 2 << 20,
            depth: 60,
            lag: 12,
            on_robot: true,
            kinds: &["killed", "stopped_1s", "stopped_10s", "stopped_25s", "lossy", "idle"],
            bad: BadLibraries::Rotated(2),
        };
        crowd("a_crowd_at_30_hz_of_1_mib_costs_the_others_no_sample", &flow);
    }

    #[test]
    fn far_and_mute_subscribers_of_1_mib_at_30_hz_cost_the_others_no_sample() {
        let flow = Flow {
            rate_hz: 30.0,
            bytes: 1 << 20,
            max_sample_bytes: 2 << 20,
            depth: 60,
            lag: 12,
            on_robot: true,
            kinds: &["far", "mute"],
            bad: BadLibraries::Rotated(2),
        };
        crowd("far_and_mute_subscribers_of_1_mib_at_30_hz_cost_the_others_no_sample", &flow);
    }
}
