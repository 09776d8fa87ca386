//! The peers of `tests/peers` and `tests/ros`: publishers and subscribers on Cyclone DDS, Fast DDS, RustDDS
//! and rclpy.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::netns::Host;
use super::process::Process;
use super::ros;

/// Why a peer can't be started: it is not built. `None` when all are.
pub fn missing() -> Option<String> {
    let peers = [Library::Cyclone, Library::Fast, Library::Rust];
    let lacking = peers.into_iter().find(|library| !library.program().exists())?;
    Some(format!("{} is not built: run `make peers`, and see what it says", lacking.program().display()))
}

/// Whose DDS the peer runs on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Library {
    /// Cyclone DDS.
    Cyclone,
    /// Fast DDS.
    Fast,
    /// RustDDS, by the bridge's own RTPS edge.
    Rust,
    /// A ROS 2 node (rclpy of Jazzy, Fast DDS 2.14). A test that has one asks [`ros::missing`] first.
    Rclpy,
}

impl Library {
    fn program(self) -> PathBuf {
        let built_by_make = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/build");
        match self {
            Library::Cyclone => built_by_make.join("cyclone_peer"),
            Library::Fast => built_by_make.join("fast_peer"),
            // An example of this package: where Cargo puts those of the profile that the bridge is built in.
            Library::Rust => {
                Path::new(env!("CARGO_BIN_EXE_adaptive-bridge")).with_file_name("examples").join("rust_peer")
            }
            Library::Rclpy => ros::python(),
        }
    }
}

/// The command line of a peer: domain 0, topic `rt/scan`, LaserScan, RELIABLE, VOLATILE, KEEP_LAST 10, 2,948
/// bytes at 100 Hz, and only a summary, unless told otherwise. `tests/peers/README.md` has all of it.
#[derive(Clone, Debug)]
#[must_use]
pub struct Peer {
    library: Library,
    role: String,
    each_sample: bool,
    says: bool,
    arguments: Vec<String>,
    environment: Vec<(String, String)>,
}

impl Peer {
    /// A peer on that library.
    pub fn on(library: Library) -> Peer {
        Peer {
            library,
            role: String::new(),
            each_sample: false,
            says: false,
            arguments: Vec::new(),
            environment: Vec::new(),
        }
    }

    /// A peer on Cyclone DDS.
    pub fn cyclone() -> Peer {
        Peer::on(Library::Cyclone)
    }

    /// A peer on Fast DDS.
    pub fn fast() -> Peer {
        Peer::on(Library::Fast)
    }

    /// A peer on RustDDS.
    pub fn rust() -> Peer {
        Peer::on(Library::Rust)
    }

    /// A ROS 2 node of that name.
    pub fn rclpy(node: &str) -> Peer {
        Peer::on(Library::Rclpy).option("--node", node)
    }

    /// It publishes.
    pub fn publisher(self) -> Peer {
        Peer { role: "pub".to_owned(), ..self }
    }

    /// It subscribes.
    pub fn subscriber(self) -> Peer {
        Peer { role: "sub".to_owned(), ..self }
    }

    /// It shows participants, endpoints and ROS 2 nodes; Cyclone DDS only. `gid_bytes` is 24 up to Humble, 16
    /// since Iron.
    pub fn graph(self, gid_bytes: usize) -> Peer {
        Peer { role: "graph".to_owned(), ..self }.option("--gid-bytes", gid_bytes)
    }

    /// It publishes `std_msgs/msg/String` by its definition, one sample for each [`RunningPeer::say`];
    /// Cyclone DDS only. It ends at [`RunningPeer::finish`], when all of it is sent.
    pub fn say(mut self) -> Peer {
        self.arguments.push("--say".to_owned());
        Peer { role: "pub".to_owned(), says: true, ..self }
    }

    /// It subscribes `std_msgs/msg/String` by its definition; Cyclone DDS only.
    pub fn decode_string(self) -> Peer {
        self.subscriber().option("--decode", "string")
    }

    /// It subscribes `diagnostic_msgs/msg/DiagnosticArray` by its definition; Cyclone DDS only.
    pub fn decode_diagnostics(self) -> Peer {
        self.subscriber().option("--decode", "diagnostics").topic("rt/diagnostics")
    }

