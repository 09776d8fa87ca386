//! Sections `latency` and `loss`: the sweep over rates and payloads, and the runs in which no sample may be
//! lost. Wake-up, direct, relay and bridge take turns.

use std::collections::BTreeMap;

use adaptive_bridge_measure::hop::{Latency, Quantiles, targets};
use adaptive_bridge_measure::statistics::median;

use super::beds::{Beds, Kind, Run, add_up};
use super::histogram::Buckets;
use super::options::{Case, Options, SCAN, SWEEP_ROUTES};
use super::out::{Output, RowKey};
use super::system::Scheduling;
use super::throughput;
use super::wakeup;

/// The largest payload that is sent at thousands of Hz.
const SMALL_BYTES: usize = 64 << 10;

/// `queue_depth` of the critical lane for such rates: a fifth of a second at 5 kHz, where the default of 64
/// holds 13 ms.
const FAST_QUEUE_DEPTH: usize = 1024;

/// The latencies and counts of one program in one case, over its repetitions.
#[derive(Default)]
struct Program {
    latency: Vec<f64>,
    from_due: Vec<f64>,
    /// The latency quantiles of each repetition.
    each: Vec<Quantiles>,
    missing: u64,
    reasons: BTreeMap<String, u64>,
    cpu_ns: u64,
    accepted: u64,
    dds_in: Vec<f64>,
    dds_out: Vec<f64>,
    shm: Buckets,
    hand_over: Buckets,
    /// Forwarded samples, and the copies that in-place assembly and forwarding by reference avoided.
    copies: Option<(u64, u64)>,
}

pub fn measure(options: &Options, output: &mut Output) -> Result<(), String> {
    for scheduling in options.schedulings() {
        let cases = options.sweep();
        let searches =
            if scheduling == options.first_scheduling() { throughput::payloads(options) } else { Vec::new() };
        let is_small = |bytes: usize| bytes <= SMALL_BYTES;
        let (small, large): (Vec<_>, Vec<_>) = searches.into_iter().partition(|bytes| is_small(*bytes));
        let (fast, heavy): (Vec<_>, Vec<_>) =
            options.loss_checks().into_iter().partition(|case| is_small(case.bytes));
        if !fast.is_empty() || !small.is_empty() {
            let routes = SWEEP_ROUTES.into_iter().filter(|bytes| is_small(*bytes)).collect::<Vec<_>>();
            let mut beds = Beds::three_with_queues(Some(FAST_QUEUE_DEPTH), scheduling, &routes, options)?;
            measure_limits(fast, small, scheduling, &mut beds, options, output)?;
        }
        if !cases.is_empty() || !heavy.is_empty() || !large.is_empty() {
            let mut beds = Beds::three(scheduling, &SWEEP_ROUTES, options)?;
            sweep(&cases, scheduling, &mut beds, options, output)?;
            measure_limits(heavy, large, scheduling, &mut beds, options, output)?;
        }
    }
    Ok(())
}

/// Measures at high rates: first those at which no sample may be lost, then the search for the highest rate.
fn measure_limits(
    losses: Vec<Case>,
    searches: Vec<usize>,
    scheduling: Scheduling,
    beds: &mut Beds,
    options: &Options,
    output: &mut Output,
) -> Result<(), String> {
    for case in losses {
        for bed in &mut beds.0 {
            eprintln!("loss: {} {}, {}", case.name(), bed.name(), scheduling.label());
            let run = bed.measure(&case)?;
            output.summary.loss.push(run.loss(&case, scheduling));
        }
    }
    for bytes in searches {
        throughput::search(bytes, scheduling, beds, options, output)?;
    }
    Ok(())
}

