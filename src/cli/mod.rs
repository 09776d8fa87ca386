//! The command line: one file for each subcommand.
//!
//! Exit codes: 0 done, 1 failed while running, 2 wrong command line, 78 bad configuration (`EX_CONFIG` of
//! sysexits.h). Logs go to stderr; what a program may want to read goes to stdout, and nothing else does.

mod check;
mod demo;
mod mode;
mod roles;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::config::{self, Settings};
use crate::telemetry;

/// Bad configuration (`EX_CONFIG`, sysexits.h).
const EXIT_CONFIG: u8 = 78;

/// A proxy between a robot's ROS 2 publishers and its subscribers: a slow subscriber behind bad Wi-Fi cannot
/// stall the publisher, nor the critical subscribers beside it.
#[derive(Debug, Parser)]
#[command(name = "adaptive-bridge", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Check a configuration file: every problem at once, and the shared memory it takes
    Check(check::Arguments),
    /// Run ingress: take every topic in from DDS, once, into shared memory
    Ingress(ConfigArguments),
    /// Run the egress of one lane: out of shared memory to its own DDS writers
    Egress(roles::EgressArguments),
    /// Run the whole bridge, all processes as children of this one
    Up(ConfigArguments),
    /// Set the mode of a lane by hand
    Mode(mode::Arguments),
    /// Show what the bridge is for: publisher, subscribers and bridge on this machine, without ROS 2
    Demo(demo::Arguments),
    #[command(hide = true)]
    DemoPublisher(demo::PublisherArguments),
    #[command(hide = true)]
    DemoSubscriber(demo::SubscriberArguments),
}

/// Which configuration.
#[derive(Args, Clone, Debug)]
struct ConfigArguments {
    /// Configuration file [default: $ADAPTIVE_BRIDGE_CONFIG, then /etc/adaptive-bridge/config.yaml]
    #[arg(long, short, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl ConfigArguments {
    fn path(&self) -> Option<&Path> {
        self.config.as_deref()
    }

    /// The settings, or the exit code after the problems were printed.
    fn load(&self) -> Result<Settings, ExitCode> {
        config::load(self.path(), &|name| std::env::var(name).ok()).map_err(|error| {
            eprintln!("{error}");
            ExitCode::from(EXIT_CONFIG)
        })
    }
}

/// Runs the program.
pub fn main() -> ExitCode {
    // clap prints help and errors itself, and exits with 0 or 2.
    let cli = Cli::parse();
    telemetry::start_logs();
    match cli.command {
        Command::Check(arguments) => check::run(&arguments),
        Command::Ingress(arguments) => roles::ingress(&arguments),
        Command::Egress(arguments) => roles::egress(&arguments),
        Command::Up(arguments) => roles::up(&arguments),
        Command::Mode(arguments) => mode::run(&arguments),
        Command::Demo(arguments) => demo::run(&arguments),
        Command::DemoPublisher(arguments) => demo::publisher(&arguments),
        Command::DemoSubscriber(arguments) => demo::subscriber(&arguments),
    }
}

/// Prints why a command failed, and gives its exit code.
fn failed(error: &dyn std::fmt::Display) -> ExitCode {
    eprintln!("adaptive-bridge: {error}");
    ExitCode::FAILURE
}
