//! Scenarios: a YAML file each that describes the endpoints of an experiment, their load, their links, and
//! events during the run.

mod check;
mod trace;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use self::trace::{FORWARD, RETURN, TraceFile};
use super::error::EvalError;
use super::impairment::Level;

/// The largest scenario file, in bytes.
const MAX_BYTES: u64 = 65_536;

/// An experiment, read from its file. config/scenarios/README.md documents every key.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// The file's name without extension.
    #[serde(skip)]
    pub name: String,
    /// The file's text.
    #[serde(skip)]
    pub text: String,
    /// A one-line description.
    pub title: String,
    /// With or without the bridge.
    pub variant: Variant,
    /// Whether the bridge classifies its subscribers.
    #[serde(default = "yes")]
    pub classifier: bool,
    /// Length of the measured window, in seconds.
    pub duration_s: f64,
    /// Length of the measured window of a smoke run, in seconds; times of events are scaled with it.
    #[serde(default = "default_quick_s")]
    pub quick_s: f64,
    /// The switches that the scenario is run with, one run each.
    #[serde(default = "plain_switch")]
    pub switches: Vec<Switch>,
    /// The publishers' load.
    #[serde(default)]
    pub workload: Workload,
    /// The remote subscribers; there is always a local, critical subscriber, too.
    pub remotes: Vec<Remote>,
    /// Events during the measured window.
    #[serde(default)]
    pub events: Vec<Event>,
}

/// Whether a scenario runs with or without the bridge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Variant {
    /// Without the bridge: all subscribers read the publisher's topic.
    Baseline,
    /// With the bridge: each subscriber reads the output of its lane.
    Bridge,
}

impl Variant {
    /// The host that sends to the remote subscribers.
    pub const fn sender(self) -> &'static str {
        match self {
            Self::Baseline => "publisher",
            Self::Bridge => "bridge",
        }
    }
}

/// The switch that connects the hosts of a test bed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    /// Forwards packets unchanged.
    Plain,
    /// Reassembles fragments (bridge netfilter and connection tracking), as a container host does.
    Reassembling,
}

impl Switch {
    /// The name used on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Reassembling => "reassembling",
        }
    }
}

/// The samples that publishers write, and the histories of their readers.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Workload {
    /// Number of topics, each with its own publisher and subscribers.
    pub routes: usize,
    /// Samples per second of each publisher.
    pub rate_hz: f64,
    /// Bytes of a serialized sample.
    pub size_bytes: u64,
    /// ROS 2 message type, `pkg/msg/Name`.
    pub message_type: String,
    /// History of the remote subscribers of a baseline.
    pub slow_history: ReaderHistory,
    /// History of the local, critical subscriber.
    pub critical_history: ReaderHistory,
}

/// The paper's workload: a LaserScan of 720 rays at 30 Hz.
impl Default for Workload {
    fn default() -> Self {
        Self {
            routes: 1,
            rate_hz: 30.0,
            size_bytes: 2_948,
            message_type: "sensor_msgs/msg/LaserScan".to_owned(),
            slow_history: ReaderHistory::KeepAll,
            critical_history: ReaderHistory::KeepLast10,
        }
    }
}

impl Workload {
    /// The DDS name of the message type.
    pub fn dds_type(&self) -> String {
        let mut parts = self.message_type.split('/');
        let (package, name) = (parts.next().unwrap_or_default(), parts.next_back().unwrap_or_default());
        format!("{package}::msg::dds_::{name}_")
    }
}

/// The HISTORY QoS of a reader.
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
    /// Name of the subscriber and of its host.
    pub name: String,
    /// The lane whose output it reads when there is a bridge.
    #[serde(default = "noncritical")]
    pub lane: String,
    /// Loss of packets to it.
    #[serde(default = "clean")]
    pub level: Level,
    /// Mean delay of packets to it.
    #[serde(default)]
    pub delay_ms: f64,
    /// Standard deviation of that delay.
    #[serde(default)]
    pub jitter_ms: f64,
    /// Mean delay of packets from it.
    #[serde(default)]
    pub return_delay_ms: f64,
    /// Standard deviation of that delay.
    #[serde(default)]
    pub return_jitter_ms: f64,
    /// Trace of loss and delay of packets to it, instead of `level`, `delay_ms` and `jitter_ms`.
    #[serde(default)]
    pub trace: Option<TraceFile>,
    /// Trace of packets from it, instead of `return_delay_ms` and `return_jitter_ms`.
    #[serde(default)]
    pub return_trace: Option<TraceFile>,
    /// Limit of the bandwidth towards it.
    #[serde(default)]
    pub cap_kbit_per_s: Option<u64>,
    /// Whether the link is impaired from the beginning of the window on, or only after an event.
    #[serde(default = "yes")]
    pub impaired_at_begin: bool,
}

