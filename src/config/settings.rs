//! The validated configuration: every value is in range, every name is resolved and every default is filled
//! in.
//!
//! Code that uses these types does not check values again and does not depend on YAML.

use std::collections::BTreeMap;
use std::fmt;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use crate::model::{ClassifierThresholds, DropPolicy, LaneRates, RatePolicy, SafetyRules};
use crate::model::{
    Durability, History, InstanceName, LaneName, NodeName, QosProfile, Reliability, RouteId, RouteInfo,
    SubscriberState, TopicName, TopicPattern, TopicPrefix, TrafficClass, TypeName,
};

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The name of this bridge; the namespace of its shared memory.
    pub instance: InstanceName,
    /// The network of the publishers.
    pub input: DdsNetwork,
    /// The namespace of the bridge's nodes.
    pub node_namespace: String,
    /// What the names of the bridge's nodes begin with, if anything.
    pub node_name: Option<NodeName>,
    /// The bytes of a graph identifier in `ros_discovery_info`: 24 up to ROS 2 Humble, 16 since Iron.
    pub graph_gid_bytes: usize,
    /// The routes, in the order of the file.
    pub routes: Vec<Route>,
    /// The patterns among the entries of `topics`, in the order of the file.
    pub patterns: Vec<RoutePattern>,
    /// The lanes: `critical`, `noncritical`, then the user's, in the order of the file.
    pub lanes: Vec<Lane>,
    /// Shared memory.
    pub shared_memory: SharedMemory,
    /// How long a lane applies its last policy when control does not confirm it, in milliseconds.
    pub policy_hold_ms: u64,
    /// Scheduling of the ingress process.
    pub ingress_scheduling: Scheduling,
    /// Whether ingress has a standby.
    pub ingress_standby: Standby,
    /// Scheduling of the control process.
    pub control_scheduling: Scheduling,
    /// The classifier (paper, section III-C).
    pub classifier: Classifier,
    /// Probing (paper, section III-C).
    pub probes: Probes,
    /// The safety supervisor (paper, section III-E).
    pub safety: Safety,
    /// Authentication of control messages.
    pub security: Security,
    /// Diagnostics.
    pub diagnostics: Diagnostics,
    /// States that the user forces, by subscriber id.
    pub overrides: BTreeMap<String, SubscriberState>,
    /// The lanes of the listed subscribers, by subscriber id.
    pub subscribers: BTreeMap<String, LaneName>,
    /// The parameters that were set while the bridge runs, each in place of the file's.
    pub set_parameters: SetParameters,
}

/// Parameters that were set while the bridge runs, by key path; the values are YAML.
pub type SetParameters = BTreeMap<String, String>;

impl Settings {
    /// The name of the node of a process.
    pub fn node_name_of(&self, process: &str) -> String {
        self.node_name.as_ref().map_or_else(|| process.to_owned(), |name| format!("{name}_{process}"))
    }

    /// Whether the critical lane serves a route.
    pub fn is_critical(&self, route: usize) -> bool {
        let mut lanes = self.lanes.iter().filter(|lane| lane.class() == TrafficClass::Critical);
        lanes.any(|lane| lane.outputs.iter().any(|output| output.route == route))
    }

    /// The lane with that name.
    pub fn lane(&self, name: &LaneName) -> Option<&Lane> {
        self.lanes.iter().find(|lane| lane.name == *name)
    }
}

/// A DDS domain and the network interfaces used in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DdsNetwork {
    /// DDS domain, 0 to 232.
    pub domain_id: u16,
    /// Interfaces or addresses to use; empty for all.
    pub interfaces: Vec<NetworkSelector>,
    /// Hosts to which the participants are also announced by unicast, for networks without multicast.
    pub static_peers: Vec<Ipv4Addr>,
}

impl DdsNetwork {
    /// The most static peers. Each process announces itself to 32 ports of each, every 2 s.
    pub const MAX_STATIC_PEERS: usize = 16;

    /// A domain, over all interfaces.
    pub fn of_domain(domain_id: u16) -> Self {
        Self { domain_id, interfaces: Vec::new(), static_peers: Vec::new() }
    }
}

/// A network interface, by name or by one of its addresses.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum NetworkSelector {
    /// A name, such as `wlan0`.
    Name(String),
    /// An address, such as `192.168.0.7`.
    Address(Ipv4Addr),
}

impl fmt::Display for NetworkSelector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => f.write_str(name),
            Self::Address(address) => address.fmt(f),
        }
    }
}

impl NetworkSelector {
    /// The allowed texts, as a phrase that completes "must be …".
    pub const ALLOWED: &'static str = "the name of a network interface or an IPv4 address";

