//! RELIABLE subscribers of a noncritical lane, as rclpy and RViz create them by default, beside BEST_EFFORT
//! ones.

use serde_json::Value;
use support::bed::{Bed, INPUT, NONCRITICAL, SCAN, is_accounted_and_idle, outputs};
use support::impairment::Impairment;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// A mean loss of 28 %, in bursts, of what a subscriber receives.
const LOSS: &str = "--level mild --reading as-run --delay-ms 0 --jitter-ms 0 --seed 24";
/// The same loss of what a subscriber sends, so that answers to HEARTBEATs are lost independently.
const LOSS_OF_ANSWERS: &str = "--level mild --reading as-run --delay-ms 0 --jitter-ms 0 --seed 25 --queue 1";
const RATE_HZ: f64 = 100.0;
const SAMPLES: u64 = 1_500;
/// The fewest samples that the lane forwards: 10 Hz for 15 s, less a tenth.
const LEAST_FORWARDED: u64 = 135;

fn bed(test: &str, yaml: &str) -> Option<Bed> {
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return None;
    }
    Bed::start_with(test, yaml, &["lossy"])
}

fn peer(library: Library, node: &str) -> Peer {
    match library {
        Library::Rclpy => Peer::rclpy(node),
        other => Peer::on(other),
    }
}

fn subscribers(bed: &Bed, host: &str, node: &str, change: fn(Peer) -> Peer) -> Vec<RunningPeer> {
    LIBRARIES.map(|library| bed.subscribe(host, change(peer(library, node)), NONCRITICAL)).into()
}

/// What the lane forwarded of a flow, and what its subscribers received.
struct Outcome {
    forwarded: u64,
    /// The time that the publisher took, in seconds.
    elapsed_s: f64,
    reliable: Vec<Received>,
    best_effort: Vec<Received>,
    lossy: Vec<Received>,
}

fn output<'a>(status: &'a Value, lane: &str) -> &'a Value {
    outputs(status).find(|output| output["lane"] == lane).unwrap()
}

/// The output of the noncritical lane.
fn noncritical(status: &Value) -> &Value {
    output(status, "noncritical")
}

/// Publishes for 15 s to subscribers of three libraries and both reliabilities that keep up; if `beside_bad`,
/// beside RELIABLE ones that are stopped and others whose link loses 28 % in each direction.
fn flow(bed: &Bed, beside_bad: bool) -> Outcome {
    let output = noncritical(&bed.wait_accounted()).clone();
    let [received, before] = ["received", "forwarded"].map(|key| output[key].as_u64().unwrap());
    let reliable = subscribers(bed, "slow", "planner", |peer| peer.keep_last(100));
    let best_effort = subscribers(bed, "slow", "viewer", |peer| peer.best_effort().keep_last(100));
    let (mut lossy, mut stopped, mut links) = (Vec::new(), Vec::new(), Vec::new());
    if beside_bad {
        lossy = subscribers(bed, "lossy", "far", |peer| peer.keep_last(100));
        stopped = subscribers(bed, "critical", "hung", |peer| peer.keep_last(100));
        for subscriber in &stopped {
            subscriber.stop();
        }
        let [far, bridge] = ["lossy", "bridge"].map(|name| bed.host(name));
        links = vec![Impairment::start(far, bridge, LOSS), Impairment::start(bridge, far, LOSS_OF_ANSWERS)];
    }
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(RATE_HZ).count(SAMPLES), INPUT);
    let sent: Sent = publisher.finish();
    sent.assert_not_blocked();
    let arrived = received + SAMPLES;
    let status = bed.bridge.wait_status("all samples accounted for", |status| {
        noncritical(status)["received"].as_u64() == Some(arrived) && is_accounted_and_idle(status)
    });
    let forwarded = noncritical(&status)["forwarded"].as_u64().unwrap() - before;
    for subscriber in reliable.iter().chain(&best_effort) {
        subscriber.wait_received(forwarded);
    }
    for link in links {
        link.end();
    }
    for subscriber in &stopped {
        subscriber.cont();
    }
    let end = |subscribers: Vec<RunningPeer>| subscribers.into_iter().map(RunningPeer::end).collect();
    let _: Vec<Received> = end(stopped);
    let (reliable, best_effort, lossy) = (end(reliable), end(best_effort), end(lossy));
    Outcome { forwarded, elapsed_s: sent.elapsed_s, reliable, best_effort, lossy }
}

