//! Networks that come, go and change while samples flow: a link that is down for shorter and longer than the
//! leases of discovery, another address, an address that comes after the bridge, an interface that vanishes,
//! a second one. With subscribers of both lanes, publishers and a responder on the far side, on ROS 2 nodes
//! (rclpy), Fast DDS and Cyclone DDS, and by their own counts. Each event happens to flows without the bridge
//! as well.

mod support;

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL};
use support::bridge::Bridge;
use support::netns::Net;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::Process;
use support::ros;

const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// Those that offer a bridge on their host the loopback interface. Cyclone DDS uses the one interface that it
/// chose when it was started, and when that has lost its address it sends nothing, with or without a bridge.
const LOOPBACK: [Library; 2] = [Library::Rclpy, Library::Fast];
/// A topic that the bridge does not know.
const PLAIN: &str = "rt/plain";
/// The responder's id.
const RESPONDER: &str = "laptop";
/// Samples that show that a subscriber is served again: of RELIABLE ones the first few may be repairs of what
/// was sent before the event.
const AGAIN: u64 = 5;

/// Routes for `rt/scan`, which the bridge's host publishes, and for `rt/from_LIBRARY`, which come from the
/// host whose link goes.
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

/// Why the tests can't run here.
fn missing() -> Option<String> {
    ros::missing().or_else(support::testbed_missing)
}

/// One subscriber, and what it is.
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

/// Flows between the bridge's host and another one.
struct Scene {
    /// Subscribers on the other host, and those that read what it publishes.
    flows: Vec<Flow>,
    /// Critical subscribers beside the bridge, which no event is to disturb.
    local: Vec<RunningPeer>,
    scanner: RunningPeer,
    /// The other publishers.
    publishers: Vec<RunningPeer>,
    responder: Option<Process>,
}

impl Scene {
    /// Starts the flows, some with the bridge and some without. `far` is the other host; `local` are the
    /// libraries of the subscribers beside the bridge.
    fn start(bed: &Bed, far: &str, local: &[Library]) -> Self {
        let scene = Self::start_unmatched(bed, far, local);
        for subscriber in scene.local.iter().chain(scene.flows.iter().map(|flow| &flow.subscriber)) {
            subscriber.wait_received(AGAIN);
        }
        scene.wait_answered(bed);
        scene
    }

    /// As [`start`](Self::start), and waits only for what is on the bridge's host.
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
        // Without the bridge, each library publishes to itself, from where the bridge is.
        for &library in local {
            let plain = peer(library, "plain_scanner").publisher().topic(&plain_topic(library)).rate_hz(30.0);
            scene.publishers.push(plain.start_on(robot));
        }
        scene.add_far_side(bed, far, &LIBRARIES, local);
        scene
    }

    /// Subscribers of both lanes, publishers and a responder on a host; and, of the libraries in `plain`,
    /// subscribers and publishers without the bridge.
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

    /// Waits until the responder's answers arrive.
    fn wait_answered(&self, bed: &Bed) {
        bed.bridge.wait_status("answers of the responder", is_answered);
    }

    /// Waits until the local subscribers have received so many more samples.
    fn local_go_on(&self, samples: u64) {
        for subscriber in &self.local {
            subscriber.wait_received(subscriber.received() + samples);
        }
    }

    /// Calls what ends an event, waits until every subscriber of the bridge is served again and the responder
    /// answers; prints for each how long that took. What works without the bridge works with it: its
    /// subscribers have to be served whether the others are or not.
    fn served_again(&self, bed: &Bed, what: &str, end_event: impl FnOnce()) {
        let before = self.counts();
        end_event();
        let began = Instant::now();
        let mut served = vec![false; self.flows.len()];
        let mut answered = false;
        let print = |name: &str| {
            println!("after {what}: {name}: {:.2} s", began.elapsed().as_secs_f64());
            true
        };
        support::wait_until(format_args!("all served again after {what}"), || {
            let mut is_over = true;
            for ((flow, before), served) in self.flows.iter().zip(&before).zip(&mut served) {
                let received = flow.subscriber.received() - before;
                if !*served && received > 0 {
                    *served = print(&flow.name);
                }
                is_over &= received >= AGAIN || !flow.through_bridge;
            }
            if !answered && bed.bridge.try_status().as_ref().is_ok_and(is_answered) {
                answered = print("responder");
            }
            is_over && answered
        });
    }

    /// Ends the flows. Every sample has come to each local subscriber, and to the others in order and once.
    fn end(self, bed: &Bed) {
        self.end_with(bed, 0);
    }

    /// As [`end`](Self::end), but so many samples may have come twice to a subscriber on the other host.
    fn end_with(self, bed: &Bed, max_duplicates: u64) {
        let sent: Sent = self.scanner.end();
        for subscriber in self.local {
            subscriber.wait_received(sent.ok);
            subscriber.end::<Received>().assert_all_of(&sent);
        }
        // Killed: without its interface, Cyclone DDS does not end.
        drop(self.publishers);
        bed.wait_whole();
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

/// With more configuration and more hosts.
fn bed_with(test: &str, yaml: &str, more: &[&str]) -> Option<Bed> {
    if let Some(reason) = missing() {
        support::skip(test, &reason);
        return None;
    }
    Bed::start_with(test, &format!("{}{yaml}", routes()), more)
}

/// A link that is down for so long, first that of the other host, then that of the bridge.
fn outage(test: &str, seconds: u64) {
    let Some(bed) = bed(test) else { return };
    let scene = Scene::start(&bed, "slow", &LIBRARIES);
    for host in ["slow", "bridge"] {
        bed.host(host).set_link(false);
        let began = Instant::now();
        scene.local_go_on(15);
        std::thread::sleep(Duration::from_secs(seconds).saturating_sub(began.elapsed()));
        let said = problems(&bed);
        let about_interface = said.iter().any(|problem| problem.starts_with("network interface eth0"));
        let far = bed.host("slow").address().to_string();
        let about_peer = |what| said.iter().any(|problem| problem.contains(&far) && problem.contains(what));
        if seconds >= 5 {
            assert_eq!(about_interface, host == "bridge", "{said:#?}");
            let peer = ["acknowledges no samples", "missed", "has been silent"].into_iter().any(about_peer);
            assert!(peer, "{said:#?}");
        }
        if seconds >= 17 {
            assert!(about_peer("has been silent"), "{said:#?}");
            assert!(said.iter().any(|problem| problem.contains(RESPONDER)), "{said:#?}");
        }
        let what = format!("{seconds} s without the link of {host}");
        scene.served_again(&bed, &what, || bed.host(host).set_link(true));
        wait_nothing_away(&bed);
    }
    // One that comes afterwards is found, so built-in endpoints are served, too.
    let late = bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL);
    late.wait_received(5);
    scene.end(&bed);
    bed.end();
}

