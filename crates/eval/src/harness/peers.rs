//! The publishers and subscribers of a run.

use std::collections::BTreeMap;
use std::path::Path;

use super::manifest::EndpointEntry;
use super::pinned;
use super::plan::Plan;
use super::program::Program;
use super::settings::{Library, Settings};
use crate::bed::Bed;
use crate::error::EvalError;
use crate::scenario::{ReaderHistory, Scenario, Variant};

/// The paper's limit of the writer's history in Fast DDS; also used for RustDDS.
const WRITER_MAX_SAMPLES: &str = "200";
/// How long a write may block. The default of Fast DDS is 100 ms; with Cyclone DDS, ROS 2 sets no limit, and
/// the paper neither (section V-C). The peer accepts at most 1,000 s.
const CYCLONE_MAX_BLOCKING_MS: &str = "1000000";

/// The paper's settings of Cyclone DDS: data by unicast, and a fixed writer history cache of 600 KiB.
const CYCLONE_URI: &str = "<General><AllowMulticast>spdp</AllowMulticast></General><Internal><Watermarks>\
     <WhcHigh>600 KiB</WhcHigh><WhcHighInit>600 KiB</WhcHighInit><WhcAdaptive>false</WhcAdaptive>\
     </Watermarks></Internal>";

/// How long a publisher continues after the end of the window, in seconds.
const AFTER_END_S: f64 = 0.2;

/// A running publisher or subscriber.
pub(super) struct Endpoint {
    pub entry: EndpointEntry,
    pub program: Program,
}

/// The role of an endpoint in a run.
enum Role<'a> {
    Publisher,
    Critical,
    Slow { lane: &'a str },
}

/// Starts the subscribers of all routes, and publishers that wait for SIGUSR1 to start publishing.
pub(super) fn start(
    plan: &Plan,
    settings: &Settings,
    bed: &Bed,
    folder: &Path,
    duration_s: f64,
) -> Result<Vec<Endpoint>, EvalError> {
    let scenario = &plan.scenario;
    let mut endpoints = Vec::new();
    for route in 0..scenario.workload.routes {
        let mut start = |host: &str, role: &Role| -> Result<(), EvalError> {
            let name = scenario.endpoint_name(host, route);
            let (entry, program) = endpoint(plan, settings, name, host, route, role, (folder, duration_s))?;
            let mut command = pinned(settings, bed.host(host)?, &program);
            command.args(&entry.command_line[1..]).envs(&entry.environment);
            let program = Program::start(&entry.name, command, &folder.join("logs"))?;
            endpoints.push(Endpoint { entry, program });
            Ok(())
        };
        start("critical", &Role::Critical)?;
        for remote in &scenario.remotes {
            start(&remote.name, &Role::Slow { lane: &remote.lane })?;
        }
        start("publisher", &Role::Publisher)?;
    }
    Ok(endpoints)
}

/// Returns the manifest entry of an endpoint, with its command line, and the path of its program.
fn endpoint(
    plan: &Plan,
    settings: &Settings,
    name: String,
    host: &str,
    route: usize,
    role: &Role,
    (folder, duration_s): (&Path, f64),
) -> Result<(EndpointEntry, std::path::PathBuf), EvalError> {
    let scenario = &plan.scenario;
    let workload = &scenario.workload;
    let lane = match (scenario.variant, role) {
        (Variant::Baseline, _) | (_, Role::Publisher) => None,
        (Variant::Bridge, Role::Critical) => Some("critical".to_owned()),
        (Variant::Bridge, Role::Slow { lane }) => Some((*lane).to_owned()),
    };
    let topic = dds_topic(scenario, route, lane.as_deref());
    let (role_name, reliable, keep_all) = match role {
        Role::Publisher => ("publisher", true, true),
        Role::Critical => ("critical", true, workload.critical_history == ReaderHistory::KeepAll),
        // The noncritical lanes offer BEST_EFFORT.
        Role::Slow { .. } if lane.is_some() => ("slow", false, false),
        Role::Slow { .. } => ("slow", true, workload.slow_history == ReaderHistory::KeepAll),
    };

    let program = settings.peer(plan.library)?;
    let record = folder.join(format!("{name}.csv"));
    let mut arguments: Vec<String> = vec![program.display().to_string()];
    let mut add = |option: &str, value: &str| arguments.extend([option.to_owned(), value.to_owned()]);
    add("--role", if matches!(role, Role::Publisher) { "pub" } else { "sub" });
    add("--topic", &topic);
    add("--type", &workload.dds_type());
    add("--reliability", if reliable { "r" } else { "be" });
    add("--history", if keep_all { "all" } else { "10" });
    add("--size", &workload.size_bytes.to_string());
    add("--record", &record.display().to_string());
    if matches!(role, Role::Publisher) {
        let readers = match scenario.variant {
            Variant::Baseline => 1 + scenario.remotes.len(),
            Variant::Bridge => 1,
        };
        add("--wait-match", &readers.to_string());
        add("--rate", &workload.rate_hz.to_string());
        add("--duration", &(settings.settle_s() + duration_s + AFTER_END_S).to_string());
        match plan.library {
            Library::Cyclone => add("--max-blocking-ms", CYCLONE_MAX_BLOCKING_MS),
            Library::Fast | Library::Rust => add("--max-samples", WRITER_MAX_SAMPLES),
        }
        arguments.extend(["--hold".to_owned(), "--prime".to_owned()]);
    }
    arguments.push("--summary".to_owned());

    let mut environment = BTreeMap::new();
    if plan.library == Library::Cyclone {
        environment.insert("CYCLONEDDS_URI".to_owned(), CYCLONE_URI.to_owned());
    }
    let entry = EndpointEntry {
        name,
        role: role_name,
        route,
        host: host.to_owned(),
        lane,
        topic,
        rate_hz: workload.rate_hz,
        size_bytes: workload.size_bytes,
        reliability: if reliable { "RELIABLE" } else { "BEST_EFFORT" },
        history: if keep_all { "KEEP_ALL" } else { "KEEP_LAST 10" },
        library: plan.library.name(),
        command_line: arguments,
        environment,
        summary: None,
    };
    Ok((entry, program))
}

/// The DDS topic of a route's output on a lane, or of its input.
fn dds_topic(scenario: &Scenario, route: usize, lane: Option<&str>) -> String {
    let name = scenario.route_name(route);
    match lane {
        None => format!("rt/{name}"),
        Some(lane) => format!("rt/adaptive_bridge/{lane}/{name}"),
    }
}
