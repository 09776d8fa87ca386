//! Tests of the test bed itself, without the bridge: real hosts (network namespaces), real DDS peers.

use std::fs;
use std::path::Path;
use std::process::Command;

use support::netns::{Host, Net};
use support::peer::{Library, LinesSent, Peer, Received, RunningPeer, Sent};
use support::process::Process;

const LIBRARIES: [Library; 3] = [Library::Cyclone, Library::Fast, Library::Rust];

/// Publisher and subscriber on libraries that are not the same: each library in both places.
const STRANGERS: [(Library, Library); 4] = [
    (Library::Fast, Library::Cyclone),
    (Library::Cyclone, Library::Fast),
    (Library::Rust, Library::Cyclone),
    (Library::Fast, Library::Rust),
];

/// Creates a publisher and a subscriber host; `None` if the machine cannot, which records the test as
/// skipped.
fn two_hosts(test: &str) -> Option<(Net, Host, Host)> {
    if let Some(reason) = support::testbed_missing() {
        support::skip(test, &reason);
        return None;
    }
    let net = Net::new(&["publisher", "critical"]);
    let (publisher, critical) = (net.host("publisher").clone(), net.host("critical").clone());
    Some((net, publisher, critical))
}

/// Starts a waiting publisher when it and the subscriber have matched each other.
fn go_when_matched(publisher: &RunningPeer, subscriber: &RunningPeer) {
    publisher.wait_matched(1);
    subscriber.wait_matched(1);
    publisher.go();
}

/// Runs a publisher and a subscriber until the subscriber has received `expected` samples. The publisher
/// stays until then: lost fragments are repaired at the heartbeats.
fn transfer(publisher: (Peer, &Host), subscriber: (Peer, &Host), expected: u64) -> (Sent, Received) {
    let subscriber = subscriber.0.subscriber().start_on(subscriber.1);
    let peer = publisher.0.publisher().hold().prime().heartbeat_ms(200).linger_s(600.0);
    let publisher = peer.start_on(publisher.1);
    go_when_matched(&publisher, &subscriber);
    subscriber.wait_received(expected);
    publisher.wait_for("all sent", |event| event["event"] == "sent");
    (publisher.end(), subscriber.end())
}

#[test]
fn reliable_samples_arrive_whole_and_once_between_the_libraries() {
    let Some((_net, here, there)) = two_hosts("reliable_samples_arrive_whole_and_once_between_the_libraries")
    else {
        return;
    };
    for (from, to) in STRANGERS {
        let peer = |library| Peer::on(library).keep_all().seed(7);
        let (sent, received) =
            transfer((peer(from).count(400).rate_hz(200.0), &here), (peer(to).size(2948), &there), 400);
        assert_eq!(sent.ok, 400, "{from:?} to {to:?}");
        received.assert_all_of(&sent);
        assert_eq!((received.first, received.last, received.missing_count), (Some(0), Some(399), 0));
        assert_eq!(received.source_timestamps_kept, 400, "{from:?} to {to:?}");
    }
}