/// What `status` says is wrong, over a second.
fn problems(bed: &Bed) -> Vec<String> {
    let output = bed.bridge.run("status --json --interval-ms 1000");
    let status: Value = serde_json::from_slice(&output.stdout).unwrap();
    let problems = status["problems"].as_array().into_iter().flatten().filter_map(Value::as_str);
    // Subscribers that bypass the bridge have nothing to do with networks.
    let problems = problems.filter(|problem| !problem.contains("bypass"));
    let problems: Vec<String> = problems.map(str::to_owned).collect();
    println!("{problems:#?}");
    problems
}

/// Waits until `status` says of everything that was away that it is back.
fn wait_nothing_away(bed: &Bed) {
    let status = bed.bridge.wait_status("nothing away", |status| {
        status["absences"].as_array().unwrap().iter().all(|absence| absence["back_s"].is_number())
    });
    println!("back: {}", status["absences"]);
}

/// Waits until `status` names this interface as away.
fn wait_away(bed: &Bed, interface: &str) {
    let is_it = |problem: &Value| {
        problem.as_str().is_some_and(|text| text.starts_with(&format!("network interface {interface} ")))
    };
    bed.bridge
        .wait_status("an interface away", |status| status["problems"].as_array().unwrap().iter().any(is_it));
}

#[test]
fn an_outage_of_1_s_ends_with_the_link() {
    outage("an_outage_of_1_s_ends_with_the_link", 1);
}

#[test]
fn an_outage_of_5_s_ends_with_the_link() {
    outage("an_outage_of_5_s_ends_with_the_link", 5);
}

/// The peers' lease for the bridge ends, that of the bridge for Fast DDS (20 s) does not.
#[test]
fn an_outage_of_17_s_ends_with_the_link() {
    outage("an_outage_of_17_s_ends_with_the_link", 17);
}

/// 60 s, or as many as `ADAPTIVE_BRIDGE_TEST_OUTAGE_S` says.
#[test]
fn a_long_outage_ends_with_the_link() {
    let seconds = std::env::var("ADAPTIVE_BRIDGE_TEST_OUTAGE_S").ok().and_then(|text| text.parse().ok());
    outage("a_long_outage_ends_with_the_link", seconds.unwrap_or(60));
}

