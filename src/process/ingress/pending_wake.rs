//! Wakes critical lanes before ingress has finished receiving a sample, at most once for each sample.
//!
//! The receiving thread or the early waker wakes the lanes; the receiving thread takes the samples
//! and counts its turns.

use std::sync::atomic::{AtomicU64, Ordering};

/// The most bytes of a fragmented sample that may be missing when the lanes are woken. A fragment of 64 KiB
/// takes some 30 µs, about as long as a lane takes to wake up; a woken lane does not stay awake for more.
const LEFT_BYTES: usize = 64 << 10;
/// Turns within which the missing fragments must arrive: one for each datagram, and the smallest fragments
/// that publishers choose by default have 1.3 KB.
const TURNS: u64 = 64;
/// The same for a whole sample: its own turn, and one that was under way when the early waker woke the lanes.
const TURNS_WHOLE: u64 = 1;

const NONE: u64 = u64::MAX;
const IN_VAIN: u64 = u64::MAX - 1;
/// Below the route's number are the turns that are left.
const ROUTE_SHIFT: u32 = 32;

/// The route whose lanes were woken for a sample that is not taken yet.
pub(super) struct PendingWake {
    /// The route and the turns that are left; [`NONE`]; or [`IN_VAIN`] if the lanes were woken and no sample
    /// followed. Any thread may replace `NONE` with a route; only the receiving thread changes a route.
    state: AtomicU64,
}

impl PendingWake {
    pub fn new() -> Self {
        Self { state: AtomicU64::new(NONE) }
    }

    /// Whether [`claim`](Self::claim) would return true, unless another thread calls it first.
    pub fn may_claim(&self, left_bytes: usize) -> bool {
        left_bytes <= LEFT_BYTES && self.state.load(Ordering::Relaxed) == NONE
    }

    /// Claims the early wake-up of the lanes of `route`, for a sample of which `left_bytes` are missing.
    /// Returns whether the caller may wake them. The next claim succeeds only after a sample of a critical
    /// route was taken, so that datagrams that only look like samples do not wake lanes repeatedly.
    pub fn claim(&self, route: usize, left_bytes: usize) -> bool {
        if left_bytes > LEFT_BYTES {
            return false;
        }
        let turns = if left_bytes == 0 { TURNS_WHOLE } else { TURNS };
        let state = ((route as u64) << ROUTE_SHIFT) | turns;
        self.state.compare_exchange(NONE, state, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    /// Ends the claim, as `route` has a sample to take. Returns whether its lanes still have to be woken.
    pub fn take_pending(&self, route: usize) -> bool {
        self.state.swap(NONE, Ordering::AcqRel) >> ROUTE_SHIFT != route as u64
    }

    /// Ends a claim that the early waker made after [`take_pending`](Self::take_pending) for a sample that
    /// has been taken by now.
    pub fn end_late_claim(&self, route: usize) {
        if self.state.load(Ordering::Relaxed) >> ROUTE_SHIFT == route as u64 {
            self.state.store(NONE, Ordering::Release);
        }
    }

    /// Counts a turn. If the sample does not arrive within the allowed turns, it may never arrive; the lanes,
    /// which sleep again by then, are woken when the next sample is taken.
    pub fn count_turn(&self) {
        let state = self.state.load(Ordering::Relaxed);
        if state == NONE || state == IN_VAIN {
            return;
        }
        let turns_left = state & ((1 << ROUTE_SHIFT) - 1);
        let then = if turns_left > 0 { state - 1 } else { IN_VAIN };
        self.state.store(then, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_claimed_wake_up_is_not_repeated() {
        let pending = PendingWake::new();
        for _ in 0..3 {
            assert!(pending.claim(7, 0));
            assert!(!pending.claim(7, 0), "claimed already");
            assert!(!pending.take_pending(7));
            pending.count_turn();
        }
        assert!(pending.take_pending(7), "no claim");
        assert!(pending.claim(7, 0));
        assert!(pending.take_pending(8), "the claim is of another route");
        assert!(pending.claim(0, 0) && !pending.take_pending(0));
    }

    #[test]
    fn a_datagram_that_becomes_no_sample_wakes_once() {
        let pending = PendingWake::new();
        assert!(pending.claim(7, 0));
        for _ in 0..=TURNS_WHOLE {
            pending.count_turn();
        }
        for _ in 0..100 {
            assert!(!pending.claim(7, 0));
            pending.count_turn();
        }
        assert!(pending.take_pending(7), "the lanes sleep again by then");
        pending.count_turn();
        assert!(pending.claim(7, 0));
    }

    #[test]
    fn the_early_waker_may_claim_during_a_turn() {
        let pending = PendingWake::new();
        assert!(pending.claim(7, 0));
        pending.count_turn();
        assert!(!pending.take_pending(7), "claimed, and awake");
        assert!(pending.claim(7, 0), "the same sample, while it is taken");
        pending.end_late_claim(8);
        assert!(!pending.claim(7, 0), "the claim is not of route 8");
        pending.end_late_claim(7);
        assert!(pending.may_claim(0) && pending.claim(7, 0) && !pending.may_claim(0));
    }

    #[test]
    fn the_missing_fragments_may_take_64_turns() {
        let pending = PendingWake::new();
        assert!(!pending.may_claim(LEFT_BYTES + 1) && !pending.claim(7, LEFT_BYTES + 1));
        assert!(pending.claim(7, LEFT_BYTES));
        for _ in 0..TURNS {
            pending.count_turn();
            assert!(!pending.claim(7, LEFT_BYTES));
        }
        assert!(!pending.take_pending(7), "in time");
        assert!(pending.claim(7, LEFT_BYTES));
        for _ in 0..=TURNS {
            pending.count_turn();
        }
        assert!(pending.take_pending(7), "too late");
    }
}
