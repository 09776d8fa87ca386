//! The command line: one file for each subcommand.
//!
//! Exit codes: 0 done, 1 failed while running, 2 wrong command line, 78 bad configuration (`EX_CONFIG` of
//! sysexits.h); 3 and 4 are `doctor`'s, 5 is `reload`'s. Logs go to stderr; what a program may want to read
//! goes to stdout, and nothing else does.

mod check;
mod completions;
mod demo;
mod doctor;
mod man;
mod mode;
mod reload;
mod responder;
mod roles;
mod status;
mod tap;
mod units;

use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};

use crate::clock;
use crate::config::{self, ConfigError, Configuration, Settings};
use crate::process::{InForce, Stop};
use crate::shm::{self, ShmError};
use crate::telemetry::{self, Snapshot};

/// A reload applied what it could, and the rest of the file waits for a restart of the whole bridge.
const EXIT_WAITS: u8 = 5;

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
    /// Answer a bridge's probes, beside a remote subscriber; needs no bridge on its machine
    Responder(responder::Arguments),
    /// Run control: probe and classify subscribers, decide the lanes' modes, watch over the bridge
    Control(ConfigArguments),
    /// Run the whole bridge, all processes as children of this one
    Up(ConfigArguments),
    /// Show what the running bridge does: processes, rates, drops, latencies, and what is wrong
    Status(status::Arguments),
    /// Read the samples of a route straight from shared memory
    Tap(tap::Arguments),
    /// Set the mode of a lane by hand
    Mode(mode::Arguments),
    /// Let the running bridge take over what was changed in its configuration file, without a restart
    ///
    /// Exit codes: 0 all applied, 5 the rest of the file waits for a restart of the whole bridge, 1 a process
    /// refused the file or did not answer, 78 the file is bad.
    Reload(ConfigArguments),
    /// Say what on this machine will hurt the bridge, and the command that mends it
    Doctor(doctor::Arguments),
    /// Show, or write, what a configuration needs of systemd beyond the installed units
    Units(units::Arguments),
    /// Print what a shell needs to complete command lines
    Completions(completions::Arguments),
    /// Write the manual pages to a folder
    #[command(hide = true)]
    Man(man::Arguments),
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

    /// The file, with its whole path, that is read when it exists.
    fn file(&self) -> PathBuf {
        let named = || std::env::var_os(config::PATH_VARIABLE).filter(|path| !path.is_empty());
        let path = self.config.clone().or_else(|| named().map(PathBuf::from));
        let path = path.unwrap_or_else(|| config::DEFAULT_PATH.into());
        std::path::absolute(&path).unwrap_or(path)
    }

    /// The settings, or the exit code after the problems were printed.
    fn load(&self) -> Result<Settings, ExitCode> {
        self.try_load().map_err(|error| bad_configuration(&error))
    }

    fn try_load(&self) -> Result<Settings, ConfigError> {
        self.try_load_configuration().map(|configuration| configuration.settings)
    }

    fn try_load_configuration(&self) -> Result<Configuration, ConfigError> {
        config::load_configuration(self.path(), &|name| std::env::var(name).ok())
    }

    /// The settings that the running bridge has in force; `None` when no bridge runs.
    fn running(&self) -> Option<Settings> {
        InForce::find(&self.file(), self.try_load().ok().as_ref())
    }

    /// The settings that the running bridge has in force, whatever the file says by now; those of the file
    /// when no bridge runs.
    fn in_force(&self) -> Result<Settings, ExitCode> {
        let loaded = self.try_load();
        match InForce::find(&self.file(), loaded.as_ref().ok()) {
            Some(settings) => Ok(settings),
            None => loaded.map_err(|error| bad_configuration(&error)),
        }
    }
}

/// Prints every problem of a configuration file, and gives the exit code.
fn bad_configuration(error: &ConfigError) -> ExitCode {
    eprintln!("{error}");
    ExitCode::from(EXIT_CONFIG)
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
        Command::Responder(arguments) => responder::run(&arguments),
        Command::Control(arguments) => roles::control(&arguments),
        Command::Up(arguments) => roles::up(&arguments),
        Command::Status(arguments) => status::run(&arguments),
        Command::Tap(arguments) => tap::run(&arguments),
        Command::Mode(arguments) => mode::run(&arguments),
        Command::Reload(arguments) => reload::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Units(arguments) => units::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Man(arguments) => man::run(&arguments),
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

/// A reading of the bridge that runs with these settings.
fn read_bridge(root: &Path, settings: &Settings) -> Result<Option<Snapshot>, String> {
    Snapshot::take(root, settings).map_err(|error| match error {
        ShmError::Incompatible { .. } => format!(
            "the bridge that runs as instance {} is of another version than this program; restart the whole \
             bridge",
            settings.instance
        ),
        other => other.to_string(),
    })
}

/// Prints that there is no bridge to look at, and gives the exit code.
fn no_bridge(settings: &Settings, root: &Path) -> ExitCode {
    let services = Path::new("/run/adaptive-bridge");
    let hint = match std::fs::metadata(services) {
        Ok(_) if services != root => {
            "look at that of the services with `sudo -u adaptive-bridge adaptive-bridge …`, or start one"
        }
        _ => "start it",
    };
    failed(&format!(
        "no bridge runs as instance {} (root {}); {hint} with `adaptive-bridge up`",
        settings.instance,
        root.display()
    ))
}

/// The exit code after stdout could not be written to. Who reads only the beginning, as `head` does, has what
/// it wants: that is no failure.
fn output_ended(error: &io::Error) -> ExitCode {
    match error.kind() {
        ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        _ => failed(&format!("stdout: {error}")),
    }
}

/// The folder of the bridge's shared files, for these settings and this environment.
fn root(settings: &Settings) -> PathBuf {
    shm::default_root(settings.shared_memory.root_path.as_deref(), |name| std::env::var_os(name))
}

/// Waits; `false` as soon as the process is asked to stop.
fn pause(ms: u64, stop: &Stop) -> bool {
    const LOOK_MS: u64 = 20;
    let end = clock::monotonic().plus_ms(ms);
    loop {
        let left_ns = end.since(clock::monotonic());
        if left_ns == 0 || stop.is_requested() {
            return !stop.is_requested();
        }
        std::thread::sleep(Duration::from_nanos(left_ns.min(LOOK_MS * 1_000_000)));
    }
}
