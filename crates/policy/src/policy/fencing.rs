//! When a standby kills an active process that is stopped.

use crate::model::MonotonicNs;

/// The shortest time between two take-overs that a standby causes. A process that has taken an identity over
/// leaves none if it ends within a second.
const PAUSE_MS: u64 = 1_500;

/// Whether a standby may kill a process that is stopped, `now`, when its role was last taken over at
/// `taken_over_at` (0: never). A program that stops each process causes at most 40 take-overs a minute.
pub const fn may_fence(taken_over_at: MonotonicNs, now: MonotonicNs) -> bool {
    taken_over_at.0 == 0 || now.since(taken_over_at) >= PAUSE_MS * 1_000_000
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stopped_process_is_not_killed_soon_after_a_take_over() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        assert!(may_fence(MonotonicNs(0), at(1)));
        assert!(!may_fence(at(1), at(1_500)));
        assert!(may_fence(at(1), at(1_501)));
    }
}
