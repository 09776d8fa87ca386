//! The soak: the memory of each process of a whole bridge under load, over time.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::time::{Duration, Instant};

use adaptive_bridge_measure::hop::{Lossy, Soak, SoakSeries};
use support::cpu_delay::CpuDelayMonitor;

use super::beds::{Beds, Ending, Plan, add_up};
use super::options::{Case, Options, SCAN};
use super::out::{Output, RowKey};
use super::system::{Usage, descriptors};

/// The part of each turn in which scans are sent. With the rest of the turn 17 s, the time after which
/// publisher and subscriber are restarted: in 70 minutes as often as in four hours with a restart a minute.
const SCANS_S: f64 = 9.0;
/// The part of each turn in which point clouds are sent, which the bridge forwards by reference.
const CLOUDS_S: f64 = 7.0;

/// How often publisher and subscriber are restarted before the measurement: 12 minutes. The memory of a
/// process grew until some 1,600 participants had come and gone, and was constant then.
const RESTARTS_BEFORE: usize = 800;
/// The point clouds that follow each of these restarts. Without them ingress grew by 3 MiB in the first 25
/// minutes of the measurement, and hardly from then on.
const CLOUDS_BEFORE: usize = 20;
/// One in so many of the restarts before the measurement is by SIGKILL: 400 participants, more than the 256
/// that a process remembers of those whose lease ended.
const KILLED_BEFORE: usize = 4;

/// The highest number of points of a series in the summary.
const MAX_POINTS: usize = 400;

pub fn measure(duration: Duration, options: &Options, output: &mut Output) -> Result<(), String> {
    let scheduling = options.first_scheduling();
    let mut beds = Beds::start(&[Plan::whole(scheduling, &[4096, 2 << 20])], options)?;
    let bed = &mut beds.0[0];
    let (scans, clouds) = (Case::lasting(1_000, SCAN, SCANS_S, 0), Case::lasting(100, 1 << 20, CLOUDS_S, 1));
    let mut soak = Soak {
        load: format!(
            "{} for {SCANS_S} s and {} for {CLOUDS_S} s, in turn; publisher and subscriber are restarted after \
             each turn, one time in two by SIGKILL, and {RESTARTS_BEFORE} times before, one in {KILLED_BEFORE} \
             by SIGKILL, with {CLOUDS_BEFORE} point clouds each",
            scans.name(),
            clouds.name()
        ),
        ..Soak::default()
    };
    for restart in 1..=RESTARTS_BEFORE {
        bed.restart_peers(if restart % KILLED_BEFORE == 0 { Ending::Killed } else { Ending::Normal })?;
        bed.measure_with_timeout(&Case { samples: CLOUDS_BEFORE, ..clouds }, 500)?;
        if restart % 100 == 0 {
            eprintln!("soak: {restart} of {RESTARTS_BEFORE} restarts before the measurement");
        }
    }
    let cpu_delays = CpuDelayMonitor::start();
    let (began, mut turn) = (Instant::now(), 0);
    while began.elapsed() < duration {
        let key = RowKey { section: "soak", scheduling: "", case: "", program: "bridge", repetition: turn };
        for case in [&scans, &clouds] {
            cpu_delays.take_max_ms();
            let run = bed.measure(case)?;
            let (held_up_ms, missing) = (cpu_delays.take_max_ms(), run.missing());
            soak.accepted += run.accepted;
            soak.missing += missing;
            add_up(&mut soak.reasons, run.reasons());
            output.raw(key, &format!("{} Hz: held up ms", case.rate_hz), held_up_ms);
            if missing > 0 {
                soak.lossy.push(Lossy { at_s: began.elapsed().as_secs_f64(), missing, held_up_ms });
            } else {
                soak.held_up_ms = Some(soak.held_up_ms.unwrap_or(0.0).max(held_up_ms));
            }
        }
        // A tenth of a second is enough for a slope over an hour, and halves the size of a saved run.
        let at_s = (began.elapsed().as_secs_f64() * 10.0).round() / 10.0;
        output.raw(key, "at s", at_s);
        output.raw(key, "missing so far", soak.missing as f64);
        let mut add_point = |name: String, unit: &str, value: f64| {
            output.raw(key, &format!("{name} {unit}"), value);
            match soak.series.iter_mut().find(|series| series.name == name && series.unit == unit) {
                Some(series) => series.points.push((at_s, value)),
                None => {
                    soak.series.push(SoakSeries { name, unit: unit.to_owned(), points: vec![(at_s, value)] })
                }
            }
        };
        for (process, pid) in bed.middle.processes() {
            // Shared memory has a series of its own: a slot of the pool adds to the resident memory of a
            // process from its first access on. Pages of the program's file are bounded by its size, and the
            // kernel maps and drops them.
            add_point(process.clone(), "KiB", Usage::of(pid).anonymous_kib as f64);
            add_point(process, "descriptors", descriptors(pid) as f64);
        }
        add_point("shared memory".to_owned(), "KiB", shared_kib(&bed.middle.processes()));
        eprintln!("soak: {:.0} of {} s, {} missing", at_s, duration.as_secs(), soak.missing);
        turn += 1;
        bed.restart_peers(if turn % 2 == 0 { Ending::Killed } else { Ending::Normal })?;
    }
    soak.seconds = began.elapsed().as_secs_f64();
    for series in &mut soak.series {
        let step = series.points.len().div_ceil(MAX_POINTS).max(1);
        series.points = series.points.iter().copied().step_by(step).collect();
    }
    output.summary.soak = Some(soak);
    Ok(())
}

/// The allocated size of the files in /dev/shm that the processes have mapped: pools, queues and boards.
fn shared_kib(processes: &[(String, u32)]) -> f64 {
    let mut files: Vec<String> = processes
        .iter()
        .filter_map(|(_, pid)| fs::read_to_string(format!("/proc/{pid}/maps")).ok())
        .flat_map(|maps| {
            let paths = maps.lines().filter_map(|line| Some(line[line.find("/dev/shm/")?..].to_owned()));
            paths.collect::<Vec<_>>()
        })
        .collect();
    files.sort_unstable();
    files.dedup();
    let blocks: u64 = files.iter().filter_map(|path| fs::metadata(path).ok()).map(|file| file.blocks()).sum();
    // A block of stat(2) has 512 bytes.
    blocks as f64 / 2.0
}
