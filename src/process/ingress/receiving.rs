//! What ingress does on the DDS library's receiving thread: taking samples and publishing them.
//!
//! A sample that is taken where it is received costs one wake-up less than one that is handed to a thread of
//! ours first; `docs/decisions/0006-hand-overs.md` has the measurements. What need not happen for each sample
//! is done by the main thread, which holds a route's lock meanwhile. The receiving thread waits for no lock:
//! it leaves the route alone, and is rung when the lock is free.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use super::super::inbox::Bell;
use super::expected::Expected;
use super::followed::Followed;
use super::input::Input;
use crate::model::{Guid, TrafficClass};
use crate::shm::{LaneWaker, this_cpu};

/// Samples taken of one route before the next route, and the DDS library, have their turn.
const SAMPLES_PER_TURN: usize = 32;

/// A route, its bell, and whether somebody came while its lock was held.
struct Served {
    input: Mutex<Input>,
    bell: Arc<Bell>,
    missed: AtomicBool,
    followed: Arc<Followed>,
    /// Whether a critical lane has it.
    is_critical: bool,
}

/// A lane that samples are published to.
pub(super) struct ServedLane {
    pub waker: LaneWaker,
    pub class: TrafficClass,
    /// Of each route.
    pub serves: Vec<bool>,
}

/// All routes, as the receiving thread and the main thread share them.
pub(super) struct Receiving {
    routes: Vec<Served>,
    /// The critical ones first.
    lanes: Vec<ServedLane>,
    turns: AtomicU64,
    expected: Expected,
    /// Where the receiving thread ran last.
    cpu: AtomicU32,
}

impl Receiving {
    pub fn new(inputs: Vec<(Input, Arc<Bell>)>, lanes: Vec<ServedLane>) -> Self {
        let is_critical = |route: usize| {
            lanes.iter().any(|lane| lane.class == TrafficClass::Critical && lane.serves[route])
        };
        let served = |(route, (input, bell)): (usize, (Input, _))| Served {
            followed: input.followed(),
            input: Mutex::new(input),
            bell,
            missed: AtomicBool::new(false),
            is_critical: is_critical(route),
        };
        Self {
            routes: inputs.into_iter().enumerate().map(served).collect(),
            lanes,
            turns: AtomicU64::new(0),
            expected: Expected::new(),
            cpu: AtomicU32::new(0),
        }
    }

    /// A datagram has come that seems to hold a sample of `writer`, or a part of one that `left_bytes` are
    /// missing of behind it. Lets the critical lanes of its route get up while `cpu` receives it, unless that
    /// sample came before: many publishers send each one to all our addresses. Whether it did.
    pub fn expect(&self, writer: Guid, sequence: i64, left_bytes: usize, cpu: u32) -> bool {
        // Before the search, which this would be in vain for all but the last of many fragments.
        if !self.expected.may_tell(left_bytes) {
            return false;
        }
        let awaits = |served: &Served| served.is_critical && served.followed.awaits(writer, sequence);
        let Some(route) = self.routes.iter().position(awaits) else {
            return false;
        };
        let tells = self.expected.tell(route, left_bytes);
        if tells {
            self.announce(route, cpu);
        }
        tells
    }

    /// Where the receiving thread ran last.
    pub fn cpu(&self) -> u32 {
        self.cpu.load(Ordering::Relaxed)
    }

    /// Takes and publishes what has arrived; on the receiving thread. Whether there may be more.
    pub fn turn(&self) -> bool {
        let cpu = this_cpu();
        self.cpu.store(cpu, Ordering::Relaxed);
        let mut more = false;
        for (route, served) in self.routes.iter().enumerate() {
            if served.bell.is_rung()
                && let Some(mut input) = served.try_enter()
            {
                if served.is_critical && self.expected.came(route) {
                    self.announce(route, cpu);
                }
                more |= self.drain(route, &mut input);
                self.expected.came_meanwhile(route);
            }
        }
        self.expected.turn_ends();
        self.turns.fetch_add(1, Ordering::Release);
        more
    }

    /// Like [`turn`](Self::turn), on any thread.
    pub fn turn_patiently(&self) -> bool {
        let mut more = false;
        for (route, served) in self.routes.iter().enumerate() {
            if served.bell.is_rung() {
                more |= self.drain(route, &mut served.enter());
            }
        }
        more
    }

    /// Turns of the receiving thread so far.
    pub fn turns(&self) -> u64 {
        self.turns.load(Ordering::Acquire)
    }

    /// Lets `work` have each route; whether the receiving thread has to be rung, because it came meanwhile,
    /// or because a route has a new reader.
    ///
    /// # Errors
    /// The first one of `work`, after all routes had their turn.
    pub fn visit<E>(&self, mut work: impl FnMut(&mut Input) -> Result<(), E>) -> Result<bool, E> {
        let mut ring = false;
        let mut outcome = Ok(());
        for served in &self.routes {
            outcome = outcome.and(work(&mut served.enter()));
            ring |= served.was_missed() || served.bell.is_rung();
        }
        outcome.map(|()| ring)
    }

    fn drain(&self, route: usize, input: &mut Input) -> bool {
        for _ in 0..SAMPLES_PER_TURN {
            if !input.step(|| self.wake(route)) {
                return false;
            }
        }
        true
    }

    /// Lets the critical lanes that serve the route get up while its sample is taken on `cpu`. A noncritical
    /// one has time.
    fn announce(&self, route: usize, cpu: u32) {
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

impl Served {
    fn enter(&self) -> MutexGuard<'_, Input> {
        self.input.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The route, unless the main thread has it; then it is told.
    fn try_enter(&self) -> Option<MutexGuard<'_, Input>> {
        let attempt = || match self.input.try_lock() {
            Ok(input) => Some(input),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        };
        attempt().or_else(|| {
            // Either the main thread sees this when it has let go, or it has by now.
            self.missed.store(true, Ordering::SeqCst);
            fence(Ordering::SeqCst);
            attempt()
        })
    }

    /// After the lock was let go of.
    fn was_missed(&self) -> bool {
        fence(Ordering::SeqCst);
        self.missed.swap(false, Ordering::SeqCst)
    }
}
