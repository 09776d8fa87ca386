//! The bridge between DDS libraries: publishers and subscribers on Cyclone DDS, Fast DDS and RustDDS run on
//! separate hosts (network namespaces) from the bridge. Every payload is compared by hash.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, missing_from};
use support::peer::{Graph, Library, Peer, Received, RunningPeer, Sent};
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Cyclone, Library::Fast, Library::Rust];

#[test]
fn every_library_reaches_every_library_through_both_lanes() {
    let Some(bed) = Bed::start("every_library_reaches_every_library_through_both_lanes", SCAN) else {
        return;
    };
    for from in LIBRARIES {
        for to in LIBRARIES {
            let peer = |library| Peer::on(library).keep_all().seed(11).size(2948);
            let critical = bed.subscribe("critical", peer(to), CRITICAL);
            let noncritical = bed.subscribe("slow", peer(to).best_effort(), NONCRITICAL);
            let publisher = bed.publish(peer(from).rate_hz(200.0).count(300), INPUT);
            let sent: Sent = publisher.finish();
            assert_eq!((sent.ok, sent.failed), (300, 0), "{from:?} to {to:?}");
            // By ingress's current reader; no writer may still wait for an acknowledgement of an earlier one.
            assert!(sent.acknowledged, "{from:?} to {to:?}");
            critical.wait_received(300);
            noncritical.wait_for("a late sample", |event| event["last"].as_u64() > Some(280));
            let received: Received = critical.end();
            received.assert_all_of(&sent);
            assert_eq!(received.source_timestamps_kept, 300, "{from:?} to {to:?}: {received:?}");
            let slow: Received = noncritical.end();
            slow.assert_sound();
            // 10 Hz for 1.5 s, and two tokens to begin with.
            assert!((slow.received as f64) < 10.0 * sent.elapsed_s + 15.0, "{slow:?}, {sent:?}");
            assert_eq!(slow.headers.keys().collect::<Vec<_>>(), received.headers.keys().collect::<Vec<_>>());
            assert_eq!(slow.source_timestamps_changed, 0, "{from:?} to {to:?}");
        }
    }
    bed.wait_accounted();
    bed.end();
}

#[test]
fn hosts_without_samples_send_few_packets() {
    let Some(bed) = Bed::start("hosts_without_samples_send_few_packets", SCAN) else { return };
    for library in LIBRARIES {
        let subscriber = bed.subscribe("critical", Peer::on(library), CRITICAL);
        subscriber.wait_matched(1);
        // Expected after discovery are announcements of a few participants, seconds apart. A Fast DDS
        // reader that receives no HEARTBEAT requests one seven times a second, from each of several writers
        // of each process, without end.
        support::wait_until(format!("few packets of {library:?}"), || {
            let before = packets(&bed);
            std::thread::sleep(Duration::from_secs(4));
            let sent = packets(&bed) - before;
            println!("{library:?}: {sent} packets in 4 s");
            sent < 100
        });
        subscriber.end::<Received>();
    }
    bed.end();
}

/// The number of packets that the host of the critical subscriber has sent.
fn packets(bed: &Bed) -> u64 {
    let output = bed.host("critical").command("cat").arg("/proc/net/dev").output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let lines = text.lines().filter_map(|line| line.split_once(':'));
    let interfaces = lines.filter(|(name, _)| name.trim() != "lo");
    // The tenth column has the sent packets: eight columns of received data precede those of sent data.
    interfaces.map(|(_, counts)| counts.split_whitespace().nth(9).unwrap().parse::<u64>().unwrap()).sum()
}

