//! The receive buffers of a kernel without settings, for the sockets of a while.

use std::fs;
use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};

/// The hidden argument of the program that keeps the settings.
pub const ROLE: &str = "__stock_buffers";

/// What Linux sets for a socket's receive buffer, in bytes.
const STOCK_BYTES: &str = "212992";
const SETTINGS: [&str; 2] = ["/proc/sys/net/core/rmem_max", "/proc/sys/net/core/rmem_default"];

/// Until it is dropped, sockets get receive buffers of 208 KiB at most.
///
/// A program of its own changes the settings, and restores them when this process ends, however it ends: it
/// is in another process group, so that Ctrl-C does not reach it, and notices the end of its stdin.
pub struct StockBuffers(Child);

impl StockBuffers {
    /// # Errors
    /// The settings cannot be changed, and are others.
    pub fn set() -> Result<Self, String> {
        let executable = std::env::current_exe().map_err(|error| error.to_string())?;
        let mut command = Command::new(executable);
        command.arg(ROLE).stdin(Stdio::piped()).stdout(Stdio::piped()).process_group(0);
        let mut child = command.spawn().map_err(|error| error.to_string())?;
        let mut answer = String::new();
        if let Some(stdout) = child.stdout.take() {
            let _ = BufReader::new(stdout).read_line(&mut answer);
        }
        let keeper = Self(child);
        if answer.trim() == "ready" { Ok(keeper) } else { Err(answer.trim().to_owned()) }
    }
}

impl Drop for StockBuffers {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

/// The program: sets both, says so, and restores them when its stdin ends.
pub fn keep() -> Result<(), String> {
    let mut before = Vec::new();
    let mut outcome = Ok(());
    for setting in SETTINGS {
        let read = fs::read_to_string(setting).map_err(|error| format!("{setting}: {error}"));
        outcome = read.and_then(|value| {
            if value.trim() == STOCK_BYTES {
                return Ok(());
            }
            before.push((setting, value.clone()));
            fs::write(setting, STOCK_BYTES)
                .map_err(|error| format!("{setting} is {}, not {STOCK_BYTES}: {error}", value.trim()))
        });
        if outcome.is_err() {
            break;
        }
    }
    println!("{}", outcome.as_ref().map_or_else(String::as_str, |()| "ready"));
    let _ = io::stdout().flush();
    if outcome.is_ok() {
        let _ = io::stdin().read_to_end(&mut Vec::new());
    }
    for (setting, value) in before {
        let _ = fs::write(setting, value);
    }
    // Its caller reports the error.
    Ok(())
}