#[test]
fn a_lossy_link_loses_best_effort_samples_and_no_reliable_ones() {
    let Some((_net, here, there)) = two_hosts("a_lossy_link_loses_best_effort_samples_and_no_reliable_ones")
    else {
        return;
    };
    for library in LIBRARIES {
        let peer = || Peer::on(library).keep_all().seed(8).type_name("test_msgs::msg::dds_::Raw_");
        let reliable = peer().topic("rt/reliable").subscriber().start_on(&there);
        let best_effort = peer().topic("rt/best_effort").best_effort().subscriber().start_on(&there);
        let publisher =
            |peer: Peer| peer.publisher().hold().prime().heartbeat_ms(200).count(300).rate_hz(200.0);
        let reliable_sent = publisher(peer().topic("rt/reliable")).option("--max-blocking-ms", 5000);
        let reliable_sent = reliable_sent.linger_s(600.0).start_on(&here);
        let best_effort_sent = publisher(peer().topic("rt/best_effort").best_effort()).start_on(&here);
        go_when_matched(&reliable_sent, &reliable);
        go_when_matched(&best_effort_sent, &best_effort);
        there.lose_incoming(0.1);
        let best_effort_sent: Sent = best_effort_sent.finish();
        reliable.wait_received(300);
        there.lose_incoming(0.0);

        let reliable_sent: Sent = reliable_sent.end();
        reliable.end::<Received>().assert_all_of(&reliable_sent);
        let best_effort: Received = best_effort.end();
        best_effort.assert_sound();
        // 0.9 ^ 200 that none is lost of the 200 or more that were sent under loss: 7e-10.
        assert!(best_effort.received < best_effort_sent.ok, "{library:?}: nothing was lost");
        assert!(best_effort.received > 0, "{library:?}: all was lost");
        assert_ne!(best_effort.hash, best_effort_sent.hash);
    }
}

#[test]
fn every_size_from_nothing_to_4_mib_passes_between_all_libraries() {
    let Some((_net, here, there)) =
        two_hosts("every_size_from_nothing_to_4_mib_passes_between_all_libraries")
    else {
        return;
    };
    let large = [2948, 2_000_000, 4 << 20];
    for from in LIBRARIES {
        for to in LIBRARIES {
            let peer = |library| Peer::on(library).keep_all().seed(9);
            let (sent, received) =
                transfer((peer(from).size(0).count(20), &here), (peer(to).size(0), &there), 20);
            received.assert_all_of(&sent);
            assert_eq!((sent.ok, received.unnumbered, received.bytes), (20, 20, 0), "{from:?} to {to:?}");

            let publisher = peer(from).sizes(&large).count(12).rate_hz(10.0);
            let (sent, received) = transfer((publisher, &here), (peer(to).sizes(&large), &there), 12);
            received.assert_all_of(&sent);
            assert_eq!((sent.ok, received.size_min, received.size_max), (12, 2948, 4 << 20));
        }
    }
}

#[test]
fn a_publisher_of_bursts_waits_for_a_signal_after_each() {
    let Some((_net, here, there)) = two_hosts("a_publisher_of_bursts_waits_for_a_signal_after_each") else {
        return;
    };
    for library in LIBRARIES {
        let peer = || Peer::on(library).keep_all().size(100_000).plain().option("--burst", 20);
        let subscriber = peer().subscriber().start_on(&there);
        let publisher = peer().publisher().hold().prime().rate_hz(100.0).start_on(&here);
        go_when_matched(&publisher, &subscriber);
        for bursts in 1..=3 {
            publisher.wait_for("a pause", |event| {
                event["event"] == "paused" && event["attempted"].as_u64() == Some(20 * bursts)
            });
            subscriber.wait_received(20 * bursts);
            publisher.go();
        }
        let sent: Sent = publisher.end();
        let received: Received = subscriber.end();
        assert!(sent.ok >= 60, "{library:?}: {}", sent.ok);
        assert_eq!((received.bad, received.size_min, received.size_max), (0, 100_000, 100_000));
    }
    // A subscriber of plain samples notices others.
    let publisher = Peer::cyclone().keep_all().size(1000).count(10);
    for library in [Library::Cyclone, Library::Rust] {
        let subscriber = Peer::on(library).keep_all().plain();
        let (_, received) = transfer((publisher.clone(), &here), (subscriber, &there), 10);
        assert_eq!(received.bad, 10, "{library:?}");
    }
}

