//! The bridge of a run: starts its programs as a user does, and records its status.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

use super::pinned;
use super::plan::Plan;
use super::program::Program;
use super::settings::Settings;
use crate::bed::{Bed, Host, stale};
use crate::error::EvalError;
use crate::scenario::Scenario;

/// The configured maximum size of a sample is its payload plus this: the minimum that a route may have, and
/// enough for the message around the payload.
const SAMPLE_ROOM_BYTES: u64 = 65_536;

/// A bridge and the responders of its remote subscribers.
pub(super) struct Bridge {
    up: Program,
    responders: Vec<Program>,
    /// The running `status --watch`, once the bridge is up.
    watch: Option<Program>,
    program: PathBuf,
    config: PathBuf,
    latest: Value,
    /// The status of each second, as a line of JSON.
    record: BufWriter<File>,
    record_path: PathBuf,
}

impl Bridge {
    /// Starts the bridge and the responders.
    pub fn start(plan: &Plan, settings: &Settings, bed: &Bed, folder: &Path) -> Result<Self, EvalError> {
        let config = folder.join("bridge.yaml");
        fs::write(&config, configuration(&plan.scenario))
            .map_err(|error| EvalError::file(&config, &error))?;
        let logs = folder.join("logs");
        let host = bed.host("bridge")?;
        let mut command = pinned(settings, host, &settings.bridge);
        command.arg("up").arg("--config").arg(&config);
        let up = Program::start("up", command, &logs)?;
        let mut responders = Vec::new();
        for remote in &plan.scenario.remotes {
            let mut command = pinned(settings, bed.host(&remote.name)?, &settings.bridge);
            command.args(["responder", "--id", &remote.name]);
            responders.push(Program::start(&format!("responder-{}", remote.name), command, &logs)?);
        }
        let record_path = folder.join("status.jsonl");
        let record = File::create(&record_path).map_err(|error| EvalError::file(&record_path, &error))?;
        let record = BufWriter::new(record);
        let program = settings.bridge.clone();
        Ok(Self { up, responders, watch: None, program, config, latest: Value::Null, record, record_path })
    }

    fn status(&self, host: &Host, arguments: &[&str]) -> Command {
        let mut command = host.command(&self.program);
        command.args(["status", "--json"]).args(arguments).arg("--config").arg(&self.config);
        command
    }

    /// Whether every process runs; once that is so, starts to watch the status.
    pub fn is_up(&mut self, host: &Host, folder: &Path) -> Result<bool, EvalError> {
        if self.watch.is_some() {
            return Ok(true);
        }
        let mut command = self.status(host, &["--interval-ms", "50"]);
        let output = command.stdin(Stdio::null()).output();
        let output = output.map_err(|error| EvalError::file(&self.program, &error))?;
        let status: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        let processes = status["processes"].as_array();
        if processes.is_none_or(|list| list.is_empty() || list.iter().any(|it| it["state"] != "running")) {
            return Ok(false);
        }
        let command = self.status(host, &["--watch", "--interval-ms", "1000"]);
        self.watch = Some(Program::start("status", command, &folder.join("logs"))?);
        Ok(true)
    }

    /// Records the status lines since the last call.
    pub fn sample(&mut self) -> Result<(), EvalError> {
        for (time, status) in self.watch.as_mut().map(Program::read_lines).unwrap_or_default() {
            writeln!(self.record, "{}", json!({ "time_ns": time.0, "status": status }))
                .map_err(|error| EvalError::file(&self.record_path, &error))?;
            self.latest = status;
        }
        Ok(())
    }