impl Remote {
    /// Whether packets to it are lost or delayed, other than by a bandwidth limit.
    pub fn is_impaired(&self) -> bool {
        self.level != Level::Clean || self.delay_ms > 0.0 || self.jitter_ms > 0.0 || self.trace.is_some()
    }

    /// Whether packets from it are lost or delayed.
    pub fn is_impaired_back(&self) -> bool {
        self.return_delay_ms > 0.0 || self.return_jitter_ms > 0.0 || self.return_trace.is_some()
    }
}

/// An action of the harness at a time of the run.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Event {
    /// Seconds from the beginning of the window.
    pub at_s: f64,
    /// The action.
    #[serde(rename = "do")]
    pub action: Action,
    /// The target: a remote subscriber (its link, or its program), an endpoint, or a process of the bridge.
    pub to: String,
}

/// The kinds of actions of an [`Event`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// Impairs the link as its remote subscriber's settings define.
    LinkOn,
    /// Makes the link clean.
    LinkOff,
    /// Cuts the link.
    LinkDown,
    /// Sends SIGSTOP to a program.
    Stop,
    /// Sends SIGCONT to a program.
    Continue,
    /// Sends SIGKILL to a process of the bridge.
    Kill,
}

impl Action {
    /// Whether the target is a link.
    pub const fn is_of_link(self) -> bool {
        matches!(self, Self::LinkOn | Self::LinkOff | Self::LinkDown)
    }

    /// The name used in scenarios and results.
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
    /// Reads and checks a scenario file.
    ///
    /// # Errors
    /// The file cannot be read, is no scenario, or has invalid values; the error lists all of them.
    pub fn load(path: &Path) -> Result<Self, EvalError> {
        let size = fs::metadata(path).map_err(|error| EvalError::file(path, &error))?.len();
        if size > MAX_BYTES {
            let path = path.display();
            return Err(EvalError::new(format!("{path}: {size} bytes, but must be at most {MAX_BYTES}")));
        }
        let text = fs::read_to_string(path).map_err(|error| EvalError::file(path, &error))?;
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        Self::parse_in(path.parent().unwrap_or(Path::new("")), &name, &text)
            .map_err(|problems| EvalError::new(format!("{}: {}", path.display(), problems.join("\n  "))))
    }

    /// Parses a scenario's text. Paths of traces are relative to the current folder.
    ///
    /// # Errors
    /// The text is no scenario, or has invalid values; the error lists all of them.
    pub fn parse(name: &str, text: &str) -> Result<Self, Vec<String>> {
        Self::parse_in(Path::new(""), name, text)
    }

    fn parse_in(folder: &Path, name: &str, text: &str) -> Result<Self, Vec<String>> {
        let scenario: Self = serde_yaml::from_str(text).map_err(|error| vec![error.to_string()])?;
        let mut scenario = Self { name: name.to_owned(), text: text.to_owned(), ..scenario };
        let mut problems = check::problems(&scenario);
        problems.extend(scenario.read_traces(folder));
        if problems.is_empty() { Ok(scenario) } else { Err(problems) }
    }

    /// Reads all scenarios of a folder, sorted by name.
    ///
    /// # Errors
    /// The folder cannot be read, has no scenarios, or one of them is invalid.
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

    /// Whether a link loses packets by a row of Table I, of which there are two readings.
    pub fn has_readings(&self) -> bool {
        self.remotes.iter().any(|remote| remote.level != Level::Clean)
    }

    /// The names of the bridge's lanes.
    pub fn lanes(&self) -> Vec<String> {
        let fixed = ["critical", "noncritical"].map(str::to_owned);
        let remote: BTreeSet<String> = self.remotes.iter().map(|remote| remote.lane.clone()).collect();
        let own = remote.into_iter().filter(|lane| !fixed.contains(lane));
        fixed.iter().cloned().chain(own).collect()
    }

