//! Which samples of a route wait in a noncritical lane, and which give way.

use std::collections::VecDeque;

use super::staleness::{age_ns, is_stale};
use crate::model::{DropPolicy, DropReason, MonotonicNs, SampleHeader, SourceTimestamp, WallNs};

/// What the queue knows of a sample; it never looks at the sample itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamps {
    /// The sample's number on its route.
    pub sequence: u64,
    /// The publisher's DDS source timestamp, unless its clock disagrees with ours.
    pub source_timestamp: SourceTimestamp,
    /// When ingress took the sample, less its lateness; stands in for a source timestamp that is missing or
    /// can't be trusted.
    pub taken_at: MonotonicNs,
    /// Size of the serialized payload.
    pub bytes: u64,
}

impl Stamps {
    /// The stamps of a sample with that header and a payload of `bytes`.
    pub const fn new(header: &SampleHeader, bytes: u64) -> Self {
        Self {
            sequence: header.sequence,
            source_timestamp: header.age_source(),
            taken_at: header.age_from(),
            bytes,
        }
    }
}

/// What may be sent at one instant, and what is too old for it.
#[derive(Clone, Copy, Debug)]
pub struct Allowance {
    /// The instant.
    pub now: MonotonicNs,
    /// The same instant on the wall clock, against which source timestamps are held.
    pub now_wall: WallNs,
    /// Whole tokens there; 0 sends nothing.
    pub tokens: u64,
    /// Bytes that may be sent without debt. The last sample sent may exceed them.
    pub bytes: u64,
    /// A sample older than this is dropped; 0 never.
    pub stale_threshold_ms: u64,
}

impl Allowance {
    fn is_stale(&self, stamps: &Stamps) -> bool {
        let age_ns = age_ns(stamps.source_timestamp, stamps.taken_at, self.now, self.now_wall);
        is_stale(age_ns, self.stale_threshold_ms)
    }
}

/// The bounded waiting room of one route on a noncritical lane.
///
/// Samples are offered in the order of their sequence, and leave in that order: sent, or dropped and handed
/// to the caller's `on_drop` with the reason. Nothing else removes a sample, so that
/// offered = sent + dropped + waiting, always. It allocates when made, when given another capacity, and else
/// never.
#[derive(Debug)]
pub struct LaneQueue<T> {
    /// Oldest in front.
    waiting: VecDeque<(T, Stamps)>,
    capacity: usize,
    limit: usize,
    policy: DropPolicy,
}

impl<T> LaneQueue<T> {
    /// An empty queue with room for `capacity` samples (at least 1), all of which it uses.
    pub fn new(policy: DropPolicy, capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self { waiting: VecDeque::with_capacity(capacity), capacity, limit: capacity, policy }
    }

    /// Samples waiting.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Whether no sample waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Makes room for `capacity` samples (at least 1). The limit stays until [`LaneQueue::set_policy`] sets
    /// another; so what waits is not touched.
    pub fn set_capacity(&mut self, capacity: usize) {
        self.capacity = capacity.max(1);
        self.waiting.reserve(self.capacity.saturating_sub(self.waiting.len()));
    }

    /// Applies another policy and lets at most `limit` samples wait, which is held to 1 to the capacity.
    /// Those that have no place any more give way as the new policy has it.
    pub fn set_policy(
        &mut self,
        policy: DropPolicy,
        limit: usize,
        mut on_drop: impl FnMut(T, Stamps, DropReason),
    ) {
        self.policy = policy;
        self.limit = limit.clamp(1, self.capacity);
        while self.waiting.len() > self.limit {
            self.give_way(&mut on_drop);
        }
    }

    /// Takes in a sample. When the queue is full, one gives way: with `DropOldest` the oldest as superseded,
    /// with `DropStale` the oldest and with `DropLatest` this one as queue full.
    pub fn offer(&mut self, item: T, stamps: Stamps, mut on_drop: impl FnMut(T, Stamps, DropReason)) {
        if self.waiting.len() >= self.limit {
            if self.policy == DropPolicy::DropLatest {
                on_drop(item, stamps, DropReason::QueueFull);
                return;
            }
            self.give_way(&mut on_drop);
        }
        self.waiting.push_back((item, stamps));
    }

    /// The sample to send next, or `None` when there is none that may be sent.
    ///
    /// - `DropOldest`: as many of the freshest as the allowance pays for remain, and all older ones are
    ///   dropped as superseded; of those that remain the oldest is returned, so that order is kept. With one
    ///   token, the usual case, that is the freshest. More tokens are there only when the lane was late by
    ///   more than the interval of the rate, and then each of them sends a sample: otherwise a lane of 1 kHz
    ///   that wakes every 2 ms would send 500 Hz.
    /// - `DropLatest`: the oldest.
    /// - `DropStale`: all stale ones are dropped, then the oldest is returned.
    ///
    /// A stale sample is never returned: it is dropped as stale and the next one tried.
    pub fn take(
        &mut self,
        allowance: &Allowance,
        mut on_drop: impl FnMut(T, Stamps, DropReason),
    ) -> Option<(T, Stamps)> {
        if allowance.tokens == 0 {
            return None;
        }
        match self.policy {
            DropPolicy::DropOldest => self.supersede(allowance, &mut on_drop),
            DropPolicy::DropLatest => {}
            DropPolicy::DropStale => self.drop_stale(allowance, &mut on_drop),
        }
        while let Some((item, stamps)) = self.waiting.pop_front() {
            if !allowance.is_stale(&stamps) {
                return Some((item, stamps));
            }
            on_drop(item, stamps, DropReason::Stale);
        }
        None
    }

