//! Restarts of a killed critical lane while samples flow: what its subscribers lose, get twice and out of
//! order, how long they hear nothing, and the account of it. Uses real processes, signals and DDS peers.

use std::collections::BTreeSet;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, outputs};
use support::peer::{Library, Peer, RunningPeer, Sent};
use support::process::signal;
use support::ros;

const RATE_HZ: f64 = 200.0;
const KILLS: usize = 5;
/// Samples that each subscriber receives between two kills: those of more than a second, after which the next
/// process may continue one that has continued another.
const SAMPLES_BETWEEN: u64 = 300;
/// Samples that are published while no lane runs: fewer than ingress retains, more than it retained before.
const SAMPLES_WITHOUT_LANE: u64 = 50;

/// A sample as a subscriber reported it.
#[derive(Clone, Copy)]
struct Arrival {
    sequence: u64,
    /// From before `write` to after `take`.
    latency_ms: f64,
}

/// A RELIABLE subscriber that reports each sample.
struct Subscriber {
    library: Library,
    peer: RunningPeer,
    /// How many samples it had reported at each kill.
    kills: Vec<usize>,
}

/// What a subscriber noticed of one kill.
#[derive(Default, Debug)]
struct Noticed {
    lost: u64,
    doubled: u64,
    out_of_order: u64,
    silent_ms: f64,
}

impl Subscriber {
    /// One on each library that this machine has, on the host `critical`.
    fn start_all(bed: &Bed) -> Vec<Self> {
        let with_ros = ros::missing().is_none().then_some(Library::Rclpy);
        let libraries = [Library::Fast, Library::Cyclone].into_iter().chain(with_ros);
        let start = |library| {
            let peer = match library {
                Library::Rclpy => Peer::rclpy("planner"),
                other => Peer::on(other),
            };
            let peer = bed.subscribe("critical", peer.keep_last(1000).each_sample(), CRITICAL);
            Self { library, peer, kills: Vec::new() }
        };
        libraries.map(start).collect()
    }

    fn arrivals(&self) -> Vec<Arrival> {
        let events = self.peer.events().into_iter().filter(|event| event["event"] == "sample");
        let arrival = |event: Value| Arrival {
            sequence: event["seq"].as_u64().unwrap(),
            latency_ms: event["latency_us"].as_f64().unwrap() / 1e3,
        };
        events.map(arrival).collect()
    }

    fn note_kill(&mut self) {
        self.kills.push(self.arrivals().len());
    }

    /// What the subscriber noticed from each kill to the next. The publisher writes at `rate_hz`.
    fn noticed(&self, rate_hz: f64) -> Vec<Noticed> {
        let arrivals = self.arrivals();
        let all: BTreeSet<u64> = arrivals.iter().map(|arrival| arrival.sequence).collect();
        let at_ms = |arrival: &Arrival| arrival.sequence as f64 * 1e3 / rate_hz + arrival.latency_ms;
        let ends = self.kills.iter().skip(1).copied().chain([arrivals.len()]);
        let mut seen: BTreeSet<u64> = arrivals[..self.kills[0]].iter().map(|one| one.sequence).collect();
        let of_kill = |(begin, end): (usize, usize)| {
            let before = seen.last().copied().unwrap();
            let mut noticed = Noticed::default();
            for arrival in &arrivals[begin..end] {
                let last = seen.last().copied().unwrap();
                if !seen.insert(arrival.sequence) {
                    noticed.doubled += 1;
                } else if arrival.sequence < last {
                    noticed.out_of_order += 1;
                }
            }
            let after = seen.last().copied().unwrap();
            noticed.lost = (before..after).filter(|sequence| !all.contains(sequence)).count() as u64;
            let pauses = arrivals[begin - 1..end].windows(2).map(|pair| at_ms(&pair[1]) - at_ms(&pair[0]));
            noticed.silent_ms = pauses.fold(0.0, f64::max);
            noticed
        };
        self.kills.iter().copied().zip(ends).map(of_kill).collect()
    }
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value}"))
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap_or_else(|| panic!("{status}"))
}

fn drops_of(lane: &Value) -> u64 {
    lane["drops"].as_object().unwrap().values().map(number).sum()
}

/// Kills the lane and waits until the next process was started.
fn kill(bed: &Bed, subscribers: &mut [Subscriber]) {
    let started = bed.pids("egress-critical").len();
    subscribers.iter_mut().for_each(Subscriber::note_kill);
    signal(bed.pid("egress-critical"), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids("egress-critical").len() > started);
}

