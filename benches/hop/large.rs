//! Section `large`: hop and CPU time over the size of a sample, between programs of other DDS libraries, and
//! the samples that are lost with the receive buffers of a kernel without settings.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use adaptive_bridge_measure::hop::{Large, Quantiles, large};

use super::beds::{FIRST_DOMAIN, Kind, Middle, Plan, Run, add_up};
use super::buffers::StockBuffers;
use super::link::Record;
use super::options::{Case, Options};
use super::out::{Output, RowKey};
use super::peers::{Library, Pair};
use super::system;

/// The largest sample of each route: for 1 KiB and 2,948 bytes, and for each other size.
const ROUTES: [usize; 7] = [4096, 16 << 10, 64 << 10, 256 << 10, 1 << 20, 4 << 20, 8 << 20];

/// The duration of each burst, 30 samples at 30 Hz.
const BURST_S: f64 = 1.0;

/// A size at a rate, between programs of one library.
struct Cell {
    library: Library,
    case: Case,
    stock_buffers: bool,
    repetitions: usize,
}

impl Cell {
    fn name(&self) -> String {
        let buffers = if self.stock_buffers { ", 208 KiB buffers" } else { "" };
        format!("{} {}{buffers}", self.library.label(), self.case.name())
    }
}

/// The cells that the options select.
fn cells(options: &Options) -> Vec<Cell> {
    let has_target = |bytes: usize| large::LIMITS.iter().any(|limits| limits.bytes == bytes);
    let sizes = large::SIZES.map(|bytes| (large::RATE_HZ, bytes));
    let mut cells = Vec::new();
    for library in Library::ALL {
        let mut add = |(rate_hz, bytes): (u64, usize), stock_buffers, repetitions| {
            let route = ROUTES.iter().position(|max| *max >= bytes).unwrap_or(0);
            let case = Case::lasting(rate_hz, bytes, options.seconds(BURST_S), route);
            let cell = Cell { library, case, stock_buffers, repetitions };
            let is_quick = library == Library::Fast && bytes == 1 << 20 && !stock_buffers;
            if options.wants("large", &cell.name()) && (is_quick || !options.quick) {
                cells.push(cell);
            }
        };
        for size in sizes {
            add(size, false, options.large_repetitions(has_target(size.1)));
        }
        for small in large::SMALL {
            add(small, false, options.large_repetitions(false));
        }
        for limits in &large::LIMITS {
            add((large::RATE_HZ, limits.bytes), true, options.large_repetitions(false));
        }
    }
    cells
}

pub fn measure(options: &Options, output: &mut Output) -> Result<(), String> {
    let mut cells = cells(options);
    for library in Library::ALL {
        let before = cells.len();
        if let Some(reason) = library.missing() {
            cells.retain(|cell| cell.library != library);
            if cells.len() < before {
                output.skip(format!("large {}: {reason}", library.label()));
            }
        }
    }
    if !cells.is_empty() {
        output.summary.parameters.push(format!(
            "large: {} repetitions of sizes with a target, {} of others",
            options.large_repetitions(true),
            options.large_repetitions(false)
        ));
    }
    let (stock, own): (Vec<_>, Vec<_>) = cells.into_iter().partition(|cell| cell.stock_buffers);
    measure_all(&own, options, output)?;
    if stock.is_empty() {
        return Ok(());
    }
    // Programs that start from here on have small buffers, so all start again.
    match StockBuffers::set() {
        Ok(_until_here) => measure_all(&stock, options, output),
        Err(reason) => {
            output.skip(format!("large with 208 KiB buffers: {reason}; run as root"));
            Ok(())
        }
    }
}

/// Starts relay and bridge, and measures the cells one after the other.
fn measure_all(cells: &[Cell], options: &Options, output: &mut Output) -> Result<(), String> {
    if cells.is_empty() {
        return Ok(());
    }
    let scheduling = options.first_scheduling();
    let plans = Kind::ALL.map(|kind| match kind {
        Kind::Bridge => Plan::whole(scheduling, &ROUTES),
        kind => Plan::new(kind, scheduling, &ROUTES),
    });
    let mut middles = Vec::new();
    for (plan, domain) in plans.iter().zip(FIRST_DOMAIN..) {
        middles.push(Middle::start(plan, domain, options)?);
    }
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let began = Instant::now();
    for (index, cell) in cells.iter().enumerate() {
        eprintln!(
            "large {} of {}: {}, {} repetitions, scheduling {}; {:.1} min so far",
            index + 1,
            cells.len(),
            cell.name(),
            cell.repetitions,
            scheduling.label(),
            began.elapsed().as_secs_f64() / 60.0
        );
        let rows = measure_cell(cell, &plans, &mut middles, folder.path(), options, output)
            .map_err(|error| format!("large {}: {error}", cell.name()))?;
        output.summary.large.extend(rows);
    }
    Ok(())
}

