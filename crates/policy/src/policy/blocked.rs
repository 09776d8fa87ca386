//! When a thread of an active process is blocked although it has work.

use crate::model::MonotonicNs;

/// Finds a thread that sleeps although it has work, such as in a deadlock.
#[derive(Clone, Copy, Debug)]
pub struct BlockedWatch {
    max_step_ns: u64,
    checked_at: MonotonicNs,
    /// The last check since which it has had work and has not run.
    since: Option<MonotonicNs>,
}

impl BlockedWatch {
    /// For checks that are `interval_ms` apart.
    pub const fn new(interval_ms: u64) -> Self {
        Self { max_step_ns: 3 * interval_ms * 1_000_000, checked_at: MonotonicNs(0), since: None }
    }

    /// Whether the thread has had work for `limit_ms` and has not run. `has_run` says that it has run since
    /// the last check, or is ready to; it matters only if the thread has work, now and at the last check. A
    /// check that is more than two intervals late does not count, because other programs use the CPUs.
    pub fn is_blocked(&mut self, has_work: bool, has_run: bool, limit_ms: u64, now: MonotonicNs) -> bool {
        let step_ns = now.since(core::mem::replace(&mut self.checked_at, now));
        if has_run || step_ns > self.max_step_ns {
            self.since = None;
        }
        self.since = has_work.then(|| self.since.unwrap_or(now));
        self.since.is_some_and(|since| now.since(since) >= limit_ms * 1_000_000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    #[test]
    fn a_thread_is_blocked_once_it_has_had_work_for_the_limit_and_has_not_run() {
        let mut watch = BlockedWatch::new(6);
        assert!(!watch.is_blocked(true, false, 12, at(6_000)), "nothing to compare with");
        assert!(!watch.is_blocked(true, false, 12, at(6_006)));
        assert!(watch.is_blocked(true, false, 12, at(6_012)));
        assert!(watch.is_blocked(true, false, 12, at(6_024)), "it still is");
        assert!(!watch.is_blocked(true, false, 36, at(6_030)), "with a longer limit");

        assert!(!watch.is_blocked(true, true, 12, at(6_036)), "it has run");
        assert!(!watch.is_blocked(true, false, 12, at(6_042)));
        assert!(!watch.is_blocked(false, false, 12, at(6_048)), "it has no work");
        assert!(!watch.is_blocked(true, false, 12, at(6_054)));
        assert!(!watch.is_blocked(true, false, 12, at(6_060)));
        assert!(watch.is_blocked(true, false, 12, at(6_066)));
    }

    #[test]
    fn late_checks_do_not_count() {
        let mut watch = BlockedWatch::new(6);
        for ms in (6_000..60_000).step_by(19) {
            assert!(!watch.is_blocked(true, false, 12, at(ms)), "{ms}");
        }
    }
}