#[test]
fn best_effort_publishers_are_read_best_effort_and_reliable_ones_reliably() {
    let test = "best_effort_publishers_are_read_best_effort_and_reliable_ones_reliably";
    // Samples that wait for a repair arrive together when it is done; the lane has room for all of them.
    let yaml = format!("{SCAN}lanes:\n  critical: {{queue_depth: 512}}\n");
    let Some(bed) = Bed::start(test, &yaml) else { return };
    for (index, from) in LIBRARIES.into_iter().enumerate() {
        // A different subscriber for each publisher, so that every library subscribes.
        let to = |offset| Peer::on(LIBRARIES[(index + offset) % LIBRARIES.len()]).keep_all();
        let critical = bed.subscribe("critical", to(1), CRITICAL);
        let best_effort = bed.publish(Peer::on(from).best_effort().rate_hz(200.0).count(200), INPUT);
        let sent: Sent = best_effort.finish();
        critical.wait_received(200);
        critical.end::<Received>().assert_all_of(&sent);

        // A RELIABLE publisher that joins after the BEST_EFFORT one has left is read reliably: ingress
        // requests repairs of its lost samples.
        let critical = bed.subscribe("critical", to(2), CRITICAL);
        bed.host("bridge").lose_incoming(0.05);
        let reliable = bed.publish(
            Peer::on(from)
                .keep_all()
                .option("--max-blocking-ms", 5000)
                .heartbeat_ms(200)
                .rate_hz(200.0)
                .count(400)
                .linger_s(20.0),
            INPUT,
        );
        critical.wait_received(400);
        bed.host("bridge").lose_incoming(0.0);
        critical.end::<Received>().assert_all_of(&reliable.end());
    }
    bed.end();
}

#[test]
fn a_reliable_publisher_is_repaired_beside_best_effort_ones_that_join_and_leave() {
    let test = "a_reliable_publisher_is_repaired_beside_best_effort_ones_that_join_and_leave";
    // Samples that wait for a repair arrive together when it is done; the lane has room for all of them.
    let yaml = format!("{SCAN}lanes:\n  critical: {{queue_depth: 1024}}\n");
    let Some(bed) = Bed::start(test, &yaml) else { return };
    for (index, from) in LIBRARIES.into_iter().enumerate() {
        let beside = LIBRARIES[(index + 1) % LIBRARIES.len()];
        // One subscriber receives the samples of all publishers, which use different ranges of numbers.
        let critical =
            bed.subscribe("critical", Peer::on(Library::Cyclone).keep_all().each_sample(), CRITICAL);
        let reliable_peer = Peer::on(from).keep_all().option("--max-blocking-ms", 5000).heartbeat_ms(200);
        let best_effort_peer = Peer::on(beside).best_effort().rate_hz(100.0);

        // The RELIABLE publisher joins a BEST_EFFORT one.
        let first_best_effort = bed.publish(best_effort_peer.clone().first_seq(1_000_000), INPUT);
        critical.wait_received(20);
        let reliable = bed.publish(reliable_peer.rate_hz(200.0).count(1_500).linger_s(20.0), INPUT);
        let reliable_numbers = || sequences_below(&critical, 1_000_000);
        support::wait_until("samples of the RELIABLE publisher", || reliable_numbers().len() > 50);
        bed.host("bridge").lose_incoming(0.05);
        support::wait_until("repaired samples", || reliable_numbers().len() > 450);
        // BEST_EFFORT publishers leave and join beside it.
        let _: Sent = first_best_effort.end();
        let before = reliable_numbers().len();
        let second_best_effort = bed.publish(best_effort_peer.first_seq(2_000_000), INPUT);
        support::wait_until("samples of both", || {
            let both = sequences(&critical);
            reliable_numbers().len() > before + 200 && both.iter().any(|number| *number >= 2_000_000)
        });
        bed.bridge.wait_status("a problem that names the BEST_EFFORT publisher", |status| {
            let problems = status["problems"].as_array().unwrap();
            let is_expected = |problem: &&Value| {
                problem.as_str().unwrap().contains("BEST_EFFORT publishers beside RELIABLE ones")
            };
            problems.iter().filter(is_expected).count() == 1
        });
        bed.host("bridge").lose_incoming(0.0);
        let _: Sent = second_best_effort.end();
        let status = bed.bridge.status();
        let accounts = status["routes"][0]["publishers"].as_array().unwrap();
        let account = accounts.iter().find(|account| account["reliability"] == "RELIABLE");
        assert_eq!(account.unwrap()["lost_upstream"], 0, "{status}");
        reliable.wait_sent();
        let sent: Sent = reliable.end();
        support::wait_until(format!("the last sample of the RELIABLE publisher, {sent:?}"), || {
            reliable_numbers().last() == Some(&sent.last)
        });
        // Samples before the first received one were written before ingress's RELIABLE reader matched.
        let numbers = reliable_numbers();
        let first = numbers[0];
        assert!(numbers.iter().copied().eq(first..=sent.last), "in order, each once: {numbers:?}");
        println!("{from:?} beside {beside:?}: from sample {first} on");
        assert_eq!(sent.failed, 0, "{sent:?}");
        let _: Received = critical.end();
    }
    bed.wait_accounted();
    bed.end();
}

