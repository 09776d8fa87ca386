//! Changes of the network while samples flow: a link that is down for shorter and longer than the leases of
//! discovery, a changed address, an address that is assigned after the bridge has started, a deleted
//! interface, a second interface. Subscribers of both lanes, publishers and a responder are on another host,
//! on rclpy, Fast DDS and Cyclone DDS; their own counts are checked. Each event is applied to flows without
//! the bridge as well.

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL};
use support::bridge::Bridge;
use support::netns::{Host, Net};
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::Process;
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// The libraries that also use the loopback interface, and so reach a bridge on the same host through it.
/// Cyclone DDS uses the one interface that it selected at its start; when that has lost its address, it sends
/// nothing, with or without a bridge.
const LOOPBACK: [Library; 2] = [Library::Rclpy, Library::Fast];
/// A topic that the bridge does not know.
const PLAIN: &str = "rt/plain";
/// The id of the responder.
const RESPONDER: &str = "laptop";
/// Samples after which a subscriber counts as receiving again: for a RELIABLE one the first few may be
/// repairs of samples sent before the event.
const RECOVERY_SAMPLES: u64 = 5;

/// The configuration: a route for `rt/scan`, which is published on the bridge's host, and routes for
/// `rt/from_LIBRARY`, which are published on the host whose link fails.
fn routes() -> String {
    let route = |name: &str| {
        format!(
            "  - {{id: {name}, input_topic: /{name}, message_type: sensor_msgs/msg/LaserScan, \
             max_sample_bytes: 65536}}\n"
        )
    };
    let remote = LIBRARIES.map(|library| route(&format!("from_{}", label(library))));
    let subscribers = format!("subscribers: {{{RESPONDER}: noncritical}}\n");
    format!("topics:\n{}{}{subscribers}", route("scan"), remote.concat())
}

fn label(library: Library) -> String {
    format!("{library:?}").to_lowercase()
}

fn peer(library: Library, node: &str) -> Peer {
    match library {
        Library::Rclpy => Peer::rclpy(node),
        other => Peer::on(other),
    }
}

/// Returns why the tests cannot run here.
fn missing() -> Option<String> {
    ros::missing().or_else(support::testbed_missing)
}

/// One subscriber and its description.
struct Flow {
    name: String,
    subscriber: RunningPeer,
    through_bridge: bool,
}

impl Flow {
    fn new(name: &str, library: Library, subscriber: RunningPeer) -> Self {
        let through_bridge = !name.starts_with("plain");
        Self { name: format!("{name} {}", label(library)), subscriber, through_bridge }
    }
}

/// Flows between the bridge's host and another host.
struct Scene {
    /// Subscribers on the other host, and subscribers of the topics that it publishes.
    flows: Vec<Flow>,
    /// Critical subscribers on the bridge's host, which must receive every sample.
    local: Vec<RunningPeer>,
    scanner: RunningPeer,
    /// The other publishers.
    publishers: Vec<RunningPeer>,
    responder: Option<Process>,
}

impl Scene {
    /// Starts flows with and without the bridge. `far` is the other host; `local` has the libraries of the
    /// subscribers on the bridge's host.
    fn start(bed: &Bed, far: &str, local: &[Library]) -> Self {
        let scene = Self::start_unmatched(bed, far, local);
        for subscriber in scene.local.iter().chain(scene.flows.iter().map(|flow| &flow.subscriber)) {
            subscriber.wait_received(RECOVERY_SAMPLES);
        }
        scene.wait_answered(bed);
        scene
    }

    /// Like [`start`](Self::start), but waits only for subscribers on the bridge's host.
    fn start_unmatched(bed: &Bed, far: &str, local: &[Library]) -> Self {
        let robot = bed.host("bridge");
        let subscribers = local
            .iter()
            .map(|&library| bed.subscribe("bridge", peer(library, "planner").keep_last(1000), CRITICAL));
        let scanner = Peer::fast().publisher().topic(INPUT).keep_last(1000).wait_match(1).rate_hz(30.0);
        let mut scene = Self {
            flows: Vec::new(),
            local: subscribers.collect(),
            scanner: scanner.start_on(robot),
            publishers: Vec::new(),
            responder: None,
        };
        // Without the bridge, each library publishes to itself, from the bridge's host.
        for &library in local {
            let plain = peer(library, "plain_scanner").publisher().topic(&plain_topic(library)).rate_hz(30.0);
            scene.publishers.push(plain.start_on(robot));
        }
        scene.add_far_side(bed, far, &LIBRARIES, local);
        scene
    }

