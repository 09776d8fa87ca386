//! Drops in the log: each reason with its count, and not more often than an operator can read.

use tracing::warn;

use crate::model::{DropCounts, DropReason, MonotonicNs};

/// A reason is logged at once when it is new, and at most every 10 s while it goes on.
const REPEAT_MS: u64 = 10_000;

/// Watches the drops of one route in one process.
#[derive(Debug)]
pub(super) struct DropWatch {
    logged: DropCounts,
    next_at: [MonotonicNs; DropReason::COUNT],
}

impl DropWatch {
    /// Begins at `counts`: what a former process dropped is not news.
    pub fn new(counts: DropCounts) -> Self {
        Self { logged: counts, next_at: [MonotonicNs(0); DropReason::COUNT] }
    }

    /// Logs what is new in `counts`. `expected` reasons are how the lane works and are not logged.
    pub fn look(
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