/// The same with ROS 2 nodes, whose names the bridge knows.
#[test]
fn a_best_effort_node_beside_a_reliable_one_is_named_and_the_reliable_one_is_repaired() {
    let test = "a_best_effort_node_beside_a_reliable_one_is_named_and_the_reliable_one_is_repaired";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    // Fast DDS sends a HEARTBEAT every 3 s; until a repair the samples after the lost one wait: 150 at 50 Hz.
    let yaml = format!("{SCAN}lanes:\n  critical: {{queue_depth: 1024}}\n");
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &yaml) else { return };
    let critical = bed.subscribe("critical", Peer::cyclone().keep_all().each_sample(), CRITICAL);
    let spare = Peer::rclpy("spare_lidar").best_effort().rate_hz(50.0).first_seq(1_000_000);
    let spare = bed.publish(spare, INPUT);
    critical.wait_received(1);
    let reliable = Peer::rclpy("lidar").keep_all().rate_hz(50.0).count(400).linger_s(20.0);
    let reliable = bed.publish(reliable, INPUT);
    let reliable_numbers = || sequences_below(&critical, 1_000_000);
    let account = |status: &Value| {
        let accounts = status["routes"][0]["publishers"].as_array().unwrap();
        accounts.iter().find(|account| account["reliability"] == "RELIABLE").unwrap().clone()
    };
    // Until ingress's RELIABLE reader has matched, its BEST_EFFORT one receives them, and may miss some.
    bed.bridge.wait_status("the account of the RELIABLE node", |status| {
        let mut accounts = status["routes"][0]["publishers"].as_array().unwrap().iter();
        accounts.any(|account| account["reliability"] == "RELIABLE")
    });
    let before = reliable_numbers().len();
    support::wait_until("a second of the RELIABLE node", || reliable_numbers().len() >= before + 50);
    let matched_at = reliable_numbers().len();
    let lost_before = account(&bed.bridge.status())["lost_upstream"].clone();
    bed.host("bridge").lose_incoming(0.05);
    let before = reliable_numbers().len();
    support::wait_until("repaired samples", || reliable_numbers().len() > before + 200);
    let named = format!(
        "BEST_EFFORT publishers beside RELIABLE ones of /scan: /spare_lidar on {};",
        bed.host("publisher").address()
    );
    let status = bed.bridge.wait_status("a problem that names the BEST_EFFORT node", |status| {
        let mut problems = status["problems"].as_array().unwrap().iter().filter_map(Value::as_str);
        problems.any(|problem| problem.contains(&named))
    });
    println!("{}", status["problems"]);
    bed.host("bridge").lose_incoming(0.0);
    let _: Sent = spare.end();
    reliable.wait_sent();
    let status = bed.bridge.status();
    let account = account(&status);
    assert_eq!((&account["node"], &account["lost_upstream"]), (&"/lidar".into(), &lost_before), "{status}");
    let sent: Sent = reliable.end();
    support::wait_until(format!("the last sample of the RELIABLE node, {sent:?}"), || {
        reliable_numbers().last() == Some(&sent.last)
    });
    let numbers = reliable_numbers().split_off(matched_at);
    assert!(numbers.iter().copied().eq(numbers[0]..=sent.last), "in order, each once: {numbers:?}");
    assert_eq!(sent.failed, 0, "{sent:?}");
    bed.wait_accounted();
    let _: Received = critical.end();
    bed.end();
}

/// The sequence numbers that a subscriber has received, in order of arrival.
fn sequences(subscriber: &RunningPeer) -> Vec<u64> {
    let events = subscriber.events();
    events
        .iter()
        .filter(|event| event["event"] == "sample")
        .filter_map(|event| event["seq"].as_u64())
        .collect()
}

