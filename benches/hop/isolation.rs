//! The critical lane while something is wrong with the noncritical one, or with one of its own subscribers.
//! There is no control process that could come to the rescue: what holds is the processes alone. The
//! noncritical egress and its subscriber have a nice value that stands for the weights of the services'
//! slices, and run on any CPU.
//!
//! Conditions take turns. `repeat` is `undisturbed` once more: what those two differ by is what any two
//! conditions may differ by for no reason.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::sys::signal::Signal;

use super::beds::{Bed, Beds, Plan, Process, Program, add_up};
use super::link::Record;
use super::options::{Case, Options, SCAN};
use super::out::{Of, Output};
use super::report::{Isolation, Quantiles};
use super::scale::latencies_us;
use super::system::Scheduling;

const LANE: &str = "noncritical";

/// What the noncritical lane does, or a second subscriber of the critical lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Condition {
    /// Its 10 Hz of 1 kHz.
    Undisturbed,
    /// SIGSTOP.
    Stopped,
    /// Beside it, a program with its nice value and time slice burns every CPU, as the egress would if all of
    /// its threads span. The egress has no switch for that, and gets none.
    Spinning,
    /// `kill -9` and started again, every 300 ms.
    Killed,
    Repeat,
    /// A second RELIABLE subscriber of the critical lane is stopped (SIGSTOP) and acknowledges nothing.
    ReaderStopped,
    /// A second RELIABLE subscriber of the critical lane was killed; its lease has not expired.
    ReaderKilled,
    /// Its 10 Hz of 5 kHz.
    Fast,
    /// All of 5 kHz: no rate limit.
    Flooding,
}

impl Condition {
    const ALL: [Self; 9] = [
        Self::Undisturbed,
        Self::Stopped,
        Self::Spinning,
        Self::Killed,
        Self::Repeat,
        Self::ReaderStopped,
        Self::ReaderKilled,
        Self::Fast,
        Self::Flooding,
    ];

    const fn label(self) -> &'static str {
        match self {
            Self::Undisturbed => "undisturbed",
            Self::Stopped => "stopped",
            Self::Spinning => "spinning",
            Self::Killed => "killed",
            Self::Repeat => "repeat",
            Self::ReaderStopped => "reader stopped",
            Self::ReaderKilled => "reader killed",
            Self::Fast => "5 kHz",
            Self::Flooding => "flooding",
        }
    }

    /// What it is compared with: the same load, undisturbed.
    const fn against(self) -> Self {
        match self {
            Self::Fast | Self::Flooding => Self::Fast,
            _ => Self::Undisturbed,
        }
    }

    const fn rate_hz(self) -> u64 {
        match self {
            Self::Fast | Self::Flooding => 5_000,
            _ => 1_000,
        }
    }
}

/// Its default, and one that never limits.
const LIMITED_HZ: u64 = 10;
const UNLIMITED_HZ: u64 = 100_000;

/// More than a restart of the services takes, and a start never gets beyond discovery.
const KILL_EVERY: Duration = Duration::from_millis(300);

/// More than the 15 s for which the others know of a participant that was killed.
const LEASE: Duration = Duration::from_secs(16);

/// Fewer than six rounds tell nothing, a dozen a third, and forty a tenth or two.
const ROUNDS_PER_REPETITION: usize = 4;

#[derive(Default)]
struct Seen {
    records: Vec<Record>,
    latency_us: Vec<f64>,
    rounds_p999_us: Vec<f64>,
    missing: u64,
    reasons: BTreeMap<String, u64>,
    noncritical_forwarded: u64,
    kills: u64,
}

pub fn measure(options: &Options, output: &mut Output) -> Result<(), String> {
    for scheduling in options.schedulings() {
        let wanted: Vec<Condition> = Condition::ALL
            .into_iter()
            .filter(|condition| {
                // One that is compared with another needs that one.
                options.wants("isolation", condition.label())
                    || Condition::ALL.iter().any(|other| {
                        other.against() == *condition && options.wants("isolation", other.label())
                    })
            })
            .collect();
        if wanted.is_empty() {
            continue;
        }
        let plan = Plan { control: false, ..Plan::whole(scheduling, &[4096]) };
        let mut beds = Beds::start(&[plan], options)?;
        let mut seen: BTreeMap<Condition, Seen> = BTreeMap::new();
        let rounds = options.repetitions * if options.quick { 1 } else { ROUNDS_PER_REPETITION };
        for round in 0..rounds {
            // Each round begins with another one: what comes first, after 5 kHz, or after what left traces
            // would be the same each time.
            for condition in wanted.iter().cycle().skip(round).take(wanted.len()) {
                eprintln!("isolation: round {}, {}, {}", round + 1, condition.label(), scheduling.label());
                // Of fewer than 1,000 samples there is no p99.9.
                let seconds = options.seconds(4.0).max(1.1);
                let case = Case::lasting(condition.rate_hz(), SCAN, seconds, 0);
                let one = measure_one(*condition, &case, &mut beds.0[0])?;
                let of = Of {
                    section: "isolation",
                    scheduling: scheduling.label(),
                    case: condition.label(),
                    program: "bridge",
                    repetition: round,
                };
                output.raw_quantiles(of, "latency", &Quantiles::of(&one.latency_us));
                for record in &one.records {
                    output.sample(of, record);
                }
                output.raw_missing(of, one.missing, &one.reasons);
                output.raw(of, "noncritical forwarded", one.noncritical_forwarded as f64);
                output.raw(of, "kills", one.kills as f64);
                let sum = seen.entry(*condition).or_default();
                sum.rounds_p999_us.extend(Quantiles::of(&one.latency_us).p999_us);
                sum.latency_us.extend(one.latency_us);
                sum.missing += one.missing;
                add_up(&mut sum.reasons, one.reasons);
                sum.noncritical_forwarded += one.noncritical_forwarded;
                sum.kills += one.kills;
            }
        }
        for (condition, seen) in seen {
            output.summary.isolation.push(row(scheduling, condition, seen));
        }
    }
    Ok(())
}

