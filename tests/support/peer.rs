//! Starts the peers of `tests/peers` and `tests/ros`: publishers and subscribers on Cyclone DDS, Fast DDS,
//! RustDDS and rclpy.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::netns::Host;
use super::process::Process;
use super::ros::{self, Release};

/// Returns which peer is not built; `None` if all are built.
pub fn missing() -> Option<String> {
    let peers = [Library::Cyclone, Library::Fast, Library::Rust];
    let lacking = peers.into_iter().find(|library| !library.program().exists())?;
    Some(format!("{} is not built: run `make peers` and read its output", lacking.program().display()))
}

/// The library that a peer runs on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Library {
    /// Cyclone DDS.
    Cyclone,
    /// Fast DDS.
    Fast,
    /// RustDDS, through the bridge's own DDS module.
    Rust,
    /// A ROS 2 node (rclpy of Jazzy, Fast DDS 2.14). A test with such a node first calls [`ros::missing`].
    Rclpy,
    /// A node of the next release (rclpy of Kilted, Fast DDS 3.2).
    Kilted,
}

impl Library {
    fn program(self) -> PathBuf {
        let built_by_make = super::root().join("tests/peers/build");
        match self {
            Library::Cyclone => built_by_make.join("cyclone_peer"),
            Library::Fast => built_by_make.join("fast_peer"),
            // An example of the root package, in the same build profile as the bridge.
            Library::Rust => super::bridge::program().with_file_name("examples").join("rust_peer"),
            Library::Rclpy => Release::Jazzy.python(),
            Library::Kilted => Release::Kilted.python(),
        }
    }
}

/// The command line of a peer. Defaults: domain 0, topic `rt/scan`, LaserScan, RELIABLE, VOLATILE, KEEP_LAST
/// 10, 2,948 bytes at 100 Hz, and only a summary. `tests/peers/README.md` describes all options.
#[derive(Clone, Debug)]
#[must_use]
pub struct Peer {
    library: Library,
    role: String,
    each_sample: bool,
    reads_stdin: bool,
    arguments: Vec<String>,
    environment: Vec<(String, String)>,
}