fn sequences_below(subscriber: &RunningPeer, bound: u64) -> Vec<u64> {
    sequences(subscriber).into_iter().filter(|number| *number < bound).collect()
}

/// A route for samples of up to 4 MiB, all of which both lanes forward.
const LARGE: &str = "topics:\n  - {id: cloud, input_topic: /cloud, message_type: sensor_msgs/msg/PointCloud2, \
                     max_sample_bytes: 4194304, retained_samples: 1}\n\
                     lanes:\n  critical: {queue_depth: 8}\n  \
                     noncritical: {max_rate_hz: 1000, stale_threshold_ms: 0, qos: {reliability: RELIABLE, \
                     history: KEEP_LAST, depth: 10}, queue_samples: 8, drop_policy: drop_latest, queue_depth: 8}\n";

#[test]
fn every_size_from_0_bytes_to_4_mib_arrives_unchanged_on_both_lanes() {
    let test = "every_size_from_0_bytes_to_4_mib_arrives_unchanged_on_both_lanes";
    let Some(bed) = Bed::start(test, LARGE) else { return };
    let cloud =
        |library| Peer::on(library).keep_all().seed(12).type_name("sensor_msgs::msg::dds_::PointCloud2_");
    let critical_topic = "rt/adaptive_bridge/critical/cloud";
    let noncritical_topic = "rt/adaptive_bridge/noncritical/cloud";
    for from in LIBRARIES {
        for to in LIBRARIES {
            let mut first = 0;
            // An empty sample; a LaserScan of 360 beams, a PointCloud2 of 2 MB, and the largest allowed
            // sample, whose size includes the header; images, which end within a word.
            for (sizes, count, rate_hz) in [
                (&[0][..], 10, 50.0),
                (&[2948, 2_000_000, (4 << 20) - 4], 9, 3.0),
                (&[70_001, 70_002, 70_003], 9, 20.0),
            ] {
                let subscribe = |host, topic| bed.subscribe(host, cloud(to).sizes(sizes), topic);
                let critical = subscribe("critical", critical_topic);
                let noncritical = subscribe("slow", noncritical_topic);
                let publisher = cloud(from).sizes(sizes).count(count).rate_hz(rate_hz).first_seq(first);
                let sent: Sent = bed.publish(publisher, "rt/cloud").finish();
                assert_eq!(sent.ok, count, "{from:?} to {to:?}");
                for subscriber in [critical, noncritical] {
                    subscriber.wait_received(count);
                    subscriber.end::<Received>().assert_all_of(&sent);
                }
                first += count;
            }
        }
    }
    let status = bed.wait_accounted();
    let critical = support::bed::outputs(&status).next().unwrap();
    assert!(
        critical["by_reference"].as_u64() > Some(0),
        "no large sample was forwarded by reference: {critical}"
    );
    // With every library, six of the nine samples of several sizes take several datagrams, and all images.
    let in_place = status["routes"][0]["in_place"].as_u64();
    let large = (LIBRARIES.len() * LIBRARIES.len() * (6 + 9)) as u64;
    assert!(in_place >= Some(large), "{in_place:?} of {large} large samples were assembled in the pool");
    bed.end();
}

#[test]
fn large_samples_arrive_complete_when_packets_are_lost() {
    let Some(bed) = Bed::start("large_samples_arrive_complete_when_packets_are_lost", LARGE) else { return };
    for (from, to) in [(Library::Cyclone, Library::Fast), (Library::Fast, Library::Cyclone)] {
        let cloud = |library| {
            let kind = "sensor_msgs::msg::dds_::PointCloud2_";
            Peer::on(library).keep_all().seed(13).type_name(kind).size(1_000_000)
        };
        let critical = bed.subscribe("critical", cloud(to), "rt/adaptive_bridge/critical/cloud");
        // Loses about ten packets of each sample on the way to the bridge and as many on the way from it.
        for host in ["bridge", "critical"] {
            bed.host(host).lose_incoming(0.01);
        }
        let publisher = cloud(from)
            .option("--max-blocking-ms", 5000)
            .heartbeat_ms(100)
            .rate_hz(5.0)
            .count(20)
            .linger_s(20.0);
        let publisher = bed.publish(publisher, "rt/cloud");
        critical.wait_received(20);
        for host in ["bridge", "critical"] {
            bed.host(host).lose_incoming(0.0);
        }
        critical.end::<Received>().assert_all_of(&publisher.end());
    }
    bed.end();
}

