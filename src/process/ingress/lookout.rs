//! The lookout: a thread that sees datagrams as they come and gets the critical lanes up.
//!
//! The kernel wakes it right after the thread that receives. A lane that it gets up has left its sleep by
//! the time that the sample is in shared memory, and the receiving thread has no system call to make for it.
//! It takes nothing and holds nothing up; what it misses is told by the receiving thread, as without it.
//! `docs/decisions/0013-lookout.md` has the measurements.

use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use tracing::warn;

use super::super::role::RoleError;
use super::super::scheduling;
use super::receiving::Receiving;
use crate::config::Settings;
use crate::dds::{Arrival, Arrivals, ArrivalsCloser, Participant};
use crate::model::TrafficClass;

/// How long it looks away after a datagram that it told nobody of: heartbeats, parts of large samples, what
/// no critical lane has. Twice as long after each further one, so that of a stream of them some 300 a second
/// are looked at.
const LOOKS_AWAY: Duration = Duration::from_micros(200);
const LOOKS_AWAY_AT_MOST: Duration = Duration::from_micros(3_200);

/// The thread; it ends when this is dropped.
pub(super) struct Lookout {
    closer: ArrivalsCloser,
    thread: Option<JoinHandle<()>>,
}

impl Lookout {
    /// None unless ingress is pinned, and each critical lane to other CPUs. A lane that stays up for a sample
    /// on the CPU on which the sample is to be received would only hold it up, and without pins on two CPUs
    /// it did: the hop took 11 µs longer at 1 kHz.
    pub fn start(participant: &Participant, receiving: &Arc<Receiving>, settings: &Settings) -> Option<Self> {
        let cpus = apart(settings)?;
        let start = || {
            let arrivals = participant.arrivals()?;
            let closer = arrivals.closer();
            let receiving = Arc::clone(receiving);
            let look_out = move || {
                if scheduling::apply_to_lookout(&cpus) {
                    run(&arrivals, &receiving);
                }
            };
            let thread = thread::Builder::new().name("lookout".to_owned()).spawn(look_out)?;
            Ok(Self { closer, thread: Some(thread) })
        };
        start().inspect_err(|error: &RoleError| warn!(%error, "no lookout: critical lanes get up later")).ok()
    }
}

impl Drop for Lookout {
    fn drop(&mut self) {
        self.closer.close();
        if let Some(thread) = self.thread.take() {
            // It has nothing that could be lost.
            let _ = thread.join();
        }
    }
}

/// The CPUs of the critical lanes, if ingress has none of them.
fn apart(settings: &Settings) -> Option<Vec<usize>> {
    let ingress = &settings.ingress_scheduling.cpus;
    let mut cpus = Vec::new();
    for lane in settings.lanes.iter().filter(|lane| lane.class == TrafficClass::Critical) {
        let of_lane = &lane.scheduling.cpus;
        if of_lane.is_empty() || of_lane.iter().any(|cpu| ingress.contains(cpu)) {
            return None;
        }
        cpus.extend(of_lane);
    }
    (!ingress.is_empty() && !cpus.is_empty()).then_some(cpus)
}

fn run(arrivals: &Arrivals, receiving: &Receiving) {
    let mut looks_away = LOOKS_AWAY;
    loop {
        let told = match arrivals.wait() {
            // While more of it is to come its publisher sends, on this CPU perhaps, and is not to be held up.
            Arrival::Sample { writer, sequence, left_bytes: 0 } => {
                receiving.expect(writer, sequence, 0, receiving.cpu())
            }
            Arrival::Sample { .. } | Arrival::Other => false,
            Arrival::Closed => return,
        };
        if told {
            looks_away = LOOKS_AWAY;
        } else {
            thread::sleep(looks_away);
            looks_away = (looks_away * 2).min(LOOKS_AWAY_AT_MOST);
        }
    }
}
