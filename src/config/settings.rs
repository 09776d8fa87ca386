//! The validated configuration: every value is in range, every name resolved, every default filled in.
//!
//! Nothing below this type needs to check again or to know what YAML is.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use crate::model::{ClassifierThresholds, DropPolicy, LaneRates, RatePolicy, SafetyRules};
use crate::model::{
    Durability, History, InstanceName, LaneName, QosProfile, Reliability, RouteId, SubscriberState,
    TopicName, TrafficClass, TypeName,
};

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Which bridge this is; the namespace of its shared memory.
    pub instance: InstanceName,
    /// Where the publishers are.
    pub input: DdsNetwork,
    /// The bytes of a graph identifier in `ros_discovery_info`: 24 up to ROS 2 Humble, 16 since Iron.
    pub graph_gid_bytes: usize,
    /// The routes, in the order of the file.
    pub routes: Vec<Route>,
    /// The lanes: `critical`, `noncritical`, then the user's, in the order of the file.
    pub lanes: Vec<Lane>,
    /// Shared memory.
    pub shared_memory: SharedMemory,
    /// How long a lane keeps its last policy when control is gone, in milliseconds.
    pub policy_hold_ms: u64,
    /// Scheduling of the ingress process.
    pub ingress_scheduling: Scheduling,
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
    /// States forced by hand, by subscriber id.
    pub overrides: BTreeMap<String, SubscriberState>,
    /// Known subscribers, and the lane each is on.
    pub subscribers: BTreeMap<String, LaneName>,
}

impl Settings {
    /// The lane of that name.
    pub fn lane(&self, name: &LaneName) -> Option<&Lane> {
        self.lanes.iter().find(|lane| lane.name == *name)
    }
}

/// One DDS domain and the network interfaces used in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DdsNetwork {
    /// DDS domain, 0 to 232.
    pub domain_id: u16,
    /// Interfaces or addresses to use; empty for all.
    pub interfaces: Vec<NetworkSelector>,
}

/// A network interface, by name or by one of its addresses.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum NetworkSelector {
    /// Such as `wlan0`.
    Name(String),
    /// Such as `192.168.0.7`.
    Address(Ipv4Addr),
}

impl NetworkSelector {
    /// What is allowed, as a phrase that completes "must be …".
    pub const ALLOWED: &'static str = "the name of a network interface or an IPv4 address";

    /// An interface name as Linux allows it (15 bytes, no `/`, no space), or an IPv4 address.
    pub fn parse(text: &str) -> Option<Self> {
        if let Ok(address) = text.parse() {
            return Some(Self::Address(address));
        }
        // 300.1.1.1 would do as a name, but is meant as an address; so is anything with a colon, of IPv6.
        let meant_as_address = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
        let is_name = (1..=15).contains(&text.len())
            && text.bytes().all(|byte| byte.is_ascii_graphic() && !matches!(byte, b'/' | b':'));
        (is_name && !meant_as_address).then(|| Self::Name(text.to_owned()))
    }
}

/// One input topic.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Route {
    /// The user's name for it.
    pub id: RouteId,
    /// What ingress subscribes to.
    pub input_topic: TopicName,
    /// The message type; `None` is found by discovery.
    pub message_type: Option<TypeName>,
    /// What ingress asks of the publisher.
    pub input_qos: InputQos,
    /// The largest sample taken in, in bytes of serialized payload.
    pub max_sample_bytes: usize,
    /// Samples kept in shared memory for a lane that comes back: what a `TRANSIENT_LOCAL` lane offers to late
    /// joiners after it was restarted, and what a restarted lane catches up with.
    pub retained_samples: usize,
}

/// What the ingress reader asks of the publisher. A policy that is `None` follows what the publisher offers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputQos {
    /// RELIABILITY.
    pub reliability: Option<Reliability>,
    /// DURABILITY.
    pub durability: Option<Durability>,
    /// HISTORY of the reader: what may wait between the DDS library and ingress.
    pub history: Option<History>,
    /// DEADLINE in milliseconds.
    pub deadline_ms: Option<u64>,
}

/// One lane: a process, its DDS participant and a writer for each route.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lane {
    /// Its name.
    pub name: LaneName,
    /// Critical or noncritical.
    pub class: TrafficClass,
    /// Where its subscribers are.
    pub network: DdsNetwork,
    /// What it forwards: one for each route that it serves, in the order of the routes.
    pub outputs: Vec<Output>,
    /// Samples for each route that may wait for the lane in shared memory.
    pub queue_depth: usize,
    /// Samples that the lane may hold in shared memory at once, for each route, while DDS sends them.
    pub max_borrowed: usize,
    /// Samples of at least so many bytes are handed to DDS by reference, smaller ones copied.
    pub by_reference_min_bytes: usize,
    /// Unacknowledged samples that a RELIABLE writer of the lane may have outstanding.
    pub window_samples: usize,
    /// Rates and staleness by mode. A critical lane has no use for them: there the rate is infinite.
    pub rates: LaneRates,
    /// Scheduling of the lane's process.
    pub scheduling: Scheduling,
}

