//! The plots of a run.

use super::large;
use super::plot::{Bars, Line, Panel, Scale, Series, lines};
use super::summary::{Isolation, Summary};
use super::tables::{PROGRAMS, payloads};
use super::targets::Estimate;
use crate::format::{number, payload};

const CLASSES: [&str; 6] = ["a", "b", "c", "d", "e", "f"];

/// The file name and content of each plot for which the run has data.
pub fn figures(summary: &Summary) -> Vec<(String, String)> {
    let mut files = Vec::new();
    for scheduling in ["other", "fifo"] {
        files.extend(latency(summary, scheduling).map(|svg| (format!("latency-{scheduling}.svg"), svg)));
        files.extend(isolation(summary, scheduling).map(|svg| (format!("isolation-{scheduling}.svg"), svg)));
    }
    files.extend(throughput(summary).map(|svg| ("throughput.svg".to_owned(), svg)));
    files.extend(cpu(summary).map(|svg| ("cpu.svg".to_owned(), svg)));
    for of in ["routes", "lanes"] {
        files.extend(scale(summary, of).map(|svg| (format!("{of}.svg"), svg)));
    }
    for library in large::libraries(summary) {
        files.extend(of_sizes(summary, library).map(|svg| (large::file_name(library), svg)));
    }
    files.extend(soak(summary).map(|svg| ("soak.svg".to_owned(), svg)));
    files
}

fn latency(summary: &Summary, scheduling: &str) -> Option<String> {
    let rows: Vec<_> = summary.latency.iter().filter(|row| row.scheduling == scheduling).collect();
    let panel = |bytes: usize| {
        let mut shown = Vec::new();
        for (program, class) in PROGRAMS.iter().zip(["f", "c", "b", "a"]) {
            let of = |quantile: fn(&super::summary::Quantiles) -> Option<f64>| {
                // The wake-up has no payload, so it is shown with every payload.
                let fits = |row: &&&super::summary::Latency| {
                    row.program == *program && (row.bytes == bytes || row.program == "wake-up")
                };
                let points = rows.iter().filter(fits);
                let mut points: Vec<(f64, f64)> =
                    points.filter_map(|row| Some((row.rate_hz as f64, quantile(&row.latency)?))).collect();
                points.sort_by(|one, other| one.0.total_cmp(&other.0));
                points
            };
            shown.push(Line { name: program, class: class.to_owned(), points: of(|latency| latency.p50_us) });
            shown.push(Line {
                name: "",
                class: format!("{class} tail"),
                points: of(|latency| latency.p99_us),
            });
        }
        Panel { title: format!("{}: p50, dashed p99, µs", payload(bytes)), lines: shown }
    };
    let panels: Vec<Panel> = payloads(rows.iter().copied()).into_iter().map(panel).collect();
    let label = format!("Latency over rate, by payload, scheduling {scheduling}");
    (!panels.is_empty()).then(|| lines(&label, "samples per second", &panels, Scale::Decades))
}

fn throughput(summary: &Summary) -> Option<String> {
    let mut sizes: Vec<usize> = summary.throughput.iter().map(|row| row.bytes).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let series = |name, class| Series {
        name,
        class,
        values: sizes
            .iter()
            .map(|bytes| {
                summary.throughput.iter().find(|row| row.program == name && row.bytes == *bytes)?.rate_hz
            })
            .collect(),
    };
    let bars = Bars {
        label: "Highest rate without loss, by payload",
        title: "highest rate without loss, samples per second",
        groups: sizes.iter().copied().map(payload).collect(),
        series: vec![series("direct", "c"), series("relay", "b"), series("bridge", "a")],
        logarithmic: true,
        shown: |value| number(value.map(f64::round)).replace(".00", "").replace(".0", ""),
    };
    (!sizes.is_empty()).then(|| bars.draw())
}

fn cpu(summary: &Summary) -> Option<String> {
    let mut rates: Vec<u64> =
        summary.resources.iter().map(|row| row.rate_hz).filter(|rate| *rate > 0).collect();
    rates.sort_unstable();
    rates.dedup();
    let sum = |rate: u64, program: &str, processes: Option<&[&str]>| {
        let rows = summary.resources.iter().filter(|row| {
            row.rate_hz == rate
                && row.program == program
                && processes.is_none_or(|only| only.contains(&row.process.as_str()))
        });
        let each: Vec<f64> = rows.filter_map(|row| row.per_sample(row.cpu_ms * 1_000.0)).collect();
        (!each.is_empty()).then(|| each.iter().sum())
    };
    let series = |name, class, program: &str, processes: Option<&[&str]>| Series {
        name,
        class,
        values: rates.iter().map(|rate| sum(*rate, program, processes)).collect(),
    };
    let bars = Bars {
        label: "CPU per thousand samples of relay and bridge",
        title: "CPU per thousand samples, ms",
        groups: rates.iter().map(|rate| format!("{rate} Hz")).collect(),
        series: vec![
            series("relay", "b", "relay", Some(&["relay"])),
            series("ingress and critical lane", "a", "bridge", Some(&["ingress", "critical"])),
            series(
                "all of the bridge",
                "d",
                "bridge",
                Some(&["ingress", "critical", "noncritical", "control"]),
            ),
        ],
        logarithmic: false,
        shown: number,
    };
    (!rates.is_empty()).then(|| bars.draw())
}

