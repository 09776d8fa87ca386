//! The memory that the outputs of a lane may take. Pure.

use super::offer::Offer;
use super::{arena, late_joiners};
use crate::config::{Lane, Output};
use crate::dds;
use crate::model::{Durability, MAX_PUBLISHERS, QosProfile, Reliability};

/// The chunks for copies of small samples, of all outputs of a lane together.
pub(in crate::process) const COPIES_BYTES: u64 = arena::MAX_BYTES as u64;

/// The last samples of each publisher, which a TRANSIENT_LOCAL output has for late joiners. Those of a
/// BEST_EFFORT one are not in the history of its writer, and one publisher's may exceed the bound.
fn for_late_joiners(qos: &QosProfile, sample_bytes: u64) -> u64 {
    let of_one = u64::from(qos.depth().unwrap_or(1)).saturating_mul(sample_bytes);
    let of_all = of_one.saturating_mul(MAX_PUBLISHERS as u64).min(late_joiners::MAX_BYTES as u64);
    match (qos.durability, qos.reliability) {
        (Durability::Volatile, _) => 0,
        (Durability::TransientLocal, Reliability::Reliable) => of_all,
        (Durability::TransientLocal, Reliability::BestEffort) => of_all.max(of_one),
    }
}

/// The samples that an output retains: in the history of its writer, and for late joiners that request none.
/// With the QoS that needs more, where the publishers decide.
pub(in crate::process) fn output_bytes(lane: &Lane, output: &Output, max_sample_bytes: usize) -> u64 {
    let of_qos = |qos: QosProfile| {
        let offer = Offer::of(lane, qos);
        let history = dds::history_bytes(&qos, offer.window_samples, max_sample_bytes);
        history.saturating_add(for_late_joiners(&qos, max_sample_bytes as u64))
    };
    of_qos(output.qos).max(output.latched_qos.map_or(0, of_qos))
}