    /// Any option of the command line, with its value; a later one wins.
    pub fn option(mut self, name: &str, value: impl ToString) -> Peer {
        self.arguments.extend([name.to_owned(), value.to_string()]);
        self
    }

    /// An environment variable, such as `CYCLONEDDS_URI`.
    pub fn env(mut self, name: &str, value: &str) -> Peer {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// DDS domain.
    pub fn domain(self, domain_id: u16) -> Peer {
        self.option("--domain", domain_id)
    }

    /// DDS topic name, such as `rt/scan`.
    pub fn topic(self, name: &str) -> Peer {
        self.option("--topic", name)
    }

    /// DDS type name, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub fn type_name(self, name: &str) -> Peer {
        self.option("--type", name)
    }

    /// RELIABILITY BEST_EFFORT.
    pub fn best_effort(self) -> Peer {
        self.option("--reliability", "be")
    }

    /// DURABILITY TRANSIENT_LOCAL.
    pub fn transient_local(self) -> Peer {
        self.option("--durability", "tl")
    }

    /// HISTORY KEEP_ALL.
    pub fn keep_all(self) -> Peer {
        self.option("--history", "all")
    }

    /// HISTORY KEEP_LAST.
    pub fn keep_last(self, depth: u32) -> Peer {
        self.option("--history", depth)
    }

    /// RESOURCE_LIMITS max_samples.
    pub fn max_samples(self, samples: u32) -> Peer {
        self.option("--max-samples", samples)
    }

    /// Samples per second; 0 is as fast as possible.
    pub fn rate_hz(self, rate_hz: f64) -> Peer {
        self.option("--rate", rate_hz)
    }

    /// A publisher ends after so many attempts, a subscriber after so many different samples.
    pub fn count(self, samples: u64) -> Peer {
        self.option("--count", samples)
    }

    /// Ends after so many seconds.
    pub fn duration_s(self, seconds: f64) -> Peer {
        self.option("--duration", seconds)
    }

    /// The sequence number of the first sample.
    pub fn first_seq(self, seq: u64) -> Peer {
        self.option("--first-seq", seq)
    }

    /// Bytes of a sample after the encapsulation header; a subscriber checks them too if told.
    pub fn size(self, bytes: usize) -> Peer {
        self.sizes(&[bytes])
    }

    /// As [`Peer::size`], one after the other in turn.
    pub fn sizes(self, bytes: &[usize]) -> Peer {
        let list: Vec<String> = bytes.iter().map(usize::to_string).collect();
        self.option("--size", list.join(","))
    }

    /// The seed of the payloads; the same on both sides.
    pub fn seed(self, seed: u64) -> Peer {
        self.option("--seed", seed)
    }

    /// The encapsulation header, as eight hexadecimal digits: kind (2 bytes) and options (2 bytes).
    pub fn encapsulation(self, header: &str) -> Peer {
        self.option("--encap", header)
    }

    /// Publishes the bytes of a file, encapsulation header not included, in place of the payload of its own.
    pub fn payload_file(self, path: &Path) -> Peer {
        self.option("--payload-file", path.display())
    }

    /// The source timestamps are so much older than the samples.
    pub fn source_age_ms(self, age_ms: u64) -> Peer {
        self.option("--source-age-ms", age_ms)
    }

    /// A publisher begins when so many subscribers have matched.
    pub fn wait_match(self, subscribers: usize) -> Peer {
        self.option("--wait-match", subscribers)
    }

    /// A publisher begins at [`RunningPeer::go`]. That the writer knows the reader does not mean that the
    /// reader knows the writer yet, and a VOLATILE reader gets nothing from before.
    pub fn hold(mut self) -> Peer {
        self.arguments.push("--hold".to_owned());
        self
    }

    /// A publisher first sends a sample that does not count and waits for its acknowledgement: a VOLATILE
    /// reader of Cyclone DDS loses samples that are on their way when it sees the writer's first heartbeat.
    pub fn prime(mut self) -> Peer {
        self.arguments.push("--prime".to_owned());
        self
    }

    /// The period of a RELIABLE writer's heartbeats in Fast DDS; its default is 3 s.
    pub fn heartbeat_ms(self, period_ms: u64) -> Peer {
        self.option("--heartbeat-ms", period_ms)
    }

