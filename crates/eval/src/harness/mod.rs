//! Executes the runs of a matrix one after the other. A finished run's folder is moved into the results in
//! one step, so that it is complete. docs/eval-results.md describes the folders.

mod bridge;
mod capture;
mod counters;
mod csv;
mod links;
mod machine;
mod manifest;
mod peers;
mod plan;
mod program;
mod progress;
mod run;
mod sampler;
mod settings;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use nix::fcntl::{Flock, FlockArg};
use serde_json::Value;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

pub use plan::{Dimensions, Plan};
use progress::Progress;
pub use settings::{Library, Settings};

use super::bed::{self, Host};
use super::error::EvalError;

/// Environment variables that are removed, as they would change the behaviour of a run's programs.
const FOREIGN_VARIABLES: [&str; 9] = [
    "ADAPTIVE_BRIDGE_CONFIG",
    "CYCLONEDDS_URI",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_DISTRO",
    "ROS_DOMAIN_ID",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "RUNTIME_DIRECTORY",
];

/// Builds a command that runs a program on a host, on the CPUs chosen by `--pin`.
fn pinned(settings: &Settings, host: &Host, program: &Path) -> Command {
    let mut command = match settings.pins.get(&host.name) {
        Some(cpus) => {
            let mut command = host.command(Path::new("taskset"));
            command.args(["--cpu-list", cpus]).arg(program);
            command
        }
        None => host.command(program),
    };
    FOREIGN_VARIABLES.iter().for_each(|name| {
        command.env_remove(name);
    });
    command.env("NO_COLOR", "1");
    command
}

/// The numbers of finished, skipped and failed runs of a matrix.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Runs that finished.
    pub finished: usize,
    /// Runs that the results already contained.
    pub skipped: usize,
    /// Runs that failed; the folder `failed` has their incomplete results.
    pub failed: usize,
}

/// Executes every run that the results do not contain yet. A run that fails is counted, and the next one
/// starts.
///
/// # Errors
/// A signal arrived, another harness writes into the same folder, the folder has runs of other settings, or a
/// file cannot be written.
pub fn run_all(plans: &[Plan], settings: &Settings) -> Result<Outcome, EvalError> {
    let folder = |name: &str| settings.out.join(name);
    fs::create_dir_all(folder("runs")).map_err(|error| EvalError::file(&settings.out, &error))?;
    let _lock = lock(&settings.out)?;
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&interrupted))
            .map_err(|error| EvalError::new(format!("signal handlers: {error}")))?;
    }
    for removed in bed::remove_leftovers() {
        eprintln!("removed the leftovers of a harness that no longer runs: {removed}");
    }
    for plan in plans {
        check_same(plan, settings, &folder("runs").join(plan.name()))?;
    }
    let mut outcome = Outcome::default();
    for (at, plan) in plans.iter().enumerate() {
        let name = plan.name();
        let done = folder("runs").join(&name);
        if done.exists() {
            outcome.skipped += 1;
            continue;
        }
        let partial = folder(".partial");
        empty(&partial)?;
        let mut progress = Progress::begin(at + 1, plans.len(), &name);
        match run::run(plan, settings, &partial, &interrupted, &mut progress) {
            Ok(()) => {
                rename(&partial, &done)?;
                let _ = fs::remove_dir_all(folder("failed").join(&name));
                progress.end("done");
                outcome.finished += 1;
            }
            Err(EvalError::Interrupted) => {
                let _ = fs::remove_dir_all(&partial);
                progress.end("interrupted");
                return Err(EvalError::Interrupted);
            }
            Err(EvalError::Failed(reason)) => {
                progress.end(&format!("failed: {reason}"));
                keep_failed(&partial, &folder("failed"), &name, &reason)?;
                outcome.failed += 1;
            }
        }
    }
    Ok(outcome)
}

/// Locks the results while this harness writes into them.
fn lock(out: &Path) -> Result<Flock<File>, EvalError> {
    let path = out.join(".lock");
    let file = File::create(&path).map_err(|error| EvalError::file(&path, &error))?;
    Flock::lock(file, FlockArg::LockExclusiveNonblock)
        .map_err(|_| EvalError::new(format!("another harness writes into {}", out.display())))
}

/// Fails if the folder of a run has one with other settings, which a report would mix with this one.
fn check_same(plan: &Plan, settings: &Settings, done: &Path) -> Result<(), EvalError> {
    if !done.exists() {
        return Ok(());
    }
    let read = |name: &str| fs::read_to_string(done.join(name)).unwrap_or_default();
    let manifest: Value = serde_json::from_str(&read("manifest.json")).unwrap_or_default();
    let differs = if manifest["quick"] != settings.quick {
        "--quick"
    } else if manifest["seed"] != settings.seed {
        "--seed"
    } else if read("scenario.yaml") != plan.scenario.text {
        "its scenario file"
    } else if plan.scenario.traces().any(|(name, trace)| read(&name) != trace.text) {
        "a trace of a link"
    } else {
        return Ok(());
    };
    Err(EvalError::new(format!(
        "{} was recorded with other settings ({differs}); choose another --out, or remove it",
        done.display()
    )))
}

/// Creates an empty folder, after removing an existing one.
fn empty(folder: &Path) -> Result<(), EvalError> {
    if folder.exists() {
        fs::remove_dir_all(folder).map_err(|error| EvalError::file(folder, &error))?;
    }
    fs::create_dir_all(folder).map_err(|error| EvalError::file(folder, &error))
}

fn keep_failed(partial: &Path, failed: &Path, name: &str, reason: &str) -> Result<(), EvalError> {
    let path: PathBuf = failed.join(name);
    empty(&path)?;
    fs::remove_dir(&path).map_err(|error| EvalError::file(&path, &error))?;
    rename(partial, &path)?;
    let file = path.join("reason.txt");
    fs::write(&file, format!("{reason}\n")).map_err(|error| EvalError::file(&file, &error))
}

fn rename(from: &Path, to: &Path) -> Result<(), EvalError> {
    fs::rename(from, to).map_err(|error| EvalError::file(to, &error))
}