    /// Whether all readers of each lane of each route are matched, and every responder has answered a probe.
    pub fn is_matched(&self, scenario: &Scenario) -> bool {
        let expected = |lane: &Value| match lane.as_str() {
            Some("critical") => 1,
            name => scenario.remotes.iter().filter(|remote| Some(remote.lane.as_str()) == name).count(),
        };
        let routes = self.latest["routes"].as_array().map(Vec::as_slice).unwrap_or_default();
        let lanes = routes.iter().flat_map(|route| route["lanes"].as_array().into_iter().flatten());
        let mut lanes = lanes.peekable();
        let matched = lanes.peek().is_some()
            && lanes.all(|lane| lane["readers"].as_u64() >= Some(expected(&lane["lane"]) as u64));
        let subscribers = self.latest["subscribers"].as_array().map(Vec::as_slice).unwrap_or_default();
        let answered = subscribers.iter().filter(|subscriber| subscriber["last_response_age_ms"].is_number());
        matched && answered.count() >= scenario.remotes.len()
    }

    /// The bridge's processes listed in its status, its supervisor and the responders.
    pub fn processes(&self) -> Vec<(String, i32)> {
        let listed = self.latest["processes"].as_array().map(Vec::as_slice).unwrap_or_default();
        let roles = listed.iter().filter_map(|process| {
            let pid = i32::try_from(process["pid"].as_i64()?).ok().filter(|pid| *pid > 0)?;
            Some((process["name"].as_str()?.to_owned(), pid))
        });
        let own = std::iter::once(&self.up).chain(&self.responders);
        own.map(|program| (program.name.clone(), program.pid().as_raw())).chain(roles).collect()
    }

    /// The programs that must not end during the run.
    pub fn programs(&mut self) -> impl Iterator<Item = &mut Program> {
        std::iter::once(&mut self.up).chain(&mut self.responders).chain(self.watch.as_mut())
    }

    /// Stops all programs; returns the problems.
    pub fn end(mut self) -> Result<Vec<String>, EvalError> {
        self.sample()?;
        self.record.flush().map_err(|error| EvalError::file(&self.record_path, &error))?;
        let mut problems = Vec::new();
        let watch = self.watch.as_mut();
        for program in watch.into_iter().chain(&mut self.responders).chain(std::iter::once(&mut self.up)) {
            if !program.end(Duration::from_secs(10)) {
                problems.push(format!("{} did not end cleanly on SIGTERM; see its log", program.name));
            }
        }
        Ok(problems)
    }
}

/// Stops the processes, then removes the shared memory that they use.
impl Drop for Bridge {
    fn drop(&mut self) {
        for program in std::iter::once(&mut self.up).chain(&mut self.responders) {
            program.end(Duration::from_secs(3));
        }
        stale::remove_own_bridge();
    }
}

/// The bridge's configuration for the routes and remote subscribers of a scenario, with default settings, but
/// for standbys: the CPU time of a role is that of one process, and no process of a scenario ends.
fn configuration(scenario: &Scenario) -> String {
    let workload = &scenario.workload;
    let mut yaml = format!("instance: {}\nros: {{domain_id: 0}}\ntopics:\n", stale::instance());
    for route in 0..workload.routes {
        let name = scenario.route_name(route);
        let room = workload.size_bytes + SAMPLE_ROOM_BYTES;
        let _ = writeln!(
            yaml,
            "  - {{id: {name}, input_topic: /{name}, message_type: {}, max_sample_bytes: {room}}}",
            workload.message_type
        );
    }
    // The paper's noncritical lanes repair nothing.
    let noncritical = scenario.lanes().into_iter().filter(|lane| lane != "critical");
    let noncritical: Vec<String> =
        noncritical.map(|lane| format!("{lane}: {{qos: {{reliability: BEST_EFFORT}}}}")).collect();
    let _ = writeln!(yaml, "lanes: {{critical: {{standby: none}}, {}}}", noncritical.join(", "));
    let _ = writeln!(yaml, "processes: {{ingress: {{standby: none}}}}");
    let remotes = scenario.remotes.iter();
    let remotes: Vec<String> =
        remotes.map(|remote| format!("{}: {{lane: {}}}", remote.name, remote.lane)).collect();
    let _ = writeln!(yaml, "subscribers: {{{}}}", remotes.join(", "));
    let _ = writeln!(yaml, "classifier: {{enabled: {}}}", scenario.classifier);
    let _ = writeln!(yaml, "shared_memory: {{root_path: {}}}", stale::folder().display());
    yaml
}
