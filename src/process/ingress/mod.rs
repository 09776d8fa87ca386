//! Ingress: takes every sample of every route from DDS and publishes it once into shared memory.
//!
//! Nothing here waits for a lane: a full queue overwrites its oldest sample, and a wake-up is not waited for.
//! Samples are taken on the DDS library's receiving thread ([`receiving`]); the main thread keeps house, and
//! a third one gets the critical lanes up meanwhile ([`lookout`]).

mod clocks;
mod expected;
mod followed;
mod input;
mod lookout;
mod pool;
mod publishers;
mod receiving;
mod source;

use std::fmt::Write;
use std::sync::Arc;
use std::time::Duration;

use tracing::{debug, info};

use super::HOUSEKEEPING_MS;
use super::inbox::Bell;
use super::notify::{Meter, write_drops, write_list};
use super::reload::ReloadRequests;
use super::role::{Role, RoleError, namespace};
use super::stop::Stop;
use crate::clock;
use crate::config::Settings;
use crate::dds::{Discovery, Participant, ParticipantOptions};
use crate::model::{LaneMode, MonotonicNs, TrafficClass};
use crate::shm::{ProcessRole, this_cpu};
use input::Input;
use lookout::Lookout;
use receiving::{Receiving, ServedLane};

/// At a shutdown, how long ingress goes on taking what DDS has received, and what still comes.
const LAST_SAMPLES_MS: u64 = 200;

/// While a route still waits for its publisher, discovery is looked at this often: what the publisher sends
/// before the reader exists is lost to a VOLATILE reader.
const SEARCHING_MS: u64 = 10;

/// How long at most the publishers retain what they wrote while no ingress ran: the reader of a killed
/// predecessor, which acknowledges nothing, also holds up a publisher whose history is full.
const RESUME_MS: u64 = 1_000;

/// The same once the first of these samples has come of each publisher: as one request names 256 samples, the
/// others may take two or three more.
const RESUMED_MS: u64 = 200;

/// Runs ingress until `stop` is requested. Of what a reload changes, nothing concerns ingress.
///
/// # Errors
/// Ingress is served already, or shared memory or DDS cannot be had.
pub fn ingress(settings: &Settings, reloads: ReloadRequests, stop: &Stop) -> Result<(), RoleError> {
    let mut ingress = Ingress::open(settings, reloads)?;
    info!(routes = settings.routes.len(), domain_id = settings.input.domain_id, "ingress is up");
    while !stop.is_requested() {
        ingress.sleep();
        if let Err(error) = ingress.keep_house(clock::monotonic()) {
            tracing::error!(%error, "housekeeping failed");
        }
    }
    ingress.role.stopping();
    // What DDS has received by now still goes on its way; a publisher that goes on does not hold us up.
    let give_up_at = clock::monotonic().plus_ms(LAST_SAMPLES_MS);
    while ingress.receiving.turn_patiently() && clock::monotonic() < give_up_at {}
    info!("ingress is done");
    Ok(())
}

struct Ingress {
    /// Before the participant, whose ports it has, too.
    _lookout: Option<Lookout>,
    receiving: Arc<Receiving>,
    participant: Participant,
    role: Role,
    /// Turns of the receiving thread at the last housekeeping.
    turns_seen: u64,
    /// Whether samples have come of each publisher that wrote until the predecessor died.
    has_resumed: bool,
    /// When the participant of a killed predecessor is disposed of at the latest.
    resume_until: MonotonicNs,
    housekeeping_at: MonotonicNs,
    received: Meter,
}

impl Drop for Ingress {
    fn drop(&mut self) {
        // Its thread has the routes, too, and the library wants readers gone before their participant.
        let Ok(_) = self.receiving.visit::<std::convert::Infallible>(|input| {
            input.close();
            Ok(())
        });
    }
}