    /// Parses an interface name that Linux allows (at most 15 bytes, no `/`, no space), or an IPv4 address.
    pub fn parse(text: &str) -> Option<Self> {
        if let Ok(address) = text.parse() {
            return Some(Self::Address(address));
        }
        // 300.1.1.1 is a valid name but meant as an address; text with a colon is meant as an IPv6 address.
        let meant_as_address = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
        let is_name = (1..=15).contains(&text.len())
            && text.bytes().all(|byte| byte.is_ascii_graphic() && !matches!(byte, b'/' | b':'));
        (is_name && !meant_as_address).then(|| Self::Name(text.to_owned()))
    }
}

/// A route: one input topic and how ingress reads it. Its outputs are in the lanes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Route {
    /// The user's name for it.
    pub id: RouteId,
    /// The id of its entry in `topics`: another one than `id` if the entry is a pattern, which has several
    /// routes.
    pub entry: RouteId,
    /// The topic that ingress subscribes to.
    pub input_topic: InputTopic,
    /// The message type; `None` to discover it.
    pub message_type: Option<TypeName>,
    /// The QoS that ingress requests from the publisher.
    pub input_qos: InputQos,
    /// The largest sample that ingress accepts, in bytes of serialized payload.
    pub max_sample_bytes: usize,
    /// Samples of routes with a higher priority go first.
    pub priority: u8,
    /// Samples kept in shared memory for a restarted lane: those that it catches up with, and those that a
    /// `TRANSIENT_LOCAL` lane offers to late joiners.
    pub retained_samples: usize,
    /// The most samples that ingress keeps in addition for a critical lane that restarts, as far as they fit
    /// a number of bytes; 0 for none.
    pub backlog_samples: usize,
}

/// What determines the input topic of a route.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum InputTopic {
    /// It is this topic.
    Topic(TopicName),
    /// It is a topic that matches, which ingress chooses when it discovers one: the route is a place.
    Pattern(TopicPattern),
}

impl InputTopic {
    /// The topic of a route with this record of ingress; `None` while it has none.
    pub fn resolve(&self, info: &RouteInfo) -> Option<TopicName> {
        match self {
            Self::Topic(topic) => Some(topic.clone()),
            Self::Pattern(_) => info.topic(),
        }
    }

    /// Whether the route is a place of a pattern.
    pub const fn is_place(&self) -> bool {
        matches!(self, Self::Pattern(_))
    }
}

impl fmt::Display for InputTopic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Topic(topic) => topic.fmt(f),
            Self::Pattern(pattern) => pattern.fmt(f),
        }
    }
}

/// What determines the topic of an output.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum OutputTopic {
    /// It is this topic.
    Topic(TopicName),
    /// It is the input topic with this before it: the output of a place.
    Prefix(TopicPrefix),
}

impl OutputTopic {
    /// The topic of an output whose route has this input topic; `None` while that has none.
    pub fn resolve(&self, input: Option<&TopicName>) -> Option<TopicName> {
        match self {
            Self::Topic(topic) => Some(topic.clone()),
            Self::Prefix(prefix) => prefix.output_of(input?),
        }
    }

    /// The topic; `None` if it depends on the input topic.
    pub const fn topic(&self) -> Option<&TopicName> {
        match self {
            Self::Topic(topic) => Some(topic),
            Self::Prefix(_) => None,
        }
    }

    /// What is before the input topic, if it depends on that.
    pub const fn prefix(&self) -> Option<&TopicPrefix> {
        match self {
            Self::Topic(_) => None,
            Self::Prefix(prefix) => Some(prefix),
        }
    }
}

impl fmt::Display for OutputTopic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Topic(topic) => topic.fmt(f),
            Self::Prefix(prefix) => prefix.fmt(f),
        }
    }
}

/// An entry of `topics` whose input topic is a pattern. Its places are consecutive routes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RoutePattern {
    /// The id of the entry.
    pub entry: RouteId,
    /// The pattern.
    pub input_topic: TopicPattern,
    /// Topics that are left out although they match.
    pub exclude: Vec<TopicPattern>,
    /// The first of its places, as an index into [`Settings::routes`].
    pub first_route: usize,
    /// The number of its places.
    pub max_routes: usize,
}

impl RoutePattern {
    /// Whether the pattern is for a topic: it matches and is not excluded.
    pub fn is_for(&self, topic: &str) -> bool {
        self.input_topic.matches(topic) && !self.exclude.iter().any(|excluded| excluded.matches(topic))
    }

    /// Its places, as indices into [`Settings::routes`].
    pub fn places(&self) -> std::ops::Range<usize> {
        self.first_route..self.first_route + self.max_routes
    }
}

