//! `check`: checks a configuration file and shows the shared memory that it needs; explains a key.

use std::ffi::OsStr;
use std::fmt;
use std::process::ExitCode;
use std::sync::LazyLock;

use clap::builder::{PossibleValue, StringValueParser, TypedValueParser};
use clap::{Arg, Args, Command};
use serde::Serialize;
use serde_json::json;

use super::{ConfigArguments, EXIT_CONFIG, EXIT_USAGE, bad_configuration, failed, print};
use crate::config::{
    self, ConfigError, InputTopic, OutputTopic, Place, Problem, Route, Row, SetParameters, Settings,
};
use crate::model::{InstanceName, LaneName, RouteId, TopicPattern, TypeName};
use crate::process::{InForce, MemoryNeed, MemoryNeeds};
use crate::shm::{RouteChannel, budget_bytes};
use crate::telemetry::bytes_text;

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Print JSON, for the problems of a bad file too
    #[arg(long)]
    json: bool,
    /// Print what a key means, its range and default, and whether a reload applies it, such as
    /// `safety.silent_ms` or `lanes.rviz.queue_depth`; a section, such as `safety`, prints all its keys.
    /// Reads no file
    #[arg(long, value_name = "KEY", value_parser = KeyParser, hide_possible_values = true)]
    #[arg(conflicts_with_all = ["json", "config"])]
    explain: Option<String>,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    if let Some(path) = &arguments.explain {
        return explain(path);
    }
    if arguments.json {
        let (json, code) = match load(&arguments.config) {
            Ok(settings) => (json!(Summary::of(&settings)), ExitCode::SUCCESS),
            Err(error) => (problems(&error), ExitCode::from(EXIT_CONFIG)),
        };
        print(format!("{json}\n"))?;
        return Ok(code);
    }
    let settings = load(&arguments.config).map_err(|error| bad_configuration(&error))?;
    let running = InForce::find(&arguments.config.file(), Some(&settings));
    let summary = Summary::of(&settings).to_string();
    let differences = match running {
        Some(running) => {
            let file = arguments.config.try_load_with(&running.set_parameters);
            differences(&running, file.map_err(|error| bad_configuration(&error))?.settings)
        }
        None => String::new(),
    };
    print(summary + &differences)?;
    Ok(ExitCode::SUCCESS)
}

/// Reads the settings, with which ingress must be able to start.
fn load(arguments: &ConfigArguments) -> Result<Settings, ConfigError> {
    let loaded = arguments.try_load_with_budget(&SetParameters::new(), &too_small_budget);
    loaded.map(|configuration| configuration.settings)
}

/// What the budget must be, if ingress cannot start with it: the pools take more at the start.
pub(super) fn too_small_budget(settings: &Settings) -> Option<String> {
    let pools = (0..settings.routes.len()).map(|route| RouteChannel::of(settings, route).pool_size());
    let (slots, first_bytes) = pools.fold((0, 0_u64), |(slots, bytes), pool| {
        (slots + pool.slots, bytes.saturating_add(pool.first_bytes))
    });
    let budget_bytes = budget_bytes(settings);
    let default = match settings.shared_memory.budget_bytes {
        Some(_) => String::new(),
        None => format!("; on this machine it is {budget_bytes} by default"),
    };
    (first_bytes > budget_bytes).then(|| {
        format!(
            "must be at least {first_bytes}, which the {slots} slots of all routes take before a sample comes; fewer \
             routes, a lower max_sample_bytes of those with small samples, queue_depth or max_taps take less{default}"
        )
    })
}

/// Reads the path of a key, and offers all paths to the completions of a shell.
#[derive(Clone)]
struct KeyParser;

impl TypedValueParser for KeyParser {
    type Value = String;