/// Measures the cases of the sweep, repetition by repetition.
fn sweep(
    cases: &[Case],
    scheduling: Scheduling,
    beds: &mut Beds,
    options: &Options,
    output: &mut Output,
) -> Result<(), String> {
    let mut programs: BTreeMap<(usize, &'static str), Program> = BTreeMap::new();
    let repetitions = |case: &Case| {
        let has_target =
            targets::HOPS.iter().any(|hop| (hop.rate_hz, hop.bytes) == (case.rate_hz, case.bytes));
        if has_target { options.target_repetitions() } else { options.repetitions }
    };
    for repetition in 0..cases.iter().map(repetitions).max().unwrap_or(0) {
        for (index, case) in cases.iter().enumerate().filter(|(_, case)| repetition < repetitions(case)) {
            let name = case.name();
            eprintln!("latency {} of {}: {name}, {}", repetition + 1, repetitions(case), scheduling.label());
            let key = |program| RowKey {
                section: "latency",
                scheduling: scheduling.label(),
                case: &name,
                program,
                repetition,
            };
            // A wake-up has no payload, so it is measured once for each rate.
            if has_wakeup(cases, index) {
                let us: Vec<f64> = wakeup::eventfd(case, options, scheduling)?
                    .iter()
                    .map(|ns| *ns as f64 / 1_000.0)
                    .collect();
                let program = programs.entry((index, "wake-up")).or_default();
                program.each.push(Quantiles::of(&us));
                output.raw_quantiles(key("wake-up"), "wake-up", &Quantiles::of(&us));
                program.latency.extend(us);
            }
            // Each repetition begins with another program.
            let count = beds.0.len();
            for bed in (0..count).map(|turn| (turn + repetition) % count) {
                let bed = &mut beds.0[bed];
                let run = bed.measure(case)?;
                let program = programs.entry((index, bed.name())).or_default();
                add(program, &run, key(bed.name()), output);
            }
        }
    }
    for (index, case) in cases.iter().enumerate() {
        for name in ["wake-up", "direct", "relay", "bridge"] {
            let direct = programs.get(&(index, "direct")).map(|direct| direct.each.clone());
            if let Some(program) = programs.get(&(index, name)) {
                output.summary.latency.push(row(
                    case,
                    scheduling,
                    name,
                    program,
                    &direct.unwrap_or_default(),
                ));
            }
        }
    }
    Ok(())
}

/// Whether a case is the one of its rate with which the wake-up is measured: the laser scan, which has the
/// most samples, else the first case of the rate.
fn has_wakeup(cases: &[Case], index: usize) -> bool {
    let rate_hz = cases[index].rate_hz;
    let mut same = cases.iter().enumerate().filter(|(_, case)| case.rate_hz == rate_hz);
    let scan = same.clone().find(|(_, case)| case.bytes == SCAN);
    scan.or_else(|| same.next()).is_some_and(|(first, _)| first == index)
}

/// Adds one repetition to the figures of a program and writes its raw data.
fn add(program: &mut Program, run: &Run, key: RowKey, output: &mut Output) {
    let (mut latency, mut from_due) = (Vec::new(), Vec::new());
    for record in &run.records {
        latency.push(record.latency_us());
        from_due.push(record.since_due_us());
        program.dds_in.push(record.dds_in_us());
        program.dds_out.push(record.dds_out_us());
        output.sample(key, record);
    }
    let cpu_ns: u64 = run.cpu_ns.values().sum();
    let quantiles = Quantiles::of(&latency);
    output.raw_quantiles(key, "latency", &quantiles);
    output.raw_quantiles(key, "from due", &Quantiles::of(&from_due));
    output.raw_missing(key, run.missing(), &run.reasons());
    if run.kind != Kind::Direct {
        output.raw(key, "cpu us/sample", cpu_ns as f64 / 1_000.0 / run.accepted.max(1) as f64);
    }
    if let Some(bridge) = &run.bridge {
        output.raw_quantiles(key, "shared memory", &bridge.shm.quantiles());
        output.raw_quantiles(key, "hand-over", &bridge.hand_over.quantiles());
        program.shm.merge(&bridge.shm);
        program.hand_over.merge(&bridge.hand_over);
        let copies = program.copies.get_or_insert_default();
        copies.0 += bridge.forwarded;
        copies.1 += bridge.by_reference + bridge.in_place;
    }
    program.each.push(quantiles);
    program.latency.extend(latency);
    program.from_due.extend(from_due);
    program.missing += run.missing();
    add_up(&mut program.reasons, run.reasons());
    program.cpu_ns += cpu_ns;
    program.accepted += run.accepted;
}

/// The row of one program and case in the summary. `direct` has the quantiles of direct in each repetition.
fn row(case: &Case, scheduling: Scheduling, name: &str, program: &Program, direct: &[Quantiles]) -> Latency {
    let hop = |of: fn(&Quantiles) -> Option<f64>| {
        let pairs = program.each.iter().zip(direct);
        let hops: Vec<f64> = pairs.filter_map(|(with, without)| Some(of(with)? - of(without)?)).collect();
        (!hops.is_empty() && ["relay", "bridge"].contains(&name)).then(|| median(&hops))
    };
    let mut stages = BTreeMap::new();
    if program.copies.is_some() {
        stages.insert("DDS in".to_owned(), Quantiles::of(&program.dds_in));
        stages.insert("shared memory".to_owned(), program.shm.quantiles());
        stages.insert("hand-over".to_owned(), program.hand_over.quantiles());
        stages.insert("DDS out".to_owned(), Quantiles::of(&program.dds_out));
    }
    Latency {
        scheduling: scheduling.label().to_owned(),
        rate_hz: case.rate_hz,
        bytes: case.bytes,
        program: name.to_owned(),
        missing: program.missing,
        reasons: program.reasons.clone(),
        latency: Quantiles::of(&program.latency),
        from_due: Quantiles::of(&program.from_due),
        repetitions_p50_us: program.each.iter().filter_map(|each| each.p50_us).collect(),
        hop_p50_us: hop(|quantiles| quantiles.p50_us),
        hop_p99_us: hop(|quantiles| quantiles.p99_us),
        cpu_us_per_sample: (program.cpu_ns > 0)
            .then(|| program.cpu_ns as f64 / 1_000.0 / program.accepted.max(1) as f64),
        stages,
        // A sample is copied into shared memory unless ingress assembled it there, and copied out of it
        // unless the lane forwarded it by reference.
        copies: program.copies.map(|(forwarded, avoided)| 2.0 - avoided as f64 / forwarded.max(1) as f64),
    }
}