#[test]
fn a_subscriber_reports_samples_of_wrong_bytes_or_wrong_size() {
    let Some((_net, here, there)) = two_hosts("a_subscriber_reports_samples_of_wrong_bytes_or_wrong_size")
    else {
        return;
    };
    let publisher = || Peer::fast().keep_all().seed(1).size(1000).count(10);
    // Each of the two programs that check: the C++ peers share one.
    for library in [Library::Cyclone, Library::Rust] {
        let subscriber = || Peer::on(library).keep_all();
        let (_, other_bytes) = transfer((publisher(), &here), (subscriber().seed(2), &there), 10);
        assert_eq!(other_bytes.bad, 10, "{library:?}");
        let (_, other_size) = transfer((publisher(), &here), (subscriber().seed(1).size(1004), &there), 10);
        assert_eq!(other_size.bad, 10, "{library:?}");
        let (_, right) = transfer((publisher(), &here), (subscriber().seed(1).size(1000), &there), 10);
        assert_eq!(right.bad, 0, "{library:?}");
    }
}

#[test]
fn encapsulation_kind_and_options_pass_unchanged() {
    let Some((_net, here, there)) = two_hosts("encapsulation_kind_and_options_pass_unchanged") else {
        return;
    };
    // CDR_BE with two bytes of padding announced, PL_CDR_LE, and CDR2_LE (XTypes 1.3, table 60).
    for (header, from, to) in [
        ("00000002", Library::Fast, Library::Fast),
        ("00030000", Library::Fast, Library::Cyclone),
        ("00070001", Library::Cyclone, Library::Fast),
        ("00000002", Library::Cyclone, Library::Rust),
        ("00070001", Library::Rust, Library::Fast),
    ] {
        let peer = |library| Peer::on(library).keep_all().size(102);
        let (sent, received) =
            transfer((peer(from).encapsulation(header).count(20), &here), (peer(to), &there), 20);
        received.assert_all_of(&sent);
        assert_eq!(received.headers, [(header.to_owned(), 20)].into(), "{from:?} to {to:?}");
        // RTPS pads a DATA submessage to whole words, and the reader gets the padding.
        assert_eq!((received.size_max, received.padded), (104, 20));
    }
}

#[test]
fn a_transient_local_late_joiner_gets_what_the_writer_keeps() {
    let Some((_net, here, there)) = two_hosts("a_transient_local_late_joiner_gets_what_the_writer_keeps")
    else {
        return;
    };
    for from in LIBRARIES {
        let peer = |library| Peer::on(library).transient_local().keep_last(5).size(100);
        // A publisher for each subscriber: Debian's Fast DDS 2.9 fails an assertion of its own
        // (OutputTrafficManager) when a reader on RustDDS joins before one on Cyclone DDS counts as gone.
        for to in LIBRARIES {
            let publisher = peer(from).publisher().count(20).linger_s(600.0).start_on(&here);
            publisher.wait_sent();
            let late = peer(to).subscriber().start_on(&there);
            late.wait_for("the latest sample", |event| event["last"] == 19);
            let received: Received = late.end();
            received.assert_sound();
            let whole = received.first <= Some(15) && received.missing.iter().all(|(_, last)| *last < 15);
            assert!(whole && received.last == Some(19), "{from:?} to {to:?}: {received:?}");
            // RustDDS discards samples beyond the depth only at its cache cleaning, so some of them may
            // arrive.
            assert!(received.received == 5 || from == Library::Rust, "{from:?} to {to:?}: {received:?}");
            assert_eq!(publisher.end::<Sent>().ok, 20);
        }
    }
}

#[test]
fn incompatible_qos_is_reported_on_both_sides() {
    let Some((_net, here, there)) = two_hosts("incompatible_qos_is_reported_on_both_sides") else { return };
    for (from, to) in STRANGERS {
        let publisher = Peer::on(from).best_effort().publisher().start_on(&here);
        let subscriber = Peer::on(to).subscriber().start_on(&there);
        for (peer, library) in [(&publisher, from), (&subscriber, to)] {
            let event = peer.wait_for("incompatible QoS", |event| event["event"] == "incompatible_qos");
            if library != Library::Rust {
                assert_eq!(event["policy_id"], 11, "RELIABILITY_QOS_POLICY_ID (DDS 1.4, 2.3.3)");
            }
            assert_eq!(peer.matched(), 0);
        }
    }
}

