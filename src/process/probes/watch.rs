//! Log messages about refused probe messages: each reason with its count, at a limited rate.

use tracing::warn;

use crate::model::{MonotonicNs, ProbeRefusal, RefusalCounts};

/// Minimum time between two log messages with the same reason; the first one is logged at once.
const REPEAT_MS: u64 = 10_000;

/// Logs increases of the counts of refused messages, or of messages that only trust mode `permissive`
/// accepted.
#[derive(Debug)]
pub struct RefusalLog {
    logged: [u64; ProbeRefusal::COUNT],
    next_at: [MonotonicNs; ProbeRefusal::COUNT],
    subject: &'static str,
}

impl RefusalLog {
    /// A log of refused messages.
    pub fn of_refused() -> Self {
        Self::new("probe messages refused")
    }

    /// A log of messages that were accepted although they are not authentic.
    pub fn of_accepted() -> Self {
        Self::new("unauthenticated probe messages accepted (security.trust_mode: permissive)")
    }

    fn new(subject: &'static str) -> Self {
        let next_at = [MonotonicNs(0); ProbeRefusal::COUNT];
        Self { logged: [0; ProbeRefusal::COUNT], next_at, subject }
    }

    /// Logs the increases of `counts` since they were last logged.
    pub fn log_new(&mut self, counts: &RefusalCounts, now: MonotonicNs) {
        for (reason, count) in counts.iter() {
            let index = reason as usize;
            let new = count.saturating_sub(self.logged[index]);
            if new == 0 || now < self.next_at[index] {
                continue;
            }
            warn!(reason = reason.label(), count = new, "{}: {}", self.subject, reason.meaning());
            self.logged[index] = count;
            self.next_at[index] = now.plus_ms(REPEAT_MS);
        }
    }
}
