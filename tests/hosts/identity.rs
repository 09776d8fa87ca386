//! The identity of a critical lane that is killed: its subscribers stay matched with the next process, and
//! receive what that one forwards. Uses real processes, signals and DDS peers on separate hosts.

use std::time::Duration;

use nix::sys::signal::Signal;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, SCAN_TYPE, outputs};
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::process::signal;

const KILLS: usize = 5;
const RATE_HZ: f64 = 200.0;
/// Samples of 12 s. The next process drops an endpoint that does not announce itself within 10 s.
const SAMPLES_AFTER: u64 = 2_400;

/// What a subscriber saw.
struct Seen {
    name: &'static str,
    matches: (usize, usize),
    received: Received,
}

/// Kills the critical lane under four subscribers, after each `pause`.
fn kill(bed: &Bed, rate_hz: f64, pause: Duration) -> Vec<Seen> {
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(rate_hz).hold(), INPUT);
    // A route by pattern has its topic by then.
    bed.bridge.wait_status("the output", |status| {
        outputs(status).any(|output| output["topic"].as_str().is_some_and(|topic| CRITICAL.ends_with(topic)))
    });
    let subscribers = [
        ("Fast DDS, RELIABLE", Peer::fast().keep_all()),
        ("Fast DDS, BEST_EFFORT", Peer::fast().keep_all().best_effort()),
        ("Cyclone DDS, RELIABLE", Peer::cyclone().keep_all()),
        ("Cyclone DDS, BEST_EFFORT", Peer::cyclone().keep_all().best_effort()),
    ]
    .map(|(name, peer)| (name, bed.subscribe("critical", peer, CRITICAL)));
    publisher.go();
    let all_receive = |more: u64| {
        let before = subscribers.each_ref().map(|(_, subscriber)| subscriber.received());
        for ((_, subscriber), before) in subscribers.iter().zip(before) {
            subscriber.wait_received(before + more);
        }
    };
    all_receive(100);
    for kills in 1..=KILLS {
        std::thread::sleep(pause);
        signal(bed.pid("egress-critical"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("egress-critical").len() == kills + 1);
        all_receive(100);
    }
    all_receive(SAMPLES_AFTER);
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    bed.wait_accounted();
    let seen = subscribers.map(|(name, subscriber)| {
        let matches = subscriber.matches();
        Seen { name, matches, received: subscriber.end() }
    });
    for Seen { name, matches, received } in &seen {
        println!(
            "{name}: matched, unmatched {matches:?}; of {}: {} missing, {} twice, longest gap {:.0} ms",
            sent.ok, received.missing_count, received.duplicates, received.max_gap_ms
        );
    }
    seen.into()
}

/// Asserts that no subscriber matched another writer, and that the RELIABLE ones miss no sample. The next
/// process sends the sample that was numbered and not sent when the lane was killed before it has matched its
/// subscribers: only RELIABLE ones request it.
fn assert_unnoticed(subscribers: Vec<Seen>) {
    for Seen { name, matches, received } in subscribers {
        assert_eq!(matches, (1, 0), "{name}");
        received.assert_sound();
        let most = if name.ends_with("BEST_EFFORT") { KILLS as u64 } else { 0 };
        assert!(received.missing_count <= most, "{name}: {received:?}");
    }
}

#[test]
fn subscribers_stay_matched_with_a_critical_lane_that_is_killed() {
    let test = "subscribers_stay_matched_with_a_critical_lane_that_is_killed";
    // It asserts that no sample is lost.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    // A process that was up for less than a second does not leave its identity if it took it over.
    let subscribers = kill(&bed, RATE_HZ, Duration::from_millis(1_500));
    let log = bed.up.log();
    let continued = log.lines().filter(|line| line.contains("identity") && line.contains("continued=true"));
    assert_eq!(continued.count(), KILLS, "{log}");
    assert_unnoticed(subscribers);
    bed.end();
}

/// The next process finds the topic of a place in shared memory.
#[test]
fn subscribers_stay_matched_with_an_output_whose_topic_matches_a_pattern() {
    let test = "subscribers_stay_matched_with_an_output_whose_topic_matches_a_pattern";
    let _alone = support::exclusive();
    let yaml =
        "topics: [{id: any, input_topic: /*, exclude: [/rosout], max_routes: 2, max_sample_bytes: 65536}]";
    let Some(bed) = Bed::start(test, yaml) else { return };
    assert_unnoticed(kill(&bed, RATE_HZ, Duration::from_millis(1_500)));
    bed.end();
}

/// A lane that restarts needs what was published meanwhile, and what its readers may lack: more samples than
/// the channel retains of a route whose samples may have 16 MiB, which is the default.
#[test]
fn subscribers_receive_all_of_a_route_that_allows_large_samples() {
    let test = "subscribers_receive_all_of_a_route_that_allows_large_samples";
    let _alone = support::exclusive();
    let yaml = SCAN.replace(", max_sample_bytes: 65536", "");
    assert_ne!(yaml, SCAN);
    let Some(bed) = Bed::start(test, &yaml) else { return };
    assert_unnoticed(kill(&bed, 2.0 * RATE_HZ, Duration::from_millis(1_500)));
    bed.end();
}

