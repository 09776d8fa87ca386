//! Measures the latency and the CPU time that the bridge adds, beside three references in the same run.
//!
//! - **wake-up**: an eventfd between two threads on two CPUs, the lowest cost of a hand-over between
//!   processes on this machine at this rate;
//! - **direct**: a publisher process and a subscriber process, with the bridge's own DDS library;
//! - **relay**: one process between them that reads and writes with that library, without shared memory;
//! - **bridge**: the shipped binary.
//!
//! The programs of a section run during the whole section and take turns: only one publisher sends at a time.
//! Publishers are open loop: sample k is due at `start + k / rate`, no matter how the sample before it went.
//! The bench records the latency both from the write and from the due time.
//!
//! `cargo bench` takes 80 minutes, `cargo bench -- --quick` two minutes. `cargo bench -- --help` lists the
//! other arguments.

mod beds;
mod buffers;
mod histogram;
mod isolation;
mod large;
mod latency;
mod link;
mod options;
mod out;
mod peers;
mod resources;
mod scale;
mod soak;
mod system;
mod throughput;
mod wakeup;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use adaptive_bridge_measure::cpu_time::CpuTime;
use adaptive_bridge_measure::hop::{self, Summary};
use clap::Parser;
use options::Options;
use out::Output;
use system::Scheduling;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(role) = arguments.first().filter(|role| role.starts_with("__")) {
        if role == buffers::ROLE {
            return end(buffers::keep());
        }
        return link::run(role, &arguments[1..]);
    }
    let options = Options::parse();
    let done = match &options.page {
        Some(runs) => fill_page(runs),
        None => measure(&options),
    };
    end(done)
}

/// The exit code of an outcome, whose error is printed.
fn end(outcome: Result<(), String>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<(), String> {
    let _lock = system::lock_bench()?;
    let _awake = if options.awake { Some(system::keep_cpus_awake()?) } else { None };
    let cpu_time = || CpuTime::parse(&fs::read_to_string("/proc/stat").unwrap_or_default());
    let began = cpu_time();
    let mut options = options.clone();
    let mut summary = Summary {
        date: out::date(std::time::SystemTime::now()),
        machine: system::machine(),
        parameters: vec![format!(
            "placement {}, {} repetitions, {} where a target applies to hop or CPU, durations times {}{}{}",
            options.placement.label(),
            options.repetitions,
            options.target_repetitions(),
            options.longer,
            if options.quick { ", quick" } else { "" },
            if options.awake { ", CPUs kept awake" } else { "" }
        )],
        ..Summary::default()
    };
    if options.schedulings().contains(&Scheduling::Fifo) && !system::has_fifo() {
        if options.scheduling.is_some() {
            return Err("--scheduling fifo needs root or CAP_SYS_NICE".to_owned());
        }
        summary.skipped.push("scheduling fifo: needs root or CAP_SYS_NICE".to_owned());
        options.scheduling = Some(Scheduling::Other);
    }
    let first = options.first_scheduling().label();
    summary.parameters.push(format!("throughput, resources, scale and large with scheduling {first}"));
    let mut output = Output::new(summary);
    if let Some(duration) = options.soak {
        soak::measure(duration, &options, &mut output)?;
    } else {
        output.summary.skipped.extend(options.skipped());
        latency::measure(&options, &mut output)?;
        resources::measure(&options, &mut output)?;
        scale::measure(&options, &mut output)?;
        isolation::measure(&options, &mut output)?;
        large::measure(&options, &mut output)?;
    }
    let stolen_percent = cpu_time().stolen_percent_since(began);
    let line =
        format!("steal: the hypervisor gave {stolen_percent:.0} % of the CPUs' time to other machines");
    output.summary.parameters.push(line);
    let failures = hop::soak_failures(&output.summary);
    let folder = output.finish(&options)?;
    println!("raw data: {}", folder.display());
    if failures.is_empty() { Ok(()) } else { Err(failures.join("; ")) }
}

/// Fills docs/performance-runs.md and docs/performance.md with the figures of saved runs.
fn fill_page(runs: &[PathBuf]) -> Result<(), String> {
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs");
    let page = docs.join("performance-runs.md");
    let with_path = |path: &Path| {
        let path = path.display().to_string();
        move |error: &dyn std::fmt::Display| format!("{path}: {error}")
    };
    let text = fs::read_to_string(&page).map_err(|error| with_path(&page)(&error))?;
    let saved = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/runs");
    let mut runs = runs.to_vec();
    if runs.is_empty() {
        runs.extend(hop::runs_named(&text).iter().map(|name| saved.join(name)));
    }
    let mut summaries = Vec::new();
    for run in &runs {
        let no_name = || format!("--page {}: name the folder of a run", run.display());
        let name = run.file_name().ok_or_else(no_name)?.to_string_lossy().into_owned();
        let path = run.join("summary.json");
        let text = fs::read_to_string(&path).map_err(|error| with_path(&path)(&error))?;
        let summary: Summary = serde_json::from_str(&text).map_err(|error| with_path(&path)(&error))?;
        summaries.push((name, summary));
    }
    for page in [page, docs.join("performance.md")] {
        let text = fs::read_to_string(&page).map_err(|error| with_path(&page)(&error))?;
        let filled = hop::fill(&text, &summaries)?;
        fs::write(&page, filled).map_err(|error| with_path(&page)(&error))?;
        println!("filled {} with the figures of {} runs", page.display(), summaries.len());
    }
    Ok(())
}
