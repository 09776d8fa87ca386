//! Memory over time: a whole bridge under load, and what each of its processes holds.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::time::{Duration, Instant};

use super::beds::{Beds, Plan, add_up};
use super::held::HeldUp;
use super::options::{Case, Options, SCAN};
use super::out::{Of, Output};
use super::report::{Lossy, Soak, SoakSeries};
use super::system::{Taken, descriptors};

/// Of each turn: most of the time scans, then some point clouds, which go by reference.
const SCANS_S: f64 = 4.0;
const CLOUDS_S: f64 = 1.0;

/// More points of a series than this show nothing more.
const MOST_POINTS: usize = 400;

pub fn measure(duration: Duration, options: &Options, output: &mut Output) -> Result<(), String> {
    let scheduling = options.first_scheduling();
    let mut beds = Beds::start(&[Plan::whole(scheduling, &[4096, 2 << 20])], options)?;
    let bed = &mut beds.0[0];
    let (scans, clouds) = (Case::lasting(1_000, SCAN, SCANS_S, 0), Case::lasting(30, 1 << 20, CLOUDS_S, 1));
    let mut soak = Soak {
        load: format!("{} for {SCANS_S} s and {} for {CLOUDS_S} s, in turn", scans.name(), clouds.name()),
        ..Soak::default()
    };
    let held_up = HeldUp::watch();
    let (began, mut turn) = (Instant::now(), 0);
    while began.elapsed() < duration {
        let of = Of { section: "soak", scheduling: "", case: "", program: "bridge", repetition: turn };
        for case in [&scans, &clouds] {
            held_up.take_ms();
            let run = bed.measure(case)?;
            let (held_up_ms, missing) = (held_up.take_ms(), run.missing());
            soak.accepted += run.accepted;
            soak.missing += missing;
            add_up(&mut soak.reasons, run.reasons());
            output.raw(of, &format!("{} Hz: held up ms", case.rate_hz), held_up_ms);
            if missing > 0 {
                soak.lossy.push(Lossy { at_s: began.elapsed().as_secs_f64(), missing, held_up_ms });
            } else {
                soak.held_up_ms = Some(soak.held_up_ms.unwrap_or(0.0).max(held_up_ms));
            }
        }
        let at_s = began.elapsed().as_secs_f64();
        output.raw(of, "at s", at_s);
        output.raw(of, "missing so far", soak.missing as f64);
        let mut see = |name: String, unit: &str, value: f64| {
            output.raw(of, &format!("{name} {unit}"), value);
            match soak.series.iter_mut().find(|series| series.name == name && series.unit == unit) {
                Some(series) => series.points.push((at_s, value)),
                None => {
                    soak.series.push(SoakSeries { name, unit: unit.to_owned(), points: vec![(at_s, value)] })
                }
            }
        };
        for (process, pid) in bed.between() {
            // Without the pool's slots, which count for a process once it has touched them: they have a
            // series of their own.
            let taken = Taken::by(pid);
            see(process.clone(), "KiB", taken.rss_kib.saturating_sub(taken.shared_kib) as f64);
            see(process, "descriptors", descriptors(pid) as f64);
        }
        see("shared memory".to_owned(), "KiB", shared_kib(&bed.between()));
        eprintln!("soak: {:.0} of {} s, {} missing", at_s, duration.as_secs(), soak.missing);
        turn += 1;
    }
    soak.seconds = began.elapsed().as_secs_f64();
    for series in &mut soak.series {
        let step = series.points.len().div_ceil(MOST_POINTS).max(1);
        series.points = series.points.iter().copied().step_by(step).collect();
    }
    output.summary.soak = Some(soak);
    Ok(())
}

/// What the files in /dev/shm that these processes have mapped take there: pools, queues and boards.
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
