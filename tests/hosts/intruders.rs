//! Detection of intruders on separate hosts (network namespaces): which readers on Cyclone DDS, Fast DDS and
//! RustDDS are remote, and which node each belongs to.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::Path;

use adaptive_bridge::clock;
use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{
    Discovery, DiscoveryTurn, Endpoint, GraphWatch, Participant, ParticipantOptions, RawReader, ReaderQos,
    encode_graph, host_addresses,
};
use adaptive_bridge::model::{Durability, Guid, Reliability, TopicName};
use adaptive_bridge::policy::{Guarded, GuardedTopic, IntruderEvent, IntruderWatch, Locality};
use nix::sys::signal::Signal;

use support::netns::{Host, Net};
use support::peer::{Library, Peer, Received, Sent};

const SCAN_TYPE: &str = "sensor_msgs::msg::dds_::LaserScan_";
const LIBRARIES: [Library; 2] = [Library::Cyclone, Library::Fast];

/// Creates a robot and a laptop. Both have more than one interface, and a network bridge for containers with
/// the same address.
fn robot_and_laptop(test: &str) -> Option<(Net, Host, Host)> {
    if let Some(reason) = support::testbed_missing() {
        support::skip(test, &reason);
        return None;
    }
    let net = Net::new(&["robot", "laptop"]);
    let (robot, laptop) = (net.host("robot").clone(), net.host("laptop").clone());
    robot.connect("wlan0", "192.168.7.1/24", &laptop, "192.168.7.2/24");
    for host in [&robot, &laptop] {
        host.add_interface("docker0", "172.17.0.1/16");
    }
    Some((net, robot, laptop))
}

fn node_on(host: &Host, name: &str, graph_gid_bytes: usize) -> Participant {
    let options = ParticipantOptions {
        network: &DdsNetwork::of_domain(0),
        namespace: "/fleet".into(),
        node_name: name.into(),
        graph_gid_bytes,
        dscp: 0,
    };
    host.within(|| Participant::open(&options).unwrap())
}

fn read(node: &mut Participant, topic: &str) -> RawReader {
    let qos = ReaderQos {
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 16,
        deadline_ms: None,
    };
    node.create_reader(topic, SCAN_TYPE, &qos).unwrap()
}

/// Adds the readers that a participant has discovered, by topic.
fn take_in(participant: &mut Participant, readers: &mut BTreeMap<String, Endpoint>) {
    while let Some(change) = participant.poll_discovery(&mut DiscoveryTurn::new(clock::monotonic())) {
        if let Discovery::Reader(reader) = change
            && !participant.owns(reader.guid)
        {
            readers.insert(reader.topic.clone(), reader);
        }
    }
}

#[test]
fn readers_of_every_library_are_matched_to_their_host() {
    let test = "readers_of_every_library_are_matched_to_their_host";
    let Some((_net, robot, laptop)) = robot_and_laptop(test) else { return };
    let mut bridge = node_on(&robot, "bridge", 16);
    let mut peers = Vec::new();
    let mut nodes = Vec::new();
    let mut expected = BTreeMap::new();
    for (host, place) in [(&robot, Locality::Local), (&laptop, Locality::Remote)] {
        for library in LIBRARIES {
            let topic = format!("rt/{library:?}_on_{}", host.name());
            peers.push(Peer::on(library).subscriber().topic(&topic).start_on(host));
            expected.insert(topic, place);
        }
        let topic = format!("rt/RustDDS_on_{}", host.name());
        let mut node = node_on(host, "node", 16);
        let reader = read(&mut node, &topic);
        nodes.push((reader, node));
        expected.insert(topic, place);
    }
    // One peer announces shared memory beside its addresses, one announces loopback only.
    peers.push(Peer::fast().shared_memory().subscriber().topic("rt/shared_memory").start_on(&robot));
    expected.insert("rt/shared_memory".to_owned(), Locality::Local);
    let loopback = "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1' \
                    multicast='true'/></Interfaces></General></Domain></CycloneDDS>";
    robot.run("ip", &["link", "set", "lo", "multicast", "on"]);
    peers.push(
        Peer::cyclone().env("CYCLONEDDS_URI", loopback).subscriber().topic("rt/loopback").start_on(&robot),
    );

    let mut readers = BTreeMap::new();
    support::wait_until("all readers discovered", || {
        take_in(&mut bridge, &mut readers);
        expected.keys().all(|topic| readers.contains_key(topic))
    });
    let own = robot.within(|| host_addresses().unwrap());
    assert!(own.contains(&IpAddr::V4(robot.address())) && own.contains(&"172.17.0.1".parse().unwrap()));
    for (topic, place) in &expected {
        let location = &readers[topic].location;
        println!("{topic}: {location:?}");
        assert_eq!(location.locality(&own), *place, "{topic}: {location:?} of {own:?}");
        if *place == Locality::Remote {
            let host = location.host().unwrap().to_string();
            assert!([laptop.address().to_string(), "192.168.7.2".to_owned()].contains(&host), "{host}");
        }
    }
    // A reader that listens only on loopback may not be discovered here.
    if let Some(reader) = readers.get("rt/loopback") {
        println!("rt/loopback: {:?}", reader.location);
        assert_eq!(reader.location.locality(&own), Locality::Local);
    }
    for peer in peers {
        let _: Received = peer.end();
    }
}