impl Ingress {
    fn open(settings: &Settings, reloads: ReloadRequests) -> Result<Self, RoleError> {
        let how = &settings.ingress_scheduling;
        let mut role = Role::open(settings, reloads, ProcessRole::Ingress, "ingress", how)?;
        let mut inputs = Vec::with_capacity(settings.routes.len());
        for route in 0..settings.routes.len() {
            let bell = Arc::new(Bell::silent());
            inputs.push((Input::open(&role, settings, route, &bell)?, bell));
        }
        let mut lanes = Vec::with_capacity(settings.lanes.len());
        for class in [TrafficClass::Critical, TrafficClass::Noncritical] {
            for (index, lane) in settings.lanes.iter().enumerate().filter(|(_, lane)| lane.class == class) {
                let serves = (0..settings.routes.len())
                    .map(|route| lane.outputs.iter().any(|output| output.route == route))
                    .collect();
                lanes.push(ServedLane { waker: role.boards.waker(index), class, serves });
            }
        }
        let receiving = Arc::new(Receiving::new(inputs, lanes));
        let on_arriving = {
            let receiving = Arc::clone(&receiving);
            move |writer, sequence, left_bytes| {
                receiving.expect(writer, sequence, left_bytes, this_cpu());
            }
        };
        let on_received = {
            let receiving = Arc::clone(&receiving);
            move || receiving.turn()
        };
        let options = ParticipantOptions {
            network: &settings.input,
            namespace: namespace(settings),
            node_name: "ingress".to_owned(),
            graph_gid_bytes: settings.graph_gid_bytes,
        };
        let participant = role.join_receiving(&options, on_arriving, on_received)?;
        let resume_until = clock::monotonic().plus_ms(RESUME_MS);
        let lookout = Lookout::start(&participant, &receiving, settings);
        let housekeeping_at = clock::monotonic();
        let mut ingress = Self {
            _lookout: lookout,
            receiving,
            participant,
            role,
            turns_seen: 0,
            has_resumed: false,
            resume_until,
            housekeeping_at,
            received: Meter::default(),
        };
        ingress.keep_house(housekeeping_at)?;
        ingress.role.ready();
        Ok(ingress)
    }

    /// Sleeps until housekeeping is due.
    fn sleep(&self) {
        let wait_ns = self.housekeeping_at.since(clock::monotonic());
        std::thread::sleep(Duration::from_nanos(wait_ns));
    }

    fn keep_house(&mut self, now: MonotonicNs) -> Result<(), RoleError> {
        while let Some(change) = self.participant.poll_discovery() {
            match change {
                Discovery::Writer(writer) if !self.participant.owns(writer.guid) => {
                    self.visit(|input, _| {
                        input.writer_found(&writer);
                        Ok(())
                    })?;
                }
                Discovery::WriterGone(guid) => {
                    self.visit(|input, _| {
                        input.writer_gone(guid);
                        Ok(())
                    })?;
                }
                Discovery::ParticipantGone { prefix, .. } => {
                    self.visit(|input, _| {
                        input.participant_gone(prefix);
                        Ok(())
                    })?;
                }
                Discovery::Incompatible { local, remote } => {
                    debug!(?local, ?remote, "endpoints are not compatible");
                }
                _ => {}
            }
        }
        let mut searching = false;
        let mut resumed = true;
        let kept = self.visit(|input, participant| {
            let kept = input.keep_house(participant, now);
            searching |= !input.is_connected();
            resumed &= input.has_resumed();
            kept
        });
        // Not earlier: a publisher lets go of samples that no matched reader has yet to acknowledge, and the
        // readers of this process have not requested them yet.
        if resumed && !std::mem::replace(&mut self.has_resumed, true) {
            self.resume_until = self.resume_until.min(now.plus_ms(RESUMED_MS));
        }
        if self.role.has_former() && now >= self.resume_until {
            self.role.dispose_former(&self.participant);
        }
        // What shows as alive is the thread that receives, not this one: it is shown when that thread has
        // turned since, and asked to turn again, whether or not anything arrives.
        let turns = self.receiving.turns();
        if turns != self.turns_seen {
            self.turns_seen = turns;
            self.role.turned(LaneMode::Normal as u8, 0);
        }
        self.role.reload();
        self.role.status(now, |line| describe(&self.receiving, &mut self.received, line, now));
        self.participant.ring();
        self.housekeeping_at = now.plus_ms(if searching { SEARCHING_MS } else { HOUSEKEEPING_MS });
        kept
    }

    /// Lets `work` have each route, which the receiving thread has to do without meanwhile.
    fn visit(
        &mut self,
        mut work: impl FnMut(&mut Input, &mut Participant) -> Result<(), RoleError>,
    ) -> Result<(), RoleError> {
        let participant = &mut self.participant;
        if self.receiving.visit(|input| work(input, participant))? {
            self.participant.ring();
        }
        Ok(())
    }
}

/// What ingress does, in a line for the service manager. The receiving thread is to be rung after it.
fn describe(receiving: &Receiving, received: &mut Meter, line: &mut String, now: MonotonicNs) {
    let (mut routes, mut connected, mut total) = (0, 0, 0);
    let mut drops = Vec::new();
    let mut without = Vec::new();
    let Ok(_) = receiving.visit::<std::convert::Infallible>(|input| {
        routes += 1;
        total += input.counters().received;
        drops.push(input.counters().drops);
        if input.is_connected() {
            connected += 1;
        } else {
            without.push(input.topic().to_string());
        }
        Ok(())
    });
    // Writing to a String cannot fail.
    let _ =
        write!(line, "reading {connected} of {routes} routes, {:.1} samples/s", received.per_s(total, now));
    write_drops(line, drops.iter());
    write_list(line, "; no publisher found yet of", without.iter());
}
