//! `man`: writes the manual pages, for building packages.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, CommandFactory};

use super::{Cli, failed};

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The folder to write to, which must exist
    directory: PathBuf,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let folder = arguments.directory.display();
    clap_mangen::generate_to(Cli::command(), &arguments.directory)
        .map_err(|error| failed(&format!("cannot write the manual pages to {folder}: {error}")))?;
    Ok(ExitCode::SUCCESS)
}
