//! Takes samples and publishes them on the DDS library's receiving thread.
//!
//! Taking a sample on the thread that receives it saves one wake-up, compared with handing it to a thread of
//! ingress first; `docs/decisions/0006-hand-overs.md` has the measurements. The main thread does the work
//! that is not needed for each sample, and locks a route meanwhile. The receiving thread never waits for a
//! lock: it skips a locked route, and is woken when the lock is free.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError};

use super::input::{Input, Step};
use super::publishers::HighWaterMarks;
use crate::dds::ArrivalFlag;
use crate::model::{Guid, TrafficClass};
use crate::shm::{LaneWaker, this_cpu};

/// Samples taken from one route before the next route, and then the DDS library, is served.
const SAMPLES_PER_TURN: usize = 32;

/// The most bytes of a fragmented sample that may be missing when the lanes are woken. A fragment of 64 KiB
/// takes some 30 µs, about as long as a lane takes to wake up; a woken lane does not stay awake for more.
const LEFT_BYTES: usize = 64 << 10;
/// Turns within which the missing fragments must arrive: one for each datagram, and the smallest fragments
/// that publishers choose by default have 1.3 KB.
const TURNS: u64 = 64;
/// Turns within which a whole sample must arrive, whose own turn does not count: one that was under way when
/// the early waker woke the lanes.
const TURNS_WHOLE: u64 = 1;
/// The datagrams of urgent topics that the DDS library receives before each other one, each with a turn:
/// `URGENT_DATAGRAMS_AHEAD` in `dp_event_loop.rs`.
const TURNS_URGENT: u64 = 4;

const NONE: u64 = u64::MAX;
const IN_VAIN: u64 = u64::MAX - 1;
/// The bits of the state below the route's number, which hold the turns that are left.
const ROUTE_SHIFT: u32 = 32;

/// One route, as the receiving thread and the main thread share it.
struct SharedRoute {
    input: Mutex<Input>,
    flag: Arc<ArrivalFlag>,
    /// Whether the receiving thread has skipped the route because the main thread had locked it.
    skipped: AtomicBool,
    marks: Arc<HighWaterMarks>,
    is_critical: bool,
}

pub(super) struct ServedLane {
    pub waker: LaneWaker,
    pub class: TrafficClass,
    /// For each route, whether the lane serves it.
    pub serves: Vec<bool>,
}

/// All routes and lanes, as the receiving thread and the main thread share them.
pub(super) struct Receiving {
    routes: Vec<SharedRoute>,
    /// Critical lanes first.
    lanes: Vec<ServedLane>,
    pending_wake: PendingWake,
    /// The CPU on which the receiving thread ran last.
    pub cpu: AtomicU32,
}

impl Receiving {
    /// Shares routes and lanes. `has_urgent`: whether topics are urgent, so that their datagrams go first.
    pub fn new(inputs: Vec<(Input, Arc<ArrivalFlag>)>, lanes: Vec<ServedLane>, has_urgent: bool) -> Self {
        let is_critical = |route: usize| {
            lanes.iter().any(|lane| lane.class == TrafficClass::Critical && lane.serves[route])
        };
        let shared = |(route, (input, flag)): (usize, (Input, _))| SharedRoute {
            marks: input.publishers.marks(),
            input: Mutex::new(input),
            flag,
            skipped: AtomicBool::new(false),
            is_critical: is_critical(route),
        };
        Self {
            routes: inputs.into_iter().enumerate().map(shared).collect(),
            lanes,
            pending_wake: PendingWake::new(has_urgent),
            cpu: AtomicU32::new(0),
        }
    }

    /// The two callbacks of the DDS library's receiving thread: one for a datagram that seems to hold a
    /// sample, with its writer, its sequence number and the bytes that are missing; one after each datagram.
    /// They do nothing until `receiving` is set: no reader exists before.
    pub fn hooks(
        receiving: &Arc<OnceLock<Arc<Self>>>,
    ) -> (impl FnMut([u8; 16], i64, usize) + use<>, impl FnMut() -> bool + use<>) {
        let (arriving, received) = (Arc::clone(receiving), Arc::clone(receiving));
        let on_arriving = move |writer, sequence, left_bytes| {
            if let Some(receiving) = arriving.get() {
                receiving.wake_early(Guid(writer), sequence, left_bytes, this_cpu());
            }
        };
        (on_arriving, move || received.get().is_some_and(|receiving| receiving.turn(true)))
    }

    /// Like [`for_each_input`](Self::for_each_input), for one route.
    pub fn with_input(&self, route: usize, work: impl FnOnce(&mut Input)) -> bool {
        let Some(shared) = self.routes.get(route) else { return false };
        work(&mut shared.lock());
        shared.take_skipped() || shared.flag.is_raised()
    }

