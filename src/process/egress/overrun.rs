//! The overruns of an output's readers: each counted once, and those of a reader that has left logged.

use tracing::warn;

use crate::dds::RawWriter;
use crate::model::{Guid, LaneCounters, TrafficClass};
use crate::shm::BoardWriter;

/// What the account of an output has of the overruns of its present writer.
#[derive(Default)]
pub(super) struct Overrun {
    counted: u64,
}

impl Overrun {
    /// Counts the overruns since the last call: of any number of readers, also of those that have left.
    pub fn count(&mut self, writer: &RawWriter, counters: &mut BoardWriter<LaneCounters>) {
        let missed = self.uncounted(writer.overrun());
        if missed > 0 {
            counters.update(|counters| counters.reader_overrun += missed);
        }
    }

    fn uncounted(&mut self, of_writer: u64) -> u64 {
        let missed = of_writer.saturating_sub(self.counted);
        self.counted = of_writer;
        missed
    }
}

/// Logs the samples that a reader had not acknowledged when it left. Control logs what a present one missed.
pub(super) fn log_left(route: &str, lane: &str, class: TrafficClass, reader: Guid, missed: u64) {
    // On a noncritical lane fresher samples supersede those that are not acknowledged, by design.
    if missed > 0 && class == TrafficClass::Critical {
        warn!(
            route,
            lane,
            ?reader,
            missed,
            reason = "reader_overrun",
            "a subscriber has left that had not acknowledged samples which the lane no longer retained"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_overrun_of_a_writer_is_counted_once() {
        let mut overrun = Overrun::default();
        assert_eq!([0, 3, 3, 10].map(|of_writer| overrun.uncounted(of_writer)), [0, 3, 0, 7]);
    }
}
