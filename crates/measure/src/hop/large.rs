//! The section `large`: hop and CPU time over the size of a sample, between programs of other DDS libraries,
//! with its targets.

use super::summary::{Large, Summary};
use super::tables::missing;
use super::targets::{Estimate, hop_ratio, word};
use crate::format::{count, number, payload};
use crate::table::Table;

/// The rate of all sizes.
pub const RATE_HZ: u64 = 30;

/// The sizes in bytes, 1 KiB to 8 MiB.
pub const SIZES: [usize; 7] = [1 << 10, 16 << 10, 64 << 10, 256 << 10, 1 << 20, 4 << 20, 8 << 20];

/// The rates, in Hz, and the size in bytes of the small samples that are recorded beside.
pub const SMALL: [(u64, usize); 2] = [(100, 2_948), (1_000, 2_948)];

/// The targets of one size.
pub struct Limits {
    /// The size in bytes.
    pub bytes: usize,
    /// The highest ratio of the bridge's hop to that of the relay.
    hop_ratio: f64,
    /// The highest hop on a quiet machine, and the aim if it is lower, in µs.
    hop_us: Option<(f64, Option<f64>)>,
    /// The highest ratio of the CPU time of all processes of the bridge to that of the relay.
    cpu_ratio: f64,
    /// Whether samples may be lost with stock receive buffers if each is counted by a drop reason.
    may_lose: bool,
}

/// The targets.
pub const LIMITS: [Limits; 3] = [
    Limits { bytes: 256 << 10, hop_ratio: 0.5, hop_us: None, cpu_ratio: 1.0, may_lose: false },
    Limits {
        bytes: 1 << 20,
        hop_ratio: 0.25,
        hop_us: Some((200.0, Some(100.0))),
        cpu_ratio: 0.9,
        may_lose: false,
    },
    Limits { bytes: 4 << 20, hop_ratio: 0.25, hop_us: Some((300.0, None)), cpu_ratio: 0.9, may_lose: true },
];

/// The libraries of a run, in its order.
pub fn libraries(summary: &Summary) -> Vec<&str> {
    let mut libraries: Vec<&str> = Vec::new();
    for row in &summary.large {
        if !libraries.contains(&row.library.as_str()) {
            libraries.push(&row.library);
        }
    }
    libraries
}

/// The file name of the plot of a library.
pub fn file_name(library: &str) -> String {
    format!("large-{}.svg", library.to_lowercase().replace(' ', "-"))
}

/// The rows of one library with all sizes, at the machine's own receive buffers.
pub fn sweep<'a>(summary: &'a Summary, library: &'a str) -> impl Iterator<Item = &'a Large> {
    let rows = summary.large.iter().filter(move |row| row.library == library);
    rows.filter(|row| row.rate_hz == RATE_HZ && !row.stock_buffers)
}

/// What the plot shows of a row: the hop of relay or bridge, the latency of direct, in µs.
pub fn hop_or_latency_us(summary: &Summary, row: &Large) -> Option<f64> {
    if row.program == "direct" {
        return Estimate::of(&row.repetitions_p50_us).map(|latency| latency.median);
    }
    Some(Estimate::of(&Case::of(summary, row).hops(&row.program))?.median)
}

/// The rows of one library, rate and size.
struct Case<'a> {
    summary: &'a Summary,
    library: &'a str,
    rate_hz: u64,
    bytes: usize,
    stock_buffers: bool,
}

impl<'a> Case<'a> {
    fn of(summary: &'a Summary, row: &'a Large) -> Self {
        let Large { library, rate_hz, bytes, stock_buffers, .. } = row;
        Self { summary, library, rate_hz: *rate_hz, bytes: *bytes, stock_buffers: *stock_buffers }
    }

    fn row(&self, program: &str) -> Option<&'a Large> {
        self.summary.large.iter().find(|row| {
            (row.library.as_str(), row.rate_hz, row.bytes) == (self.library, self.rate_hz, self.bytes)
                && row.stock_buffers == self.stock_buffers
                && row.program == program
        })
    }

    /// The hop in each repetition: the median latency beyond that of direct.
    fn hops(&self, program: &str) -> Vec<f64> {
        let of = |program| self.row(program).map_or(&[][..], |row| &row.repetitions_p50_us[..]);
        of(program).iter().zip(of("direct")).map(|(with, without)| with - without).collect()
    }

    /// The hop of the bridge divided by that of the relay in each repetition. If the relay's is lost in the
    /// noise, it counts as 0.
    fn hop_ratios(&self) -> Vec<f64> {
        let pairs = self.hops("bridge").into_iter().zip(self.hops("relay"));
        pairs.map(|(bridge, relay)| hop_ratio(bridge, relay).unwrap_or(f64::INFINITY)).collect()
    }

    fn cpu_ratios(&self) -> Vec<f64> {
        let of = |program| self.row(program).map_or(&[][..], |row| &row.repetitions_cpu_us[..]);
        of("bridge").iter().zip(of("relay")).map(|(bridge, relay)| bridge / relay).collect()
    }
}

