//! Scenarios: what is run, with what load, over what links, and what is done to it meanwhile. A YAML file each.

mod check;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use super::error::EvalError;
use super::impairment::Level;

/// The largest scenario file, in bytes.
const MAX_BYTES: u64 = 65_536;

/// One experiment, as its file describes it. config/scenarios/README.md documents every key.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// The name of the file.
    #[serde(skip)]
    pub name: String,
    /// The file.
    #[serde(skip)]
    pub text: String,
    /// What it is, in a line.
    pub title: String,
    /// With or without the bridge.
    pub variant: Variant,
    /// Whether the bridge classifies its subscribers.
    #[serde(default = "yes")]
    pub classifier: bool,
    /// The measured window, in seconds.
    pub duration_s: f64,
    /// The same in a smoke run; events move with it.
    #[serde(default = "default_quick_s")]
    pub quick_s: f64,
    /// The hosts between that it is run with.
    #[serde(default = "plain_switch")]
    pub switches: Vec<Switch>,
    /// What is published.
    #[serde(default)]
    pub workload: Workload,
    /// The remote subscribers; the local, critical one is always there.
    pub remotes: Vec<Remote>,
    /// What happens meanwhile.
    #[serde(default)]
    pub events: Vec<Event>,
}

/// With or without the bridge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Variant {
    /// All subscribers read the publisher's topic.
    Baseline,
    /// They read their lanes.
    Bridge,
}

/// The host between the hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    /// Passes packets on.
    Plain,
    /// Puts fragments together with bridge netfilter and connection tracking, as a host of containers does.
    Reassembling,
}

impl Switch {
    /// As the command line has it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Reassembling => "reassembling",
        }
    }
}

/// What is published.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Workload {
    /// Topics, each with a publisher and all subscribers of its own.
    pub routes: usize,
    /// Samples per second of each.
    pub rate_hz: f64,
    /// Bytes of a serialized sample.
    pub size_bytes: u64,
    /// ROS 2 message type, `pkg/msg/Name`.
    pub message_type: String,
    /// History of remote subscribers of a baseline.
    pub slow_history: ReaderHistory,
}

/// The paper's: a LaserScan at 30 Hz, of 720 rays.
impl Default for Workload {
    fn default() -> Self {
        Self {
            routes: 1,
            rate_hz: 30.0,
            size_bytes: 2_948,
            message_type: "sensor_msgs/msg/LaserScan".to_owned(),
            slow_history: ReaderHistory::KeepAll,
        }
    }
}

impl Workload {
    /// The name of the type in DDS.
    pub fn dds_type(&self) -> String {
        let mut parts = self.message_type.split('/');
        let (package, name) = (parts.next().unwrap_or_default(), parts.next_back().unwrap_or_default());
        format!("{package}::msg::dds_::{name}_")
    }
}

/// HISTORY of a reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReaderHistory {
    /// KEEP_ALL.
    KeepAll,
    /// KEEP_LAST 10.
    #[serde(rename = "keep_last_10")]
    KeepLast10,
}

/// A remote subscriber and its link.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Remote {
    /// Its name, and that of its host.
    pub name: String,
    /// The lane it reads where there is a bridge.
    #[serde(default = "noncritical")]
    pub lane: String,
    /// What is lost on the way to it.
    #[serde(default = "clean")]
    pub level: Level,
    /// Mean delay on the way to it.
    #[serde(default)]
    pub delay_ms: f64,
    /// Its standard deviation.
    #[serde(default)]
    pub jitter_ms: f64,
    /// Mean delay on the way back.
    #[serde(default)]
    pub return_delay_ms: f64,
    /// Its standard deviation.
    #[serde(default)]
    pub return_jitter_ms: f64,
    /// The bandwidth of the way to it.
    #[serde(default)]
    pub cap_kbit_per_s: Option<u64>,
    /// Whether all this is there from the beginning of the window, or only after an event.
    #[serde(default = "yes")]
    pub impaired_at_begin: bool,
}

impl Remote {
    /// Whether packets towards it are lost or delayed by more than a cap.
    pub fn is_impaired(&self) -> bool {
        self.level != Level::Clean || self.delay_ms > 0.0 || self.jitter_ms > 0.0
    }

    /// Whether packets from it are delayed.
    pub fn returns_late(&self) -> bool {
        self.return_delay_ms > 0.0 || self.return_jitter_ms > 0.0
    }
}

