//! `list`, `run` and `matrix`: list scenarios and run them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;

use clap::Args;

use super::failed;
use crate::bed::{self, BedKind};
use crate::error::EvalError;
use crate::harness::{self, Dimensions, Library, Plan, Settings};
use crate::impairment::{BackendChoice, Reading};
use crate::scenario::{Scenario, Switch};

/// Seconds that a run takes in addition to its measured window: to create hosts, to match, to settle and to
/// wait for acknowledgements.
const OVERHEAD_S: f64 = 20.0;

/// The folder of the scenarios.
#[derive(Args, Debug)]
pub(super) struct Folder {
    /// The folder that scenarios are read from
    #[arg(long, value_name = "DIR", default_value = "config/scenarios")]
    scenarios: PathBuf,
}

/// Command-line arguments of `run`.
#[derive(Args, Debug)]
pub(super) struct RunArguments {
    /// Names of scenarios, as `list` prints them, or their files
    #[arg(required = true)]
    scenario: Vec<String>,
    /// DDS library of the publisher and the subscribers; separate several by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fast")]
    library: Vec<Library>,
    /// Reading of the paper's Table I; separate several by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "as-printed")]
    reading: Vec<Reading>,
    #[command(flatten)]
    common: Common,
}

/// Command-line arguments of `matrix`.
#[derive(Args, Debug)]
pub(super) struct MatrixArguments {
    /// DDS library of the publisher and the subscribers; separate several by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fast,cyclone")]
    library: Vec<Library>,
    /// Reading of the paper's Table I; separate several by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "as-printed,as-run")]
    reading: Vec<Reading>,
    #[command(flatten)]
    common: Common,
}

#[derive(Args, Debug)]
struct Common {
    /// Kind of the test bed's hosts; separate several by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "netns")]
    bed: Vec<BedKind>,
    /// Switch between the hosts; separate several by commas [default: those of the scenario]
    #[arg(long, value_enum, value_delimiter = ',')]
    switch: Vec<Switch>,
    /// Smoke runs of a few seconds: they show that everything works; their figures mean nothing
    #[arg(long)]
    quick: bool,
    /// Repetitions of each run
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeat: u32,
    /// Seed of the links: with the same seed they drop the same packets (NFQUEUE only)
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// The folder of the results; runs that it already contains are skipped
    #[arg(long, value_name = "DIR", default_value = "eval-results")]
    out: PathBuf,
    /// Back end that impairs the links
    #[arg(long, value_enum, default_value = "auto")]
    backend: BackendChoice,
    /// The CPUs that run a host's programs, such as `critical=1` or `bridge=0-1`; repeatable
    #[arg(long, value_name = "HOST=CPUS", value_parser = pin)]
    pin: Vec<(String, String)>,
    /// The program `adaptive-bridge` [default: the one in this program's folder]
    #[arg(long, value_name = "FILE")]
    bridge: Option<PathBuf>,
    /// The folder of the peer programs (the DDS publishers and subscribers)
    #[arg(long, value_name = "DIR", default_value = "tests/peers/build")]
    peers: PathBuf,
    #[command(flatten)]
    folder: Folder,
}

fn pin(text: &str) -> Result<(String, String), String> {
    let cpus = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_digit() || ",-".contains(c));
    match text.split_once('=') {
        Some((host, list)) if cpus(list) => Ok((host.to_owned(), list.to_owned())),
        _ => Err("must be a host, =, and CPUs such as 0, 0,2 or 1-3".to_owned()),
    }
}

pub(super) fn list(folder: &Folder) -> ExitCode {
    match Scenario::load_all(&folder.scenarios) {
        Ok(scenarios) => {
            let width = scenarios.iter().map(|scenario| scenario.name.len()).max().unwrap_or(0);
            for Scenario { name, title, duration_s, .. } in scenarios {
                println!("{name:width$}  {duration_s:>4.0} s  {title}");
            }
            ExitCode::SUCCESS
        }
        Err(error) => failed(&error),
    }
}

