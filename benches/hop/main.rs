//! How fast the bridge is, beside what it is measured against, all in one run.
//!
//! - **wake-up**: an eventfd between two threads on the two CPUs, the least that a hand-over between
//!   processes costs on this machine at this rate;
//! - **direct**: a publisher process to a subscriber process, with the bridge's own DDS library;
//! - **relay**: one process between them that reads and writes with that library, without shared memory;
//! - **bridge**: the shipped binary, ingress and the critical egress.
//!
//! All programs stay up for the whole run; only the publisher of one of them sends at a time, in the order
//! wake-up, direct, relay, bridge, again and again. Sending is open loop: sample k is due at `start + k /
//! rate` whatever became of the one before it, and both the latency from the moment of the write and the one
//! from the moment it was due are recorded.
//!
//! `cargo bench` takes about six minutes, `cargo bench -- --quick` one. Other arguments: [`Options`].

mod children;
mod link;
mod report;
mod statistics;
mod system;
mod wakeup;

use std::path::PathBuf;
use std::process::ExitCode;

use system::{Placement, Scheduling};

/// What is measured: a payload at a rate.
#[derive(Clone, Copy, Debug)]
pub struct Case {
    pub name: &'static str,
    pub route: link::Route,
    pub rate_hz: u64,
    pub bytes: usize,
    /// Samples of one repetition.
    pub samples: usize,
}

/// The command line.
#[derive(Clone, Debug)]
pub struct Options {
    /// `--quick`: shorter repetitions.
    pub quick: bool,
    /// `--save`: keep the result in `benches/runs/<date>` too.
    pub save: bool,
    /// `--repetitions N`, 5 unless told.
    pub repetitions: usize,
    /// `--placement alternating|split|free`.
    pub placement: Placement,
    /// `--scheduling other|fifo`.
    pub scheduling: Scheduling,
    /// `--only TEXT`: only the cases whose name contains the text.
    pub only: Option<String>,
    /// `--no-loss`: without the checks for loss.
    pub no_loss: bool,
    /// `--bridge FILE`: another build of the bridge than this one.
    pub bridge: PathBuf,
}

impl Options {
    fn parse(arguments: &[String]) -> Result<Self, String> {
        let mut options = Self {
            quick: false,
            save: false,
            repetitions: 5,
            placement: Placement::Alternating,
            scheduling: Scheduling::Other,
            only: None,
            no_loss: false,
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
                "--no-loss" => options.no_loss = true,
                "--bridge" => options.bridge = PathBuf::from(value()?),
                "--only" => options.only = Some(value()?.clone()),
                "--repetitions" => {
                    let text = value()?;
                    options.repetitions = text.parse().map_err(|_| format!("{text} is no number"))?;
                }
                "--placement" => options.placement = Placement::parse(value()?)?,
                "--scheduling" => options.scheduling = Scheduling::parse(value()?)?,
                other => return Err(format!("{other} is not an argument of this bench")),
            }
        }
        if options.repetitions == 0 {
            return Err("--repetitions must be at least 1".to_owned());
        }
        Ok(options)
    }

    fn cases(&self) -> Vec<Case> {
        let samples = |full: usize, quick: usize| if self.quick { quick } else { full };
        let (scan, cloud) = (link::Route::Scan, link::Route::Cloud);
        let all = [
            Case {
                name: "100 Hz of 2,948 B",
                route: scan,
                rate_hz: 100,
                bytes: 2_948,
                samples: samples(400, 150),
            },
            Case {
                name: "1 kHz of 2,948 B",
                route: scan,
                rate_hz: 1_000,
                bytes: 2_948,
                samples: samples(3_000, 1_000),
            },
            Case {
                name: "10 Hz of 1 MiB",
                route: cloud,
                rate_hz: 10,
                bytes: 1 << 20,
                samples: samples(60, 15),
            },
        ];
        all.into_iter().filter(|case| self.wants(case.name)).collect()
    }

    fn loss_checks(&self) -> Vec<Case> {
        if self.no_loss {
            return Vec::new();
        }
        let samples = |full: usize, quick: usize| if self.quick { quick } else { full };
        let (scan, cloud) = (link::Route::Scan, link::Route::Cloud);
        let all = [
            Case {
                name: "5 kHz of 2,948 B",
                route: scan,
                rate_hz: 5_000,
                bytes: 2_948,
                samples: samples(50_000, 15_000),
            },
            Case {
                name: "30 Hz of 2 MB",
                route: cloud,
                rate_hz: 30,
                bytes: 2_000_000,
                samples: samples(300, 90),
            },
        ];
        all.into_iter().filter(|case| self.wants(case.name)).collect()
    }

    fn wants(&self, name: &str) -> bool {
        self.only.as_ref().is_none_or(|text| name.contains(text.as_str()))
    }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(role) = arguments.first().filter(|role| role.starts_with("__")) {
        return link::run(role, &arguments[1..]);
    }
    match Options::parse(&arguments).and_then(|options| measure(&options)) {
        Ok(folder) => {
            println!("\nraw data: {}", folder.display());
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("bench: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<PathBuf, String> {
    let machine = system::Machine::look();
    let began = std::time::SystemTime::now();
    let mut beds = children::Beds::start(options)?;
    let mut results = report::Results::new(options, machine, began);
    for repetition in 0..options.repetitions {
        for case in options.cases() {
            eprintln!("repetition {} of {}: {}", repetition + 1, options.repetitions, case.name);
            results.wakeup(&case, repetition, wakeup::eventfd(&case, options)?);
            for bed in beds.all() {
                let run = bed.measure(&case)?;
                results.run(&case, repetition, &run);
            }
        }
    }
    for case in options.loss_checks() {
        for bed in beds.all() {
            eprintln!("loss: {} {}", case.name, bed.name());
            let run = bed.measure(&case)?;
            results.loss(&case, &run);
        }
    }
    drop(beds);
    results.print();
    results.write(options)
}
