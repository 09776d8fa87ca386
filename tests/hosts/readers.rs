//! Subscribers of the critical lane that crash, stop, join and leave, beside subscribers that keep up, on
//! rclpy, Fast DDS and Cyclone DDS. Each event is applied to a second flow without the bridge as well.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, outputs};
use support::pacer::paced;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::signal;
use support::ros;

/// A topic that the bridge does not know.
const PLAIN: &str = "rt/plain";
const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
const RATE_HZ: f64 = 200.0;

/// Starts a bridge on a separate host; `None` if the machine lacks the requirements of `test`.
fn bed(test: &str) -> Option<Bed> {
    bed_with(test, SCAN)
}

fn bed_with(test: &str, yaml: &str) -> Option<Bed> {
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return None;
    }
    Bed::start(test, yaml)
}

fn peer(library: Library, node: &str) -> Peer {
    match library {
        Library::Rclpy => Peer::rclpy(node),
        other => Peer::on(other),
    }
}

/// Two flows with the same publisher and subscribers: one through the bridge, one without it.
struct Scene<'b> {
    bed: &'b Bed,
    flows: [Flow; 2],
}

struct Flow {
    publisher: RunningPeer,
    /// Subscribers that keep up: a ROS 2 node, Fast DDS and Cyclone DDS.
    healthy: Vec<RunningPeer>,
}

impl<'b> Scene<'b> {
    /// Starts both flows and waits until every subscriber receives samples. The publishers are rclpy nodes
    /// with a depth of 1,000 samples, which are 5 s.
    fn start(bed: &'b Bed) -> Self {
        let healthy = |topic| -> Vec<RunningPeer> {
            LIBRARIES.map(|library| subscribe(bed, "critical", library, "planner", topic)).into()
        };
        let publisher = |node| Peer::rclpy(node).publisher().keep_last(1000).rate_hz(RATE_HZ);
        let bridged = healthy(CRITICAL);
        let plain = healthy(PLAIN);
        let host = bed.host("publisher");
        // A VOLATILE subscriber on Cyclone DDS discards samples before a writer's first heartbeat as history,
        // so that the publisher without the bridge sends a priming sample. The bridge's writer was matched
        // before it had samples.
        let publishers = [
            publisher("scanner").topic(INPUT).wait_match(1).start_on(host),
            publisher("plain_scanner").topic(PLAIN).wait_match(LIBRARIES.len()).prime().hold().start_on(host),
        ];
        for subscriber in &plain {
            subscriber.wait_matched(1);
        }
        let [publisher, plain_publisher] = publishers;
        plain_publisher.go();
        let flows =
            [Flow { publisher, healthy: bridged }, Flow { publisher: plain_publisher, healthy: plain }];
        let scene = Self { bed, flows };
        scene.wait_more(100);
        scene
    }

    /// Waits until every subscriber that keeps up has received so many more samples.
    fn wait_more(&self, samples: u64) {
        wait_more(self.flows.iter().flat_map(|flow| &flow.healthy), samples);
    }

    /// Does some work while no subscriber that keeps up lacks more than 100 samples; the lane retains 256.
    fn paced(&self, work: impl FnOnce()) {
        let [bridged, plain] = &self.flows;
        paced(&bridged.publisher, &bridged.healthy, 100, || {
            paced(&plain.publisher, &plain.healthy, 100, work);
        });
    }

    /// Starts one more subscriber of each library on another host; returns those of the bridge, then the
    /// others.
    fn join(&self, node: &str) -> [Vec<RunningPeer>; 2] {
        let join = |topic| LIBRARIES.map(|library| subscribe(self.bed, "slow", library, node, topic)).into();
        [CRITICAL, PLAIN].map(join)
    }

    /// Ends both flows. Asserts that each subscriber that keeps up received every sample, with and without
    /// the bridge, and that the critical lane forwarded every sample.
    fn end(self) {
        let [bridged, plain] = self.flows;
        plain.end();
        let sent = bridged.end();
        let status = self.bed.wait_accounted();
        let critical = critical(&status);
        assert_eq!(critical["received"], sent.ok, "{critical}");
        assert_eq!(critical["forwarded"], sent.ok, "{critical}");
    }
}