impl Peer {
    /// A peer on a given library.
    pub fn on(library: Library) -> Peer {
        Peer {
            library,
            role: String::new(),
            each_sample: false,
            reads_stdin: false,
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

    /// A ROS 2 node with a given name.
    pub fn rclpy(node: &str) -> Peer {
        Peer::on(Library::Rclpy).option("--node", node)
    }

    /// The same node on the release after that.
    pub fn on_kilted(self) -> Peer {
        Peer { library: Library::Kilted, ..self }
    }

    /// Makes the peer a publisher.
    pub fn publisher(self) -> Peer {
        Peer { role: "pub".to_owned(), ..self }
    }

    /// Makes the peer a subscriber.
    pub fn subscriber(self) -> Peer {
        Peer { role: "sub".to_owned(), ..self }
    }

    /// Makes the peer report participants, endpoints and ROS 2 nodes; Cyclone DDS only. `gid_bytes` is 24 up
    /// to Humble, 16 since Iron.
    pub fn graph(self, gid_bytes: usize) -> Peer {
        Peer { role: "graph".to_owned(), ..self }.option("--gid-bytes", gid_bytes)
    }

    /// Makes a ROS 2 node report the endpoints of these topics, which are DDS names, and all nodes.
    pub fn info(topics: &[&str]) -> Peer {
        Peer { role: "info".to_owned(), ..Peer::rclpy("info") }.topic(&topics.join(","))
    }

    /// Makes a ROS 2 node call parameter services, once for each [`RunningPeer::say`] of a call in JSON.
    pub fn parameters(node: &str) -> Peer {
        Peer { role: "parameters".to_owned(), reads_stdin: true, ..Peer::rclpy(node) }
    }

    /// Makes the peer call the service of this name as rmw_cyclonedds does, once for each
    /// [`RunningPeer::say`] of a request in CDR, in hexadecimal; Cyclone DDS only. The name is without the
    /// slash at its beginning, the type that of DDS without `_Request_`.
    pub fn client(service: &str, type_name: &str) -> Peer {
        let peer = Peer { role: "client".to_owned(), reads_stdin: true, ..Peer::cyclone() };
        peer.topic(service).type_name(type_name)
    }

    /// Makes the peer a publisher of `std_msgs/msg/String` with the generated type, one sample for each
    /// [`RunningPeer::say`]; Cyclone DDS only. It ends at [`RunningPeer::finish`], after sending all samples.
    pub fn say(mut self) -> Peer {
        self.arguments.push("--say".to_owned());
        Peer { role: "pub".to_owned(), reads_stdin: true, ..self }
    }

    /// Makes the peer a subscriber of `std_msgs/msg/String` with the generated type; Cyclone DDS only.
    pub fn decode_string(self) -> Peer {
        self.subscriber().option("--decode", "string")
    }

    /// Makes the peer a subscriber of `diagnostic_msgs/msg/DiagnosticArray` with the generated type; Cyclone
    /// DDS only.
    pub fn decode_diagnostics(self) -> Peer {
        self.subscriber().option("--decode", "diagnostics").topic("rt/diagnostics")
    }

    /// Adds an option of the command line with its value; a later one overrides an earlier one.
    pub fn option(mut self, name: &str, value: impl ToString) -> Peer {
        self.arguments.extend([name.to_owned(), value.to_string()]);
        self
    }

    /// Sets an environment variable, such as `CYCLONEDDS_URI`.
    pub fn env(mut self, name: &str, value: &str) -> Peer {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Gives a node on rclpy socket buffers as large as those of the other peers.
    pub fn large_socket_buffers(self) -> Peer {
        let profile = super::root().join("tests/ros/large_buffers.xml");
        self.env("FASTRTPS_DEFAULT_PROFILES_FILE", profile.to_str().unwrap())
    }

    /// Sets the DDS domain.
    pub fn domain(self, domain_id: u16) -> Peer {
        self.option("--domain", domain_id)
    }

    /// Sets the DDS topic name, such as `rt/scan`.
    pub fn topic(self, name: &str) -> Peer {
        self.option("--topic", name)
    }

    /// Sets the DDS type name, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub fn type_name(self, name: &str) -> Peer {
        self.option("--type", name)
    }

    /// Sets RELIABILITY to BEST_EFFORT.
    pub fn best_effort(self) -> Peer {
        self.option("--reliability", "be")
    }

    /// Sets DURABILITY to TRANSIENT_LOCAL.
    pub fn transient_local(self) -> Peer {
        self.option("--durability", "tl")
    }

    /// Sets HISTORY to KEEP_ALL.
    pub fn keep_all(self) -> Peer {
        self.option("--history", "all")
    }

    /// Sets HISTORY to KEEP_LAST.
    pub fn keep_last(self, depth: u32) -> Peer {
        self.option("--history", depth)
    }

    /// Sets `max_samples` of RESOURCE_LIMITS.
    pub fn max_samples(self, samples: u32) -> Peer {
        self.option("--max-samples", samples)
    }

    /// How long a write waits for room in the history, 0.1 s by default.
    pub fn max_blocking_s(self, seconds: u32) -> Peer {
        self.option("--max-blocking-ms", 1_000 * seconds)
    }

    /// Sets the samples per second; 0 is as fast as possible.
    pub fn rate_hz(self, rate_hz: f64) -> Peer {
        self.option("--rate", rate_hz)
    }

    /// Sets the number of write calls after which a publisher ends, or of different samples after which a
    /// subscriber ends.
    pub fn count(self, samples: u64) -> Peer {
        self.option("--count", samples)
    }

    /// Sets the time after which the peer ends.
    pub fn duration_s(self, seconds: f64) -> Peer {
        self.option("--duration", seconds)
    }

    /// Sets the sequence number of the first sample.
    pub fn first_seq(self, seq: u64) -> Peer {
        self.option("--first-seq", seq)
    }

    /// Gives the type so many keys, which the samples have in turn. After the last sample, a publisher
    /// disposes key 1 and unregisters key 2. Fast DDS and Cyclone DDS only.
    pub fn keys(self, keys: u32) -> Peer {
        self.option("--keys", keys)
    }

    /// Sets the bytes of a sample after the encapsulation header. A subscriber with this option checks the
    /// size and the bytes.
    pub fn size(self, bytes: usize) -> Peer {
        self.sizes(&[bytes])
    }

    /// Like [`Peer::size`], with several sizes in turn.
    pub fn sizes(self, bytes: &[usize]) -> Peer {
        let list: Vec<String> = bytes.iter().map(usize::to_string).collect();
        self.option("--size", list.join(","))
    }

    /// Sets the seed of the payloads, which must be the same on both sides.
    pub fn seed(self, seed: u64) -> Peer {
        self.option("--seed", seed)
    }

    /// Sets the encapsulation header, as eight hexadecimal digits: kind (2 bytes) and options (2 bytes).
    pub fn encapsulation(self, header: &str) -> Peer {
        self.option("--encap", header)
    }

    /// Publishes the content of a file, without encapsulation header, instead of a generated payload.
    pub fn payload_file(self, path: &Path) -> Peer {
        self.option("--payload-file", path.display())
    }

    /// Makes the source timestamps so much older than the time of writing.
    pub fn source_age_ms(self, age_ms: u64) -> Peer {
        self.option("--source-age-ms", age_ms)
    }

    /// Makes a publisher wait until so many subscribers have matched.
    pub fn wait_match(self, subscribers: usize) -> Peer {
        self.option("--wait-match", subscribers)
    }

    /// Makes a publisher wait for [`RunningPeer::go`]. A writer that has matched a reader may not have been
    /// matched by that reader yet, and a VOLATILE reader does not receive earlier samples.
    pub fn hold(mut self) -> Peer {
        self.arguments.push("--hold".to_owned());
        self
    }

    /// Makes a publisher first send a sample that does not count and wait for its acknowledgement: a VOLATILE
    /// reader of Cyclone DDS loses samples that are in flight when it receives the writer's first heartbeat.
    pub fn prime(mut self) -> Peer {
        self.arguments.push("--prime".to_owned());
        self
    }

    /// Sets the period of a RELIABLE writer's heartbeats in Fast DDS; the default is 3 s.
    pub fn heartbeat_ms(self, period_ms: u64) -> Peer {
        self.option("--heartbeat-ms", period_ms)
    }

    /// Keeps a publisher alive for so many seconds after its last sample was acknowledged.
    pub fn linger_s(self, seconds: f64) -> Peer {
        self.option("--linger", seconds)
    }

    /// Makes a subscriber stop reading for `for_s` seconds after each `every_s` seconds.
    pub fn stall(self, every_s: f64, for_s: f64) -> Peer {
        self.option("--stall-every", every_s).option("--stall-for", for_s)
    }

    /// Enables the shared-memory transport and data sharing of Fast DDS.
    pub fn shared_memory(mut self) -> Peer {
        self.arguments.push("--shm".to_owned());
        self
    }

    /// Restricts the peer to the interface with a given address.
    pub fn interface(self, address: std::net::Ipv4Addr) -> Peer {
        self.option("--interface", address)
    }

    /// Reports each sample, in addition to the summary.
    pub fn each_sample(self) -> Peer {
        Peer { each_sample: true, ..self }
    }

    /// Sends and expects payloads of zeros with the sequence number at both ends, which cost the peer little.
    pub fn plain(mut self) -> Peer {
        self.arguments.push("--plain".to_owned());
        self
    }

    /// Treats payloads as opaque: without sequence numbers and without a check of their bytes.
    pub fn opaque(mut self) -> Peer {
        self.arguments.push("--opaque".to_owned());
        self
    }

    /// Starts the peer on a host and waits until its endpoints exist.
    pub fn start_on(self, host: &Host) -> RunningPeer {
        let command = host.command(self.library.program());
        self.start_as(&format!(" on {}", host.name()), command)
    }

    /// Starts the peer on this machine and waits until its endpoints exist.
    pub fn start(self) -> RunningPeer {
        let command = Command::new(self.library.program());
        self.start_as("", command)
    }

    fn start_as(self, place: &str, mut command: Command) -> RunningPeer {
        if matches!(self.library, Library::Rclpy | Library::Kilted) {
            command.arg(ros::node_program());
        }
        command.args(["--role", &self.role]).args(&self.arguments).envs(self.environment);
        if !self.each_sample {
            command.arg("--summary");
        }
        let name = format!("{:?} {}{place}", self.library, self.role);
        let spawn = if self.reads_stdin { Process::spawn_with_stdin } else { Process::spawn };
        let peer = RunningPeer { process: spawn(&name, command) };
        peer.wait_for("ready", |event| event["event"] == "ready");
        peer
    }
}

/// A running peer; dereferences to its [`Process`].
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

/// The message of a `decoded` event.
fn message_of(event: &mut Value) -> Option<Value> {
    (event["event"] == "decoded").then(|| event["message"].take())
}

impl RunningPeer {
    /// All events so far.
    pub fn events(&self) -> Vec<Value> {
        self.process.stdout_lines().iter().map(|line| event_of(line)).collect()
    }

    /// Waits for an event; past events count too.
    pub fn wait_for(&self, what: &str, mut found: impl FnMut(&Value) -> bool) -> Value {
        let find = |line: &str| Some(event_of(line)).filter(|event| found(event));
        self.process.wait_for_line(what, 0, find).0
    }

    /// The number of endpoints that currently match the peer's.
    pub fn matched(&self) -> u64 {
        let last = self.events().into_iter().rev().find(|event| event["event"] == "matched");
        last.and_then(|event| event["current"].as_u64()).unwrap_or(0)
    }

    /// How often an endpoint has been matched, and unmatched.
    pub fn matches(&self) -> (usize, usize) {
        let events = self.events().into_iter().filter(|event| event["event"] == "matched");
        let changes: Vec<i64> = events.filter_map(|event| event["change"].as_i64()).collect();
        let count = |is_one: fn(&i64) -> bool| changes.iter().filter(|change| is_one(change)).count();
        (count(|change| *change > 0), count(|change| *change < 0))
    }

    /// Waits until so many endpoints match the peer's.
    pub fn wait_matched(&self, endpoints: u64) {
        super::wait_until(format!("{endpoints} matched endpoints"), || self.matched() == endpoints);
    }

    /// Publishes one line; it must not contain a line break and need not be UTF-8. See [`Peer::say`].
    pub fn say(&mut self, line: impl AsRef<[u8]>) {
        self.process.write_stdin(&[line.as_ref(), b"\n"].concat());
    }

    /// The messages that a peer of [`Peer::decode_string`] or [`Peer::decode_diagnostics`] has decoded so
    /// far, oldest first, as objects with the fields of the message definition. The peer logs messages that
    /// it cannot decode.
    pub fn decoded(&self) -> Vec<Value> {
        self.events().iter_mut().filter_map(message_of).collect()
    }

    /// Waits for a decoded message; past messages count too.
    pub fn wait_decoded(&self, what: &str, mut found: impl FnMut(&Value) -> bool) -> Value {
        let find = |line: &str| message_of(&mut event_of(line)).filter(|message| found(message));
        self.process.wait_for_line(what, 0, find).0
    }

    /// Starts a publisher that waits because of [`Peer::hold`].
    pub fn go(&self) {
        self.process.signal(Signal::SIGUSR1);
    }

    /// The number of samples that a subscriber has received, without duplicates, up to 100 ms ago.
    pub fn received(&self) -> u64 {
        let mut after = 0;
        // Searches from the end: there are thousands of events after some minutes.
        let before = self.process.find_last_line(|line| {
            let event = event_of(line);
            after += u64::from(event["event"] == "sample");
            event["received"].as_u64()
        });
        before.unwrap_or(0) + after
    }

    /// The number of samples that a publisher has written, up to 100 ms ago.
    pub fn written(&self) -> u64 {
        self.process.find_last_line(|line| event_of(line)["attempted"].as_u64()).unwrap_or(0)
    }

    /// Waits until a subscriber has received so many samples.
    pub fn wait_received(&self, samples: u64) {
        super::wait_until(MissingSamples { peer: self, samples }, || self.received() >= samples);
    }

    /// Waits until a publisher has sent all samples, and until all are acknowledged or 10 s have passed;
    /// returns whether all are acknowledged.
    pub fn wait_sent(&self) -> bool {
        self.wait_for("all sent", |event| event["event"] == "sent")["acknowledged"] == true
    }

    /// Waits until the peer ends by itself; returns its summary.
    pub fn finish<S: DeserializeOwned>(mut self) -> S {
        let status = self.process.wait();
        assert!(status.success(), "the peer ended with {status}");
        self.summary()
    }

    /// Terminates the peer (SIGTERM); returns its summary.
    pub fn end<S: DeserializeOwned>(mut self) -> S {
        self.process.terminate();
        self.finish()
    }

    fn summary<S: DeserializeOwned>(&self) -> S {
        let event = self.wait_for("the summary", |event| event["event"] == "summary");
        serde_json::from_value(event.clone()).unwrap_or_else(|error| panic!("{error} in {event}"))
    }
}

/// Formats which samples a subscriber has not received, for the panic message of a timeout.
struct MissingSamples<'a> {
    peer: &'a RunningPeer,
    samples: u64,
}

impl Display for MissingSamples<'_> {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        let Self { peer, samples } = self;
        write!(formatter, "{samples} samples at {}, {} so far", peer.process.name(), peer.received())?;
        let events = peer.events();
        let received: BTreeSet<u64> = events
            .iter()
            .filter(|event| event["event"] == "sample")
            .filter_map(|event| event["seq"].as_u64())
            .collect();
        // With --summary no sample is listed before the peer ends.
        if !received.is_empty() {
            let missing: Vec<u64> = (0..*samples).filter(|sequence| !received.contains(sequence)).collect();
            write!(formatter, ", without {missing:?}")?;
        } else {
            // It may have ended already.
            let _ = nix::sys::signal::kill(peer.process.pid(), Signal::SIGTERM);
            let summary = (0..100).find_map(|_| {
                std::thread::sleep(Duration::from_millis(100));
                peer.events().into_iter().find(|event| event["event"] == "summary")
            });
            let summary = summary.unwrap_or_default();
            write!(formatter, ", from {} to {}", summary["first"], summary["last"])?;
            write!(formatter, ", without {}", summary["missing"])?;
        }
        Ok(())
    }
}