pub(super) fn run(arguments: &RunArguments) -> ExitCode {
    let folder = &arguments.common.folder.scenarios;
    let scenarios = arguments.scenario.iter().map(|name| find(folder, name)).collect();
    run_all(scenarios, &arguments.library, &arguments.reading, &arguments.common)
}

pub(super) fn matrix(arguments: &MatrixArguments) -> ExitCode {
    let scenarios = Scenario::load_all(&arguments.common.folder.scenarios);
    run_all(scenarios, &arguments.library, &arguments.reading, &arguments.common)
}

fn find(folder: &Path, name: &str) -> Result<Scenario, EvalError> {
    if name.ends_with(".yaml") {
        return Scenario::load(Path::new(name));
    }
    let path = folder.join(format!("{name}.yaml"));
    if path.exists() {
        return Scenario::load(&path);
    }
    let folder = folder.display();
    Err(EvalError::new(format!(
        "no scenario '{name}' in {folder}: `adaptive-bridge-eval list` lists them all"
    )))
}

fn run_all(
    scenarios: Result<Vec<Scenario>, EvalError>,
    libraries: &[Library],
    readings: &[Reading],
    common: &Common,
) -> ExitCode {
    let outcome = scenarios.and_then(|scenarios| {
        let scenarios: Vec<Rc<Scenario>> = scenarios.into_iter().map(Rc::new).collect();
        let dimensions = Dimensions {
            libraries: libraries.to_vec(),
            readings: readings.to_vec(),
            beds: common.bed.clone(),
            switches: common.switch.clone(),
            repetitions: common.repeat,
        };
        let plans = dimensions.plans(&scenarios, bed::docker_switch());
        let settings = common.settings()?;
        check_possible(&plans, &settings)?;
        let seconds: f64 = plans.iter().map(|plan| plan.duration_s(settings.quick) + OVERHEAD_S).sum();
        eprintln!("{} runs, about {:.0} min, into {}", plans.len(), seconds / 60.0, settings.out.display());
        harness::run_all(&plans, &settings)
    });
    match outcome {
        Ok(outcome) => {
            let harness::Outcome { finished, skipped, failed } = outcome;
            eprintln!("{finished} finished, {skipped} already in the results, {failed} failed");
            if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
        }
        Err(error) => failed(&error),
    }
}

/// Checks that peers, test beds and the bridge exist, so that no run of a matrix fails for want of them.
fn check_possible(plans: &[Plan], settings: &Settings) -> Result<(), EvalError> {
    let mut beds: Vec<(BedKind, Switch)> = Vec::new();
    for plan in plans {
        settings.peer(plan.library)?;
        if !beds.contains(&(plan.bed, plan.switch)) {
            beds.push((plan.bed, plan.switch));
        }
    }
    for (bed, switch) in beds {
        if let Some(reason) = bed.missing(switch) {
            let (bed, switch) = (bed.name(), switch.name());
            return Err(EvalError::new(format!(
                "this machine cannot make a {bed} bed with a {switch} switch: {reason}"
            )));
        }
    }
    if !settings.bridge.exists() {
        let bridge = settings.bridge.display();
        return Err(EvalError::new(format!("{bridge} does not exist; run `cargo build` or give --bridge")));
    }
    Ok(())
}

impl Common {
    fn settings(&self) -> Result<Settings, EvalError> {
        let harness = std::env::current_exe()
            .map_err(|error| EvalError::new(format!("the path of this program: {error}")))?;
        let beside = harness.with_file_name("adaptive-bridge");
        let absolute = |path: &Path| std::path::absolute(path).map_err(|error| EvalError::file(path, &error));
        Ok(Settings {
            out: absolute(&self.out)?,
            bridge: absolute(self.bridge.as_deref().unwrap_or(&beside))?,
            harness,
            peers: absolute(&self.peers)?,
            quick: self.quick,
            seed: self.seed,
            backend: self.backend,
            pins: self.pin.iter().cloned().collect::<BTreeMap<_, _>>(),
            command_line: std::env::args().collect(),
        })
    }
}
