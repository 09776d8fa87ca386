//! The tables, and the raw data.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use adaptive_bridge::model::LatencyHistogram;
use serde_json::{Value, json};

use super::children::{Kind, Run};
use super::statistics::{median, quantile};
use super::system::Machine;
use super::{Case, Options};

const NS_PER_US: f64 = 1_000.0;

/// One repetition of one program in one case: what it is called, to its value in µs.
type Row = BTreeMap<&'static str, f64>;

pub struct Results {
    machine: Machine,
    date: String,
    parameters: String,
    cases: Vec<Case>,
    /// (case, program, repetition) to its figures.
    rows: BTreeMap<(usize, &'static str, usize), Row>,
    losses: Vec<Value>,
    loss_lines: Vec<String>,
    copies: BTreeMap<usize, (u64, u64)>,
    samples_csv: String,
}

impl Results {
    pub fn new(options: &Options, machine: Machine, began: SystemTime) -> Self {
        Self {
            machine,
            date: date(began),
            parameters: format!(
                "placement {}, scheduling {}, {} repetitions",
                options.placement.label(),
                options.scheduling.label(),
                options.repetitions
            ),
            cases: options.cases(),
            rows: BTreeMap::new(),
            losses: Vec::new(),
            loss_lines: Vec::new(),
            copies: BTreeMap::new(),
            samples_csv: "case,program,repetition,number,late_us,latency_us,dds_in_us,dds_out_us\n"
                .to_owned(),
        }
    }

    fn index(&self, case: &Case) -> usize {
        self.cases.iter().position(|known| known.name == case.name).unwrap_or(0)
    }

    pub fn wakeup(&mut self, case: &Case, repetition: usize, latencies_ns: Vec<u64>) {
        let us: Vec<f64> = latencies_ns.iter().map(|&ns| ns as f64 / NS_PER_US).collect();
        let row = Row::from([("p50", quantile(&us, 0.5)), ("p99", quantile(&us, 0.99))]);
        self.rows.insert((self.index(case), "wake-up", repetition), row);
    }

    pub fn run(&mut self, case: &Case, repetition: usize, run: &Run) {
        let index = self.index(case);
        let us = |from: u64, to: u64| {
            if from == 0 || to == 0 { f64::NAN } else { (to as f64 - from as f64) / NS_PER_US }
        };
        let (mut latency, mut from_due, mut late) = (Vec::new(), Vec::new(), Vec::new());
        let (mut dds_in, mut dds_out) = (Vec::new(), Vec::new());
        for record in &run.records {
            latency.push(us(record.written_at, record.arrived_at));
            from_due.push(us(record.due_at, record.arrived_at));
            late.push(us(record.due_at, record.written_at));
            dds_in.push(us(record.written_at, record.taken_at));
            dds_out.push(us(record.handed_at, record.arrived_at));
            let _ = writeln!(
                self.samples_csv,
                "{},{},{repetition},{},{:.1},{:.1},{:.1},{:.1}",
                case.name.replace(',', ""),
                run.kind.label(),
                record.number,
                us(record.due_at, record.written_at),
                us(record.written_at, record.arrived_at),
                us(record.written_at, record.taken_at),
                us(record.handed_at, record.arrived_at),
            );
        }
        let mut row = Row::from([
            ("p50", quantile(&latency, 0.5)),
            ("p90", quantile(&latency, 0.9)),
            ("p99", quantile(&latency, 0.99)),
            ("max", quantile(&latency, 1.0)),
            ("from_due_p50", quantile(&from_due, 0.5)),
            ("from_due_p99", quantile(&from_due, 0.99)),
            ("late_p50", quantile(&late, 0.5)),
            ("late_p99", quantile(&late, 0.99)),
            ("missing", run.accepted as f64 - run.records.len() as f64),
            ("cpu", run.cpu_ns as f64 / NS_PER_US / run.accepted.max(1) as f64),
        ]);
        if let Some(bridge) = &run.bridge {
            let copies = self.copies.entry(index).or_default();
            copies.0 += bridge.forwarded;
            copies.1 += bridge.by_reference;
            row.insert("dds_in_p50", quantile(&dds_in, 0.5));
            row.insert("dds_in_p99", quantile(&dds_in, 0.99));
            row.insert("shm_p50", histogram_us(&bridge.shm, 0.5));
            row.insert("shm_p99", histogram_us(&bridge.shm, 0.99));
            row.insert("hand_over_p50", histogram_us(&bridge.hand_over, 0.5));
            row.insert("hand_over_p99", histogram_us(&bridge.hand_over, 0.99));
            row.insert("dds_out_p50", quantile(&dds_out, 0.5));
            row.insert("dds_out_p99", quantile(&dds_out, 0.99));
        }
        self.rows.insert((index, run.kind.label(), repetition), row);
    }