#[test]
fn a_stopped_reliable_subscriber_fills_the_writers_history() {
    let Some((_net, here, there)) = two_hosts("a_stopped_reliable_subscriber_fills_the_writers_history")
    else {
        return;
    };
    for library in LIBRARIES {
        let peer = || Peer::on(library).keep_all();
        let subscriber = peer().subscriber().start_on(&there);
        let publisher = peer()
            .max_samples(50)
            .rate_hz(200.0)
            .hold()
            .prime()
            .heartbeat_ms(200)
            .publisher()
            .start_on(&here);
        go_when_matched(&publisher, &subscriber);
        subscriber.wait_received(20);
        subscriber.stop();
        // This is the stall that the bridge is for: the writer has no room, so write blocks, then fails.
        publisher.wait_for("failed writes", |event| {
            event["event"] == "progress" && event["attempted"].as_u64() > event["ok"].as_u64()
        });
        let before = subscriber.received();
        subscriber.cont();
        subscriber.wait_received(before + 50);
        let sent: Sent = publisher.end();
        assert!(sent.failed > 0, "{library:?}: {sent:?}");
        assert!(sent.call_us.unwrap().max >= 90_000.0, "{library:?}: write has blocked for 100 ms");
        assert!(sent.skipped_ticks > 0, "{library:?}: {sent:?}");
        subscriber.wait_received(sent.ok);
        let received: Received = subscriber.end();
        received.assert_all_of(&sent);
        assert_eq!(received.missing_count, sent.failed, "the samples that failed are what is missing");
    }
}

#[test]
fn a_stalling_subscriber_reads_late_and_then_goes_on() {
    let Some((_net, here, there)) = two_hosts("a_stalling_subscriber_reads_late_and_then_goes_on") else {
        return;
    };
    for library in LIBRARIES {
        let peer = || Peer::on(library).keep_all().rate_hz(100.0).count(200);
        let subscriber = peer().stall(0.5, 0.4);
        let (sent, received) = transfer((peer(), &here), (subscriber, &there), 200);
        received.assert_all_of(&sent);
        assert!(received.latency_us.unwrap().max >= 300_000.0, "{library:?}: {received:?}");
    }
}

#[test]
fn each_sample_is_an_event_when_asked_for() {
    let Some((_net, here, there)) = two_hosts("each_sample_is_an_event_when_asked_for") else { return };
    let publisher = Peer::fast().keep_all().count(5).first_seq(100).size(64).source_age_ms(5000);
    let subscriber = Peer::cyclone().keep_all().each_sample().subscriber().start_on(&there);
    let publisher = publisher.publisher().hold().prime().heartbeat_ms(200).each_sample().start_on(&here);
    go_when_matched(&publisher, &subscriber);
    subscriber.wait_received(5);
    publisher.wait_for("the last write", |event| event["seq"] == 104);
    let written: Vec<u64> = publisher.events().iter().filter_map(|event| event["seq"].as_u64()).collect();
    assert_eq!(written, [100, 101, 102, 103, 104]);
    let sample = subscriber.wait_for("sample 103", |event| event["seq"] == 103);
    assert_eq!(
        (&sample["size"], &sample["header"], &sample["good"]),
        (&64.into(), &"00010000".into(), &true.into())
    );
    let sent: Sent = publisher.finish();
    let received: Received = subscriber.end();
    assert_eq!(received.source_timestamps_kept, 5);
    received.assert_all_of(&sent);
}

/// Appends a number to CDR, little endian.
fn number(cdr: &mut Vec<u8>, value: usize) {
    cdr.resize(cdr.len().next_multiple_of(4), 0);
    cdr.extend((value as u32).to_le_bytes());
}

/// Appends a string to CDR, little endian.
fn text(cdr: &mut Vec<u8>, value: &str) {
    number(cdr, value.len() + 1);
    cdr.extend(value.as_bytes());
    cdr.push(0);
}

