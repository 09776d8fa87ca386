//! Executes one run, from creating its hosts to writing its results.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::model::MonotonicNs;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::bridge::Bridge;
use super::csv::Csv;
use super::links::Links;
use super::machine::{Machine, Software};
use super::manifest::{FORMAT, Manifest, PortEntry};
use super::peers::{self, Endpoint};
use super::plan::Plan;
use super::progress::Progress;
use super::sampler::{Sampler, queue_drops};
use super::settings::Settings;
use crate::bed::{Bed, Host};
use crate::error::EvalError;
use crate::scenario::{Action, Event, Scenario, Variant};

/// Timeout of each step before the window, such as matching.
const SET_UP_TIMEOUT_S: f64 = 60.0;
/// Timeout of publishers after the end of the window: 10 s for acknowledgements, and time for a blocked
/// write.
const PUBLISHER_TIMEOUT_S: f64 = 30.0;
/// Timeout of a program after SIGTERM.
const END_TIMEOUT: Duration = Duration::from_secs(5);
const TICK: Duration = Duration::from_millis(20);
const SAMPLE_MS: u64 = 1_000;

/// Executes one run. When it returns without an error, the results are in `folder`.
pub(super) fn run(
    plan: &Plan,
    settings: &Settings,
    folder: &Path,
    interrupted: &AtomicBool,
    progress: &mut Progress,
) -> Result<(), EvalError> {
    let logs = folder.join("logs");
    fs::create_dir_all(&logs).map_err(|error| EvalError::file(&logs, &error))?;
    let scenario_file = folder.join("scenario.yaml");
    fs::write(&scenario_file, &plan.scenario.text)
        .map_err(|error| EvalError::file(&scenario_file, &error))?;
    for (name, trace) in plan.scenario.traces() {
        let path = folder.join(name);
        fs::write(&path, &trace.text).map_err(|error| EvalError::file(&path, &error))?;
    }
    let machine = Machine::read();
    progress.phase("creating the hosts");
    let shared = shared_folders(settings, folder);
    let shared: Vec<&Path> = shared.iter().map(PathBuf::as_path).collect();
    // Declared before the run, so that it is dropped last: programs end before their hosts are removed.
    let sender = plan.scenario.variant.sender();
    let bed = plan.bed.make(&host_names(&plan.scenario), sender, plan.switch, &shared)?;
    let mut run = Run::start(plan, settings, folder, &bed, interrupted)?;
    run.match_all(progress)?;
    let (begin, end) = run.measure(progress)?;
    progress.phase("waiting for the last acknowledgements");
    run.await_publishers()?;
    run.finish(&machine.read_again(), begin, end)
}

/// The hosts of a scenario, in the order of their addresses.
fn host_names(scenario: &Scenario) -> Vec<String> {
    let bridge = (scenario.variant == Variant::Bridge).then_some("bridge");
    let fixed = ["publisher"].into_iter().chain(bridge).chain(["critical"]);
    fixed.map(str::to_owned).chain(scenario.remotes.iter().map(|remote| remote.name.clone())).collect()
}

/// The folders that programs need on hosts with a separate file system.
fn shared_folders(settings: &Settings, folder: &Path) -> Vec<PathBuf> {
    let programs = [&settings.bridge, &settings.harness].into_iter();
    let programs = programs.filter_map(|program| program.parent().map(Path::to_owned));
    programs.chain([settings.peers.clone(), folder.to_owned()]).collect()
}

/// A run in progress. Fields are dropped in this order: the endpoints first, then the links, then the bridge,
/// so that endpoints do not record effects of the end.
struct Run<'a> {
    plan: &'a Plan,
    settings: &'a Settings,
    folder: &'a Path,
    bed: &'a Bed,
    interrupted: &'a AtomicBool,
    endpoints: Vec<Endpoint>,
    links: Links,
    bridge: Option<Bridge>,
    sampler: Sampler,
    events: Csv,
    next_sample: MonotonicNs,
}

