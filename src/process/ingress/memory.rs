//! The memory that the input of a route may take. Pure.

pub(in crate::process) use super::patterns::PATTERN_BYTES;
use super::pool::{UNFINISHED_IN_ALL_BYTES, assembly_limits};
use super::source::most_waiting_bytes;
use crate::config::Route;
use crate::dds;

/// Samples of which fragments are missing, at the readers of these routes: each has one for the publishers of
/// each reliability, or one for all where the configuration gives the reliability.
pub(in crate::process) fn fragment_bytes<'a>(routes: impl IntoIterator<Item = &'a Route>) -> u64 {
    let of_route = |route: &Route| {
        let readers = if route.input_qos.reliability.is_some() { 1 } else { 2 };
        readers * assembly_limits(route.max_sample_bytes).max_total_bytes as u64
    };
    let of_all = routes.into_iter().map(of_route).fold(0, u64::saturating_add);
    of_all.min(UNFINISHED_IN_ALL_BYTES as u64)
}

/// Samples that the DDS library keeps, also when ingress has taken them, until others replace them; and those
/// that wait for an earlier one.
pub(in crate::process) fn waiting_bytes(route: &Route) -> u64 {
    dds::WITHHELD_BYTES.saturating_add(most_waiting_bytes(&route.input_qos, route.max_sample_bytes) as u64)
}
