//! H2: the bridge removes the degradation for critical subscribers.

use super::{Criterion, Finding, missing, place_name};
use crate::report::cells::{Cell, Place, Results};
use crate::report::{format, paper};

/// The allowed ratio of a critical p95 to that of the clean bridge.
const P95_TIMES: f64 = 1.10;

/// The latency that the bridge may add to the clean p95. The paper's bridge added 0.56 ms.
const ADDED_MS: f64 = 0.4;

/// The allowed difference of the rate from its target, and the allowed standard deviation: both are 0.0 at
/// the paper's one decimal.
const RATE_HZ: f64 = 0.05;

/// The paper's bridge scenarios with loss.
const IMPAIRED: [&str; 4] = ["bridge_mild", "bridge_moderate", "bridge_strong", "bridge_toggle"];

const CLAIM: &str = "With the bridge, loss at a remote subscriber does not affect the critical subscribers \
                     and the publisher. Rules, for each of the paper's bridge scenarios, by the medians over \
                     repetitions: the rate is 30.0 Hz with a standard deviation of 0.0; no critical sample \
                     is lost, in any repetition; under loss the critical p95 is at most 10 % above that of \
                     the clean bridge; and the clean bridge's p95 is at most 0.4 ms above the clean \
                     baseline's (the paper: 0.6 ms). A full verdict requires runs of all four levels on \
                     Fast DDS and Cyclone DDS, in both readings.";

/// Computes the verdict.
pub fn finding(results: &Results) -> Finding {
    let mut criteria = Vec::new();
    let scenarios: Vec<&str> = paper::TABLE_III.iter().map(|row| row.scenario).collect();
    for cell in results.cells().filter(|cell| scenarios.contains(&cell.scenario.as_str())) {
        criteria.extend(rate(cell));
        criteria.push(lost(cell));
        if IMPAIRED.contains(&cell.scenario.as_str()) {
            let reading = cell.reading.as_deref().unwrap_or_default();
            criteria.extend(
                results.cell(&cell.place, reading, "bridge_clean").and_then(|clean| tail(clean, cell)),
            );
        }
    }
    criteria.extend(results.places().into_iter().filter_map(|place| added(results, place)));
    let needed = ["baseline_clean", "bridge_clean", "bridge_mild", "bridge_moderate", "bridge_strong"];
    let title = "With the bridge, loss does not affect critical subscribers and the publisher";
    Finding::judged("H2", title, CLAIM, criteria, missing(results, &needed))
}

fn rate(cell: &Cell) -> Option<Criterion> {
    let (hz, deviation) = (cell.median(|one| one.rate_hz)?, cell.median(|one| one.rate_std_hz)?);
    let nominal = cell.median(|one| Some(one.nominal_hz))?;
    Some(Criterion {
        rule: "the rate is 30.0 ± 0.0 Hz".to_owned(),
        place: place_name(cell),
        found: format!("{} ± {} Hz", format::number(hz, 2), format::number(deviation, 2)),
        holds: (hz - nominal).abs() < RATE_HZ && deviation < RATE_HZ,
    })
}

fn lost(cell: &Cell) -> Criterion {
    let (lost, samples) = (cell.total(|one| one.critical.lost), cell.total(|one| one.critical.samples));
    Criterion {
        rule: "no critical sample is lost".to_owned(),
        place: place_name(cell),
        found: format!("{} of {} lost", format::count(lost as f64), format::count((samples + lost) as f64)),
        holds: lost == 0 && samples > 0,
    }
}

fn tail(clean: &Cell, cell: &Cell) -> Option<Criterion> {
    let (clean_ms, p95_ms) = (clean.critical_ms(0.95)?, cell.critical_ms(0.95)?);
    Some(Criterion {
        rule: "the critical p95 is at most 10 % above the clean bridge's".to_owned(),
        place: place_name(cell),
        found: format!("{} ms, clean {} ms", format::ms(p95_ms), format::ms(clean_ms)),
        holds: p95_ms <= P95_TIMES * clean_ms,
    })
}

fn added(results: &Results, place: &Place) -> Option<Criterion> {
    let p95 = |scenario| results.cell(place, "as-printed", scenario)?.critical_ms(0.95);
    let (bridge_ms, baseline_ms) = (p95("bridge_clean")?, p95("baseline_clean")?);
    let added_ms = bridge_ms - baseline_ms;
    Some(Criterion {
        rule: "the bridge adds at most 0.4 ms to the clean critical p95".to_owned(),
        place: place.name(),
        found: format!(
            "{} ms added, the paper {}",
            format::ms(added_ms),
            format::ms(paper::CLEAN_P95_ADDED_MS)
        ),
        holds: added_ms <= ADDED_MS,
    })
}
