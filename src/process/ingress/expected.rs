//! Wakes critical lanes before ingress has finished receiving a sample, at most once for each sample.
//!
//! The receiving thread or the lookout wakes the lanes; the receiving thread takes the samples and counts its
//! turns.

use std::sync::atomic::{AtomicU64, Ordering};

/// The most bytes of a fragmented sample that may be missing when the lanes are woken. A fragment of 64 KiB
/// takes some 30 µs, about as long as a lane takes to wake up; a woken lane does not stay awake for more.
const LEFT_BYTES: usize = 64 << 10;
/// Turns within which the missing fragments must arrive: one for each datagram, and the smallest fragments
/// that publishers choose by default have 1.3 KB.
const TURNS: u64 = 64;
/// The same for a whole sample: its own turn, and one that was under way when the lookout woke the lanes.
const TURNS_WHOLE: u64 = 1;

const NONE: u64 = u64::MAX;
const IN_VAIN: u64 = u64::MAX - 1;
/// Below the route's number are the turns that are left.
const ROUTE_SHIFT: u32 = 32;

/// The route whose lanes were woken for a sample that is not taken yet.
pub(super) struct Expected {
    /// The route and the turns that are left; [`NONE`]; or [`IN_VAIN`] if the lanes were woken and no sample
    /// followed. Any thread may replace `NONE` with a route; only the receiving thread changes a route.
    told: AtomicU64,
}

impl Expected {
    pub fn new() -> Self {
        Self { told: AtomicU64::new(NONE) }
    }

    /// Whether [`tell`](Self::tell) would return true, unless another thread calls it first.
    pub fn may_tell(&self, left_bytes: usize) -> bool {
        left_bytes <= LEFT_BYTES && self.told.load(Ordering::Relaxed) == NONE
    }

    /// Claims the early wake-up of the lanes of `route`, for a sample of which `left_bytes` are missing.
    /// Returns whether the caller may wake them. The next claim succeeds only after a sample of a critical
    /// route was taken, so that datagrams that only look like samples do not wake lanes repeatedly.
    pub fn tell(&self, route: usize, left_bytes: usize) -> bool {
        if left_bytes > LEFT_BYTES {
            return false;
        }
        let turns = if left_bytes == 0 { TURNS_WHOLE } else { TURNS };
        let told = ((route as u64) << ROUTE_SHIFT) | turns;
        self.told.compare_exchange(NONE, told, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    /// Ends the claim, as `route` has a sample to take. Returns whether its lanes still have to be woken.
    pub fn came(&self, route: usize) -> bool {
        self.told.swap(NONE, Ordering::AcqRel) >> ROUTE_SHIFT != route as u64
    }

    /// Ends a claim that the lookout made after [`came`](Self::came) for a sample that has been taken by now.
    pub fn came_meanwhile(&self, route: usize) {
        if self.told.load(Ordering::Relaxed) >> ROUTE_SHIFT == route as u64 {
            self.told.store(NONE, Ordering::Release);
        }
    }

    /// Counts a turn. If the sample does not arrive within the allowed turns, it may never arrive; the lanes,
    /// which sleep again by then, are woken when the next sample is taken.
    pub fn turn_ends(&self) {
        let told = self.told.load(Ordering::Relaxed);
        if told == NONE || told == IN_VAIN {
            return;
        }
        let turns_left = told & ((1 << ROUTE_SHIFT) - 1);
        let then = if turns_left > 0 { told - 1 } else { IN_VAIN };
        self.told.store(then, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_that_the_lanes_were_told_of_is_not_announced_again() {
        let expected = Expected::new();
        for _ in 0..3 {
            assert!(expected.tell(7, 0));
            assert!(!expected.tell(7, 0), "told already");
            assert!(!expected.came(7));
            expected.turn_ends();
        }
        assert!(expected.came(7), "nobody told of this one");
        assert!(expected.tell(7, 0));
        assert!(expected.came(8), "told of another route");
        assert!(expected.tell(0, 0) && !expected.came(0));
    }

    #[test]
    fn what_never_becomes_a_sample_is_told_of_once() {
        let expected = Expected::new();
        assert!(expected.tell(7, 0));
        for _ in 0..=TURNS_WHOLE {
            expected.turn_ends();
        }
        for _ in 0..100 {
            assert!(!expected.tell(7, 0));
            expected.turn_ends();
        }
        assert!(expected.came(7), "the lanes sleep again by then");
        expected.turn_ends();
        assert!(expected.tell(7, 0));
    }

    #[test]
    fn the_lookout_may_tell_while_another_datagram_has_its_turn() {
        let expected = Expected::new();
        assert!(expected.tell(7, 0));
        expected.turn_ends();
        assert!(!expected.came(7), "told of, and up");
        assert!(expected.tell(7, 0), "of the same one, while it is taken");
        expected.came_meanwhile(8);
        assert!(!expected.tell(7, 0), "another route has nothing to do with it");
        expected.came_meanwhile(7);
        assert!(expected.may_tell(0) && expected.tell(7, 0) && !expected.may_tell(0));
    }

    #[test]
    fn the_rest_of_a_sample_in_fragments_has_some_turns_to_come() {
        let expected = Expected::new();
        assert!(!expected.may_tell(LEFT_BYTES + 1) && !expected.tell(7, LEFT_BYTES + 1));
        assert!(expected.tell(7, LEFT_BYTES));
        for _ in 0..TURNS {
            expected.turn_ends();
            assert!(!expected.tell(7, LEFT_BYTES));
        }
        assert!(!expected.came(7), "in time");
        assert!(expected.tell(7, LEFT_BYTES));
        for _ in 0..=TURNS {
            expected.turn_ends();
        }
        assert!(expected.came(7), "too late");
    }
}
