//! A bridge on a host of its own, between a host with the publisher and hosts with the subscribers.

use serde_json::Value;

use super::bridge::Bridge;
use super::netns::{Host, Net};
use super::peer::{Peer, Received, RunningPeer};
use super::process::Process;

/// The configuration of one LaserScan route, whose type is given, so that every writer is there from the
/// start.
pub const SCAN: &str = "topics:\n  - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
                        max_sample_bytes: 65536}\n";
/// The DDS type of it.
pub const SCAN_TYPE: &str = "sensor_msgs::msg::dds_::LaserScan_";
/// Its DDS topics.
pub const INPUT: &str = "rt/scan";
pub const CRITICAL: &str = "rt/adaptive_bridge/critical/scan";
pub const NONCRITICAL: &str = "rt/adaptive_bridge/noncritical/scan";

/// A running bridge and the hosts around it. Fields are dropped in this order: processes before their hosts.
pub struct Bed {
    pub up: Process,
    pub bridge: Bridge,
    pub net: Net,
}

impl Bed {
    /// Starts a bridge with this configuration, but for its instance name; records that `test` is skipped
    /// where the machine can't.
    pub fn start(test: &str, yaml: &str) -> Option<Self> {
        Self::start_with(test, yaml, &[])
    }

    /// As [`start`](Self::start), with more hosts beside the four.
    pub fn start_with(test: &str, yaml: &str, more: &[&str]) -> Option<Self> {
        if let Some(reason) = super::testbed_missing() {
            super::skip(test, &reason);
            return None;
        }
        let net = Net::new(&[&["publisher", "bridge", "critical", "slow"], more].concat());
        let bridge = Bridge::new(&format!("instance: {{instance}}\n{yaml}"));
        let up = bridge.start_on(net.host("bridge"), "up");
        let bed = Self { up, bridge, net };
        bed.wait_up();
        Some(bed)
    }

    /// Waits until ingress and the two fixed lanes are up.
    pub fn wait_up(&self) {
        for role in ["ingress is up", "egress is up lane=\"critical\"", "egress is up lane=\"noncritical\""] {
            self.up.wait_for_log(role);
        }
    }

    pub fn host(&self, name: &str) -> &Host {
        self.net.host(name)
    }

    /// A subscriber on a host, matched on both sides: each end learns of the other by itself, and what is
    /// written before the writer knows of a reader is not for that reader.
    pub fn subscribe(&self, host: &str, peer: Peer, topic: &str) -> RunningPeer {
        let (route, lane) = self.output(topic);
        // Not by the number of readers: one that has just ended may still be counted.
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

    /// Route and lane of a DDS topic of the bridge, in quotes.
    fn output(&self, topic: &str) -> (Value, Value) {
        let status = self.bridge.status();
        for route in status["routes"].as_array().into_iter().flatten() {
            for output in route["lanes"].as_array().into_iter().flatten() {
                if output["topic"].as_str().is_some_and(|name| topic == format!("rt{name}")) {
                    return (route["id"].clone(), output["lane"].clone());
                }
            }
        }
        panic!("{topic} in {status}")
    }

    /// A publisher that begins when ingress reads it.
    pub fn publish(&self, peer: Peer, topic: &str) -> RunningPeer {
        peer.publisher().topic(topic).wait_match(1).start_on(self.host("publisher"))
    }

    /// Waits until each lane accounts for each sample, and none waits; yields the status.
    pub fn wait_whole(&self) -> Value {
        if self.bridge.try_status().is_err() {
            return Value::Null;
        }
        self.bridge.wait_status("every lane whole and quiet", is_whole_and_quiet)
    }

    /// The process ids of a child of `up`, oldest first: `ingress`, `egress-critical`, …
    pub fn pids(&self, child: &str) -> Vec<i32> {
        let mark = format!("started child=\"{child}\" pid=");
        let log = self.up.log();
        log.lines()
            .filter_map(|line| line.split(&mark).nth(1)?.split_whitespace().next()?.parse().ok())
            .collect()
    }

    /// The process id of the present child of that name.
    pub fn pid(&self, child: &str) -> i32 {
        *self.pids(child).last().unwrap_or_else(|| panic!("{child} was never started\n{}", self.up.log()))
    }

    /// Asks the bridge to end, and checks that it does so as it should.
    pub fn end(mut self) {
        let status = self.up.terminate();
        assert!(status.success(), "up ended with {status}\n{}", self.up.log());
    }
}

impl Drop for Bed {
    fn drop(&mut self) {
        if std::thread::panicking() {
            match self.bridge.try_status() {
                Ok(status) => eprintln!("--- what the bridge counted: {}\n---", status["routes"]),
                Err(error) => eprintln!("--- no status of the bridge: {error}"),
            }
        }
    }
}

/// Whether every lane accounts for every sample of every route, and none waits.
pub fn is_whole_and_quiet(status: &Value) -> bool {
    let mut outputs = outputs(status).peekable();
    outputs.peek().is_some() && outputs.all(|output| output["whole"] == true && output["waiting"] == 0)
}

/// Each lane of each route in a status.
pub fn outputs(status: &Value) -> impl Iterator<Item = &Value> {
    let routes = status["routes"].as_array().into_iter().flatten();
    routes.flat_map(|route| route["lanes"].as_array().into_iter().flatten())
}

/// What a subscriber missed from sample `first` on.
pub fn missing_from(received: &Received, first: u64) -> Vec<(u64, u64)> {
    received.missing.iter().copied().filter(|(_, last)| *last >= first).collect()
}
