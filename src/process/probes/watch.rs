//! Refusals in the log: each reason with its count, and not more often than an operator can read.

use tracing::warn;

use crate::model::{MonotonicNs, ProbeRefusal, RefusalCounts};

/// A reason is logged at once when it is new, and at most every 10 s while it goes on.
const REPEAT_MS: u64 = 10_000;

/// Watches the counts of what was refused, or of what a permissive trust mode accepted all the same.
#[derive(Debug)]
pub struct RefusalWatch {
    logged: [u64; ProbeRefusal::COUNT],
    next_at: [MonotonicNs; ProbeRefusal::COUNT],
    what: &'static str,
}

impl RefusalWatch {
    /// Of messages that were refused.
    pub fn of_refused() -> Self {
        Self::new("probe messages refused")
    }

    /// Of messages that were accepted although they do not authenticate.
    pub fn of_accepted() -> Self {
        Self::new("probe messages accepted that do not authenticate (security.trust_mode: permissive)")
    }

    fn new(what: &'static str) -> Self {
        let next_at = [MonotonicNs(0); ProbeRefusal::COUNT];
        Self { logged: [0; ProbeRefusal::COUNT], next_at, what }
    }

    /// Logs what is new in `counts`.
    pub fn look(&mut self, counts: &RefusalCounts, now: MonotonicNs) {
        for (reason, count) in counts.iter() {
            let index = reason as usize;
            let new = count.saturating_sub(self.logged[index]);
            if new == 0 || now < self.next_at[index] {
                continue;
            }
            warn!(reason = reason.label(), count = new, "{}: {}", self.what, reason.meaning());
            self.logged[index] = count;
            self.next_at[index] = now.plus_ms(REPEAT_MS);
        }
    }
}