/// Measures direct, relay and bridge in turn, repetition by repetition.
fn measure_cell(
    cell: &Cell,
    plans: &[Plan; 3],
    middles: &mut [Middle],
    folder: &Path,
    options: &Options,
    output: &mut Output,
) -> Result<Vec<Large>, String> {
    let mut pairs = Vec::new();
    for (plan, domain) in plans.iter().zip(FIRST_DOMAIN..) {
        pairs.push(Pair::start(cell.library, &cell.case, plan, domain, &folder.join("peer"), options)?);
    }
    for (pair, plan) in pairs.iter_mut().zip(plans) {
        pair.warm_up().map_err(|error| format!("{}: {error}", plan.kind.label()))?;
    }
    let mut runs: Vec<Vec<Run>> = plans.iter().map(|_| Vec::new()).collect();
    for repetition in 0..cell.repetitions {
        // Each repetition begins with another program.
        for turn in 0..plans.len() {
            let at = (turn + repetition) % plans.len();
            let run = run(cell, &plans[at], &mut middles[at], &mut pairs[at])?;
            record(cell, repetition, &run, output);
            runs[at].push(run);
        }
    }
    let mut rows = Vec::new();
    // A repetition in which nothing arrived in one of them has no hop.
    let has_hop = |repetition: usize| runs.iter().all(|runs| !runs[repetition].records.is_empty());
    let counted: Vec<usize> = (0..cell.repetitions).filter(|repetition| has_hop(*repetition)).collect();
    for (runs, pair) in runs.iter().zip(pairs) {
        rows.push(row(cell, options, runs, &counted, pair.end()?));
    }
    Ok(rows)
}

/// Sends one burst through one program.
fn run(cell: &Cell, plan: &Plan, middle: &mut Middle, pair: &mut Pair) -> Result<Run, String> {
    let routes = cell.case.first_route..cell.case.first_route + 1;
    let before = middle.begin(&routes)?;
    let processes = match plan.kind {
        Kind::Direct => pair.pids().map(|(name, pid)| (name.to_owned(), pid)).to_vec(),
        Kind::Relay | Kind::Bridge => middle.processes(),
    };
    let cpu_before: Vec<u64> = processes.iter().map(|(_, pid)| system::cpu_ns(*pid)).collect();
    let burst = pair.send()?;
    let cpu_ns: BTreeMap<String, u64> = processes
        .into_iter()
        .zip(cpu_before)
        .map(|((name, pid), before)| (name, system::cpu_ns(pid).saturating_sub(before)))
        .collect();
    // Later than the CPU time: an idle wait for a lost sample is no cost of the others.
    let records = pair.receive(&burst)?;
    let (bridge, relay_refused) = middle.finish(&routes, before)?;
    Ok(Run {
        kind: plan.kind,
        accepted: burst.accepted.len() as u64,
        refused: burst.refused,
        records,
        // Known when the subscriber has ended.
        damaged: 0,
        relay_refused,
        cpu_ns,
        bridge,
    })
}

/// Adds a run to the raw data.
fn record(cell: &Cell, repetition: usize, run: &Run, output: &mut Output) {
    let name = cell.name();
    let key = RowKey { section: "large", scheduling: "", case: &name, program: run.kind.label(), repetition };
    for record in &run.records {
        output.sample(key, record);
    }
    output.raw_quantiles(key, "latency", &Quantiles::of(&latencies_us(run)));
    output.raw_missing(key, run.missing(), &run.reasons());
    for (process, ns) in &run.cpu_ns {
        output.raw(key, &format!("{process} cpu us/sample"), per_sample_us(*ns, run));
    }
}

/// The row of one program, of the repetitions that count.
fn row(cell: &Cell, options: &Options, runs: &[Run], counted: &[usize], damaged: u64) -> Large {
    let mut reasons = BTreeMap::new();
    runs.iter().for_each(|run| add_up(&mut reasons, run.drops()));
    let accepted = runs.iter().map(|run| run.accepted).sum();
    let all: Vec<f64> = runs.iter().flat_map(latencies_us).collect();
    let each = |of: &dyn Fn(&Run) -> f64| counted.iter().map(|at| hundredths(of(&runs[*at]))).collect();
    Large {
        library: cell.library.label().to_owned(),
        scheduling: options.first_scheduling().label().to_owned(),
        rate_hz: cell.case.rate_hz,
        bytes: cell.case.bytes,
        program: runs.first().map_or(String::new(), |run| run.kind.label().to_owned()),
        stock_buffers: cell.stock_buffers,
        accepted,
        missing: accepted - all.len() as u64,
        damaged,
        reasons,
        latency: Quantiles::of(&all),
        repetitions_p50_us: each(&|run| Quantiles::of(&latencies_us(run)).p50_us.unwrap_or(f64::NAN)),
        repetitions_cpu_us: each(&|run| per_sample_us(run.cpu_ns.values().sum(), run)),
    }
}

fn latencies_us(run: &Run) -> Vec<f64> {
    run.records.iter().map(Record::latency_us).collect()
}

fn per_sample_us(ns: u64, run: &Run) -> f64 {
    ns as f64 / 1_000.0 / run.accepted.max(1) as f64
}

/// Two decimals are below the resolution of the clocks, and keep a saved run small.
fn hundredths(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}