impl Flow {
    /// Ends the flow. Asserts that each subscriber that keeps up received every sample.
    fn end(self) -> Sent {
        let sent: Sent = self.publisher.end();
        assert_eq!(sent.failed, 0, "{sent:?}");
        for subscriber in self.healthy {
            subscriber.wait_received(sent.ok);
            subscriber.end::<Received>().assert_all_of(&sent);
        }
        sent
    }
}

/// Waits until each subscriber has received so many more samples.
fn wait_more<'a>(subscribers: impl IntoIterator<Item = &'a RunningPeer>, samples: u64) {
    let goals = subscribers.into_iter().map(|subscriber| (subscriber, subscriber.received() + samples));
    for (subscriber, goal) in goals.collect::<Vec<_>>() {
        subscriber.wait_received(goal);
    }
}

/// Starts a RELIABLE subscriber with a depth of 1,000 samples; one of the bridge is matched on both sides.
fn subscribe(bed: &Bed, host: &str, library: Library, node: &str, topic: &str) -> RunningPeer {
    let peer = peer(library, node).keep_last(1000);
    if topic == PLAIN {
        peer.subscriber().topic(topic).start_on(bed.host(host))
    } else {
        bed.subscribe(host, peer, topic)
    }
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap_or_else(|| panic!("{status}"))
}

#[test]
fn killed_critical_subscribers_cost_the_others_no_sample() {
    let Some(bed) = bed("killed_critical_subscribers_cost_the_others_no_sample") else { return };
    let scene = Scene::start(&bed);
    scene.paced(|| {
        for mut victim in scene.join("crashing").into_iter().flatten() {
            victim.wait_received(10);
            victim.kill9();
        }
        // Four times the samples that a writer retains for a subscriber that does not acknowledge, sent long
        // before a lease ends.
        scene.wait_more(1024);
    });
    scene.end();
    bed.end();
}

#[test]
fn critical_subscribers_stopped_beyond_their_lease_cost_the_others_no_sample_and_receive_again() {
    let test = "critical_subscribers_stopped_beyond_their_lease_cost_the_others_no_sample_and_receive_again";
    let Some(bed) = bed(test) else { return };
    let scene = Scene::start(&bed);
    scene.paced(|| {
        let stopped = scene.join("debugged");
        for victim in stopped.iter().flatten() {
            victim.wait_received(10);
            victim.stop();
        }
        // The lease of a participant is 20 s in Fast DDS and 10 s in Cyclone DDS.
        std::thread::sleep(Duration::from_secs(22));
        scene.wait_more(100);
        for victim in stopped.iter().flatten() {
            victim.cont();
        }
        // Without the bridge, Fast DDS 2.14 does not serve its subscriber again.
        let [bridged, _plain] = stopped;
        wait_more(&bridged, 100);
        for victim in bridged {
            victim.end::<Received>().assert_sound();
        }
        // When a lease ended, the lane had evicted thousands of samples that the subscriber lacked.
        bed.bridge.wait_status("the losses of the stopped subscribers", |status| {
            critical(status)["reader_overrun"].as_u64() > Some(0)
        });
    });
    scene.end();
    bed.end();
}

#[test]
fn twenty_critical_subscribers_that_join_and_leave_cost_the_others_no_sample_and_receive_no_history() {
    let test =
        "twenty_critical_subscribers_that_join_and_leave_cost_the_others_no_sample_and_receive_no_history";
    let Some(bed) = bed(test) else { return };
    let scene = Scene::start(&bed);
    scene.paced(|| twenty_visits(&bed, &scene.flows[0].healthy[1]));
    scene.wait_more(512);
    scene.end();
    bed.end();
}

/// Starts subscribers of both flows one after the other; half of them leave normally, the others are killed.
fn twenty_visits(bed: &Bed, planner: &RunningPeer) {
    for visit in 0..20 {
        let library = LIBRARIES[visit % LIBRARIES.len()];
        let published = planner.received();
        let visitors = [CRITICAL, PLAIN].map(|topic| subscribe(bed, "slow", library, "visitor", topic));
        for (mut visitor, topic) in visitors.into_iter().zip([CRITICAL, PLAIN]) {
            visitor.wait_received(10);
            if visit % 2 == 0 {
                let received: Received = visitor.end();
                received.assert_sound();
                if topic == CRITICAL {
                    assert_eq!(received.missing_count, 0, "{library:?}: {received:?}");
                    assert!(received.first >= Some(published), "{library:?} after {published}: {received:?}");
                }
            } else {
                visitor.kill9();
            }
        }
    }
}

