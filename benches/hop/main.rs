//! What the bridge costs, beside what it is measured against, all in one run.
//!
//! - **wake-up**: an eventfd between two threads on the two CPUs, the least that a hand-over between
//!   processes costs on this machine at this rate;
//! - **direct**: a publisher process to a subscriber process, with the bridge's own DDS library;
//! - **relay**: one process between them that reads and writes with that library, without shared memory;
//! - **bridge**: the shipped binary.
//!
//! The programs of a section stay up all the time that it takes; only the publisher of one of them sends at a
//! time, again and again one after the other. Sending is open loop: sample k is due at `start + k / rate`
//! whatever became of the one before it, and both the latency from the moment of the write and the one from
//! the moment it was due are recorded.
//!
//! `cargo bench` takes an hour, `cargo bench -- --quick` two minutes. Other arguments: [`Options`].

mod beds;
mod held;
mod histogram;
mod isolation;
mod latency;
mod link;
mod options;
mod out;
mod report;
mod resources;
mod scale;
mod soak;
mod system;
mod throughput;
mod wakeup;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use adaptive_bridge::telemetry::CpuTime;
use options::Options;
use out::Output;
use report::Summary;
use system::Scheduling;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(role) = arguments.first().filter(|role| role.starts_with("__")) {
        return link::run(role, &arguments[1..]);
    }
    let done = Options::parse(&arguments).and_then(|options| match &options.page {
        Some(runs) => fill_page(runs),
        None => measure(&options),
    });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<(), String> {
    let _alone = system::alone()?;
    let _awake = if options.awake { Some(system::awake()?) } else { None };
    let began = CpuTime::now();
    let mut options = options.clone();
    let mut summary = Summary {
        date: out::date(std::time::SystemTime::now()),
        machine: system::machine(),
        parameters: vec![format!(
            "placement {}, {} repetitions, {} of hops and CPU that are judged, durations times {}{}{}",
            options.placement.label(),
            options.repetitions,
            options.judged_repetitions(),
            options.longer,
            if options.quick { ", quick" } else { "" },
            if options.awake { ", CPUs kept awake" } else { "" }
        )],
        ..Summary::default()
    };
    if options.schedulings().contains(&Scheduling::Fifo) && !system::has_fifo() {
        if options.scheduling.is_some() {
            return Err("no right to SCHED_FIFO: root, or CAP_SYS_NICE".to_owned());
        }
        summary.skipped.push("scheduling fifo: no right to it".to_owned());
        options.scheduling = Some(Scheduling::Other);
    }
    let first = options.first_scheduling().label();
    summary.parameters.push(format!("throughput, resources and scale with scheduling {first}"));
    let mut output = Output::new(summary);
    if let Some(duration) = options.soak {
        soak::measure(duration, &options, &mut output)?;
    } else {
        output.summary.skipped.extend(options.left_out());
        latency::measure(&options, &mut output)?;
        resources::measure(&options, &mut output)?;
        scale::measure(&options, &mut output)?;
        isolation::measure(&options, &mut output)?;
    }
    let stolen_percent = CpuTime::now().stolen_percent_since(began);
    let line =
        format!("the hypervisor kept {stolen_percent:.0} % of the CPUs' time for others meanwhile (steal)");
    output.summary.parameters.push(line);
    let folder = output.finish(&options)?;
    println!("raw data: {}", folder.display());
    let failures = report::soak_failures(&output.summary);
    if failures.is_empty() { Ok(()) } else { Err(failures.join("; ")) }
}

/// Fills the figures of docs/performance.md from runs that are kept.
fn fill_page(runs: &[PathBuf]) -> Result<(), String> {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/performance.md");
    let say = |path: &Path| {
        let path = path.display().to_string();
        move |error: &dyn std::fmt::Display| format!("{path}: {error}")
    };
    let text = fs::read_to_string(&page).map_err(|error| say(&page)(&error))?;
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/runs");
    let mut runs = runs.to_vec();
    if runs.is_empty() {
        runs.extend(report::runs_named(&text).iter().map(|name| kept.join(name)));
    }
    let mut summaries = Vec::new();
    for run in &runs {
        let name = run.file_name().ok_or("a run is a folder")?.to_string_lossy().into_owned();
        let path = run.join("summary.json");
        let text = fs::read_to_string(&path).map_err(|error| say(&path)(&error))?;
        let summary: Summary = serde_json::from_str(&text).map_err(|error| say(&path)(&error))?;
        summaries.push((name, summary));
    }
    let filled = report::fill(&text, &summaries)?;
    fs::write(&page, filled).map_err(|error| say(&page)(&error))?;
    println!("{} is filled from {} runs", page.display(), summaries.len());
    Ok(())
}
