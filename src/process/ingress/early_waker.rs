//! The early waker: a thread that wakes critical lanes as soon as a datagram arrives.
//!
//! The kernel wakes it right after the receiving thread. A lane that it wakes is awake by the time that the
//! sample is in shared memory, and saves the receiving thread a system call. The early waker consumes no
//! datagram and delays none; for datagrams that it misses, the receiving thread wakes the lanes.
//! `docs/decisions/0013-early-waker.md` has the measurements.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use tracing::warn;

use super::super::error::RoleError;
use super::super::scheduling;
use super::receiving::Receiving;
use crate::config::Settings;
use crate::dds::{Arrival, Arrivals, ArrivalsCloser, Participant};
use crate::model::TrafficClass;

/// How long the early waker sleeps after a datagram for which it woke no lane: a heartbeat, a part of a large
/// sample, or a sample that no critical lane serves. The time doubles after each further one, so that the
/// early waker checks some 300 of them per second.
const MIN_PAUSE: Duration = Duration::from_micros(200);
const MAX_PAUSE: Duration = Duration::from_micros(3_200);

/// Handle of the early waker thread, which ends when this is dropped.
pub(super) struct EarlyWaker {
    closer: ArrivalsCloser,
    thread: Option<JoinHandle<()>>,
}

impl EarlyWaker {
    /// Starts the thread if ingress is pinned, and each critical lane to other CPUs; else returns `None`. A
    /// lane that waits awake on the CPU that receives the sample delays it: without pinning, on two CPUs, the
    /// hop took 11 µs longer at 1 kHz.
    pub fn start(participant: &Participant, receiving: &Arc<Receiving>, settings: &Settings) -> Option<Self> {
        let cpus = apart(settings)?;
        let start = || {
            let arrivals = participant.arrivals()?;
            let closer = arrivals.closer();
            let receiving = Arc::clone(receiving);
            let wake_early = move || {
                if scheduling::apply_to_early_waker(&cpus) {
                    run(&arrivals, &receiving);
                }
            };
            let thread = thread::Builder::new().name("early-waker".to_owned()).spawn(wake_early)?;
            Ok(Self { closer, thread: Some(thread) })
        };
        start()
            .inspect_err(|error: &RoleError| warn!(%error, "no early waker: critical lanes wake up later"))
            .ok()
    }
}

impl Drop for EarlyWaker {
    fn drop(&mut self) {
        self.closer.close();
        if let Some(thread) = self.thread.take() {
            // The thread has no result, so a panic of it is ignored.
            let _ = thread.join();
        }
    }
}

/// The CPUs of the critical lanes, if ingress is pinned to others.
fn apart(settings: &Settings) -> Option<Vec<usize>> {
    let ingress = &settings.ingress_scheduling.cpus;
    let mut cpus = Vec::new();
    for lane in settings.lanes.iter().filter(|lane| lane.class() == TrafficClass::Critical) {
        let of_lane = &lane.scheduling.cpus;
        if of_lane.is_empty() || of_lane.iter().any(|cpu| ingress.contains(cpu)) {
            return None;
        }
        cpus.extend(of_lane);
    }
    (!ingress.is_empty() && !cpus.is_empty()).then_some(cpus)
}

fn run(arrivals: &Arrivals, receiving: &Receiving) {
    let mut pause = MIN_PAUSE;
    loop {
        let woke = match arrivals.wait() {
            // Only for the last fragment: until then the publisher still sends, perhaps on this CPU, and must
            // not be preempted.
            Arrival::Sample { writer, sequence, left_bytes: 0 } => {
                receiving.wake_early(writer, sequence, 0, receiving.cpu.load(Ordering::Relaxed))
            }
            Arrival::Sample { .. } | Arrival::Other => false,
            Arrival::Closed => return,
        };
        if woke {
            pause = MIN_PAUSE;
        } else {
            #[allow(clippy::disallowed_methods, reason = "the pause keeps the CPU time of this thread low")]
            thread::sleep(pause);
            pause = (pause * 2).min(MAX_PAUSE);
        }
    }
}
