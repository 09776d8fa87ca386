//! Writes the report as one HTML file with inline style and SVG, without scripts and external resources. The
//! file is also well-formed XML.

use std::fmt::Write as _;

use adaptive_bridge_measure::format::escape;

use super::cells::{Cell, Place, Results, reading_name};
use super::context::Context;
use super::figures;
use super::tables::{self, Field, Table};
use super::verdict::{Finding, Verdict, mechanism};

const STYLE: &str = include_str!("style.css");

/// The section on how figures are computed.
const METHOD: [&str; 7] = [
    "Latency is the time from the stamp that the publisher puts into the sample just before its publish call \
     to the reception by the subscriber's program, both on the same clock. A sample belongs to the measured \
     window by its stamp.",
    "The rate is that of attempts to publish, over windows of 5 s that slide by 1 s and lie completely \
     within the measured window: mean and population standard deviation over these windows, as the paper \
     defines them.",
    "Percentiles are interpolated linearly between the two nearest values. A cumulative distribution \
     contains the samples of all repetitions.",
    "For several repetitions the median is shown, with the interval of order statistics that contains the \
     true median with 95 % confidence. With fewer than six repetitions no such interval exists; then the \
     range from the smallest to the largest value is shown, which contains the true median with 94 % \
     confidence for five, 75 % for three, 50 % for two.",
    "A critical sample is lost if the publisher's writer accepted it and the subscriber never received it, \
     and late if it was received after the next one was due.",
    "Samples held: those that the publisher's writer accepted and the remote subscriber has not yet received \
     in order; a RELIABLE writer must keep at least these.",
    "The applied loss is that of the packets that arrived at the impaired links while they were on, with the \
     standard error of a correlated chain.",
];

/// Writes the report as HTML.
pub fn page(results: &Results, findings: &[Finding], context: &Context) -> String {
    let mut page = String::new();
    let _ = write!(
        page,
        "<!DOCTYPE html>\n<html xmlns=\"http://www.w3.org/1999/xhtml\" lang=\"en\">\n<head>\n<meta \
         charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <title>Adaptive Bridge: evaluation</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n"
    );
    header(&mut page, context);
    verdicts(&mut page, results, findings);
    settings(&mut page, results);
    both_libraries(&mut page, results);
    page.push_str("<h2 id=\"table-1\">Impairment</h2>\n");
    for reading in ["as-printed", "as-run"] {
        table(&mut page, &tables::table_i(results, reading));
    }
    rules(&mut page, findings);
    runs(&mut page, results, context);
    page.push_str("<h2 id=\"method\">How the figures are computed</h2>\n<ul>\n");
    for line in METHOD {
        let _ = writeln!(page, "<li>{}</li>", escape(line));
    }
    page.push_str("</ul>\n</body>\n</html>\n");
    page
}

fn header(page: &mut String, context: &Context) {
    let _ = writeln!(
        page,
        "<h1>Adaptive Bridge: evaluation</h1>\n<p class=\"lead\">{}</p>",
        escape(&context.summary)
    );
    for warning in &context.warnings {
        let _ = writeln!(page, "<p class=\"warning\">{}</p>", escape(warning));
    }
}

fn verdicts(page: &mut String, results: &Results, findings: &[Finding]) {
    if let Some(text) = tables::summary_sentence(results) {
        let _ = writeln!(page, "<p class=\"short\">{}</p>", escape(&text));
    }
    page.push_str("<h2 id=\"verdicts\">Verdicts</h2>\n<div class=\"cards\">\n");
    for (index, finding) in findings.iter().enumerate() {
        let _ = writeln!(
            page,
            "<section class=\"card {}\"><h3>{}: {}</h3><p class=\"badge\">{}</p><p>{}</p><p><a \
             href=\"#rules-{index}\">rules and figures</a></p></section>",
            verdict_class(finding.verdict),
            escape(finding.id),
            escape(&finding.title),
            finding.verdict.name(),
            escape(&finding.because),
        );
    }
    page.push_str("</div>\n");
    table(page, &tables::headline(results));
}

const fn verdict_class(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Confirmed => "good",
        Verdict::Partly => "fair",
        Verdict::Contradicted => "poor",
        Verdict::Incomplete | Verdict::NotSeen | Verdict::NotTested => "none",
    }
}