    fn parse_ref(
        &self,
        command: &Command,
        argument: Option<&Arg>,
        value: &OsStr,
    ) -> Result<String, clap::Error> {
        // `explain` checks the path, because it need not be one of those that are offered.
        StringValueParser::new().parse_ref(command, argument, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(OFFERED_PATHS.iter().map(|path| PossibleValue::new(path.as_str()))))
    }
}

/// The paths of all keys without characters that a shell interprets: `lanes.LANE.queue_depth`, `topics.id`.
static OFFERED_PATHS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let offered = |name: &str| {
        let name = name.trim_end_matches("[]");
        let chosen = name.strip_prefix('<').and_then(|name| name.strip_suffix('>'));
        chosen.map_or_else(|| name.to_owned(), str::to_uppercase)
    };
    let path = |path: &&str| path.split('.').map(offered).collect::<Vec<_>>().join(".");
    config::KEYS.iter().map(path).collect()
});

/// Prints the declaration of a key, or of all keys of a section.
fn explain(path: &str) -> Result<ExitCode, ExitCode> {
    let keys = config::keys_at(path);
    if keys.is_empty() {
        let hint = config::nearest_key(path).map(|key| format!("; did you mean `{key}`?"));
        failed(&format!("{path} is no key of the configuration{}", hint.unwrap_or_default()));
        return Err(ExitCode::from(EXIT_USAGE));
    }
    let explained: Vec<String> = keys.iter().map(|(path, row)| explained(path, row)).collect();
    print(explained.join("\n"))?;
    Ok(ExitCode::SUCCESS)
}

fn explained(path: &str, row: &Row) -> String {
    let reload =
        if row.reloads { "applies a change" } else { "a change waits for a restart of the whole bridge" };
    format!(
        "{path}\n  {}\n  allowed: {}\n  default: {}\n  reload:  {reload}\n",
        row.documentation,
        row.range(),
        row.default
    )
}

#[derive(Serialize)]
struct Summary<'a> {
    instance: &'a InstanceName,
    lanes: Vec<&'a LaneName>,
    routes: Vec<RouteSummary<'a>>,
    /// `shared_memory.budget_bytes`, or its default on this machine.
    budget_bytes: u64,
    /// What all pools take at the start.
    first_bytes: u64,
    /// The most that they take.
    shared_memory_bytes: u64,
    memory: Vec<ProcessMemory>,
}

/// The most memory that a process may need.
#[derive(Serialize)]
struct ProcessMemory {
    process: String,
    limit_bytes: u64,
    #[serde(flatten)]
    parts: MemoryNeed,
}

impl ProcessMemory {
    fn all(settings: &Settings) -> Vec<Self> {
        let needs = MemoryNeeds::of(settings);
        let lanes = settings.lanes.iter().zip(needs.lanes).filter(|(lane, _)| lane.is_used());
        let lanes = lanes.map(|(lane, need)| (format!("egress-{}", lane.name), need));
        let all = [("ingress".to_owned(), needs.ingress)].into_iter().chain(lanes);
        all.chain([("control".to_owned(), needs.control)])
            .map(|(process, parts)| Self { process, limit_bytes: parts.limit_bytes(), parts })
            .collect()
    }
}

#[derive(Serialize)]
struct RouteSummary<'a> {
    id: &'a RouteId,
    #[serde(serialize_with = "as_text")]
    input_topic: &'a InputTopic,
    /// Of a pattern: the topics that are left out, and the number of its places.
    exclude: Option<&'a [TopicPattern]>,
    max_routes: Option<usize>,
    message_type: Option<&'a TypeName>,
    outputs: Vec<OutputSummary<'a>>,
    max_sample_bytes: usize,
    slots: usize,
    /// What the pool takes at the start.
    first_bytes: u64,
    /// What it takes if each slot has the largest sample, within the budget.
    shared_memory_bytes: u64,
}

#[derive(Serialize)]
struct OutputSummary<'a> {
    lane: &'a LaneName,
    #[serde(serialize_with = "as_text")]
    topic: &'a OutputTopic,
}

