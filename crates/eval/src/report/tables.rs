//! Builds the report's tables, which both HTML and Markdown show.

use super::cells::{Cell, Place, Results, reading_name};
use super::format::{self, deviation, interval};
use super::measures::Measures;
use super::metrics::{self, paper_value};
use super::paper;
use super::record::LinkOutcome;
use crate::impairment::{Level, Reading};
use crate::statistics::Estimate;

/// A table with title, note, header and rows.
pub struct Table {
    pub title: String,
    pub note: String,
    pub columns: Vec<String>,
    pub rows: Vec<Vec<Field>>,
}

/// A field of a table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Field {
    /// The measured value, or a text.
    pub text: String,
    /// The interval over repetitions.
    pub interval: Option<String>,
    /// The paper's value.
    pub paper: Option<String>,
    /// The deviation from the paper's value.
    pub deviation: Option<String>,
    /// Whether there is no value.
    pub is_missing: bool,
}

impl Field {
    /// Creates a field with a text.
    pub fn text(text: impl Into<String>) -> Self {
        Self { text: text.into(), ..Self::default() }
    }

    /// Creates a field without a value, with the reason.
    pub fn missing(reason: &str) -> Self {
        Self { text: reason.to_owned(), is_missing: true, ..Self::default() }
    }

    fn with_paper(mut self, ours: Option<f64>, paper: Option<f64>, shown: fn(f64) -> String) -> Self {
        self.paper = paper.map(shown);
        self.deviation = ours.zip(paper).map(|(ours, paper)| deviation(ours, paper, shown));
        self
    }
}

/// A column of a table: its title, the key of its metric, and the format of its values.
struct Column {
    title: &'static str,
    key: &'static str,
    shown: fn(f64) -> String,
}

impl Column {
    const fn new(title: &'static str, key: &'static str, shown: fn(f64) -> String) -> Self {
        Self { title, key, shown }
    }
}

const P50: Column = Column::new("critical p50, ms", "critical_p50_ms", format::ms);
const P95: Column = Column::new("critical p95, ms", "critical_p95_ms", format::ms);
const P99: Column = Column::new("critical p99, ms", "critical_p99_ms", format::ms);
const RATE: Column = Column::new("rate, Hz", "publisher_rate_hz", format::hz);
const RATE_STD: Column = Column::new("rate std, Hz", "publisher_rate_std_hz", format::hz);
const TRANSITIONS: Column = Column::new("transitions", "classifier_transitions", format::count);

fn field(cell: Option<&Cell>, column: &Column, paper: Option<f64>) -> Field {
    let Some(cell) = cell else { return Field::missing("not run").with_paper(None, paper, column.shown) };
    let figure = metrics::METRICS.iter().find(|metric| metric.key == column.key).map(|metric| metric.of);
    match figure.and_then(|figure| cell.estimate(figure)) {
        Some(estimate) => {
            estimated(&estimate, column.shown).with_paper(Some(estimate.median), paper, column.shown)
        }
        None => Field::missing("–").with_paper(None, paper, column.shown),
    }
}

fn estimated(estimate: &Estimate, shown: fn(f64) -> String) -> Field {
    Field { text: shown(estimate.median), interval: interval(estimate, shown), ..Field::default() }
}

/// Builds Table I: the parameters and expected losses of a reading, and the applied losses.
pub fn table_i(results: &Results, reading: &str) -> Table {
    let model_of = if reading == "as-run" { Reading::AsRun } else { Reading::AsPrinted };
    let rows = paper::TABLE_I.iter().zip(paper::LOSS_AS_RUN_PERCENT).map(|(row, as_run)| {
        let model = row.level.model(model_of);
        let name = level_name(row.level);
        let paper_percent = if model_of == Reading::AsRun { as_run } else { row.loss_percent };
        let mut fields = vec![Field::text(name)];
        let parameters = [model.p(), model.r(), model.loss_good(), model.loss_bad()];
        fields.extend(parameters.into_iter().enumerate().map(|(index, ours)| {
            let Some(paper) = row.parameters else { return Field::text("–") };
            Field::text(format::percent(ours)).with_paper(
                Some(ours),
                Some(paper[index] / 100.0),
                format::percent,
            )
        }));
        let expected = Field::text(format::percent(model.stationary_loss()));
        let shown = |percent: f64| format::percent(percent / 100.0);
        fields.push(expected.with_paper(Some(model.stationary_loss() * 100.0), Some(paper_percent), shown));
        fields.push(applied(results, reading, &name.to_lowercase()));
        fields
    });
    Table {
        title: format!("Table I, {}: impairment", reading_name(reading)),
        note: format!(
            "{} Applied loss: the share lost of the packets that arrived while a link was on, over all seeds \
             of this reading, with the 95 % interval of the correlated chain.",
            if model_of == Reading::AsRun {
                "The paper's harness passes the losses of the two states to netem in the wrong order, as its \
                 counters show; the paper's figures were measured with these losses."
            } else {
                "The parameters as the paper prints them."
            }
        ),
        columns: texts(&[
            "scenario",
            "good→bad",
            "bad→good",
            "loss in good",
            "loss in bad",
            "expected loss",
            "applied loss",
        ]),
        rows: rows.collect(),
    }
}

