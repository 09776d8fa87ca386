//! `ingress`, `egress`, `control` and `up`: run one process of the bridge, or the supervisor.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Args;

use super::check::too_small_budget;
use super::{ConfigArguments, EXIT_CONFIG, EXIT_UNUSED, bad_configuration, failed, pause};
use crate::config::{Configuration, SetParameters, Standby};
use crate::process::{self, HangUp, InForce, InForceError, ReloadRequests, RoleError, Stop};
use crate::telemetry;

/// How long a service process that cannot start waits before it exits. systemd restarts an exited process
/// after 100 ms; a process that lacks, say, a network interface gains nothing from being started that often.
const FAILED_START_MS: u64 = 2_000;

#[derive(Args, Debug)]
pub(super) struct EgressArguments {
    /// The lane to serve
    #[arg(long, value_name = "NAME")]
    lane: String,
    #[command(flatten)]
    config: ConfigArguments,
}

#[derive(Args, Debug)]
pub(super) struct UpArguments {
    /// Leave processes alone that make no progress, for example because a debugger has stopped them;
    /// otherwise they are killed and restarted after 2 s (ingress, critical lane; by their standby after
    /// 0.5 s) or 5 s
    #[arg(long)]
    no_watchdog: bool,
    #[command(flatten)]
    config: ConfigArguments,
}

/// Environment variable of the services of the standbys.
const STANDBY_VARIABLE: &str = "ADAPTIVE_BRIDGE_STANDBY";

pub(super) fn ingress(arguments: &ConfigArguments) -> Result<ExitCode, ExitCode> {
    let mut ends_with = None;
    let code = role(arguments, |Configuration { settings, .. }, reloads, stop| {
        // No restart changes that, and a standby must not report that it is ready.
        if let Some(problem) = too_small_budget(settings) {
            failed(&format!("shared_memory.budget_bytes {problem}"));
            ends_with = Some(EXIT_CONFIG);
            return Ok(());
        }
        if ends_standby(settings.ingress_standby, "ingress") {
            ends_with = Some(EXIT_UNUSED);
            return Ok(());
        }
        process::ingress(settings, reloads, stop)
    })?;
    Ok(ends_with.map_or(code, ExitCode::from))
}

/// Whether this is the service of a standby.
fn is_standby() -> bool {
    std::env::var_os(STANDBY_VARIABLE).is_some()
}

/// Ends the service of a standby that the configuration does not have any more: the other process of the role
/// serves it alone.
fn ends_standby(standby: Standby, role: &str) -> bool {
    let ends = standby == Standby::None && is_standby();
    if ends {
        process::end_standby(role);
    }
    ends
}

pub(super) fn egress(arguments: &EgressArguments) -> Result<ExitCode, ExitCode> {
    let mut unused = false;
    let code = role(&arguments.config, |configuration, reloads, stop| {
        let settings = &configuration.settings;
        let lane = settings.lanes.iter().find(|lane| lane.name.as_str() == arguments.lane);
        unused = lane.is_some_and(|lane| !lane.is_used());
        if unused {
            process::end_unused(&arguments.lane);
            return Ok(());
        }
        unused = lane.is_some_and(|lane| ends_standby(lane.standby, &arguments.lane));
        if unused {
            return Ok(());
        }
        process::egress(settings, &arguments.lane, reloads, stop)
    })?;
    Ok(if unused { ExitCode::from(EXIT_UNUSED) } else { code })
}

pub(super) fn control(arguments: &ConfigArguments) -> Result<ExitCode, ExitCode> {
    role(arguments, |Configuration { settings, inline_secret }, reloads, stop| {
        process::control(settings, inline_secret.as_ref(), reloads, stop)
    })
}

pub(super) fn up(arguments: &UpArguments) -> Result<ExitCode, ExitCode> {
    let hang_up = HangUp::on_signal().map_err(|error| failed(&error))?;
    // `up` starts the whole bridge, so it reads the file and not the configuration in force.
    let configuration = arguments
        .config
        .try_load_with_budget(&SetParameters::new(), &too_small_budget)
        .map_err(|error| bad_configuration(&error))?;
    telemetry::set_verbosity(configuration.settings.diagnostics.verbosity);
    let mut child_arguments: Vec<OsString> = match arguments.config.path() {
        Some(path) => vec!["--config".into(), path.into()],
        None => Vec::new(),
    };
    for parameter in &arguments.config.parameters {
        child_arguments.extend(["--parameter".into(), parameter.to_string().into()]);
    }
    let watchdog = !arguments.no_watchdog;
    run(|stop| {
        process::up(configuration, &arguments.config.file(), &child_arguments, watchdog, &hang_up, stop)
    })
}

/// Runs one process of the bridge with the configuration in force.
fn role(
    arguments: &ConfigArguments,
    role: impl FnOnce(&Configuration, ReloadRequests, &Stop) -> Result<(), RoleError>,
) -> Result<ExitCode, ExitCode> {
    process::bound_free_memory();
    // First: a signal that ends the process by itself would leave its files.
    let stop = stop_on_signals()?;
    let reload_arguments = arguments.clone();
    let reloads = ReloadRequests::on_signal(move |set| reload_arguments.try_load_with(set))
        .map_err(|error| failed(&error))?;
    process::end_with_supervisor();
    let (file, load) = (arguments.file(), |set: &SetParameters| arguments.try_load_with(set));
    let joined =
        if is_standby() { InForce::wait(&file, load, &stop) } else { InForce::join(&file, load).map(Some) };
    let in_force = match joined {
        Ok(Some(in_force)) => in_force,
        Ok(None) => return Ok(ExitCode::SUCCESS),
        Err(InForceError::Config(error)) => return Err(bad_configuration(&error)),
        Err(error) => return run_until(&stop, |_| Err(error)),
    };
    let configuration = in_force.configuration().clone();
    telemetry::set_verbosity(configuration.settings.diagnostics.verbosity);
    run_until(&stop, |stop| role(&configuration, reloads.kept_in(in_force), stop))
}

/// Runs `role` until it returns or a signal stops it, and returns the exit code of the process.
pub(super) fn run<E: std::fmt::Display>(
    role: impl FnOnce(&Stop) -> Result<(), E>,
) -> Result<ExitCode, ExitCode> {
    run_until(&stop_on_signals()?, role)
}

fn stop_on_signals() -> Result<Stop, ExitCode> {
    Stop::on_signals().map_err(|error| failed(&error))
}

fn run_until<E: std::fmt::Display>(
    stop: &Stop,
    role: impl FnOnce(&Stop) -> Result<(), E>,
) -> Result<ExitCode, ExitCode> {
    process::abort_on_panic();
    match role(stop) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(error) => {
            let code = failed(&error);
            if std::env::var_os("NOTIFY_SOCKET").is_some() {
                pause(FAILED_START_MS, stop);
            }
            Err(code)
        }
    }
}
