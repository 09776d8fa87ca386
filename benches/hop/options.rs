//! The command line of the bench and the cases that it selects.

use std::path::PathBuf;
use std::time::Duration;

use super::report::payload;
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

/// The highest data rate of the sweep. Of the skipped cases, 4,194 MB/s and more, even direct cannot receive
/// all: its limits were 1,235 MB/s with 64 KiB, 2,852 with 1 MiB and 4,161 with 4 MiB.
const MAX_BYTES_PER_S: u64 = 1_100_000_000;

/// The command line.
#[derive(Clone, Debug)]
pub struct Options {
    /// `--quick`: a few cases of each section, in less than three minutes.
    pub quick: bool,
    /// `--save`: save the result in `benches/runs/<date>` too.
    pub save: bool,
    /// `--repetitions N`: 3 by default; at least 20 for cases with a target.
    pub repetitions: usize,
    /// `--longer FACTOR`: multiplies every duration.
    pub longer: f64,
    /// `--placement alternating|split|free`.
    pub placement: Placement,
    /// `--awake`: keep idle CPUs from sleeping.
    pub awake: bool,
    /// `--scheduling other|fifo`: measure only with this scheduling.
    pub scheduling: Option<Scheduling>,
    /// `--only TEXT`, repeatable: only cases whose name, `SECTION CASE`, contains one of the texts.
    pub only: Vec<String>,
    /// `--soak DURATION`: measure only memory over time.
    pub soak: Option<Duration>,
    /// `--page RUN…`: measure nothing; fill docs/performance.md with the figures of the runs, by default of
    /// those that it already names.
    pub page: Option<Vec<PathBuf>>,
    /// `--bridge FILE`: measure another build of the bridge.
    pub bridge: PathBuf,
}

impl Options {
    pub fn parse(arguments: &[String]) -> Result<Self, String> {
        let mut options = Self {
            quick: false,
            save: false,
            repetitions: 0,
            longer: 1.0,
            placement: Placement::Alternating,
            awake: false,
            scheduling: None,
            only: Vec::new(),
            soak: None,
            page: None,
            bridge: PathBuf::from(env!("CARGO_BIN_EXE_adaptive-bridge")),
        };
        let mut rest = arguments.iter();
        while let Some(argument) = rest.next() {
            let mut value = || rest.next().ok_or_else(|| format!("{argument} needs a value"));
            match argument.as_str() {
                // Added by cargo.
                "--bench" => {}
                "--quick" => options.quick = true,
                "--save" => options.save = true,
                "--awake" => options.awake = true,
                "--bridge" => options.bridge = PathBuf::from(value()?),
                "--only" => options.only.push(value()?.clone()),
                "--repetitions" => options.repetitions = number(value()?)? as usize,
                "--longer" => options.longer = number(value()?)?,
                "--placement" => options.placement = Placement::parse(value()?)?,
                "--scheduling" => options.scheduling = Some(Scheduling::parse(value()?)?),
                "--soak" => {
                    let text = value()?;
                    let duration = humantime::parse_duration(text);
                    options.soak = Some(duration.map_err(|error| format!("{text}: {error}"))?);
                }
                "--page" => {
                    let runs = rest.by_ref().filter(|argument| *argument != "--bench");
                    options.page = Some(runs.map(PathBuf::from).collect());
                }
                other => {
                    return Err(format!("unknown argument {other}; benches/README.md lists the arguments"));
                }
            }
        }
        if options.repetitions == 0 {
            options.repetitions = if options.quick { 1 } else { 3 };
        }
        Ok(options)
    }

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

fn number(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if number > 0.0 { Ok(number) } else { Err(format!("{text} must be greater than 0")) }
}
