//! The command line, and what is measured by it.

use std::path::PathBuf;
use std::time::Duration;

use super::report::payload;
use super::system::{Placement, Scheduling};

/// Samples of a size at a rate, spread over some routes.
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
    /// On one route, for so long.
    pub fn lasting(rate_hz: u64, bytes: usize, seconds: f64, route: usize) -> Self {
        let samples = ((rate_hz as f64 * seconds).round() as usize).max(1);
        Self { rate_hz, bytes, samples, first_route: route, routes: 1 }
    }

    /// `1 kHz of 2,948 B`.
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

/// The largest samples of the sweep's routes, one for each payload; 2 MB fits the fourth one, too.
pub const SWEEP_ROUTES: [usize; 5] = [4096, 4096, 64 << 10, 2 << 20, 4 << 20];

/// The laser scan of most sections.
pub const SCAN: usize = 2_948;

/// Repetitions of the cases that hops are judged by: so many tell with a certainty of 95 % between which two
/// of them, the sixth lowest and the sixth highest, their median is. What repetitions differ by are minutes
/// in which the machine is slower, so many short ones tell more than a few long ones.
const JUDGED_REPETITIONS: usize = 20;

/// No case of the sweep sends more. Of what it leaves out, 4,194 MB/s and more, not even a subscriber with
/// nothing in between takes all: 1,235 MB/s of 64 KiB, 2,852 of 1 MiB, 4,161 of 4 MiB at most.
const MOST_BYTES_PER_S: u64 = 1_100_000_000;

/// The command line.
#[derive(Clone, Debug)]
pub struct Options {
    /// `--quick`: little of everything, in less than three minutes.
    pub quick: bool,
    /// `--save`: keep the result in `benches/runs/<date>` too.
    pub save: bool,
    /// `--repetitions N`, 3 unless told; what hops and CPU are judged by has 20 at least.
    pub repetitions: usize,
    /// `--longer FACTOR`: of every duration.
    pub longer: f64,
    /// `--placement alternating|split|free`.
    pub placement: Placement,
    /// `--awake`: idle CPUs do not sleep.
    pub awake: bool,
    /// `--scheduling other|fifo`: only one of them.
    pub scheduling: Option<Scheduling>,
    /// `--only TEXT`, again and again: only what has one of the texts in its name, `SECTION CASE`.
    pub only: Vec<String>,
    /// `--soak DURATION`: nothing but memory over time.
    pub soak: Option<Duration>,
    /// `--page RUN…`: no measurement; fills the figures of docs/performance.md, without RUN from the runs
    /// that it names already.
    pub page: Option<Vec<PathBuf>>,
    /// `--bridge FILE`: another build of the bridge than this one.
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
                // Cargo adds this one.
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
                other => return Err(format!("{other} is not an argument of this bench")),
            }
        }
        if options.repetitions == 0 {
            options.repetitions = if options.quick { 1 } else { 3 };
        }
        Ok(options)
    }

    /// Whether that of a section is to be measured; `case` may be empty.
    pub fn wants(&self, section: &str, case: &str) -> bool {
        let name = format!("{section} {case}");
        self.only.is_empty() || self.only.iter().any(|text| name.contains(text.as_str()))
    }

    pub fn schedulings(&self) -> Vec<Scheduling> {
        match self.scheduling {
            Some(scheduling) => vec![scheduling],
            None if self.quick => vec![Scheduling::Other],
            None => vec![Scheduling::Other, Scheduling::Fifo],
        }
    }

    /// What is not a matter of normal scheduling or FIFO is measured with the first of those.
    pub fn first_scheduling(&self) -> Scheduling {
        self.schedulings()[0]
    }

    /// Repetitions of the cases that hops and CPU are judged by.
    pub fn judged_repetitions(&self) -> usize {
        if self.quick { self.repetitions } else { self.repetitions.max(JUDGED_REPETITIONS) }
    }

    /// A duration of the default run, a fifth of it in a quick one.
    pub fn seconds(&self, seconds: f64) -> f64 {
        seconds * self.longer * if self.quick { 0.2 } else { 1.0 }
    }

    /// The sweep over rates and payloads.
    pub fn sweep(&self) -> Vec<Case> {
        let headline = [(1_000, SCAN), (100, SCAN), (10, 1 << 20)];
        let mut cases = Vec::new();
        for (route, bytes) in PAYLOADS.into_iter().enumerate() {
            for rate_hz in RATES_HZ {
                let is_headline = headline.contains(&(rate_hz, bytes));
                if too_much(rate_hz, bytes) || (self.quick && !is_headline) {
                    continue;
                }
                // 20 samples are the least.
                let seconds = self.seconds(1.4).max(20.0 / rate_hz as f64);
                let case = Case::lasting(rate_hz, bytes, seconds, route);
                if self.wants("latency", &case.name()) {
                    cases.push(case);
                }
            }
        }
        cases
    }

    /// What the sweep leaves out.
    pub fn left_out(&self) -> Vec<String> {
        let all = PAYLOADS.into_iter().flat_map(|bytes| RATES_HZ.map(|rate_hz| (rate_hz, bytes)));
        let mut lines: Vec<String> = all
            .filter(|(rate_hz, bytes)| too_much(*rate_hz, *bytes))
            .map(|(rate_hz, bytes)| {
                let name = Case::lasting(rate_hz, bytes, 1.0, 0).name();
                let rate = rate_hz as f64 * bytes as f64 / 1e6;
                format!("latency {name}: {rate:.0} MB/s, more than {} MB/s", MOST_BYTES_PER_S / 1_000_000)
            })
            .collect();
        if self.quick {
            lines.push("what --quick leaves out: most of the sweep, all but one scheduling".to_owned());
        }
        if !self.only.is_empty() {
            lines.push(format!("all but --only {}", self.only.join(", ")));
        }
        lines
    }

    /// Long runs that must lose nothing.
    pub fn loss_checks(&self) -> Vec<Case> {
        let all = [
            Case::lasting(5_000, SCAN, self.seconds(10.0), 1),
            Case::lasting(60, 2_000_000, self.seconds(10.0), 3),
        ];
        all.into_iter().filter(|case| self.wants("loss", &case.name())).collect()
    }
}

fn too_much(rate_hz: u64, bytes: usize) -> bool {
    rate_hz * bytes as u64 > MOST_BYTES_PER_S
}

fn number(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("{text} is no number"))?;
    if number > 0.0 { Ok(number) } else { Err(format!("{text} is not above 0")) }
}
