//! `ingress`, `egress`, `control` and `up`.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Args;

use super::{ConfigArguments, bad_configuration, failed, pause};
use crate::config::Configuration;
use crate::process::{self, HangUp, InForce, InForceError, ReloadRequests, RoleError, Stop};
use crate::telemetry;

/// A service manager restarts a process that died at once, so that samples flow again; one that cannot start,
/// for want of a network interface say, does not come sooner for being tried more often. It waits before it
/// ends.
const FAILED_START_MS: u64 = 2_000;

/// What `egress` is asked.
#[derive(Args, Debug)]
pub(super) struct EgressArguments {
    /// The lane to serve
    #[arg(long, value_name = "NAME")]
    lane: String,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn ingress(arguments: &ConfigArguments) -> ExitCode {
    role(arguments, |configuration, reloads, stop| process::ingress(&configuration.settings, reloads, stop))
}

pub(super) fn egress(arguments: &EgressArguments) -> ExitCode {
    role(&arguments.config, |configuration, reloads, stop| {
        process::egress(&configuration.settings, &arguments.lane, reloads, stop)
    })
}

pub(super) fn control(arguments: &ConfigArguments) -> ExitCode {
    role(arguments, |Configuration { settings, inline_secret }, reloads, stop| {
        process::control(settings, inline_secret.as_ref(), reloads, stop)
    })
}

pub(super) fn up(arguments: &ConfigArguments) -> ExitCode {
    let hang_up = match HangUp::on_signal() {
        Ok(hang_up) => hang_up,
        Err(error) => return failed(&error),
    };
    // A start of the whole bridge: here the file counts.
    let configuration = match arguments.try_load_configuration() {
        Ok(configuration) => configuration,
        Err(error) => return bad_configuration(&error),
    };
    telemetry::set_verbosity(configuration.settings.diagnostics.verbosity);
    let passed_on: Vec<OsString> = match arguments.path() {
        Some(path) => vec!["--config".into(), path.into()],
        None => Vec::new(),
    };
    run(|stop| process::up(configuration, &arguments.file(), &passed_on, &hang_up, stop))
}

fn role(
    arguments: &ConfigArguments,
    role: impl FnOnce(&Configuration, ReloadRequests, &Stop) -> Result<(), RoleError>,
) -> ExitCode {
    let again = arguments.clone();
    let reloads = match ReloadRequests::on_signal(move || again.try_load_configuration()) {
        Ok(reloads) => reloads,
        Err(error) => return failed(&error),
    };
    process::end_with_supervisor();
    let in_force = match InForce::join(&arguments.file(), arguments.try_load_configuration()) {
        Ok(in_force) => in_force,
        Err(InForceError::Config(error)) => return bad_configuration(&error),
        Err(InForceError::Shm(error)) => return run(|_| Err(error)),
    };
    let configuration = in_force.configuration().clone();
    telemetry::set_verbosity(configuration.settings.diagnostics.verbosity);
    run(|stop| role(&configuration, reloads.kept_in(in_force), stop))
}

pub(super) fn run<E: std::fmt::Display>(role: impl FnOnce(&Stop) -> Result<(), E>) -> ExitCode {
    let stop = match Stop::on_signals() {
        Ok(stop) => stop,
        Err(error) => return failed(&error),
    };
    match role(&stop) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let code = failed(&error);
            if std::env::var_os("NOTIFY_SOCKET").is_some() {
                pause(FAILED_START_MS, &stop);
            }
            code
        }
    }
}
