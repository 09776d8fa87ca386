//! Logs counts of dropped samples and refused messages by reason, rate-limited so that an operator can read
//! the log.

use tracing::warn;

use crate::model::{Counts, DropCounts, DropReason, MonotonicNs, ProbeRefusal, Reason, RefusalCounts};

/// Shortest interval between two log lines of the same reason. The first increase is logged at once.
const REPEAT_MS: u64 = 10_000;

#[derive(Debug)]
pub(super) struct CountLog<R, const N: usize> {
    logged: Counts<R, N>,
    next_at: [MonotonicNs; N],
}

/// Logs the new drops of one route in one process.
pub(super) type DropLog = CountLog<DropReason, { DropReason::COUNT }>;

/// Logs refused probe messages, or those that only trust mode `permissive` accepted.
pub(super) type RefusalLog = CountLog<ProbeRefusal, { ProbeRefusal::COUNT }>;

impl<R: Reason, const N: usize> CountLog<R, N> {
    /// Starts at `counts`, so that the counts of the former process are not logged again.
    pub fn new(counts: Counts<R, N>) -> Self {
        Self { logged: counts, next_at: [MonotonicNs(0); N] }
    }

    /// Calls `log` with each reason that is due, and its increase since it was last logged.
    fn log_new(&mut self, counts: &Counts<R, N>, now: MonotonicNs, mut log: impl FnMut(R, u64)) {
        for (reason, new) in counts.since(&self.logged).iter() {
            let next_at = &mut self.next_at[reason.index()];
            if now >= *next_at {
                log(reason, new);
                self.logged.add(reason, new);
                *next_at = now.plus_ms(REPEAT_MS);
            }
        }
    }
}

impl DropLog {
    /// Logs the drops in `counts` that were not logged yet and that are not `expected`.
    pub fn log_drops(
        &mut self,
        counts: &DropCounts,
        route: &str,
        lane: &str,
        expected: impl Fn(DropReason) -> bool,
        now: MonotonicNs,
    ) {
        self.log_new(counts, now, |reason, dropped| {
            if !expected(reason) {
                warn!(route, lane, reason = reason.label(), dropped, "samples dropped: {}", reason.meaning());
            }
        });
    }
}

impl RefusalLog {
    /// Logs the refused messages in `counts` that were not logged yet.
    pub fn log_refused(&mut self, counts: &RefusalCounts, now: MonotonicNs) {
        self.log_new(counts, now, |reason, count| {
            warn!(reason = reason.label(), count, "probe messages refused: {}", reason.meaning());
        });
    }

    /// Logs the messages in `counts` that were accepted although they are not authentic, if not logged yet.
    pub fn log_accepted(&mut self, counts: &RefusalCounts, now: MonotonicNs) {
        self.log_new(counts, now, |reason, count| {
            warn!(
                reason = reason.label(),
                count,
                "unauthenticated probe messages accepted (security.trust_mode: permissive): {}",
                reason.meaning()
            );
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_reason_is_logged_at_once_and_then_every_ten_seconds() {
        let mut counts = DropCounts::default();
        counts.add(DropReason::Stale, 5);
        let mut log = DropLog::new(counts);
        let mut logged_at = |ms, counts: &DropCounts| {
            let mut logged = Vec::new();
            log.log_new(counts, MonotonicNs(0).plus_ms(ms), |reason, new| logged.push((reason, new)));
            logged
        };
        assert_eq!(logged_at(1, &counts), []);
        counts.add(DropReason::Stale, 1);
        assert_eq!(logged_at(2, &counts), [(DropReason::Stale, 1)]);
        counts.add(DropReason::Stale, 2);
        counts.add(DropReason::TooLarge, 1);
        assert_eq!(logged_at(10_001, &counts), [(DropReason::TooLarge, 1)]);
        assert_eq!(logged_at(10_002, &counts), [(DropReason::Stale, 2)]);
    }
}
