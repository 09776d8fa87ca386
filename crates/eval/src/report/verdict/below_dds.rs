//! Verdict on a claim that the paper does not make: lanes are not coupled below DDS by IP fragments.

use super::{Criterion, Finding, place_name};
use crate::report::cells::{Cell, Results};
use crate::report::format;

const CLAIM: &str = "Not a hypothesis of the paper: the lanes are not coupled by IP fragments either, for \
                     which a switch that reassembles them may have one memory for all lanes. Rules, for each \
                     bridge scenario with loss: no IP fragment is sent to a remote subscriber (captured at \
                     its host), and the switch discards no incomplete datagram.";

/// Computes the verdict.
pub fn finding(results: &Results) -> Finding {
    let mut criteria = Vec::new();
    for cell in results.cells().filter(|cell| cell.bridge && cell.reading.is_some()) {
        criteria.extend(none(cell, "no fragment is sent to a remote subscriber", "fragments", |one| {
            one.fragments_to_remote
        }));
        // A plain switch reassembles nothing.
        if cell.place.switch == "reassembling" {
            criteria.extend(none(
                cell,
                "the switch discards no incomplete datagram",
                "datagrams discarded",
                |one| one.reassembly_failed,
            ));
        }
    }
    let mut missing = Vec::new();
    if !criteria.iter().any(|criterion| criterion.rule.starts_with("the switch")) {
        missing.push("a bridge scenario with loss and a switch that reassembles fragments".to_owned());
    }
    Finding::judged("Below DDS", "No coupling by IP fragments", CLAIM, criteria, missing)
}

fn none(
    cell: &Cell,
    rule: &str,
    what: &str,
    count: impl Fn(&crate::report::measures::Measures) -> Option<u64>,
) -> Option<Criterion> {
    let counts: Vec<u64> = cell.measures.iter().filter_map(count).collect();
    let total: u64 = counts.iter().sum();
    (!counts.is_empty()).then(|| Criterion {
        rule: rule.to_owned(),
        place: place_name(cell),
        found: format!("{} {what}", format::count(total as f64)),
        holds: total == 0,
    })
}