/// The summary of a peer of [`Peer::say`].
#[derive(Clone, Debug, Deserialize)]
pub struct LinesSent {
    /// Lines read from stdin.
    pub attempted: u64,
    /// Lines that were published.
    pub ok: u64,
    /// Lines that could not be published.
    pub failed: u64,
    /// Whether all RELIABLE readers have acknowledged all samples.
    pub acknowledged: bool,
}

/// The summary of a publisher.
#[derive(Clone, Debug, Deserialize)]
pub struct Sent {
    /// Calls of `write`.
    pub attempted: u64,
    /// Calls that succeeded.
    pub ok: u64,
    /// Calls that failed.
    pub failed: u64,
    /// The sequence number of the first sample.
    pub first: u64,
    /// The sequence number of the last sample.
    pub last: u64,
    /// Periods in which nothing was sent because the previous call took too long.
    pub skipped_ticks: u64,
    /// The duration of the calls.
    pub call_us: Option<Distribution>,
    /// Successful writes per second.
    pub rate_hz: f64,
    /// The time from the first call to the last.
    pub elapsed_s: f64,
    /// Whether all RELIABLE readers have acknowledged all samples.
    pub acknowledged: bool,
    /// The hash of all written samples; equals [`Received::hash`] if the same samples were received. Empty
    /// for a ROS 2 node.
    pub hash: String,
}

