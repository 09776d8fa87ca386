//! The command line of the bench and the cases that it selects.

use std::path::PathBuf;
use std::time::Duration;

use adaptive_bridge_measure::hop::payload;
use clap::Parser;
use clap::builder::ArgPredicate;

use super::system::{Placement, Scheduling};

/// One load: samples of one size at one rate, spread over one or more routes.
#[derive(Clone, Copy, Debug)]
pub struct Case {
    pub rate_hz: u64,
    pub bytes: usize,
    pub samples: usize,
    /// Sample k goes to route `first_route + k % routes`.
    pub first_route: usize,
    pub routes: usize,
}

impl Case {
    /// Samples on one route for `seconds`.
    pub fn lasting(rate_hz: u64, bytes: usize, seconds: f64, route: usize) -> Self {
        let samples = ((rate_hz as f64 * seconds).round() as usize).max(1);
        Self { rate_hz, bytes, samples, first_route: route, routes: 1 }
    }

    /// The name in reports, such as `1 kHz of 2,948 B`.
    pub fn name(&self) -> String {
        let rate = if self.rate_hz >= 1_000 && self.rate_hz.is_multiple_of(1_000) {
            format!("{} kHz", self.rate_hz / 1_000)
        } else {
            format!("{} Hz", self.rate_hz)
        };
        format!("{rate} of {}", payload(self.bytes))
    }
}

pub const RATES_HZ: [u64; 5] = [10, 30, 100, 1_000, 5_000];
pub const PAYLOADS: [usize; 5] = [64, 2_948, 64 << 10, 1 << 20, 4 << 20];

/// The largest sample of each route of the sweep, one route for each payload; 2 MB fits the fourth one, too.
pub const SWEEP_ROUTES: [usize; 5] = [4096, 4096, 64 << 10, 2 << 20, 4 << 20];

/// The size of the laser scan that most sections use.
pub const SCAN: usize = 2_948;

/// Repetitions of cases with a target. With 20, the median lies with 95 % confidence between the sixth lowest
/// and the sixth highest value. Repetitions differ because the machine is slower in some minutes, so many
/// short ones give a narrower interval than a few long ones.
const TARGET_REPETITIONS: usize = 20;

/// Repetitions in the section `large`, with three libraries in 20 minutes. With 12, the interval is from the
/// third lowest to the third highest value, with six from the lowest to the highest.
const LARGE_TARGET_REPETITIONS: usize = 12;
const LARGE_REPETITIONS: usize = 6;

/// The highest data rate of the sweep. Of the skipped cases, 4,194 MB/s and more, even direct cannot receive
/// all: its limits were 1,235 MB/s with 64 KiB, 2,852 with 1 MiB and 4,161 with 4 MiB.
const MAX_BYTES_PER_S: u64 = 1_100_000_000;

/// The command line.
#[derive(Clone, Debug, Parser)]
#[command(bin_name = "cargo bench --", about = "Measures the latency and the CPU time that the bridge adds")]
pub struct Options {
    /// Measure a few cases of each section, in less than three minutes
    #[arg(long)]
    pub quick: bool,
    /// Save the result in `benches/runs/<date>` too
    #[arg(long)]
    pub save: bool,
    /// Repetitions of each case; at least 20 for cases with a target
    #[arg(long, value_name = "N", value_parser = count, default_value = "3")]
    #[arg(default_value_if("quick", ArgPredicate::IsPresent, "1"))]
    pub repetitions: usize,
    /// Multiply every duration
    #[arg(long, value_name = "FACTOR", value_parser = factor, default_value = "1")]
    pub longer: f64,
    /// How the programs are placed on CPUs
    #[arg(long, value_enum, default_value_t = Placement::Alternating)]
    pub placement: Placement,
    /// Keep idle CPUs from sleeping
    #[arg(long)]
    pub awake: bool,
    /// Measure only with this scheduling
    #[arg(long, value_enum)]
    pub scheduling: Option<Scheduling>,
    /// Measure only cases whose name, `SECTION CASE`, contains one of the texts
    #[arg(long, value_name = "TEXT")]
    pub only: Vec<String>,
    /// Measure only memory over time
    #[arg(long, value_name = "DURATION", value_parser = humantime::parse_duration)]
    pub soak: Option<Duration>,
    /// Measure nothing; fill docs/performance-runs.md and performance.md with the figures of the runs, by
    /// default of those that the first already names
    #[arg(long, value_name = "RUN", num_args = 0..)]
    pub page: Option<Vec<PathBuf>>,
    /// Measure another build of the bridge
    #[arg(long, value_name = "FILE", default_value = env!("CARGO_BIN_EXE_adaptive-bridge"))]
    pub bridge: PathBuf,
    /// Added by cargo.
    #[arg(long = "bench", hide = true)]
    _bench: bool,
}

