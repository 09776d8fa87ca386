//! `report`: what a folder of results shows, as a page, as Markdown and as CSV.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::failed;
use crate::eval::report;

/// What `report` is asked.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The folder that `run` or `matrix` wrote to
    #[arg(value_name = "DIR")]
    results: PathBuf,
    /// Where the report is written [default: DIR]
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
    // Who reads may have gone: the report is written all the same.
    match writeln!(io::stdout(), "{}", lines.join("\n")) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => failed(&error),
        _ => ExitCode::SUCCESS,
    }
}
