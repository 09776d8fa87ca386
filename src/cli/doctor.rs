//! `doctor`: what on this machine will hurt, what that means, and the command that mends it.

mod limits;
mod memory;
mod network;
mod services;

use std::fmt::{self, Write};
use std::fs;
use std::io::{self, Write as _};
use std::path::Path;
use std::process::{Command, ExitCode};

use clap::Args;
use serde::Serialize;

use super::{ConfigArguments, failed, output_ended};
use crate::config::{self, Settings};

/// What `doctor` is asked.
///
/// Exit codes: 0 nothing that hurts, 3 warnings, 4 errors: the bridge will not run, or not do its work.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Print JSON: one object with all findings
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    config: ConfigArguments,
}

/// How much a finding matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
enum Severity {
    /// As it should be.
    Ok,
    /// Worth to know.
    Note,
    /// It will hurt under load, or after a while.
    Warning,
    /// The bridge will not run, or not do its work.
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

/// What one check found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Finding {
    /// The check, by a name that stays the same.
    check: &'static str,
    severity: Severity,
    /// What was found.
    found: String,
    /// What it means for the bridge; empty where all is well.
    meaning: &'static str,
    /// What to type.
    command: Option<String>,
}

impl Finding {
    fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self { check, severity: Severity::Ok, found: found.into(), meaning: "", command: None }
    }

    fn new(check: &'static str, severity: Severity, found: impl Into<String>, meaning: &'static str) -> Self {
        Self { check, severity, found: found.into(), meaning, command: None }
    }

    fn mended_by(mut self, command: impl Into<String>) -> Self {
        self.command = Some(command.into());
        self
    }
}

/// All findings.
#[derive(Debug, Serialize)]
struct Diagnosis {
    /// The worst of them.
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

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let file = arguments.config.file();
    let mut findings = Vec::new();
    let settings = match arguments.config.try_load() {
        Ok(settings) => {
            findings.push(Finding::ok("configuration", format!("{} is good", file.display())));
            settings
        }
        Err(error) => {
            let problems = error.problems().len();
            findings.push(
                Finding::new(
                    "configuration",
                    Severity::Error,
                    format!("{}: {problems} problems", file.display()),
                    "No process of the bridge starts. What follows is judged by the defaults.",
                )
                .mended_by(format!("adaptive-bridge check --config {}", file.display())),
            );
            match config::parse("topics: [{id: none, input_topic: /none}]", "the defaults", &|_| None) {
                Ok(settings) => settings,
                Err(error) => return failed(&error),
            }
        }
    };
    findings.extend(check(&settings, &file));
    let diagnosis = Diagnosis::of(findings);
    let text = if arguments.json {
        match serde_json::to_string_pretty(&diagnosis) {
            Ok(text) => text + "\n",
            Err(error) => return failed(&error),
        }
    } else {
        diagnosis.to_string()
    };
    match io::stdout().write_all(text.as_bytes()) {
        Ok(()) => ExitCode::from(diagnosis.severity.exit_code()),
        Err(error) => output_ended(&error),
    }
}

fn check(settings: &Settings, file: &Path) -> Vec<Finding> {
    let mut findings = services::versions();
    findings.extend(network::check(settings));
    findings.extend(memory::check(settings));
    findings.extend(limits::check(settings));
    findings.extend(services::check(settings, file));
    findings
}

/// A number that the kernel shows in a file.
fn number(path: &str) -> Option<i64> {
    fs::read_to_string(path).ok()?.trim().parse().ok()
}

/// What a program prints, whatever its exit code; `None` when there is no such program.
fn output(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Items with commas between.
fn list<T: fmt::Display>(items: impl IntoIterator<Item = T>) -> String {
    let mut text = String::new();
    for item in items {
        let comma = if text.is_empty() { "" } else { ", " };
        // Writing to a String cannot fail.
        let _ = write!(text, "{comma}{item}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exit_code_is_that_of_the_worst_finding() {
        let found = |severity| Finding::new("x", severity, "y", "z");
        let code = |findings: &[Severity]| {
            Diagnosis::of(findings.iter().copied().map(found).collect()).severity.exit_code()
        };
        assert_eq!(code(&[]), 0);
        assert_eq!(code(&[Severity::Ok, Severity::Note]), 0);
        assert_eq!(code(&[Severity::Warning, Severity::Ok]), 3);
        assert_eq!(code(&[Severity::Error, Severity::Warning]), 4);
    }

    #[test]
    fn a_finding_says_what_it_means_and_what_to_type() {
        let finding = Finding::new("clock", Severity::Warning, "hpet", "Slow.").mended_by("fix it");
        let shown = Diagnosis::of(vec![finding]).to_string();
        assert_eq!(
            shown,
            "WARNING  clock              hpet\n\
             \x20                           Slow.\n\
             \x20                           $ fix it\n"
        );
    }
}