impl Lane {
    /// Samples that the lane may hold in shared memory at once, for each route: a noncritical one also
    /// borrows what waits in its own queue, the sample it takes next and the one that it sends.
    pub fn max_borrowed_in_all(&self) -> usize {
        let waiting = match self.class {
            TrafficClass::Critical => 0,
            TrafficClass::Noncritical => {
                self.rates.normal.queue_samples.max(self.rates.degraded.queue_samples) + 2
            }
        };
        self.max_borrowed.max(waiting)
    }
}

/// One route on one lane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Output {
    /// Index into [`Settings::routes`].
    pub route: usize,
    /// What the lane publishes to.
    pub topic: TopicName,
    /// How.
    pub qos: QosProfile,
}

/// Shared memory of one bridge.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SharedMemory {
    /// The folder of the bridge's own files; `None` lets the program choose (see `config/README.md`).
    pub root_path: Option<PathBuf>,
    /// Local programs that may tap a route at once.
    pub max_taps: usize,
}

/// How the operating system schedules a process.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Scheduling {
    /// The scheduling policy.
    pub policy: SchedulingPolicy,
    /// 1 to 99 for FIFO and round robin, 0 otherwise.
    pub priority: u8,
    /// Nice value, 0 to 19: higher ones leave the CPU to others. Nothing to FIFO and round robin.
    pub nice: u8,
    /// The time slice asked of the kernel's fair scheduler, in microseconds; `None` for the kernel's own. A
    /// process that wakes takes the CPU at once from one with a longer slice. Nothing to FIFO and round
    /// robin, nor to a kernel before 6.12.
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

/// The classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Classifier {
    /// Whether subscribers are classified at all.
    pub enabled: bool,
    /// The one responder that counts; `None` for any.
    pub subscriber_id: Option<String>,
    /// Evaluations per second.
    pub evaluate_rate_hz: f64,
    /// What it decides by.
    pub thresholds: ClassifierThresholds,
}

/// Active probing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Probes {
    /// Whether probes are sent.
    pub enabled: bool,
    /// Probes per second.
    pub rate_hz: f64,
    /// Shown as a warning above it; decides nothing.
    pub rtt_threshold_ms: f64,
    /// Shown as a warning above it; decides nothing.
    pub loss_threshold: f64,
    /// Shown as a warning above it; decides nothing.
    pub jitter_threshold_ms: f64,
    /// Probes in the sliding window.
    pub window_size: usize,
    /// Consecutive readings before a warning is shown or withdrawn.
    pub hysteresis_count: u32,
    /// A response later than this counts as lost.
    pub timeout_ms: u64,
    /// Topic of the requests.
    pub request_topic: TopicName,
    /// Topic of the responses.
    pub response_topic: TopicName,
}

/// The safety supervisor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Safety {
    /// Evaluations per second.
    pub evaluate_rate_hz: f64,
    /// What it decides by.
    pub rules: SafetyRules,
}

/// What is done about control messages that do not authenticate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum TrustMode {
    /// They are refused.
    DefaultDeny,
    /// They are accepted and logged.
    Permissive,
    /// They are accepted.
    Off,
}

/// Where the shared secret is. The secret itself is never held in the settings, so that it cannot be logged.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum SecretSource {
    /// The file's first line.
    File(PathBuf),
    /// The value of this environment variable.
    Environment(String),
    /// `security.hmac_secret` of the configuration file itself, as the original package has it.
    ConfigFile,
}

/// Authentication of control messages.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Security {
    /// What is done about messages that do not authenticate.
    pub trust_mode: TrustMode,
    /// Whether probes are signed.
    pub enable_probe_hmac: bool,
    /// Where the secret is; `None` when there is none.
    pub secret: Option<SecretSource>,
    /// How old a signed message may be.
    pub replay_window_ms: u64,
    /// Probes and responses that are looked at per second, of one sender.
    pub max_probe_rate_hz: u32,
    /// Whether an override may name a subscriber by its node name.
    pub allow_legacy_node_name_overrides: bool,
}

/// Diagnostics.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Diagnostics {
    /// Whether they are published.
    pub enabled: bool,
    /// How often, in milliseconds.
    pub publish_interval_ms: u64,
    /// Topic of the original's JSON diagnostics.
    pub topic: TopicName,
    /// What is logged where `RUST_LOG` says nothing.
    pub verbosity: Verbosity,
    /// Address of the Prometheus page; `None` for none.
    pub metrics: Option<MetricsListener>,
}

/// The least severe level that is logged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verbosity {
    /// What failed.
    Error,
    /// Also what is wrong and goes on.
    Warn,
    /// Also what happens seldom.
    Info,
    /// Also what helps to find a fault.
    Debug,
    /// Everything.
    Trace,
}

/// Where the Prometheus page is served.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum MetricsListener {
    /// TCP; a loopback address.
    Tcp(IpAddr, u16),
    /// A unix socket.
    Unix(PathBuf),
}