fn as_text<S: serde::Serializer>(shown: &impl fmt::Display, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(shown)
}

impl<'a> Summary<'a> {
    fn of(settings: &'a Settings) -> Self {
        let budget_bytes = budget_bytes(settings);
        let summary = |(index, route): (usize, &'a Route)| {
            let pool = RouteChannel::of(settings, index).pool_size();
            let outputs = settings.lanes.iter().filter_map(|lane| {
                let output = lane.outputs.iter().find(|output| output.route == index)?;
                Some(OutputSummary { lane: &lane.name, topic: &output.topic })
            });
            let pattern = settings.patterns.iter().find(|pattern| pattern.entry == route.entry);
            let places = pattern.map_or(1, |pattern| pattern.max_routes);
            RouteSummary {
                id: &route.entry,
                input_topic: &route.input_topic,
                exclude: pattern.map(|pattern| &pattern.exclude[..]),
                max_routes: pattern.map(|pattern| pattern.max_routes),
                message_type: route.message_type.as_ref(),
                outputs: outputs.collect(),
                max_sample_bytes: route.max_sample_bytes,
                slots: pool.slots,
                first_bytes: places as u64 * pool.first_bytes,
                shared_memory_bytes: (places as u64 * pool.bytes)
                    .min(budget_bytes.max(places as u64 * pool.first_bytes)),
            }
        };
        // The places of a pattern are equal: one entry of the file has one summary.
        let is_first =
            |index: usize| index == 0 || settings.routes[index - 1].entry != settings.routes[index].entry;
        let routes = settings.routes.iter().enumerate().filter(|(index, _)| is_first(*index));
        let routes: Vec<_> = routes.map(summary).collect();
        Self {
            instance: &settings.instance,
            lanes: settings.lanes.iter().map(|lane| &lane.name).collect(),
            budget_bytes,
            first_bytes: routes.iter().map(|route| route.first_bytes).sum(),
            shared_memory_bytes: budget_bytes.min(routes.iter().map(|route| route.shared_memory_bytes).sum()),
            routes,
            memory: ProcessMemory::all(settings),
        }
    }
}

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "instance {}: {} routes, {} lanes", self.instance, self.routes.len(), self.lanes.len())?;
        for route in &self.routes {
            let from_dds = || "type from DDS discovery".to_owned();
            let message_type = route.message_type.map_or_else(from_dds, ToString::to_string);
            writeln!(f, "\nroute {}: {} ({message_type})", route.id, route.input_topic)?;
            for output in &route.outputs {
                writeln!(f, "  {} -> {}", output.lane, output.topic)?;
            }
            let mut places = String::new();
            if let Some(max_routes) = route.max_routes {
                let excluded: Vec<String> =
                    route.exclude.unwrap_or_default().iter().map(ToString::to_string).collect();
                let excluded = if excluded.is_empty() { "none".to_owned() } else { excluded.join(", ") };
                writeln!(f, "  a pattern: at most {max_routes} topics at once; excluded: {excluded}")?;
                places = format!("{max_routes} times ");
            }
            writeln!(
                f,
                "  shared memory: {places}{} slots for samples of up to {}: {} at the start, at most {}",
                route.slots,
                bytes_text(route.max_sample_bytes as f64),
                bytes_text(route.first_bytes as f64),
                bytes_text(route.shared_memory_bytes as f64)
            )?;
        }
        writeln!(
            f,
            "\ntotal shared memory: {} at the start, at most {} of a budget of {}",
            bytes_text(self.first_bytes as f64),
            bytes_text(self.shared_memory_bytes as f64),
            bytes_text(self.budget_bytes as f64)
        )?;
        writeln!(f, "\nmost memory of each process, the limit that `adaptive-bridge units` sets:")?;
        for memory in &self.memory {
            let parts = memory.parts.parts();
            let parts = parts.iter().filter(|(_, bytes)| *bytes > 0);
            let parts: Vec<_> =
                parts.map(|(name, bytes)| format!("{name} {}", bytes_text(*bytes as f64))).collect();
            let limit = bytes_text(memory.limit_bytes as f64);
            writeln!(f, "  {:<20} {limit}: {}", memory.process, parts.join(", "))?;
        }
        Ok(())
    }
}