/// A laptop that sleeps for longer than every lease: its programs stop, and its link is down. The programs run
/// again before the link is up.
#[test]
fn a_suspended_laptop_is_served_again() {
    let Some(bed) = bed("a_suspended_laptop_is_served_again") else { return };
    let laptop = bed.host("slow").clone();
    let scene = Scene::start(&bed, "slow", &LIBRARIES);
    laptop.signal_all(Signal::SIGSTOP);
    laptop.set_link(false);
    std::thread::sleep(Duration::from_secs(25));
    scene.local_go_on(15);
    laptop.signal_all(Signal::SIGCONT);
    std::thread::sleep(Duration::from_secs(1));
    scene.served_again(&bed, "25 s of suspend", || laptop.set_link(true));
    wait_nothing_away(&bed);
    scene.end(&bed);
    bed.end();
}

#[test]
fn another_address_of_the_robot_disturbs_no_local_subscriber_and_is_announced() {
    let test = "another_address_of_the_robot_disturbs_no_local_subscriber_and_is_announced";
    let Some(bed) = bed(test) else { return };
    let robot = bed.host("bridge").clone();
    let scene = Scene::start(&bed, "slow", &LOOPBACK);

    robot.set_address(None);
    scene.local_go_on(60);
    wait_away(&bed, "eth0");
    let [a, b, c, d] = robot.address().octets();
    let another = Ipv4Addr::new(a, b, c, d + 100);
    scene.served_again(&bed, "another address", || robot.set_address(Some(another)));
    wait_nothing_away(&bed);
    // What joins now has to find the built-in endpoints at the new address.
    let late = bed.subscribe("slow", Peer::fast(), CRITICAL);
    late.wait_received(30);
    // A subscriber that discovers the bridge anew receives again what it had received and whose
    // acknowledgement was lost with the address.
    scene.end_with(&bed, 3);
    bed.end();
}

#[test]
fn an_interface_that_is_deleted_and_made_again_is_used_again() {
    let test = "an_interface_that_is_deleted_and_made_again_is_used_again";
    let Some(bed) = bed(test) else { return };
    let robot = bed.host("bridge").clone();
    let scene = Scene::start(&bed, "slow", &LOOPBACK);
    robot.unplug();
    scene.local_go_on(60);
    wait_away(&bed, "eth0");
    scene.served_again(&bed, "an interface that was deleted", || robot.plug_in());
    wait_nothing_away(&bed);
    scene.end(&bed);
    bed.end();
}

/// Cyclone DDS sends acknowledgements to one of the addresses that a participant announces, the lowest. A
/// subscriber on it that is behind the second interface needs a lane that uses only that one.
#[test]
fn a_second_interface_reaches_subscribers_behind_it() {
    let test = "a_second_interface_reaches_subscribers_behind_it";
    let lane = "lanes: {field: {networks: [wlan0]}}\n";
    let Some(bed) = bed_with(test, lane, &["far"]) else { return };
    let far = bed.host("far");
    far.unplug();
    bed.up.wait_for_log("network interface wlan0 is not on this host or has no IPv4 address");
    let mut scene = Scene::start(&bed, "slow", &LOOPBACK);
    wait_away(&bed, "wlan0");
    bed.host("bridge").connect("wlan0", "192.168.77.1/24", far, "192.168.77.2/24");
    scene.flows.clear();
    scene.publishers.clear();
    scene.add_far_side(&bed, "far", &LOOPBACK, &[]);
    let field = Peer::cyclone().best_effort().subscriber().topic("rt/adaptive_bridge/field/scan");
    scene.flows.push(Flow::new("field", Library::Cyclone, field.start_on(far)));
    scene.served_again(&bed, "a second interface", || {});
    scene.end(&bed);
    bed.end();
}

#[test]
fn an_address_that_comes_after_the_bridge_is_used() {
    let test = "an_address_that_comes_after_the_bridge_is_used";
    if let Some(reason) = missing() {
        support::skip(test, &reason);
        return;
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let robot = net.host("bridge").clone();
    robot.set_address(None);
    // The interface by its name, although it has no address yet.
    let yaml = format!("instance: {{instance}}\nros: {{networks: [eth0]}}\n{}", routes());
    let bridge = Bridge::new(&yaml);
    let up = bridge.start_on(&robot, "up");
    let bed = Bed { up, bridge, net };
    bed.wait_up();
    bed.up.wait_for_log("network interface eth0 is not on this host or has no IPv4 address");
    let scene = Scene::start_unmatched(&bed, "slow", &LOOPBACK);
    scene.local_go_on(30);
    wait_away(&bed, "eth0");
    scene.served_again(&bed, "an address that came late", || robot.set_address(Some(robot.address())));
    wait_nothing_away(&bed);
    scene.end(&bed);
    bed.end();
}