#[test]
fn all_samples_forwarded_by_a_critical_egress_killed_five_times_reach_every_subscriber() {
    let test = "all_samples_forwarded_by_a_critical_egress_killed_five_times_reach_every_subscriber";
    kill_beside_subscribers(test, |bed, subscribers| {
        for _ in 1..=5 {
            kill_critical(bed);
            wait_more(subscribers, 100);
        }
    });
}

/// The process between the two kills has not matched all subscribers again, and the next one must wait for
/// those, too. A subscriber that dies with the lane never matches again, and the wait for it must end.
#[test]
fn all_samples_forwarded_by_a_critical_egress_killed_twice_in_a_moment_reach_every_subscriber() {
    let test = "all_samples_forwarded_by_a_critical_egress_killed_twice_in_a_moment_reach_every_subscriber";
    kill_beside_subscribers(test, |bed, subscribers| {
        let forwarded = || critical(&bed.bridge.status())["forwarded"].as_u64().unwrap();
        for with_a_subscriber in [false, false, true] {
            if with_a_subscriber {
                let mut victim = subscribe(bed, "slow", Library::Fast, "victim", CRITICAL);
                victim.wait_received(10);
                victim.kill9();
            }
            kill_critical(bed);
            std::thread::sleep(Duration::from_millis(300));
            kill_critical(bed);
            let before = forwarded();
            support::wait_until("samples that count as forwarded", || forwarded() > before + 100);
            wait_more(subscribers, 100);
        }
    });
}

#[test]
fn what_a_killed_critical_egress_had_not_repaired_the_next_process_repairs() {
    let test = "what_a_killed_critical_egress_had_not_repaired_the_next_process_repairs";
    let Some((missed, dropped, _)) = kill_during_an_outage(test, SCAN) else { return };
    assert!(missed.into_iter().all(|missed| missed <= dropped), "missed {missed:?}, dropped {dropped}");
}

#[test]
fn samples_that_a_killed_critical_egress_had_not_repaired_are_counted_as_unconfirmed() {
    let test = "samples_that_a_killed_critical_egress_had_not_repaired_are_counted_as_unconfirmed";
    // A latched output has another writer after a kill, which can't repair what counts as forwarded.
    let latched = "qos_overrides: {critical: {durability: TRANSIENT_LOCAL, depth: 1}}}";
    let yaml = SCAN.replace('}', &format!(", {latched}"));
    let Some((missed, dropped, unconfirmed)) = kill_during_an_outage(test, &yaml) else { return };
    let account = format!("missed {missed:?}, dropped {dropped}, unconfirmed {unconfirmed}");
    assert!(missed.into_iter().all(|missed| missed <= dropped + unconfirmed), "{account}");
    assert!(missed.into_iter().any(|missed| missed > dropped + 50), "the lane repaired all: {account}");
}

/// Kills the critical egress at the end of an outage of its subscribers. Returns how many samples each of
/// them missed, and how many count as dropped and as unconfirmed.
fn kill_during_an_outage(test: &str, yaml: &str) -> Option<([u64; 3], u64, u64)> {
    let bed = bed_with(test, yaml)?;
    let subscribers = LIBRARIES.map(|library| subscribe(&bed, "slow", library, "planner", CRITICAL));
    let publisher = bed.publish(Peer::rclpy("scanner").keep_last(1000).rate_hz(RATE_HZ), INPUT);
    wait_more(&subscribers, 100);
    bed.host("slow").lose_incoming(1.0);
    // 100 samples at 200 Hz; the lane retains 256 for repairs.
    std::thread::sleep(Duration::from_millis(500));
    kill_critical(&bed);
    bed.host("slow").lose_incoming(0.0);
    wait_more(&subscribers, 100);
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    let status = bed.wait_accounted();
    let critical = critical(&status);
    let dropped: u64 = critical["drops"].as_object().unwrap().values().filter_map(Value::as_u64).sum();
    let unconfirmed = critical["unconfirmed"].as_u64().unwrap();
    let missed = subscribers.map(|subscriber| {
        subscriber.wait_for("the last sample", |event| event["last"] == sent.last);
        let received: Received = subscriber.end();
        received.assert_sound();
        received.missing_count
    });
    bed.end();
    Some((missed, dropped, unconfirmed))
}

