//! The `adaptive-bridge-eval` program: runs its command line.

use std::process::ExitCode;

fn main() -> ExitCode {
    adaptive_bridge_eval::main()
}