    pub fn loss(&mut self, case: &Case, run: &Run) {
        let mut numbers: Vec<u64> = run.records.iter().map(|record| record.number).collect();
        let disordered = numbers.windows(2).filter(|pair| pair[1] <= pair[0]).count();
        numbers.sort_unstable();
        numbers.dedup();
        let lost = run.accepted.saturating_sub(numbers.len() as u64);
        let mut drops: Vec<(String, u64)> =
            run.bridge.as_ref().map(|bridge| bridge.drops.clone()).unwrap_or_default();
        if run.relay_refused > 0 {
            drops.push(("relay window_full".to_owned(), run.relay_refused));
        }
        if let Some(bridge) = run.bridge.as_ref().filter(|bridge| bridge.lost_upstream > 0) {
            drops.push(("ingress lost_upstream".to_owned(), bridge.lost_upstream));
        }
        let named: Vec<String> = drops.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let mut line = format!(
            "{:<18} {:<7} {:>7} {:>7} {:>8} {:>5} {:>10} {:>8}  {}",
            case.name,
            run.kind.label(),
            run.accepted,
            run.refused,
            numbers.len(),
            lost,
            disordered,
            run.damaged,
            if named.is_empty() { "none".to_owned() } else { named.join(", ") }
        );
        if let Some(bridge) = &run.bridge {
            let _ = write!(
                line,
                "; ingress {}, critical lane {} ({} by reference), account {}",
                bridge.received,
                bridge.forwarded,
                bridge.by_reference,
                if bridge.whole { "whole" } else { "NOT WHOLE" }
            );
        }
        self.loss_lines.push(line);
        self.losses.push(json!({
            "case": case.name, "program": run.kind.label(), "accepted": run.accepted, "refused": run.refused,
            "received": numbers.len(), "lost": lost, "disordered": disordered, "damaged": run.damaged,
            "drops": drops.iter().map(|(name, count)| json!({"name": name, "count": count})).collect::<Vec<_>>(),
        }));
    }