fn wait_more(subscribers: &[Subscriber], samples: u64) {
    let goals: Vec<u64> = subscribers.iter().map(|one| one.peer.received() + samples).collect();
    for (subscriber, goal) in subscribers.iter().zip(goals) {
        subscriber.peer.wait_received(goal);
    }
}

/// Ends the flow, and asserts that each published sample is forwarded or dropped for a named reason, and that
/// no subscriber misses one that is not dropped, or gets one twice. Returns the lane in the status.
fn assert_accounted(bed: &Bed, publisher: RunningPeer, subscribers: Vec<Subscriber>, rate_hz: f64) -> Value {
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "the publisher was blocked: {sent:?}");
    let status = bed.wait_accounted();
    let route = &status["routes"][0];
    assert_eq!(number(&route["published"]), sent.ok, "{route}");
    let lane = critical(&status);
    let (forwarded, dropped) = (number(&lane["forwarded"]), drops_of(lane));
    assert_eq!(forwarded + dropped, sent.ok, "every sample is forwarded or has a drop reason: {lane}");
    let unconfirmed = number(&lane["unconfirmed"]);
    let drops: Vec<_> = lane["drops"].as_object().unwrap().iter().filter(|(_, n)| **n != 0).collect();
    println!("{} sent, {forwarded} forwarded, {unconfirmed} unconfirmed, dropped {drops:?}", sent.ok);
    for subscriber in subscribers {
        subscriber.peer.wait_for("the last sample", |event| event["seq"] == sent.last);
        let noticed = subscriber.noticed(rate_hz);
        println!("{:?}", subscriber.library);
        noticed.iter().for_each(|kill| println!("  {kill:?}"));
        let lost: u64 = noticed.iter().map(|kill| kill.lost).sum();
        assert!(lost <= dropped, "{:?}: {noticed:?} of {lane}", subscriber.library);
        assert!(noticed.iter().all(|kill| kill.doubled == 0), "{:?}: {noticed:?}", subscriber.library);
        assert!(noticed.iter().all(|kill| kill.out_of_order == 0), "{:?}: {noticed:?}", subscriber.library);
    }
    lane.clone()
}

#[test]
fn what_a_killed_critical_lane_loses_is_counted_and_no_sample_comes_twice() {
    let test = "what_a_killed_critical_lane_loses_is_counted_and_no_sample_comes_twice";
    // It reports how long the subscribers hear nothing.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let mut subscribers = Subscriber::start_all(&bed);
    let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(RATE_HZ), INPUT);
    wait_more(&subscribers, SAMPLES_BETWEEN);
    for _ in 0..KILLS {
        kill(&bed, &mut subscribers);
        wait_more(&subscribers, SAMPLES_BETWEEN);
    }
    assert_accounted(&bed, publisher, subscribers, RATE_HZ);
    bed.end();
}

/// `up` is stopped meanwhile, so that the lane stays away for a known number of samples.
#[test]
fn subscribers_receive_what_was_published_while_no_critical_lane_ran() {
    let test = "subscribers_receive_what_was_published_while_no_critical_lane_ran";
    let rate_hz = RATE_HZ / 2.0;
    // On a busy machine a subscriber may take longer to match than the lane waits for it.
    support::attempts(|| {
        let _alone = support::exclusive();
        let Some(bed) = Bed::start_without_watchdog(test, SCAN) else { return Ok(()) };
        let mut subscribers = Subscriber::start_all(&bed);
        let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(rate_hz), INPUT);
        wait_more(&subscribers, 50);
        let published = || number(&bed.bridge.status()["routes"][0]["published"]);
        subscribers.iter_mut().for_each(Subscriber::note_kill);
        bed.up.stop();
        signal(bed.pid("egress-critical"), Signal::SIGKILL);
        let before = published();
        support::wait_until("samples without a lane", || published() >= before + SAMPLES_WITHOUT_LANE);
        bed.up.cont();
        wait_more(&subscribers, SAMPLES_BETWEEN);
        let lane = assert_accounted(&bed, publisher, subscribers, rate_hz);
        bed.end();
        assert_eq!(lane["drops"]["lane_down"], 0, "ingress retains them: {lane}");
        if drops_of(&lane) == 0 { Ok(()) } else { Err(format!("dropped, although retained: {lane}")) }
    });
}
