//! Section `throughput`: searches for the highest rate without loss, by doubling until a run fails and then
//! by bisection. A run passes when no sample is refused, lost or damaged and the publisher keeps its
//! schedule. The resulting rate must pass twice.

use adaptive_bridge_measure::hop::{Attempt, Throughput, payload};

use super::beds::{Bed, Beds, Run};
use super::options::{Case, Options, PAYLOADS};
use super::out::{Output, RowKey};
use super::system::Scheduling;

/// The data rate of the first run, which any machine sustains.
const FIRST_MB_PER_S: f64 = 5.0;
/// The highest rate of the first run.
const MAX_FIRST_HZ: f64 = 1_000.0;

/// Bisections between the last rate that passed and twice that rate: the result is within 6 % of the limit.
const BISECTIONS: usize = 4;

/// The highest rate that is tried, because the publisher's own loop takes 5 µs.
const MAX_HZ: f64 = 200_000.0;

/// The payloads that the options select.
pub fn payloads(options: &Options) -> Vec<usize> {
    let quick = |bytes: &usize| !options.quick || *bytes == 2_948;
    let wanted = |bytes: &usize| options.wants("throughput", &payload(*bytes));
    PAYLOADS.into_iter().filter(quick).filter(wanted).collect()
}

/// Searches for the highest rate of a payload in each bed.
pub fn search(
    bytes: usize,
    scheduling: Scheduling,
    beds: &mut Beds,
    options: &Options,
    output: &mut Output,
) -> Result<(), String> {
    let seconds = options.seconds(1.5);
    for bed in &mut beds.0 {
        let found = search_in(bytes, scheduling, seconds, bed)?;
        let case = payload(bytes);
        for (index, attempt) in found.attempts.iter().enumerate() {
            let key = RowKey {
                section: "throughput",
                scheduling: scheduling.label(),
                case: &case,
                program: bed.name(),
                repetition: index,
            };
            let outcome = if attempt.failure.is_some() { "failed at Hz" } else { "passed at Hz" };
            output.raw(key, outcome, attempt.rate_hz);
        }
        output.summary.throughput.push(found);
    }
    Ok(())
}

fn search_in(
    bytes: usize,
    scheduling: Scheduling,
    seconds: f64,
    bed: &mut Bed,
) -> Result<Throughput, String> {
    let route = PAYLOADS.iter().position(|known| *known == bytes).unwrap_or(0);
    let mut attempts: Vec<Attempt> = Vec::new();
    let mut passes = |rate_hz: f64| -> Result<bool, String> {
        let case = Case::lasting(rate_hz.round() as u64, bytes, seconds, route);
        let run = bed.measure_with_timeout(&case, 1_500)?;
        let failure = failure(&case, scheduling, &run);
        eprintln!(
            "throughput: {}, {}: {}",
            case.name(),
            bed.name(),
            failure.as_deref().unwrap_or("nothing lost")
        );
        let passed = failure.is_none();
        attempts.push(Attempt { rate_hz, failure });
        Ok(passed)
    };
    let mut passed: Option<f64> = None;
    let mut rate_hz = (FIRST_MB_PER_S * 1e6 / bytes as f64).min(MAX_FIRST_HZ).round();
    let mut failed = None;
    while failed.is_none() && rate_hz <= MAX_HZ {
        if passes(rate_hz)? {
            passed = Some(rate_hz);
            rate_hz *= 2.0;
        } else {
            failed = Some(rate_hz);
        }
    }
    if let Some(mut above) = failed {
        let mut below = passed.unwrap_or(0.0);
        for _ in 0..BISECTIONS {
            let middle = f64::midpoint(below, above).round();
            if passes(middle)? {
                below = middle;
            } else {
                above = middle;
            }
        }
        passed = (below > 0.0).then_some(below);
    }
    // The rate must pass once more; if it does not, lower rates are tried.
    while let Some(found) = passed.filter(|found| *found >= 1.0) {
        if passes(found)? {
            break;
        }
        passed = Some((found * 0.9).floor());
    }
    let next = attempts
        .iter()
        .filter(|attempt| passed.is_none_or(|passed| attempt.rate_hz >= passed))
        .filter_map(|attempt| Some((attempt.rate_hz, attempt.failure.as_ref()?)))
        .min_by(|one, other| one.0.total_cmp(&other.0));
    let limit = next.map_or("not reached".to_owned(), |(rate, failure)| format!("{rate:.0} Hz: {failure}"));
    Ok(Throughput {
        scheduling: scheduling.label().to_owned(),
        bytes,
        program: bed.name().to_owned(),
        rate_hz: passed.filter(|found| *found >= 1.0),
        limit,
        run_s: seconds,
        attempts,
    })
}

/// The reason why a run failed; `None` when it passed.
fn failure(case: &Case, scheduling: Scheduling, run: &Run) -> Option<String> {
    let account = run.loss(case, scheduling);
    let last = run.records.iter().max_by_key(|record| record.number);
    let behind_ns = last.map_or(0, |last| last.written_at.saturating_sub(last.due_at));
    let run_ns = case.samples as u64 * 1_000_000_000 / case.rate_hz;
    let dropped: Vec<String> = account.drops.iter().map(|(name, count)| format!("{name} {count}")).collect();
    if account.refused > 0 {
        Some(format!("{} refused by the publisher's own writer", account.refused))
    } else if account.lost > 0 {
        let by = if dropped.is_empty() { String::new() } else { format!(" ({})", dropped.join(", ")) };
        Some(format!("{} lost{by}", account.lost))
    } else if account.damaged > 0 {
        Some(format!("{} damaged", account.damaged))
    } else if behind_ns > run_ns / 50 {
        // More than 2 % of the duration of the run.
        Some(format!("the publisher is {} ms behind at the end", behind_ns / 1_000_000))
    } else {
        None
    }
}
