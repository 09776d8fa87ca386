//! Writes the report as Markdown: verdicts and tables, without figures.

use std::fmt::Write as _;

use super::cells::{Results, reading_name};
use super::context::Context;
use super::tables::{self, Field, Table};
use super::verdict::{Finding, mechanism};

/// Writes the report as Markdown, with a link to notes that are in its folder.
pub fn page(results: &Results, findings: &[Finding], context: &Context, has_notes: bool) -> String {
    let mut page = format!("# Adaptive Bridge: evaluation\n\n{}\n", plain(&context.summary));
    if has_notes {
        page.push_str("\n[Notes](README.md): how to read the tables.\n");
    }
    for warning in &context.warnings {
        let _ = write!(page, "\n**{}**\n", plain(warning));
    }
    if let Some(text) = tables::summary_sentence(results) {
        let _ = write!(page, "\n{}\n", plain(&text));
    }
    page.push_str("\n## Verdicts\n\n");
    for finding in findings {
        let (title, because) = (plain(&finding.title), plain(&finding.because));
        let _ = writeln!(page, "- **{}: {}.** {title}. {because}", finding.id, finding.verdict.name());
    }
    table(&mut page, &tables::headline(results));
    for reading in ["as-printed", "as-run"] {
        table(&mut page, &tables::table_i(results, reading));
    }
    for place in results.places() {
        for reading in results.readings(place) {
            let _ = write!(page, "\n## {}, Table I {}\n", plain(&place.name()), reading_name(&reading));
            table(&mut page, &tables::table_ii(results, place, &reading));
            for level in ["mild", "moderate", "strong"] {
                let scenario = format!("baseline_{level}");
                if let Some(text) = results.cell(place, &reading, &scenario).and_then(mechanism) {
                    let _ = write!(page, "\n{scenario}: {}\n", plain(&text));
                }
            }
            table(&mut page, &tables::table_iii(results, place, &reading));
            table(&mut page, &tables::publisher_and_critical(results, place, &reading));
            table(&mut page, &tables::remote(results, place, &reading));
        }
    }
    let mut beds: Vec<(&str, &str)> =
        results.places().into_iter().map(|place| (place.bed.as_str(), place.switch.as_str())).collect();
    beds.dedup();
    beds.sort_unstable();
    beds.dedup();
    page.push_str("\n## Both libraries\n");
    for (bed, switch) in beds {
        for reading in ["as-printed", "as-run"] {
            if tables::has_table_iv(results, bed, switch, reading) {
                table(&mut page, &tables::table_iv(results, bed, switch, reading));
            }
        }
    }
    page.push_str("\n## How the verdicts are computed\n");
    for finding in findings {
        let _ =
            write!(page, "\n### {}: {}\n\n{}\n\n", finding.id, plain(&finding.title), plain(finding.claim));
        for criterion in &finding.criteria {
            let holds = if criterion.holds { "holds" } else { "**does not hold**" };
            let [rule, found, place] =
                [&criterion.rule, &criterion.found, &criterion.place].map(|text| plain(text));
            let _ = writeln!(page, "- {place}: {rule}: {holds}, {found}");
        }
        if !finding.missing.is_empty() {
            let missing: Vec<String> = finding.missing.iter().map(|one| plain(one)).collect();
            let _ = write!(page, "\nNot run: {}.\n", missing.join("; "));
        }
    }
    page.push_str("\n## Runs, machine and software\n\n");
    for (name, values) in &context.facts {
        let values: Vec<String> = values.iter().map(|value| plain(value)).collect();
        let _ = writeln!(page, "- {}: {}", plain(name), values.join("; "));
    }
    let unusable = results.unusable.iter().map(|(name, reason)| format!("{name}: {reason}"));
    let lists = [
        ("Problems of runs", context.problems.clone()),
        ("Failed or unreadable", unusable.collect()),
        ("Not run", context.not_run.clone()),
    ];
    for (title, items) in lists.iter().filter(|(_, items)| !items.is_empty()) {
        let _ = write!(page, "\n### {title}\n\n");
        for item in items {
            let _ = writeln!(page, "- {}", plain(item));
        }
    }
    page
}

fn table(page: &mut String, table: &Table) {
    let _ = write!(page, "\n### {}\n\n", plain(&table.title));
    let columns: Vec<String> = table.columns.iter().map(|column| plain(column)).collect();
    let _ = writeln!(page, "| {} |", columns.join(" | "));
    let _ = writeln!(page, "|{}", "---|".repeat(columns.len()));
    for row in &table.rows {
        let fields: Vec<String> = row.iter().map(field).collect();
        let _ = writeln!(page, "| {} |", fields.join(" | "));
    }
    if !table.note.is_empty() {
        let _ = write!(page, "\n{}\n", plain(&table.note));
    }
}

fn field(field: &Field) -> String {
    let mut text = plain(&field.text);
    if let Some(interval) = &field.interval {
        let _ = write!(text, " [{}]", plain(interval));
    }
    if let Some(paper) = &field.paper {
        let deviation = field.deviation.as_ref().map(|text| format!(", {text}")).unwrap_or_default();
        let _ = write!(text, " (paper {}{})", plain(paper), plain(&deviation));
    }
    text
}

/// Escapes text so that Markdown does not interpret it.
fn plain(text: &str) -> String {
    let mut plain = String::with_capacity(text.len());
    for char in text.chars() {
        match char {
            '|' | '*' | '`' | '<' | '[' | ']' | '\\' => {
                plain.push('\\');
                plain.push(char);
            }
            char if char.is_control() => plain.push(' '),
            char => plain.push(char),
        }
    }
    plain
}
