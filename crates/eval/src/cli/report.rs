//! `report`: writes the report of a folder of results as HTML, Markdown and CSV.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::failed;
use crate::report;

/// Command-line arguments of `report`.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The folder that `run` or `matrix` wrote to
    #[arg(value_name = "DIR")]
    results: PathBuf,
    /// The folder that the report is written to [default: DIR]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let out = arguments.out.as_ref().unwrap_or(&arguments.results);
    let written = match report::write(&arguments.results, out) {
        Ok(written) => written,
        Err(error) => return failed(&error),
    };
    for problem in written.warnings.iter().chain(&written.unusable) {
        eprintln!("adaptive-bridge-eval: {problem}");
    }
    let files = written.files.iter().map(|file| file.display().to_string());
    let lines: Vec<String> = written.verdicts.iter().cloned().chain(files).collect();
    // A closed stdout is no failure: the report's files are written.
    match writeln!(io::stdout(), "{}", lines.join("\n")) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => failed(&error),
        _ => ExitCode::SUCCESS,
    }
}