/// The detection of intruders as in a turn of the control process.
struct Turn {
    participant: Participant,
    graph: GraphWatch,
    watch: IntruderWatch,
    own: Vec<IpAddr>,
    events: Vec<IntruderEvent>,
}

impl Turn {
    fn new(host: &Host) -> Self {
        let participant = node_on(host, "bridge", 16);
        let graph = participant.watch_graph().unwrap();
        let topic = |name| TopicName::try_from(name).unwrap();
        let alternative = Some(topic("/adaptive_bridge/noncritical/scan"));
        let guarded = |topic, guarded| GuardedTopic { topic, guarded, alternative: alternative.clone() };
        let watch = IntruderWatch::new(vec![
            guarded(topic("/scan"), Guarded::Input),
            guarded(topic("/adaptive_bridge/critical/scan"), Guarded::CriticalOutput),
        ]);
        let own = host.within(|| host_addresses().unwrap());
        Self { participant, graph, watch, own, events: Vec::new() }
    }

    fn take(&mut self) {
        let now = clock::monotonic();
        while let Some(change) = self.participant.poll_discovery(&mut DiscoveryTurn::new(clock::monotonic()))
        {
            match change {
                Discovery::Reader(reader) => {
                    self.watch.endpoint_discovered(
                        reader.guid,
                        &reader.topic,
                        &reader.location,
                        &self.own,
                        now,
                    );
                }
                Discovery::ReaderGone(guid) => self.watch.endpoint_lost(guid, now),
                Discovery::ParticipantGone { prefix, .. } => {
                    self.graph.participant_gone(prefix);
                    self.watch.participant_lost(prefix, now);
                }
                _ => {}
            }
        }
        self.graph.poll();
        while let Some(event) = self.watch.poll(now, |reader| self.graph.node_of(reader)) {
            println!("{event:?}");
            self.events.push(event);
        }
    }

    fn wait_until(&mut self, what: &str, mut condition: impl FnMut(&Self) -> bool) {
        support::wait_until(what, || {
            self.take();
            condition(self)
        });
    }

    /// Waits for the next event and returns it.
    fn next(&mut self, what: &str) -> IntruderEvent {
        let before = self.events.len();
        self.wait_until(what, |turn| turn.events.len() > before);
        self.events[before].clone()
    }
}