    /// Adds subscribers of both lanes, publishers and a responder on a host, and for the libraries in `plain`
    /// also subscribers and publishers without the bridge.
    fn add_far_side(&mut self, bed: &Bed, far: &str, libraries: &[Library], plain: &[Library]) {
        let far = bed.host(far);
        let robot = bed.host("bridge");
        for &library in libraries {
            let from = format!("from_{}", label(library));
            let far_peer = |topic: &str| peer(library, "far_subscriber").subscriber().topic(topic);
            let publisher = |topic: &str| peer(library, "far_scanner").publisher().topic(topic).rate_hz(10.0);
            let mut add = |name, subscriber| self.flows.push(Flow::new(name, library, subscriber));
            add("noncritical", far_peer(NONCRITICAL).best_effort().start_on(far));
            add("critical", far_peer(CRITICAL).start_on(far));
            let near_topic = format!("rt/adaptive_bridge/critical/{from}");
            add("published", Peer::fast().subscriber().topic(&near_topic).start_on(robot));
            self.publishers.push(publisher(&format!("rt/{from}")).start_on(far));
            if plain.contains(&library) {
                add("plain", far_peer(&plain_topic(library)).start_on(far));
                let near_topic = format!("rt/plain_{from}");
                let near_peer = peer(library, "near_subscriber").subscriber().topic(&near_topic);
                add("plain published", near_peer.start_on(robot));
                self.publishers.push(publisher(&near_topic).start_on(far));
            }
        }
        self.responder = Some(bed.bridge.start_on(far, &format!("responder --id {RESPONDER}")));
    }

    fn counts(&self) -> Vec<u64> {
        self.flows.iter().map(|flow| flow.subscriber.received()).collect()
    }

    /// Waits until control receives the responder's responses.
    fn wait_answered(&self, bed: &Bed) {
        bed.bridge.wait_status("responses of the responder", is_answered);
    }

    /// Waits until the local subscribers have received so many more samples.
    fn wait_more_local(&self, samples: u64) {
        for subscriber in &self.local {
            subscriber.wait_received(subscriber.received() + samples);
        }
    }

    /// Calls `end_event`, waits until every subscriber of the bridge receives samples again and the responder
    /// responds, and prints the time that each took. Subscribers without the bridge are not waited for: the
    /// bridge must recover even if they do not.
    fn wait_recovered(&self, bed: &Bed, what: &str, end_event: impl FnOnce()) {
        let before = self.counts();
        end_event();
        let began = Instant::now();
        let mut recovered = vec![false; self.flows.len()];
        let mut answered = false;
        let print = |name: &str| {
            println!("after {what}: {name}: {:.2} s", began.elapsed().as_secs_f64());
            true
        };
        support::wait_until(format_args!("all subscribers receiving again after {what}"), || {
            let mut is_over = true;
            for ((flow, before), recovered) in self.flows.iter().zip(&before).zip(&mut recovered) {
                let received = flow.subscriber.received() - before;
                if !*recovered && received > 0 {
                    *recovered = print(&flow.name);
                }
                is_over &= received >= RECOVERY_SAMPLES || !flow.through_bridge;
            }
            if !answered && bed.bridge.try_status().as_ref().is_ok_and(is_answered) {
                answered = print("responder");
            }
            is_over && answered
        });
        for (flow, _) in self.flows.iter().zip(recovered).filter(|(_, recovered)| !recovered) {
            println!("after {what}: {}: not yet", flow.name);
        }
    }

    /// Waits until every subscriber of the bridge has received so many more samples: those that are served
    /// without the bridge again are served through it too, and not just once.
    fn wait_more_of_the_bridge(&self, samples: u64) {
        let flows = self.flows.iter().zip(self.counts());
        for (flow, before) in flows.filter(|(flow, _)| flow.through_bridge) {
            flow.subscriber.wait_received(before + samples);
        }
    }

    /// Ends the flows. Asserts that each local subscriber received every sample, and that the others received
    /// samples in order and without duplicates.
    fn end(self, bed: &Bed) {
        self.end_with(bed, 0);
    }

    /// Like [`end`](Self::end), but a subscriber on the other host may have received so many duplicates.
    fn end_with(self, bed: &Bed, max_duplicates: u64) {
        self.wait_more_of_the_bridge(2 * RECOVERY_SAMPLES);
        let sent: Sent = self.scanner.end();
        for subscriber in self.local {
            subscriber.wait_received(sent.ok);
            subscriber.end::<Received>().assert_all_of(&sent);
        }
        // Kills the publishers: without its interface, Cyclone DDS does not end by itself.
        drop(self.publishers);
        bed.wait_accounted();
        for flow in self.flows {
            let received: Received = flow.subscriber.end();
            if flow.through_bridge {
                println!("{}: {} received, {} missing", flow.name, received.received, received.missing_count);
                let duplicates = received.duplicates;
                assert!(duplicates <= max_duplicates, "{duplicates} duplicates: {received:?}");
                Received { duplicates: 0, ..received }.assert_sound();
            }
        }
    }
}

