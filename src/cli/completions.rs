//! `completions`: prints the script with which a shell completes command lines of this program.

use std::process::ExitCode;

use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::{Cli, print};

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The shell
    shell: Shell,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let mut command = Cli::command();
    let name = command.get_name().to_owned();
    // Generated in memory first, because the generator panics when a write fails.
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut command, name, &mut script);
    print(script)?;
    Ok(ExitCode::SUCCESS)
}