    /// A publisher stays for so many seconds after its last sample was acknowledged.
    pub fn linger_s(self, seconds: f64) -> Peer {
        self.option("--linger", seconds)
    }

    /// A subscriber does not read for `for_s` seconds after each `every_s` seconds.
    pub fn stall(self, every_s: f64, for_s: f64) -> Peer {
        self.option("--stall-every", every_s).option("--stall-for", for_s)
    }

    /// Fast DDS: with its shared-memory transport and data sharing too.
    pub fn shared_memory(mut self) -> Peer {
        self.arguments.push("--shm".to_owned());
        self
    }

    /// Uses the interface with that address only.
    pub fn interface(self, address: std::net::Ipv4Addr) -> Peer {
        self.option("--interface", address)
    }

    /// An event for each sample, too.
    pub fn each_sample(self) -> Peer {
        Peer { each_sample: true, ..self }
    }

    /// Payloads that are not a peer's: neither sequence nor check.
    pub fn opaque(mut self) -> Peer {
        self.arguments.push("--opaque".to_owned());
        self
    }

    /// Starts it on a host, and waits until its endpoints are there.
    pub fn start_on(self, host: &Host) -> RunningPeer {
        let command = host.command(self.library.program());
        self.start_as(&format!(" on {}", host.name()), command)
    }

    /// Starts it on this machine, and waits until its endpoints are there.
    pub fn start(self) -> RunningPeer {
        let command = Command::new(self.library.program());
        self.start_as("", command)
    }

    fn start_as(self, place: &str, mut command: Command) -> RunningPeer {
        if self.library == Library::Rclpy {
            command.arg(ros::node_program());
        }
        command.args(["--role", &self.role]).args(&self.arguments).envs(self.environment);
        if !self.each_sample {
            command.arg("--summary");
        }
        let name = format!("{:?} {}{place}", self.library, self.role);
        let spawn = if self.says { Process::spawn_fed } else { Process::spawn };
        let peer = RunningPeer { process: spawn(&name, command) };
        peer.wait_for("ready", |event| event["event"] == "ready");
        peer
    }
}

/// A peer that was started; also a [`Process`].
pub struct RunningPeer {
    process: Process,
}

impl Deref for RunningPeer {
    type Target = Process;

    fn deref(&self) -> &Process {
        &self.process
    }
}

impl DerefMut for RunningPeer {
    fn deref_mut(&mut self) -> &mut Process {
        &mut self.process
    }
}

fn event_of(line: &str) -> Value {
    serde_json::from_str(line).unwrap_or(Value::Null)
}

/// What a `decoded` event carries.
fn message_of(event: &mut Value) -> Option<Value> {
    (event["event"] == "decoded").then(|| event["message"].take())
}

impl RunningPeer {
    /// All events so far.
    pub fn events(&self) -> Vec<Value> {
        self.process.stdout_lines().iter().map(|line| event_of(line)).collect()
    }

    /// Waits for an event, among those so far and those to come.
    pub fn wait_for(&self, what: &str, mut found: impl FnMut(&Value) -> bool) -> Value {
        let find = |line: &str| Some(event_of(line)).filter(|event| found(event));
        self.process.wait_for_line(what, 0, find).0
    }

    /// The number of endpoints that match it now.
    pub fn matched(&self) -> u64 {
        let last = self.events().into_iter().rev().find(|event| event["event"] == "matched");
        last.and_then(|event| event["current"].as_u64()).unwrap_or(0)
    }

    /// Waits until so many endpoints match it.
    pub fn wait_matched(&self, endpoints: u64) {
        super::wait_until(format!("{endpoints} matched endpoints"), || self.matched() == endpoints);
    }

    /// Publishes a line, which has no line break in it and need not be UTF-8; see [`Peer::say`].
    pub fn say(&mut self, line: impl AsRef<[u8]>) {
        self.process.feed(&[line.as_ref(), b"\n"].concat());
    }

    /// What a peer of [`Peer::decode_string`] or [`Peer::decode_diagnostics`] has decoded so far, oldest
    /// first: the fields by the names of the definition. What is not to be decoded is in its log.
    pub fn decoded(&self) -> Vec<Value> {
        self.events().iter_mut().filter_map(message_of).collect()
    }

