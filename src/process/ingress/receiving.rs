//! Takes samples and publishes them on the DDS library's receiving thread.
//!
//! Taking a sample on the thread that receives it saves one wake-up, compared with handing it to a thread of
//! ingress first; `docs/decisions/0006-hand-overs.md` has the measurements. The main thread does the work
//! that is not needed for each sample, and locks a route meanwhile. The receiving thread never waits for a
//! lock: it skips a locked route, and is woken when the lock is free.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering, fence};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use super::input::Input;
use super::pending_wake::PendingWake;
use super::writer_sequences::WriterSequences;
use crate::dds::ArrivalFlag;
use crate::model::{Guid, TrafficClass};
use crate::shm::{LaneWaker, this_cpu};

/// Samples taken from one route before the next route, and then the DDS library, is served.
const SAMPLES_PER_TURN: usize = 32;

/// One route, as the receiving thread and the main thread share it.
struct SharedRoute {
    input: Mutex<Input>,
    flag: Arc<ArrivalFlag>,
    /// Whether the receiving thread has skipped the route because the main thread had locked it.
    skipped: AtomicBool,
    writer_sequences: Arc<WriterSequences>,
    /// Whether a critical lane serves the route.
    is_critical: bool,
}

/// A lane that samples are published to.
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
    cpu: AtomicU32,
}

impl Receiving {
    pub fn new(inputs: Vec<(Input, Arc<ArrivalFlag>)>, lanes: Vec<ServedLane>) -> Self {
        let is_critical = |route: usize| {
            lanes.iter().any(|lane| lane.class == TrafficClass::Critical && lane.serves[route])
        };
        let shared = |(route, (input, flag)): (usize, (Input, _))| SharedRoute {
            writer_sequences: input.writer_sequences(),
            input: Mutex::new(input),
            flag,
            skipped: AtomicBool::new(false),
            is_critical: is_critical(route),
        };
        Self {
            routes: inputs.into_iter().enumerate().map(shared).collect(),
            lanes,
            pending_wake: PendingWake::new(),
            cpu: AtomicU32::new(0),
        }
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
        let is_new =
            |shared: &SharedRoute| shared.is_critical && shared.writer_sequences.is_new(writer, sequence);
        let Some(route) = self.routes.iter().position(is_new) else {
            return false;
        };
        let claimed = self.pending_wake.claim(route, left_bytes);
        if claimed {
            self.wake_critical(route, cpu);
        }
        claimed
    }

    /// The CPU on which the receiving thread ran last.
    pub fn cpu(&self) -> u32 {
        self.cpu.load(Ordering::Relaxed)
    }

    /// Takes and publishes the samples that have arrived; on the receiving thread. Returns whether more may
    /// wait.
    pub fn turn(&self) -> bool {
        let cpu = this_cpu();
        self.cpu.store(cpu, Ordering::Relaxed);
        let mut more = false;
        for (route, shared) in self.routes.iter().enumerate() {
            if shared.flag.is_raised()
                && let Some(mut input) = shared.try_lock()
            {
                if shared.is_critical && self.pending_wake.take_pending(route) {
                    self.wake_critical(route, cpu);
                }
                more |= self.drain(route, &mut input);
                self.pending_wake.end_late_claim(route);
            }
        }
        self.pending_wake.count_turn();
        more
    }

    /// Like [`turn`](Self::turn), but on any thread: waits for the locks, and wakes no lane early.
    pub fn turn_blocking(&self) -> bool {
        let mut more = false;
        for (route, shared) in self.routes.iter().enumerate() {
            if shared.flag.is_raised() {
                more |= self.drain(route, &mut shared.lock());
            }
        }
        more
    }

    /// Locks each input in turn and calls `work` with it. Returns whether the caller has to ring the
    /// receiving thread, because that has skipped a locked route, or because a route has a new reader.
    ///
    /// # Errors
    /// The first error of `work`, after `work` was called with all inputs.
    pub fn for_each_input<E>(&self, mut work: impl FnMut(&mut Input) -> Result<(), E>) -> Result<bool, E> {
        let mut ring = false;
        let mut outcome = Ok(());
        for shared in &self.routes {
            outcome = outcome.and(work(&mut shared.lock()));
            ring |= shared.take_skipped() || shared.flag.is_raised();
        }
        outcome.map(|()| ring)
    }

    /// Takes and publishes up to `SAMPLES_PER_TURN` samples. Returns whether more may wait.
    fn drain(&self, route: usize, input: &mut Input) -> bool {
        for _ in 0..SAMPLES_PER_TURN {
            if !input.step(|| self.wake(route)) {
                return false;
            }
        }
        true
    }

    /// Wakes the critical lanes that serve the route while its sample is being taken on `cpu`. A noncritical
    /// lane needs no early wake-up.
    fn wake_critical(&self, route: usize, cpu: u32) {
        for lane in self.lanes.iter().take_while(|lane| lane.class == TrafficClass::Critical) {
            if lane.serves[route] {
                lane.waker.announce(cpu);
            }
        }
    }

    /// Wakes the lanes that serve the route.
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
