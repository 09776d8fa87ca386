//! `mode`: overrides the mode of a lane by hand.

use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::{ConfigArguments, failed};
use crate::model::LaneMode;
use crate::process;

/// What `mode` is asked.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The lane
    lane: String,
    /// The mode that it is to be in, whatever the control process decides
    mode: Mode,
    /// How long: such as 90s, 10m, 2h, or `forever`. A safety mode holds against it
    #[arg(long = "for", value_name = "TIME", default_value = "1h", value_parser = how_long)]
    duration: HowLong,
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
    /// End the override: the control process decides again
    Auto,
}

impl Mode {
    const fn override_by_hand(self) -> Option<LaneMode> {
        match self {
            Self::Normal => Some(LaneMode::Normal),
            Self::Degraded => Some(LaneMode::Degraded),
            Self::Suspended => Some(LaneMode::Suspended),
            Self::Stopped => Some(LaneMode::Stopped),
            Self::Auto => None,
        }
    }
}

/// How long an override lasts; without an end when `None`.
#[derive(Clone, Copy, Debug)]
struct HowLong(Option<Duration>);

fn how_long(text: &str) -> Result<HowLong, String> {
    if text == "forever" {
        return Ok(HowLong(None));
    }
    let duration = humantime::parse_duration(text).map_err(|error| error.to_string())?;
    if duration.is_zero() {
        Err("must be longer than nothing".to_owned())
    } else {
        Ok(HowLong(Some(duration)))
    }
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let settings = match arguments.config.in_force() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    let mode = arguments.mode.override_by_hand();
    match process::set_mode(&settings, &arguments.lane, mode, arguments.duration.0) {
        Ok(epoch) => {
            let lane = &arguments.lane;
            match (mode, arguments.duration.0) {
                (None, _) => println!("lane {lane}: no override (epoch {epoch})"),
                (Some(mode), None) => println!("lane {lane}: {mode} until it is changed (epoch {epoch})"),
                (Some(mode), Some(duration)) => {
                    println!(
                        "lane {lane}: {mode} for {} (epoch {epoch})",
                        humantime::format_duration(duration)
                    );
                }
            }
            ExitCode::SUCCESS
        }
        Err(error) => failed(&error),
    }
}
