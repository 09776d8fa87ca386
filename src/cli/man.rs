//! `man`: writes the manual pages, for building packages.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, CommandFactory};

use super::{Cli, failed};

/// The arguments of `man`.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The folder to write to, which must exist
    directory: PathBuf,
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    match clap_mangen::generate_to(Cli::command(), &arguments.directory) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let folder = arguments.directory.display();
            failed(&format!("cannot write the manual pages to {folder}: {error}"))
        }
    }
}