    /// Drops every waiting sample for `reason`.
    pub fn clear(&mut self, reason: DropReason, mut on_drop: impl FnMut(T, Stamps, DropReason)) {
        while let Some((item, stamps)) = self.waiting.pop_front() {
            on_drop(item, stamps, reason);
        }
    }

    fn give_way(&mut self, on_drop: &mut impl FnMut(T, Stamps, DropReason)) {
        let (leaving, reason) = match self.policy {
            DropPolicy::DropOldest => (self.waiting.pop_front(), DropReason::Superseded),
            DropPolicy::DropStale => (self.waiting.pop_front(), DropReason::QueueFull),
            DropPolicy::DropLatest => (self.waiting.pop_back(), DropReason::QueueFull),
        };
        if let Some((item, stamps)) = leaving {
            on_drop(item, stamps, reason);
        }
    }

    /// Keeps the freshest samples that the allowance pays for, and drops all that are older.
    fn supersede(&mut self, allowance: &Allowance, on_drop: &mut impl FnMut(T, Stamps, DropReason)) {
        let mut kept = 0;
        let mut older_bytes = 0_u64;
        let mut oldest_kept = self.waiting.len();
        for (index, (_, stamps)) in self.waiting.iter().enumerate().rev() {
            if allowance.is_stale(stamps) {
                continue;
            }
            // The freshest goes last and may make debt, so that only what goes before it must be paid for.
            if kept > 0 {
                older_bytes = older_bytes.saturating_add(stamps.bytes);
                if older_bytes > allowance.bytes {
                    break;
                }
            }
            oldest_kept = index;
            kept += 1;
            if kept == allowance.tokens {
                break;
            }
        }
        if kept == 0 {
            return;
        }
        for (item, stamps) in self.waiting.drain(..oldest_kept) {
            on_drop(item, stamps, DropReason::Superseded);
        }
    }