/// CDR of `rmw_dds_common/msg/ParticipantEntitiesInfo`, little endian, without its header.
fn participant_entities(gid_bytes: usize) -> Vec<u8> {
    let gid = |fill: u8| vec![fill; gid_bytes];
    let mut cdr = gid(0x11);
    number(&mut cdr, 2);
    for (name, readers, writers) in [("scanner", vec![], vec![0x21, 0x22]), ("viewer", vec![0x31], vec![])] {
        text(&mut cdr, "/robot");
        text(&mut cdr, name);
        for gids in [readers, writers] {
            number(&mut cdr, gids.len());
            gids.into_iter().for_each(|fill| cdr.extend(gid(fill)));
        }
    }
    cdr
}

#[test]
fn the_ros_graph_and_its_endpoints_are_shown() {
    let Some((_net, here, there)) = two_hosts("the_ros_graph_and_its_endpoints_are_shown") else { return };
    for gid_bytes in [24, 16] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("graph.cdr");
        fs::write(&file, participant_entities(gid_bytes)).unwrap();
        let graph = Peer::cyclone().graph(gid_bytes).start_on(&there);
        let publisher = Peer::fast()
            .topic("ros_discovery_info")
            .type_name("rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_")
            .transient_local()
            .keep_last(1)
            .payload_file(&file)
            .count(1)
            .linger_s(600.0)
            .publisher()
            .start_on(&here);

        support::wait_until("a graph entry", || graph.graph().nodes.len() == 1);
        let shown = graph.graph();
        let nodes = &shown.nodes[&"11".repeat(gid_bytes)];
        assert_eq!(nodes.len(), 2);
        assert_eq!((nodes[0].namespace.as_str(), nodes[0].name.as_str()), ("/robot", "scanner"));
        assert_eq!(nodes[0].writer_gids, ["21".repeat(gid_bytes), "22".repeat(gid_bytes)]);
        assert_eq!(nodes[1].reader_gids, ["31".repeat(gid_bytes)]);
        assert!(nodes[0].reader_gids.is_empty() && nodes[1].writer_gids.is_empty());

        let of_publisher = |graph: &support::peer::Graph| {
            let found =
                graph.endpoints.values().find(|e| e.kind == "writer" && e.topic == "ros_discovery_info");
            found.cloned()
        };
        let endpoint = support::wait_for("the writer", || of_publisher(&graph.graph()));
        assert_eq!(endpoint.type_name, "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_");
        assert_eq!(endpoint.qos["reliability"], "RELIABLE");
        assert_eq!(endpoint.qos["durability"], "TRANSIENT_LOCAL");
        publisher.end::<Sent>();
        support::wait_until("the writer is gone", || of_publisher(&graph.graph()).is_none());
    }
}

#[test]
fn a_published_string_is_decoded_by_a_peer_with_the_message_definition() {
    let test = "a_published_string_is_decoded_by_a_peer_with_the_message_definition";
    let Some((_net, here, there)) = two_hosts(test) else { return };
    let peer = || Peer::cyclone().keep_all().topic("rt/adaptive_bridge/test");
    let listener = peer().decode_string().start_on(&there);
    // More than 1 MiB does not fit the history of Cyclone DDS: the last line waits until the one before has
    // been repaired and acknowledged.
    let mut speaker = peer().max_blocking_s(30).say().start_on(&here);
    speaker.wait_matched(1);
    listener.wait_matched(1);
    let long = "x".repeat(1 << 20);
    let lines = ["", "{\"id\":\"läptop\",\"seq\":1}", "back\\slash\t\u{1}", &long];
    for line in lines {
        speaker.say(line);
    }
    speaker.say(b"no \xff UTF-8");
    listener.wait_decoded("the last line", |message| message["data"] == "no \u{fffd} UTF-8");
    let decoded = listener.decoded();
    let heard: Vec<&str> = decoded.iter().filter_map(|message| message["data"].as_str()).collect();
    assert_eq!(heard[..4], lines);
    assert_eq!(heard.len(), 5);
    let summary: LinesSent = speaker.finish();
    assert_eq!((summary.attempted, summary.ok, summary.failed, summary.acknowledged), (5, 5, 0, true));
}

