//! Ingress: takes every sample of every route from DDS and publishes it once into shared memory.
//!
//! Nothing here waits for a lane: a full queue overwrites its oldest sample, and a wake-up is not waited for.

mod input;
mod source;

use std::time::Duration;

use tracing::{debug, info};

use super::HOUSEKEEPING_MS;
use super::reload::ReloadRequests;
use super::role::{Role, RoleError, namespace};
use super::stop::Stop;
use crate::clock;
use crate::config::Settings;
use crate::dds::{Discovery, Participant, ParticipantOptions};
use crate::model::{LaneMode, MonotonicNs, TrafficClass};
use crate::shm::{LaneWaker, ProcessRole};
use input::Input;

/// Samples taken of one route before the next route has its turn.
const SAMPLES_PER_TURN: usize = 32;

/// At a shutdown, how long ingress goes on taking what DDS has received, and what still comes.
const LAST_SAMPLES_MS: u64 = 200;

/// While a route still waits for its publisher, discovery is looked at this often: what the publisher sends
/// before the reader exists is lost to a VOLATILE reader.
const SEARCHING_MS: u64 = 10;

/// Runs ingress until `stop` is requested. Of what a reload changes, nothing concerns ingress.
///
/// # Errors
/// Ingress is served already, or shared memory or DDS cannot be had.
pub fn ingress(settings: &Settings, reloads: ReloadRequests, stop: &Stop) -> Result<(), RoleError> {
    let mut ingress = Ingress::open(settings, reloads)?;
    info!(routes = settings.routes.len(), domain_id = settings.input.domain_id, "ingress is up");
    while !stop.is_requested() {
        if ingress.turn() {
            continue;
        }
        ingress.sleep();
    }
    // What DDS has received by now still goes on its way; a publisher that goes on does not hold us up.
    let give_up_at = clock::monotonic().plus_ms(LAST_SAMPLES_MS);
    while ingress.turn() && clock::monotonic() < give_up_at {}
    info!("ingress is done");
    Ok(())
}

struct Ingress {
    /// Before the participant: the DDS library wants its readers and writers gone first.
    inputs: Vec<Input>,
    participant: Participant,
    role: Role,
    /// Of the critical lanes first, each with the routes that it serves.
    wakers: Vec<(LaneWaker, Vec<bool>)>,
    housekeeping_at: MonotonicNs,
}

impl Ingress {
    fn open(settings: &Settings, reloads: ReloadRequests) -> Result<Self, RoleError> {
        let how = &settings.ingress_scheduling;
        let mut role = Role::open(settings, reloads, ProcessRole::Ingress, "ingress", how)?;
        let mut inputs = Vec::with_capacity(settings.routes.len());
        for route in 0..settings.routes.len() {
            inputs.push(Input::open(&role, settings, route)?);
        }
        let mut wakers = Vec::with_capacity(settings.lanes.len());
        for class in [TrafficClass::Critical, TrafficClass::Noncritical] {
            for (index, lane) in settings.lanes.iter().enumerate().filter(|(_, lane)| lane.class == class) {
                let serves = (0..settings.routes.len())
                    .map(|route| lane.outputs.iter().any(|output| output.route == route))
                    .collect();
                wakers.push((role.boards.waker(index), serves));
            }
        }
        let participant = role.join(&ParticipantOptions {
            network: &settings.input,
            namespace: namespace(settings),
            node_name: "ingress".to_owned(),
            graph_gid_bytes: settings.graph_gid_bytes,
        })?;
        let mut ingress = Self { role, participant, inputs, wakers, housekeeping_at: MonotonicNs(0) };
        ingress.keep_house(clock::monotonic())?;
        Ok(ingress)
    }

    /// Handles what is there; whether anything was.
    fn turn(&mut self) -> bool {
        let now = clock::monotonic();
        // First, because it may connect a route, whose reader must be looked at before sleeping: a new reader
        // rings nobody yet.
        if now >= self.housekeeping_at
            && let Err(error) = self.keep_house(now)
        {
            tracing::error!(%error, "housekeeping failed");
        }
        let mut busy = false;
        for route in 0..self.inputs.len() {
            for _ in 0..SAMPLES_PER_TURN {
                if !self.inputs[route].step(|| wake(&self.wakers, route)) {
                    break;
                }
                busy = true;
            }
        }
        busy
    }

    /// Sleeps until a sample arrives or housekeeping is due.
    fn sleep(&mut self) {
        // An arrival after the last look rings the bell of its route, and a bell that was rung keeps `park`
        // from sleeping; so nothing is slept through.
        let wait_ns = self.housekeeping_at.since(clock::monotonic());
        if wait_ns > 0 {
            std::thread::park_timeout(Duration::from_nanos(wait_ns));
        }
    }

    fn keep_house(&mut self, now: MonotonicNs) -> Result<(), RoleError> {
        while let Some(change) = self.participant.poll_discovery() {
            match change {
                Discovery::Writer(writer) if !self.participant.owns(writer.guid) => {
                    for input in &mut self.inputs {
                        input.writer_found(&writer);
                    }
                }
                Discovery::WriterGone(guid) => {
                    for input in &mut self.inputs {
                        input.writer_gone(guid);
                    }
                }
                Discovery::ParticipantGone { prefix } => {
                    for input in &mut self.inputs {
                        input.participant_gone(prefix);
                    }
                }
                Discovery::Incompatible { local, remote } => {
                    debug!(?local, ?remote, "endpoints are not compatible");
                }
                _ => {}
            }
        }
        let mut searching = false;
        for input in &mut self.inputs {
            input.keep_house(&mut self.participant, now)?;
            searching |= !input.is_connected();
        }
        self.role.reload();
        self.role.turned(LaneMode::Normal as u8, 0);
        self.housekeeping_at = now.plus_ms(if searching { SEARCHING_MS } else { HOUSEKEEPING_MS });
        Ok(())
    }
}

/// Wakes the lanes that serve the route, the critical ones first.
fn wake(wakers: &[(LaneWaker, Vec<bool>)], route: usize) {
    for (waker, serves) in wakers {
        if serves[route] {
            waker.wake();
        }
    }
}
