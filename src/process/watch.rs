//! Logs dropped samples by reason, rate-limited so that an operator can read the log.

use tracing::warn;

use crate::model::{DropCounts, DropReason, MonotonicNs};

/// Shortest interval between two log lines of the same reason. The first drop is logged at once.
const REPEAT_MS: u64 = 10_000;

/// Logs the new drops of one route in one process.
#[derive(Debug)]
pub(super) struct DropWatch {
    logged: DropCounts,
    next_at: [MonotonicNs; DropReason::COUNT],
}

impl DropWatch {
    /// Starts at `counts`, so that drops of a predecessor of this process are not logged again.
    pub fn new(counts: DropCounts) -> Self {
        Self { logged: counts, next_at: [MonotonicNs(0); DropReason::COUNT] }
    }

    /// Logs the drops in `counts` that were not logged yet. `expected` reasons are normal operation of the
    /// lane and are not logged.
    pub fn log_new(
        &mut self,
        counts: &DropCounts,
        route: &str,
        lane: &str,
        expected: &[DropReason],
        now: MonotonicNs,
    ) {
        for &reason in DropReason::ALL {
            let dropped = counts.get(reason).saturating_sub(self.logged.get(reason));
            if dropped == 0 || expected.contains(&reason) || now < self.next_at[reason as usize] {
                continue;
            }
            warn!(route, lane, reason = reason.label(), dropped, "samples dropped: {}", reason.meaning());
            self.logged.add(reason, dropped);
            self.next_at[reason as usize] = now.plus_ms(REPEAT_MS);
        }
    }
}
