//! Draws the report's figures.

use super::cells::{Cell, Place, Results};
use super::measures::{backlog, remote_hosts};
use super::plot::{Bars, Curve, Line, Panel, Series, Strip, Timeline, cdf};
use super::record::{Role, RtpsReading, Run};
use super::{format, paper};
use crate::statistics::{Distribution, sliding_rate};

const LEVELS: [(&str, &str); 4] =
    [("Clean", "clean"), ("Mild", "mild"), ("Moderate", "moderate"), ("Strong", "strong")];

/// Draws Figure 4: critical p95 and publisher rate by impairment, with and without the bridge.
pub fn figure_4(results: &Results, place: &Place, reading: &str) -> [String; 2] {
    let series = |name,
                  class,
                  variant: &str,
                  of: fn(&super::measures::Measures) -> Option<f64>,
                  paper: fn(&paper::Row) -> f64| {
        let scenario = |level: &str| format!("{variant}_{level}");
        Series {
            name,
            class,
            values: LEVELS
                .iter()
                .map(|(_, level)| results.cell(place, reading, &scenario(level))?.estimate(of))
                .collect(),
            paper: LEVELS
                .iter()
                .map(|(_, level)| paper::row(&scenario(level)).filter(|_| place.library == "fast").map(paper))
                .collect(),
        }
    };
    let both = |of: fn(&super::measures::Measures) -> Option<f64>, paper: fn(&paper::Row) -> f64| {
        vec![
            series("no bridge", "baseline", "baseline", of, paper),
            series("with the bridge", "bridge", "bridge", of, paper),
        ]
    };
    let groups: Vec<&str> = LEVELS.iter().map(|(name, _)| *name).collect();
    [
        Bars {
            label: "Critical p95 latency by impairment, without and with the bridge",
            groups: groups.clone(),
            series: both(|one| one.critical_ms.quantile(0.95), |row| row.p95_ms),
            logarithmic: true,
            target: None,
            shown: format::ms,
        }
        .draw(),
        Bars {
            label: "Publisher rate by impairment, without and with the bridge",
            groups,
            series: both(|one| one.rate_hz, |row| row.rate_hz),
            logarithmic: false,
            target: Some(30.0),
            shown: format::hz,
        }
        .draw(),
    ]
}

/// Draws Figure 5: cumulative distributions of the critical latency, without and with the bridge, on the same
/// axis.
pub fn figure_5(results: &Results, place: &Place, reading: &str) -> [String; 2] {
    let curves = |variant: &str| -> Vec<Curve> {
        let curve = |(name, level): &(&'static str, &'static str)| {
            let cell = results.cell(place, reading, &format!("{variant}_{level}"))?;
            Some(Curve { name, class: level, latencies_ms: results.pooled_critical_ms(cell) })
        };
        LEVELS.iter().filter_map(curve).collect()
    };
    let both = [curves("baseline"), curves("bridge")];
    let values = || both.iter().flatten().flat_map(|curve| curve.latencies_ms.values());
    let least = values().copied().fold(f64::INFINITY, f64::min);
    let range_ms =
        if least.is_finite() { (least, values().copied().fold(1.0, f64::max)) } else { (0.1, 10.0) };
    let [baseline, bridge] = &both;
    [
        cdf("Critical latency without the bridge", baseline, range_ms),
        cdf("Critical latency with the bridge", bridge, range_ms),
    ]
}

/// Draws the time line of a run.
pub fn timeline(run: &Run) -> String {
    let manifest = &run.manifest;
    let mut panels = vec![rates(run), latencies(run), calls(run)];
    panels.extend(held(run));
    panels.extend(rtps(run));
    panels.extend(fragment_memory(run));
    let mut strips = Vec::new();
    if let Some(bridge) = &run.bridge {
        for (id, record) in &bridge.subscribers {
            strips.push(Strip { title: format!("Classifier's state of {id}"), changes: &record.states });
        }
        for (lane, changes) in &bridge.lanes {
            strips.push(Strip { title: format!("Mode of lane {lane}"), changes });
        }
    }
    let signals =
        run.events.iter().filter(|event| matches!(event.event.as_str(), "stop" | "continue" | "kill"));
    Timeline {
        label: &format!("Time line of {}", manifest.run),
        end_s: run.length_s(),
        impaired: run.impaired_spans(),
        events: signals.map(|event| (event.at_s, format!("{} {}", event.event, event.subject))).collect(),
        panels,
        strips,
    }
    .draw()
}

/// The run of a cell whose time line is shown: the first repetition.
pub fn shown_run<'a>(results: &'a Results, cell: &Cell) -> Option<&'a Run> {
    cell.runs.first().and_then(|index| results.runs.get(*index))
}

fn rates(run: &Run) -> Panel<'static> {
    let mut lines = Vec::new();
    let mut nominal_hz: f64 = 0.0;
    for (index, publisher) in run.published.iter().enumerate() {
        nominal_hz = publisher.endpoint.rate_hz;
        let times: Vec<f64> = publisher.attempts.iter().map(|attempt| attempt.at_s).collect();
        let points = sliding_rate(&times, 0.0, run.length_s(), 1.0 / nominal_hz).points;
        let name = if index == 0 { "publisher" } else { "another publisher" };
        lines.push(Line { name, class: "baseline", points });
    }
    lines.truncate(1);
    for (class, subscriber) in ["bridge", "third"].into_iter().zip(run.of_role(Role::Slow)) {
        let times: Vec<f64> = subscriber.receptions.iter().map(|reception| reception.at_s).collect();
        let points = sliding_rate(&times, 0.0, run.length_s(), 1.0 / nominal_hz.max(1e-3)).points;
        lines.push(Line {
            name: if class == "bridge" { "remote subscriber" } else { "another" },
            class,
            points,
        });
    }
    Panel {
        title: "Rate in windows of 5 s, Hz",
        lines,
        logarithmic: false,
        at_least: nominal_hz,
        target: Some(nominal_hz),
    }
}