fn level_name(level: Level) -> &'static str {
    match level {
        Level::Clean => "Clean",
        Level::Mild => "Mild",
        Level::Moderate => "Moderate",
        Level::Strong => "Strong",
    }
}

/// The loss that the links of a level applied, by their counters.
fn applied(results: &Results, reading: &str, level: &str) -> Field {
    let (mut judged, mut lost, mut variance) = (0_u64, 0_u64, 0.0);
    let runs = results.runs.iter().map(|run| &run.manifest);
    let of_reading = runs.filter(|one| one.reading.as_deref() == Some(reading) && one.level == level);
    let forward = of_reading.flat_map(|one| &one.links).filter(|link| link.direction == "forward");
    for outcome in independent(forward.filter_map(|link| link.impairment.as_ref())) {
        judged += outcome.judged;
        lost += outcome.lost;
        let error = outcome.loss_standard_error.unwrap_or(0.0) * outcome.judged as f64;
        variance += error * error;
    }
    if level == "clean" {
        return Field::text("–");
    }
    if judged == 0 {
        return Field::missing("not run");
    }
    let share = lost as f64 / judged as f64;
    let error = 1.96 * variance.sqrt() / judged as f64;
    Field {
        text: format::percent(share),
        interval: Some(format!("± {}", format::percent(error))),
        ..Field::default()
    }
}

/// Selects links with independent losses. Links with the same seed have the same sequence of losses; of
/// these, only the one with the most packets is selected.
fn independent<'a>(links: impl Iterator<Item = &'a LinkOutcome>) -> Vec<&'a LinkOutcome> {
    let mut independent: Vec<&LinkOutcome> = Vec::new();
    for link in links {
        match independent.iter_mut().find(|one| one.seed.is_some() && one.seed == link.seed) {
            Some(same) if same.judged < link.judged => *same = link,
            Some(_) => {}
            None => independent.push(link),
        }
    }
    independent
}

/// Builds Table II: the baselines at a place.
pub fn table_ii(results: &Results, place: &Place, reading: &str) -> Table {
    let rows = &paper::TABLE_II;
    Table {
        title: "Table II: no bridge".to_owned(),
        note: library_note(place),
        ..scenario_table(results, place, reading, rows, &[P50, P95, P99, RATE, RATE_STD])
    }
}

/// Builds Table III: the bridge scenarios at a place.
pub fn table_iii(results: &Results, place: &Place, reading: &str) -> Table {
    let rows = &paper::TABLE_III;
    Table {
        title: "Table III: with the bridge".to_owned(),
        note: library_note(place),
        ..scenario_table(results, place, reading, rows, &[P50, P95, P99, RATE, RATE_STD, TRANSITIONS])
    }
}

fn library_note(place: &Place) -> String {
    if place.library == "fast" {
        String::new()
    } else {
        "The paper has this table for Fast DDS only.".to_owned()
    }
}

fn scenario_table(
    results: &Results,
    place: &Place,
    reading: &str,
    rows: &[paper::Row],
    columns: &[Column],
) -> Table {
    let rows = rows.iter().map(|row| {
        let cell = results.cell(place, reading, row.scenario);
        let mut fields = vec![Field::text(row.title)];
        let paper = |column: &Column| paper_value(row.scenario, &place.library, column.key);
        fields.extend(columns.iter().map(|column| field(cell, column, paper(column))));
        fields
    });
    let titles = columns.iter().map(|column| column.title);
    Table {
        title: String::new(),
        note: String::new(),
        columns: std::iter::once("scenario").chain(titles).map(str::to_owned).collect(),
        rows: rows.collect(),
    }
}