/// Median and interval, with the limit and the judgement if there is one.
fn judged(values: &[f64], limit: Option<f64>, aim: Option<f64>) -> String {
    let Some(estimate) = Estimate::of(values) else { return number(None) };
    let Some(limit) = limit else { return estimate.text() };
    let shown = |limit: f64| format!("{limit:.2}").replace(".00", "");
    let aim = aim.map_or(String::new(), |aim| {
        format!(", aim {}: {}", shown(aim), word(estimate.meets(aim)).trim_matches('*'))
    });
    format!("{}, limit {}: {}{aim}", estimate.text(), shown(limit), word(estimate.meets(limit)))
}

/// The samples lost between publisher and subscriber with stock receive buffers.
fn lost(case: &Case, limits: &Limits) -> String {
    let Some(row) = case.row("bridge") else { return number(None) };
    let named = row.reasons.values().sum::<u64>() >= row.missing;
    let met = row.missing == 0 || (limits.may_lose && named);
    let text =
        format!("{} of {}: {}", missing(row.missing, &row.reasons), count(row.accepted), word(Some(met)));
    if row.missing > 0 && named { text + ", each named" } else { text }
}

/// The table of the targets, and the small samples beside.
fn targets(summary: &Summary) -> Option<String> {
    let mut heads = vec!["between programs of".to_owned(), String::new()];
    let cases = LIMITS.iter().map(|limits| (RATE_HZ, limits.bytes, Some(limits)));
    let cases: Vec<_> = cases.chain(SMALL.map(|(rate_hz, bytes)| (rate_hz, bytes, None))).collect();
    heads.extend(
        cases.iter().map(|(rate_hz, bytes, _)| format!("{} at {} Hz", payload(*bytes), count(*rate_hz))),
    );
    let mut table = Table::new(&heads.iter().map(String::as_str).collect::<Vec<_>>());
    for library in libraries(summary) {
        type Cell = fn(&Case, Option<&Limits>) -> String;
        let rows: [(&str, bool, Cell); 4] = [
            ("hop over the relay's", false, |case, limits| {
                judged(&case.hop_ratios(), limits.map(|limits| limits.hop_ratio), None)
            }),
            ("hop, µs", false, |case, limits| {
                let (limit, aim) = limits.and_then(|limits| limits.hop_us).unzip();
                judged(&case.hops("bridge"), limit, aim.flatten())
            }),
            ("CPU over the relay's", false, |case, limits| {
                judged(&case.cpu_ratios(), limits.map(|limits| limits.cpu_ratio), None)
            }),
            ("lost with 208 KiB buffers", true, |case, limits| {
                limits.map_or(String::new(), |limits| lost(case, limits))
            }),
        ];
        for (index, (what, stock_buffers, cell)) in rows.into_iter().enumerate() {
            let mut cells =
                vec![if index == 0 { library.to_owned() } else { String::new() }, what.to_owned()];
            cells.extend(cases.iter().map(|&(rate_hz, bytes, limits)| {
                cell(&Case { summary, library, rate_hz, bytes, stock_buffers }, limits)
            }));
            table.row(cells);
        }
    }
    (!table.is_empty()).then(|| table.text())
}

/// All figures, a row for each library, rate, size and program.
fn all(summary: &Summary) -> String {
    let mut table = Table::new(&[
        "",
        "samples",
        "p50, µs",
        "p99, µs",
        "max, µs",
        "hop, µs",
        "CPU/sample, µs",
        "missing",
        "damaged",
    ]);
    let text = |values: &[f64]| Estimate::of(values).map_or_else(|| number(None), |estimate| estimate.text());
    for row in &summary.large {
        let buffers = if row.stock_buffers { ", 208 KiB buffers" } else { "" };
        let hops =
            if row.program == "direct" { Vec::new() } else { Case::of(summary, row).hops(&row.program) };
        table.row([
            format!(
                "{}, {} Hz of {}, {}{buffers}",
                row.library,
                count(row.rate_hz),
                payload(row.bytes),
                row.program
            ),
            count(row.latency.samples),
            number(row.latency.p50_us),
            number(row.latency.p99_us),
            number(row.latency.max_us),
            text(&hops),
            text(&row.repetitions_cpu_us),
            missing(row.missing, &row.reasons),
            count(row.damaged),
        ]);
    }
    table.text()
}

/// The table of the targets and the plot of the first library, for docs/performance.md; `plot` links a plot
/// if the run has it.
pub fn summary(summary: &Summary, plot: &dyn Fn(&str, &str) -> String) -> Option<String> {
    let library = *libraries(summary).first()?;
    Some(link(library, plot) + &targets(summary)?)
}

/// The table of the targets, the plots of all libraries and all figures.
pub fn section(summary: &Summary, plot: &dyn Fn(&str, &str) -> String) -> Option<String> {
    let plots: String = libraries(summary).into_iter().map(|library| link(library, plot)).collect();
    let details = "<details><summary>All figures of each program</summary>";
    Some(format!("{}\n{plots}{details}\n\n{}\n</details>\n", targets(summary)?, all(summary)))
}

fn link(library: &str, plot: &dyn Fn(&str, &str) -> String) -> String {
    plot(
        &file_name(library),
        &format!("Hop and CPU over the size of a sample, between programs of {library}"),
    )
}
