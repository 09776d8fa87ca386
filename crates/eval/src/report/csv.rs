//! Writes the figures and verdicts as CSV.

use super::cells::Results;
use super::metrics::{METRICS, paper_value};
use super::verdict::Finding;

/// Writes `runs.csv`: a line for each run, a column for each figure.
pub fn runs(results: &Results) -> String {
    let mut columns =
        vec!["run", "scenario", "library", "reading", "bed", "switch", "repetition", "quick", "synthetic"];
    columns.extend(METRICS.iter().map(|metric| metric.key));
    let mut rows = vec![columns.iter().map(|column| (*column).to_owned()).collect()];
    for cell in results.cells() {
        for (index, measures) in cell.runs.iter().zip(&cell.measures) {
            let Some(run) = results.runs.get(*index) else { continue };
            let manifest = &run.manifest;
            let mut fields = vec![
                manifest.run.clone(),
                manifest.scenario.clone(),
                manifest.library.clone(),
                manifest.reading.clone().unwrap_or_default(),
                manifest.bed.clone(),
                manifest.switch.clone(),
                manifest.repetition.to_string(),
                manifest.quick.to_string(),
                manifest.synthetic.to_string(),
            ];
            fields.extend(METRICS.iter().map(|metric| optional((metric.of)(measures))));
            rows.push(fields);
        }
    }
    text(&rows)
}

/// Writes `figures.csv`: a line for each figure of each scenario in each setting, over its repetitions.
pub fn figures(results: &Results) -> String {
    const COLUMNS: [&str; 14] = [
        "scenario",
        "library",
        "reading",
        "bed",
        "switch",
        "figure",
        "median",
        "low",
        "high",
        "confidence",
        "min",
        "max",
        "repetitions",
        "paper",
    ];
    let mut rows = vec![COLUMNS.map(str::to_owned).to_vec()];
    for cell in results.cells() {
        for metric in &METRICS {
            let Some(estimate) = cell.estimate(metric.of) else { continue };
            let mut fields = vec![
                cell.scenario.clone(),
                cell.place.library.clone(),
                cell.reading.clone().unwrap_or_default(),
                cell.place.bed.clone(),
                cell.place.switch.clone(),
                metric.key.to_owned(),
            ];
            let numbers = [
                estimate.median,
                estimate.low,
                estimate.high,
                estimate.confidence,
                estimate.min,
                estimate.max,
            ];
            fields.extend(numbers.map(|number| optional(Some(number))));
            fields.push(estimate.count.to_string());
            fields.push(optional(paper_value(&cell.scenario, &cell.place.library, metric.key)));
            rows.push(fields);
        }
    }
    text(&rows)
}

/// Writes `verdicts.csv`: a line for each criterion of each verdict.
pub fn verdicts(findings: &[Finding]) -> String {
    const COLUMNS: [&str; 7] = ["hypothesis", "title", "verdict", "rule", "where", "found", "holds"];
    let mut rows = vec![COLUMNS.map(str::to_owned).to_vec()];
    for finding in findings {
        let verdict = [finding.id.to_owned(), finding.title.clone(), finding.verdict.name().to_owned()];
        if finding.criteria.is_empty() {
            rows.push(verdict.iter().cloned().chain(std::iter::repeat_n(String::new(), 4)).collect());
        }
        for criterion in &finding.criteria {
            let of = [
                criterion.rule.clone(),
                criterion.place.clone(),
                criterion.found.clone(),
                criterion.holds.to_string(),
            ];
            rows.push(verdict.iter().cloned().chain(of).collect());
        }
    }
    text(&rows)
}

fn optional(value: Option<f64>) -> String {
    // Six decimals of a value in milliseconds are a nanosecond.
    value
        .map(|value| format!("{:.6}", value).trim_end_matches('0').trim_end_matches('.').to_owned())
        .unwrap_or_default()
}

/// The text of a file. Writing to memory does not fail, and fields are valid UTF-8.
fn text(rows: &[Vec<String>]) -> String {
    let mut writer = csv::WriterBuilder::new().flexible(true).from_writer(Vec::new());
    for row in rows {
        let _ = writer.write_record(row);
    }
    String::from_utf8(writer.into_inner().unwrap_or_default()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_quoted_where_required() {
        let rows = [vec!["a".into(), "b, c".into(), "say \"d\"".into()], vec!["e".into(), String::new()]];
        assert_eq!(text(&rows), "a,\"b, c\",\"say \"\"d\"\"\"\ne,\n");
        let numbers = [Some(1.5), Some(30.0), Some(1e-9), Some(1_200.0), None].map(optional);
        assert_eq!(numbers, ["1.5", "30", "0", "1200", ""]);
    }
}
