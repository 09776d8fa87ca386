//! The command line of `adaptive-bridge`: one file for each subcommand.
//!
//! Exit codes: 0 success, 1 failed while running, 2 wrong command line, 78 bad configuration (`EX_CONFIG` of
//! sysexits.h); `doctor` also uses 3 and 4, `reload` also 5. Logs go to stderr; only output that another
//! program may read goes to stdout.

mod check;
mod completions;
mod demo;
mod doctor;
mod man;
mod mode;
mod original;
mod reload;
mod responder;
mod roles;
mod ros_args;
mod status;
mod tap;
mod units;

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};

use crate::clock;
use crate::config::{self, ConfigError, Configuration, Parameters, SetParameters, Settings};
use crate::model::TopicName;
use crate::process::{InForce, Stop};
use crate::shm::ShmError;
use crate::telemetry::{self, Snapshot};

/// Exit code of `reload` when some changes of the file wait for a restart of the whole bridge.
const EXIT_WAITS: u8 = 5;

/// Exit code for a wrong command line, as of clap.
const EXIT_USAGE: u8 = 2;

/// Exit code of `egress` for a lane on which no route has an output. The service units do not restart it.
const EXIT_UNUSED: u8 = 3;

/// Exit code for a bad configuration (`EX_CONFIG` of sysexits.h).
const EXIT_CONFIG: u8 = 78;

/// A proxy between a robot's ROS 2 publishers and its subscribers: a slow subscriber behind bad Wi-Fi cannot
/// stall the publisher or the critical subscribers.
#[derive(Debug, Parser)]
#[command(name = "adaptive-bridge", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Check a configuration file: list all its problems, or the shared memory that it needs; explain a key
    Check(check::Arguments),
    /// Run ingress: receive each input topic once from DDS and publish it in shared memory
    Ingress(ConfigArguments),
    /// Run the egress of one lane: forward samples from shared memory with the lane's own DDS writers
    Egress(roles::EgressArguments),
    /// Run a responder beside a remote subscriber: answer probe requests; needs no bridge on its machine
    Responder(responder::Arguments),
    /// Run control: probe and classify subscribers, set the lanes' modes, supervise the bridge
    Control(ConfigArguments),
    /// Run the whole bridge: a supervisor with all other processes as its children
    Up(roles::UpArguments),
    /// Show the state of the running bridge: problems, processes, rates, drops, latencies
    Status(status::Arguments),
    /// Read the samples of a route directly from shared memory
    Tap(tap::Arguments),
    /// Override the mode of a lane by hand
    Mode(mode::Arguments),
    /// Apply the changes of the configuration file to the running bridge, without a restart
    ///
    /// Exit codes: 0 all changes are applied, 5 some changes wait for a restart of the whole bridge, 1 a
    /// process refused the file or did not answer, 78 the file is bad.
    Reload(ConfigArguments),
    /// Check this machine for conditions that impair the bridge, and print the command that fixes each
    Doctor(doctor::Arguments),
    /// Print or write the systemd drop-ins that a configuration needs beside the installed units
    Units(units::Arguments),
    /// Print the script with which a shell completes command lines
    Completions(completions::Arguments),
    /// Wait for a signal, in place of a node of the original package: `up` does its work
    #[command(hide = true)]
    Companion(ConfigArguments),
    /// Write the manual pages to a folder
    #[command(hide = true)]
    Man(man::Arguments),
    /// Demonstrate the bridge with a publisher and two subscribers on this machine, without ROS 2
    Demo(demo::Arguments),
    #[command(hide = true)]
    DemoPublisher(demo::PeerArguments),
    #[command(hide = true)]
    DemoSubscriber(demo::SubscriberArguments),
}

/// The option that names the configuration file.
#[derive(Args, Clone, Debug)]
struct ConfigArguments {
    /// Configuration file [default: $ADAPTIVE_BRIDGE_CONFIG, then /etc/adaptive-bridge/config.yaml]
    #[arg(long, short, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A value in place of the file's, such as `probes.rate_hz:=4`, or a file of ROS 2 parameters;
    /// repeatable. `--ros-args -p`, `--params-file`, `-r __ns:=`, `-r __node:=` and `--log-level` do the same
    #[arg(long = "parameter", value_name = "KEY:=VALUE|FILE")]
    parameters: Vec<Parameters>,
}

impl ConfigArguments {
    fn path(&self) -> Option<&Path> {
        self.config.as_deref()
    }

    /// The absolute path of the configuration file, which may not exist.
    fn file(&self) -> PathBuf {
        let from_environment = || std::env::var_os(config::PATH_VARIABLE).filter(|path| !path.is_empty());
        // Files of parameters that cannot be read are reported when the configuration is loaded.
        let named = config::named_path(self.path(), &self.parameters).unwrap_or_default();
        let path = named.or_else(|| from_environment().map(PathBuf::from));
        let path = path.unwrap_or_else(|| config::DEFAULT_PATH.into());
        std::path::absolute(&path).unwrap_or(path)
    }

    /// Reads the settings; if the file is bad, prints its problems and returns the exit code.
    fn load(&self) -> Result<Settings, ExitCode> {
        self.try_load().map_err(|error| bad_configuration(&error))
    }

    fn try_load(&self) -> Result<Settings, ConfigError> {
        self.try_load_configuration().map(|configuration| configuration.settings)
    }

    fn try_load_configuration(&self) -> Result<Configuration, ConfigError> {
        self.try_load_with(&SetParameters::new())
    }