fn latencies(run: &Run) -> Panel<'static> {
    let all = || run.of_role(Role::Critical).flat_map(|one| &one.receptions);
    let points = || all().map(|reception| (reception.at_s, reception.latency_ms));
    Panel {
        title: "Critical latency per second, ms",
        lines: vec![
            Line { name: "largest", class: "baseline", points: per_second(run, points(), Distribution::max) },
            Line {
                name: "median",
                class: "clean",
                points: per_second(run, points(), |all| all.quantile(0.5)),
            },
        ],
        logarithmic: true,
        at_least: 1.0,
        target: None,
    }
}

fn calls(run: &Run) -> Panel<'static> {
    let attempts = || run.published.iter().flat_map(|one| &one.attempts);
    let all = attempts().map(|attempt| (attempt.at_s, attempt.call_ms));
    let failed = attempts().filter(|attempt| !attempt.ok).map(|attempt| (attempt.at_s, attempt.call_ms));
    let mut lines =
        vec![Line { name: "longest", class: "baseline", points: per_second(run, all, Distribution::max) }];
    let failed = per_second(run, failed, Distribution::max);
    if failed.iter().any(|point| point.1.is_finite()) {
        lines.push(Line { name: "longest that failed", class: "strong", points: failed });
    }
    Panel {
        title: "Longest publish call per second, ms",
        lines,
        logarithmic: true,
        at_least: 1.0,
        target: None,
    }
}

fn held(run: &Run) -> Option<Panel<'static>> {
    let subscriber = run.of_role(Role::Slow).find(|one| one.endpoint.lane.is_none())?;
    let held = backlog(run, subscriber).into_iter().map(|(at_s, held)| (at_s, held as f64));
    let points = per_second(run, held, Distribution::max);
    Some(Panel {
        title: "Most samples held for the remote subscriber, per second",
        lines: vec![Line { name: "held", class: "third", points }],
        logarithmic: false,
        at_least: 10.0,
        target: None,
    })
}

fn rtps(run: &Run) -> Option<Panel<'static>> {
    let host = remote_hosts(run).into_iter().next()?;
    let growth = |direction: &str, of: fn(&RtpsReading) -> u64| -> Vec<(f64, f64)> {
        let readings: Vec<&RtpsReading> =
            run.rtps.iter().filter(|one| one.port == host && one.direction == direction).collect();
        let pairs = readings.windows(2).map(|pair| {
            let (over_s, grown) = (pair[1].at_s - pair[0].at_s, of(pair[1]).saturating_sub(of(pair[0])));
            (pair[1].at_s, grown as f64 / over_s.max(1e-3))
        });
        pairs.filter(|(at_s, _)| (0.0..=run.length_s()).contains(at_s)).collect()
    };
    let lines = vec![
        Line { name: "data", class: "bridge", points: growth("to_host", |one| one.user_data) },
        Line { name: "heartbeats", class: "moderate", points: growth("to_host", |one| one.user_heartbeat) },
        Line { name: "acknacks", class: "strong", points: growth("from_host", |one| one.user_acknack) },
    ];
    (!lines[0].points.is_empty()).then_some(Panel {
        title: "RTPS to and from the remote host, per second",
        lines,
        logarithmic: false,
        at_least: 10.0,
        target: None,
    })
}

fn fragment_memory(run: &Run) -> Option<Panel<'static>> {
    let readings = run.kernel.iter().filter(|one| one.host == "switch");
    let points: Vec<(f64, f64)> = readings
        .filter(|one| (0.0..=run.length_s()).contains(&one.at_s))
        .map(|one| (one.at_s, one.fragment_memory_bytes as f64 / 1024.0))
        .collect();
    points.iter().any(|point| point.1 > 0.0).then_some(Panel {
        title: "Memory of incomplete datagrams at the switch, KiB",
        lines: vec![Line { name: "memory", class: "third", points }],
        logarithmic: false,
        at_least: 10.0,
        target: None,
    })
}

/// Computes a figure of the points in each second of the window; a second without points is a gap (NaN).
fn per_second(
    run: &Run,
    points: impl Iterator<Item = (f64, f64)>,
    figure: fn(&Distribution) -> Option<f64>,
) -> Vec<(f64, f64)> {
    let seconds = run.length_s().ceil() as usize;
    let mut values: Vec<Vec<f64>> = vec![Vec::new(); seconds];
    for (at_s, value) in points.filter(|point| point.0 >= 0.0) {
        if let Some(second) = values.get_mut(at_s as usize) {
            second.push(value);
        }
    }
    let figures = values.into_iter().map(|values| figure(&Distribution::new(values)).unwrap_or(f64::NAN));
    figures.enumerate().map(|(second, value)| (second as f64 + 0.5, value)).collect()
}