    /// The figure in each repetition.
    fn each(&self, case: usize, program: &'static str, figure: &'static str) -> Vec<f64> {
        let of = |((of_case, of_program, _), row): (&(usize, &'static str, usize), &Row)| {
            (*of_case == case && *of_program == program).then(|| row.get(figure).copied().unwrap_or(f64::NAN))
        };
        self.rows.iter().filter_map(of).collect()
    }

    /// The median of the repetitions.
    fn middle(&self, case: usize, program: &'static str, figure: &'static str) -> f64 {
        median(&self.each(case, program, figure))
    }

    /// The median, over the repetitions, of how much longer the program took than direct in the same one.
    fn hop(&self, case: usize, program: &'static str, figure: &'static str) -> f64 {
        let direct = self.each(case, "direct", figure);
        let with = self.each(case, program, figure);
        let hops: Vec<f64> = with.iter().zip(&direct).map(|(with, without)| with - without).collect();
        median(&hops)
    }

    pub fn print(&self) {
        print!("{}", self.tables());
    }

    fn tables(&self) -> String {
        let mut text = String::new();
        let machine = &self.machine;
        let _ = writeln!(
            text,
            "{}, {} CPUs, Linux {}; commit {}; {}\n{}; load average before: {}",
            machine.cpu,
            machine.cpus,
            machine.kernel,
            machine.commit,
            machine.command,
            self.parameters,
            machine.load_average
        );
        for (index, case) in self.cases.iter().enumerate() {
            let _ = writeln!(
                text,
                "\n{} ({} samples a repetition; medians of the repetitions, µs)\n\
                 {:<9} {:>9} {:>9} {:>9} {:>9} {:>13} {:>10} {:>8}",
                case.name,
                case.samples,
                "",
                "p50",
                "p99",
                "hop p50",
                "hop p99",
                "from due p99",
                "CPU/sample",
                "missing"
            );
            let _ = writeln!(
                text,
                "{:<9} {:>9.1} {:>9.1}",
                "wake-up",
                self.middle(index, "wake-up", "p50"),
                self.middle(index, "wake-up", "p99")
            );
            for kind in Kind::ALL {
                let name = kind.label();
                let hop = |figure| match kind {
                    Kind::Direct => String::new(),
                    _ => format!("{:.1}", self.hop(index, name, figure)),
                };
                let cpu = match kind {
                    Kind::Direct => String::new(),
                    _ => format!("{:.1}", self.middle(index, name, "cpu")),
                };
                let _ = writeln!(
                    text,
                    "{name:<9} {:>9.1} {:>9.1} {:>9} {:>9} {:>13.1} {cpu:>10} {:>8}",
                    self.middle(index, name, "p50"),
                    self.middle(index, name, "p99"),
                    hop("p50"),
                    hop("p99"),
                    self.middle(index, name, "from_due_p99"),
                    self.each(index, name, "missing").iter().sum::<f64>()
                );
            }
            let stage = |figure| self.middle(index, "bridge", figure);
            let _ = writeln!(
                text,
                "stages of the bridge, p50/p99: DDS in {:.1}/{:.1}, shared memory {:.1}/{:.1}, hand-over to DDS \
                 {:.1}/{:.1}, DDS out {:.1}/{:.1}",
                stage("dds_in_p50"),
                stage("dds_in_p99"),
                stage("shm_p50"),
                stage("shm_p99"),
                stage("hand_over_p50"),
                stage("hand_over_p99"),
                stage("dds_out_p50"),
                stage("dds_out_p99"),
            );
            let _ = writeln!(
                text,
                "hop of the bridge / hop of the relay: {:.2} (at most 1.10); CPU of the bridge / CPU of the \
                 relay: {:.2}; shared memory / wake-up: {:.2} (at most 1.60); copies of a payload: {:.2}",
                self.hop(index, "bridge", "p50") / self.hop(index, "relay", "p50"),
                stage("cpu") / self.middle(index, "relay", "cpu"),
                stage("shm_p50") / self.middle(index, "wake-up", "p50"),
                self.copies_of(index)
            );
        }
        if !self.loss_lines.is_empty() {
            let _ = writeln!(
                text,
                "\n{:<18} {:<7} {:>7} {:>7} {:>8} {:>5} {:>10} {:>8}  drops by name",
                "loss", "", "sent", "refused", "received", "lost", "disordered", "damaged"
            );
            for line in &self.loss_lines {
                let _ = writeln!(text, "{line}");
            }
        }
        text
    }

    /// Copies of a payload in user space from the receive buffer to the DDS writer: one into shared memory,
    /// and another where the lane did not hand it on by reference.
    fn copies_of(&self, case: usize) -> f64 {
        let (forwarded, by_reference) = self.copies.get(&case).copied().unwrap_or_default();
        2.0 - by_reference as f64 / forwarded.max(1) as f64
    }

    fn summary(&self) -> Value {
        let cases: Vec<Value> = self
            .cases
            .iter()
            .enumerate()
            .map(|(index, case)| {
                let figures = |program: &'static str| -> Value {
                    let mut names: Vec<&'static str> = self
                        .rows
                        .iter()
                        .filter(|((of_case, of_program, _), _)| *of_case == index && *of_program == program)
                        .flat_map(|(_, row)| row.keys().copied())
                        .collect();
                    names.sort_unstable();
                    names.dedup();
                    names
                        .into_iter()
                        .map(|name| (format!("{name}_us"), json!(self.middle(index, program, name))))
                        .collect::<serde_json::Map<_, _>>()
                        .into()
                };
                json!({
                    "case": case.name, "rate_hz": case.rate_hz, "bytes": case.bytes, "samples": case.samples,
                    "wake-up": figures("wake-up"), "direct": figures("direct"), "relay": figures("relay"),
                    "bridge": figures("bridge"),
                    "relay_hop_p50_us": self.hop(index, "relay", "p50"),
                    "bridge_hop_p50_us": self.hop(index, "bridge", "p50"),
                    "copies": self.copies_of(index),
                })
            })
            .collect();
        json!({
            "date": self.date, "machine": self.machine, "parameters": self.parameters,
            "cases": cases, "loss": self.losses,
        })
    }