/// The QoS that the ingress reader requests. A policy that is `None` follows the publisher's offer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputQos {
    /// RELIABILITY.
    pub reliability: Option<Reliability>,
    /// DURABILITY.
    pub durability: Option<Durability>,
    /// HISTORY of the reader: the samples that may wait between the DDS library and ingress.
    pub history: Option<History>,
    /// DEADLINE in milliseconds.
    pub deadline_ms: Option<u64>,
}

/// The default of `window_samples` where the depth of the history does not give it.
pub(super) const DEFAULT_WINDOW_SAMPLES: usize = 256;

/// What a lane forwards of the samples of its routes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Forwarding {
    /// Every sample, at once: a critical lane.
    Everything,
    /// Samples that are not too old, as many as these rates allow in each mode: a noncritical lane.
    Limited(LaneRates),
}

/// One lane: a process, its DDS participant and a writer for each route.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lane {
    /// Its name.
    pub name: LaneName,
    /// What it forwards, which makes it critical or noncritical.
    pub forwarding: Forwarding,
    /// The network of its subscribers.
    pub network: DdsNetwork,
    /// The Differentiated Services Code Point of what the lane sends by unicast, 0 to 63.
    pub dscp: u8,
    /// Its outputs, one for each route that it serves, in the order of the routes.
    pub outputs: Vec<Output>,
    /// The most samples of each route that wait for the lane in shared memory.
    pub queue_depth: usize,
    /// The most samples of each route that the lane holds in shared memory while DDS sends them.
    pub max_borrowed: usize,
    /// Samples of at least this size are passed to DDS by reference, smaller ones are copied.
    pub by_reference_min_bytes: usize,
    /// The most unacknowledged samples of a RELIABLE writer of the lane; `None` for the default of
    /// [`Lane::window_samples_of`].
    pub window_samples: Option<usize>,
    /// Scheduling of the lane's process.
    pub scheduling: Scheduling,
    /// Whether the lane's process has a standby; only that of a critical lane may.
    pub standby: Standby,
}

impl Lane {
    /// Critical or noncritical.
    pub const fn class(&self) -> TrafficClass {
        match self.forwarding {
            Forwarding::Everything => TrafficClass::Critical,
            Forwarding::Limited(_) => TrafficClass::Noncritical,
        }
    }

    /// Whether any route has an output on this lane. The two built-in lanes always exist; a lane without an
    /// output has no process.
    pub fn is_used(&self) -> bool {
        !self.outputs.is_empty()
    }

    /// Whether the samples of an output with this QoS supersede each other: those of a noncritical lane,
    /// unless they are state (TRANSIENT_LOCAL).
    pub fn supersedes(&self, qos: &QosProfile) -> bool {
        self.class() == TrafficClass::Noncritical && qos.durability == Durability::Volatile
    }

    /// The most unacknowledged samples of a RELIABLE writer with this QoS. Of samples that supersede each
    /// other only the history is repaired, so that a subscriber behind a bad link continues with fresh ones.
    pub fn window_samples_of(&self, qos: &QosProfile) -> usize {
        let default = match qos.depth() {
            Some(depth) if self.supersedes(qos) => depth as usize,
            _ => DEFAULT_WINDOW_SAMPLES,
        };
        self.window_samples.unwrap_or(default)
    }

    /// The most samples of each route that the lane holds in shared memory: a noncritical lane also holds
    /// those in its own queue, the sample that it takes next and the one that it sends.
    pub fn max_borrowed_in_all(&self) -> usize {
        let waiting = match &self.forwarding {
            Forwarding::Everything => 0,
            Forwarding::Limited(rates) => rates.normal.queue_samples.max(rates.degraded.queue_samples) + 2,
        };
        self.max_borrowed.max(waiting)
    }
}

/// The output of one route on one lane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Output {
    /// Index into [`Settings::routes`].
    pub route: usize,
    /// The topic that the lane publishes to.
    pub topic: OutputTopic,
    /// The QoS of its writer.
    pub qos: QosProfile,
    /// The QoS of its writer once the publishers offer TRANSIENT_LOCAL; `None` if the configuration gives the
    /// DURABILITY.
    pub latched_qos: Option<QosProfile>,
}

/// The shared memory of one bridge.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SharedMemory {
    /// The folder of the bridge's own files; `None` lets the program choose (see `config/README.md`).
    pub root_path: Option<PathBuf>,
    /// The most local programs that tap a route at once.
    pub max_taps: usize,
    /// The most bytes that the pools of all routes take together; `None` for a default by the machine.
    pub budget_bytes: Option<u64>,
}