/// Builds Table IV: the bridge scenarios with both libraries, in one kind of test bed and switch.
pub fn table_iv(results: &Results, bed: &str, switch: &str, reading: &str) -> Table {
    let place =
        |library: &str| Place { library: library.to_owned(), bed: bed.to_owned(), switch: switch.to_owned() };
    let rows = paper::TABLE_IV.iter().map(|row| {
        let mut fields = vec![Field::text(row.scenario)];
        for column in [P99, RATE] {
            for library in ["fast", "cyclone"] {
                let cell = results.cell(&place(library), reading, row.scenario);
                fields.push(field(cell, &column, paper_value(row.scenario, library, column.key)));
            }
        }
        fields
    });
    Table {
        title: format!("Table IV: both libraries, {} ({})", reading_name(reading), place("fast").bed_name()),
        note: String::new(),
        columns: texts(&[
            "scenario",
            "Fast DDS p99, ms",
            "Cyclone p99, ms",
            "Fast DDS rate, Hz",
            "Cyclone rate, Hz",
        ]),
        rows: rows.collect(),
    }
}

/// Whether the results have a run for Table IV.
pub fn has_table_iv(results: &Results, bed: &str, switch: &str, reading: &str) -> bool {
    let shown = |cell: &Cell| {
        paper::TABLE_IV.iter().any(|row| row.scenario == cell.scenario)
            && (cell.place.bed.as_str(), cell.place.switch.as_str()) == (bed, switch)
            && cell.reading.as_deref().unwrap_or(reading) == reading
    };
    results.cells().any(shown)
}

/// Builds the table of the publisher's and critical subscriber's figures that the paper does not have, for
/// every scenario at a place.
pub fn publisher_and_critical(results: &Results, place: &Place, reading: &str) -> Table {
    const COLUMNS: [Column; 10] = [
        P95,
        Column::new("critical max, ms", "critical_max_ms", format::ms),
        Column::new("critical lost", "critical_lost", format::count),
        Column::new("critical late", "critical_late", format::count),
        Column::new("longest gap, ms", "critical_gap_ms", format::ms),
        RATE,
        Column::new("calls blocked", "publish_blocked", format::count),
        Column::new("calls failed", "publish_failed", format::count),
        Column::new("call p99, ms", "publish_call_p99_ms", format::ms),
        Column::new("call max, ms", "publish_call_max_ms", format::ms),
    ];
    every_scenario(
        results,
        place,
        reading,
        "Publisher and critical subscriber: further figures",
        "Late: received after the next sample was due. Call: the publish call; blocked: longer than half a \
         period at 30 Hz.",
        &COLUMNS,
    )
}

/// Builds the table of the remote subscriber's figures, for every scenario at a place.
pub fn remote(results: &Results, place: &Place, reading: &str) -> Table {
    const COLUMNS: [Column; 10] = [
        Column::new("rate, Hz", "noncritical_rate_hz", format::hz),
        Column::new("p50, ms", "noncritical_p50_ms", format::ms),
        Column::new("p95, ms", "noncritical_p95_ms", format::ms),
        Column::new("lane's bytes/s while impaired", "noncritical_lane_impaired_bytes_per_s", format::bytes),
        Column::new("bytes/s on the wire", "noncritical_wire_bytes_per_s", format::bytes),
        Column::new("while impaired", "noncritical_wire_impaired_bytes_per_s", format::bytes),
        Column::new("IP fragments", "noncritical_fragments", format::count),
        Column::new("repair requests", "noncritical_acknacks", format::count),
        Column::new("slowest demotion, s", "demote_max_s", format::hz),
        Column::new("slowest promotion, s", "promote_max_s", format::hz),
    ];
    every_scenario(
        results,
        place,
        reading,
        "Remote subscriber",
        "Of several remote subscribers, the slowest. The lane's bytes are the payload that it sends; bytes \
         on the wire are those of all protocols, including probes and discovery, without those that the \
         link lost. Repair requests: ACKNACK and NACK_FRAG of user data.",
        &COLUMNS,
    )
}

fn every_scenario(
    results: &Results,
    place: &Place,
    reading: &str,
    title: &str,
    note: &str,
    columns: &[Column],
) -> Table {
    let rows = results.cells_of(place, reading).into_iter().map(|cell| {
        let mut fields = vec![Field::text(&cell.scenario)];
        fields.extend(columns.iter().map(|column| field(Some(cell), column, None)));
        fields
    });
    let titles = columns.iter().map(|column| column.title);
    Table {
        title: title.to_owned(),
        note: note.to_owned(),
        columns: std::iter::once("scenario").chain(titles).map(str::to_owned).collect(),
        rows: rows.collect(),
    }
}