/// CDR of `diagnostic_msgs/msg/DiagnosticArray`, little endian, without its header.
fn diagnostics() -> Vec<u8> {
    let mut cdr = Vec::new();
    number(&mut cdr, 1_700_000_000);
    number(&mut cdr, 999_999_999);
    text(&mut cdr, "base");
    number(&mut cdr, 2);
    for (level, name) in [(0u8, "bridge: ingress"), (2, "bridge: lane")] {
        cdr.push(level);
        text(&mut cdr, name);
        text(&mut cdr, "a message");
        text(&mut cdr, "");
        number(&mut cdr, 1);
        text(&mut cdr, "rate_hz");
        text(&mut cdr, "3.0");
    }
    cdr
}

#[test]
fn diagnostics_are_decoded_by_their_definition_and_cut_off_ones_are_not() {
    let test = "diagnostics_are_decoded_by_their_definition_and_cut_off_ones_are_not";
    let Some((_net, here, there)) = two_hosts(test) else { return };
    let listener = Peer::cyclone().transient_local().keep_all().decode_diagnostics().start_on(&there);
    let folder = tempfile::tempdir().unwrap();
    let whole = diagnostics();
    for (name, cdr) in [("cut_off", &whole[..whole.len() - 4]), ("whole", &whole)] {
        let file = folder.path().join(name);
        fs::write(&file, cdr).unwrap();
        let publisher = Peer::fast()
            .transient_local()
            .keep_last(1)
            .topic("rt/diagnostics")
            .type_name("diagnostic_msgs::msg::dds_::DiagnosticArray_")
            .payload_file(&file)
            .wait_match(1)
            .count(1)
            .publisher()
            .start_on(&here);
        assert!(publisher.wait_sent(), "the listener has acknowledged it");
        publisher.finish::<Sent>();
    }
    let values = serde_json::json!([{"key": "rate_hz", "value": "3.0"}]);
    let status = |level: u8, name: &str| {
        serde_json::json!({"level": level, "name": name, "message": "a message", "hardware_id": "",
                           "values": values})
    };
    let expected = serde_json::json!({
        "header": {"stamp": {"sec": 1_700_000_000, "nanosec": 999_999_999}, "frame_id": "base"},
        "status": [status(0, "bridge: ingress"), status(2, "bridge: lane")],
    });
    listener.wait_decoded("both statuses", |message| *message == expected);
    assert_eq!(listener.decoded(), [expected], "{}", listener.log());
}

#[test]
fn a_host_without_a_link_receives_nothing() {
    let Some((_net, here, there)) = two_hosts("a_host_without_a_link_receives_nothing") else { return };
    let subscriber = Peer::fast().best_effort().subscriber().start_on(&there);
    let publisher = Peer::fast().best_effort().rate_hz(100.0).wait_match(1).publisher().start_on(&here);
    subscriber.wait_received(10);
    there.set_link(false);
    let mut last = subscriber.received();
    support::wait_until("silence", || {
        std::thread::sleep(std::time::Duration::from_millis(500));
        let now = subscriber.received();
        std::mem::replace(&mut last, now) == now
    });
    there.set_link(true);
    subscriber.wait_received(last + 10);
    let received: Received = subscriber.end();
    received.assert_sound();
    assert!(received.missing_count > 0);
    publisher.end::<Sent>();
}

