//! Runs the programs that set up the network.

use std::ffi::OsString;
use std::process::{Command, Stdio};

use super::error::ImpairmentError;

/// The folders of system programs on Debian, which are not in every user's PATH.
const SYSTEM_FOLDERS: &str = "/usr/local/sbin:/usr/sbin:/sbin";

/// Runs a program and waits for its end; returns its stdout.
pub(crate) fn run(words: &[String]) -> Result<String, ImpairmentError> {
    let failed = |message: String| ImpairmentError::Command { command: words.join(" "), message };
    let Some((program, arguments)) = words.split_first() else {
        return Err(failed("no program".to_owned()));
    };
    let mut command = Command::new(program);
    command.args(arguments).env("PATH", path()).env("LC_ALL", "C").stdin(Stdio::null());
    let output = command.output().map_err(|error| failed(error.to_string()))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    Err(failed(format!("{} ({})", stderr.trim().replace('\n', "; "), output.status)))
}

fn path() -> OsString {
    let mut path = std::env::var_os("PATH").unwrap_or_default();
    if !path.is_empty() {
        path.push(":");
    }
    path.push(SYSTEM_FOLDERS);
    path
}

/// Splits a command line without quotes into words.
pub(crate) fn words(line: &str) -> Vec<String> {
    line.split_whitespace().map(str::to_owned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_has_the_command_and_its_error_message() {
        let error = run(&words("ls /nowhere-at-all")).expect_err("no such folder").to_string();
        assert!(error.contains("`ls /nowhere-at-all`") && error.contains("No such file"), "{error}");
        let error = run(&words("no-such-program a")).expect_err("no such program").to_string();
        assert!(error.contains("`no-such-program a`"), "{error}");
        assert!(run(&[]).is_err());
        assert_eq!(run(&words("echo a  b")).expect("it runs"), "a b\n");
    }
}