/// How the operating system schedules a process.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Scheduling {
    /// The scheduling policy.
    pub policy: SchedulingPolicy,
    /// 1 to 99 for FIFO and round robin, 0 otherwise.
    pub priority: u8,
    /// Nice value, 0 to 19; a higher one leaves more CPU time to other processes. No effect with FIFO and
    /// round robin.
    pub nice: u8,
    /// The time slice requested from the kernel's fair scheduler, in microseconds; `None` for the kernel's
    /// default. A process that wakes preempts one with a longer slice. No effect with FIFO and round robin,
    /// and before Linux 6.12.
    pub slice_us: Option<u32>,
    /// CPUs that the process may run on; empty for all.
    pub cpus: Vec<usize>,
    /// Whether to lock the process' memory (`mlockall`).
    pub lock_memory: bool,
}

/// A scheduling policy of Linux.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum SchedulingPolicy {
    /// `SCHED_OTHER`.
    #[default]
    Other,
    /// `SCHED_FIFO`.
    Fifo,
    /// `SCHED_RR`.
    RoundRobin,
}

/// Whether a process has a second one, which takes its role over when it ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Standby {
    /// No: the supervisor starts the next process.
    None,
    /// The second process is started with the first one, and waits.
    Warm,
}

/// The settings of the classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Classifier {
    /// Whether subscribers are classified.
    pub enabled: bool,
    /// The id of the only responder that is classified; `None` for all.
    pub subscriber_id: Option<String>,
    /// Evaluations per second.
    pub evaluate_rate_hz: f64,
    /// Its thresholds.
    pub thresholds: ClassifierThresholds,
}

/// The settings of the probes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Probes {
    /// Whether probes are sent.
    pub enabled: bool,
    /// Probes per second.
    pub rate_hz: f64,
    /// Mean RTT above which a warning is shown; no other effect.
    pub rtt_threshold_ms: f64,
    /// Loss above which a warning is shown; no other effect.
    pub loss_threshold: f64,
    /// Jitter above which a warning is shown; no other effect.
    pub jitter_threshold_ms: f64,
    /// Probes in the sliding window.
    pub window_size: usize,
    /// Consecutive readings before a warning is shown or withdrawn.
    pub hysteresis_count: u32,
    /// Time after which a probe without a response is lost.
    pub timeout_ms: u64,
    /// Topic of the probe requests.
    pub request_topic: TopicName,
    /// Topic of the probe responses.
    pub response_topic: TopicName,
}

/// The settings of the safety supervisor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Safety {
    /// Evaluations per second.
    pub evaluate_rate_hz: f64,
    /// Its thresholds and counts.
    pub rules: SafetyRules,
}

/// How the bridge treats probe messages that are not authenticated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum TrustMode {
    /// Refuses probe messages that are not authenticated.
    DefaultDeny,
    /// Accepts and logs probe messages that are not authenticated.
    Permissive,
    /// Accepts probe messages that are not authenticated.
    Off,
}

/// The source of the shared secret. The settings never contain the secret itself, so that it is not logged.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum SecretSource {
    /// The first line of this file.
    File(PathBuf),
    /// The value of this environment variable.
    Environment(String),
    /// `security.hmac_secret` of the configuration file, as in the original package.
    ConfigFile,
}

/// The settings for authentication of probe messages.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Security {
    /// How messages that are not authenticated are treated.
    pub trust_mode: TrustMode,
    /// Whether probes are signed.
    pub enable_probe_hmac: bool,
    /// The source of the secret; `None` when there is none.
    pub secret: Option<SecretSource>,
    /// The largest age of a signed message.
    pub replay_window_ms: u64,
    /// The most probe requests, or responses to own probes, of one sender that are processed per second.
    pub max_probe_rate_hz: u32,
    /// Without effect; for files of the original package.
    pub allow_legacy_node_name_overrides: bool,
}

/// The settings of diagnostics, logs and metrics.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Diagnostics {
    /// Whether diagnostics are published.
    pub enabled: bool,
    /// The interval of the diagnostics, in milliseconds.
    pub publish_interval_ms: u64,
    /// The topic of the JSON diagnostics of the original package.
    pub topic: TopicName,
    /// The log level where `RUST_LOG` does not set one.
    pub verbosity: Verbosity,
    /// The address of the Prometheus page; `None` for no page.
    pub metrics: Option<MetricsListener>,
}

/// The least severe level that is logged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verbosity {
    /// Logs failures.
    Error,
    /// Logs also problems after which the process continues.
    Warn,
    /// Logs also rare events.
    Info,
    /// Logs also details for finding a fault.
    Debug,
    /// Logs everything.
    Trace,
}

/// The address of the Prometheus page.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum MetricsListener {
    /// A loopback address and a TCP port.
    Tcp(IpAddr, u16),
    /// The path of a unix socket.
    Unix(PathBuf),
}