    /// Reads the configuration with parameters that were set while the bridge runs.
    fn try_load_with(&self, set: &SetParameters) -> Result<Configuration, ConfigError> {
        self.try_load_with_budget(set, &|_| None)
    }

    /// Like [`try_load_with`](Self::try_load_with); `is_refused` says what the budget must be.
    fn try_load_with_budget(
        &self,
        set: &SetParameters,
        is_refused: &dyn Fn(&Settings) -> Option<String>,
    ) -> Result<Configuration, ConfigError> {
        let one =
            |(key, value): (&String, &String)| Parameters::One { key: key.clone(), value: value.clone() };
        let parameters = [&self.parameters[..], &set.iter().map(one).collect::<Vec<_>>()].concat();
        let env = |name: &str| std::env::var(name).ok();
        let path = self.path();
        let mut configuration = config::load_configuration_with_budget(path, &parameters, &env, is_refused)?;
        configuration.settings.set_parameters = set.clone();
        Ok(configuration)
    }

    /// The settings in force in the running bridge; `None` when no bridge runs.
    fn running(&self) -> Option<Settings> {
        InForce::find(&self.file(), self.try_load().ok().as_ref())
    }

    /// The settings in force in the running bridge, even if the file has changed since; without a running
    /// bridge, the settings of the file.
    fn in_force(&self) -> Result<Settings, ExitCode> {
        let loaded = self.try_load();
        match InForce::find(&self.file(), loaded.as_ref().ok()) {
            Some(settings) => Ok(settings),
            None => loaded.map_err(|error| bad_configuration(&error)),
        }
    }
}

fn bad_configuration(error: &ConfigError) -> ExitCode {
    eprintln!("{error}");
    ExitCode::from(EXIT_CONFIG)
}

/// Runs the subcommand that the command line names.
pub fn main() -> ExitCode {
    let arguments = match ros_args::translate(original::translate(std::env::args_os())) {
        Ok(arguments) => arguments,
        Err(error) => {
            failed(&error);
            return ExitCode::from(EXIT_USAGE);
        }
    };
    // clap prints help and errors itself and exits with 0 or 2.
    let cli = Cli::parse_from(arguments);
    telemetry::start_logs();
    let ended = match cli.command {
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
        Command::Companion(_) => original::companion(),
        Command::Man(arguments) => man::run(&arguments),
        Command::Demo(arguments) => Ok(demo::run(&arguments)),
        Command::DemoPublisher(arguments) => Ok(demo::publisher(&arguments)),
        Command::DemoSubscriber(arguments) => Ok(demo::subscriber(&arguments)),
    };
    telemetry::flush_logs();
    ended.unwrap_or_else(|code| code)
}

fn failed(error: &dyn std::fmt::Display) -> ExitCode {
    eprintln!("adaptive-bridge: {error}");
    ExitCode::FAILURE
}

fn topic(text: &str) -> Result<TopicName, String> {
    TopicName::try_from(text).map_err(|error| error.to_string())
}

/// Takes a snapshot of the bridge that runs with these settings; `None` when no bridge runs.
fn read_bridge(root: &Path, settings: &Settings) -> Result<Option<Snapshot>, String> {
    Snapshot::take(root, settings).map_err(|error| match error {
        ShmError::Incompatible { .. } => format!(
            "the running bridge (instance {}) has a different version than this program; restart the whole \
             bridge",
            settings.instance
        ),
        other => other.to_string(),
    })
}

/// Takes a snapshot of the bridge, or prints why there is none and returns the exit code.
fn running_bridge(root: &Path, settings: &Settings) -> Result<Snapshot, ExitCode> {
    let snapshot = read_bridge(root, settings).map_err(|error| failed(&error))?;
    snapshot.ok_or_else(|| no_bridge(settings, root))
}

fn no_bridge(settings: &Settings, root: &Path) -> ExitCode {
    let services = Path::new("/run/adaptive-bridge");
    let hint = match std::fs::metadata(services) {
        Ok(_) if services != root => {
            "reach the bridge of the systemd services with `sudo -u adaptive-bridge adaptive-bridge …`, or start one"
        }
        _ => "start it",
    };
    failed(&format!(
        "no bridge runs as instance {} (root {}); {hint} with `adaptive-bridge up`",
        settings.instance,
        root.display()
    ))
}

/// The exit code after a write to stdout failed. A reader that closes the pipe early, as `head` does, is no
/// failure.
fn output_ended(error: &io::Error) -> ExitCode {
    match error.kind() {
        ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        _ => failed(&format!("stdout: {error}")),
    }
}

fn print(text: impl AsRef<[u8]>) -> Result<(), ExitCode> {
    io::stdout().write_all(text.as_ref()).map_err(|error| output_ended(&error))
}

/// Sleeps for `ms` and returns `true`; returns `false` as soon as a stop is requested.
fn pause(ms: u64, stop: &Stop) -> bool {
    const POLL_MS: u64 = 20;
    let end = clock::monotonic().plus_ms(ms);
    loop {
        let left_ns = end.since(clock::monotonic());
        if left_ns == 0 || stop.is_requested() {
            return !stop.is_requested();
        }
        #[allow(clippy::disallowed_methods, reason = "a subcommand handles no samples of the bridge")]
        std::thread::sleep(Duration::from_nanos(left_ns.min(POLL_MS * 1_000_000)));
    }
}
