//! The queue of one route in a noncritical lane: which samples wait, and which are dropped.

use alloc::collections::VecDeque;

use super::staleness::{age_ns, is_stale};
use crate::model::{DropPolicy, DropReason, MonotonicNs, SampleHeader, SampleKey, SourceTimestamp, WallNs};

/// The metadata by which the queue decides; it does not read the sample itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampleStamps {
    /// The sample's sequence number in its route.
    pub sequence: u64,
    /// The publisher's DDS source timestamp; none if the publisher's clock disagrees with this host's.
    pub source_timestamp: SourceTimestamp,
    /// The instant from which the age is measured without a source timestamp: when ingress took the sample,
    /// minus its age on arrival.
    pub taken_at: MonotonicNs,
    /// Size of the serialized payload.
    pub bytes: u64,
    /// What it says of its key.
    pub key: SampleKey,
}

impl SampleStamps {
    /// The stamps of a sample with that header and a payload of `bytes`.
    #[inline]
    pub const fn new(header: &SampleHeader, bytes: u64) -> Self {
        Self {
            sequence: header.sequence,
            source_timestamp: header.age_source(),
            taken_at: header.age_from(),
            bytes,
            key: header.key,
        }
    }

    /// Whether the sample has data that a newer sample of its key replaces. Samples without key hash count as
    /// of one key.
    fn is_superseded_by(&self, newer: &Self) -> bool {
        !self.key.is_end() && !newer.key.is_end() && self.key.hash() == newer.key.hash()
    }
}

/// What a lane may send at one instant, and the age from which samples are stale.
#[derive(Clone, Copy, Debug)]
pub struct Allowance {
    /// The instant on the monotonic clock.
    pub now: MonotonicNs,
    /// The instant `now` on the wall clock, for comparison with source timestamps.
    pub now_wall: WallNs,
    /// Whole tokens; with 0 nothing is sent.
    pub tokens: u64,
    /// Bytes that can be sent without debt. The last sample sent may exceed them.
    pub bytes: u64,
    /// A sample older than this is dropped as stale; 0 turns that off.
    pub stale_threshold_ms: u64,
}

impl Allowance {
    fn is_stale(&self, stamps: &SampleStamps) -> bool {
        // The end of a key is no value that becomes wrong with its age.
        if stamps.key.is_end() {
            return false;
        }
        let age_ns = age_ns(stamps.source_timestamp, stamps.taken_at, self.now, self.now_wall);
        is_stale(age_ns, self.stale_threshold_ms)
    }
}

/// The bounded queue of one route in a noncritical lane.
///
/// The caller offers samples in the order of their sequence numbers. Each is either sent or dropped, which
/// passes it to the caller's `on_drop` with the reason, so that offered = sent + dropped + waiting, always.
/// The queue allocates only on construction and when its capacity changes.
///
/// Samples of a topic with keys ([`SampleKey::is_keyed`]): with `DropOldest`, a newer sample takes the place
/// of the waiting one of its key, so that each key waits once and all take turns. A sample that disposes or
/// unregisters a key is neither superseded nor stale; it is dropped only from a queue that is full of such
/// samples, as queue full.
#[derive(Debug)]
pub struct LaneQueue<T> {
    /// The oldest is at the front.
    waiting: VecDeque<(T, SampleStamps)>,
    capacity: usize,
    limit: usize,
    policy: DropPolicy,
}

impl<T> LaneQueue<T> {
    /// An empty queue of `capacity` samples (at least 1), which is also its limit.
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

    /// Changes the capacity (at least 1). The limit and the waiting samples stay until
    /// [`LaneQueue::set_policy`] changes the limit.
    pub fn set_capacity(&mut self, capacity: usize) {
        self.capacity = capacity.max(1);
        self.waiting.reserve(self.capacity.saturating_sub(self.waiting.len()));
    }

    /// Applies another policy and limits the waiting samples to `limit`, clamped to 1 to the capacity. Drops
    /// samples above the limit according to the new policy.
    pub fn set_policy(
        &mut self,
        policy: DropPolicy,
        limit: usize,
        mut on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) {
        self.policy = policy;
        self.limit = limit.clamp(1, self.capacity);
        while self.waiting.len() > self.limit {
            self.drop_one(&mut on_drop);
        }
    }

