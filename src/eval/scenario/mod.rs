//! Scenarios: what is run, with what load, over what links, and what is done to it meanwhile. A YAML file
//! each.

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

impl Variant {
    /// The host that sends to the remote subscribers.
    pub const fn sender(self) -> &'static str {
        match self {
            Self::Baseline => "publisher",
            Self::Bridge => "bridge",
        }
    }
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
    /// History of the local, critical subscriber.
    pub critical_history: ReaderHistory,
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
            critical_history: ReaderHistory::KeepLast10,
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
    /// What is lost and how long it takes on the way to it, from time to time, in place of the above.
    #[serde(default)]
    pub trace: Option<TraceFile>,
    /// The same on the way back.
    #[serde(default)]
    pub return_trace: Option<TraceFile>,
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
        self.level != Level::Clean || self.delay_ms > 0.0 || self.jitter_ms > 0.0 || self.trace.is_some()
    }

    /// Whether packets from it are delayed or lost.
    pub fn is_impaired_back(&self) -> bool {
        self.return_delay_ms > 0.0 || self.return_jitter_ms > 0.0 || self.return_trace.is_some()
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
        Self::parse_in(path.parent().unwrap_or(Path::new("")), &name, &text)
            .map_err(|problems| EvalError::new(format!("{}: {}", path.display(), problems.join("\n  "))))
    }

    /// Reads a scenario of that name, whose files are in the present folder.
    ///
    /// # Errors
    /// What is wrong with it: that it is no scenario, or every value that can't be.
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

#[cfg(test)]
mod tests {
    use super::*;

    const LEAST: &str = "title: a\nvariant: bridge\nduration_s: 10\nremotes:\n  - {name: slow}\n";

    fn scenarios() -> Vec<Scenario> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/config/scenarios");
        Scenario::load_all(folder.as_ref()).unwrap_or_else(|error| panic!("{error}"))
    }

    #[test]
    fn every_scenario_of_the_paper_is_there_and_all_are_valid() {
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
    fn the_least_is_the_papers_workload_on_the_plain_switch() {
        let scenario = Scenario::parse("a", LEAST).expect("valid");
        assert_eq!((scenario.switches, scenario.workload.rate_hz), (vec![Switch::Plain], 30.0));
        assert_eq!(Workload::default().dds_type(), "sensor_msgs::msg::dds_::LaserScan_");
        assert!(!Scenario::parse("a", LEAST).expect("valid").has_readings());
    }

    #[test]
    fn lanes_and_processes_are_those_of_the_remote_subscribers() {
        let text = LEAST.replace("{name: slow}", "{name: slow}\n  - {name: laptop, lane: rviz}");
        let scenario = Scenario::parse("a", &text).expect("valid");
        assert_eq!(scenario.lanes(), ["critical", "noncritical", "rviz"]);
        assert!(scenario.bridge_processes().contains(&"egress-rviz".to_owned()));
        assert_eq!((scenario.endpoint_name("slow", 0), scenario.endpoint_name("slow", 1)), {
            ("slow".to_owned(), "slow-2".to_owned())
        });
    }

    #[test]
    fn what_is_wrong_is_said_all_at_once() {
        for (from, to, said) in [
            ("duration_s: 10", "duration_s: 0", "duration_s is 0, and may be 1 to 86400"),
            ("duration_s: 10", "duration_s: .nan", "duration_s is NaN"),
            ("variant: bridge", "variant: bridges", "bridges"),
            ("title: a", "titel: a", "titel"),
            ("{name: slow}", "{name: bridge}", "remotes[0].name is 'bridge', which is taken"),
            ("{name: slow}", "{name: 'a b'}", "remotes[0].name is 'a b', and may be"),
            ("{name: slow}", "{name: slow}\n  - {name: slow}", "remotes[1].name is 'slow', which is taken"),
            ("{name: slow}", "{name: slow, lane: critical}", "which is for the local subscriber"),
            ("{name: slow}", "{name: slow, delay_ms: -1}", "remotes[0].delay_ms is -1"),
            ("{name: slow}", "{name: slow, cap_kbit_per_s: 1}", "remotes[0].cap_kbit_per_s is 1"),
            (
                "{name: slow}",
                "{name: slow, jitter_ms: 1, trace: {file: Cargo.toml}}",
                "remotes[0].trace takes the place of level, delay_ms and jitter_ms",
            ),
            (
                "{name: slow}",
                "{name: slow, return_delay_ms: 1, return_trace: {file: Cargo.toml}}",
                "remotes[0].return_trace takes the place of return_delay_ms and return_jitter_ms",
            ),
            ("{name: slow}", "{name: slow, trace: {file: Cargo.toml}}", "Cargo.toml:1: there is no header"),
            ("{name: slow}", "{name: slow, trace: {file: nowhere.csv}}", "nowhere.csv: No such file"),
            ("{name: slow}", "{name: slow, trace: {file: a.csv, loop: true}}", "loop"),
            ("title: a", "title: a\nswitches: []", "switches is empty"),
            ("title: a", "title: a\nworkload: {routes: 0}", "workload.routes is 0"),
            ("title: a", "title: a\nworkload: {message_type: LaserScan}", "workload.message_type"),
            ("title: a", "title: a\nevents: [{at_s: 11, do: stop, to: slow}]", "events[0].at_s is 11"),
            ("title: a", "title: a\nevents: [{at_s: 1, do: kill, to: up}]", "events[0].to is 'up'"),
            ("title: a", "title: a\nevents: [{at_s: 1, do: kill, to: slow}]", "kill can be done to ingress"),
            (
                "title: a",
                "title: a\nevents: [{at_s: 1, do: link_on, to: critical}]",
                "link_on can be done to slow",
            ),
            (
                "title: a",
                "title: a\nevents: [{at_s: 2, do: stop, to: slow}, {at_s: 1, do: stop, to: slow}]",
                "not in the order",
            ),
        ] {
            let problems = Scenario::parse("a", &LEAST.replace(from, to)).expect_err(to).join("\n");
            assert!(problems.contains(said), "{to}: {problems}");
        }
        let text = LEAST.replace("duration_s: 10", "duration_s: 0").replace("slow", "up");
        assert_eq!(Scenario::parse("a", &text).expect_err("two problems").len(), 2);
        assert!(Scenario::parse("a", "").is_err());
        assert!(Scenario::load("/nowhere/a.yaml".as_ref()).is_err());
        assert!(Scenario::load_all("/nowhere".as_ref()).is_err());
    }

    #[test]
    fn every_key_is_documented() {
        let page = include_str!("../../../config/scenarios/README.md");
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