/// Lists the differences between the configuration in force and the file.
fn differences(running: &Settings, file: Settings) -> String {
    let (_, reload) = running.reloaded(file);
    let mut text = String::new();
    for change in &reload.changed {
        text += &format!("waits for a reload: {change}\n");
    }
    for change in &reload.waits {
        text += &format!("waits for a restart of the whole bridge: {change}\n");
    }
    if !text.is_empty() {
        text.insert_str(0, "\nthe configuration in force in the running bridge differs from this file:\n");
    }
    text
}

fn problems(error: &ConfigError) -> serde_json::Value {
    let problem = |problem: &Problem| {
        let (place, line) = match problem.place {
            Place::Environment => ("environment", None),
            Place::File => ("file", None),
            Place::Line(line) => ("file", Some(line)),
            Place::Parameter { line: 0, .. } => ("parameter", None),
            Place::Parameter { line, .. } => ("parameter", Some(line)),
        };
        let file = match problem.place {
            Place::Environment => None,
            Place::File | Place::Line(_) => Some(error.file.clone()),
            Place::Parameter { source, .. } => {
                error.parameter_files.get(source).and_then(|file| Some(file.as_ref()?.display().to_string()))
            }
        };
        let Problem { key, value, allowed, hint, .. } = problem;
        json!({
            "place": place, "file": file, "line": line, "key": key, "value": value, "allowed": allowed,
            "hint": hint
        })
    };
    let problems: Vec<_> = error.problems.iter().map(problem).collect();
    json!({ "file": error.file, "problems": problems })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(yaml: &str) -> Result<Settings, ConfigError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), yaml).unwrap();
        load(&ConfigArguments { config: Some(file.path().to_owned()), parameters: Vec::new() })
    }

    #[test]
    fn a_budget_with_which_ingress_cannot_start_is_a_problem_of_its_line() {
        let route = "topics: [{id: scan, input_topic: /scan}]\n";
        let with_budget = |bytes: u64, depth| {
            format!(
                "{route}lanes: {{critical: {{queue_depth: {depth}}}}}\nshared_memory:\n  budget_bytes: {bytes}\n"
            )
        };
        let settings = checked(&with_budget(1 << 30, 4096)).unwrap();
        let needed = RouteChannel::of(&settings, 0).pool_size().first_bytes;
        assert!(checked(&with_budget(needed, 4096)).is_ok());
        let error = checked(&with_budget(needed - 1, 4096)).unwrap_err();
        let [problem] = &error.problems[..] else { panic!("{error}") };
        assert_eq!((problem.place, problem.key.as_str()), (Place::Line(4), "shared_memory.budget_bytes"));
        assert_eq!(problem.value, Some((needed - 1).to_string()));
        assert!(problem.allowed.starts_with(&format!("must be at least {needed}, which")), "{error}");
        assert!(problem.allowed.ends_with("take less"), "{error}");
        // Without a budget in the file, no default is enough for 1,024 such routes: 4 KiB for each of 4
        // million slots.
        let routes: String =
            (0..1024).map(|route| format!("- {{id: r{route}, input_topic: /r{route}}}\n")).collect();
        let yaml = format!("topics:\n{routes}lanes: {{critical: {{queue_depth: 4096}}}}\n");
        let error = checked(&yaml).unwrap_err();
        let expected = "shared_memory.budget_bytes: must be given: at least ";
        assert!(error.to_string().contains(expected), "{error}");
        assert!(error.to_string().ends_with(" by default"), "{error}");
        assert!(checked(route).is_ok());
    }
}