#[test]
fn encapsulation_kind_and_padding_bits_arrive_as_they_were_sent() {
    let test = "encapsulation_kind_and_padding_bits_arrive_as_they_were_sent";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    // CDR_BE with two announced padding bytes, PL_CDR_LE, CDR2_LE with one padding byte (XTypes 1.3, table
    // 60).
    for (header, from, to) in [
        ("00000002", Library::Fast, Library::Fast),
        ("00030000", Library::Fast, Library::Rust),
        ("00070001", Library::Rust, Library::Fast),
    ] {
        let critical = bed.subscribe("critical", Peer::on(to).keep_all().size(100), CRITICAL);
        let noncritical = bed.subscribe("slow", Peer::on(to).best_effort().size(100), NONCRITICAL);
        let publisher = Peer::on(from).keep_all().size(100).encapsulation(header).count(40).rate_hz(20.0);
        let sent: Sent = bed.publish(publisher, INPUT).finish();
        critical.wait_received(40);
        noncritical.wait_received(1);
        let received: Received = critical.end();
        received.assert_all_of(&sent);
        assert_eq!(received.headers, BTreeMap::from([(header.to_owned(), 40)]));
        let slow: Received = noncritical.end();
        slow.assert_sound();
        assert_eq!(slow.headers.keys().collect::<Vec<_>>(), [header]);
    }
    bed.end();
}

#[test]
fn a_type_is_discovered_and_an_error_names_both_of_two_types_on_one_topic() {
    let test = "a_type_is_discovered_and_an_error_names_both_of_two_types_on_one_topic";
    let yaml = "topics:\n  - {id: any, input_topic: /any, max_sample_bytes: 65536}\n";
    let Some(bed) = Bed::start(test, yaml) else { return };
    bed.up.wait_for_log("waiting for a publisher");
    let peer = || Peer::cyclone().keep_all().type_name("robot_msgs::msg::dds_::Custom_");
    let critical =
        peer().subscriber().topic("rt/adaptive_bridge/critical/any").start_on(bed.host("critical"));
    let publisher = bed.publish(peer().rate_hz(100.0), "rt/any");
    critical.wait_received(50);

    let other = Peer::fast().type_name("other_msgs::msg::dds_::Different_").topic("rt/any").publisher();
    let other = other.start_on(bed.host("slow"));
    bed.up.wait_for_log("two types claim the topic");
    let log = bed.up.log();
    let line = log.lines().find(|line| line.contains("two types claim")).unwrap();
    assert!(line.contains("robot_msgs::msg::dds_::Custom_"), "{line}");
    assert!(line.contains("other_msgs::msg::dds_::Different_"), "{line}");
    let before = critical.received();
    critical.wait_received(before + 50);
    let _: Sent = other.end();
    let _: Sent = publisher.end();
    critical.end::<Received>().assert_sound();
    bed.end();
}

/// A latched route: a map on both lanes, RELIABLE on the critical one, BEST_EFFORT on the noncritical one.
const MAP: &str = "topics:\n  - id: map\n    input_topic: /map\n    message_type: nav_msgs/msg/OccupancyGrid\n    \
                   max_sample_bytes: 65536\n    qos_overrides:\n      \
                   critical: {durability: TRANSIENT_LOCAL, depth: 1}\n      \
                   noncritical: {durability: TRANSIENT_LOCAL, depth: 1}\n";

