//! Verdicts on the paper's hypotheses (section IV-A), computed from the data by rules that are part of them.
//!
//! A verdict is of what was run. It can come out as not confirmed, and what was not run is never confirmed.

mod below;
mod h1;
mod h2;
mod h3;
#[cfg(test)]
mod tests;

pub use h1::mechanism;

use super::cells::{Cell, Results};

/// What became of a hypothesis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// All that it takes was run, and holds.
    Confirmed,
    /// Some of it holds, and some doesn't.
    Partly,
    /// It was run, and doesn't hold.
    NotConfirmed,
    /// What was run holds; not all that it takes was run.
    Incomplete,
    /// Nothing of it was seen; not all that it takes was run.
    NotSeen,
    /// What it takes was not run, or only as a smoke run.
    NotTested,
}

impl Verdict {
    /// In words.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Partly => "partly confirmed",
            Self::NotConfirmed => "not confirmed",
            Self::Incomplete => "holds so far, incomplete",
            Self::NotSeen => "not seen so far, incomplete",
            Self::NotTested => "not tested",
        }
    }
}

/// Something that was looked at, in one place.
#[derive(Clone, Debug)]
pub struct Criterion {
    /// What has to hold; criteria of the same rule are judged together.
    pub rule: String,
    /// Where.
    pub place: String,
    /// What was found.
    pub found: String,
    pub holds: bool,
}

/// A hypothesis, and what the data say of it.
#[derive(Clone, Debug)]
pub struct Finding {
    /// Such as `H1`.
    pub id: &'static str,
    pub title: String,
    /// What it claims, and by which rule it is judged.
    pub claim: &'static str,
    pub verdict: Verdict,
    /// Why, in a sentence or a few.
    pub because: String,
    pub criteria: Vec<Criterion>,
    /// What would have to be run for a full verdict.
    pub missing: Vec<String>,
}

impl Finding {
    /// Judges by all criteria: each rule holds where it holds everywhere.
    fn judged(
        id: &'static str,
        title: &str,
        claim: &'static str,
        criteria: Vec<Criterion>,
        missing: Vec<String>,
    ) -> Self {
        let mut rules: Vec<&str> = criteria.iter().map(|criterion| criterion.rule.as_str()).collect();
        rules.sort_unstable();
        rules.dedup();
        let broken: Vec<&str> = rules
            .iter()
            .copied()
            .filter(|rule| criteria.iter().any(|criterion| criterion.rule == *rule && !criterion.holds))
            .collect();
        let verdict = match (rules.len(), broken.len(), missing.len()) {
            (0, _, _) => Verdict::NotTested,
            (_, 0, 0) => Verdict::Confirmed,
            (_, 0, _) => Verdict::Incomplete,
            (rules, broken, _) if broken < rules => Verdict::Partly,
            _ => Verdict::NotConfirmed,
        };
        let because = if rules.is_empty() {
            "Nothing of what it takes was run.".to_owned()
        } else if broken.is_empty() {
            format!("{}, in all {} places that were looked at.", rules_text(rules.len()), criteria.len())
        } else {
            let sentences: Vec<String> = broken.iter().map(|rule| broken_text(rule, &criteria)).collect();
            sentences.join(" ")
        };
        Self { id, title: title.to_owned(), claim, verdict, because, criteria, missing }
    }
}

fn rules_text(count: usize) -> String {
    match count {
        1 => "The rule holds".to_owned(),
        2 => "Both rules hold".to_owned(),
        _ => format!("All {count} rules hold"),
    }
}

/// A rule that does not hold, where not, and what was found at the first of these places.
fn broken_text(rule: &str, criteria: &[Criterion]) -> String {
    let of_rule = || criteria.iter().filter(|criterion| criterion.rule == rule);
    let broken: Vec<&Criterion> = of_rule().filter(|criterion| !criterion.holds).collect();
    let first = broken.first().map(|one| format!(": {} in {}", one.found, one.place)).unwrap_or_default();
    format!("That {rule} does not hold in {} of {} places{first}.", broken.len(), of_rule().count())
}

/// What the data say of each hypothesis, in their order. A smoke run says nothing.
pub fn findings(results: &Results) -> Vec<Finding> {
    let mut findings = vec![
        h1::finding(results, "as-printed"),
        h1::finding(results, "as-run"),
        h2::finding(results),
        h3::finding(results),
        below::finding(results),
    ];
    if results.any_quick() {
        for finding in findings.iter_mut().filter(|finding| finding.verdict != Verdict::NotTested) {
            finding.verdict = Verdict::NotTested;
            finding.because = "These are smoke runs (--quick): too short for a verdict.".to_owned();
        }
    }
    findings
}

/// Scenarios of the paper that were not run in each library and reading: what a full verdict takes.
fn missing(results: &Results, scenarios: &[&str]) -> Vec<String> {
    let mut missing = Vec::new();
    for (library, name) in [("fast", "Fast DDS"), ("cyclone", "Cyclone DDS")] {
        for scenario in scenarios {
            // Without loss there is only one reading.
            let readings: &[&str] =
                if scenario.ends_with("clean") { &[""] } else { &["as-printed", "as-run"] };
            for reading in readings {
                let is_it = |cell: &Cell| {
                    cell.place.library == library
                        && cell.scenario == *scenario
                        && cell.reading.as_deref().unwrap_or_default() == *reading
                };
                if !results.cells().any(is_it) {
                    let reading = super::cells::reading_name(reading);
                    missing.push(format!("{scenario} {reading} on {name}").replace("  ", " "));
                }
            }
        }
    }
    missing
}

/// Where a criterion was looked at, with the reading where there is one.
fn place_name(cell: &Cell) -> String {
    let reading = cell.reading.as_deref().map(super::cells::reading_name).map(|name| format!(", {name}"));
    format!("{}{}, {}", cell.scenario, reading.unwrap_or_default(), cell.place.name())
}
