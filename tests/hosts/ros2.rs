//! What ROS 2 nodes (rclpy) see of the bridge, beyond the samples.

use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN};
use support::bridge::{self, Bridge};
use support::netns::Net;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::{Process, signal};
use support::ros;

/// Nodes that publish one sample each.
const NODES: u64 = 50;

/// SCAN, and a route whose type is known only when its publisher is discovered.
const IMU: &str = "  - {id: imu, input_topic: /imu, max_sample_bytes: 8192}\n";

/// Waits until a query lists `count` endpoints of a topic that are not of the test's own nodes, each with
/// this hash.
fn wait_hash(query: &RunningPeer, topic: &str, kind: &str, count: usize, hash: &str) {
    query.wait_for(&format!("{count} {kind} of {topic} with {hash}"), |event| {
        let endpoints = event["endpoints"].as_array().into_iter().flatten();
        let is_own = |node: &Value| ["lidar", "imu", "info"].iter().any(|name| node == name);
        let found =
            endpoints.filter(|one| one["topic"] == topic && one["kind"] == kind && !is_own(&one["node"]));
        let hashes: Vec<_> = found.map(|endpoint| endpoint["type_hash"].as_str().unwrap()).collect();
        hashes == vec![hash; count]
    });
}

#[test]
fn nodes_see_the_type_hash_of_the_publisher_on_the_outputs() {
    let test = "nodes_see_the_type_hash_of_the_publisher_on_the_outputs";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, &format!("{SCAN}{IMU}")) else { return };
    let scan = bed.publish(Peer::rclpy("lidar").rate_hz(10.0), INPUT);
    let imu = Peer::rclpy("imu").type_name("sensor_msgs::msg::dds_::Imu_").rate_hz(10.0);
    let imu = bed.publish(imu, "rt/imu");
    let [scan_hash, imu_hash] =
        ["LaserScan", "Imu"].map(|name| ros::type_hash(&format!("sensor_msgs/msg/{name}")));
    bed.bridge.wait_status("the hashes of both types", |status| {
        let routes = status["routes"].as_array().unwrap();
        routes.iter().map(|route| route["type_hash"].as_str()).eq([Some(&*scan_hash), Some(&*imu_hash)])
    });
    let topics = [
        (INPUT, "reader", 1, scan_hash.as_str()),
        (CRITICAL, "writer", 1, &scan_hash),
        (NONCRITICAL, "writer", 1, &scan_hash),
        ("rt/imu", "reader", 1, &imu_hash),
        ("rt/adaptive_bridge/critical/imu", "writer", 1, &imu_hash),
        ("rt/adaptive_bridge/noncritical/imu", "writer", 1, &imu_hash),
        ("rt/diagnostics", "writer", 1, &ros::type_hash("diagnostic_msgs/msg/DiagnosticArray")),
        ("rt/adaptive_bridge/diagnostics", "writer", 1, &ros::type_hash("std_msgs/msg/String")),
        ("rt/adaptive_bridge/probe_req", "writer", 1, &ros::type_hash("std_msgs/msg/String")),
        // Of the bridge's four processes and of three nodes; the nodes of these writers are unknown.
        ("ros_discovery_info", "writer", 7, &ros::type_hash("rmw_dds_common/msg/ParticipantEntitiesInfo")),
    ];
    let query = Peer::info(&topics.map(|(topic, ..)| topic)).start_on(bed.host("critical"));
    for (topic, kind, count, hash) in topics {
        wait_hash(&query, topic, kind, count, hash);
    }
    // A restarted lane announces the hash with its new writers.
    let pid = bed.pid("egress-critical");
    signal(pid, Signal::SIGKILL);
    support::wait_until("a restarted critical lane", || bed.pid("egress-critical") != pid);
    let query = Peer::info(&[CRITICAL]).start_on(bed.host("slow"));
    wait_hash(&query, CRITICAL, "writer", 1, &scan_hash);
    for publisher in [scan, imu] {
        let _: Sent = publisher.end();
    }
    bed.end();
}

#[test]
fn the_nodes_of_the_bridge_are_in_the_enclave_of_a_plain_node() {
    let test = "the_nodes_of_the_bridge_are_in_the_enclave_of_a_plain_node";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscriber = bed.subscribe("slow", Peer::rclpy("plain"), NONCRITICAL);
    let query = Peer::info(&[INPUT]).start_on(bed.host("critical"));
    for name in ["plain", "ingress", "control", "egress_critical", "egress_noncritical"] {
        query.wait_for(&format!("the enclave of {name}"), |event| {
            let mut nodes = event["nodes"].as_array().into_iter().flatten();
            nodes.any(|node| node["name"] == name && node["enclave"] == "/")
        });
    }
    let _: Received = subscriber.end();
    bed.end();
}

