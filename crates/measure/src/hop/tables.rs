//! The Markdown tables of each section; `None` where the run did not measure it.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::summary::{Call, Latency, Resource, Soak, Summary};
use super::targets;
use crate::format::{count, number, payload, range};
use crate::statistics::median;
use crate::table::Table;

/// The programs that are compared, in the order of the tables.
pub const PROGRAMS: [&str; 4] = ["wake-up", "direct", "relay", "bridge"];

/// Counts by name, such as `critical queue_overflow 7, relay window_full 2`.
fn by_name(counts: &BTreeMap<String, u64>) -> String {
    let counts: Vec<String> =
        counts.iter().map(|(name, value)| format!("{name} {}", count(*value))).collect();
    counts.join(", ")
}

/// The number of missing samples and the known reasons, such as `7 (critical queue_overflow 7)`.
pub fn missing(samples: u64, reasons: &BTreeMap<String, u64>) -> String {
    if reasons.is_empty() { count(samples) } else { format!("{} ({})", count(samples), by_name(reasons)) }
}

/// The payloads of the rows, smallest first, except those of the wake-up, which has no payload.
pub fn payloads<'a>(rows: impl Iterator<Item = &'a Latency>) -> Vec<usize> {
    let mut sizes: Vec<usize> = rows.filter(|row| row.program != "wake-up").map(|row| row.bytes).collect();
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

/// The machine, commit, command, parameters and skipped cases of a run.
pub fn run(summary: &Summary) -> String {
    let machine = &summary.machine;
    let mut text = format!(
        "- {}, {} CPUs, Linux {}; load average before: {}; net.core.rmem_max {}\n- commit {}; `{}`\n",
        machine.cpu,
        machine.cpus,
        machine.kernel,
        machine.load_average,
        machine.rmem_max,
        machine.commit,
        machine.command
    );
    for line in &summary.parameters {
        let _ = writeln!(text, "- {line}");
    }
    for line in &summary.skipped {
        let _ = writeln!(text, "- not measured: {line}");
    }
    text
}

/// The hops, their ratio and the tails, a row for each rate and payload.
pub fn hops(summary: &Summary, scheduling: &str) -> Option<String> {
    let mut table = Table::new(&[
        "µs",
        "wake-up p50",
        "direct p50",
        "relay hop",
        "bridge hop",
        "ratio",
        "direct p99.9",
        "relay p99.9",
        "bridge p99.9",
        "bridge max",
    ]);
    for (bytes, rate_hz) in cases(summary, scheduling) {
        let row = |program: &str| latency(summary, scheduling, rate_hz, bytes, program);
        let hop = |program: &str| row(program).and_then(|row| row.hop_p50_us);
        let of =
            |program: &str, quantile: fn(&Latency) -> Option<f64>| number(row(program).and_then(quantile));
        table.row([
            format!("{} Hz of {}", count(rate_hz), payload(bytes)),
            of("wake-up", |row| row.latency.p50_us),
            of("direct", |row| row.latency.p50_us),
            number(hop("relay")),
            number(hop("bridge")),
            number(
                hop("bridge").zip(hop("relay")).and_then(|(bridge, relay)| targets::hop_ratio(bridge, relay)),
            ),
            of("direct", |row| row.latency.p999_us),
            of("relay", |row| row.latency.p999_us),
            of("bridge", |row| row.latency.p999_us),
            of("bridge", |row| row.latency.max_us),
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// All latency figures, a row for each rate, payload and program.
pub fn latencies(summary: &Summary, scheduling: &str) -> Option<String> {
    let mut table = Table::new(&[
        "µs",
        "samples",
        "p50",
        "p99",
        "p99.9",
        "max",
        "hop p50",
        "hop p99",
        "p50 of repetitions",
        "from due p99",
        "CPU/sample",
        "missing",
    ]);
    for (bytes, rate_hz) in cases(summary, scheduling) {
        for program in PROGRAMS {
            let Some(row) = latency(summary, scheduling, rate_hz, bytes, program) else { continue };
            table.row([
                format!("{} Hz of {}, {program}", count(rate_hz), payload(bytes)),
                count(row.latency.samples),
                number(row.latency.p50_us),
                number(row.latency.p99_us),
                number(row.latency.p999_us),
                number(row.latency.max_us),
                number(row.hop_p50_us),
                number(row.hop_p99_us),
                range(&row.repetitions_p50_us),
                number(row.from_due.p99_us),
                number(row.cpu_us_per_sample),
                if program == "wake-up" { String::new() } else { missing(row.missing, &row.reasons) },
            ]);
        }
    }
    (!table.is_empty()).then(|| table.text())
}

/// The latencies of the bridge's stages, a row for each rate and payload.
pub fn stages(summary: &Summary, scheduling: &str) -> Option<String> {
    const STAGES: [&str; 4] = ["DDS in", "shared memory", "hand-over", "DDS out"];
    let mut table = Table::new(&[
        "p50 / p99, µs",
        STAGES[0],
        STAGES[1],
        STAGES[2],
        STAGES[3],
        "shared memory / wake-up",
        "copies",
    ]);
    for (bytes, rate_hz) in cases(summary, scheduling) {
        let Some(row) = latency(summary, scheduling, rate_hz, bytes, "bridge") else { continue };
        let stage = |name: &str| row.stages.get(name).cloned().unwrap_or_default();
        let floor =
            latency(summary, scheduling, rate_hz, bytes, "wake-up").and_then(|row| row.latency.p50_us);
        let ratio = stage(STAGES[1]).p50_us.zip(floor).map(|(stage, floor)| stage / floor);
        let mut cells = vec![format!("{} Hz of {}", count(rate_hz), payload(bytes))];
        for name in STAGES {
            cells.push(format!("{} / {}", number(stage(name).p50_us), number(stage(name).p99_us)));
        }
        cells.extend([number(ratio), number(row.copies)]);
        table.row(cells);
    }
    (!table.is_empty()).then(|| table.text())
}

/// The payloads and rates of the latency section.
fn cases(summary: &Summary, scheduling: &str) -> Vec<(usize, u64)> {
    let rows = summary.latency.iter().filter(|row| row.scheduling == scheduling && row.program != "wake-up");
    let mut cases: Vec<(usize, u64)> = rows.map(|row| (row.bytes, row.rate_hz)).collect();
    cases.sort_unstable();
    cases.dedup();
    cases
}

/// The latency of one program in one case.
fn latency<'a>(
    summary: &'a Summary,
    scheduling: &str,
    rate_hz: u64,
    bytes: usize,
    program: &str,
) -> Option<&'a Latency> {
    summary.latency.iter().find(|row| {
        row.scheduling == scheduling
            && row.rate_hz == rate_hz
            && row.program == program
            && (row.bytes == bytes || program == "wake-up")
    })
}

/// The runs in which no sample may be lost.
pub fn loss(summary: &Summary) -> Option<String> {
    let mut table = Table::new(&[
        "",
        "sent",
        "refused",
        "received",
        "lost",
        "disordered",
        "damaged",
        "account",
        "drops by name",
    ]);
    for row in &summary.loss {
        let case = format!("{} Hz of {}", count(row.rate_hz), payload(row.bytes));
        table.row([
            format!("{case}, {}, {}", row.program, row.scheduling),
            count(row.accepted),
            count(row.refused),
            count(row.received),
            count(row.lost),
            count(row.disordered),
            count(row.damaged),
            row.whole.map_or("", |whole| if whole { "whole" } else { "NOT WHOLE" }).to_owned(),
            if row.drops.is_empty() { "none".to_owned() } else { by_name(&row.drops) },
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// The highest rates without loss.
pub fn throughput(summary: &Summary) -> Option<String> {
    let mut table = Table::new(&["", "rate, Hz", "MB/s", "vs direct", "failure at the next higher rate"]);
    for row in &summary.throughput {
        let direct = summary
            .throughput
            .iter()
            .find(|one| one.program == "direct" && one.bytes == row.bytes && one.scheduling == row.scheduling)
            .and_then(|one| one.rate_hz);
        table.row([
            format!("{}, {}", payload(row.bytes), row.program),
            row.rate_hz.map_or("–".to_owned(), |rate| count(rate.round() as u64)),
            number(row.rate_hz.map(|rate| rate * row.bytes as f64 / 1e6)),
            number(row.rate_hz.zip(direct).map(|(rate, direct)| rate / direct)),
            row.limit.clone(),
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// The total resource usage of relay and bridge.
pub fn totals(summary: &Summary) -> Option<String> {
    const PARTS: [(&str, &str, &[&str]); 3] = [
        ("relay", "relay", &["relay"]),
        ("bridge", "ingress and critical lane", &["ingress", "critical"]),
        ("bridge", "all of the bridge", &["ingress", "critical", "noncritical", "control"]),
    ];
    let mut table = Table::new(&[
        "",
        "CPU, % of one",
        "CPU per 1,000 samples, ms",
        "vs relay",
        "wake-ups/sample",
        "system calls/sample",
        "RSS, MiB",
        "anonymous, MiB",
    ]);
    let mut rates: Vec<u64> = summary.resources.iter().map(|row| row.rate_hz).collect();
    rates.sort_unstable();
    rates.dedup();
    for rate_hz in rates {
        let mut relay_share = None;
        for (program, name, processes) in PARTS {
            let is_part = |row: &&Resource| {
                row.rate_hz == rate_hz && row.program == program && processes.contains(&row.process.as_str())
            };
            let rows: Vec<&Resource> = summary.resources.iter().filter(is_part).collect();
            let Some(first) = rows.first() else { continue };
            let sum = |of: &dyn Fn(&Resource) -> f64| rows.iter().map(|row| of(row)).sum::<f64>();
            let cpu_ms = sum(&|row| row.cpu_ms);
            let share = cpu_ms / first.seconds.max(1e-9) / 10.0;
            let relay = *relay_share.get_or_insert(share);
            let calls: Option<f64> = rows.iter().map(|row| row.system_calls_per_sample).sum();
            table.row([
                format!("{}, {name}", load(rate_hz)),
                number(Some(share)),
                number(first.per_sample(cpu_ms * 1_000.0)),
                number((program == "bridge" && relay > 0.0).then(|| share / relay)),
                number(first.per_sample(sum(&|row| row.sleeps as f64))),
                number(calls),
                number(Some(sum(&|row| row.rss_kib as f64) / 1_024.0)),
                number(Some(sum(&|row| row.anonymous_kib as f64) / 1_024.0)),
            ]);
        }
    }
    (!table.is_empty()).then(|| table.text())
}

fn load(rate_hz: u64) -> String {
    if rate_hz == 0 { "idle".to_owned() } else { format!("{} Hz", count(rate_hz)) }
}

/// The CPU time, wake-ups and memory of each process. Figures under load include the idle turns.
pub fn resources(summary: &Summary) -> Option<String> {
    let mut table = Table::new(&[
        "",
        "CPU, % of one",
        "CPU per 1,000 samples, ms",
        "wake-ups/s",
        "wake-ups/sample",
        "preempted/s",
        "system calls/sample",
        "RSS, MiB",
        "anonymous, MiB",
        "shared, MiB",
        "file, MiB",
    ]);
    let mebibytes = |kib: u64| number(Some(kib as f64 / 1_024.0));
    let mut rows: Vec<&Resource> = summary.resources.iter().collect();
    rows.sort_by_key(|row| row.rate_hz);
    for row in rows {
        let per_s = |value: f64| number((row.seconds > 0.0).then(|| value / row.seconds));
        table.row([
            format!("{}, {}: {}", load(row.rate_hz), row.program, row.process),
            per_s(row.cpu_ms / 10.0),
            // ms per 1,000 samples are µs per sample.
            number(row.per_sample(row.cpu_ms * 1_000.0)),
            per_s(row.sleeps as f64),
            number(row.per_sample(row.sleeps as f64)),
            per_s(row.preemptions as f64),
            number(row.system_calls_per_sample),
            mebibytes(row.rss_kib),
            mebibytes(row.anonymous_kib),
            mebibytes(row.shared_kib),
            mebibytes(row.file_kib),
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// System calls per sample, by name where there is at least one in a hundred samples.
pub fn calls(summary: &Summary) -> Option<String> {
    let mut table = Table::new(&["", "samples", "calls/sample", "by name"]);
    let mut processes: Vec<(&str, &str, u64)> = Vec::new();
    for call in &summary.calls {
        let process = (call.program.as_str(), call.process.as_str(), call.rate_hz);
        if !processes.contains(&process) {
            processes.push(process);
        }
    }
    for (program, process, rate_hz) in processes {
        let mut calls: Vec<&Call> = summary
            .calls
            .iter()
            .filter(|call| call.program == program && call.process == process && call.rate_hz == rate_hz)
            .collect();
        calls.sort_by_key(|call| std::cmp::Reverse(call.count));
        let per_sample = |call: &Call| call.count as f64 / call.samples.max(1) as f64;
        let each: Vec<String> = calls
            .iter()
            .filter(|call| per_sample(call) >= 0.01)
            .map(|call| format!("{} {}", call.call, number(Some(per_sample(call)))))
            .collect();
        table.row([
            format!("{program}: {process}, {rate_hz} Hz"),
            count(calls.first().map_or(0, |call| call.samples)),
            number(Some(calls.iter().map(|call| per_sample(call)).sum())),
            each.join(", "),
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// Latency, CPU time and memory over the number of routes or lanes.
pub fn scale(summary: &Summary, of: &str) -> Option<String> {
    let mut table = Table::new(&[
        "",
        "p50, µs",
        "p99, µs",
        "p99.9, µs",
        "p50 of repetitions",
        "CPU/sample, µs",
        "by process",
        "RSS, MiB",
        "missing",
    ]);
    for row in summary.scale.iter().filter(|row| row.of == of) {
        let cpu: f64 = row.cpu_us_per_sample.values().sum();
        let by_process: Vec<String> = row
            .cpu_us_per_sample
            .iter()
            .map(|(process, us)| format!("{process} {}", number(Some(*us))))
            .collect();
        let memory: u64 = row.rss_kib.values().sum();
        let known = !row.rss_kib.is_empty();
        let many = if row.count == 1 { of.trim_end_matches('s') } else { of };
        table.row([
            format!("{} {many}, {}", row.count, row.program),
            number(row.latency.p50_us),
            number(row.latency.p99_us),
            number(row.latency.p999_us),
            range(&row.repetitions_p50_us),
            number(known.then_some(cpu)),
            by_process.join(", "),
            number(known.then_some(memory as f64 / 1_024.0)),
            missing(row.missing, &row.reasons),
        ]);
    }
    if table.is_empty() {
        return None;
    }
    let mut text = table.text();
    for (program, (latency_us, cpu_us)) in slopes(summary, of) {
        let one = of.trim_end_matches('s');
        let _ = writeln!(
            text,
            "\nEach further {one} costs the {program} {} µs of p50 and {} µs of CPU for each sample (least squares).",
            number(Some(latency_us)),
            number(Some(cpu_us))
        );
    }
    Some(text)
}

/// The cost of each further route or lane for each program: p50, and CPU time per sample of ingress and the
/// critical lane (or of the relay), in µs.
fn slopes(summary: &Summary, of: &str) -> Vec<(&'static str, (f64, f64))> {
    let of_program = |program: &'static str| {
        let rows = || summary.scale.iter().filter(|row| row.of == of && row.program == program);
        let cpu = |row: &super::summary::Scale| {
            ["relay", "ingress", "critical"].iter().filter_map(|name| row.cpu_us_per_sample.get(*name)).sum()
        };
        let latency: Vec<(f64, f64)> =
            rows().filter_map(|row| Some((row.count as f64, row.latency.p50_us?))).collect();
        let cpu: Vec<(f64, f64)> = rows().map(|row| (row.count as f64, cpu(row))).collect();
        Some((program, (least_squares(&latency)?, least_squares(&cpu)?)))
    };
    ["relay", "bridge"].into_iter().filter_map(of_program).collect()
}

/// The slope of the least-squares line through the points.
fn least_squares(points: &[(f64, f64)]) -> Option<f64> {
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / points.len() as f64;
    let (x, y) = (mean(|point| point.0), mean(|point| point.1));
    let squares: f64 = points.iter().map(|point| (point.0 - x).powi(2)).sum();
    (squares > 0.0).then(|| points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum::<f64>() / squares)
}

/// The latency of the critical lane, a row for each condition of the noncritical one.
pub fn isolation(summary: &Summary) -> Option<String> {
    let mut table = Table::new(&[
        "noncritical lane",
        "samples",
        "p50, µs",
        "p99, µs",
        "p99.9, µs",
        "max, µs",
        "p99.9 of rounds",
        "median of rounds",
        "round / undisturbed (95 %)",
        "missing",
        "noncritical forwarded",
    ]);
    for row in &summary.isolation {
        let ratio =
            if row.condition == row.against { None } else { targets::ratio_to_baseline(summary, row) };
        table.row([
            format!("{}, {} Hz, {}", row.condition, count(row.rate_hz), row.scheduling),
            count(row.latency.samples),
            number(row.latency.p50_us),
            number(row.latency.p99_us),
            number(row.latency.p999_us),
            number(row.latency.max_us),
            range(&row.rounds_p999_us),
            number(Some(median(&row.rounds_p999_us))),
            ratio.map_or_else(|| number(None), |ratio| ratio.text()),
            missing(row.missing, &row.reasons),
            count(row.noncritical_forwarded),
        ]);
    }
    (!table.is_empty()).then(|| table.text())
}

/// The load, the missing samples and the memory over time of a soak.
pub fn soak(summary: &Summary) -> Option<String> {
    let soak = summary.soak.as_ref()?;
    let mut table = Table::new(&["", "first", "last", "most", "unit", "per hour (95 % interval)", ""]);
    for series in &soak.series {
        let values = || series.points.iter().map(|point| point.1);
        let (trend, per_hour) = targets::trend(series);
        let is_memory = series.unit == "KiB";
        table.row([
            series.name.clone(),
            number(values().next()),
            number(values().next_back()),
            number(values().reduce(f64::max)),
            series.unit.clone(),
            targets::slope(per_hour),
            match trend {
                _ if !is_memory => String::new(),
                targets::Trend::Flat => "flat".to_owned(),
                targets::Trend::Slow => "grows slowly".to_owned(),
                targets::Trend::Grows => "**grows**".to_owned(),
                targets::Trend::TooShort => "too short to tell".to_owned(),
            },
        ]);
    }
    Some(format!(
        "{:.1} hours of {}: {} samples, missing: {}.{}\n\n{}",
        soak.seconds / 3_600.0,
        soak.load,
        count(soak.accepted),
        missing(soak.missing, &soak.reasons),
        cpu_delays(soak),
        table.text()
    ))
}

/// The longest CPU delays in the periods with missing samples, and in all others.
fn cpu_delays(soak: &Soak) -> String {
    let Some(otherwise_ms) = soak.held_up_ms else { return String::new() };
    let mut text = "\n\nLongest delay of a CPU within 100 ms:".to_owned();
    for lossy in &soak.lossy {
        text.push_str(&format!(
            " {} ms in the period until {} s, in which {} samples are missing;",
            number(Some(lossy.held_up_ms)),
            count(lossy.at_s as u64),
            count(lossy.missing),
        ));
    }
    text.push_str(&format!(" up to {} ms in periods without missing samples.", number(Some(otherwise_ms))));
    text
}

/// The growth and loss for which a soak fails; empty when it passes.
pub fn soak_failures(summary: &Summary) -> Vec<String> {
    let Some(soak) = &summary.soak else { return Vec::new() };
    let grows = soak.series.iter().filter(|series| series.unit == "KiB");
    let mut failures: Vec<String> = grows
        .filter(|series| targets::trend(series).0 == targets::Trend::Grows)
        .map(|series| format!("the memory of {} grows", series.name))
        .collect();
    if soak.missing > 0 {
        failures.push(format!("{} samples are missing", soak.missing));
    }
    failures
}