    /// One line for each repetition and figure.
    fn raw_csv(&self) -> String {
        let mut text = "case,program,repetition,figure,us\n".to_owned();
        for ((case, program, repetition), row) in &self.rows {
            let case = self.cases[*case].name.replace(',', "");
            for (figure, value) in row {
                let _ = writeln!(text, "{case},{program},{repetition},{figure},{value:.2}");
            }
        }
        text
    }

    pub fn write(&self, options: &Options) -> Result<PathBuf, String> {
        let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
        let target =
            std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| manifest.join("target"), PathBuf::from);
        let folder = target.join("bench").join(&self.date);
        self.write_to(&folder)?;
        write(&folder.join("samples.csv"), &self.samples_csv)?;
        if options.save {
            self.write_to(&manifest.join("benches").join("runs").join(&self.date))?;
        }
        Ok(folder)
    }

    fn write_to(&self, folder: &Path) -> Result<(), String> {
        fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let summary = serde_json::to_string_pretty(&self.summary()).map_err(|error| error.to_string())?;
        write(&folder.join("summary.json"), &(summary + "\n"))?;
        write(&folder.join("raw.csv"), &self.raw_csv())?;
        let readme = format!("# Bench run of {}\n\n```\n{}```\n", self.date, self.tables());
        write(&folder.join("README.md"), &readme)
    }
}

fn write(path: &Path, text: &str) -> Result<(), String> {
    fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()))
}

/// A quantile in µs, interpolated within its bucket, whose width is 1/16 of its value.
fn histogram_us(histogram: &LatencyHistogram, quantile: f64) -> f64 {
    let total = histogram.count();
    let rank = quantile * total as f64;
    let (mut seen, mut lower_ns) = (0.0, 0.0);
    for (upper_ns, count) in histogram.buckets() {
        let count = count as f64;
        if count > 0.0 && seen + count >= rank {
            let share = ((rank - seen) / count).clamp(0.0, 1.0);
            return (lower_ns + (upper_ns as f64 - lower_ns) * share) / NS_PER_US;
        }
        seen += count;
        lower_ns = upper_ns as f64;
    }
    f64::NAN
}

/// `2025-11-20T14-05-00Z`, by the system's `date`, so that no calendar has to be written here.
fn date(instant: SystemTime) -> String {
    let seconds = instant.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    Command::new("date")
        .args(["-u", "-d", &format!("@{seconds}"), "+%Y-%m-%dT%H-%M-%SZ"])
        .output()
        .ok()
        .filter(|output| output.status.success())
        .map_or_else(
            || seconds.to_string(),
            |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
        )
}