impl<'a> Run<'a> {
    fn start(
        plan: &'a Plan,
        settings: &'a Settings,
        folder: &'a Path,
        bed: &'a Bed,
        interrupted: &'a AtomicBool,
    ) -> Result<Self, EvalError> {
        let bridge = match plan.scenario.variant {
            Variant::Bridge => Some(Bridge::start(plan, settings, bed, folder)?),
            Variant::Baseline => None,
        };
        let links = Links::open(plan, settings, bed, folder)?;
        let remotes: Vec<&str> = plan.scenario.remotes.iter().map(|remote| remote.name.as_str()).collect();
        let sampler = Sampler::open(bed, &remotes, folder)?;
        let events = Csv::create(folder, "events.csv", "time_ns,event,subject")?;
        let next_sample = clock::monotonic();
        let endpoints = Vec::new();
        Ok(Self {
            plan,
            settings,
            folder,
            bed,
            interrupted,
            endpoints,
            links,
            bridge,
            sampler,
            events,
            next_sample,
        })
    }

    /// Waits for links and bridge, starts the endpoints and waits until all of them are matched.
    fn match_all(&mut self, progress: &mut Progress) -> Result<(), EvalError> {
        progress.phase("starting the links");
        self.wait("the links", |run| Ok(run.links.are_ready()))?;
        if self.bridge.is_some() {
            progress.phase("starting the bridge");
            let bridge_host = self.bed.host("bridge")?.clone();
            self.wait("the bridge", |run| run.bridge_is_up(&bridge_host))?;
        }
        progress.phase("matching");
        let duration_s = self.plan.duration_s(self.settings.quick);
        self.endpoints = peers::start(self.plan, self.settings, self.bed, self.folder, duration_s)?;
        let readers = match self.plan.scenario.variant {
            Variant::Baseline => 1 + self.plan.scenario.remotes.len(),
            Variant::Bridge => 1,
        };
        self.wait("publishers and subscribers to match", |run| {
            let matched = run.endpoints.iter_mut().all(|endpoint| {
                let expected = if endpoint.entry.role == "publisher" { readers } else { 1 };
                let matched = endpoint.program.latest("matched").and_then(|line| line["current"].as_u64());
                matched >= Some(expected as u64)
            });
            Ok(matched && run.bridge.as_ref().is_none_or(|it| it.is_matched(&run.plan.scenario)))
        })
    }

    fn bridge_is_up(&mut self, host: &Host) -> Result<bool, EvalError> {
        match &mut self.bridge {
            Some(bridge) => bridge.is_up(host, self.folder),
            None => Ok(true),
        }
    }

    /// Starts the publishers and applies the scenario's events; returns the measured window.
    fn measure(&mut self, progress: &mut Progress) -> Result<(MonotonicNs, MonotonicNs), EvalError> {
        self.publishers().for_each(|publisher| publisher.program.signal(Signal::SIGUSR1));
        self.wait("the first samples", |run| {
            Ok(run.publishers().all(|publisher| publisher.program.latest("progress").is_some()))
        })?;
        let quick = self.settings.quick;
        let duration_s = self.plan.duration_s(quick);
        progress.phase("settling");
        let begin = after(clock::monotonic(), self.settings.settle_s());
        self.wait_until(begin, |_| {})?;

        self.record_event(begin, "begin", "")?;
        for remote in &self.plan.scenario.remotes {
            // A link that is never impaired and has no event needs no record.
            let has_event =
                self.plan.scenario.events.iter().any(|it| it.action.is_of_link() && it.to == remote.name);
            let impaired =
                remote.is_impaired() || remote.is_impaired_back() || remote.cap_kbit_per_s.is_some();
            if remote.impaired_at_begin && (impaired || has_event) {
                self.apply(&Event { at_s: 0.0, action: Action::LinkOn, to: remote.name.clone() })?;
            }
        }
        let plan = self.plan;
        for event in &plan.scenario.events {
            let due = after(begin, plan.at_s(event.at_s, quick));
            self.wait_until(due, |now| progress.time(begin, now, duration_s))?;
            self.apply(event)?;
        }
        let end = after(begin, duration_s);
        self.wait_until(end, |now| progress.time(begin, now, duration_s))?;
        self.record_event(end, "end", "")?;
        Ok((begin, end))
    }