    /// The names of the bridge's processes: the supervisor (`up`) and the roles.
    pub fn bridge_processes(&self) -> Vec<String> {
        let lanes = self.lanes().into_iter().map(|lane| format!("egress-{lane}"));
        let roles = ["up", "ingress", "control"].into_iter().map(str::to_owned);
        roles.chain(lanes).collect()
    }

    /// The name of a route, by its number.
    pub fn route_name(&self, route: usize) -> String {
        if route == 0 { "scan".to_owned() } else { format!("scan_{}", route + 1) }
    }

    /// The name of an endpoint of a route; those of the first route have no number.
    pub fn endpoint_name(&self, name: &str, route: usize) -> String {
        if route == 0 { name.to_owned() } else { format!("{name}-{}", route + 1) }
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

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "title: a\nvariant: bridge\nduration_s: 10\nremotes:\n  - {name: slow}\n";

    fn scenarios() -> Vec<Scenario> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/scenarios");
        Scenario::load_all(folder.as_ref()).unwrap_or_else(|error| panic!("{error}"))
    }

    #[test]
    fn every_scenario_of_the_paper_exists_and_all_are_valid() {
        let scenarios = scenarios();
        let find = |name: &str| scenarios.iter().find(|it| it.name == name).expect(name);
        for level in Level::ALL {
            let duration_s = if level == Level::Clean { 120.0 } else { 180.0 };
            for (prefix, variant) in [("baseline", Variant::Baseline), ("bridge", Variant::Bridge)] {
                let scenario = find(&format!("{prefix}_{}", level.name()));
                assert_eq!(
                    (scenario.variant, scenario.duration_s),
                    (variant, duration_s),
                    "{}",
                    scenario.name
                );
                assert_eq!(scenario.remotes.iter().map(|it| it.level).collect::<Vec<_>>(), [level]);
                assert_eq!(scenario.workload, Workload::default());
                let returns = (scenario.remotes[0].return_delay_ms, scenario.remotes[0].return_jitter_ms);
                assert_eq!(returns, if level == Level::Clean { (0.0, 0.0) } else { (20.0, 10.0) });
                assert!(scenario.events.is_empty() && scenario.classifier);
            }
        }
        let toggle = find("bridge_toggle");
        assert_eq!(toggle.duration_s, 240.0);
        assert_eq!(toggle.events.iter().map(|event| event.at_s).collect::<Vec<_>>(), [60.0, 120.0, 180.0]);
        assert!(!find("bridge_ablation").classifier);
    }

    #[test]
    fn defaults_are_the_papers_workload_on_the_plain_switch() {
        let scenario = Scenario::parse("a", MINIMAL).expect("valid");
        assert_eq!((scenario.switches, scenario.workload.rate_hz), (vec![Switch::Plain], 30.0));
        assert_eq!(Workload::default().dds_type(), "sensor_msgs::msg::dds_::LaserScan_");
        assert!(!Scenario::parse("a", MINIMAL).expect("valid").has_readings());
    }

    #[test]
    fn lanes_and_processes_include_those_of_the_remote_subscribers() {
        let text = MINIMAL.replace("{name: slow}", "{name: slow}\n  - {name: laptop, lane: rviz}");
        let scenario = Scenario::parse("a", &text).expect("valid");
        assert_eq!(scenario.lanes(), ["critical", "noncritical", "rviz"]);
        assert!(scenario.bridge_processes().contains(&"egress-rviz".to_owned()));
        assert_eq!((scenario.endpoint_name("slow", 0), scenario.endpoint_name("slow", 1)), {
            ("slow".to_owned(), "slow-2".to_owned())
        });
    }