#[test]
fn an_intruder_is_reported_with_host_and_node_until_it_leaves() {
    let test = "an_intruder_is_reported_with_host_and_node_until_it_leaves";
    let Some((_net, robot, laptop)) = robot_and_laptop(test) else { return };
    let mut turn = Turn::new(&robot);

    // Readers on the robot are no intruders: neither of these is reported.
    let mut planner = node_on(&robot, "planner", 16);
    let _planner_reader = read(&mut planner, "rt/scan");
    let local = Peer::fast().subscriber().start_on(&robot);

    let mut reported = 0;
    for (gid_bytes, topic) in [(16, "rt/scan"), (24, "rt/adaptive_bridge/critical/scan")] {
        let mut rviz = node_on(&laptop, &format!("rviz_{gid_bytes}"), gid_bytes);
        let reader = read(&mut rviz, topic);
        let IntruderEvent::Appeared(intruder) = turn.next("a warning") else { panic!("{:?}", turn.events) };
        reported += 1;
        assert_eq!(intruder.reader, reader.guid());
        assert_eq!(intruder.topic.topic.to_dds(), topic);
        assert_eq!(intruder.node.as_deref(), Some(format!("/fleet/rviz_{gid_bytes}").as_str()));
        let text = intruder.to_string();
        assert!(text.contains("point it at /adaptive_bridge/noncritical/scan"), "{text}");

        // First a reader is deleted while its participant stays, then the participant leaves.
        let (guid, second) = (reader.guid(), read(&mut rviz, "rt/scan"));
        let IntruderEvent::Appeared(_) = turn.next("a second warning") else { panic!("{:?}", turn.events) };
        reported += 1;
        drop(reader);
        rviz.remove_endpoint(guid);
        assert!(matches!(turn.next("its end"), IntruderEvent::Left(gone) if gone.reader == guid));
        let guid = second.guid();
        drop((second, rviz));
        assert!(matches!(turn.next("its end"), IntruderEvent::Left(gone) if gone.reader == guid));
        // The reader and its participant are disposed of by separate messages.
        turn.wait_until("its node is forgotten", |turn| turn.graph.node_of(guid).is_none());
    }

    // Peers that are no ROS 2 nodes and are killed, so that their leases have to expire.
    for library in LIBRARIES {
        let mut peer = Peer::on(library).subscriber().start_on(&laptop);
        let IntruderEvent::Appeared(intruder) = turn.next("a warning") else { panic!("{:?}", turn.events) };
        reported += 1;
        assert_eq!(intruder.node, None);
        assert!(intruder.to_string().contains("a reader without a known node"), "{intruder}");
        peer.signal(Signal::SIGKILL);
        peer.wait();
        assert!(matches!(turn.next("its end"), IntruderEvent::Left(gone) if gone.reader == intruder.reader));
    }
    assert_eq!((turn.watch.present().count(), turn.watch.reported, turn.watch.unreported), (0, reported, 0));
    let _: Received = local.end();
}

#[test]
fn an_intruder_whose_link_fails_for_a_while_causes_one_warning() {
    let test = "an_intruder_whose_link_fails_for_a_while_causes_one_warning";
    let Some((_net, robot, laptop)) = robot_and_laptop(test) else { return };
    laptop.run("ip", &["link", "set", "wlan0", "down"]);
    let mut turn = Turn::new(&robot);
    let mut rviz = node_on(&laptop, "rviz", 16);
    let reader = read(&mut rviz, "rt/scan");
    assert!(matches!(turn.next("a warning"), IntruderEvent::Appeared(_)));
    laptop.set_link(false);
    assert!(matches!(turn.next("the end of its lease"), IntruderEvent::Left(_)));
    laptop.set_link(true);
    let IntruderEvent::Returned(intruder) = turn.next("its return") else { panic!("{:?}", turn.events) };
    assert_eq!((intruder.reader, intruder.node.as_deref()), (reader.guid(), Some("/fleet/rviz")));
    assert_eq!((turn.watch.present().count(), turn.watch.reported, turn.watch.unreported), (1, 1, 0));
}

#[test]
fn a_false_or_malformed_graph_entry_is_counted_and_names_no_node() {
    let test = "a_false_or_malformed_graph_entry_is_counted_and_names_no_node";
    let Some((_net, robot, laptop)) = robot_and_laptop(test) else { return };
    let mut turn = Turn::new(&robot);
    let mut rviz = node_on(&laptop, "rviz", 16);
    let reader = read(&mut rviz, "rt/scan");
    // One entry of another participant has the first one's GUID, the next claims the reader for its own node.
    let lie = encode_graph(rviz.guid(), "/", "innocent", &[reader.guid()], &[], 16);
    let thief = encode_graph(Guid([7; 16]), "/", "thief", &[reader.guid()], &[], 24);
    let folder = tempfile::tempdir().unwrap();
    let mut liars = Vec::new();
    for (name, bytes) in [("lie", &lie[..]), ("thief", &thief[..]), ("garbage", &[0xff; 400][..])] {
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        liars.push(say_on_the_graph(&file).start_on(&laptop));
    }
    turn.wait_until("three refusals", |turn| turn.graph.refusals().malformed == 3);
    turn.wait_until("the node's name", |turn| turn.graph.node_of(reader.guid()) == Some("/fleet/rviz"));
    assert_eq!(turn.graph.refusals().too_many, 0);
    for liar in liars {
        let _: Sent = liar.end();
    }
}

/// A publisher that publishes the bytes of a file once on the topic of the graph.
fn say_on_the_graph(file: &Path) -> Peer {
    Peer::fast()
        .publisher()
        .topic("ros_discovery_info")
        .type_name("rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_")
        .transient_local()
        .keep_last(1)
        .payload_file(file)
        .count(1)
        .linger_s(600.0)
}