#[test]
fn a_publisher_of_another_type_or_definition_is_a_problem_while_it_is_there() {
    let test = "a_publisher_of_another_type_or_definition_is_a_problem_while_it_is_there";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let peer = |hash: &str| Peer::on(Library::Rust).option("--type-hash", hash.repeat(32)).rate_hz(10.0);
    let first = bed.publish(peer("a1"), INPUT);
    let hash = format!("RIHS01_{}", "a1".repeat(32));
    bed.bridge.wait_status("the first hash", |status| status["routes"][0]["type_hash"] == *hash);
    let problems = |status: &Value, text: &str| {
        let problems = status["problems"].as_array().unwrap().clone();
        problems.iter().filter(|problem| problem.as_str().unwrap().contains(text)).count()
    };
    let begin = |peer: Peer| peer.publisher().topic(INPUT).start_on(bed.host("slow"));
    let other_definition = begin(peer("b2"));
    let text = format!("another definition of sensor_msgs/msg/LaserScan (RIHS01_{}) than", "b2".repeat(32));
    bed.bridge.wait_status("the other definition", |status| problems(status, &text) == 1);
    // The outputs keep the hash that they announced first.
    assert_eq!(bed.bridge.status()["routes"][0]["type_hash"], hash);
    let _: Sent = other_definition.end();
    bed.bridge.wait_status("no problem", |status| problems(status, "another definition") == 0);
    let other_type = begin(peer("a1").type_name("sensor_msgs::msg::dds_::Imu_"));
    let text = "with the type sensor_msgs/msg/Imu, not sensor_msgs/msg/LaserScan";
    bed.bridge.wait_status("the other type", |status| problems(status, text) == 1);
    for publisher in [other_type, first] {
        let _: Sent = publisher.end();
    }
    bed.end();
}

#[test]
fn the_sample_of_a_node_that_publishes_once_and_ends_reaches_the_subscriber() {
    let test = "the_sample_of_a_node_that_publishes_once_and_ends_reaches_the_subscriber";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let critical = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let received = || {
        let status = bed.wait_accounted();
        status["routes"][0]["received"].as_u64().unwrap()
    };
    let mut next = 0;
    support::attempts(|| {
        let before = received();
        // Five at a time, because each takes half a second to start.
        for _ in 0..NODES / 5 {
            let nodes = (0..5).map(|_| {
                // As `ros2 topic pub --once`, which ends 0.1 s after it has published. A machine that
                // stalls for so long can keep ingress from discovering the node by then, as any subscriber.
                let node = Peer::rclpy("once").option("--keep-alive", 0.1).first_seq(next).count(1);
                next += 1;
                bed.publish(node, INPUT)
            });
            for mut node in nodes.collect::<Vec<_>>() {
                node.wait();
            }
        }
        // Ingress may still have to receive the last one.
        let all = (0..20).any(|_| {
            std::thread::sleep(Duration::from_millis(100));
            received() - before == NODES
        });
        all.then_some(()).ok_or_else(|| format!("{} of {NODES} samples", received() - before))
    });
    critical.wait_received(NODES);
    let received: Received = critical.end();
    // The nodes are not in step, so that their samples may arrive in another order.
    assert_eq!((received.bad, received.duplicates), (0, 0), "{received:?}");
    bed.wait_accounted();
    bed.end();
}

#[test]
fn a_launch_file_of_the_original_package_starts_a_bridge_whose_nodes_have_its_names() {
    let test = "a_launch_file_of_the_original_package_starts_a_bridge_whose_nodes_have_its_names";
    if let Some(reason) = ros::missing().or_else(support::testbed_missing) {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["bridge", "critical"]);
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{SCAN}"));
    let file = |name: &str| bridge.folder().join(name);
    // As launch_ros writes it for `Node(name="adaptive_bridge_proxy", namespace="r1", parameters=[…])`.
    let parameters = format!(
        "/r1/adaptive_bridge_proxy:\n  ros__parameters:\n    config_path: {}\n    diagnostics:\n      \
         topic: /r1/diagnostics_json\n",
        bridge.config().display()
    );
    std::fs::write(file("launch_params_1"), parameters).unwrap();
    let start = |executable: &str, arguments: &[&str]| {
        symlink(bridge::program(), file(executable)).unwrap();
        let mut command = net.host("bridge").command(file(executable));
        command.args(arguments).args(["--ros-args", "--log-level", "debug"]).env("NO_COLOR", "1");
        Process::spawn(executable, command)
    };
    let names = ["-r", "__node:=adaptive_bridge_proxy", "-r", "__ns:=/r1", "--params-file"];
    let parameters = file("launch_params_1").display().to_string();
    let arguments = [&["--ros-args"][..], &names, &[&*parameters, "--"]].concat();
    let mut proxy = start("proxy_node", &arguments);
    let mut others = ["classifier_node", "diagnostics_node", "probe_responder"].map(|name| start(name, &[]));

    let topics = [CRITICAL, "rt/r1/diagnostics_json", "rt/adaptive_bridge/probe_resp"];
    let query = Peer::info(&topics).start_on(net.host("critical"));
    for (topic, node) in topics.iter().zip([
        "/r1/adaptive_bridge_proxy_egress_critical",
        "/r1/adaptive_bridge_proxy_control",
        "/adaptive_bridge/responder_adaptive_bridge_probe_responder",
    ]) {
        query.wait_for(&format!("{node}, which writes {topic}"), |event| {
            event["endpoints"].as_array().into_iter().flatten().any(|endpoint| {
                let name = |key: &str| endpoint[key].as_str().unwrap_or_default().to_owned();
                endpoint["topic"] == **topic
                    && endpoint["kind"] == "writer"
                    && format!("{}/{}", name("namespace"), name("node")) == node
            })
        });
    }
    // The responder answers the control process.
    bridge.wait_status("a subscriber that answers", |status| {
        status["subscribers"].as_array().is_some_and(|subscribers| !subscribers.is_empty())
    });
    // The parameter is part of the configuration in force, also after a reload.
    let reload = bridge.run("reload");
    assert!(reload.status.success(), "{}", String::from_utf8_lossy(&reload.stderr));
    for process in others.iter_mut().chain([&mut proxy]) {
        process.signal(Signal::SIGINT);
        let ended = process.wait();
        assert!(ended.success(), "{ended}: {}", process.log());
    }
}

