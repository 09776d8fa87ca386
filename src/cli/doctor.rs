//! `doctor`: checks this machine for conditions that impair the bridge and shows how to fix them.

mod limits;
mod memory;
mod network;
mod services;

use std::fmt;
use std::fs;
use std::path::Path;
use std::process::{Command, ExitCode};

use clap::Args;
use serde::Serialize;

use super::{ConfigArguments, failed, print};
use crate::config::{self, Settings};

/// The arguments of `doctor`.
///
/// Exit codes: 0 no warning, 3 warnings, 4 errors: the bridge will not start or not work.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Print JSON: one object with all findings
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    config: ConfigArguments,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
enum Severity {
    /// No problem.
    Ok,
    /// A fact to know.
    Note,
    /// A condition that impairs the bridge under load, or after some time.
    Warning,
    /// A condition with which the bridge will not start or not work.
    Error,
}

impl Severity {
    const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Warning => "WARNING",
            Self::Error => "ERROR",
        }
    }

    const fn exit_code(self) -> u8 {
        match self {
            Self::Ok | Self::Note => 0,
            Self::Warning => 3,
            Self::Error => 4,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Finding {
    /// The stable name of the check.
    check: &'static str,
    severity: Severity,
    /// The state that the check found.
    found: String,
    /// The consequence for the bridge; empty without a problem.
    meaning: &'static str,
    /// The command that fixes it.
    command: Option<String>,
}

impl Finding {
    fn new(check: &'static str, severity: Severity, found: impl Into<String>) -> Self {
        Self { check, severity, found: found.into(), meaning: "", command: None }
    }

    fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Severity::Ok, found)
    }

    fn note(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Severity::Note, found)
    }

    fn warning(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Severity::Warning, found)
    }

    fn error(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Severity::Error, found)
    }

    fn means(self, meaning: &'static str) -> Self {
        Self { meaning, ..self }
    }

    fn with_command(mut self, command: impl Into<String>) -> Self {
        self.command = Some(command.into());
        self
    }
}

#[derive(Debug, Serialize)]
struct Diagnosis {
    /// The worst severity of the findings.
    severity: Severity,
    findings: Vec<Finding>,
}

impl Diagnosis {
    fn of(findings: Vec<Finding>) -> Self {
        let severity = findings.iter().map(|finding| finding.severity).max().unwrap_or(Severity::Ok);
        Self { severity, findings }
    }
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for finding in &self.findings {
            writeln!(f, "{:<8} {:<18} {}", finding.severity.label(), finding.check, finding.found)?;
            if !finding.meaning.is_empty() {
                writeln!(f, "{:27} {}", "", finding.meaning)?;
            }
            if let Some(command) = &finding.command {
                writeln!(f, "{:27} $ {command}", "")?;
            }
        }
        Ok(())
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let file = arguments.config.file();
    let mut findings = Vec::new();
    let settings = match arguments.config.try_load() {
        Ok(settings) => {
            findings.push(Finding::ok("configuration", format!("{} is good", file.display())));
            settings
        }
        Err(error) => {
            let problems = error.problems.len();
            findings.push(
                Finding::error("configuration", format!("{}: {problems} problems", file.display()))
                    .means("No process of the bridge starts. The following checks use the default settings.")
                    .with_command(format!("adaptive-bridge check --config {}", file.display())),
            );
            config::parse("topics: [{id: none, input_topic: /none}]", "the defaults", &|_| None)
                .map_err(|error| failed(&error))?
        }
    };
    findings.extend(check(&settings, &file));
    let diagnosis = Diagnosis::of(findings);
    let text = if arguments.json {
        serde_json::to_string_pretty(&diagnosis).map_err(|error| failed(&error))? + "\n"
    } else {
        diagnosis.to_string()
    };
    print(text)?;
    Ok(ExitCode::from(diagnosis.severity.exit_code()))
}

fn check(settings: &Settings, file: &Path) -> Vec<Finding> {
    let mut findings = services::versions();
    findings.extend(network::check(settings));
    findings.extend(memory::check(settings));
    findings.extend(limits::check(settings));
    findings.extend(services::check(settings, file));
    findings
}

/// Reads a file of the kernel that holds one number.
fn number(path: &str) -> Option<i64> {
    fs::read_to_string(path).ok()?.trim().parse().ok()
}

/// Runs a program and returns its stdout, whatever its exit code; `None` when the program cannot be started.
fn output(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// A number of bytes in MiB, rounded up.
const fn mib(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

fn list<T: fmt::Display>(items: impl IntoIterator<Item = T>) -> String {
    items.into_iter().map(|item| item.to_string()).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exit_code_is_that_of_the_worst_finding() {
        let found = |severity| Finding::new("x", severity, "y").means("z");
        let code = |findings: &[Severity]| {
            Diagnosis::of(findings.iter().copied().map(found).collect()).severity.exit_code()
        };
        assert_eq!(code(&[]), 0);
        assert_eq!(code(&[Severity::Ok, Severity::Note]), 0);
        assert_eq!(code(&[Severity::Warning, Severity::Ok]), 3);
        assert_eq!(code(&[Severity::Error, Severity::Warning]), 4);
    }

    #[test]
    fn a_finding_is_shown_with_its_meaning_and_its_command() {
        let finding = Finding::new("clock", Severity::Warning, "hpet").means("Slow.").with_command("fix it");
        let shown = Diagnosis::of(vec![finding]).to_string();
        assert_eq!(
            shown,
            "WARNING  clock              hpet\n\
             \x20                           Slow.\n\
             \x20                           $ fix it\n"
        );
    }
}