    /// Applies and records an event.
    fn apply(&mut self, event: &Event) -> Result<(), EvalError> {
        match event.action {
            action if action.is_of_link() => self.links.switch(self.bed, &event.to, action)?,
            action => {
                let signal = match action {
                    Action::Stop => Signal::SIGSTOP,
                    Action::Continue => Signal::SIGCONT,
                    _ => Signal::SIGKILL,
                };
                let mut processes = self.processes().into_iter();
                let found = processes.find(|(name, _)| *name == event.to);
                let (name, pid) =
                    found.ok_or_else(|| EvalError::new(format!("there is no process {}", event.to)))?;
                kill(Pid::from_raw(pid), signal)
                    .map_err(|error| EvalError::new(format!("{signal} to {name} ({pid}): {error}")))?;
            }
        }
        self.record_event(clock::monotonic(), event.action.name(), &event.to)
    }

    fn record_event(&mut self, time: MonotonicNs, event: &str, subject: &str) -> Result<(), EvalError> {
        self.events.row(&[&time.0, &event, &subject])
    }

    /// Waits until each publisher has received its acknowledgements, or its wait for them has timed out.
    fn await_publishers(&mut self) -> Result<(), EvalError> {
        let deadline = after(clock::monotonic(), PUBLISHER_TIMEOUT_S);
        while clock::monotonic() < deadline
            && !self.publishers().all(|publisher| publisher.program.latest("summary").is_some())
        {
            self.turn()?;
        }
        Ok(())
    }

    /// Stops all programs in order, and writes the manifest.
    fn finish(self, machine: &Machine, begin: MonotonicNs, end: MonotonicNs) -> Result<(), EvalError> {
        let Self { plan, settings, folder, bed, mut endpoints, links, bridge, sampler, mut events, .. } =
            self;
        let mut problems = Vec::new();
        let mut software = Software::read(bridge.is_some().then_some(settings.bridge.as_path()));
        // Publishers first, so that no subscriber ends while a publisher still writes.
        endpoints.sort_by_key(|endpoint| endpoint.entry.role != "publisher");
        let mut entries = Vec::with_capacity(endpoints.len());
        for Endpoint { mut entry, mut program } in endpoints {
            program.end(END_TIMEOUT);
            entry.summary = program.wait_for_last("summary");
            if entry.summary.is_none() {
                problems.push(format!("{} did not end on SIGTERM and was killed", entry.name));
            }
            let library = program.latest("ready").and_then(|ready| ready["library"].as_str());
            software.peer = software.peer.or(library.map(str::to_owned));
            entries.push(entry);
        }
        let (links, link_problems) = links.end()?;
        problems.extend(link_problems);
        if let Some(bridge) = bridge {
            problems.extend(bridge.end()?);
        }
        sampler.end()?;
        events.flush()?;
        let wall_now_ms = clock::wall().0 / 1_000_000;
        let since_begin_ms = clock::monotonic().since(begin) / 1_000_000;
        let manifest = Manifest {
            format: FORMAT,
            run: &plan.name(),
            scenario: &plan.scenario.name,
            title: &plan.scenario.title,
            variant: plan.scenario.variant,
            level: plan.scenario.remotes[0].level,
            library: plan.library.name(),
            reading: plan.reading,
            bed: plan.bed,
            switch: plan.switch,
            quick: settings.quick,
            repetition: plan.repetition,
            seed: settings.seed,
            duration_s: plan.duration_s(settings.quick),
            settle_s: settings.settle_s(),
            begin_ns: begin.0,
            end_ns: end.0,
            begin_unix_ms: wall_now_ms.saturating_sub(since_begin_ms),
            classifier: (plan.scenario.variant == Variant::Bridge).then_some(plan.scenario.classifier),
            machine,
            software,
            command_line: settings.command_line.clone(),
            pins: settings.pins.clone(),
            endpoints: entries,
            links,
            ports: ports(bed),
            problems,
        };
        let path = folder.join("manifest.json");
        let text = serde_json::to_string_pretty(&manifest)
            .map_err(|error| EvalError::new(format!("the manifest: {error}")))?;
        fs::write(&path, text + "\n").map_err(|error| EvalError::file(&path, &error))
    }

