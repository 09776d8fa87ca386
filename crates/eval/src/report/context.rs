//! The context of the figures: machine and software of the runs, warnings, and missing runs.

use std::collections::BTreeSet;
use std::time::{Duration, UNIX_EPOCH};

use super::cells::{Results, reading_name};
use super::format;
use super::paper;
use super::record::{Manifest, Role, Run};

/// Texts about the runs of a report.
pub struct Context {
    /// A paragraph about the number of runs, their settings, and how to read the tables.
    pub summary: String,
    /// Warnings that apply to the whole report.
    pub warnings: Vec<String>,
    /// Name and values of each fact; several values if runs differ.
    pub facts: Vec<(&'static str, Vec<String>)>,
    /// Problems that were recorded in the manifests of runs.
    pub problems: Vec<String>,
    /// Scenarios of the paper that were not run in a setting.
    pub not_run: Vec<String>,
}

impl Context {
    /// Collects the context of all results.
    pub fn of(results: &Results) -> Self {
        let mut warnings = Vec::new();
        if results.any_synthetic() {
            warnings.push("Made-up data, for tests of this report. Nothing here was measured.".to_owned());
        }
        if results.any_quick() {
            warnings.push(
                "Smoke runs (--quick): they show that the evaluation works; their figures have no meaning."
                    .to_owned(),
            );
        }
        let problems: Vec<String> = results
            .runs
            .iter()
            .flat_map(|run| {
                run.manifest.problems.iter().map(|problem| format!("{}: {problem}", run.manifest.run))
            })
            .collect();
        if !problems.is_empty() {
            warnings.push(format!(
                "{} problems were recorded during runs: see \"Problems of runs\" below.",
                problems.len()
            ));
        }
        if !results.unusable.is_empty() {
            warnings.push(format!("{} runs failed or could not be read.", results.unusable.len()));
        }
        let (summary, facts, not_run) = (summary(results), facts(results), not_run(results));
        Self { summary, warnings, facts, problems, not_run }
    }
}

fn summary(results: &Results) -> String {
    let libraries: BTreeSet<&str> = results.places().into_iter().map(|place| place.library_name()).collect();
    let beds: BTreeSet<String> = results.places().into_iter().map(|place| place.bed_name()).collect();
    let joined = |set: BTreeSet<&str>| set.into_iter().collect::<Vec<_>>().join(" and ");
    let cells = results.cells().count();
    let repetitions: Vec<usize> = results.cells().map(|cell| cell.runs.len()).collect();
    let (least, most) = (repetitions.iter().min().unwrap_or(&0), repetitions.iter().max().unwrap_or(&0));
    let repetitions = match (least, most) {
        (1, 1) => "once".to_owned(),
        (least, most) if least == most => format!("{most} times"),
        (least, most) => format!("{least} to {most} times"),
    };
    let mut summary = format!(
        "{} runs: {cells} experiments, each {}, with {} on {}. Below a figure are the paper's value and the \
         deviation from it.",
        results.runs.len(),
        repetitions,
        joined(libraries),
        beds.into_iter().collect::<Vec<_>>().join(" and ")
    );
    if results.cells().any(|cell| (2..6).contains(&cell.runs.len())) {
        summary += " The interval of two to five runs is their range.";
    }
    // The paper's subscribers have KEEP_ALL.
    let critical = results.runs.iter().flat_map(|run| &run.manifest.endpoints);
    if critical.clone().any(|one| one.role == Role::Critical && one.history.starts_with("KEEP_LAST")) {
        summary += " Critical subscribers with KEEP_LAST: newer samples replace those that come late, which \
                    count as lost.";
    }
    summary
}

fn facts(results: &Results) -> Vec<(&'static str, Vec<String>)> {
    /// The largest number of different values of a fact that are listed; further ones are only counted.
    const SHOWN: usize = 8;
    let distinct = |of: &dyn Fn(&Run) -> Vec<String>| {
        let mut values: Vec<String> = Vec::new();
        for value in results.runs.iter().flat_map(of) {
            if !values.contains(&value) {
                values.push(value);
            }
        }
        let more = values.len().saturating_sub(SHOWN);
        values.truncate(SHOWN);
        if more > 0 {
            values.push(format!("and {more} more"));
        }
        values
    };
    let one = |of: fn(&Run) -> String| distinct(&|run| vec![of(run)]);
    let mut facts = vec![
        ("When", vec![span(results)]),
        (
            "Machine",
            one(|run| {
                let machine = &run.manifest.machine;
                format!(
                    "{}, {} CPUs, {}",
                    machine.cpu,
                    machine.cpus,
                    format::bytes(machine.memory_bytes as f64)
                )
            }),
        ),
        ("System", one(|run| format!("{}, kernel {}", run.manifest.machine.os, run.manifest.machine.kernel))),
        ("Load average before a run", vec![load(results)]),
        ("CPU time that the hypervisor took (steal)", vec![stolen(results)]),
        (
            "Commit",
            one(|run| {
                let software = &run.manifest.software;
                let changes = if software.modified { ", with uncommitted changes" } else { "" };
                format!(
                    "{}{changes} (version {})",
                    software.commit.as_deref().unwrap_or("not from a checkout"),
                    software.version
                )
            }),
        ),
        ("Bridge", distinct(&|run| run.manifest.software.bridge.iter().cloned().collect())),
        ("DDS library of publishers and subscribers", one(|run| run.manifest.software.peer.clone())),
        (
            "Links impaired by",
            distinct(&|run| {
                let outcomes = run.manifest.links.iter().filter_map(|link| {
                    let at = if link.before_switch { "before the switch" } else { "at the receiver" };
                    let outcome = link.impairment.as_ref()?;
                    Some(format!("{} {at} ({})", outcome.backend, outcome.reason))
                });
                outcomes.collect()
            }),
        ),
        ("Traces of links, and their losses", distinct(&|run| traces(&run.manifest))),
        (
            "Seeds of the links",
            distinct(&|run| {
                let outcomes = run.manifest.links.iter().filter_map(|link| link.impairment.as_ref());
                outcomes.filter_map(|outcome| Some(outcome.seed?.to_string())).collect()
            }),
        ),
        ("Command", one(|run| run.manifest.command_line.join(" "))),
        (
            "Measured window",
            one(|run| format!("{} s: {}", format::count(run.manifest.duration_s), run.manifest.scenario)),
        ),
        (
            "Programs",
            distinct(&|run| {
                let endpoint = |one: &super::record::Endpoint| {
                    let environment: Vec<String> =
                        one.environment.iter().map(|(name, value)| format!("{name}={value}")).collect();
                    format!("{} {}", environment.join(" "), one.command_line.join(" ")).trim().to_owned()
                };
                run.manifest.endpoints.iter().take(1).map(endpoint).collect()
            }),
        ),
    ];
    facts.retain(|(_, values)| !values.is_empty());
    facts
}

/// The losses of a run's links that followed a trace, with the expected losses.
fn traces(manifest: &Manifest) -> Vec<String> {
    let outcomes = manifest.links.iter().filter_map(|link| {
        let outcome = link.impairment.as_ref()?;
        let trace = outcome.trace.as_ref()?;
        let error = outcome.loss_standard_error.filter(|_| outcome.judged > 0)?;
        let [lost, expected, error] =
            [outcome.lost as f64 / outcome.judged as f64, outcome.loss_expected, 1.96 * error]
                .map(format::percent);
        Some(format!(
            "{} {} by {}: {lost} of {} packets lost, expected {expected} ± {error}",
            manifest.run, link.name, trace.file, outcome.judged
        ))
    });
    outcomes.collect()
}

fn span(results: &Results) -> String {
    let begins = || results.runs.iter().map(|run| run.manifest.begin_unix_ms);
    let text = |time_ms: u64| {
        let time = UNIX_EPOCH.checked_add(Duration::from_millis(time_ms)).unwrap_or(UNIX_EPOCH);
        humantime::format_rfc3339_seconds(time).to_string()
    };
    match (begins().min(), begins().max()) {
        (Some(first), Some(last)) if first != last => format!("{} to {}", text(first), text(last)),
        (Some(first), _) => text(first),
        _ => String::new(),
    }
}

fn load(results: &Results) -> String {
    let loads = || results.runs.iter().map(|run| run.manifest.machine.load_before);
    let (least, most) = (loads().fold(f64::INFINITY, f64::min), loads().fold(0.0, f64::max));
    format!("{} to {}", format::number(least, 1), format::number(most, 1))
}

fn stolen(results: &Results) -> String {
    let stolen = || results.runs.iter().filter_map(|run| run.manifest.machine.stolen_percent);
    let Some(least) = stolen().reduce(f64::min) else { return "not recorded".to_owned() };
    let most = stolen().fold(0.0, f64::max);
    let of = match results.runs.len() - stolen().count() {
        0 => String::new(),
        unknown => format!(", not recorded in {unknown} runs"),
    };
    format!("{} to {} %{of}", format::number(least, 0), format::number(most, 0))
}

/// Lists the paper's scenarios that are missing in a setting in which other scenarios were run.
fn not_run(results: &Results) -> Vec<String> {
    let mut missing = Vec::new();
    for place in results.places() {
        for reading in results.readings(place) {
            for row in paper::TABLE_II.iter().chain(&paper::TABLE_III) {
                if results.cell(place, &reading, row.scenario).is_none() {
                    missing.push(format!("{} {}: {}", row.scenario, reading_name(&reading), place.name()));
                }
            }
        }
    }
    missing
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::made_up::{MadeUp, results};

    #[test]
    fn the_summary_explains_intervals_and_losses_only_if_there_are_any() {
        let run = MadeUp::default();
        let one = summary(&results(std::slice::from_ref(&run)));
        assert!(!one.contains("range") && !one.contains("KEEP_LAST"), "{one}");
        let mut three = results(&[run.clone(), run.clone(), run]);
        three.runs[1].manifest.endpoints[1].history = "KEEP_LAST 10".to_owned();
        let three = summary(&three);
        assert!(three.contains("their range") && three.contains("KEEP_LAST"), "{three}");
    }
}