    /// Adds a sample. When the queue is full, it drops one: with `DropOldest` the oldest as superseded, with
    /// `DropStale` the oldest and with `DropLatest` the new one as queue full.
    pub fn offer(
        &mut self,
        item: T,
        stamps: SampleStamps,
        mut on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) {
        // If one of two samples does not tell its key, they may have the same one: data does not pass the end
        // of such a key.
        let may_pass = |waiting: &SampleStamps| {
            waiting.key.hash() != stamps.key.hash()
                && !(waiting.key.is_end() && (waiting.key.hash().is_none() || stamps.key.hash().is_none()))
        };
        if stamps.key.is_keyed()
            && self.policy == DropPolicy::DropOldest
            && let Some(waiting) = self.waiting.iter_mut().rev().find(|(_, waiting)| !may_pass(waiting))
            && waiting.1.is_superseded_by(&stamps)
        {
            let (superseded, its_stamps) = core::mem::replace(waiting, (item, stamps));
            on_drop(superseded, its_stamps, DropReason::Superseded);
            return;
        }
        if self.waiting.len() >= self.limit {
            // An end of a key is not dropped for data.
            let only_ends = || self.waiting.iter().all(|(_, waiting)| waiting.key.is_end());
            if !stamps.key.is_end() && (self.policy == DropPolicy::DropLatest || only_ends()) {
                on_drop(item, stamps, DropReason::QueueFull);
                return;
            }
            self.drop_one(&mut on_drop);
        }
        self.waiting.push_back((item, stamps));
    }

