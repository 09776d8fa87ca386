//! The `adaptive-bridge-eval` program: parses, dispatches, exits.

use std::process::ExitCode;

fn main() -> ExitCode {
    adaptive_bridge::eval::main()
}
