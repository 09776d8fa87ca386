//! Section `scale`: the same load over more routes, and with more noncritical lanes.

use std::collections::BTreeMap;

use adaptive_bridge_measure::hop::{Quantiles, Scale};

use super::beds::{Beds, Kind, Plan, Run, add_up};
use super::link::Record;
use super::options::{Case, Options, SCAN};
use super::out::{Output, RowKey};
use super::system::Usage;

const ROUTES: [usize; 4] = [1, 4, 16, 64];

/// The total rate of all routes, so that only the number of routes differs.
const RATE_HZ: u64 = 640;

/// Numbers of lanes: the critical lane and 0, 1, 3 or 7 noncritical ones.
const LANES: [usize; 4] = [1, 2, 4, 8];

pub fn measure(options: &Options, output: &mut Output) -> Result<(), String> {
    let scheduling = options.first_scheduling();
    for count in ROUTES {
        if !options.wants("scale", &format!("{count} routes")) || (options.quick && count != 16) {
            continue;
        }
        let mut beds = Beds::three(scheduling, &vec![4096; count], options)?;
        let samples = (RATE_HZ as f64 * options.seconds(3.0)) as usize;
        let case = Case { rate_hz: RATE_HZ, bytes: SCAN, samples, first_route: 0, routes: count };
        take_turns(("routes", &[count; 3]), &case, &mut beds, options, output)?;
    }
    let counts: Vec<usize> = LANES
        .into_iter()
        .filter(|count| options.wants("scale", &format!("{count} lanes")))
        .filter(|count| !options.quick || [1, 4].contains(count))
        .collect();
    if counts.is_empty() {
        return Ok(());
    }
    let plan = |count: &usize| Plan {
        lanes: count - 1,
        lanes_run: true,
        ..Plan::new(Kind::Bridge, scheduling, &[4096])
    };
    let plans: Vec<Plan> = counts.iter().map(plan).collect();
    let mut beds = Beds::start(&plans, options)?;
    let case = Case::lasting(1_000, SCAN, options.seconds(5.0), 0);
    take_turns(("lanes", &counts), &case, &mut beds, options, output)
}

/// Measures the beds in turn, repetition by repetition. `counts` has the number of routes or lanes of each
/// bed.
fn take_turns(
    (of, counts): (&str, &[usize]),
    case: &Case,
    beds: &mut Beds,
    options: &Options,
    output: &mut Output,
) -> Result<(), String> {
    let mut runs: Vec<Vec<Run>> = beds.0.iter().map(|_| Vec::new()).collect();
    let name = case.name();
    for repetition in 0..options.repetitions {
        for ((bed, count), runs) in beds.0.iter_mut().zip(counts).zip(&mut runs) {
            eprintln!("scale: {count} {of}, {}, {name}", bed.name());
            let run = bed.measure(case)?;
            let case = format!("{count} {of}");
            let key =
                RowKey { section: "scale", scheduling: "", case: &case, program: bed.name(), repetition };
            output.raw_quantiles(key, "latency", &Quantiles::of(&latencies_us(&run)));
            for (process, ns) in &run.cpu_ns {
                let us = *ns as f64 / 1_000.0 / run.accepted.max(1) as f64;
                output.raw(key, &format!("{process} cpu us/sample"), us);
            }
            runs.push(run);
        }
    }
    for ((bed, count), runs) in beds.0.iter().zip(counts).zip(&runs) {
        let all: Vec<f64> = runs.iter().flat_map(latencies_us).collect();
        let accepted: u64 = runs.iter().map(|run| run.accepted).sum();
        let mut reasons = BTreeMap::new();
        runs.iter().for_each(|run| add_up(&mut reasons, run.reasons()));
        let mut cpu_us_per_sample: BTreeMap<String, f64> = BTreeMap::new();
        for (process, ns) in runs.iter().flat_map(|run| &run.cpu_ns) {
            *cpu_us_per_sample.entry(process.clone()).or_default() +=
                *ns as f64 / 1_000.0 / accepted.max(1) as f64;
        }
        output.summary.scale.push(Scale {
            of: of.to_owned(),
            count: *count,
            program: bed.name().to_owned(),
            rate_hz: case.rate_hz,
            bytes: case.bytes,
            missing: runs.iter().map(Run::missing).sum(),
            reasons,
            latency: Quantiles::of(&all),
            repetitions_p50_us: runs
                .iter()
                .filter_map(|run| Quantiles::of(&latencies_us(run)).p50_us)
                .collect(),
            cpu_us_per_sample,
            rss_kib: bed
                .middle
                .processes()
                .into_iter()
                .map(|(name, pid)| (name, Usage::of(pid).rss_kib))
                .collect(),
        });
    }
    Ok(())
}

/// The latencies of a run, from the write to the subscriber's decoder.
pub fn latencies_us(run: &Run) -> Vec<f64> {
    run.records.iter().map(Record::latency_us).collect()
}