/// Builds the table of CPU time and memory of the bridge's processes, for every bridge scenario at a place.
pub fn usage(results: &Results, place: &Place, reading: &str) -> Table {
    let mut rows = Vec::new();
    for cell in results.cells_of(place, reading).into_iter().filter(|cell| cell.bridge) {
        let mut names: Vec<&String> = cell.measures.iter().flat_map(|one| one.usage.keys()).collect();
        names.sort();
        names.dedup();
        for name in names {
            let of = |figure: fn(&super::measures::Usage) -> f64| {
                Estimate::of(cell.measures.iter().filter_map(|one| one.usage.get(name)).map(figure))
            };
            let fields = [
                of(|usage| usage.cpu_percent).map(|one| estimated(&one, format::hz)),
                of(|usage| usage.rss_max_bytes as f64).map(|one| estimated(&one, format::bytes)),
            ];
            let mut row = vec![Field::text(&cell.scenario), Field::text(name)];
            row.extend(fields.map(|field| field.unwrap_or_else(|| Field::missing("not measured"))));
            rows.push(row);
        }
    }
    Table {
        title: "CPU and memory of each process".to_owned(),
        note: "CPU: percent of one core, mean over the run. Memory: the largest resident size.".to_owned(),
        columns: texts(&["scenario", "process", "CPU, %", "memory"]),
        rows,
    }
}

/// The strongest of the paper's impairments that was run both without and with the bridge.
fn strongest<'a>(
    results: &'a Results,
    place: &Place,
    reading: &str,
) -> Option<(&'static str, &'a Cell, &'a Cell)> {
    ["strong", "moderate", "mild"].into_iter().find_map(|level| {
        let cell = |variant: &str| results.cell(place, reading, &format!("{variant}_{level}"));
        Some((level, cell("baseline")?, cell("bridge")?))
    })
}

/// Summarises the effect of the bridge in one sentence, for the setting nearest to the paper's.
pub fn summary_sentence(results: &Results) -> Option<String> {
    let (place, reading) = results.nearest_to_paper()?;
    let (level, without, with) = strongest(results, place, &reading)?;
    let rate = |cell: &Cell| cell.median(|one| one.rate_hz).map(format::hz);
    // "Up to": of all runs, where the rate is a median.
    let gap = |cell: &Cell| cell.max(|one| one.critical_gap_ms).map(|gap_ms| format::number(gap_ms / 1e3, 2));
    Some(format!(
        "{}, {level} loss {}: without the bridge the publisher reaches {} Hz, and the critical subscriber \
         waits up to {} s for a sample; with the bridge, {} Hz and {} s.",
        place.library_name(),
        reading_name(&reading),
        rate(without)?,
        gap(without)?,
        rate(with)?,
        gap(with)?
    ))
}

/// Builds the table of the bridge's effect at each place, for the strongest of the paper's impairments.
pub fn headline(results: &Results) -> Table {
    let mut rows = Vec::new();
    for place in results.places() {
        for reading in results.readings(place) {
            let Some((level, without, with)) = strongest(results, place, &reading) else { continue };
            let change = |of: fn(&Measures) -> Option<f64>, shown: fn(f64) -> String| {
                let one = |cell: &Cell| cell.median(of).map_or_else(|| "–".to_owned(), shown);
                Field::text(format!("{} → {}", one(without), one(with)))
            };
            rows.push(vec![
                Field {
                    interval: Some(place.bed_name()),
                    ..Field::text(format!(
                        "{}, {level} loss {}",
                        place.library_name(),
                        reading_name(&reading)
                    ))
                },
                change(|one| one.rate_hz, format::hz),
                change(|one| one.critical_ms.quantile(0.95), format::ms),
                change(|one| one.critical_gap_ms, format::ms),
                change(|one| Some(one.critical.lost as f64), format::count),
                change(|one| one.call_ms.max(), format::ms),
            ]);
        }
    }
    Table {
        title: "Without → with the bridge".to_owned(),
        note: "The strongest impairment that was run both without and with the bridge. Medians over \
               repetitions."
            .to_owned(),
        columns: texts(&[
            "where",
            "publisher, Hz",
            "critical p95, ms",
            "longest gap, ms",
            "critical lost",
            "longest publish call, ms",
        ]),
        rows,
    }
}

fn texts(texts: &[&str]) -> Vec<String> {
    texts.iter().map(|text| (*text).to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn losses_of_the_same_seed_count_once() {
        let link = |seed: Option<u64>, judged: u64| -> LinkOutcome {
            serde_json::from_value(json!({"backend": "", "reason": "", "seed": seed, "delay_ms": 0.0,
                                          "judged": judged, "lost": 0, "loss_expected": 0.1}))
            .unwrap()
        };
        let links = [(Some(1), 10), (Some(2), 20), (Some(1), 30), (Some(2), 5), (None, 7), (None, 7)];
        let links = links.map(|(seed, judged)| link(seed, judged));
        let counted: Vec<u64> = independent(links.iter()).iter().map(|one| one.judged).collect();
        assert_eq!(counted, [30, 20, 7, 7]);
    }
}
