//! Section `resources`: CPU time, wake-ups, memory and system calls of each process, idle and under load.

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use adaptive_bridge_measure::hop::{Call, Resource, TARGET_HZ};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::beds::{Bed, Beds, Kind, Plan};
use super::options::{Case, Options, SCAN};
use super::out::{Output, RowKey};
use super::system::Usage;

/// The rates of the loads.
const LOADS_HZ: [u64; 2] = [100, TARGET_HZ];

/// The rate of the load under strace. strace makes each system call several times as slow; at higher rates
/// that would change the number of calls.
const TRACED_HZ: u64 = 100;

pub fn measure(options: &Options, output: &mut Output) -> Result<(), String> {
    if !options.wants("resources", "") {
        return Ok(());
    }
    let scheduling = options.first_scheduling();
    let plans = [
        Plan::new(Kind::Direct, scheduling, &[4096]),
        Plan::new(Kind::Relay, scheduling, &[4096]),
        Plan::whole(scheduling, &[4096]),
    ];
    let mut beds = Beds::start(&plans, options)?;
    eprintln!("resources: idle");
    idle(&beds, options.seconds(10.0), output);
    for rate_hz in LOADS_HZ {
        // As for hops, many short repetitions where a target applies.
        let (repetitions, seconds) = if rate_hz == TARGET_HZ {
            (options.target_repetitions(), 2.0)
        } else {
            (options.repetitions, 5.0)
        };
        let case = Case::lasting(rate_hz, SCAN, options.seconds(seconds), 0);
        for repetition in 0..repetitions {
            eprintln!("resources {} of {repetitions}: {}", repetition + 1, case.name());
            let count = beds.0.len();
            for bed in (0..count).map(|turn| (turn + repetition) % count) {
                load(&mut beds.0[bed], &case, repetition, output)?;
            }
        }
        let case = Case::lasting(rate_hz, SCAN, options.seconds(5.0), 0);
        for bed in &mut beds.0 {
            count_calls(bed, &case, output)?;
        }
    }
    merge(&mut output.summary.resources);
    let case = Case::lasting(TRACED_HZ, SCAN, options.seconds(5.0), 0);
    for bed in &mut beds.0 {
        eprintln!("system calls: {} {}", case.name(), bed.name());
        trace(bed, &case, output)?;
    }
    Ok(())
}

