//! H3: the classifier saves bandwidth that a static split does not.

use super::{Criterion, Finding, missing, place_name};
use crate::report::cells::{Cell, Results};
use crate::report::{format, paper};

/// The share of the bandwidth that has to be saved.
const SAVED: f64 = 0.65;

const CLAIM: &str = "The classifier saves noncritical bandwidth while a link is impaired, beyond what \
                     splitting the topic does. Rules: in the impaired time the noncritical lane sends at \
                     least 65 % fewer bytes of payload than without the classifier (the paper: 70 %, counted \
                     only after the demotion; here the classifier's reaction time is included), and the \
                     classifier reacts to each toggle of the link within 20 s, in every repetition. A full \
                     verdict requires runs of ablation, moderate loss and toggle on Fast DDS and Cyclone \
                     DDS, in both readings.";

/// Computes the verdict.
pub fn finding(results: &Results) -> Finding {
    let mut criteria = Vec::new();
    for cell in results.cells() {
        match cell.scenario.as_str() {
            "bridge_ablation" => {
                let with = format!("bridge_{}", cell.level);
                let reading = cell.reading.as_deref().unwrap_or_default();
                criteria.extend(results.cell(&cell.place, reading, &with).and_then(|with| saved(cell, with)));
            }
            "bridge_toggle" => criteria.push(reactions(cell)),
            _ => {}
        }
    }
    let needed = ["bridge_moderate", "bridge_ablation", "bridge_toggle"];
    let title = "The classifier saves noncritical bandwidth";
    Finding::judged("H3", title, CLAIM, criteria, missing(results, &needed))
}

/// The saved share; `None` without both values.
fn saved_share(without: Option<f64>, with: Option<f64>) -> Option<f64> {
    Some(1.0 - with? / without.filter(|bytes| *bytes > 0.0)?)
}

fn saved(without: &Cell, with: &Cell) -> Option<Criterion> {
    // The rule compares the bytes that the lane sends: probes and discovery do not become fewer on an
    // impaired link, and the bytes on the wire may lack those that the link lost.
    let sent = |cell: &Cell| cell.median(|one| one.lane_impaired_bytes_per_s);
    let share = saved_share(sent(without), sent(with))?;
    let on_the_wire = |cell: &Cell| cell.median(|one| one.wire_impaired_bytes_per_s);
    let of_all = saved_share(on_the_wire(without), on_the_wire(with)).map_or_else(String::new, |share| {
        format!("; of all bytes on the wire, including probes and discovery, {}", format::percent(share))
    });
    Some(Criterion {
        rule: "at least 65 % of the noncritical bandwidth is saved".to_owned(),
        place: place_name(with),
        found: format!(
            "{} saved ({}/s instead of {}/s; the paper {}{of_all})",
            format::percent(share),
            format::bytes(sent(with)?),
            format::bytes(sent(without)?),
            format::percent(paper::SAVED_PERCENT / 100.0)
        ),
        holds: share >= SAVED,
    })
}

fn reactions(cell: &Cell) -> Criterion {
    let all = || cell.measures.iter().flat_map(|one| &one.reactions);
    let missing = all().filter(|reaction| reaction.after_s.is_none()).count();
    let longest = all().filter_map(|reaction| reaction.after_s).fold(0.0, f64::max);
    let count = all().count();
    let found = match (count, missing) {
        (0, _) => "no toggle was recorded".to_owned(),
        (_, 0) => format!("the slowest of {count} reactions took {} s", format::number(longest, 1)),
        _ => format!("no reaction to {missing} of {count} toggles"),
    };
    Criterion {
        rule: "the classifier reacts to each toggle within 20 s".to_owned(),
        place: place_name(cell),
        found,
        holds: count > 0 && missing == 0 && longest <= paper::REACTION_S,
    }
}