/// The map is written once, before the kills.
#[test]
fn subscribers_stay_matched_with_a_latched_output_and_get_its_sample_once() {
    let test = "subscribers_stay_matched_with_a_latched_output_and_get_its_sample_once";
    let _alone = support::exclusive();
    let map = "  - id: map\n    input_topic: /map\n    message_type: sensor_msgs/msg/LaserScan\n    \
               max_sample_bytes: 65536\n    \
               qos_overrides: {critical: {durability: TRANSIENT_LOCAL, depth: 1}}\n";
    let Some(bed) = Bed::start(test, &format!("{SCAN}{map}")) else { return };
    let topic = "rt/adaptive_bridge/critical/map";
    let subscribe = |peer: Peer| bed.subscribe("critical", peer.transient_local().keep_last(1), topic);
    let maps = [Peer::fast(), Peer::cyclone()].map(subscribe);
    let map = bed.publish(Peer::cyclone().transient_local().keep_last(1).count(1).linger_s(600.0), "rt/map");
    maps.iter().for_each(|subscriber| subscriber.wait_received(1));
    assert_unnoticed(kill(&bed, RATE_HZ, Duration::from_millis(1_500)));
    for subscriber in maps {
        assert_eq!(subscriber.matches(), (1, 0));
        let received: Received = subscriber.end();
        assert_eq!((received.received, received.duplicates), (1, 0), "{received:?}");
    }
    for peer in [Peer::fast(), Peer::cyclone()] {
        subscribe(peer).wait_received(1);
    }
    drop(map);
    bed.end();
}

/// An output with keys has another writer after a restart, which its subscribers match instead of the former
/// one. The subscribers of the other output of the lane stay matched.
#[test]
fn an_output_that_is_not_continued_costs_the_others_nothing() {
    let test = "an_output_that_is_not_continued_costs_the_others_nothing";
    let _alone = support::exclusive();
    let poses = "  - {id: poses, input_topic: /poses, max_sample_bytes: 65536}\n";
    let Some(bed) = Bed::start(test, &format!("{SCAN}{poses}")) else { return };
    let with_keys = |peer: Peer| peer.type_name(SCAN_TYPE).size(300).keys(4);
    let publisher = bed.publish(with_keys(Peer::cyclone()).rate_hz(5.0), "rt/poses");
    bed.bridge.wait_status("an output with keys", |status| {
        status["routes"].as_array().is_some_and(|routes| routes.iter().any(|route| route["has_keys"] == true))
    });
    let poses = [Peer::fast(), Peer::cyclone()]
        .map(|peer| bed.subscribe("critical", with_keys(peer), "rt/adaptive_bridge/critical/poses"));
    assert_unnoticed(kill(&bed, RATE_HZ, Duration::from_millis(1_500)));
    for subscriber in poses {
        let (matched, unmatched) = subscriber.matches();
        assert_eq!((matched, unmatched), (KILLS + 1, KILLS), "a writer of a killed process is still matched");
        subscriber.wait_received(subscriber.received() + 5);
    }
    drop(publisher);
    bed.end();
}

#[test]
fn subscribers_may_come_and_go_while_no_lane_runs() {
    let test = "subscribers_may_come_and_go_while_no_lane_runs";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let peers = || [Peer::fast().keep_all(), Peer::cyclone().keep_all()];
    let [stays, goes] = [(); 2].map(|()| peers().map(|peer| bed.subscribe("critical", peer, CRITICAL)));
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(RATE_HZ), INPUT);
    let receive = |subscribers: &[RunningPeer]| {
        let before: Vec<u64> = subscribers.iter().map(RunningPeer::received).collect();
        for (subscriber, before) in subscribers.iter().zip(before) {
            subscriber.wait_received(before + 100);
        }
    };
    receive(&stays);
    signal(bed.pid("egress-critical"), Signal::SIGKILL);
    let comes = peers().map(|peer| peer.subscriber().topic(CRITICAL).start_on(bed.host("slow")));
    for subscriber in goes {
        subscriber.end::<Received>().assert_sound();
    }
    receive(&comes);
    receive(&stays);
    bed.bridge.wait_status("the readers that are there", |status| {
        let lane = outputs(status).find(|output| output["lane"] == "critical");
        lane.is_some_and(|lane| lane["matched_readers"].as_array().is_some_and(|readers| readers.len() == 4))
    });
    let _: Sent = publisher.end();
    for subscriber in stays.into_iter().chain(comes) {
        assert_eq!(subscriber.matches(), (1, 0));
        subscriber.end::<Received>().assert_sound();
    }
    bed.end();
}
