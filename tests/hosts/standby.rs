//! The standbys of ingress and of the critical lane take over when the process that serves the role is
//! killed, stopped, hangs or is asked to end. Uses real processes, signals and DDS peers on separate hosts.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, STANDBYS};
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::process::signal;
use support::ros;
use support::threads::{self, Fault};

const RATE_HZ: f64 = 200.0;
/// The subscriber whose samples are looked at one by one.
const WATCHED: &str = "Cyclone DDS, RELIABLE";

const LANE: &str = "egress-critical";

/// What a standby logs before it kills the active process because it hangs.
const KILLS_HUNG: &str = "standby: kills the active process: ";
/// How the line goes on if a thread of the process has work and does not run, without the wait for its turns.
const HAS_WORK: &str = "sleeps although";

/// How often the test repeats its eight take-overs; 1 without it.
const ROUNDS_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_TAKE_OVER_ROUNDS";

/// What happens to an active process.
#[derive(Clone, Copy, Debug)]
enum Event {
    Signal(Signal),
    /// Its thread of that name, or its main thread, hangs.
    Hang(Option<&'static str>),
}

impl Event {
    /// The cause of the take-over, as the status shows it.
    fn cause(self) -> &'static str {
        match self {
            Self::Signal(Signal::SIGSTOP) => "stopped",
            Self::Signal(Signal::SIGTERM) => "handed_over",
            Self::Signal(_) => "ended",
            Self::Hang(_) => "hung",
        }
    }
}

/// The processes of a role, as the status shows them.
fn process(status: &Value, name: &str) -> Value {
    let processes = status["processes"].as_array().unwrap();
    processes.iter().find(|process| process["name"] == name).unwrap().clone()
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value}"))
}

/// Waits until a standby of the role has the sockets of the active process, and returns the id of the latter.
pub fn wait_standby(bed: &Bed, name: &str) -> i32 {
    let what = format!("a standby of {name}");
    let status = bed.bridge.wait_status(&what, |status| {
        let process = process(status, name);
        process["state"] == "running" && process["standby"]["pid"] != 0
    });
    // The active process connects within 100 ms. A process that was up for less than a second does not leave
    // its identity if it took it over.
    std::thread::sleep(Duration::from_millis(1_500));
    i32::try_from(number(&process(&status, name)["pid"])).unwrap()
}

/// Waits until standbys of the role have taken over that often, and returns what the status shows of them.
pub fn wait_take_over(bed: &Bed, name: &str, take_overs: u64) -> Value {
    let status = bed.bridge.wait_status(&format!("take-over {take_overs} of {name}"), |status| {
        process(status, name)["standby"]["take_overs"] == take_overs
    });
    process(&status, name)["standby"].clone()
}

/// How long the last take-over took.
pub fn took_ms(standby: &Value) -> f64 {
    number(&standby["took_ns"]) as f64 / 1e6
}