fn row(scheduling: Scheduling, condition: Condition, seen: Seen) -> Isolation {
    Isolation {
        scheduling: scheduling.label().to_owned(),
        condition: condition.label().to_owned(),
        against: condition.against().label().to_owned(),
        rate_hz: condition.rate_hz(),
        missing: seen.missing,
        reasons: seen.reasons,
        latency: Quantiles::of(&seen.latency_us),
        rounds_p999_us: seen.rounds_p999_us,
        noncritical_forwarded: seen.noncritical_forwarded,
        kills: seen.kills,
    }
}

fn measure_one(condition: Condition, case: &Case, bed: &mut Bed) -> Result<Seen, String> {
    let disturbance = Disturbance::begin(condition, bed)?;
    std::thread::sleep(Duration::from_millis(300));
    let run = bed.measure(case);
    let kills = disturbance.end(bed)?;
    // What waited for the lane is behind it, those that were killed are forgotten, and the next condition
    // begins as the first one did.
    std::thread::sleep(if kills > 0 { LEASE } else { Duration::from_millis(700) });
    let run = run?;
    Ok(Seen {
        latency_us: latencies_us(&run),
        rounds_p999_us: Vec::new(),
        missing: run.missing(),
        reasons: run.reasons(),
        records: run.records,
        noncritical_forwarded: run.bridge.as_ref().map_or(0, |bridge| bridge.noncritical_forwarded),
        kills,
    })
}

/// What goes on while the critical lane is measured.
enum Disturbance {
    None,
    Stopped,
    Spinning(Program),
    Killed { stop: Arc<AtomicBool>, killer: JoinHandle<Result<(Process, u64), String>> },
    Flooding,
    Reader(#[allow(dead_code)] Program),
}

impl Disturbance {
    fn begin(condition: Condition, bed: &mut Bed) -> Result<Self, String> {
        if let Condition::ReaderStopped | Condition::ReaderKilled = condition {
            let reader = bed.second_subscriber()?;
            // Matched on both sides by then.
            std::thread::sleep(Duration::from_secs(1));
            let is_stopped = condition == Condition::ReaderStopped;
            reader.signal(if is_stopped { Signal::SIGSTOP } else { Signal::SIGKILL });
            return Ok(Self::Reader(reader));
        }
        let bridge = bed.bridge.as_mut().ok_or("no bridge")?;
        Ok(match condition {
            Condition::Undisturbed
            | Condition::Repeat
            | Condition::Fast
            | Condition::ReaderStopped
            | Condition::ReaderKilled => Self::None,
            Condition::Stopped => {
                bridge.signal(LANE, Signal::SIGSTOP);
                Self::Stopped
            }
            Condition::Spinning => Self::Spinning(Program::spinner()?),
            Condition::Killed => {
                let process = bridge.take(LANE).ok_or("no noncritical lane")?;
                let (stop, start) = (Arc::new(AtomicBool::new(false)), bridge.starter(LANE));
                let told = Arc::clone(&stop);
                let killer = std::thread::spawn(move || kill_again_and_again(process, &start, &told));
                Self::Killed { stop, killer }
            }
            Condition::Flooding => {
                bridge.set_noncritical_rate(UNLIMITED_HZ)?;
                Self::Flooding
            }
        })
    }

    /// Undoes it; how often the lane was killed.
    fn end(self, bed: &mut Bed) -> Result<u64, String> {
        let bridge = bed.bridge.as_mut().ok_or("no bridge")?;
        match self {
            Self::None => {}
            // Dropping it kills it.
            Self::Reader(_) => return Ok(1),
            Self::Spinning(spinner) => drop(spinner),
            Self::Stopped => bridge.signal(LANE, Signal::SIGCONT),
            Self::Killed { stop, killer } => {
                stop.store(true, Ordering::Relaxed);
                let (mut last, kills) = killer.join().map_err(|_| "the killing thread died".to_owned())??;
                // A child does not outlive the thread that started it: this one needs another.
                let _ = last.child.kill();
                last.child.wait().map_err(|error| error.to_string())?;
                let start = bridge.starter(LANE);
                bridge.give(start()?);
                return Ok(kills);
            }
            Self::Flooding => bridge.set_noncritical_rate(LIMITED_HZ)?,
        }
        Ok(0)
    }
}

fn kill_again_and_again(
    mut process: Process,
    start: &dyn Fn() -> Result<Process, String>,
    stop: &AtomicBool,
) -> Result<(Process, u64), String> {
    let mut kills = 0;
    while !stop.load(Ordering::Relaxed) {
        process.signal(Signal::SIGKILL);
        process.child.wait().map_err(|error| error.to_string())?;
        process = start()?;
        kills += 1;
        std::thread::sleep(KILL_EVERY);
    }
    Ok((process, kills))
}
