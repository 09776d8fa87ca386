//! `ingress`, `egress` and `up`.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Args;

use super::{ConfigArguments, failed};
use crate::process::{self, Stop};

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
    process::end_with_supervisor();
    let settings = match arguments.load() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    run(|stop| process::ingress(&settings, stop))
}

pub(super) fn egress(arguments: &EgressArguments) -> ExitCode {
    process::end_with_supervisor();
    let settings = match arguments.config.load() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    run(|stop| process::egress(&settings, &arguments.lane, stop))
}

pub(super) fn up(arguments: &ConfigArguments) -> ExitCode {
    let settings = match arguments.load() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    let passed_on: Vec<OsString> = match arguments.path() {
        Some(path) => vec!["--config".into(), path.into()],
        None => Vec::new(),
    };
    run(|stop| process::up(&settings, &passed_on, stop))
}

pub(super) fn run<E: std::fmt::Display>(role: impl FnOnce(&Stop) -> Result<(), E>) -> ExitCode {
    let stop = match Stop::on_signals() {
        Ok(stop) => stop,
        Err(error) => return failed(&error),
    };
    match role(&stop) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&error),
    }
}
