//! The `adaptive-bridge` program: parses, dispatches, exits.

use std::process::ExitCode;

fn main() -> ExitCode {
    adaptive_bridge::cli::main()
}