/// The pauses between two samples from the one with that index on, in ms.
fn pauses_ms(subscriber: &RunningPeer, first: usize) -> Vec<f64> {
    let events = subscriber.events().into_iter().filter(|event| event["event"] == "sample").skip(first);
    let at_ms = |event: Value| {
        number(&event["seq"]) as f64 * 1e3 / RATE_HZ + event["latency_us"].as_f64().unwrap() / 1e3
    };
    let times: Vec<f64> = events.map(at_ms).collect();
    times.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

/// Ends a subscriber, which must have stayed matched.
fn end(name: &str, subscriber: RunningPeer, sent: &Sent) -> Received {
    let matches = subscriber.matches();
    let received: Received = subscriber.end();
    println!(
        "{name}: matched, unmatched {matches:?}; of {}: {} missing, {} twice, longest gap {:.0} ms",
        sent.ok, received.missing_count, received.duplicates, received.max_gap_ms
    );
    assert_eq!(matches, (1, 0), "{name}");
    received
}

#[test]
fn a_standby_takes_over_and_no_subscriber_misses_a_sample() {
    let test = "a_standby_takes_over_and_no_subscriber_misses_a_sample";
    let signals = [Signal::SIGKILL, Signal::SIGSTOP, Signal::SIGTERM, Signal::SIGKILL].map(Event::Signal);
    let rounds = std::env::var(ROUNDS_VARIABLE).map_or(1, |text| text.parse().unwrap());
    let events = signals.into_iter().flat_map(|event| [(LANE, event), ("ingress", event)]);
    let events: Vec<_> = std::iter::repeat_n(events, rounds).flatten().collect();
    take_over(test, &events, Peer::cyclone().keep_all());
}

#[test]
fn a_standby_takes_over_from_a_process_that_hangs() {
    let test = "a_standby_takes_over_from_a_process_that_hangs";
    let event_loop = threads::THREADS[1];
    let events =
        [(LANE, Event::Hang(None)), ("ingress", Event::Hang(event_loop)), (LANE, Event::Hang(event_loop))];
    // On a busy machine ingress acknowledges nothing for half a second, for which a KEEP_ALL publisher waits.
    take_over(test, &events, Peer::cyclone().keep_last(1_000));
}

fn take_over(test: &str, events: &[(&str, Event)], publisher: Peer) {
    // It asserts that no sample is lost.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &format!("{SCAN}{STANDBYS}")) else { return };
    let mut peers = vec![
        ("Fast DDS, RELIABLE", Peer::fast().keep_all()),
        (WATCHED, Peer::cyclone().keep_all().each_sample()),
        ("Cyclone DDS, BEST_EFFORT", Peer::cyclone().keep_all().best_effort()),
    ];
    if ros::missing().is_none() {
        peers.push(("rclpy, RELIABLE", Peer::rclpy("planner").keep_last(1_000)));
    }
    let subscribers: Vec<_> =
        peers.into_iter().map(|(name, peer)| (name, bed.subscribe("critical", peer, CRITICAL))).collect();
    let publisher = bed.publish(publisher.rate_hz(RATE_HZ), INPUT);
    let all_receive = |more: u64| {
        let goals: Vec<u64> = subscribers.iter().map(|(_, one)| one.received() + more).collect();
        for ((_, subscriber), goal) in subscribers.iter().zip(goals) {
            subscriber.wait_received(goal);
        }
    };
    all_receive(100);
    let mut stopped = Vec::new();
    for (index, &(name, event)) in events.iter().enumerate() {
        let active = wait_standby(&bed, name);
        let watched = subscribers.iter().find(|(name, _)| *name == WATCHED).map(|(_, one)| one).unwrap();
        let before = usize::try_from(watched.received()).unwrap();
        match event {
            Event::Signal(sent) => signal(active, sent),
            Event::Hang(thread) => threads::cause(Fault::Hang, active, threads::thread(active, thread)),
        }
        if event.cause() == "stopped" {
            stopped.push(active);
        }
        let standby = wait_take_over(&bed, name, index as u64 / 2 + 1);
        all_receive(100);
        assert_eq!(standby["cause"], event.cause(), "{name}, {event:?}: {standby}");
        let took_ms = took_ms(&standby);
        let pause_ms = pauses_ms(watched, before.saturating_sub(10)).into_iter().fold(0.0, f64::max);
        println!("{name}, {event:?}: taken over in {took_ms:.1} ms, longest pause {pause_ms:.1} ms");
    }
    // A process that was stopped and continued late must not speak with the identity of the active one.
    for pid in stopped {
        assert!(!std::path::Path::new(&format!("/proc/{pid}")).exists(), "a stopped process lives: {pid}");
    }
    all_receive(2_400);
    let log = bed.up.log();
    let at_once = log.lines().filter(|line| line.contains(KILLS_HUNG) && line.contains(HAS_WORK)).count();
    let hangs = events.iter().filter(|(_, event)| event.cause() == "hung").count();
    println!("{at_once} of {hangs} hangs noticed by a thread that has work");
    assert_eq!(at_once > 0, hangs > 0, "{log}");
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    bed.wait_accounted();
    for (name, subscriber) in subscribers {
        let received = end(name, subscriber, &sent);
        received.assert_sound();
        assert_eq!(received.missing_count, 0, "{name}: {received:?}");
    }
    bed.end();
}

#[test]
fn a_standby_that_is_asked_to_end_right_after_it_took_over_hands_over_too() {
    let test = "a_standby_that_is_asked_to_end_right_after_it_took_over_hands_over_too";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &format!("{SCAN}{STANDBYS}")) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(RATE_HZ), INPUT);
    subscriber.wait_received(100);
    let mut active = wait_standby(&bed, LANE);
    for take_overs in 1..=3 {
        signal(active, Signal::SIGTERM);
        let status =
            bed.bridge.wait_status(&format!("take-over {take_overs}, and the next standby"), |status| {
                let lane = process(status, LANE);
                lane["standby"]["take_overs"] == take_overs && lane["standby"]["pid"] != 0
            });
        let lane = process(&status, LANE);
        assert_eq!(lane["standby"]["cause"], "handed_over", "{lane}");
        active = i32::try_from(number(&lane["pid"])).unwrap();
    }
    subscriber.wait_received(subscriber.received() + 200);
    let sent: Sent = publisher.end();
    bed.wait_accounted();
    let received = end("Cyclone DDS", subscriber, &sent);
    received.assert_sound();
    assert_eq!(received.missing_count, 0, "{received:?}");
    bed.end();
}

