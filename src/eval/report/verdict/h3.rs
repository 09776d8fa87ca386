//! H3: the classifier saves bandwidth that a static split does not.

use super::{Criterion, Finding, missing, place_name};
use crate::eval::report::cells::{Cell, Results};
use crate::eval::report::{format, paper};

/// What has to be saved, as a share.
const SAVED: f64 = 0.65;

const CLAIM: &str = "The classifier saves noncritical bandwidth while a link is impaired, beyond what \
                     splitting the topic does. Rules: in the impaired time the bytes on the wire towards the \
                     remote subscriber are at least 65 % fewer than without the classifier (the paper: 70 %, \
                     of the time after the demotion only; here the time that the classifier takes counts), \
                     and each toggle of the link is answered within 20 s, in every repetition. For the whole \
                     verdict ablation, moderate loss and toggle have to be run on Fast DDS and Cyclone DDS, \
                     in both readings.";

/// What the runs say.
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

/// The share of bytes on the wire that the classifier saves in the impaired time.
pub fn saved_share(without: &Cell, with: &Cell) -> Option<f64> {
    let bytes = |cell: &Cell| cell.median(|one| one.wire_impaired_bytes_per_s);
    Some(1.0 - bytes(with)? / bytes(without).filter(|bytes| *bytes > 0.0)?)
}

fn saved(without: &Cell, with: &Cell) -> Option<Criterion> {
    let bytes = |cell: &Cell| cell.median(|one| one.wire_impaired_bytes_per_s);
    let share = saved_share(without, with)?;
    Some(Criterion {
        rule: "at least 65 % of the noncritical bandwidth is saved".to_owned(),
        place: place_name(with),
        found: format!(
            "{} saved ({}/s instead of {}/s; the paper {})",
            format::percent(share),
            format::bytes(bytes(with)?),
            format::bytes(bytes(without)?),
            format::percent(paper::SAVED_PERCENT / 100.0)
        ),
        holds: share >= SAVED,
    })
}

fn reactions(cell: &Cell) -> Criterion {
    let all = || cell.measures.iter().flat_map(|one| &one.reactions);
    let unanswered = all().filter(|reaction| reaction.after_s.is_none()).count();
    let longest = all().filter_map(|reaction| reaction.after_s).fold(0.0, f64::max);
    let count = all().count();
    let found = match (count, unanswered) {
        (0, _) => "no toggle was seen".to_owned(),
        (_, 0) => format!("the slowest of {count} took {} s", format::number(longest, 1)),
        _ => format!("{unanswered} of {count} were not answered at all"),
    };
    Criterion {
        rule: "each toggle is answered within 20 s".to_owned(),
        place: place_name(cell),
        found,
        holds: count > 0 && unanswered == 0 && longest <= paper::REACTION_S,
    }
}