    /// Waits for a decoded message, among those so far and those to come.
    pub fn wait_decoded(&self, what: &str, mut found: impl FnMut(&Value) -> bool) -> Value {
        let find = |line: &str| message_of(&mut event_of(line)).filter(|message| found(message));
        self.process.wait_for_line(what, 0, find).0
    }

    /// Lets a publisher begin that was held back by [`Peer::hold`].
    pub fn go(&self) {
        self.process.signal(Signal::SIGUSR1);
    }

    /// What a subscriber has received so far, without duplicates; up to 100 ms late.
    pub fn received(&self) -> u64 {
        let mut after = 0;
        // From the end: there are thousands of events after some minutes.
        for line in self.process.stdout_lines().iter().rev() {
            let event = event_of(line);
            if event["event"] == "sample" {
                after += 1;
            } else if let Some(received) = event["received"].as_u64() {
                return received + after;
            }
        }
        after
    }

    /// Waits until a subscriber has received so many samples.
    pub fn wait_received(&self, samples: u64) {
        super::wait_until(Lacking { peer: self, samples }, || self.received() >= samples);
    }

    /// Waits until a publisher has sent all, and until all of it is acknowledged or 10 s have passed; yields
    /// whether it was.
    pub fn wait_sent(&self) -> bool {
        self.wait_for("all sent", |event| event["event"] == "sent")["acknowledged"] == true
    }

    /// Waits until it ends by itself; yields its summary.
    pub fn finish<S: DeserializeOwned>(mut self) -> S {
        let status = self.process.wait();
        assert!(status.success(), "the peer ended with {status}");
        self.summary()
    }

    /// Ends it (SIGTERM); yields its summary.
    pub fn end<S: DeserializeOwned>(mut self) -> S {
        self.process.terminate();
        self.finish()
    }

    fn summary<S: DeserializeOwned>(&self) -> S {
        let event = self.wait_for("the summary", |event| event["event"] == "summary");
        serde_json::from_value(event.clone()).unwrap_or_else(|error| panic!("{error} in {event}"))
    }
}

/// What a subscriber was to receive, and which of it has come; said where it does not come.
struct Lacking<'a> {
    peer: &'a RunningPeer,
    samples: u64,
}

impl Display for Lacking<'_> {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        let Self { peer, samples } = self;
        write!(formatter, "{samples} samples received, {} so far", peer.received())?;
        let events = peer.events();
        let received: BTreeSet<u64> = events
            .iter()
            .filter(|event| event["event"] == "sample")
            .filter_map(|event| event["seq"].as_u64())
            .collect();
        // With --summary no sample is listed.
        if !received.is_empty() {
            let missing: Vec<u64> = (0..*samples).filter(|sequence| !received.contains(sequence)).collect();
            write!(formatter, ", without {missing:?}")?;
        }
        Ok(())
    }
}

/// What a peer of [`Peer::say`] did.
#[derive(Clone, Debug, Deserialize)]
pub struct Said {
    /// Lines that it was given.
    pub attempted: u64,
    /// Those that were written.
    pub ok: u64,
    /// Those that were not.
    pub failed: u64,
    /// Whether all RELIABLE readers have acknowledged everything.
    pub acknowledged: bool,
}

/// What a publisher did.
#[derive(Clone, Debug, Deserialize)]
pub struct Sent {
    /// Calls of write.
    pub attempted: u64,
    /// Those that succeeded.
    pub ok: u64,
    /// Those that failed.
    pub failed: u64,
    /// The sequence number of the first sample.
    pub first: u64,
    /// The sequence number of the last sample.
    pub last: u64,
    /// Periods in which nothing was sent, as the call before took too long.
    pub skipped_ticks: u64,
    /// How long write took.
    pub call_us: Option<Distribution>,
    /// Successful writes per second.
    pub rate_hz: f64,
    /// From the first call to the last.
    pub elapsed_s: f64,
    /// Whether all RELIABLE readers have acknowledged everything.
    pub acknowledged: bool,
    /// Of all samples that were written; equals [`Received::hash`] if the same were received. Empty from a
    /// ROS 2 node.
    pub hash: String,
}

