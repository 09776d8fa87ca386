//! Section `isolation`: the latency of the critical lane under faults of the noncritical lane or of one of
//! the critical lane's own subscribers. Control does not run, so only the separation of the processes
//! protects the critical lane. The noncritical egress and its subscriber run on any CPU, with a nice value
//! that corresponds to the weights of the services' slices.
//!
//! Conditions take turns. `repeat` is the same as `undisturbed`: their difference is the noise of the
//! comparison.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use adaptive_bridge_measure::hop::{Isolation, Quantiles};
use nix::sys::signal::Signal;

use super::beds::{Bed, Beds, Plan, Process, Program, add_up};
use super::link::Record;
use super::options::{Case, Options, SCAN};
use super::out::{Output, RowKey};
use super::scale::latencies_us;
use super::system::Scheduling;

const LANE: &str = "noncritical";

/// The state of the noncritical lane, or of a second subscriber of the critical lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Condition {
    /// The noncritical lane forwards 10 Hz of the 1 kHz.
    Undisturbed,
    /// The noncritical egress is stopped (SIGSTOP).
    Stopped,
    /// A program with the nice value and time slice of the noncritical egress uses every CPU fully, as the
    /// egress would if all its threads were in endless loops. The egress itself has no switch for that.
    Spinning,
    /// The noncritical egress is killed and started again every 300 ms.
    Killed,
    /// The same as `Undisturbed`.
    Repeat,
    /// A second RELIABLE subscriber of the critical lane is stopped (SIGSTOP) and acknowledges nothing.
    ReaderStopped,
    /// A second RELIABLE subscriber of the critical lane was killed; its lease has not expired.
    ReaderKilled,
    /// The noncritical lane forwards 10 Hz of 5 kHz.
    Fast,
    /// The noncritical lane forwards all of 5 kHz, without a rate limit.
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

    /// The condition that it is compared with: the same load, undisturbed.
    const fn baseline(self) -> Self {
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

/// The default rate limit of the noncritical lane.
const LIMITED_HZ: u64 = 10;
/// A rate limit that no load of the bench reaches.
const UNLIMITED_HZ: u64 = 100_000;

/// The period of kills: longer than a restart by systemd takes, and too short for the lane to complete
/// discovery.
const KILL_EVERY: Duration = Duration::from_millis(300);

/// Longer than the 15 s lease after which the others remove a killed participant.
const LEASE: Duration = Duration::from_secs(16);

/// Rounds of each repetition. Fewer than six rounds give no interval for the median ratio; a dozen resolve a
/// difference of a third, forty one of 10 to 20 %.
const ROUNDS_PER_REPETITION: usize = 4;

/// The measurements of one condition, of one or more rounds.
#[derive(Default)]
struct Measured {
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
                // The baseline of a selected condition is measured too.
                options.wants("isolation", condition.label())
                    || Condition::ALL.iter().any(|other| {
                        other.baseline() == *condition && options.wants("isolation", other.label())
                    })
            })
            .collect();
        if wanted.is_empty() {
            continue;
        }
        let plan = Plan { control: false, ..Plan::whole(scheduling, &[4096]) };
        let mut beds = Beds::start(&[plan], options)?;
        let mut measured: BTreeMap<Condition, Measured> = BTreeMap::new();
        let rounds = options.repetitions * if options.quick { 1 } else { ROUNDS_PER_REPETITION };
        for round in 0..rounds {
            // Each round begins with another condition. Otherwise the same condition would always be the
            // first one after 5 kHz or after a disturbance with lasting effects.
            for condition in wanted.iter().cycle().skip(round).take(wanted.len()) {
                eprintln!("isolation: round {}, {}, {}", round + 1, condition.label(), scheduling.label());
                // A p99.9 needs at least 1,000 samples.
                let seconds = options.seconds(4.0).max(1.1);
                let case = Case::lasting(condition.rate_hz(), SCAN, seconds, 0);
                let one = measure_one(*condition, &case, &mut beds.0[0])?;
                let key = RowKey {
                    section: "isolation",
                    scheduling: scheduling.label(),
                    case: condition.label(),
                    program: "bridge",
                    repetition: round,
                };
                output.raw_quantiles(key, "latency", &Quantiles::of(&one.latency_us));
                for record in &one.records {
                    output.sample(key, record);
                }
                output.raw_missing(key, one.missing, &one.reasons);
                output.raw(key, "noncritical forwarded", one.noncritical_forwarded as f64);
                output.raw(key, "kills", one.kills as f64);
                let sum = measured.entry(*condition).or_default();
                sum.rounds_p999_us.extend(Quantiles::of(&one.latency_us).p999_us);
                sum.latency_us.extend(one.latency_us);
                sum.missing += one.missing;
                add_up(&mut sum.reasons, one.reasons);
                sum.noncritical_forwarded += one.noncritical_forwarded;
                sum.kills += one.kills;
            }
        }
        for (condition, measured) in measured {
            output.summary.isolation.push(row(scheduling, condition, measured));
        }
    }
    Ok(())
}