/// Something that is done at a time.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Event {
    /// Seconds from the beginning of the window.
    pub at_s: f64,
    /// What.
    #[serde(rename = "do")]
    pub action: Action,
    /// To whom: a remote subscriber (its link, or its program), an endpoint, a process of the bridge.
    pub to: String,
}

/// What can be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// The link is impaired as its remote subscriber says.
    LinkOn,
    /// The link is clean.
    LinkOff,
    /// The link is cut.
    LinkDown,
    /// SIGSTOP.
    Stop,
    /// SIGCONT.
    Continue,
    /// SIGKILL, to a process of the bridge.
    Kill,
}

impl Action {
    /// Whether it is done to a link.
    pub const fn is_of_link(self) -> bool {
        matches!(self, Self::LinkOn | Self::LinkOff | Self::LinkDown)
    }

    /// As the files have it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::LinkOn => "link_on",
            Self::LinkOff => "link_off",
            Self::LinkDown => "link_down",
            Self::Stop => "stop",
            Self::Continue => "continue",
            Self::Kill => "kill",
        }
    }
}

impl Scenario {
    /// Reads a file.
    ///
    /// # Errors
    /// It can't be read, is no scenario, or has values that can't be; all of these are named.
    pub fn load(path: &Path) -> Result<Self, EvalError> {
        let size = fs::metadata(path).map_err(|error| EvalError::file(path, &error))?.len();
        if size > MAX_BYTES {
            return Err(EvalError::new(format!("{}: {size} bytes are no scenario", path.display())));
        }
        let text = fs::read_to_string(path).map_err(|error| EvalError::file(path, &error))?;
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        Self::parse(&name, &text)
            .map_err(|problems| EvalError::new(format!("{}: {}", path.display(), problems.join("\n  "))))
    }

    /// Reads a scenario of that name.
    ///
    /// # Errors
    /// What is wrong with it: that it is no scenario, or every value that can't be.
    pub fn parse(name: &str, text: &str) -> Result<Self, Vec<String>> {
        let scenario: Self = serde_yaml::from_str(text).map_err(|error| vec![error.to_string()])?;
        let scenario = Self { name: name.to_owned(), text: text.to_owned(), ..scenario };
        match check::problems(&scenario) {
            problems if problems.is_empty() => Ok(scenario),
            problems => Err(problems),
        }
    }

    /// All scenarios of a folder, by name.
    ///
    /// # Errors
    /// The folder can't be read, has none, or one of them is wrong.
    pub fn load_all(folder: &Path) -> Result<Vec<Self>, EvalError> {
        let entries = fs::read_dir(folder).map_err(|error| EvalError::file(folder, &error))?;
        let mut paths: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "yaml"));
        paths.sort();
        if paths.is_empty() {
            return Err(EvalError::new(format!("{} has no scenarios (*.yaml)", folder.display())));
        }
        paths.iter().map(|path| Self::load(path)).collect()
    }

    /// Whether something is lost by a row of Table I, of which there are two readings.
    pub fn has_readings(&self) -> bool {
        self.remotes.iter().any(|remote| remote.level != Level::Clean)
    }

    /// The lanes that the bridge has.
    pub fn lanes(&self) -> Vec<String> {
        let fixed = ["critical", "noncritical"].map(str::to_owned);
        let remote: BTreeSet<String> = self.remotes.iter().map(|remote| remote.lane.clone()).collect();
        let own = remote.into_iter().filter(|lane| !fixed.contains(lane));
        fixed.iter().cloned().chain(own).collect()
    }

    /// The processes of the bridge: its `up` and the roles.
    pub fn bridge_processes(&self) -> Vec<String> {
        let lanes = self.lanes().into_iter().map(|lane| format!("egress-{lane}"));
        let roles = ["up", "ingress", "control"].into_iter().map(str::to_owned);
        roles.chain(lanes).collect()
    }

    /// The name of a route.
    pub fn route_name(&self, route: usize) -> String {
        if route == 0 { "scan".to_owned() } else { format!("scan_{}", route + 1) }
    }

    /// The name of an endpoint of a route: plain of the first one.
    pub fn endpoint_name(&self, who: &str, route: usize) -> String {
        if route == 0 { who.to_owned() } else { format!("{who}-{}", route + 1) }
    }
}

fn yes() -> bool {
    true
}

fn default_quick_s() -> f64 {
    8.0
}

fn plain_switch() -> Vec<Switch> {
    vec![Switch::Plain]
}

fn noncritical() -> String {
    "noncritical".to_owned()
}

fn clean() -> Level {
    Level::Clean
}