    /// Removes the sample to send next; `None` when no sample may be sent.
    ///
    /// - `DropOldest`: keeps as many of the newest samples as the allowance permits and drops all older ones
    ///   as superseded; returns the oldest of those kept, so that the order is kept. With one token, the
    ///   usual case, that is the newest sample. There are more tokens only if the lane was late by more than
    ///   the interval of the rate, and then each token sends a sample: otherwise a lane with a rate of 1 kHz
    ///   that wakes every 2 ms would send 500 Hz.
    /// - `DropLatest`: returns the oldest sample.
    /// - `DropStale`: drops all stale samples, then returns the oldest.
    ///
    /// A stale sample is never returned: it is dropped as stale, and the next one is tried.
    pub fn take(
        &mut self,
        allowance: &Allowance,
        mut on_drop: impl FnMut(T, SampleStamps, DropReason),
    ) -> Option<(T, SampleStamps)> {
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
    pub fn clear(&mut self, reason: DropReason, mut on_drop: impl FnMut(T, SampleStamps, DropReason)) {
        while let Some((item, stamps)) = self.waiting.pop_front() {
            on_drop(item, stamps, reason);
        }
    }

    /// Drops the sample that the policy chooses when the queue is full.
    fn drop_one(&mut self, on_drop: &mut impl FnMut(T, SampleStamps, DropReason)) {
        if self.waiting.front().is_some_and(|(_, stamps)| stamps.key.is_keyed()) {
            let mut places = 0..self.waiting.len();
            let is_data = |place: &usize| !self.waiting[*place].1.key.is_end();
            let data = match self.policy {
                DropPolicy::DropOldest | DropPolicy::DropStale => places.find(is_data),
                DropPolicy::DropLatest => places.rfind(is_data),
            };
            if let Some((item, stamps)) = self.waiting.remove(data.unwrap_or(0)) {
                on_drop(item, stamps, DropReason::QueueFull);
            }
            return;
        }
        let (dropped, reason) = match self.policy {
            DropPolicy::DropOldest => (self.waiting.pop_front(), DropReason::Superseded),
            DropPolicy::DropStale => (self.waiting.pop_front(), DropReason::QueueFull),
            DropPolicy::DropLatest => (self.waiting.pop_back(), DropReason::QueueFull),
        };
        if let Some((item, stamps)) = dropped {
            on_drop(item, stamps, reason);
        }
    }

    /// Keeps as many of the newest samples as the allowance permits, and drops all older ones.
    fn supersede(&mut self, allowance: &Allowance, on_drop: &mut impl FnMut(T, SampleStamps, DropReason)) {
        if self.waiting.front().is_some_and(|(_, stamps)| stamps.key.is_keyed()) {
            return;
        }
        let mut kept = 0;
        let mut older_bytes = 0_u64;
        let mut oldest_kept = self.waiting.len();
        for (index, (_, stamps)) in self.waiting.iter().enumerate().rev() {
            if allowance.is_stale(stamps) {
                continue;
            }
            // The newest is sent last and may make debt, so only those before it need their bytes.
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

    /// Drops all stale samples, also behind a fresh one: each publisher of a topic has its own clock.
    fn drop_stale(&mut self, allowance: &Allowance, on_drop: &mut impl FnMut(T, SampleStamps, DropReason)) {
        for _ in 0..self.waiting.len() {
            let Some((item, stamps)) = self.waiting.pop_front() else { return };
            if allowance.is_stale(&stamps) {
                on_drop(item, stamps, DropReason::Stale);
            } else {
                // Does not allocate: a sample was just removed.
                self.waiting.push_back((item, stamps));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::KeyedPayload;

    const NOW_MS: u64 = 10_000;

    fn stamps(sequence: u64, age_ms: u64) -> SampleStamps {
        let taken_at = MonotonicNs((NOW_MS - age_ms) * 1_000_000);
        let key = SampleKey::NONE;
        SampleStamps { sequence, source_timestamp: SourceTimestamp::NONE, taken_at, bytes: 100, key }
    }

    fn allowance(tokens: u64) -> Allowance {
        let now = MonotonicNs(NOW_MS * 1_000_000);
        Allowance { now, now_wall: WallNs(0), tokens, bytes: u64::MAX, stale_threshold_ms: 200 }
    }

    /// A queue of three to which samples 1, 2, … of given ages were offered, and the dropped samples.
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
    fn drop_oldest_sends_the_newest_and_supersedes_the_others() {
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
    fn drop_oldest_sends_the_newest_when_the_bytes_suffice_for_one_only() {
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&Allowance { bytes: 99, ..allowance(3) }), Some(3));
        let mut bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30]);
        assert_eq!(bench.take(&Allowance { bytes: 100, ..allowance(3) }), Some(2));
    }

    #[test]
    fn drop_oldest_drops_the_oldest_of_a_full_queue() {
        let bench = Bench::new(DropPolicy::DropOldest, &[90, 60, 30, 20, 10]);
        assert_eq!(bench.dropped, [(1, Superseded), (2, Superseded)]);
        assert_eq!(bench.queue.len(), 3);
    }

    #[test]
    fn drop_oldest_skips_a_stale_sample_for_the_next_newest() {
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
    fn drop_latest_is_first_in_first_out_and_drops_the_new_sample_of_a_full_queue() {
        let mut bench = Bench::new(DropPolicy::DropLatest, &[90, 60, 30, 20]);
        assert_eq!(bench.dropped, [(4, QueueFull)]);
        assert!(!bench.queue.is_empty());
        assert_eq!(bench.take(&allowance(1)), Some(1));
        assert_eq!(bench.take(&allowance(9)), Some(2));
    }

    #[test]
    fn drop_latest_drops_a_stale_oldest_sample_and_tries_the_next() {
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
    fn drop_stale_drops_the_oldest_of_a_full_queue() {
        let bench = Bench::new(DropPolicy::DropStale, &[90, 60, 30, 20]);
        assert_eq!(bench.dropped, [(1, QueueFull)]);
    }

    #[test]
    fn without_a_token_nothing_is_sent_or_dropped() {
        for policy in [DropPolicy::DropOldest, DropPolicy::DropLatest, DropPolicy::DropStale] {
            let mut bench = Bench::new(policy, &[500, 60, 30]);
            assert_eq!(bench.take(&allowance(0)), None);
            assert_eq!((bench.queue.len(), bench.dropped.len()), (3, 0));
        }
    }

    #[test]
    fn a_lower_limit_drops_samples_according_to_the_new_policy() {
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
    fn the_queue_never_exceeds_or_reallocates_its_capacity() {
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

    /// Offers a fresh sample with key hash `[key; 16]`, or none for 0, which ends the key if `status_info` is
    /// not 0.
    fn offer_keyed(bench: &mut Bench, sequence: u64, key: u8, status_info: u8) {
        let hash = (key > 0).then_some([key; 16]);
        let key = SampleKey::new(hash, status_info, KeyedPayload::Data);
        let dropped = &mut bench.dropped;
        let stamps = SampleStamps { key, ..stamps(sequence, 0) };
        bench.queue.offer(sequence, stamps, |item, _, reason| dropped.push((item, reason)));
    }

    #[test]
    fn the_freshest_sample_of_each_key_waits_and_the_keys_take_turns() {
        let mut bench = Bench::new(DropPolicy::DropOldest, &[]);
        for (sequence, key) in [(1, 1), (2, 2), (3, 1), (4, 1), (5, 3)] {
            offer_keyed(&mut bench, sequence, key, 0);
        }
        let superseded = DropReason::Superseded;
        assert_eq!(bench.dropped, [(1, superseded), (3, superseded)]);
        // One that is updated more often than the lane sends does not keep the others from their turn.
        assert_eq!(bench.take(&allowance(1)), Some(4));
        offer_keyed(&mut bench, 6, 1, 0);
        assert_eq!(bench.take(&allowance(1)), Some(2));
        offer_keyed(&mut bench, 7, 1, 0);
        assert_eq!([5, 7].map(|_| bench.take(&allowance(9))), [Some(5), Some(7)]);
        assert_eq!(bench.dropped[2..], [(6, superseded)]);
        // A fourth key in a queue of three.
        for (sequence, key) in [(8, 1), (9, 2), (10, 3), (11, 4)] {
            offer_keyed(&mut bench, sequence, key, 0);
        }
        assert_eq!(bench.dropped[3..], [(8, DropReason::QueueFull)]);
        // Data does not pass an end that may be of the same key: the key would stay ended.
        for keys in [[0, 1, 0], [1, 0, 1]] {
            let mut bench = Bench::new(DropPolicy::DropOldest, &[]);
            for (sequence, key, status_info) in [(1, keys[0], 0), (2, keys[1], 1), (3, keys[2], 0)] {
                offer_keyed(&mut bench, sequence, key, status_info);
            }
            assert_eq!([1, 2, 3].map(|_| bench.take(&allowance(9))), [Some(1), Some(2), Some(3)]);
        }
        // Those without a hash count as of one key.
        let mut bench = Bench::new(DropPolicy::DropOldest, &[]);
        for sequence in 1..=3 {
            offer_keyed(&mut bench, sequence, 0, 0);
        }
        assert_eq!((bench.take(&allowance(1)), bench.queue.len()), (Some(3), 0));
    }

    #[test]
    fn the_end_of_a_key_is_not_superseded_and_not_stale() {
        for policy in [DropPolicy::DropOldest, DropPolicy::DropStale, DropPolicy::DropLatest] {
            let mut bench = Bench::new(policy, &[]);
            for (sequence, key, status_info) in [(1, 1, 0), (2, 1, 1), (3, 1, 0), (4, 2, 2)] {
                offer_keyed(&mut bench, sequence, key, status_info);
            }
            // The queue of three drops data for it.
            let lost = if policy == DropPolicy::DropLatest { 3 } else { 1 };
            assert_eq!(bench.dropped, [(lost, DropReason::QueueFull)], "{policy:?}");
            let late = Allowance { now: MonotonicNs((NOW_MS + 900) * 1_000_000), ..allowance(1) };
            assert_eq!([2, 4].map(|_| bench.take(&late)), [Some(2), Some(4)], "{policy:?}");
            assert_eq!(bench.dropped[1..], [(4 - lost, DropReason::Stale)], "{policy:?}");
            // One that is full of them.
            for sequence in 5..=8 {
                offer_keyed(&mut bench, sequence, sequence as u8, 3);
            }
            assert_eq!(bench.dropped[2..], [(5, DropReason::QueueFull)], "{policy:?}");
            offer_keyed(&mut bench, 9, 9, 0);
            assert_eq!(bench.dropped[3..], [(9, DropReason::QueueFull)], "{policy:?}: data for an end");
        }
    }
}