fn row(scheduling: Scheduling, condition: Condition, measured: Measured) -> Isolation {
    Isolation {
        scheduling: scheduling.label().to_owned(),
        condition: condition.label().to_owned(),
        against: condition.baseline().label().to_owned(),
        rate_hz: condition.rate_hz(),
        missing: measured.missing,
        reasons: measured.reasons,
        latency: Quantiles::of(&measured.latency_us),
        rounds_p999_us: measured.rounds_p999_us,
        noncritical_forwarded: measured.noncritical_forwarded,
        kills: measured.kills,
    }
}

/// Measures one condition in one round.
fn measure_one(condition: Condition, case: &Case, bed: &mut Bed) -> Result<Measured, String> {
    let disturbance = Disturbance::begin(condition, bed)?;
    std::thread::sleep(Duration::from_millis(300));
    let run = bed.measure(case);
    let kills = disturbance.end(bed)?;
    // By the end of this sleep the noncritical lane has handled its queued samples and the lease of killed
    // participants has expired, so that the next condition begins undisturbed.
    std::thread::sleep(if kills > 0 { LEASE } else { Duration::from_millis(700) });
    let run = run?;
    Ok(Measured {
        latency_us: latencies_us(&run),
        rounds_p999_us: Vec::new(),
        missing: run.missing(),
        reasons: run.reasons(),
        records: run.records,
        noncritical_forwarded: run.bridge.as_ref().map_or(0, |bridge| bridge.noncritical_forwarded),
        kills,
    })
}

/// A disturbance that lasts while the critical lane is measured.
enum Disturbance {
    None,
    Stopped,
    Spinning(Program),
    Killed { stop: Arc<AtomicBool>, killer: JoinHandle<Result<(Process, u64), String>> },
    Flooding,
    Reader(#[allow(dead_code, reason = "ends when it is dropped")] Program),
}

impl Disturbance {
    fn begin(condition: Condition, bed: &mut Bed) -> Result<Self, String> {
        if let Condition::ReaderStopped | Condition::ReaderKilled = condition {
            let reader = bed.second_subscriber()?;
            // Time for the endpoints to match on both sides.
            std::thread::sleep(Duration::from_secs(1));
            let is_stopped = condition == Condition::ReaderStopped;
            reader.signal(if is_stopped { Signal::SIGSTOP } else { Signal::SIGKILL });
            return Ok(Self::Reader(reader));
        }
        let bridge = bed.middle.bridge.as_mut().ok_or("no bridge")?;
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
                let stop_requested = Arc::clone(&stop);
                let killer = std::thread::spawn(move || kill_repeatedly(process, &start, &stop_requested));
                Self::Killed { stop, killer }
            }
            Condition::Flooding => {
                bridge.set_noncritical_rate(UNLIMITED_HZ)?;
                Self::Flooding
            }
        })
    }

    /// Ends the disturbance and returns the number of killed processes.
    fn end(self, bed: &mut Bed) -> Result<u64, String> {
        let bridge = bed.middle.bridge.as_mut().ok_or("no bridge")?;
        match self {
            Self::None => {}
            // The drop kills the subscriber.
            Self::Reader(_) => return Ok(1),
            Self::Spinning(spinner) => drop(spinner),
            Self::Stopped => bridge.signal(LANE, Signal::SIGCONT),
            Self::Killed { stop, killer } => {
                stop.store(true, Ordering::Relaxed);
                let (mut last, kills) =
                    killer.join().map_err(|_| "the killing thread panicked".to_owned())??;
                // The kernel kills the last child, whose starting thread has ended, so it is replaced here.
                let _ = last.child.kill();
                last.child.wait().map_err(|error| error.to_string())?;
                let start = bridge.starter(LANE);
                bridge.put_back(start()?);
                return Ok(kills);
            }
            Self::Flooding => bridge.set_noncritical_rate(LIMITED_HZ)?,
        }
        Ok(0)
    }
}

/// Kills and restarts a process until a stop is requested; returns the last process and the number of kills.
fn kill_repeatedly(
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
