//! The command line of `adaptive-bridge-eval`: one file for each subcommand.
//!
//! Exit codes: 0 done, 1 failed while running, 2 wrong command line. Logs go to stderr; what a program may
//! want to read goes to stdout, and nothing else does.

mod impair;
mod impair_report;
mod report;
mod runs;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::telemetry;

/// The evaluation of Adaptive Bridge: the paper's experiments and more, on hosts and links of its own.
#[derive(Debug, Parser)]
#[command(name = "adaptive-bridge-eval", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show the scenarios
    List(runs::Folder),
    /// Run scenarios
    Run(runs::RunArguments),
    /// Run every scenario
    Matrix(runs::MatrixArguments),
    /// Make the report of a folder of results: HTML, Markdown and CSV
    Report(report::Arguments),
    /// Lose and delay what this network namespace receives from one host, until SIGINT or SIGTERM
    Impair(impair::Arguments),
}

/// Runs the program.
pub fn main() -> ExitCode {
    // clap prints help and errors itself, and exits with 0 or 2.
    let cli = Cli::parse();
    telemetry::start_logs();
    match cli.command {
        Command::List(folder) => runs::list(&folder),
        Command::Run(arguments) => runs::run(&arguments),
        Command::Matrix(arguments) => runs::matrix(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Impair(arguments) => impair::run(&arguments),
    }
}

/// Prints why a command failed, and gives its exit code.
fn failed(error: &dyn std::fmt::Display) -> ExitCode {
    eprintln!("adaptive-bridge-eval: {error}");
    ExitCode::FAILURE
}