/// What a subscriber saw.
#[derive(Clone, Debug, Deserialize)]
pub struct Received {
    /// Samples, without duplicates.
    pub received: u64,
    /// Those of them that are too short for a sequence number (less than 8 bytes).
    pub unnumbered: u64,
    /// The lowest sequence number.
    pub first: Option<u64>,
    /// The highest sequence number.
    pub last: Option<u64>,
    /// Ranges of sequence numbers between them that did not come, ends included; 1000 at most.
    pub missing: Vec<(u64, u64)>,
    /// How many numbers these are, without a limit.
    pub missing_count: u64,
    /// Samples that came again.
    pub duplicates: u64,
    /// Samples that came after a later one.
    pub out_of_order: u64,
    /// Samples of the wrong size or with wrong bytes.
    pub bad: u64,
    /// Samples with up to three zeros of padding at the end, as RTPS allows.
    pub padded: u64,
    /// Bytes after the encapsulation headers.
    pub bytes: u64,
    /// Of the smallest sample.
    pub size_min: u64,
    /// Of the largest sample.
    pub size_max: u64,
    /// How many samples had which encapsulation header.
    pub headers: BTreeMap<String, u64>,
    /// Samples whose source timestamp is the publisher's to 10 ns.
    pub source_timestamps_kept: u64,
    /// The others (of 24 bytes or more).
    pub source_timestamps_changed: u64,
    /// From before write to after take, on one machine.
    pub latency_us: Option<Distribution>,
    /// The longest time between two samples.
    pub max_gap_ms: f64,
    /// Of all samples received; see [`Sent::hash`].
    pub hash: String,
}

impl Received {
    /// Asserts that exactly what was sent has come: each byte of it, once, in order.
    pub fn assert_all_of(&self, sent: &Sent) {
        assert_eq!(self.received, sent.ok, "number of samples\n{sent:?}\n{self:?}");
        self.assert_sound();
        // A ROS 2 node has no hash; a subscriber compares each payload with the expected one in any case.
        if !self.hash.is_empty() && !sent.hash.is_empty() {
            assert_eq!(self.hash, sent.hash, "hash of the payloads\n{sent:?}\n{self:?}");
        }
    }

    /// Asserts that what has come is whole, came once and in order; some may be missing.
    pub fn assert_sound(&self) {
        assert_eq!(self.bad, 0, "samples with wrong bytes\n{self:?}");
        assert_eq!(self.duplicates, 0, "duplicates\n{self:?}");
        assert_eq!(self.out_of_order, 0, "samples out of order\n{self:?}");
    }
}

/// Microseconds.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Distribution {
    pub min: f64,
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
    pub max: f64,
}

/// What a peer of role graph knows now.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// By GUID, in hexadecimal.
    pub endpoints: BTreeMap<String, Endpoint>,
    /// The nodes of each participant that has a graph entry, by its identifier, in hexadecimal.
    pub nodes: BTreeMap<String, Vec<Node>>,
}

/// A reader or writer, as discovery describes it.
#[derive(Clone, Debug, Deserialize)]
pub struct Endpoint {
    /// `reader` or `writer`.
    pub kind: String,
    pub guid: String,
    pub participant: String,
    pub topic: String,
    #[serde(rename = "type")]
    pub type_name: String,
    /// `reliability`, `durability`, … by the names of the DDS specification; `user_data`.
    pub qos: Value,
}

/// A ROS 2 node, as `ros_discovery_info` describes it.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
pub struct Node {
    pub namespace: String,
    pub name: String,
    pub reader_gids: Vec<String>,
    pub writer_gids: Vec<String>,
}

impl RunningPeer {
    /// What a peer of role graph knows now. An entry that can't be decoded is a panic.
    pub fn graph(&self) -> Graph {
        let mut graph = Graph::default();
        for event in self.events() {
            let text = |key: &str| event[key].as_str().unwrap_or_default().to_owned();
            match event["event"].as_str().unwrap_or_default() {
                "endpoint" => {
                    let endpoint: Endpoint = serde_json::from_value(event).unwrap();
                    graph.endpoints.insert(endpoint.guid.clone(), endpoint);
                }
                "endpoint_gone" => {
                    graph.endpoints.remove(&text("guid"));
                }
                "participant_entities" => {
                    let nodes = serde_json::from_value(event["nodes"].clone()).unwrap();
                    graph.nodes.insert(text("gid"), nodes);
                }
                "bad_participant_entities" => panic!("a graph entry that can't be decoded: {event}"),
                _ => {}
            }
        }
        graph
    }
}