    fn publishers(&mut self) -> impl Iterator<Item = &mut Endpoint> {
        self.endpoints.iter_mut().filter(|endpoint| endpoint.entry.role == "publisher")
    }

    /// All processes whose CPU time and memory are recorded, by name.
    fn processes(&self) -> Vec<(String, i32)> {
        let endpoints = self.endpoints.iter();
        let endpoints = endpoints.map(|it| (it.entry.name.clone(), it.program.pid().as_raw()));
        endpoints.chain(self.bridge.iter().flat_map(Bridge::processes)).collect()
    }

    /// Waits for a condition before the window.
    fn wait(
        &mut self,
        what: &str,
        mut fulfilled: impl FnMut(&mut Self) -> Result<bool, EvalError>,
    ) -> Result<(), EvalError> {
        let deadline = after(clock::monotonic(), SET_UP_TIMEOUT_S);
        while !fulfilled(self)? {
            if clock::monotonic() >= deadline {
                return Err(EvalError::new(format!(
                    "timed out after {SET_UP_TIMEOUT_S} s waiting for {what}"
                )));
            }
            self.turn()?;
        }
        Ok(())
    }

    fn wait_until(&mut self, time: MonotonicNs, mut show: impl FnMut(MonotonicNs)) -> Result<(), EvalError> {
        loop {
            let now = clock::monotonic();
            if now >= time {
                return Ok(());
            }
            show(now);
            self.turn()?;
        }
    }

    /// Makes one turn: counts packets, samples once a second, checks the programs, and sleeps for a tick.
    fn turn(&mut self) -> Result<(), EvalError> {
        if self.interrupted.load(Ordering::Relaxed) {
            return Err(EvalError::Interrupted);
        }
        self.sampler.count_packets();
        let now = clock::monotonic();
        if now >= self.next_sample {
            self.next_sample = now.plus_ms(SAMPLE_MS);
            self.sample(now)?;
        }
        self.check_programs()?;
        #[allow(clippy::disallowed_methods, reason = "the harness handles no samples")]
        std::thread::sleep(TICK);
        Ok(())
    }

    fn sample(&mut self, now: MonotonicNs) -> Result<(), EvalError> {
        if let Some(bridge) = &mut self.bridge {
            bridge.sample()?;
        }
        let mut drops = Vec::new();
        for port in self.links.capped_ports() {
            let json = self.bed.switch().run(&format!("tc -s -j qdisc show dev {port}"))?;
            drops.push((port.to_owned(), queue_drops(&json)));
        }
        self.sampler.sample(now, &self.processes(), &drops)?;
        self.links.sample()
    }

    /// Fails if a program has ended, other than a publisher that has finished.
    fn check_programs(&mut self) -> Result<(), EvalError> {
        let endpoints = self.endpoints.iter_mut().map(|endpoint| &mut endpoint.program);
        let bridge = self.bridge.iter_mut().flat_map(Bridge::programs);
        for program in endpoints.chain(self.links.programs()).chain(bridge) {
            if let Some(status) = program.ended()
                && !(status.success() && program.latest("summary").is_some())
            {
                let error = program.latest("error").map(|line| format!(" {}", line["message"]));
                let (name, error) = (&program.name, error.unwrap_or_default());
                let text = format!("{name} ended during the run ({status}){error}; see logs/{name}.log");
                return Err(EvalError::new(text));
            }
        }
        Ok(())
    }
}

fn ports(bed: &Bed) -> Vec<PortEntry> {
    let mtus: BTreeMap<String, u64> = bed.hosts().iter().filter_map(mtu).collect();
    bed.hosts()
        .iter()
        .map(|host| PortEntry { host: host.name.clone(), mtu: mtus.get(&host.name).copied() })
        .collect()
}

fn mtu(host: &Host) -> Option<(String, u64)> {
    let output = host.network.run("ip -j link show dev eth0").ok()?;
    let links: serde_json::Value = serde_json::from_str(&output).ok()?;
    Some((host.name.clone(), links[0]["mtu"].as_u64()?))
}

fn after(time: MonotonicNs, seconds: f64) -> MonotonicNs {
    // From float to integer `as` saturates.
    time.plus_ns((seconds * 1e9) as u64)
}
