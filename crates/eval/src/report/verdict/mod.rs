//! Verdicts on the paper's hypotheses (section IV-A), computed from the runs by rules that the report lists.
//!
//! A verdict can be "contradicted", and a hypothesis whose scenarios were not run is never confirmed.

mod below_dds;
mod h1;
mod h2;
mod h3;
#[cfg(test)]
mod tests;

pub use h1::mechanism;

use super::cells::{Cell, Results};

/// The verdict on a hypothesis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// All required scenarios were run, and all rules hold.
    Confirmed,
    /// Some rules hold, and some do not.
    Partly,
    /// The required scenarios were run, and no rule holds.
    Contradicted,
    /// All rules hold in the scenarios that were run, but some required scenarios were not run.
    Incomplete,
    /// No rule holds in the scenarios that were run, but some required scenarios were not run.
    NotSeen,
    /// No required scenario was run, or only smoke runs.
    NotTested,
}

impl Verdict {
    /// The verdict in words.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Partly => "partly confirmed",
            Self::Contradicted => "contradicted",
            Self::Incomplete => "holds so far, incomplete",
            Self::NotSeen => "not seen so far, incomplete",
            Self::NotTested => "not tested",
        }
    }
}

/// The check of a rule in one scenario and setting.
#[derive(Clone, Debug)]
pub struct Criterion {
    /// The rule; it holds if all criteria with the same text hold.
    pub rule: String,
    /// The scenario and setting.
    pub place: String,
    /// The measured values.
    pub found: String,
    pub holds: bool,
}

/// A hypothesis with its verdict and the checked criteria.
#[derive(Clone, Debug)]
pub struct Finding {
    /// Identifier of the hypothesis, such as `H1`.
    pub id: &'static str,
    pub title: String,
    /// The claim and its rules.
    pub claim: &'static str,
    pub verdict: Verdict,
    /// The reason for the verdict, in one or more sentences.
    pub because: String,
    pub criteria: Vec<Criterion>,
    /// Scenarios that must be run for a full verdict.
    pub missing: Vec<String>,
}

impl Finding {
    /// Computes the verdict from all criteria: a rule holds if it holds everywhere.
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
            _ => Verdict::Contradicted,
        };
        let because = if rules.is_empty() {
            "None of the required scenarios was run.".to_owned()
        } else if broken.is_empty() {
            format!("{}, in all {} places that were checked.", rules_text(rules.len()), criteria.len())
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

/// Describes a rule that does not hold: in how many places, and the values at the first of them.
fn broken_text(rule: &str, criteria: &[Criterion]) -> String {
    let of_rule = || criteria.iter().filter(|criterion| criterion.rule == rule);
    let broken: Vec<&Criterion> = of_rule().filter(|criterion| !criterion.holds).collect();
    let first = broken.first().map(|one| format!(": {} in {}", one.found, one.place)).unwrap_or_default();
    format!("That {rule} does not hold in {} of {} places{first}.", broken.len(), of_rule().count())
}

/// Computes the verdicts on all hypotheses. Smoke runs give no verdict.
pub fn findings(results: &Results) -> Vec<Finding> {
    let mut findings = vec![
        h1::finding(results, "as-printed"),
        h1::finding(results, "as-run"),
        h2::finding(results),
        h3::finding(results),
        below_dds::finding(results),
    ];
    if results.any_quick() {
        for finding in findings.iter_mut().filter(|finding| finding.verdict != Verdict::NotTested) {
            finding.verdict = Verdict::NotTested;
            finding.because = "These are smoke runs (--quick): too short for a verdict.".to_owned();
        }
    }
    findings
}

/// Lists the scenarios that were not run in each library and reading, which a full verdict requires.
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

/// The name of a criterion's scenario and setting, with the reading if there is one.
fn place_name(cell: &Cell) -> String {
    let reading = cell.reading.as_deref().map(super::cells::reading_name).map(|name| format!(", {name}"));
    format!("{}{}, {}", cell.scenario, reading.unwrap_or_default(), cell.place.name())
}