/// Writes tables and figures of each setting. The setting nearest to the paper's is expanded, the others are
/// collapsed.
fn settings(page: &mut String, results: &Results) {
    page.push_str("<h2 id=\"settings\">Tables II and III, Figures 4 and 5</h2>\n");
    let nearest = results.nearest_to_paper();
    for place in results.places() {
        for reading in results.readings(place) {
            let is_open = nearest.as_ref() == Some(&(place, reading.clone()));
            setting(page, results, place, &reading, is_open);
        }
    }
}

fn setting(page: &mut String, results: &Results, place: &Place, reading: &str, is_open: bool) {
    let open = if is_open { " open=\"open\"" } else { "" };
    let _ = writeln!(
        page,
        "<details class=\"setting\"{open}><summary><b>{}, Table I {}</b><span>{}</span></summary>",
        escape(place.library_name()),
        escape(reading_name(reading)),
        escape(&place.bed_name()),
    );
    table(page, &tables::table_ii(results, place, reading));
    let causes: Vec<(&Cell, String)> = ["mild", "moderate", "strong"]
        .iter()
        .filter_map(|level| results.cell(place, reading, &format!("baseline_{level}")))
        .filter_map(|cell| Some((cell, mechanism(cell)?)))
        .collect();
    if !causes.is_empty() {
        page.push_str("<p>The causes, from the figures of the baselines:</p>\n<ul>\n");
        for (cell, text) in causes {
            let _ = writeln!(page, "<li><b>{}</b>: {}</li>", escape(&cell.scenario), escape(&text));
        }
        page.push_str("</ul>\n");
    }
    table(page, &tables::table_iii(results, place, reading));
    let [p95, rate] = figures::figure_4(results, place, reading);
    let [baseline, bridge] = figures::figure_5(results, place, reading);
    page.push_str("<div class=\"figures\">\n");
    figure(page, "Figure 4, top: critical p95 in ms (logarithmic; –: not run)", &p95);
    figure(page, "Figure 4, bottom: publisher rate in Hz (dashed: 30 Hz; –: not run)", &rate);
    figure(page, "Figure 5, top: critical latency, no bridge", &baseline);
    figure(page, "Figure 5, bottom: critical latency with the bridge", &bridge);
    page.push_str("</div>\n");
    table(page, &tables::publisher_and_critical(results, place, reading));
    table(page, &tables::remote(results, place, reading));
    let usage = tables::usage(results, place, reading);
    if !usage.rows.is_empty() {
        page.push_str("<details><summary>CPU and memory of each process</summary>\n");
        table(page, &usage);
        page.push_str("</details>\n");
    }
    timelines(page, results, place, reading);
    page.push_str("</details>\n");
}

fn timelines(page: &mut String, results: &Results, place: &Place, reading: &str) {
    /// The scenarios whose time lines are not collapsed: the strongest loss without and with the bridge, and
    /// the toggle.
    const OPEN: [&str; 3] = ["baseline_strong", "bridge_strong", "bridge_toggle"];
    page.push_str(
        "<h3>Time lines</h3>\n<p>The first repetition of each scenario; shaded while the link is \
         impaired.</p>\n",
    );
    let cells = results.cells_of(place, reading);
    page.push_str("<div class=\"figures\">\n");
    let shown = |cell: &&&Cell| OPEN.contains(&cell.scenario.as_str());
    for cell in cells.iter().filter(shown) {
        if let Some(run) = figures::shown_run(results, cell) {
            figure(page, &format!("{}: {}", cell.scenario, cell.title), &figures::timeline(run));
        }
    }
    page.push_str("</div>\n");
    for cell in cells.iter().filter(|cell| !shown(cell)) {
        if let Some(run) = figures::shown_run(results, cell) {
            let _ = writeln!(
                page,
                "<details><summary>{}: {}</summary>",
                escape(&cell.scenario),
                escape(&cell.title)
            );
            figure(page, &cell.title, &figures::timeline(run));
            page.push_str("</details>\n");
        }
    }
}

fn both_libraries(page: &mut String, results: &Results) {
    let mut beds: Vec<(&str, &str)> =
        results.places().into_iter().map(|place| (place.bed.as_str(), place.switch.as_str())).collect();
    beds.sort_unstable();
    beds.dedup();
    page.push_str("<h2 id=\"table-4\">Both libraries</h2>\n");
    for (bed, switch) in beds {
        for reading in ["as-printed", "as-run"] {
            if tables::has_table_iv(results, bed, switch, reading) {
                table(page, &tables::table_iv(results, bed, switch, reading));
            }
        }
    }
}