/// The summary of a subscriber.
#[derive(Clone, Debug, Deserialize)]
pub struct Received {
    /// Samples received, without duplicates.
    pub received: u64,
    /// Received samples that are too short for a sequence number (less than 8 bytes).
    pub unnumbered: u64,
    /// The lowest sequence number.
    pub first: Option<u64>,
    /// The highest sequence number.
    pub last: Option<u64>,
    /// Gaps: the first and the last missing sequence number of each; at most 1000 gaps.
    pub missing: Vec<(u64, u64)>,
    /// The total of missing sequence numbers, without that limit.
    pub missing_count: u64,
    /// Samples received more than once.
    pub duplicates: u64,
    /// Samples received after one with a higher sequence number.
    pub out_of_order: u64,
    /// Samples with a wrong size or wrong bytes.
    pub bad: u64,
    /// Samples with up to three zeros of padding at the end, as RTPS allows.
    pub padded: u64,
    /// Bytes received, without encapsulation headers.
    pub bytes: u64,
    /// Bytes of the smallest sample.
    pub size_min: u64,
    /// Bytes of the largest sample.
    pub size_max: u64,
    /// The last state of each key: `alive`, `disposed` or `no_writers`; see [`Peer::keys`].
    #[serde(default)]
    pub keys: BTreeMap<u32, String>,
    /// The number of samples with each encapsulation header.
    pub headers: BTreeMap<String, u64>,
    /// Samples whose source timestamp differs from the publisher's by 10 ns at most.
    pub source_timestamps_kept: u64,
    /// The other samples of 24 bytes or more.
    pub source_timestamps_changed: u64,
    /// The time from before `write` to after `take`, with both on one machine.
    pub latency_us: Option<Distribution>,
    /// The longest time between two samples.
    pub max_gap_ms: f64,
    /// The hash of all received samples; see [`Sent::hash`].
    pub hash: String,
}

