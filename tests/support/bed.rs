//! A test bed: a bridge on a separate host, between a host with the publisher and hosts with the subscribers.

use std::net::SocketAddrV4;

use serde_json::Value;

use super::bridge::Bridge;
use super::netns::{Host, Net, udp_ports};
use super::peer::{Peer, Received, RunningPeer};
use super::process::Process;

/// The configuration of one LaserScan route. The type is configured, so that all writers exist from the
/// start.
pub const SCAN: &str = "topics:\n  - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
                        max_sample_bytes: 65536}\n";
/// The keys with which ingress and the critical lane have standbys in a bed.
pub const STANDBYS: &str = "lanes: {critical: {standby: warm}}\nprocesses: {ingress: {standby: warm}}\n";
/// The keys with which they have none.
pub const NO_STANDBYS: &str = "lanes: {critical: {standby: none}}\nprocesses: {ingress: {standby: none}}\n";
/// The same as options of `up`, for a file that has other keys of these.
const NO_STANDBYS_OPTIONS: &str =
    " --parameter lanes.critical.standby:=none --parameter processes.ingress.standby:=none";
/// The DDS type of the route.
pub const SCAN_TYPE: &str = "sensor_msgs::msg::dds_::LaserScan_";
/// The DDS topic of the route's input.
pub const INPUT: &str = "rt/scan";
/// The DDS topic of the route's critical output.
pub const CRITICAL: &str = "rt/adaptive_bridge/critical/scan";
/// The DDS topic of the route's noncritical output.
pub const NONCRITICAL: &str = "rt/adaptive_bridge/noncritical/scan";

/// A running bridge and the hosts around it. The order of the fields drops processes before their hosts.
pub struct Bed {
    pub up: Process,
    pub bridge: Bridge,
    pub net: Net,
}

impl Bed {
    /// Starts a bridge with the configuration `yaml`, to which the instance name is added, without standbys
    /// unless `yaml` has them: most tests are about what a restart does. Returns `None` and records that
    /// `test` is skipped if the machine lacks the requirements.
    pub fn start(test: &str, yaml: &str) -> Option<Self> {
        Self::start_with(test, yaml, &[])
    }

    /// Like [`start`](Self::start), but `up` leaves children alone that the test stops.
    pub fn start_without_watchdog(test: &str, yaml: &str) -> Option<Self> {
        Self::start_up(test, yaml, &[], "up --no-watchdog")
    }

    /// Like [`start`](Self::start), with more hosts than the default four.
    pub fn start_with(test: &str, yaml: &str, more: &[&str]) -> Option<Self> {
        Self::start_up(test, yaml, more, "up")
    }

    fn start_up(test: &str, yaml: &str, more: &[&str], up: &str) -> Option<Self> {
        if let Some(reason) = super::testbed_missing() {
            super::skip(test, &reason);
            return None;
        }
        let net = Net::new(&[&["publisher", "bridge", "critical", "slow"], more].concat());
        let bridge = Bridge::new(&format!("instance: {{instance}}\n{yaml}"));
        let standbys = if yaml.contains("standby: warm") { "" } else { NO_STANDBYS_OPTIONS };
        let up = bridge.start_on(net.host("bridge"), &format!("{up}{standbys}"));
        let bed = Self { up, bridge, net };
        bed.wait_up();
        Some(bed)
    }

    /// Starts `up`, which has ended, without standbys, and waits until its processes are up.
    pub fn start_up_again(&mut self) {
        self.up = self.bridge.start_on(self.net.host("bridge"), &format!("up{NO_STANDBYS_OPTIONS}"));
        self.wait_up();
    }

    /// Waits until ingress and the two default lanes are up.
    pub fn wait_up(&self) {
        for role in ["ingress is up", "egress is up lane=\"critical\"", "egress is up lane=\"noncritical\""] {
            self.up.wait_for_log(role);
        }
    }

    pub fn host(&self, name: &str) -> &Host {
        self.net.host(name)
    }

    /// Starts a subscriber on a host and waits until reader and writer have matched each other. Each side
    /// discovers the other independently, and a VOLATILE reader does not receive samples written before the
    /// writer matched it.
    pub fn subscribe(&self, host: &str, peer: Peer, topic: &str) -> RunningPeer {
        let (route, lane) = self.output(topic);
        // Counts log messages instead of readers: a reader that has just ended may still be counted.
        let joined = || {
            let log = self.up.log();
            let of_output = format!("readers changed route={route} lane={lane} ");
            log.lines().filter(|line| line.contains(&of_output) && line.contains("joined=true")).count()
        };
        let before = joined();
        let subscriber = peer.subscriber().topic(topic).start_on(self.host(host));
        subscriber.wait_matched(1);
        super::wait_until("a reader matched by the bridge", || joined() > before);
        subscriber
    }