    #[test]
    fn all_mistakes_are_listed() {
        for (from, to, message) in [
            ("duration_s: 10", "duration_s: 0", "duration_s is 0, but must be 1 to 86400"),
            ("duration_s: 10", "duration_s: .nan", "duration_s is NaN"),
            ("variant: bridge", "variant: bridges", "bridges"),
            ("title: a", "titel: a", "titel"),
            ("{name: slow}", "{name: bridge}", "remotes[0].name is 'bridge', which is already in use"),
            ("{name: slow}", "{name: 'a b'}", "remotes[0].name is 'a b', but must be"),
            (
                "{name: slow}",
                "{name: slow}\n  - {name: slow}",
                "remotes[1].name is 'slow', which is already in use",
            ),
            ("{name: slow}", "{name: slow, lane: critical}", "reserved for the local subscriber"),
            ("{name: slow}", "{name: slow, delay_ms: -1}", "remotes[0].delay_ms is -1"),
            ("{name: slow}", "{name: slow, cap_kbit_per_s: 1}", "remotes[0].cap_kbit_per_s is 1"),
            (
                "{name: slow}",
                "{name: slow, jitter_ms: 1, trace: {file: Cargo.toml}}",
                "remotes[0].trace excludes level, delay_ms and jitter_ms",
            ),
            (
                "{name: slow}",
                "{name: slow, return_delay_ms: 1, return_trace: {file: Cargo.toml}}",
                "remotes[0].return_trace excludes return_delay_ms and return_jitter_ms",
            ),
            ("{name: slow}", "{name: slow, trace: {file: Cargo.toml}}", "Cargo.toml:1: there is no header"),
            ("{name: slow}", "{name: slow, trace: {file: nowhere.csv}}", "nowhere.csv: No such file"),
            ("{name: slow}", "{name: slow, trace: {file: a.csv, loop: true}}", "loop"),
            ("title: a", "title: a\nswitches: []", "switches is empty"),
            ("title: a", "title: a\nworkload: {routes: 0}", "workload.routes is 0"),
            ("title: a", "title: a\nworkload: {message_type: LaserScan}", "workload.message_type"),
            ("title: a", "title: a\nevents: [{at_s: 11, do: stop, to: slow}]", "events[0].at_s is 11"),
            ("title: a", "title: a\nevents: [{at_s: 1, do: kill, to: up}]", "events[0].to is 'up'"),
            (
                "title: a",
                "title: a\nevents: [{at_s: 1, do: kill, to: slow}]",
                "the target of kill must be one of ingress",
            ),
            (
                "title: a",
                "title: a\nevents: [{at_s: 1, do: link_on, to: critical}]",
                "the target of link_on must be one of slow",
            ),
            (
                "title: a",
                "title: a\nevents: [{at_s: 2, do: stop, to: slow}, {at_s: 1, do: stop, to: slow}]",
                "must be in the order of at_s",
            ),
        ] {
            let problems = Scenario::parse("a", &MINIMAL.replace(from, to)).expect_err(to).join("\n");
            assert!(problems.contains(message), "{to}: {problems}");
        }
        let text = MINIMAL.replace("duration_s: 10", "duration_s: 0").replace("slow", "up");
        assert_eq!(Scenario::parse("a", &text).expect_err("two problems").len(), 2);
        assert!(Scenario::parse("a", "").is_err());
        assert!(Scenario::load("/nowhere/a.yaml".as_ref()).is_err());
        assert!(Scenario::load_all("/nowhere".as_ref()).is_err());
    }

    #[test]
    fn every_key_is_documented() {
        let page = include_str!("../../../../config/scenarios/README.md");
        let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| `")).collect();
        for key in [
            "title",
            "variant",
            "classifier",
            "duration_s",
            "quick_s",
            "switches",
            "workload.routes",
            "workload.rate_hz",
            "workload.size_bytes",
            "workload.message_type",
            "workload.slow_history",
            "workload.critical_history",
            "remotes",
            "remotes[].name",
            "remotes[].lane",
            "remotes[].level",
            "remotes[].delay_ms",
            "remotes[].jitter_ms",
            "remotes[].return_delay_ms",
            "remotes[].return_jitter_ms",
            "remotes[].trace.file",
            "remotes[].trace.repeat",
            "remotes[].return_trace.file",
            "remotes[].return_trace.repeat",
            "remotes[].cap_kbit_per_s",
            "remotes[].impaired_at_begin",
            "events",
            "events[].at_s",
            "events[].do",
            "events[].to",
        ] {
            let documented = rows.iter().any(|row| row.contains(&format!("`{key}`")));
            assert!(documented, "{key} is not documented");
        }
    }
}
