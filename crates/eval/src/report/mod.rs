//! The report of a folder of results: the paper's tables and figures with our values beside the paper's,
//! further figures that the paper does not have, and verdicts on its hypotheses.

mod cells;
mod context;
mod csv;
mod error;
mod figures;
mod format;
mod html;
#[cfg(test)]
mod made_up;
mod markdown;
mod measures;
mod metrics;
mod paper;
mod plot;
mod record;
mod tables;
mod verdict;

use std::fs;
use std::path::{Path, PathBuf};

pub use error::ReportError;

use cells::Results;
use context::Context;
use record::Folder;

/// A summary of the written report, for the terminal.
#[derive(Debug)]
pub struct Written {
    /// The paths of the written files.
    pub files: Vec<PathBuf>,
    /// The verdicts, a line each.
    pub verdicts: Vec<String>,
    /// Warnings that apply to the whole report.
    pub warnings: Vec<String>,
    /// Runs that are not in the report, with the reason.
    pub unusable: Vec<String>,
}

/// Reads the results in `results` and writes `report.html`, `report.md`, `figures.csv`, `runs.csv` and
/// `verdicts.csv` into `out`, which is created if it does not exist.
///
/// # Errors
/// There are no results, or a file cannot be read or written. A run that cannot be read is no error; the
/// report lists it.
pub fn write(results: &Path, out: &Path) -> Result<Written, ReportError> {
    let results = Results::new(Folder::read(results)?);
    let findings = verdict::findings(&results);
    let context = Context::of(&results);
    fs::create_dir_all(out).map_err(ReportError::file(out))?;
    let has_notes = out.join("README.md").exists();
    let contents = [
        ("report.html", html::page(&results, &findings, &context)),
        ("report.md", markdown::page(&results, &findings, &context, has_notes)),
        ("figures.csv", csv::figures(&results)),
        ("runs.csv", csv::runs(&results)),
        ("verdicts.csv", csv::verdicts(&findings)),
    ];
    let mut files = Vec::new();
    for (name, content) in contents {
        let path = out.join(name);
        fs::write(&path, content).map_err(ReportError::file(&path))?;
        files.push(path);
    }
    let verdicts = findings.iter().map(|one| format!("{}: {}. {}", one.id, one.verdict.name(), one.because));
    Ok(Written {
        files,
        verdicts: verdicts.collect(),
        warnings: context.warnings,
        unusable: results.unusable.iter().map(|(name, reason)| format!("{name}: {reason}")).collect(),
    })
}
