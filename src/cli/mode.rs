//! `mode`: overrides the mode of a lane by hand.

use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::{ConfigArguments, failed};
use crate::model::LaneMode;
use crate::process;

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The lane
    lane: String,
    /// The mode to set, which overrides the control process
    mode: Mode,
    /// How long the override lasts: such as 90s, 10m, 2h, or `forever`. The safety supervisor takes
    /// precedence over it
    #[arg(long = "for", value_name = "TIME", default_value = "1h", value_parser = override_duration)]
    duration: OverrideDuration,
    #[command(flatten)]
    config: ConfigArguments,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Mode {
    /// Forward at the configured rate
    Normal,
    /// Forward at the degraded rate
    Degraded,
    /// Forward nothing on a noncritical lane
    Suspended,
    /// Forward nothing, on a critical lane either
    Stopped,
    /// End the override: the control process sets the mode again
    Auto,
}

impl Mode {
    /// The mode of the override; `None` to end it.
    const fn override_mode(self) -> Option<LaneMode> {
        match self {
            Self::Normal => Some(LaneMode::Normal),
            Self::Degraded => Some(LaneMode::Degraded),
            Self::Suspended => Some(LaneMode::Suspended),
            Self::Stopped => Some(LaneMode::Stopped),
            Self::Auto => None,
        }
    }
}

/// The time after which an override expires; `None` when it never does.
#[derive(Clone, Copy, Debug)]
struct OverrideDuration(Option<Duration>);

fn override_duration(text: &str) -> Result<OverrideDuration, String> {
    if text == "forever" {
        return Ok(OverrideDuration(None));
    }
    let duration = humantime::parse_duration(text).map_err(|error| error.to_string())?;
    if duration.is_zero() {
        Err("must be longer than 0 s".to_owned())
    } else {
        Ok(OverrideDuration(Some(duration)))
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let settings = arguments.config.in_force()?;
    let mode = arguments.mode.override_mode();
    let epoch = process::set_mode(&settings, &arguments.lane, mode, arguments.duration.0)
        .map_err(|error| failed(&error))?;
    let lane = &arguments.lane;
    match (mode, arguments.duration.0) {
        (None, _) => println!("lane {lane}: no override (epoch {epoch})"),
        (Some(mode), None) => println!("lane {lane}: {mode} until the next override (epoch {epoch})"),
        (Some(mode), Some(duration)) => {
            println!("lane {lane}: {mode} for {} (epoch {epoch})", humantime::format_duration(duration));
        }
    }
    Ok(ExitCode::SUCCESS)
}
