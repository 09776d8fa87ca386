//! Critical lanes: forward every sample, in order, at once.

use super::super::arena::CopyArena;
use super::Turn;
use super::output::Output;
use crate::dds::Participant;
use crate::model::{LaneMode, MonotonicNs};
use crate::policy::critical_drop;

/// Samples taken from one route before the next route is served.
const SAMPLES_PER_TURN: usize = 32;

/// Forwards the samples that wait in shared memory, or drops them if the mode requires it.
pub(super) fn step(
    outputs: &mut [Output],
    participant: &mut Participant,
    arena: &mut CopyArena,
    mode: LaneMode,
) -> Turn {
    let mut busy = false;
    for output in outputs {
        for _ in 0..SAMPLES_PER_TURN {
            let Some(sample) = output.take() else {
                break;
            };
            busy = true;
            match critical_drop(mode) {
                Some(reason) => output.drop_sample(&sample, reason),
                None => output.send(sample, participant, arena),
            }
        }
    }
    if busy { Turn::Busy } else { Turn::UntilWoken(MonotonicNs(u64::MAX)) }
}
