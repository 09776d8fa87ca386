//! H1: without a bridge, one lossy link degrades the publisher and the critical subscriber.

use super::{Criterion, Finding, Verdict, missing, place_name};
use crate::report::cells::{Cell, Place, Results, reading_name};
use crate::report::format;

/// The rate is degraded if it is lower than the clean baseline's by at least this share.
const RATE_LOST: f64 = 0.05;

/// The critical latency is degraded if its p95 is at least this many times that of the clean baseline.
const LATENCY_TIMES: f64 = 10.0;

const LEVELS: [&str; 3] = ["baseline_mild", "baseline_moderate", "baseline_strong"];

const CLAIM: &str = "Without a bridge, bursty loss at one remote subscriber degrades the publisher's rate \
                     and the critical subscriber's latency. Rule: in each impaired baseline the rate is at \
                     least 5 % below the clean baseline's, and the critical p95 at least ten times the clean \
                     baseline's. Confirmed if both hold in all of them, and mild, moderate and strong loss were run \
                     with Fast DDS, as the paper did; partly confirmed if at least one of them holds \
                     somewhere.";

/// The levels of loss that degrade rate and latency at a place.
struct AtPlace {
    place: Place,
    rate: Vec<&'static str>,
    latency: Vec<&'static str>,
    levels: usize,
    /// The longest time without a sample at the critical subscriber, in any run of any level.
    gap_ms: f64,
}

/// Computes the verdict for one reading.
pub fn finding(results: &Results, reading: &str) -> Finding {
    let (mut criteria, mut places) = (Vec::new(), Vec::new());
    for place in results.places() {
        let Some(clean) = clean_baseline(results, place, reading) else { continue };
        let mut at =
            AtPlace { place: place.clone(), rate: Vec::new(), latency: Vec::new(), levels: 0, gap_ms: 0.0 };
        for scenario in LEVELS {
            let Some(cell) = results.cell(place, reading, scenario) else { continue };
            let Some([rate, latency]) = judge(clean, cell) else { continue };
            let level = scenario.trim_start_matches("baseline_");
            at.levels += 1;
            at.gap_ms = at.gap_ms.max(cell.max(|one| one.critical_gap_ms).unwrap_or(0.0));
            at.rate.extend(rate.holds.then_some(level));
            at.latency.extend(latency.holds.then_some(level));
            criteria.extend([rate, latency]);
        }
        if at.levels > 0 {
            places.push(at);
        }
    }
    let whole = LEVELS.len();
    let all = criteria.iter().all(|criterion| criterion.holds);
    let any = criteria.iter().any(|criterion| criterion.holds);
    let on_fast = |at: &&AtPlace| at.place.library == "fast";
    let is_whole = places.iter().filter(on_fast).any(|at| at.levels == whole);
    let verdict = match (all, any, is_whole) {
        _ if places.is_empty() => Verdict::NotTested,
        (true, _, true) => Verdict::Confirmed,
        (_, true, _) => Verdict::Partly,
        (_, false, true) => Verdict::Contradicted,
        (_, false, false) => Verdict::NotSeen,
    };
    let sentences: Vec<String> = places.iter().map(AtPlace::sentence).collect();
    let because = match verdict {
        Verdict::NotTested => "An impaired and a clean baseline in the same setting were not run.".to_owned(),
        Verdict::NotSeen => format!("Not all levels were run. {}", sentences.join(" ")),
        _ => sentences.join(" "),
    };
    let mut scenarios = vec!["baseline_clean"];
    scenarios.extend(LEVELS);
    let missing = missing(results, &scenarios)
        .into_iter()
        .filter(|one| one.contains(reading_name(reading)) || one.contains("clean"));
    Finding {
        id: "H1",
        title: format!(
            "Without a bridge, one lossy link degrades the publisher and the critical subscriber: Table I {}",
            reading_name(reading)
        ),
        claim: CLAIM,
        verdict,
        because,
        criteria,
        missing: missing.collect(),
    }
}

/// The clean baseline at a place, or else with the other switch: without loss the switch has nothing to
/// reassemble or to discard.
fn clean_baseline<'a>(results: &'a Results, place: &Place, reading: &str) -> Option<&'a Cell> {
    let scenario = "baseline_clean";
    let same_but_switch = |other: &&Place| (&other.library, &other.bed) == (&place.library, &place.bed);
    results.cell(place, reading, scenario).or_else(|| {
        results
            .places()
            .into_iter()
            .filter(same_but_switch)
            .find_map(|other| results.cell(other, reading, scenario))
    })
}

