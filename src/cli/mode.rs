//! `mode`: sets the mode of a lane by hand.

use std::process::ExitCode;

use clap::{Args, ValueEnum};

use super::{ConfigArguments, failed};
use crate::model::LaneMode;
use crate::process;

/// What `mode` is asked.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The lane
    lane: String,
    /// The mode that it is to be in
    mode: Mode,
    #[command(flatten)]
    config: ConfigArguments,
}

/// The modes that can be set by hand.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Mode {
    /// The configured rate
    Normal,
    /// The reduced rate
    Degraded,
    /// Nothing on a noncritical lane
    Suspended,
    /// Nothing on any lane
    Stopped,
}

impl From<Mode> for LaneMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::Normal => Self::Normal,
            Mode::Degraded => Self::Degraded,
            Mode::Suspended => Self::Suspended,
            Mode::Stopped => Self::Stopped,
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let settings = match arguments.config.load() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    match process::set_mode(&settings, &arguments.lane, arguments.mode.into()) {
        Ok(epoch) => {
            let mode = LaneMode::from(arguments.mode);
            println!("lane {}: {mode} (epoch {epoch})", arguments.lane);
            ExitCode::SUCCESS
        }
        Err(error) => failed(&error),
    }
}