/// Kills the critical egress and waits until the next process was started.
fn kill_critical(bed: &Bed) {
    let started = bed.pids("egress-critical").len();
    signal(bed.pid("egress-critical"), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids("egress-critical").len() > started);
}

/// Does some work that kills the critical egress beside a subscriber of each library. Asserts that the
/// account is complete and that each of them received every sample that counts as forwarded.
fn kill_beside_subscribers(test: &str, work: impl FnOnce(&Bed, &[RunningPeer])) {
    let Some(bed) = bed(test) else { return };
    let subscribers = LIBRARIES.map(|library| subscribe(&bed, "critical", library, "planner", CRITICAL));
    let publisher = Peer::rclpy("scanner").keep_last(1000).rate_hz(RATE_HZ);
    let publisher = bed.publish(publisher, INPUT);
    subscribers[0].wait_received(100);
    work(&bed, &subscribers);
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    let status = bed.wait_accounted();
    let critical = critical(&status);
    let forwarded = critical["forwarded"].as_u64().unwrap();
    let dropped: u64 = critical["drops"].as_object().unwrap().values().filter_map(Value::as_u64).sum();
    assert_eq!(forwarded + dropped, sent.ok, "every sample is forwarded or has a drop reason: {critical}");
    for subscriber in subscribers {
        subscriber.wait_for("the last sample", |event| event["last"] == sent.last);
        let received: Received = subscriber.end();
        received.assert_sound();
        // Samples written before all three were matched again count as `no_reader`; some subscribers received
        // them.
        let no_reader = critical["drops"]["no_reader"].as_u64().unwrap();
        // And one for each kill may have been written and not yet counted: it counts as `lane_down`.
        let kills = bed.pids("egress-critical").len() as u64 - 1;
        let uncounted = kills.min(critical["drops"]["lane_down"].as_u64().unwrap());
        let possible = forwarded..=forwarded + no_reader + uncounted;
        assert!(possible.contains(&received.received), "{received:?} of {critical}");
    }
    bed.end();
}

/// A Cyclone DDS reader keeps up to 16 samples of which fragments are lost, and discards the fragments of
/// newer ones until the writer withdraws the old ones.
#[test]
fn best_effort_subscribers_receive_again_after_many_lost_fragments() {
    let test = "best_effort_subscribers_receive_again_after_many_lost_fragments";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscribers = [Library::Cyclone, Library::Fast, Library::Rust].map(|library| {
        let reader = || Peer::on(library).best_effort().keep_all();
        [CRITICAL, NONCRITICAL].map(|topic| bed.subscribe("slow", reader(), topic))
    });
    let subscribers = subscribers.into_iter().flatten().collect::<Vec<_>>();
    let publisher = bed.publish(Peer::cyclone().rate_hz(50.0), INPUT);
    let all_receive = |samples| {
        let before: Vec<u64> = subscribers.iter().map(RunningPeer::received).collect();
        support::wait_until(format!("{samples} samples more than {before:?}"), || {
            let now = subscribers.iter().map(RunningPeer::received);
            now.zip(&before).all(|(now, before)| now > before + samples)
        });
    };
    all_receive(20);
    bed.host("slow").lose_incoming(0.5);
    // Of 250 samples and 50 of the noncritical lane, in three datagrams each, an eighth arrives whole, and
    // another eighth not at all.
    std::thread::sleep(Duration::from_secs(5));
    bed.host("slow").lose_incoming(0.0);
    all_receive(20);
    let _: Sent = publisher.end();
    for subscriber in subscribers {
        subscriber.end::<Received>().assert_sound();
    }
    bed.wait_accounted();
    bed.end();
}