/// The age in milliseconds that 95 % of the samples did not exceed.
fn p95_ms(received: &Received) -> f64 {
    received.latency_us.map_or(f64::MAX, |latency| latency.p95 / 1e3)
}

fn print(kind: &str, subscribers: &[Received]) {
    for received in subscribers {
        let latency = received.latency_us.unwrap();
        let [p50, p95, max] = [latency.p50, latency.p95, latency.max].map(|us| us / 1e3);
        println!(
            "  {kind}: {} received, age p50 {p50:.1}, p95 {p95:.1}, max {max:.1} ms, longest gap {:.0} ms",
            received.received, received.max_gap_ms
        );
    }
}

#[test]
fn bad_reliable_subscribers_of_a_noncritical_lane_change_nothing_for_the_others() {
    let test = "bad_reliable_subscribers_of_a_noncritical_lane_change_nothing_for_the_others";
    // It compares rates and ages.
    let _alone = support::exclusive();
    let Some(bed) = bed(test, SCAN) else { return };
    support::attempts(|| {
        let [alone, beside] = [false, true].map(|beside_bad| flow(&bed, beside_bad));
        for (name, flow) in [("alone", &alone), ("beside bad ones", &beside)] {
            println!("{name}: {} forwarded", flow.forwarded);
            print("RELIABLE", &flow.reliable);
            print("BEST_EFFORT", &flow.best_effort);
            print("RELIABLE, lossy", &flow.lossy);
            for received in flow.reliable.iter().chain(&flow.best_effort) {
                received.assert_sound();
                assert_eq!(received.received, flow.forwarded);
            }
            flow.lossy.iter().for_each(Received::assert_sound);
        }
        are_unmoved(&alone, &beside)
    });
    bed.end();
}

/// Checks that bad subscribers changed neither the rate of the lane nor the ages at the others.
fn are_unmoved(alone: &Outcome, beside: &Outcome) -> Result<(), String> {
    for flow in [alone, beside] {
        // Of the token bucket's 10 Hz, with the burst.
        let most = 10.0f64.mul_add(flow.elapsed_s, 5.0);
        if flow.forwarded < LEAST_FORWARDED || flow.forwarded as f64 > most {
            return Err(format!("{} forwarded in {} s", flow.forwarded, flow.elapsed_s));
        }
    }
    let pairs = alone.reliable.iter().zip(&beside.reliable);
    for (alone, beside) in pairs.chain(alone.best_effort.iter().zip(&beside.best_effort)) {
        is_as_young(beside, alone)?;
    }
    // Without repair some 40 % arrive: a sample is three packets. The history is 0.2 s.
    let is_repaired =
        |lossy: &Received| lossy.received * 10 >= beside.forwarded * 6 && p95_ms(lossy) <= 500.0;
    beside.lossy.iter().all(is_repaired).then_some(()).ok_or_else(|| format!("{:?}", beside.lossy))
}

/// Checks that the age of 95 % of the samples is at most 20 ms above that in the other flow.
fn is_as_young(received: &Received, than: &Received) -> Result<(), String> {
    let (age, than) = (p95_ms(received), p95_ms(than));
    let is_young = age <= than + 20.0;
    is_young
        .then_some(())
        .ok_or_else(|| format!("the age of 95 % of the samples rose from {than} to {age} ms"))
}

#[test]
fn a_reliable_subscriber_of_a_lane_that_the_file_makes_best_effort_is_named_in_status() {
    let test = "a_reliable_subscriber_of_a_lane_that_the_file_makes_best_effort_is_named_in_status";
    let yaml = format!("{SCAN}lanes: {{noncritical: {{qos: {{reliability: BEST_EFFORT}}}}}}\n");
    let Some(bed) = bed(test, &yaml) else { return };
    let viewer = bed.subscribe("slow", Peer::rclpy("viewer").best_effort(), NONCRITICAL);
    let rviz = Peer::rclpy("rviz").subscriber().topic(NONCRITICAL).start_on(bed.host("slow"));
    let publisher = bed.publish(Peer::cyclone().rate_hz(RATE_HZ), INPUT);
    viewer.wait_received(5);
    let named = bed.bridge.wait_status("a problem that names the RELIABLE subscriber", |status| {
        let problems = status["problems"].as_array().unwrap();
        problems.iter().any(|problem| {
            let problem = problem.as_str().unwrap();
            problem.contains("/rviz on") && problem.contains("gets nothing: it requests RELIABLE")
        })
    });
    let [unmatched] = noncritical(&named)["unmatched_readers"].as_array().unwrap().as_slice() else {
        panic!("{named}")
    };
    assert_eq!((&unmatched["node"], &unmatched["policy"]), (&"/rviz".into(), &"RELIABILITY".into()));
    assert_eq!(noncritical(&named)["readers"], 1);
    assert_eq!(rviz.received(), 0);
    let _: Received = rviz.end();
    bed.bridge.wait_status("no problem once the subscriber is gone", |status| {
        noncritical(status)["unmatched_readers"].as_array().is_some_and(Vec::is_empty)
            && status["problems"].as_array().is_some_and(Vec::is_empty)
    });
    let _: Sent = publisher.end();
    viewer.end::<Received>().assert_sound();
    bed.end();
}