fn plain_topic(library: Library) -> String {
    format!("{PLAIN}_{}", label(library))
}

/// Whether the responder has answered within the last second.
fn is_answered(status: &Value) -> bool {
    let mut subscribers = status["subscribers"].as_array().into_iter().flatten();
    subscribers.any(|subscriber| {
        subscriber["id"] == RESPONDER
            && subscriber["last_response_age_ms"].as_f64().is_some_and(|age_ms| age_ms < 1_000.0)
    })
}

fn bed(test: &str) -> Option<Bed> {
    bed_with(test, "", &[])
}

/// Like [`bed`], with additional configuration and hosts.
fn bed_with(test: &str, yaml: &str, more: &[&str]) -> Option<Bed> {
    if let Some(reason) = missing() {
        support::skip(test, &reason);
        return None;
    }
    Bed::start_with(test, &format!("{}{yaml}", routes()), more)
}

/// Tests a link that is down for so many seconds: first that of the other host, then that of the bridge.
fn outage(test: &str, seconds: u64) {
    let Some(bed) = bed(test) else { return };
    let scene = Scene::start(&bed, "slow", &LIBRARIES);
    for host in ["slow", "bridge"] {
        bed.host(host).set_link(false);
        let began = Instant::now();
        scene.wait_more_local(15);
        std::thread::sleep(Duration::from_secs(seconds).saturating_sub(began.elapsed()));
        let problems = problems(&bed);
        let about_interface = problems.iter().any(|problem| problem.starts_with("network interface eth0"));
        let far = bed.host("slow").address().to_string();
        let about_peer =
            |what| problems.iter().any(|problem| problem.contains(&far) && problem.contains(what));
        if seconds >= 5 {
            assert_eq!(about_interface, host == "bridge", "{problems:#?}");
            let peer = ["acknowledges no samples", "missed", "has been silent"].into_iter().any(about_peer);
            assert!(peer, "{problems:#?}");
        }
        if seconds >= 17 {
            assert!(about_peer("has been silent"), "{problems:#?}");
            assert!(problems.iter().any(|problem| problem.contains(RESPONDER)), "{problems:#?}");
        }
        let what = format!("{seconds} s without the link of {host}");
        scene.wait_recovered(&bed, &what, || bed.host(host).set_link(true));
        wait_absences_ended(&bed);
    }
    // A subscriber that joins afterwards is discovered, so that built-in endpoints have recovered too.
    let late = bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL);
    late.wait_received(5);
    scene.end(&bed);
    bed.end();
}

/// The problems in `status` over an interval of one second, without those about intruders.
fn problems(bed: &Bed) -> Vec<String> {
    let output = bed.bridge.run("status --json --interval-ms 1000");
    let status: Value = serde_json::from_slice(&output.stdout).unwrap();
    let problems = status["problems"].as_array().into_iter().flatten().filter_map(Value::as_str);
    // Problems about subscribers that bypass the bridge are unrelated to networks.
    let problems = problems.filter(|problem| !problem.contains("bypass"));
    let problems: Vec<String> = problems.map(str::to_owned).collect();
    println!("{problems:#?}");
    problems
}

/// Waits until `status` shows every absence as ended.
fn wait_absences_ended(bed: &Bed) {
    let status = bed.bridge.wait_status("the end of all absences", |status| {
        status["absences"].as_array().unwrap().iter().all(|absence| absence["back_s"].is_number())
    });
    println!("absences: {}", status["absences"]);
}

/// Waits until `status` has a problem about an absent interface.
fn wait_absence(bed: &Bed, interface: &str) {
    let is_absence = |problem: &Value| {
        problem.as_str().is_some_and(|text| text.starts_with(&format!("network interface {interface} ")))
    };
    bed.bridge.wait_status("an absent interface", |status| {
        status["problems"].as_array().unwrap().iter().any(is_absence)
    });
}

#[test]
fn all_flows_recover_from_an_outage_of_1_s() {
    outage("all_flows_recover_from_an_outage_of_1_s", 1);
}

