//! The command line of `adaptive-bridge-eval`: one file for each subcommand.
//!
//! Exit codes: 0 success, 1 failed while running, 2 wrong command line. Logs go to stderr, results to stdout.

mod impair;
mod impair_report;
mod report;
mod runs;

use std::process::ExitCode;

use adaptive_bridge::telemetry;
use clap::{Parser, Subcommand};

/// Evaluate Adaptive Bridge: the paper's experiments and others, on simulated hosts and links
#[derive(Debug, Parser)]
#[command(name = "adaptive-bridge-eval", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List the scenarios
    List(runs::Folder),
    /// Run scenarios
    Run(runs::RunArguments),
    /// Run every scenario
    Matrix(runs::MatrixArguments),
    /// Write the report of a folder of results: HTML, Markdown and CSV
    Report(report::Arguments),
    /// Drop and delay packets that this network namespace receives from one host, until SIGINT or SIGTERM
    Impair(impair::Arguments),
}

/// Runs the program.
pub fn main() -> ExitCode {
    // clap prints help and errors itself, and exits with 0 or 2.
    let cli = Cli::parse();
    telemetry::start_logs();
    let ended = match cli.command {
        Command::List(folder) => runs::list(&folder),
        Command::Run(arguments) => runs::run(&arguments),
        Command::Matrix(arguments) => runs::matrix(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Impair(arguments) => impair::run(&arguments),
    };
    telemetry::flush_logs();
    ended
}

/// Prints why a command failed; returns its exit code.
fn failed(error: &dyn std::fmt::Display) -> ExitCode {
    eprintln!("adaptive-bridge-eval: {error}");
    ExitCode::FAILURE
}