impl Sent {
    /// Asserts that no write failed and that the publisher kept at least a quarter of its rate. A write that
    /// blocks for less than its time limit does not fail, nor does one with KEEP_LAST, but each skips the
    /// periods that it takes. A quarter: a busy machine costs some periods, a blocked writer nearly all.
    pub fn assert_not_blocked(&self) {
        assert_eq!(self.failed, 0, "the publisher was blocked: {self:?}");
        assert!(self.skipped_ticks <= 3 * self.ok, "the publisher was slowed down: {self:?}");
    }
}

impl Received {
    /// Asserts that exactly the sent samples were received: every byte, once, in order.
    pub fn assert_all_of(&self, sent: &Sent) {
        assert_eq!(self.received, sent.ok, "number of samples\n{sent:?}\n{self:?}");
        self.assert_sound();
        // A ROS 2 node has no hash. A subscriber compares each payload with the expected one in any case.
        if !self.hash.is_empty() && !sent.hash.is_empty() {
            assert_eq!(self.hash, sent.hash, "hash of the payloads\n{sent:?}\n{self:?}");
        }
    }

    /// Asserts that the received samples have the right bytes, no duplicates and the right order. Samples may
    /// be missing.
    pub fn assert_sound(&self) {
        assert_eq!(self.bad, 0, "samples with wrong bytes\n{self:?}");
        assert_eq!(self.duplicates, 0, "duplicates\n{self:?}");
        assert_eq!(self.out_of_order, 0, "samples out of order\n{self:?}");
    }
}