#[test]
fn all_flows_recover_from_an_outage_of_5_s() {
    outage("all_flows_recover_from_an_outage_of_5_s", 5);
}

/// The lease of the bridge's participants expires at the peers; that of Fast DDS (20 s) does not expire at
/// the bridge.
#[test]
fn all_flows_recover_from_an_outage_of_17_s() {
    outage("all_flows_recover_from_an_outage_of_17_s", 17);
}

#[test]
fn a_changed_address_of_the_bridge_is_announced_and_costs_local_subscribers_no_sample() {
    let test = "a_changed_address_of_the_bridge_is_announced_and_costs_local_subscribers_no_sample";
    let Some(bed) = bed(test) else { return };
    let robot = bed.host("bridge").clone();
    let scene = Scene::start(&bed, "slow", &LOOPBACK);
    // Without the bridge, nodes of one host do not need its address.
    let plain = |node| Peer::rclpy(node).keep_last(1000).topic("rt/plain_local").rate_hz(30.0);
    let plain_planner = plain("plain_planner").subscriber().start_on(&robot);
    let plain_source = plain("plain_source").publisher().wait_match(1).hold().start_on(&robot);
    plain_planner.wait_matched(1);
    plain_source.go();
    plain_planner.wait_received(RECOVERY_SAMPLES);

    robot.set_address(None);
    scene.wait_more_local(60);
    wait_absence(&bed, "eth0");
    let [a, b, c, d] = robot.address().octets();
    let another = Ipv4Addr::new(a, b, c, d + 100);
    scene.wait_recovered(&bed, "another address", || robot.set_address(Some(another)));
    wait_absences_ended(&bed);
    // A subscriber that joins now must find the built-in endpoints at the new address.
    let late = bed.subscribe("slow", Peer::fast(), CRITICAL);
    late.wait_received(30);
    // A subscriber that discovers the bridge again receives a second time the samples whose acknowledgements
    // were lost with the address.
    scene.end_with(&bed, 3);
    let sent: Sent = plain_source.end();
    plain_planner.wait_received(sent.ok);
    plain_planner.end::<Received>().assert_all_of(&sent);
    bed.end();
}

#[test]
fn an_interface_that_is_deleted_and_recreated_is_used_again() {
    let test = "an_interface_that_is_deleted_and_recreated_is_used_again";
    let Some(bed) = bed(test) else { return };
    let robot = bed.host("bridge").clone();
    let scene = Scene::start(&bed, "slow", &LOOPBACK);
    robot.unplug();
    scene.wait_more_local(60);
    wait_absence(&bed, "eth0");
    scene.wait_recovered(&bed, "an interface that was deleted", || robot.plug_in());
    wait_absences_ended(&bed);
    scene.end(&bed);
    bed.end();
}

/// Cyclone DDS sends acknowledgements only to the lowest address that a participant announces. A subscriber
/// on it behind the second interface therefore needs a lane that uses only that interface.
#[test]
fn a_second_interface_reaches_subscribers_behind_it() {
    let test = "a_second_interface_reaches_subscribers_behind_it";
    let lane = "lanes: {field: {networks: [wlan0]}}\n";
    let Some(bed) = bed_with(test, lane, &["far"]) else { return };
    let far = bed.host("far");
    far.unplug();
    bed.up.wait_for_log("network interface wlan0 is not on this host or has no IPv4 address");
    let mut scene = Scene::start(&bed, "slow", &LOOPBACK);
    wait_absence(&bed, "wlan0");
    bed.host("bridge").connect("wlan0", "192.168.77.1/24", far, "192.168.77.2/24");
    scene.flows.clear();
    scene.publishers.clear();
    scene.add_far_side(&bed, "far", &LOOPBACK, &[]);
    let field = Peer::cyclone().best_effort().subscriber().topic("rt/adaptive_bridge/field/scan");
    scene.flows.push(Flow::new("field", Library::Cyclone, field.start_on(far)));
    scene.wait_recovered(&bed, "a second interface", || {});
    scene.end(&bed);
    bed.end();
}

/// Tests a network of the bridge's host that is there only after the bridge has started.
fn late_network(what: &str, networks: &str, take_away: impl FnOnce(&Host), give: impl FnOnce(&Host)) {
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let robot = net.host("bridge").clone();
    take_away(&robot);
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{networks}{}", routes()));
    let up = bridge.start_on(&robot, "up");
    let bed = Bed { up, bridge, net };
    bed.wait_up();
    let is_configured = !networks.is_empty();
    if is_configured {
        bed.up.wait_for_log("network interface eth0 is not on this host or has no IPv4 address");
    }
    let scene = Scene::start_unmatched(&bed, "slow", &LOOPBACK);
    scene.wait_more_local(30);
    // The bridge does not miss an interface that neither the configuration names nor a peer was reached by.
    if is_configured {
        wait_absence(&bed, "eth0");
    }
    scene.wait_recovered(&bed, what, || give(&robot));
    wait_absences_ended(&bed);
    scene.end(&bed);
    bed.end();
}