fn rules(page: &mut String, findings: &[Finding]) {
    page.push_str("<h2 id=\"rules\">How the verdicts are computed</h2>\n");
    for (index, finding) in findings.iter().enumerate() {
        let _ = writeln!(
            page,
            "<details class=\"rules\" id=\"rules-{index}\"><summary>{}: {}: <b>{}</b></summary>\n<p>{}</p>",
            escape(finding.id),
            escape(&finding.title),
            finding.verdict.name(),
            escape(finding.claim),
        );
        if !finding.criteria.is_empty() {
            page.push_str("<div class=\"scroll\"><table><thead><tr>");
            for column in ["holds", "rule", "found", "where"] {
                let _ = write!(page, "<th>{column}</th>");
            }
            page.push_str("</tr></thead><tbody>\n");
            for criterion in &finding.criteria {
                let (class, word) = if criterion.holds { ("good", "yes") } else { ("poor", "no") };
                let [rule, found, place] =
                    [&criterion.rule, &criterion.found, &criterion.place].map(|text| escape(text));
                let _ = writeln!(
                    page,
                    "<tr><td class=\"{class}\">{word}</td><td>{rule}</td><td>{found}</td><td>{place}</td></tr>"
                );
            }
            page.push_str("</tbody></table></div>\n");
        }
        if !finding.missing.is_empty() {
            page.push_str("<p>Not run, but needed for a full verdict:</p>\n<ul class=\"missing\">\n");
            for one in &finding.missing {
                let _ = writeln!(page, "<li>{}</li>", escape(one));
            }
            page.push_str("</ul>\n");
        }
        page.push_str("</details>\n");
    }
}

fn runs(page: &mut String, results: &Results, context: &Context) {
    page.push_str("<h2 id=\"runs\">Runs, machine and software</h2>\n<dl>\n");
    for (name, values) in &context.facts {
        let _ = writeln!(page, "<dt>{}</dt>", escape(name));
        for value in values {
            let _ = writeln!(page, "<dd>{}</dd>", escape(value));
        }
    }
    page.push_str("</dl>\n");
    list(page, "Problems of runs", &context.problems);
    let unusable: Vec<String> =
        results.unusable.iter().map(|(name, reason)| format!("{name}: {reason}")).collect();
    list(page, "Failed or unreadable", &unusable);
    list(page, "Scenarios of the paper that were not run", &context.not_run);
    let _ = writeln!(page, "<details><summary>All {} runs</summary>\n<ul>", results.runs.len());
    for run in &results.runs {
        let _ = writeln!(page, "<li>{}</li>", escape(&run.manifest.run));
    }
    page.push_str("</ul></details>\n");
}

fn list(page: &mut String, title: &str, items: &[String]) {
    if items.is_empty() {
        return;
    }
    let _ = writeln!(page, "<h3>{}</h3>\n<ul class=\"missing\">", escape(title));
    for item in items {
        let _ = writeln!(page, "<li>{}</li>", escape(item));
    }
    page.push_str("</ul>\n");
}

fn figure(page: &mut String, caption: &str, svg: &str) {
    let _ = writeln!(page, "<figure><figcaption>{}</figcaption>{svg}</figure>", escape(caption));
}

fn table(page: &mut String, table: &Table) {
    let _ = writeln!(page, "<h3>{}</h3>", escape(&table.title));
    page.push_str("<div class=\"scroll\"><table><thead><tr>");
    for column in &table.columns {
        let _ = write!(page, "<th>{}</th>", escape(column));
    }
    page.push_str("</tr></thead><tbody>\n");
    for row in &table.rows {
        page.push_str("<tr>");
        for (index, field) in row.iter().enumerate() {
            if index == 0 {
                let below = field.interval.as_ref().map(|text| format!("<small>{}</small>", escape(text)));
                let _ = write!(page, "<th>{}{}</th>", escape(&field.text), below.unwrap_or_default());
            } else {
                self::field(page, field);
            }
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</tbody></table></div>\n");
    if !table.note.is_empty() {
        let _ = writeln!(page, "<p class=\"note\">{}</p>", escape(&table.note));
    }
}

fn field(page: &mut String, field: &Field) {
    let class = if field.is_missing { " class=\"weak\"" } else { "" };
    let _ = write!(page, "<td{class}>{}", escape(&field.text));
    if let Some(interval) = &field.interval {
        let _ = write!(page, "<small>{}</small>", escape(interval));
    }
    if let Some(paper) = &field.paper {
        let deviation =
            field.deviation.as_ref().map(|text| format!(" ({})", escape(text))).unwrap_or_default();
        let _ = write!(page, "<small class=\"paper-value\">paper {}{deviation}</small>", escape(paper));
    }
    page.push_str("</td>");
}
