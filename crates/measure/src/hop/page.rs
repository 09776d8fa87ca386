//! Fills the tables of docs/performance-runs.md and docs/performance.md, and makes the README of a run. The
//! text of the pages is written by hand; everything between `<!-- figures:SECTION -->` and `<!-- end -->` is
//! generated from runs.

use std::fmt::Write as _;

use super::figures::figures;
use super::summary::Summary;
use super::{large, tables, targets};

const BEGIN: &str = "<!-- figures:";
const END: &str = "<!-- end -->";

/// The path of the runs, relative to the page.
const RUNS: &str = "../benches/runs/";

/// All sections, with their titles in the README of a run.
const SECTIONS: [(&str, &str); 12] = [
    ("targets", "Targets"),
    ("large", "Large samples"),
    ("latency-other", "Latency, scheduling other"),
    ("latency-fifo", "Latency, scheduling fifo, memory locked"),
    ("loss", "Loss"),
    ("throughput", "Throughput"),
    ("resources", "CPU, wake-ups, memory"),
    ("calls", "System calls"),
    ("routes", "Routes"),
    ("lanes", "Lanes"),
    ("isolation", "Isolation"),
    ("soak", "Memory over time"),
];

/// A section of docs/performance.md, whose figures are all in section `large` too.
const SUMMARY: &str = "large-targets";

/// Replaces the figures of the page by those of the runs, which are pairs of folder name and summary. Each
/// section shows the first run that has it, or `Not measured yet.`
///
/// # Errors
/// The page has an unknown section, or one without an end.
pub fn fill(page: &str, runs: &[(String, Summary)]) -> Result<String, String> {
    let mut filled = String::new();
    let mut rest = page;
    while let Some(at) = rest.find(BEGIN) {
        let (before, from) = rest.split_at(at);
        let (head, _) = from.split_once('\n').ok_or("the last section has no end")?;
        let name = head.trim_start_matches(BEGIN).trim_end().trim_end_matches("-->").trim();
        let end = from.find(END).ok_or_else(|| format!("section {name} has no end"))?;
        if from[head.len()..end].contains(BEGIN) {
            return Err(format!("section {name} has no end"));
        }
        let text = if name == "runs" { Some(list(runs)) } else { of_runs(name, runs)? };
        let text = text.unwrap_or_else(|| "Not measured yet.\n".to_owned());
        let _ = write!(filled, "{before}{head}\n{}\n{END}", text.trim_end());
        rest = &from[end + END.len()..];
    }
    Ok(filled + rest)
}

fn list(runs: &[(String, Summary)]) -> String {
    let mut text = String::new();
    for (name, summary) in runs {
        let _ = writeln!(text, "[{name}]({RUNS}{name}/README.md):\n\n{}", tables::run(summary));
    }
    if text.is_empty() { "No runs yet.\n".to_owned() } else { text }
}

/// The names of the runs that the page links to.
pub fn runs_named(page: &str) -> Vec<String> {
    let before = format!("]({RUNS}");
    let links = page.split(before.as_str()).skip(1);
    let names = links.filter_map(|rest| rest.split(')').next()?.strip_suffix("/README.md"));
    names.map(str::to_owned).collect()
}

fn of_runs(name: &str, runs: &[(String, Summary)]) -> Result<Option<String>, String> {
    if name != SUMMARY && !SECTIONS.iter().any(|(known, _)| *known == name) {
        return Err(format!("{name} is not a section of a run"));
    }
    if name == "targets" {
        // The targets need the figures of all runs together.
        let mut all = Summary::default();
        for (_, summary) in runs.iter().rev() {
            all.take(summary);
        }
        return Ok(section(name, &all, ""));
    }
    Ok(runs.iter().find_map(|(run, summary)| section(name, summary, &format!("{RUNS}{run}/"))))
}

impl Summary {
    /// Replaces the sections that the other run has.
    fn take(&mut self, other: &Self) {
        let other = other.clone();
        if !other.latency.is_empty() {
            self.latency = other.latency;
        }
        if !other.loss.is_empty() {
            self.loss = other.loss;
        }
        if !other.resources.is_empty() {
            self.resources = other.resources;
        }
        if !other.isolation.is_empty() {
            self.isolation = other.isolation;
        }
        if other.soak.is_some() {
            self.soak = other.soak;
        }
    }
}

/// The tables and plots of a section; `plots` is the path of the plots.
fn section(name: &str, summary: &Summary, plots: &str) -> Option<String> {
    let files = figures(summary);
    let plot = |file: &str, alt: &str| {
        let there = files.iter().any(|(known, _)| known == file);
        if there { format!("![{alt}]({plots}{file})\n\n") } else { String::new() }
    };
    let text = match name {
        "targets" => targets::table(summary)?,
        "latency-other" | "latency-fifo" => {
            let scheduling = name.trim_start_matches("latency-");
            let hops = tables::hops(summary, scheduling)?;
            let stages = tables::stages(summary, scheduling).unwrap_or_default();
            let all = tables::latencies(summary, scheduling).unwrap_or_default();
            plot(&format!("{name}.svg"), "Latency over rate, by payload")
                + &format!("{hops}\nStages of the bridge:\n\n{stages}\n")
                + &format!("<details><summary>All figures of each program</summary>\n\n{all}\n</details>\n")
        }
        "large" => large::section(summary, &plot)?,
        SUMMARY => large::summary(summary, &plot)?,
        "loss" => tables::loss(summary)?,
        "throughput" => {
            plot("throughput.svg", "Highest rate without loss, by payload") + &tables::throughput(summary)?
        }
        "resources" => {
            plot("cpu.svg", "CPU per thousand samples")
                + &tables::totals(summary)?
                + "\n<details><summary>Each process</summary>\n\n"
                + &tables::resources(summary)?
                + "\n</details>\n"
        }
        "calls" => tables::calls(summary)?,
        "routes" | "lanes" => {
            let alt = format!("Latency and CPU over the number of {name}");
            plot(&format!("{name}.svg"), &alt) + &tables::scale(summary, name)?
        }
        "isolation" => {
            let alt = "Critical latency by condition of the noncritical lane";
            plot("isolation-other.svg", alt) + &plot("isolation-fifo.svg", alt) + &tables::isolation(summary)?
        }
        "soak" => plot("soak.svg", "Memory of each process over time") + &tables::soak(summary)?,
        _ => return None,
    };
    Some(text)
}

/// The README of a run, with all its sections.
pub fn readme(summary: &Summary) -> String {
    let mut text = format!("# Bench run of {}\n\n{}", summary.date, tables::run(summary));
    for (name, title) in SECTIONS {
        if let Some(section) = section(name, summary, "") {
            let _ = write!(text, "\n## {title}\n\n{section}");
        }
    }
    text
}