/// The DDS topic of a lane that the file makes BEST_EFFORT.
const PLAIN: &str = "rt/adaptive_bridge/plain/scan";

#[test]
fn best_effort_subscribers_get_what_a_best_effort_lane_gives_them() {
    let test = "best_effort_subscribers_get_what_a_best_effort_lane_gives_them";
    // At the default rate of 10 Hz a lossy subscriber receives 60 of 150 samples, and the two lanes lose
    // different ones: 46 and 64 were seen.
    let yaml = format!(
        "{SCAN}lanes: {{plain: {{qos: {{reliability: BEST_EFFORT}}}}}}\n\
         routing_policy: {{noncritical_max_rate_hz: 50}}\n"
    );
    // It compares rates and ages.
    let _alone = support::exclusive();
    let Some(bed) = bed(test, &yaml) else { return };
    bed.up.wait_for_log("egress is up lane=\"plain\"");
    bed.bridge.wait_status("both lanes", |status| outputs(status).any(|output| output["lane"] == "plain"));
    support::attempts(|| compare_lanes(&bed));
    bed.end();
}

/// Publishes for 15 s to subscribers of both lanes. Those that keep up receive what their lane forwards, and
/// those behind a lossy link about the same share of it.
fn compare_lanes(bed: &Bed) -> Result<(), String> {
    let forwarded = |status: &Value| {
        ["noncritical", "plain"].map(|lane| output(status, lane)["forwarded"].as_u64().unwrap())
    };
    let before = forwarded(&bed.wait_accounted());
    let join = |host, topic| -> Vec<RunningPeer> {
        let peer = |library| peer(library, "viewer").best_effort().keep_last(1_000);
        LIBRARIES.map(|library| bed.subscribe(host, peer(library), topic)).into()
    };
    let [near, plain_near] = [NONCRITICAL, PLAIN].map(|topic| join("slow", topic));
    let [far, plain_far] = [NONCRITICAL, PLAIN].map(|topic| join("lossy", topic));
    let [lossy, bridge] = ["lossy", "bridge"].map(|name| bed.host(name));
    let links = [Impairment::start(lossy, bridge, LOSS), Impairment::start(bridge, lossy, LOSS_OF_ANSWERS)];
    let publisher = bed.publish(Peer::cyclone().rate_hz(RATE_HZ).count(SAMPLES), INPUT);
    publisher.finish::<Sent>().assert_not_blocked();
    let after = forwarded(&bed.wait_accounted());
    let [forwarded, plain_forwarded] = [0, 1].map(|lane| after[lane] - before[lane]);
    for link in links {
        link.end();
    }
    for (subscribers, forwarded) in [(&near, forwarded), (&plain_near, plain_forwarded)] {
        for subscriber in subscribers {
            subscriber.wait_received(forwarded);
        }
    }
    let end = |subscribers: Vec<RunningPeer>| -> Vec<Received> {
        subscribers.into_iter().map(RunningPeer::end).collect()
    };
    let [near, plain_near, far, plain_far] = [near, plain_near, far, plain_far].map(end);
    print("default lane", &near);
    print("BEST_EFFORT lane", &plain_near);
    print("default lane, lossy", &far);
    print("BEST_EFFORT lane, lossy", &plain_far);
    near.iter().chain(&far).for_each(Received::assert_sound);
    for (received, plain) in far.iter().zip(&plain_far) {
        // Of 750 samples some 40 % arrive: a sample is three packets.
        if received.received * plain_forwarded * 4 < plain.received * forwarded * 3 {
            return Err(format!("of {forwarded}: {received:?}\nof {plain_forwarded}: {plain:?}"));
        }
    }
    let pairs = near.iter().chain(&far).zip(plain_near.iter().chain(&plain_far));
    pairs.into_iter().try_for_each(|(received, plain)| is_as_young(received, plain))
}