    /// Wakes the critical lanes of a route early. A datagram has arrived that seems to hold a sample of
    /// `writer`, or a part of one of which `left_bytes` are missing, and `cpu` receives it. A sample that was
    /// received before wakes no lane: many publishers send each one to all addresses of this host. Returns
    /// whether the lanes were woken.
    pub fn wake_early(&self, writer: Guid, sequence: i64, left_bytes: usize, cpu: u32) -> bool {
        // Checked before the search, which would find nothing to do for all but the last of many fragments.
        if !self.pending_wake.may_claim(left_bytes) {
            return false;
        }
        let is_new = |shared: &SharedRoute| {
            shared.is_critical && shared.marks.find(writer).is_some_and(|(_, last)| sequence > last)
        };
        let Some(route) = self.routes.iter().position(is_new) else {
            return false;
        };
        let claimed = self.pending_wake.claim(route, left_bytes);
        if claimed {
            self.wake_critical(route, cpu);
        }
        claimed
    }

    /// Takes and publishes the samples that have arrived, up to `SAMPLES_PER_TURN` of each route. On the
    /// receiving thread (`is_receiving`) it skips a locked route and wakes critical lanes early; on any other
    /// thread it waits for the locks. Returns whether more may wait.
    pub fn turn(&self, is_receiving: bool) -> bool {
        let cpu = this_cpu();
        if is_receiving {
            self.cpu.store(cpu, Ordering::Relaxed);
        }
        let mut more = false;
        for (route, shared) in self.routes.iter().enumerate().filter(|(_, shared)| shared.flag.is_raised()) {
            let input = if is_receiving { shared.try_lock() } else { Some(shared.lock()) };
            let Some(mut input) = input else { continue };
            if is_receiving && shared.is_critical && self.pending_wake.take_pending(route) {
                self.wake_critical(route, cpu);
            }
            let mut left = SAMPLES_PER_TURN;
            while left > 0 {
                match input.step() {
                    Step::Published => {
                        self.wake(route);
                        input.keep_published();
                    }
                    Step::Discarded => {}
                    Step::Empty => break,
                }
                left -= 1;
            }
            more |= left == 0;
            if is_receiving {
                self.pending_wake.end_late_claim(route);
            }
        }
        if is_receiving {
            self.pending_wake.count_turn();
        }
        more
    }

    /// Locks each input in turn and calls `work` with it. Returns whether the caller has to ring the
    /// receiving thread, because that has skipped a locked route, or because a route has a new reader.
    pub fn for_each_input(&self, mut work: impl FnMut(&mut Input)) -> bool {
        let mut ring = false;
        for shared in &self.routes {
            work(&mut shared.lock());
            ring |= shared.take_skipped() || shared.flag.is_raised();
        }
        ring
    }

    /// Wakes the critical lanes that serve the route while its sample is being taken on `cpu`. A noncritical
    /// lane needs no early wake-up.
    fn wake_critical(&self, route: usize, cpu: u32) {
        for lane in self.lanes.iter().take_while(|lane| lane.class == TrafficClass::Critical) {
            if lane.serves[route] {
                lane.waker.wake_early(cpu);
            }
        }
    }

    fn wake(&self, route: usize) {
        for lane in &self.lanes {
            if lane.serves[route] {
                lane.waker.wake();
            }
        }
    }
}

impl SharedRoute {
    #[allow(clippy::disallowed_methods, reason = "one input is used by one thread at a time")]
    fn lock(&self) -> MutexGuard<'_, Input> {
        self.input.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks the input, unless the main thread has locked it; then sets `skipped`.
    fn try_lock(&self) -> Option<MutexGuard<'_, Input>> {
        let attempt = || match self.input.try_lock() {
            Ok(input) => Some(input),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        };
        attempt().or_else(|| {
            // Either the main thread sees this flag after it has unlocked the input, or it has unlocked it by
            // now and the second attempt succeeds.
            self.skipped.store(true, Ordering::SeqCst);
            fence(Ordering::SeqCst);
            attempt()
        })
    }

    /// Resets `skipped` and returns its value. To be called after the lock is released.
    fn take_skipped(&self) -> bool {
        fence(Ordering::SeqCst);
        self.skipped.swap(false, Ordering::SeqCst)
    }
}

/// The route whose lanes were woken for a sample that is not taken yet.
pub(super) struct PendingWake {
    /// The route and the turns that are left; [`NONE`]; or [`IN_VAIN`] if the lanes were woken and no sample
    /// followed. Any thread may replace `NONE` with a route; only the receiving thread changes a route.
    state: AtomicU64,
    /// The turns within which a whole sample must arrive.
    turns_whole: u64,
}

impl PendingWake {
    pub fn new(has_urgent: bool) -> Self {
        let turns_whole = TURNS_WHOLE + if has_urgent { TURNS_URGENT } else { 0 };
        Self { state: AtomicU64::new(NONE), turns_whole }
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
        let turns = if left_bytes == 0 { self.turns_whole } else { TURNS };
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
        let pending = PendingWake::new(false);
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
        let pending = PendingWake::new(false);
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
    fn urgent_datagrams_may_go_before_a_claimed_sample() {
        let pending = PendingWake::new(true);
        assert!(pending.claim(7, 0));
        for _ in 0..TURNS_WHOLE + TURNS_URGENT {
            pending.count_turn();
        }
        assert!(!pending.take_pending(7), "in time");
    }

    #[test]
    fn the_early_waker_may_claim_during_a_turn() {
        let pending = PendingWake::new(false);
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
        let pending = PendingWake::new(false);
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
