//! The `adaptive-bridge` program: runs its command line.

use std::process::ExitCode;

fn main() -> ExitCode {
    adaptive_bridge::cli::main()
}