    /// Publishers of one topic have clocks of their own, so a stale sample may stand behind a fresh one.
    fn drop_stale(&mut self, allowance: &Allowance, on_drop: &mut impl FnMut(T, Stamps, DropReason)) {
        for _ in 0..self.waiting.len() {
            let Some((item, stamps)) = self.waiting.pop_front() else { return };
            if allowance.is_stale(&stamps) {
                on_drop(item, stamps, DropReason::Stale);
            } else {
                // Takes the place just vacated: never grows.
                self.waiting.push_back((item, stamps));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW_MS: u64 = 10_000;

    fn stamps(sequence: u64, age_ms: u64) -> Stamps {
        let taken_at = MonotonicNs((NOW_MS - age_ms) * 1_000_000);
        Stamps { sequence, source_timestamp: SourceTimestamp::NONE, taken_at, bytes: 100 }
    }

    fn allowance(tokens: u64) -> Allowance {
        let now = MonotonicNs(NOW_MS * 1_000_000);
        Allowance { now, now_wall: WallNs(0), tokens, bytes: u64::MAX, stale_threshold_ms: 200 }
    }

    /// A queue of three in which samples 1, 2, … of those ages were offered, and what was dropped.
    struct Bench {
        queue: LaneQueue<u64>,
        dropped: Vec<(u64, DropReason)>,
    }

    impl Bench {
        fn new(policy: DropPolicy, ages_ms: &[u64]) -> Self {
            let mut bench = Self { queue: LaneQueue::new(policy, 3), dropped: Vec::new() };
            for (sequence, &age_ms) in (1..).zip(ages_ms) {
                let dropped = &mut bench.dropped;
                bench.queue.offer(sequence, stamps(sequence, age_ms), |item, _, reason| {
                    dropped.push((item, reason));
                });
            }
            bench
        }

        fn take(&mut self, allowance: &Allowance) -> Option<u64> {
            let dropped = &mut self.dropped;
            let taken = self.queue.take(allowance, |item, _, reason| dropped.push((item, reason)));
            taken.map(|(item, stamps)| {
                assert_eq!(item, stamps.sequence);
                item
            })
        }
    }

    use DropReason::{QueueFull, Stale, Superseded};

    #[test]
    fn drop_oldest_sends_the_freshest_and_supersedes_the_others() {
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&allowance(1)), Some(3));
        assert_eq!(bench.dropped, [(1, Superseded), (2, Superseded)]);
        assert!(bench.queue.is_empty());
    }

    #[test]
    fn drop_oldest_sends_one_sample_for_each_token_in_order() {
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&allowance(2)), Some(2));
        assert_eq!(bench.take(&allowance(1)), Some(3));
        assert_eq!(bench.dropped, [(1, Superseded)]);
    }

    #[test]
    fn drop_oldest_sends_the_freshest_when_bytes_pay_for_one_only() {
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&Allowance { bytes: 99, ..allowance(3) }), Some(3));
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&Allowance { bytes: 100, ..allowance(3) }), Some(2));
    }

    #[test]
    fn drop_oldest_overflows_at_the_old_end() {
        let bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30, 20, 10]);
        assert_eq!(bench.dropped, [(1, Superseded), (2, Superseded)]);
        assert_eq!(bench.queue.len(), 3);
    }

    #[test]
    fn drop_oldest_passes_over_a_stale_sample_to_the_next_freshest() {
        // The third is from a publisher whose clock is behind.
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 900]);
        assert_eq!(bench.take(&allowance(1)), Some(2));
        assert_eq!(bench.dropped, [(1, Superseded)]);
        assert_eq!(bench.take(&allowance(1)), None);
        assert_eq!(bench.dropped, [(1, Superseded), (3, Stale)]);
    }

    #[test]
    fn a_queue_of_stale_samples_sends_none_under_any_policy() {
        for policy in [DropPolicy::DropOldest, DropPolicy::DropLatest, DropPolicy::DropStale] {
            let mut bench = Bench::new(policy, &[500, 400, 201]);
            assert_eq!(bench.take(&allowance(1)), None);
            assert_eq!(bench.dropped, [(1, Stale), (2, Stale), (3, Stale)], "{policy:?}");
        }
    }

    #[test]
    fn drop_latest_is_first_in_first_out_and_refuses_what_has_no_place() {
        let mut bench = Bench::new(DropPolicy::DropLatest, &[90, 60, 30, 20]);
        assert_eq!(bench.dropped, [(4, QueueFull)]);
        assert_eq!(bench.take(&allowance(1)), Some(1));
        assert_eq!(bench.take(&allowance(9)), Some(2));
    }

    #[test]
    fn drop_latest_drops_a_stale_head_and_tries_the_next() {
        let mut bench = Bench::new(DropPolicy::DropLatest, &[300, 60, 300]);
        assert_eq!(bench.take(&allowance(1)), Some(2));
        assert_eq!(bench.dropped, [(1, Stale)]);
    }

    #[test]
    fn drop_stale_drops_every_stale_one_first_and_then_sends_the_oldest() {
        let mut bench = Bench::new(DropPolicy::DropStale, &[60, 300, 30]);
        assert_eq!(bench.take(&allowance(1)), Some(1));
        assert_eq!(bench.dropped, [(2, Stale)]);
        assert_eq!(bench.take(&allowance(1)), Some(3));
    }

    #[test]
    fn drop_stale_overflows_at_the_old_end() {
        let bench = Bench::new(DropPolicy::DropStale, &[90, 60, 30, 20]);
        assert_eq!(bench.dropped, [(1, QueueFull)]);
    }

    #[test]
    fn without_a_token_nothing_moves() {
        for policy in [DropPolicy::DropOldest, DropPolicy::DropLatest, DropPolicy::DropStale] {
            let mut bench = Bench::new(policy, &[500, 60, 30]);
            assert_eq!(bench.take(&allowance(0)), None);
            assert_eq!((bench.queue.len(), bench.dropped.len()), (3, 0));
        }
    }

    #[test]
    fn a_lower_limit_makes_samples_give_way_as_the_new_policy_has_it() {
        let cases = [
            (DropPolicy::DropOldest, [(1, Superseded), (2, Superseded)]),
            (DropPolicy::DropStale, [(1, QueueFull), (2, QueueFull)]),
            (DropPolicy::DropLatest, [(3, QueueFull), (2, QueueFull)]),
        ];
        for (policy, expected) in cases {
            let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
            let dropped = &mut bench.dropped;
            bench.queue.set_policy(policy, 0, |item, _, reason| dropped.push((item, reason)));
            assert_eq!(bench.dropped, expected, "{policy:?}");
            assert_eq!(bench.queue.len(), 1);
        }
    }

    #[test]
    fn the_queue_never_outgrows_the_room_it_was_made_with() {
        let mut queue = LaneQueue::new(DropPolicy::DropStale, 4);
        let room = queue.waiting.capacity();
        queue.set_policy(DropPolicy::DropStale, usize::MAX, |_: u64, _, _| {});
        for sequence in 1..1_000 {
            queue.offer(sequence, stamps(sequence, sequence % 300), |_, _, _| {});
            if sequence % 3 == 0 {
                queue.take(&allowance(1), |_, _, _| {});
            }
        }
        assert!(queue.len() <= 4);
        assert_eq!(queue.waiting.capacity(), room);
    }
}