impl Options {
    /// Whether `--only` selects a case of a section; `case` may be empty.
    pub fn wants(&self, section: &str, case: &str) -> bool {
        let name = format!("{section} {case}");
        self.only.is_empty() || self.only.iter().any(|text| name.contains(text.as_str()))
    }

    /// The schedulings to measure with.
    pub fn schedulings(&self) -> Vec<Scheduling> {
        match self.scheduling {
            Some(scheduling) => vec![scheduling],
            None if self.quick => vec![Scheduling::Other],
            None => vec![Scheduling::Other, Scheduling::Fifo],
        }
    }

    /// The scheduling of sections that are measured with only one.
    pub fn first_scheduling(&self) -> Scheduling {
        self.schedulings()[0]
    }

    /// The repetitions of cases with a target for hop or CPU.
    pub fn target_repetitions(&self) -> usize {
        if self.quick { self.repetitions } else { self.repetitions.max(TARGET_REPETITIONS) }
    }

    /// The repetitions of a size of the section `large`, whose cells have an interval from six on.
    pub fn large_repetitions(&self, has_target: bool) -> usize {
        let least = if has_target { LARGE_TARGET_REPETITIONS } else { LARGE_REPETITIONS };
        if self.quick { self.repetitions } else { self.repetitions.max(least) }
    }

    /// Scales a duration by `--longer`, and to a fifth in a quick run.
    pub fn seconds(&self, seconds: f64) -> f64 {
        seconds * self.longer * if self.quick { 0.2 } else { 1.0 }
    }

    /// The selected cases of the sweep over rates and payloads.
    pub fn sweep(&self) -> Vec<Case> {
        let headline = [(1_000, SCAN), (100, SCAN), (10, 1 << 20)];
        let mut cases = Vec::new();
        for (route, bytes) in PAYLOADS.into_iter().enumerate() {
            for rate_hz in RATES_HZ {
                let is_headline = headline.contains(&(rate_hz, bytes));
                if exceeds_limit(rate_hz, bytes) || (self.quick && !is_headline) {
                    continue;
                }
                // Long enough for at least 20 samples.
                let seconds = self.seconds(1.4).max(20.0 / rate_hz as f64);
                let case = Case::lasting(rate_hz, bytes, seconds, route);
                if self.wants("latency", &case.name()) {
                    cases.push(case);
                }
            }
        }
        cases
    }

    /// A line for each case that is not measured.
    pub fn skipped(&self) -> Vec<String> {
        let all = PAYLOADS.into_iter().flat_map(|bytes| RATES_HZ.map(|rate_hz| (rate_hz, bytes)));
        let mut lines: Vec<String> = all
            .filter(|(rate_hz, bytes)| exceeds_limit(*rate_hz, *bytes))
            .map(|(rate_hz, bytes)| {
                let name = Case::lasting(rate_hz, bytes, 1.0, 0).name();
                let rate = rate_hz as f64 * bytes as f64 / 1e6;
                format!("latency {name}: {rate:.0} MB/s, more than {} MB/s", MAX_BYTES_PER_S / 1_000_000)
            })
            .collect();
        if self.quick {
            lines.push("with --quick: most of the sweep, and scheduling fifo".to_owned());
        }
        if !self.only.is_empty() {
            lines.push(format!("everything except --only {}", self.only.join(", ")));
        }
        lines
    }

    /// The long runs in which no sample may be lost.
    pub fn loss_checks(&self) -> Vec<Case> {
        let all = [
            Case::lasting(5_000, SCAN, self.seconds(10.0), 1),
            Case::lasting(60, 2_000_000, self.seconds(10.0), 3),
        ];
        all.into_iter().filter(|case| self.wants("loss", &case.name())).collect()
    }
}

fn exceeds_limit(rate_hz: u64, bytes: usize) -> bool {
    rate_hz * bytes as u64 > MAX_BYTES_PER_S
}

fn count(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|count| *count > 0).ok_or_else(|| "must be a whole number above 0".to_owned())
}

fn factor(text: &str) -> Result<f64, String> {
    let factor = text.parse().ok().filter(|factor: &f64| factor.is_finite() && *factor > 0.0);
    factor.ok_or_else(|| "must be a number above 0".to_owned())
}
