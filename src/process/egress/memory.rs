//! The memory that the outputs of a lane may take. Pure.

use super::arena;
use super::offer::Offer;
use crate::config::{Lane, Output};
use crate::dds;
use crate::model::{Durability, QosProfile, Reliability};

/// The chunks for copies of small samples, of all outputs of a lane together.
pub(in crate::process) const COPIES_BYTES: u64 = arena::MAX_BYTES as u64;

/// The samples that an output retains: in the history of its writer, and for late joiners that request none.
/// With the QoS that needs more, where the publishers decide.
pub(in crate::process) fn output_bytes(lane: &Lane, output: &Output, max_sample_bytes: usize) -> u64 {
    let of_qos = |qos: QosProfile| {
        let offer = Offer::of(lane, qos);
        let is_for_late_joiners =
            qos.durability == Durability::TransientLocal && qos.reliability == Reliability::BestEffort;
        let kept = if is_for_late_joiners { u64::from(qos.depth().unwrap_or(1)) } else { 0 };
        let history = dds::history_bytes(&qos, offer.window_samples, max_sample_bytes);
        history.saturating_add(kept.saturating_mul(max_sample_bytes as u64))
    };
    of_qos(output.qos).max(output.latched_qos.map_or(0, of_qos))
}