/// Measures all processes of all beds at the same time, without load.
fn idle(beds: &Beds, seconds: f64, output: &mut Output) {
    let all: Vec<(&'static str, String, u32, Usage)> = beds
        .0
        .iter()
        .flat_map(|bed| {
            bed.processes().into_iter().map(|(name, pid)| (bed.name(), name, pid, Usage::of(pid)))
        })
        .collect();
    let began = Instant::now();
    std::thread::sleep(Duration::from_secs_f64(seconds));
    let seconds = began.elapsed().as_secs_f64();
    for (program, process, pid, before) in all {
        let row = row((program, &process), 0, seconds, 0, before, Usage::of(pid));
        output.summary.resources.push(row);
    }
}

/// Measures the processes of one bed under load.
fn load(bed: &mut Bed, case: &Case, repetition: usize, output: &mut Output) -> Result<(), String> {
    let before: Vec<(String, u32, Usage)> =
        bed.processes().into_iter().map(|(name, pid)| (name, pid, Usage::of(pid))).collect();
    let began = Instant::now();
    let run = bed.measure(case)?;
    let seconds = began.elapsed().as_secs_f64();
    let name = case.name();
    for (process, pid, before) in before {
        let row = row((bed.name(), &process), case.rate_hz, seconds, run.accepted, before, Usage::of(pid));
        let program = format!("{} {process}", bed.name());
        let key = RowKey { section: "resources", scheduling: "", case: &name, program: &program, repetition };
        output.raw(key, "cpu ms", row.cpu_ms);
        output.raw(key, "sleeps", row.sleeps as f64);
        output.raw(key, "preemptions", row.preemptions as f64);
        output.raw(key, "rss KiB", row.rss_kib as f64);
        output.raw(key, "samples", row.samples as f64);
        output.raw(key, "seconds", row.seconds);
        output.summary.resources.push(row);
    }
    Ok(())
}

fn row(
    (program, process): (&str, &str),
    rate_hz: u64,
    seconds: f64,
    samples: u64,
    before: Usage,
    after: Usage,
) -> Resource {
    let cpu_ms = after.cpu_ns.saturating_sub(before.cpu_ns) as f64 / 1e6;
    Resource {
        program: program.to_owned(),
        process: process.to_owned(),
        rate_hz,
        seconds,
        samples,
        cpu_ms,
        repetitions_cpu_us: (samples > 0).then(|| cpu_ms * 1_000.0 / samples as f64).into_iter().collect(),
        sleeps: after.sleeps.saturating_sub(before.sleeps),
        preemptions: after.preemptions.saturating_sub(before.preemptions),
        system_calls_per_sample: None,
        rss_kib: after.rss_kib,
        anonymous_kib: after.anonymous_kib,
        shared_kib: after.shared_kib,
        file_kib: after.file_kib,
    }
}

/// Merges the repetitions of each process and rate: sums their counts, and keeps the memory of the last one.
fn merge(rows: &mut Vec<Resource>) {
    let mut merged: Vec<Resource> = Vec::new();
    for row in rows.drain(..) {
        let same = |one: &&mut Resource| {
            (&one.program, &one.process, one.rate_hz) == (&row.program, &row.process, row.rate_hz)
        };
        match merged.iter_mut().find(same) {
            Some(one) => {
                let mut repetitions_cpu_us = std::mem::take(&mut one.repetitions_cpu_us);
                repetitions_cpu_us.extend(&row.repetitions_cpu_us);
                *one = Resource {
                    repetitions_cpu_us,
                    seconds: one.seconds + row.seconds,
                    samples: one.samples + row.samples,
                    cpu_ms: one.cpu_ms + row.cpu_ms,
                    sleeps: one.sleeps + row.sleeps,
                    preemptions: one.preemptions + row.preemptions,
                    ..row
                };
            }
            None => merged.push(row),
        }
    }
    *rows = merged;
}

/// A tool, perf or strace, that observes a process of the bed until it is stopped.
struct Tracer {
    child: Child,
    process: String,
    file: tempfile::NamedTempFile,
}

impl Tracer {
    /// Starts the tool; `-o FILE` and `-p PID` are added to its arguments.
    fn start(tool: &str, arguments: &[&str], process: &str, pid: u32) -> Result<Self, String> {
        let file = tempfile::NamedTempFile::new().map_err(|error| error.to_string())?;
        let mut command = Command::new(tool);
        command.args(arguments).arg("-o").arg(file.path()).arg("-p").arg(pid.to_string());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let child = command.spawn().map_err(|error| format!("{tool}: {error}"))?;
        Ok(Self { child, process: process.to_owned(), file })
    }

    /// Stops the tool; returns the name of the observed process and the text that the tool wrote.
    fn stop(mut self) -> (String, String) {
        let _ = kill(Pid::from_raw(self.child.id().cast_signed()), Signal::SIGINT);
        let _ = self.child.wait();
        let text = std::fs::read_to_string(self.file.path()).unwrap_or_default();
        (self.process, text)
    }
}

/// Runs a load while a tool observes each process between publisher and subscriber. Returns the text of the
/// tool for each process and the number of samples; fails when the tool cannot be started.
fn traced(
    bed: &mut Bed,
    case: &Case,
    tool: &str,
    arguments: &[&str],
) -> Result<(Vec<(String, String)>, u64), String> {
    let mut tracers = Vec::new();
    for (process, pid) in bed.middle.processes() {
        tracers.push(Tracer::start(tool, arguments, &process, pid)?);
    }
    // Time for the tool to attach to all threads.
    std::thread::sleep(Duration::from_millis(500));
    let run = bed.measure(case);
    let texts = tracers.into_iter().map(Tracer::stop).collect();
    Ok((texts, run?.accepted))
}

/// Counts system calls with perf, which hardly slows a process down.
fn count_calls(bed: &mut Bed, case: &Case, output: &mut Output) -> Result<(), String> {
    if bed.kind() == Kind::Direct {
        return Ok(());
    }
    let arguments = ["stat", "-x", ",", "-e", "raw_syscalls:sys_enter"];
    let (texts, samples) = match traced(bed, case, "perf", &arguments) {
        Ok(traced) => traced,
        Err(error) => {
            output.skip(format!("system calls by perf: {error}"));
            return Ok(());
        }
    };
    for (process, text) in texts {
        let count =
            text.lines().find(|line| line.contains("raw_syscalls")).and_then(|line| line.split(',').next());
        let Some(count) = count.and_then(|count| count.parse::<f64>().ok()) else {
            output
                .skip(format!("system calls by perf: {}", text.lines().last().unwrap_or("it wrote nothing")));
            continue;
        };
        let rows = output.summary.resources.iter_mut();
        let rows = rows
            .filter(|row| row.program == bed.name() && row.process == process && row.rate_hz == case.rate_hz);
        // Stored in the row of the last repetition, whose value `merge` keeps.
        if let Some(row) = rows.last() {
            row.system_calls_per_sample = Some(count / samples.max(1) as f64);
        }
    }
    Ok(())
}

/// Counts system calls by name with strace, and keeps its output as a file of the run.
fn trace(bed: &mut Bed, case: &Case, output: &mut Output) -> Result<(), String> {
    if bed.kind() == Kind::Direct {
        return Ok(());
    }
    let (texts, samples) = match traced(bed, case, "strace", &["-c", "-f", "-q"]) {
        Ok(traced) => traced,
        Err(error) => {
            output.skip(format!("system calls by strace: {error}"));
            return Ok(());
        }
    };
    for (process, text) in texts {
        if !text.contains("syscall") {
            output.skip(format!("system calls of {process}: strace counted nothing"));
        }
        for (call, count) in parse_strace(&text) {
            output.summary.calls.push(Call {
                program: bed.name().to_owned(),
                process: process.clone(),
                rate_hz: case.rate_hz,
                call,
                count,
                samples,
            });
        }
        output.file(&format!("strace-{}-{process}.txt", bed.name()), text);
    }
    Ok(())
}

/// The calls and counts in the table of `strace -c`: `% time, seconds, usecs/call, calls, [errors,] syscall`.
fn parse_strace(text: &str) -> Vec<(String, u64)> {
    let line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let call = *words.last()?;
        words.first()?.parse::<f64>().ok()?;
        let calls = words.get(3)?.parse().ok()?;
        (call != "total").then(|| (call.to_owned(), calls))
    };
    text.lines().filter_map(line).collect()
}
