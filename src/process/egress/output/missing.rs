//! Why samples are missing before the one that was taken.

use super::Output;
use crate::model::{DropReason, SampleHeader};
use crate::shm::ProcessRole;

impl Output {
    /// Counts the samples missing before `next`, by the reason why the lane did not get them.
    pub(super) fn count_missing(&mut self, missing: u64, next: &SampleHeader) {
        let reason = if !self.caught_up && self.tracker.first() > 0 && next.published_at < self.started_at {
            DropReason::LaneDown
        } else if self.is_first_of_new_ingress(next) {
            DropReason::IngressDied
        } else if !self.caught_up {
            DropReason::LaneDown
        } else {
            self.gap_reason
        };
        self.counters.update(|counters| {
            counters.first_sequence = self.tracker.first();
            // This accounts for the missing samples, but not yet for `next`.
            counters.last_sequence = next.sequence - 1;
            counters.drops.add(reason, missing);
        });
    }

    /// Ingress may have been started again before the last housekeeping, or since.
    fn is_first_of_new_ingress(&self, next: &SampleHeader) -> bool {
        let started_since = || {
            let health = self.boards.health(ProcessRole::Ingress);
            health.filter(|health| health.starts != self.ingress_starts).map(|health| health.started_at)
        };
        let restarted_at = self.ingress_restarted_at.or_else(started_since);
        restarted_at.is_some_and(|restarted_at| next.published_at >= restarted_at)
    }

    /// Notes what is known of restarts with a sample that was taken.
    pub(super) fn follow_restarts(&mut self, taken: &SampleHeader) {
        if taken.published_at >= self.started_at {
            self.caught_up = true;
        }
        if self.ingress_restarted_at.is_some_and(|restarted_at| taken.published_at >= restarted_at) {
            self.ingress_restarted_at = None;
        }
    }
}