fn scale(summary: &Summary, of: &str) -> Option<String> {
    let rows: Vec<_> = summary.scale.iter().filter(|row| row.of == of).collect();
    let panels: Vec<Panel> =
        [("latency: p50, dashed p99, µs", false), ("CPU of all processes for each sample, µs", true)]
            .into_iter()
            .map(|(title, is_cpu)| {
                let mut shown = Vec::new();
                for (program, class) in [("direct", "c"), ("relay", "b"), ("bridge", "a")] {
                    let of = |value: fn(&super::summary::Scale) -> Option<f64>| -> Vec<(f64, f64)> {
                        let rows = rows.iter().filter(|row| row.program == program);
                        rows.filter_map(|row| Some((row.count as f64, value(row)?))).collect()
                    };
                    if is_cpu {
                        let total = |row: &super::summary::Scale| {
                            (!row.cpu_us_per_sample.is_empty()).then(|| row.cpu_us_per_sample.values().sum())
                        };
                        shown.push(Line { name: program, class: class.to_owned(), points: of(total) });
                    } else {
                        shown.push(Line {
                            name: program,
                            class: class.to_owned(),
                            points: of(|row| row.latency.p50_us),
                        });
                        let points = of(|row| row.latency.p99_us);
                        shown.push(Line { name: "", class: format!("{class} tail"), points });
                    }
                }
                shown.retain(|line| !line.points.is_empty());
                Panel { title: title.to_owned(), lines: shown }
            })
            .collect();
    let label = format!("Latency and CPU over the number of {of}");
    (!rows.is_empty()).then(|| lines(&label, of, &panels, Scale::Linear))
}

fn isolation(summary: &Summary, scheduling: &str) -> Option<String> {
    let rows: Vec<&Isolation> = summary.isolation.iter().filter(|row| row.scheduling == scheduling).collect();
    let series = |name, class, of: fn(&Isolation) -> Option<f64>| Series {
        name,
        class,
        values: rows.iter().map(|row| of(row)).collect(),
    };
    let bars = Bars {
        label: "Critical latency by condition of the noncritical lane",
        title: "latency of the critical lane, µs",
        groups: rows.iter().map(|row| row.condition.clone()).collect(),
        series: vec![
            series("p50", "c", |row| row.latency.p50_us),
            series("p99.9", "a", |row| row.latency.p999_us),
        ],
        logarithmic: true,
        shown: |value| number(value.map(f64::round)).replace(".00", "").replace(".0", ""),
    };
    (!rows.is_empty()).then(|| bars.draw())
}

/// Hop and CPU time over the size, between programs of one library.
fn of_sizes(summary: &Summary, library: &str) -> Option<String> {
    type Value = fn(&Summary, &super::summary::Large) -> Option<f64>;
    let panels = [
        ("p50, µs: hop of bridge and relay, latency of direct", large::hop_or_latency_us as Value),
        ("CPU for each sample, µs; of direct: its peers", |_, row| {
            Estimate::of(&row.repetitions_cpu_us).map(|estimate| estimate.median)
        }),
    ]
    .map(|(title, value)| {
        let line = |(program, class): (&'static str, &str)| {
            let rows = large::sweep(summary, library).filter(|row| row.program == program);
            let points = rows.filter_map(|row| Some((row.bytes as f64, value(summary, row)?)));
            // A logarithmic axis has no place for a hop that is lost in the noise.
            let points = points.filter(|point| point.1 > 0.0).collect();
            Line { name: program, class: class.to_owned(), points }
        };
        let lines = [("bridge", "a"), ("relay", "b"), ("direct", "c")].map(line).into_iter();
        Panel { title: title.to_owned(), lines: lines.filter(|line| !line.points.is_empty()).collect() }
    });
    let label = format!("Hop and CPU over the size of a sample, between programs of {library}");
    let title = format!("size of a sample, at {} Hz", large::RATE_HZ);
    panels.iter().any(|panel| !panel.lines.is_empty()).then(|| lines(&label, &title, &panels, Scale::Bytes))
}

fn soak(summary: &Summary) -> Option<String> {
    let soak = summary.soak.as_ref()?;
    let resident: Vec<_> = soak.series.iter().filter(|series| series.unit == "KiB").collect();
    let shown = resident.iter().zip(CLASSES.iter().cycle()).map(|(series, class)| Line {
        name: &series.name,
        class: (*class).to_owned(),
        points: series.points.iter().map(|(at_s, kib)| (at_s / 60.0, kib / 1024.0)).collect(),
    });
    let panel = Panel { title: "memory, MiB".to_owned(), lines: shown.collect() };
    let label = "Memory of each process over time";
    (!resident.is_empty()).then(|| lines(label, "minutes", std::slice::from_ref(&panel), Scale::Linear))
}
