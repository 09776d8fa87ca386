//! The sample that critical lanes get up for before it has been taken.
//!
//! The thread that receives takes samples and counts its turns; it or the lookout tells of them.

use std::sync::atomic::{AtomicU64, Ordering};

/// Of a sample in fragments, what may be yet to come when the lanes are told. A fragment of 64 KiB takes some
/// 30 µs, about as long as a lane takes to get up; more would be longer than a lane that is told stays up.
const LEFT_BYTES: usize = 64 << 10;
/// Turns until the rest of it must have come: one for each datagram, and the smallest fragments that
/// publishers send by themselves have 1.3 KB.
const TURNS: u64 = 64;
/// The same for a whole sample: the turn of its own, and one that was under way when the lookout told of it.
const TURNS_WHOLE: u64 = 1;

const NONE: u64 = u64::MAX;
const IN_VAIN: u64 = u64::MAX - 1;
/// Below the route's number are the turns that are left.
const ROUTE_SHIFT: u32 = 32;

/// Which route's lanes were told of a sample that is yet to be taken.
pub(super) struct Expected {
    /// The route and the turns that are left; [`NONE`], or [`IN_VAIN`] when no sample came of what they
    /// were told. Anybody may put a route where there is none; only the receiving thread changes one.
    told: AtomicU64,
}

impl Expected {
    pub fn new() -> Self {
        Self { told: AtomicU64::new(NONE) }
    }

    /// Whether [`tell`](Self::tell) would say yes, unless somebody is faster.
    pub fn may_tell(&self, left_bytes: usize) -> bool {
        left_bytes <= LEFT_BYTES && self.told.load(Ordering::Relaxed) == NONE
    }

    /// Whether the lanes of `route` may be told of a sample that misses `left_bytes` yet: then they were
    /// told, and are not told again before a sample has come, of whatever critical route: datagrams that only
    /// look like samples wake no lane again and again.
    pub fn tell(&self, route: usize, left_bytes: usize) -> bool {
        if left_bytes > LEFT_BYTES {
            return false;
        }
        let turns = if left_bytes == 0 { TURNS_WHOLE } else { TURNS };
        let told = ((route as u64) << ROUTE_SHIFT) | turns;
        self.told.compare_exchange(NONE, told, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    /// `route` has a sample to take; whether its lanes are yet to be told.
    pub fn came(&self, route: usize) -> bool {
        self.told.swap(NONE, Ordering::AcqRel) >> ROUTE_SHIFT != route as u64
    }

    /// What `route` had was taken; the lookout may have told of it after [`came`](Self::came).
    pub fn came_meanwhile(&self, route: usize) {
        if self.told.load(Ordering::Relaxed) >> ROUTE_SHIFT == route as u64 {
            self.told.store(NONE, Ordering::Release);
        }
    }

    /// A turn has taken what there was. What has not come by now may never come, and the lanes, which sleep
    /// again, are to be told when the next one is taken.
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