/// The distribution of a duration, in microseconds.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Distribution {
    pub min: f64,
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
    pub max: f64,
}

/// The ROS 2 graph that a peer of role `graph` has discovered.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// All endpoints, by GUID in hexadecimal.
    pub endpoints: BTreeMap<String, Endpoint>,
    /// The nodes of each participant that has published a graph entry, by its GID in hexadecimal.
    pub nodes: BTreeMap<String, Vec<Node>>,
    /// The USER_DATA of each participant, by its GUID in hexadecimal.
    pub user_data: BTreeMap<String, String>,
}

/// A reader or writer, as announced by discovery.
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

/// A ROS 2 node, as announced on `ros_discovery_info`.
#[derive(Clone, Debug, Deserialize, PartialEq, Eq)]
pub struct Node {
    pub namespace: String,
    pub name: String,
    pub reader_gids: Vec<String>,
    pub writer_gids: Vec<String>,
}

impl RunningPeer {
    /// The graph that a peer of role `graph` has discovered so far. Panics if a graph entry could not be
    /// decoded.
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
                "participant" => {
                    graph.user_data.insert(text("guid"), text("user_data"));
                }
                "participant_gone" => {
                    graph.user_data.remove(&text("guid"));
                }
                "participant_entities" => {
                    let nodes = serde_json::from_value(event["nodes"].clone()).unwrap();
                    graph.nodes.insert(text("gid"), nodes);
                }
                "bad_participant_entities" => panic!("a graph entry that cannot be decoded: {event}"),
                _ => {}
            }
        }
        graph
    }
}