#[test]
fn dropping_a_net_removes_its_hosts_and_their_processes() {
    let test = "dropping_a_net_removes_its_hosts_and_their_processes";
    if let Some(reason) = support::netns::requires_root() {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["publisher"]);
    let host = net.host("publisher").clone();
    let file = format!("/run/netns/{}", host.namespace());
    assert!(Path::new(&file).exists());
    assert!(host.run("ip", &["-o", "addr"]).contains(&format!("{}/24", host.address())));
    // A grandchild in a session of its own, which a signal to the process group does not reach.
    let mut command = host.command("setsid");
    command.args(["--fork", "sh", "-c", "echo $$; exec sleep 600"]);
    let process = Process::spawn("sleeper", command);
    let (pid, _) = process.wait_for_line("its pid", 0, |line| line.parse::<u32>().ok());
    let alive = || fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.contains(" Z "));
    assert!(alive());
    drop(net);
    assert!(!Path::new(&file).exists());
    support::wait_until("the end of the process in the host", || !alive());
}

#[test]
fn the_hosts_of_a_killed_test_program_are_removed_by_the_next() {
    let test = "the_hosts_of_a_killed_test_program_are_removed_by_the_next";
    if let Some(reason) = support::netns::requires_root() {
        return support::skip(test, &reason);
    }
    let mut child = Command::new("true").spawn().unwrap();
    let dead = child.id();
    child.wait().unwrap();
    let stale = format!("ab-{dead}-0-slow");
    assert!(Command::new("ip").args(["netns", "add", &stale]).status().unwrap().success());
    let file = format!("/run/netns/{stale}");
    assert!(Path::new(&file).exists());
    drop(Net::new(&["publisher"]));
    assert!(!Path::new(&file).exists());
}

#[test]
fn a_process_can_be_stopped_continued_and_killed() {
    let mut command = Command::new("sh");
    command.args(["-c", "while :; do echo tick; sleep 0.01; done"]);
    let mut process = Process::spawn("ticker", command);
    let state = |process: &Process| {
        let stat = fs::read_to_string(format!("/proc/{}/stat", process.pid())).unwrap();
        stat.rsplit(") ").next().unwrap().chars().next().unwrap()
    };
    let (_, from) = process.wait_for_line("a tick", 0, |line| (line == "tick").then_some(()));
    process.stop();
    support::wait_until("it is stopped", || state(&process) == 'T');
    assert!(process.is_running());
    process.cont();
    process.wait_for_line("another tick", from, |line| (line == "tick").then_some(()));
    process.kill9();
    assert!(!process.is_running());
}

#[test]
fn a_dropped_process_takes_its_children_with_it() {
    let mut command = Command::new("sh");
    command.args(["-c", "sleep 600 & echo $!; wait"]);
    let process = Process::spawn("parent", command);
    let (child, _) = process.wait_for_line("the pid", 0, |line| line.parse::<u32>().ok());
    let alive = || fs::read_to_string(format!("/proc/{child}/stat")).is_ok_and(|stat| !stat.contains(" Z "));
    assert!(alive());
    drop(process);
    support::wait_until("the end of the child", || !alive());
}

#[test]
fn a_skipped_test_is_listed_and_fails_where_nothing_may_be_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let list = folder.path().join("deeper/skipped.txt");
    support::skip_into(&list, false, "first", "no root");
    support::skip_into(&list, false, "second", "no netns");
    assert_eq!(fs::read_to_string(&list).unwrap(), "first: no root\nsecond: no netns\n");
    let skipped = std::panic::catch_unwind(|| support::skip_into(&list, true, "third", "no root"));
    assert!(skipped.is_err());
    assert_eq!(fs::read_to_string(&list).unwrap().lines().count(), 2);
}

#[test]
fn a_bridge_has_a_configuration_file_and_a_name_of_its_own() {
    let yaml = "instance: {instance}\nroot: {folder}/shm\n";
    let (one, other) = (support::bridge::Bridge::new(yaml), support::bridge::Bridge::new(yaml));
    assert_ne!(one.instance(), other.instance());
    let written = fs::read_to_string(one.config()).unwrap();
    let expected = format!("instance: {}\nroot: {}/shm\n", one.instance(), one.folder().display());
    assert_eq!(written, expected);
    // The exit code shows that the program was run and ended by itself; this file is not valid for it.
    assert!(one.run("check").status.code().is_some());
}