#[test]
fn a_bridge_with_standbys_that_ends_says_goodbye() {
    let test = "a_bridge_with_standbys_that_ends_says_goodbye";
    let Some(mut bed) = Bed::start(test, &format!("{SCAN}{STANDBYS}")) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().rate_hz(RATE_HZ), INPUT);
    subscriber.wait_received(20);
    for name in ["ingress", "egress-critical"] {
        wait_standby(&bed, name);
    }
    let status = bed.up.terminate();
    let log = bed.up.log();
    assert!(status.success(), "up ended with {status}\n{log}");
    for (role, done) in [("ingress", "ingress is done"), ("egress-critical", "egress is done")] {
        let of_role = |line: &&str| line.starts_with(&format!("[{role}"));
        assert!(log.lines().filter(of_role).any(|line| line.contains(done)), "{log}");
    }
    assert!(!log.contains("hands over"), "{log}");
    subscriber.wait_matched(0);
    publisher.wait_matched(0);
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use std::time::Instant;

    use adaptive_bridge::clock;
    use adaptive_bridge::model::MonotonicNs;
    use nix::sys::signal::kill;
    use nix::unistd::Pid;
    use support::cpu_delay::{CpuDelay, CpuDelayMonitor};

    use super::super::hostile::Random;
    use super::*;

    /// How long processes are killed and stopped, in seconds; an hour in `make soak`.
    const SECONDS: u64 = 60;
    const SECONDS_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_HITLESS_S";

    const IMAGE: &str = "  - {id: image, input_topic: /image, message_type: sensor_msgs/msg/LaserScan, \
                         max_sample_bytes: 2000000}\n";
    const IMAGE_BYTES: usize = 1 << 20;

    /// Each 2 to 10 s a process of the bridge, active or standby, is killed, or stopped and continued late.
    #[test]
    fn no_subscriber_notices_that_any_process_is_killed_or_stopped() {
        let test = "no_subscriber_notices_that_any_process_is_killed_or_stopped";
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, &format!("{SCAN}{IMAGE}{STANDBYS}")) else { return };
        let mut peers =
            vec![("Fast DDS", Peer::fast().keep_all()), (WATCHED, Peer::cyclone().keep_all().each_sample())];
        if ros::missing().is_none() {
            peers.push(("rclpy", Peer::rclpy("planner").keep_last(1_000)));
        }
        let scans = peers.into_iter().map(|(name, peer)| (name, bed.subscribe("critical", peer, CRITICAL)));
        let image = |peer: Peer| peer.keep_all().size(IMAGE_BYTES).large_socket_buffers();
        let out = "rt/adaptive_bridge/critical/image";
        let images = [("Fast DDS, 1 MiB", Peer::fast()), ("Cyclone DDS, 1 MiB", Peer::cyclone())];
        let images = images.map(|(name, peer)| (name, bed.subscribe("critical", image(peer), out)));
        let subscribers: Vec<_> = scans.chain(images).collect();
        // A write that blocks for longer fails, and its sample would be neither sent nor missing. By default
        // that is 100 ms; on a slow machine a write of 1 MiB took 103 ms when ingress was killed.
        let publisher = || Peer::cyclone().max_blocking_s(1);
        let publishers = [
            bed.publish(publisher().keep_all().rate_hz(RATE_HZ), INPUT),
            bed.publish(image(publisher()).rate_hz(30.0), "rt/image"),
        ];
        for (_, subscriber) in &subscribers {
            subscriber.wait_received(50);
        }

        let seconds = std::env::var(SECONDS_VARIABLE).map_or(SECONDS, |text| text.parse().unwrap());
        let mut random = Random(u64::from(std::process::id()) | 1);
        println!("seed {}", random.0);
        let until = Instant::now() + Duration::from_secs(seconds);
        let monitor = CpuDelayMonitor::start();
        let mut faults = Vec::new();
        while Instant::now() < until {
            std::thread::sleep(Duration::from_millis(2_000 + random.below(8_000) as u64));
            let status = bed.bridge.status();
            let processes = status["processes"].as_array().unwrap().iter();
            let of = |process: &Value| {
                let name = process["name"].as_str().unwrap();
                [(number(&process["pid"]), name.to_owned())]
                    .into_iter()
                    .chain([(number(&process["standby"]["pid"]), format!("standby of {name}"))])
            };
            let pids: Vec<_> = processes.flat_map(of).filter(|(pid, _)| *pid != 0).collect();
            let (pid, name) = &pids[random.below(pids.len())];
            let pid = Pid::from_raw(i32::try_from(*pid).unwrap());
            let sent = if random.below(4) == 0 { Signal::SIGSTOP } else { Signal::SIGKILL };
            faults.push((clock::monotonic(), format!("{sent} of {name}"), sent));
            // It may have ended already.
            let _ = kill(pid, sent);
            if sent == Signal::SIGSTOP {
                std::thread::sleep(Duration::from_millis(random.below(4_000) as u64));
                let _ = kill(pid, Signal::SIGCONT);
            }
        }
        let stops = faults.iter().filter(|(.., sent)| *sent == Signal::SIGSTOP).count();
        println!("{} killed, {stops} stopped", faults.len() - stops);
        for (_, subscriber) in &subscribers {
            subscriber.wait_received(subscriber.received() + 50);
        }
        let sent = publishers.map(|publisher| {
            let sent: Sent = publisher.end();
            sent.assert_not_blocked();
            let longest_ms = sent.call_us.as_ref().map_or(0.0, |calls| calls.max / 1e3);
            println!("longest write {longest_ms:.1} ms");
            sent
        });
        bed.wait_accounted();
        let delays = monitor.take();
        for (name, subscriber) in subscribers {
            let sent = &sent[usize::from(name.ends_with("MiB"))];
            subscriber
                .wait_for("the last sample", |event| event["last"] == sent.last || event["seq"] == sent.last);
            if name == WATCHED {
                println!("{}", pauses(&subscriber));
                list_pauses(&subscriber, &faults, &delays);
            }
            end(name, subscriber, sent).assert_all_of(sent);
        }
        let log = bed.up.log();
        let hung: Vec<_> = log.lines().filter(|line| line.contains(KILLS_HUNG)).collect();
        assert!(
            hung.is_empty(),
            "nothing hung, and a standby killed the active process:\n{}",
            hung.join("\n")
        );
        bed.end();
    }

    /// The distribution of the pauses between two samples.
    fn pauses(subscriber: &RunningPeer) -> String {
        let mut pauses = pauses_ms(subscriber, 0);
        pauses.sort_by(f64::total_cmp);
        let at = |part: f64| pauses[((pauses.len() - 1) as f64 * part) as usize];
        format!("pauses: p99 {:.1}, p99.9 {:.1}, max {:.1} ms", at(0.99), at(0.999), at(1.0))
    }

    /// Lists the pauses that are longer than the goal, each with the last fault before its end, and with how
    /// long a CPU did not run a thread of the highest priority meanwhile.
    fn list_pauses(subscriber: &RunningPeer, faults: &[(MonotonicNs, String, Signal)], delays: &[CpuDelay]) {
        const GOAL_NS: u64 = 20_000_000;
        let wall_ns = clock::wall().0 - clock::monotonic().0;
        let events = subscriber.events().into_iter().filter(|event| event["event"] == "sample");
        let arrivals: Vec<MonotonicNs> = events
            .map(|event| {
                let latency_ns = (event["latency_us"].as_f64().unwrap() * 1e3) as u64;
                MonotonicNs(number(&event["source_ns"]) + latency_ns - wall_ns)
            })
            .collect();
        let ms = |ns: u64| ns as f64 / 1e6;
        let cpus = delays.iter().map(|delay| delay.cpu + 1).max().unwrap_or(0);
        for pair in arrivals.windows(2).filter(|pair| pair[1].since(pair[0]) > GOAL_NS) {
            let (from, to) = (pair[0], pair[1]);
            let of_cpu = |cpu| {
                let of_cpu = delays.iter().filter(|delay| delay.cpu == cpu);
                of_cpu.map(|delay| delay.ns_between(from, to)).sum::<u64>()
            };
            let delay_ns = (0..cpus).map(of_cpu).max().unwrap_or(0);
            let fault = match faults.iter().rev().find(|(at, ..)| *at < to) {
                None => "began before all faults".to_owned(),
                Some((at, what, _)) if *at < from => {
                    format!("began {:.1} ms after {what}", ms(from.since(*at)))
                }
                Some((at, what, _)) => format!("had {what} {:.1} ms after its begin", ms(at.since(from))),
            };
            println!(
                "pause of {:.1} ms, which {fault}; a CPU did not run a thread of the highest priority for \
                 {:.1} ms of it",
                ms(to.since(from)),
                ms(delay_ns)
            );
        }
    }
}
