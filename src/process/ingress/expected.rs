//! The sample that critical lanes get up for before it has been taken.
//!
//! The receiving thread alone asks and tells; the atomics are there because other threads hold it, too.

use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};

/// Of a sample in fragments, what may be yet to come when the lanes are told. A fragment of 64 KiB takes some
/// 30 µs, about as long as a lane takes to get up; more would be longer than a lane that is told stays up.
const LEFT_BYTES: usize = 64 << 10;
/// Turns until the rest of it must have come: one for each datagram, and the smallest fragments that
/// publishers send by themselves have 1.3 KB.
const TURNS: u32 = 64;

const NONE: usize = usize::MAX;
const IN_VAIN: usize = usize::MAX - 1;

/// Which route's lanes were told of a sample that is yet to be taken.
pub(super) struct Expected {
    /// The route; [`NONE`], or [`IN_VAIN`] when no sample came of what they were told.
    route: AtomicUsize,
    turns_left: AtomicU32,
}

impl Expected {
    pub fn new() -> Self {
        Self { route: AtomicUsize::new(NONE), turns_left: AtomicU32::new(0) }
    }

    /// Whether lanes may be told of a sample that misses `left_bytes` yet. Once told they are not told again
    /// before a sample has come, of whatever route: datagrams that only look like samples wake no lane again
    /// and again.
    pub fn may_tell(&self, left_bytes: usize) -> bool {
        left_bytes <= LEFT_BYTES && self.route.load(Ordering::Relaxed) == NONE
    }

    /// The lanes of `route` were told.
    pub fn told(&self, route: usize, left_bytes: usize) {
        self.route.store(route, Ordering::Relaxed);
        self.turns_left.store(if left_bytes == 0 { 0 } else { TURNS }, Ordering::Relaxed);
    }

    /// `route` has a sample to take; whether its lanes are yet to be told.
    pub fn came(&self, route: usize) -> bool {
        self.route.swap(NONE, Ordering::Relaxed) != route
    }

    /// A turn has taken what there was. What has not come by now may never come, and the lanes, which sleep
    /// again, are to be told when the next one is taken.
    pub fn turn_ends(&self) {
        let turns_left = self.turns_left.load(Ordering::Relaxed);
        if turns_left > 0 {
            self.turns_left.store(turns_left - 1, Ordering::Relaxed);
        } else if self.route.load(Ordering::Relaxed) != NONE {
            self.route.store(IN_VAIN, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_that_the_lanes_were_told_of_is_not_announced_again() {
        let expected = Expected::new();
        for _ in 0..3 {
            assert!(expected.may_tell(0));
            expected.told(7, 0);
            assert!(!expected.came(7));
            expected.turn_ends();
        }
        assert!(expected.came(7), "nobody told of this one");
        expected.told(7, 0);
        assert!(expected.came(8), "told of another route");
    }

    #[test]
    fn what_never_becomes_a_sample_is_told_of_once() {
        let expected = Expected::new();
        expected.told(7, 0);
        expected.turn_ends();
        for _ in 0..100 {
            assert!(!expected.may_tell(0));
            expected.turn_ends();
        }
        assert!(expected.came(7), "the lanes sleep again by then");
        expected.turn_ends();
        assert!(expected.may_tell(0));
    }

    #[test]
    fn the_rest_of_a_sample_in_fragments_has_some_turns_to_come() {
        let expected = Expected::new();
        assert!(!expected.may_tell(LEFT_BYTES + 1));
        assert!(expected.may_tell(LEFT_BYTES));
        expected.told(7, LEFT_BYTES);
        for _ in 0..TURNS {
            expected.turn_ends();
            assert!(!expected.may_tell(LEFT_BYTES));
        }
        assert!(!expected.came(7), "in time");
        expected.told(7, LEFT_BYTES);
        for _ in 0..=TURNS {
            expected.turn_ends();
        }
        assert!(expected.came(7), "too late");
    }
}