impl AtPlace {
    fn sentence(&self) -> String {
        let list = |levels: &[&str]| match levels.len() {
            0 => "at no level".to_owned(),
            count if count == self.levels && count > 1 => "at every level".to_owned(),
            _ => format!("at {}", levels.join(" and ")),
        };
        let switch = if self.place.switch == "plain" { "" } else { ", switch that reassembles fragments" };
        let place = format!("{}, {}{switch}", self.place.library_name(), self.place.bed);
        format!(
            "{place}: rate degraded {}, critical latency {}; longest time without a critical sample {} s.",
            list(&self.rate),
            list(&self.latency),
            format::number(self.gap_ms / 1e3, 2)
        )
    }
}

/// Checks whether rate and latency are degraded.
fn judge(clean: &Cell, cell: &Cell) -> Option<[Criterion; 2]> {
    let (clean_hz, hz) = (clean.median(|one| one.rate_hz)?, cell.median(|one| one.rate_hz)?);
    let (clean_ms, p95_ms) = (clean.critical_ms(0.95)?, cell.critical_ms(0.95)?);
    let place = place_name(cell);
    Some([
        Criterion {
            rule: "the rate is at least 5 % lower than clean".to_owned(),
            place: place.clone(),
            found: format!("{} Hz, clean {} Hz", format::hz(hz), format::hz(clean_hz)),
            holds: hz <= (1.0 - RATE_LOST) * clean_hz,
        },
        Criterion {
            rule: "the critical p95 is at least ten times the clean one".to_owned(),
            place,
            found: format!("{} ms, clean {} ms", format::ms(p95_ms), format::ms(clean_ms)),
            holds: p95_ms >= LATENCY_TIMES * clean_ms,
        },
    ])
}

/// Explains the degradation of a baseline, or its absence, from its figures.
pub fn mechanism(cell: &Cell) -> Option<String> {
    let attempts = cell.total(|one| one.attempts);
    // The sentences are about all repetitions, and say "at most" and "up to". With the median of 0, 0 and 5
    // lost samples they would say that all arrived.
    let held = cell.max(|one| one.outstanding_max.map(|held| held as f64))?;
    if attempts == 0 {
        return None;
    }
    let (failed, blocked) = (cell.total(|one| one.failed), cell.total(|one| one.blocked));
    let held = format::count(held);
    let memory = cell.max(|one| one.fragment_memory_max_bytes.map(|bytes| bytes as f64)).unwrap_or(0.0);
    let discarded = cell.total(|one| one.reassembly_failed.unwrap_or(0) as usize);
    let mut text = if failed + blocked == 0 {
        format!(
            "The writer's history did not fill: at most {held} samples waited for the remote subscriber, and \
             no publish call blocked or failed."
        )
    } else {
        format!(
            "Up to {held} samples waited for the remote subscriber; {} of {} publish calls blocked and {} failed.",
            format::count(blocked as f64),
            format::count(attempts as f64),
            format::count(failed as f64)
        )
    };
    if let Some((gap_ms, max_ms)) =
        cell.max(|one| one.critical_gap_ms).zip(cell.max(|one| one.critical_ms.max())).filter(|_| failed > 0)
    {
        text += &format!(
            " While calls fail, the publisher sends no samples: the critical subscriber was without a sample \
             for up to {} s. It received samples up to {} ms after they were written",
            format::number(gap_ms / 1e3, 1),
            format::ms(max_ms)
        );
        let lost = cell.total(|one| one.critical.lost);
        text += &if lost > 0 {
            format!(", and missed {} that the writer took.", format::count(lost as f64))
        } else {
            ", and each one that the writer took.".to_owned()
        };
    }
    if memory > 0.0 || discarded > 0 {
        text += &format!(
            " Incomplete datagrams took up to {} of memory at the switch, which discarded {} of them.",
            format::bytes(memory),
            format::count(discarded as f64)
        );
    } else {
        text += " The switch held no fragments, so it dropped nothing of the critical path.";
    }
    Some(text)
}