#[test]
fn nodes_and_the_bridge_find_each_other_without_multicast() {
    let test = "nodes_and_the_bridge_find_each_other_without_multicast";
    if let Some(reason) = ros::missing().or_else(support::testbed_missing) {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    for host in ["publisher", "bridge", "critical", "slow"] {
        net.host(host).run("iptables", &["-A", "OUTPUT", "-d", "224.0.0.0/4", "-j", "DROP"]);
    }
    // The bridge lists the hosts of the publisher and of the critical subscribers; those of the slow host
    // list the bridge.
    let [publisher, bridge, critical] =
        ["publisher", "bridge", "critical"].map(|host| net.host(host).address().to_string());
    let yaml = format!("instance: {{instance}}\n{SCAN}ros: {{static_peers: [{publisher}, {critical}]}}\n");
    let configuration = Bridge::new(&yaml);
    let mut up = configuration.start_on(net.host("bridge"), "up");
    let mut responder = net.host("slow").command(bridge::program());
    responder.args(["responder", "--id", "laptop"]).env("ROS_STATIC_PEERS", &bridge);
    let mut responder = Process::spawn("the responder", responder);
    let node = |peer: Peer| peer.env("ROS_STATIC_PEERS", &bridge);
    // Cyclone DDS takes discovery by unicast only if it has peers itself; this is what rmw_cyclonedds_cpp
    // makes of ROS_STATIC_PEERS.
    let cyclone = || {
        let uri = format!(
            "<General><AllowMulticast>false</AllowMulticast></General><Discovery>\
             <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>\
             <Peers><Peer address='{bridge}'/></Peers></Discovery>"
        );
        Peer::cyclone().env("CYCLONEDDS_URI", &uri)
    };
    let subscribers = [
        Peer::rclpy("planner").subscriber().topic(CRITICAL).start_on(net.host("critical")),
        cyclone().subscriber().topic(CRITICAL).start_on(net.host("critical")),
        Peer::fast().subscriber().topic(NONCRITICAL).start_on(net.host("critical")),
        node(Peer::rclpy("rviz")).subscriber().topic(NONCRITICAL).start_on(net.host("slow")),
    ];
    for (library, first) in [(Peer::rclpy("lidar"), 0), (cyclone(), 1_000_000)] {
        let library = library.first_seq(first);
        let goals = subscribers.iter().map(|subscriber| subscriber.received() + 5).collect::<Vec<_>>();
        let publisher = library.publisher().topic(INPUT).rate_hz(30.0).start_on(net.host("publisher"));
        for (subscriber, goal) in subscribers.iter().zip(goals) {
            subscriber.wait_received(goal);
        }
        let _: Sent = publisher.end();
    }
    configuration.wait_status("the responder's answers", |status| {
        let subscribers = status["subscribers"].as_array().into_iter().flatten();
        subscribers.filter(|subscriber| subscriber["id"] == "laptop").count() == 1
    });
    for subscriber in subscribers {
        let _: Received = subscriber.end();
    }
    for process in [&mut responder, &mut up] {
        process.signal(Signal::SIGINT);
        assert!(process.wait().success(), "{}", process.log());
    }
}

#[test]
fn every_worked_configuration_starts() {
    let test = "every_worked_configuration_starts";
    if let Some(reason) = support::testbed_missing() {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["bridge"]);
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/examples");
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(files.len() >= 4, "{files:?}");
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let bridge = Bridge::new(&format!("{text}\ninstance: {{instance}}\n"));
        let mut up = bridge.start_on(net.host("bridge"), "up");
        bridge.wait_status(&file.display().to_string(), |status| {
            let processes = status["processes"].as_array().unwrap();
            !processes.is_empty() && processes.iter().all(|process| process["state"] == "running")
        });
        up.signal(Signal::SIGINT);
        assert!(up.wait().success(), "{}: {}", file.display(), up.log());
    }
}