#[test]
fn a_latched_sample_reaches_late_joiners_of_both_lanes_even_after_a_restart_of_egress() {
    let test = "a_latched_sample_reaches_late_joiners_of_both_lanes_even_after_a_restart_of_egress";
    let Some(bed) = Bed::start(test, MAP) else { return };
    let map = |library| {
        Peer::on(library)
            .transient_local()
            .keep_last(1)
            .type_name("nav_msgs::msg::dds_::OccupancyGrid_")
            .size(4000)
    };
    // Published once with an old source timestamp: a latched sample is forwarded at any age.
    let publisher = map(Library::Cyclone).count(1).linger_s(600.0).source_age_ms(60_000);
    let publisher = bed.publish(publisher, "rt/map");
    publisher.wait_sent();
    for round in 0..2 {
        for to in LIBRARIES {
            let late =
                |host, peer: Peer, topic: &str| peer.subscriber().topic(topic).start_on(bed.host(host));
            let critical = late("critical", map(to), "rt/adaptive_bridge/critical/map");
            let noncritical = late("slow", map(to).best_effort(), "rt/adaptive_bridge/noncritical/map");
            for subscriber in [critical, noncritical] {
                subscriber.wait_received(1);
                let received: Received = subscriber.end();
                assert_eq!((received.received, received.bad), (1, 0), "round {round}, {to:?}: {received:?}");
                assert_eq!(received.source_timestamps_changed, 0);
            }
        }
        if round == 0 {
            for child in ["egress-critical", "egress-noncritical"] {
                support::process::signal(bed.pid(child), nix::sys::signal::Signal::SIGKILL);
                support::wait_until("a restart", || bed.pids(child).len() == 2);
            }
        }
    }
    let _: Sent = publisher.end();
    bed.end();
}

#[test]
fn several_routes_and_a_user_defined_lane_in_another_domain_forward_samples() {
    let test = "several_routes_and_a_user_defined_lane_in_another_domain_forward_samples";
    let yaml = "topics:\n  \
                - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, max_sample_bytes: 8192}\n  \
                - {id: odom, input_topic: /odom, message_type: nav_msgs/msg/Odometry, max_sample_bytes: 8192, \
                   outputs: {rviz: /operator/odom}}\n\
                lanes:\n  rviz: {domain_id: 42, max_rate_hz: 20, networks: [eth0]}\n";
    let Some(bed) = Bed::start(test, yaml) else { return };
    bed.up.wait_for_log("egress is up lane=\"rviz\"");
    let scan = || Peer::cyclone().keep_all().seed(1);
    let odom = || Peer::fast().keep_all().seed(2).type_name("nav_msgs::msg::dds_::Odometry_");
    let critical_scan = bed.subscribe("critical", scan(), CRITICAL);
    let critical_odom = bed.subscribe("critical", odom(), "rt/adaptive_bridge/critical/odom");
    let rviz_scan = bed.subscribe("slow", scan().best_effort().domain(42), "rt/adaptive_bridge/rviz/scan");
    let rviz_odom = bed.subscribe("slow", odom().best_effort().domain(42), "rt/operator/odom");
    let scans = bed.publish(scan().rate_hz(100.0).count(300), INPUT);
    let odoms = bed.publish(odom().rate_hz(150.0).count(450), "rt/odom");
    let (scans, odoms): (Sent, Sent) = (scans.finish(), odoms.finish());
    critical_scan.wait_received(300);
    critical_odom.wait_received(450);
    critical_scan.end::<Received>().assert_all_of(&scans);
    critical_odom.end::<Received>().assert_all_of(&odoms);
    for subscriber in [rviz_scan, rviz_odom] {
        let received: Received = subscriber.end();
        received.assert_sound();
        // 20 Hz for 3 s, plus a burst of the token bucket at each end.
        assert!((50..=66).contains(&received.received), "{received:?}");
        assert!(missing_from(&received, 0).len() > 10);
    }
    bed.wait_accounted();
    bed.end();
}