    /// The route and the lane of an output's DDS topic, as JSON strings.
    fn output(&self, topic: &str) -> (Value, Value) {
        let status = self.bridge.status();
        for route in status["routes"].as_array().into_iter().flatten() {
            for output in route["lanes"].as_array().into_iter().flatten() {
                if output["topic"].as_str().is_some_and(|name| topic == format!("rt{name}")) {
                    return (route["id"].clone(), output["lane"].clone());
                }
            }
        }
        panic!("no output {topic} in {status}")
    }

    /// Starts a publisher that publishes its first sample when ingress has matched it.
    pub fn publish(&self, peer: Peer, topic: &str) -> RunningPeer {
        peer.publisher().topic(topic).wait_match(1).start_on(self.host("publisher"))
    }

    /// Waits until every lane accounts for every sample and none waits; returns the status.
    pub fn wait_accounted(&self) -> Value {
        self.bridge.wait_status("all samples accounted for, none waiting", is_accounted_and_idle)
    }

    /// The process ids that a child of `up` (`ingress`, `egress-critical`, …) has had, oldest first.
    pub fn pids(&self, child: &str) -> Vec<i32> {
        let marker = format!("started child=\"{child}\" pid=");
        let log = self.up.log();
        log.lines()
            .filter_map(|line| line.split(&marker).nth(1)?.split_whitespace().next()?.parse().ok())
            .collect()
    }

    /// The current process id of a child of `up`.
    pub fn pid(&self, child: &str) -> i32 {
        *self.pids(child).last().unwrap_or_else(|| panic!("{child} was never started\n{}", self.up.log()))
    }

    /// The addresses at which the bridge's processes in domain 0 receive unicast discovery traffic: ports
    /// 7410, 7412 and so on (RTPS 2.5, clause 9.6.1.1).
    pub fn discovery_addresses(&self) -> Vec<SocketAddrV4> {
        let address = self.host("bridge").address();
        let is_discovery = |port: &u16| (7410..7440).contains(port) && port.is_multiple_of(2);
        let ports = udp_ports(self.pid("ingress")).into_iter().filter(is_discovery);
        let addresses: Vec<_> = ports.map(|port| SocketAddrV4::new(address, port)).collect();
        assert!(addresses.len() >= 4, "one for each process: {addresses:?}");
        addresses
    }

    /// Asserts that no standby has taken a role over: they kill only processes that are stopped or hang.
    pub fn assert_no_take_over(&self) {
        for process in self.bridge.status()["processes"].as_array().into_iter().flatten() {
            assert_eq!(process["standby"]["take_overs"], 0, "{process}\n{}", self.up.log());
        }
    }

    /// Terminates the bridge and asserts that it ends successfully.
    pub fn end(mut self) {
        let status = self.up.terminate();
        assert!(status.success(), "up ended with {status}\n{}", self.up.log());
    }
}

impl Drop for Bed {
    fn drop(&mut self) {
        if std::thread::panicking() {
            match self.bridge.try_status() {
                Ok(status) => eprintln!("--- counters of the bridge: {}\n---", status["routes"]),
                Err(error) => eprintln!("--- no status of the bridge: {error}"),
            }
        }
    }
}

/// Whether every lane accounts for every sample of every route and none waits.
pub fn is_accounted_and_idle(status: &Value) -> bool {
    let mut outputs = outputs(status).peekable();
    outputs.peek().is_some() && outputs.all(|output| output["whole"] == true && output["waiting"] == 0)
}

/// Iterates over the outputs (lanes of all routes) in a status.
pub fn outputs(status: &Value) -> impl Iterator<Item = &Value> {
    let routes = status["routes"].as_array().into_iter().flatten();
    routes.flat_map(|route| route["lanes"].as_array().into_iter().flatten())
}

/// The gaps of a subscriber from sample `first` on.
pub fn missing_from(received: &Received, first: u64) -> Vec<(u64, u64)> {
    received.missing.iter().copied().filter(|(_, last)| *last >= first).collect()
}