#[test]
fn an_address_that_is_assigned_after_the_start_is_used() {
    let test = "an_address_that_is_assigned_after_the_start_is_used";
    if let Some(reason) = missing() {
        return support::skip(test, &reason);
    }
    let remove = |robot: &Host| robot.set_address(None);
    let assign = |robot: &Host| robot.set_address(Some(robot.address()));
    late_network("a late address of a configured interface", "ros: {networks: [eth0]}\n", remove, assign);
    late_network("a late address", "", remove, assign);
}

#[test]
fn a_link_that_comes_up_after_the_start_is_used() {
    let test = "a_link_that_comes_up_after_the_start_is_used";
    if let Some(reason) = missing() {
        return support::skip(test, &reason);
    }
    late_network("a late link", "", |robot| robot.set_link(false), |robot| robot.set_link(true));
}

/// The UDP datagrams that sockets of a host have received.
fn received_datagrams(host: &Host) -> u64 {
    let counters = host.run("cat", &["/proc/net/snmp"]);
    let [names, values] =
        [0, 1].map(|line| counters.lines().filter(|l| l.starts_with("Udp:")).nth(line).unwrap());
    let column = names.split_whitespace().position(|name| name == "InDatagrams").unwrap();
    values.split_whitespace().nth(column).unwrap().parse().unwrap()
}

/// As `docker0` is while no container runs. Fast DDS takes its address for that of another host, and sends
/// each sample to it as well if ingress announces it.
#[test]
fn an_interface_that_never_had_a_carrier_is_not_announced() {
    let test = "an_interface_that_never_had_a_carrier_is_not_announced";
    if let Some(reason) = support::testbed_missing() {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let robot = net.host("bridge").clone();
    for command in [
        "link add docker0 type veth peer name unused",
        "address add 172.17.0.1/16 dev docker0",
        "link set docker0 up",
    ] {
        robot.run("ip", &command.split(' ').collect::<Vec<_>>());
    }
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{}", routes()));
    let up = bridge.start_on(&robot, "up");
    let bed = Bed { up, bridge, net };
    bed.wait_up();
    let samples = 10_000;
    let publisher =
        Peer::fast().publisher().topic(INPUT).rate_hz(2_000.0).count(samples).wait_match(1).hold();
    let publisher = publisher.start_on(&robot);
    publisher.wait_matched(1);
    let before = received_datagrams(&robot);
    publisher.go();
    let sent: Sent = publisher.finish();
    assert_eq!(sent.ok, samples);
    let datagrams = received_datagrams(&robot) - before;
    println!("{datagrams} datagrams for {samples} samples");
    // Beside the samples there are announcements, HEARTBEATs and acknowledgements.
    assert!(datagrams < samples * 3 / 2, "{datagrams} datagrams for {samples} samples");
    bed.end();
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    /// An outage of 60 s, or of `ADAPTIVE_BRIDGE_TEST_OUTAGE_S`; 300 s in `make soak`.
    #[test]
    fn all_flows_recover_from_a_long_outage() {
        let seconds = std::env::var("ADAPTIVE_BRIDGE_TEST_OUTAGE_S").ok().and_then(|text| text.parse().ok());
        outage("all_flows_recover_from_a_long_outage", seconds.unwrap_or(60));
    }

    /// A laptop is suspended for longer than every lease: its programs stop, and its link is down. The
    /// programs run again before the link is up.
    #[test]
    fn all_flows_recover_from_a_suspended_laptop() {
        let Some(bed) = bed("all_flows_recover_from_a_suspended_laptop") else { return };
        let laptop = bed.host("slow").clone();
        let scene = Scene::start(&bed, "slow", &LIBRARIES);
        laptop.signal_all(Signal::SIGSTOP);
        laptop.set_link(false);
        std::thread::sleep(Duration::from_secs(25));
        scene.wait_more_local(15);
        laptop.signal_all(Signal::SIGCONT);
        std::thread::sleep(Duration::from_secs(1));
        scene.wait_recovered(&bed, "25 s of suspend", || laptop.set_link(true));
        wait_absences_ended(&bed);
        scene.end(&bed);
        bed.end();
    }
}