#[test]
fn the_ros_graph_shows_each_process_as_a_node_with_its_endpoints() {
    let test = "the_ros_graph_shows_each_process_as_a_node_with_its_endpoints";
    for gid_bytes in [16, 24] {
        let yaml = format!("{SCAN}ros: {{graph_gid_bytes: {gid_bytes}}}\n");
        let Some(bed) = Bed::start(test, &yaml) else { return };
        let publisher = bed.publish(Peer::fast().rate_hz(10.0), INPUT);
        let viewer = Peer::cyclone().graph(gid_bytes).start_on(bed.host("slow"));
        let node_of = |graph: &Graph, name: &str| {
            graph.nodes.values().flatten().find(|node| node.name == name).cloned()
        };
        for (name, kind, topic) in [
            ("ingress", "reader", INPUT),
            ("egress_critical", "writer", CRITICAL),
            ("egress_noncritical", "writer", NONCRITICAL),
        ] {
            support::wait_until(format!("{name} with its {kind} of {topic}"), || {
                let graph = viewer.graph();
                let Some(node) = node_of(&graph, name) else { return false };
                let gids = if kind == "reader" { &node.reader_gids } else { &node.writer_gids };
                node.namespace.starts_with("/adaptive_bridge")
                    && gids.len() == 1
                    && graph.endpoints.values().any(|endpoint| {
                        endpoint.kind == kind
                            && endpoint.topic == topic
                            && endpoint.type_name == support::bed::SCAN_TYPE
                            && gids[0].starts_with(&endpoint.guid)
                    })
            });
        }
        // rmw_cyclonedds reads the enclave of a node in the USER_DATA of its participant.
        let graph = viewer.graph();
        let enclaves = graph.nodes.keys().map(|gid| graph.user_data[&gid[..32]].as_str());
        assert!(
            enclaves.clone().all(|enclave| enclave == "enclave=/;"),
            "{:?}",
            enclaves.collect::<Vec<_>>()
        );
        let _: Sent = publisher.end();
        bed.end();
    }
}

#[test]
fn the_endpoints_announce_the_deadline_and_the_lifespan_of_the_configuration() {
    let test = "the_endpoints_announce_the_deadline_and_the_lifespan";
    let yaml = "topics:\n  - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
                qos_overrides: {input: {deadline_ms: 700}, critical: {deadline_ms: 800, lifespan_ms: 900}}}\n";
    let Some(bed) = Bed::start(test, yaml) else { return };
    let publisher = bed.publish(Peer::fast().rate_hz(10.0), INPUT);
    let viewer = Peer::cyclone().graph(16).start_on(bed.host("slow"));
    for (kind, topic, deadline_ms, lifespan_ms) in [
        ("reader", INPUT, Some(700.0), None),
        ("writer", CRITICAL, Some(800.0), Some(900.0)),
        ("writer", NONCRITICAL, None, None),
    ] {
        let qos = support::wait_for(format!("the {kind} of {topic}"), || {
            let endpoints = viewer.graph().endpoints;
            let mut of_topic = endpoints.into_values().filter(|it| it.kind == kind && it.topic == topic);
            of_topic.next().map(|endpoint| endpoint.qos)
        });
        let announced = ["deadline_ms", "lifespan_ms"].map(|policy| qos[policy].as_f64());
        assert_eq!(announced, [deadline_ms, lifespan_ms], "{kind} of {topic}: {qos}");
    }
    let _: Sent = publisher.end();
    bed.end();
}

#[test]
fn each_lane_marks_its_datagrams_with_its_dscp() {
    let test = "each_lane_marks_its_datagrams_with_its_dscp";
    let Some(bed) = Bed::start(test, &format!("{SCAN}lanes: {{noncritical: {{dscp: 10}}}}\n")) else {
        return;
    };
    let bridge = bed.host("bridge").address().to_string();
    let lanes = [("critical", CRITICAL, "46"), ("slow", NONCRITICAL, "10")];
    for (host, _, dscp) in lanes {
        let counted = ["-A", "INPUT", "-p", "udp", "-s", &bridge, "-m", "dscp", "--dscp", dscp];
        bed.host(host).run("iptables", &counted);
    }
    let subscribers = lanes.map(|(host, topic, _)| bed.subscribe(host, Peer::cyclone(), topic));
    let publisher = bed.publish(Peer::cyclone().rate_hz(30.0), INPUT);
    for subscriber in &subscribers {
        subscriber.wait_received(20);
    }
    let _: Sent = publisher.end();
    for ((host, ..), subscriber) in lanes.into_iter().zip(subscribers) {
        let received = subscriber.end::<Received>().received;
        let rules = bed.host(host).run("iptables", &["-L", "INPUT", "-v", "-n", "-x"]);
        let packets: u64 = rules.lines().nth(2).unwrap().split_whitespace().next().unwrap().parse().unwrap();
        assert!(packets >= received, "{received} samples, but with the DSCP of the lane: {rules}");
    }
    bed.end();
}
