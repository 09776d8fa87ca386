//! Ingress: takes every sample of every route from DDS and publishes it once to shared memory.
//!
//! Ingress never waits for a lane: a full queue overwrites its oldest sample, and waking a lane does not
//! block. The DDS library's receiving thread takes and publishes the samples ([`receiving`]); the main thread
//! does the housekeeping; a third thread wakes critical lanes early ([`early_waker`]).

mod arrival_progress;
mod early_waker;
mod input;
pub(super) mod memory;
mod patterns;
mod pool;
mod prepared;
mod publishers;
mod reader_record;
mod receiving;
mod source;

use std::sync::Arc;
use std::time::Duration;

use tracing::info;

use super::HOUSEKEEPING_MS;
use super::error::RoleError;
use super::identity::Identity;
use super::memory_limit;
use super::notify::{Meter, write_drops, write_list};
use super::place::Place;
use super::reload::ReloadRequests;
use super::role::{Role, participant_options};
use super::stop::Stop;
use super::successor::Leave;
use crate::clock;
use crate::config::{InputTopic, Route, Settings};
use crate::dds::{ArrivalFlag, Discovery, DiscoveryTurn, Participant};
use crate::model::{LaneMode, MonotonicNs, TrafficClass};
use crate::shm::{Boards, ProcessRole, ShmError, ShmNode};
use early_waker::EarlyWaker;
use input::{Input, OpenedPool};
use patterns::Patterns;
use prepared::PreparedPools;
use receiving::{Receiving, ServedLane};

/// The name of the role, and of the node.
const NAME: &str = "ingress";

/// At shutdown, how long ingress continues to take samples that DDS has received or still receives.
const LAST_SAMPLES_MS: u64 = 200;

/// The shortest interval of housekeeping. While a route has no publisher, a change that discovery reports
/// begins housekeeping at once, because a VOLATILE reader loses the samples that the publisher sends before
/// the reader exists; but not more often than this, because any host can announce endpoints.
const SEARCHING_MS: u64 = 10;

/// After a restart, how long at most the participant of a killed former process is kept. Until it is disposed
/// of, publishers retain the samples that they wrote while no ingress ran; but its reader, which acknowledges
/// nothing, also blocks a publisher whose history is full.
const RESUME_MS: u64 = 1_000;

/// How long that participant is kept once each publisher has sent the first of these samples. One request
/// names 256 samples, so the remaining ones may take two or three more requests.
const RESUMED_MS: u64 = 200;

/// How long at most a process that continues the participant of a killed one leaves samples in the sockets
/// until its readers are matched again, which takes some 10 ms with the journal of discovery. A BEST_EFFORT
/// sample that does not fit the socket's buffer is lost: with the default `net.core.rmem_max`, the 97th scan.
const HOLD_MS: u64 = 100;
/// How often it checks that.
const HOLD_POLL_MS: u64 = 1;

/// Runs ingress until `stop` is requested. No reloadable setting concerns ingress.
///
/// # Errors
/// Another process serves ingress, or shared memory or DDS cannot be opened.
pub fn ingress(settings: &Settings, reloads: ReloadRequests, stop: &Stop) -> Result<(), RoleError> {
    let role = (ProcessRole::Ingress, NAME);
    let (scheduling, standby) = (&settings.ingress_scheduling, settings.ingress_standby);
    let mut pools = PreparedPools::None;
    let mut prepare = |node: &ShmNode, settings: &Settings| pools.follow(node, settings);
    let waited = Place::wait(settings, reloads, role, scheduling, standby, stop, &mut prepare)?;
    let Some(place) = waited else { return Ok(()) };
    let settings = &place.settings().clone();
    let mut ingress = Ingress::open(settings, place, pools)?;
    info!(routes = settings.routes.len(), domain_id = settings.input.domain_id, "ingress is up");
    let leave = loop {
        if stop.is_requested() {
            match ingress.identity.leave(&ingress.participant, clock::monotonic()) {
                Leave::Soon => {}
                leave => break leave,
            }
        }
        ingress.sleep();
        if let Err(error) = ingress.housekeeping(clock::monotonic()) {
            tracing::error!(%error, "housekeeping failed");
        }
    };
    ingress.role.notifier.stopping();
    if leave == Leave::HandOver {
        info!("ingress hands over to its standby");
        // As if it were killed: what is dropped would say goodbye, and give up the readers.
        std::mem::forget(ingress);
        return Ok(());
    }
    ingress.identity.end();
    // If a killed former process was another participant: the next process does not know of it.
    ingress.role.dispose_former(&ingress.participant);
    // Publishes the samples that DDS has received by now. The time limit is for publishers that keep sending.
    let give_up_at = clock::monotonic().plus_ms(LAST_SAMPLES_MS);
    while ingress.receiving.turn(false) && clock::monotonic() < give_up_at {}
    info!("ingress is done");
    Ok(())
}

struct Ingress {
    /// Declared before the participant, so that it is dropped first: it watches the participant's sockets.
    _early_waker: Option<EarlyWaker>,
    receiving: Arc<Receiving>,
    participant: Participant,
    identity: Identity,
    role: Role,
    patterns: Patterns,
    /// Until when samples are left in the sockets at most; `None` once they are received.
    hold_until: Option<MonotonicNs>,
    /// Whether each publisher that wrote until the former process died has sent a sample to this process.
    has_resumed: bool,
    /// The latest time to dispose of the participant of a killed former process.
    resume_until: MonotonicNs,
    housekeeping_at: MonotonicNs,
    /// When a change that discovery reports may begin housekeeping; `None` if no route waits for one.
    search_at: Option<MonotonicNs>,
    received: Meter,
}

impl Drop for Ingress {
    fn drop(&mut self) {
        // The participant's thread shares the inputs, and the library requires that readers are dropped
        // before their participant.
        self.receiving.for_each_input(Input::close);
    }
}

impl Ingress {
    fn open(settings: &Settings, place: Place, pools: PreparedPools) -> Result<Self, RoleError> {
        let role = Role::open(place, ProcessRole::Ingress);
        memory_limit::check(settings, ProcessRole::Ingress);
        let urgent: Vec<_> = urgent_routes(settings).collect();
        let shared = Arc::default();
        let options = participant_options(settings, &settings.input, NAME);
        let urgent_topics = || {
            urgent.iter().filter_map(|route| match &settings.routes[*route].input_topic {
                InputTopic::Topic(topic) => Some(topic.to_dds()),
                InputTopic::Pattern(_) => None,
            })
        };
        let unfinished = pool::UNFINISHED_IN_ALL_BYTES;
        let open = |kept| {
            let (on_arriving, on_received) = Receiving::hooks(&shared);
            Participant::open_receiving(&options, kept, unfinished, urgent_topics(), on_arriving, on_received)
        };
        let standby = settings.ingress_standby;
        let (role, pools, (participant, identity, continued)) = role.open_beside(
            |node, boards| open_pools(node, boards, settings, pools),
            |role| Identity::join(role, ProcessRole::Ingress, NAME, &options, standby, open),
        )?;
        let mut inputs = Vec::with_capacity(settings.routes.len());
        for (route, pool) in pools.into_iter().enumerate() {
            let flag = ArrivalFlag::passive();
            inputs.push((Input::open(&role, settings, route, &flag, pool), flag));
        }
        let receiving = Arc::new(Receiving::new(inputs, served_lanes(settings, &role), !urgent.is_empty()));
        let _ = shared.set(Arc::clone(&receiving));
        let resume_until = clock::monotonic().plus_ms(RESUME_MS);
        let hold_until = continued.then(|| clock::monotonic().plus_ms(HOLD_MS));
        let patterns = Patterns::open(settings, &role.boards);
        let early_waker = EarlyWaker::start(&participant, &receiving, settings);
        let housekeeping_at = clock::monotonic();
        let mut ingress = Self {
            _early_waker: early_waker,
            receiving,
            participant,
            identity,
            role,
            patterns,
            hold_until,
            has_resumed: false,
            resume_until,
            housekeeping_at,
            search_at: None,
            received: Meter::default(),
        };
        ingress.resume_places(housekeeping_at);
        ingress.housekeeping(housekeeping_at)?;
        ingress.role.is_up();
        Ok(ingress)
    }

    /// Sleeps until housekeeping is due.
    #[allow(clippy::disallowed_methods, reason = "other threads receive the samples")]
    fn sleep(&self) {
        let until = |at: MonotonicNs| Duration::from_nanos(at.since(clock::monotonic()));
        match self.search_at {
            Some(search_at) => {
                std::thread::sleep(until(search_at));
                self.participant.wait_for_discovery(until(self.housekeeping_at));
            }
            None => std::thread::sleep(until(self.housekeeping_at)),
        }
    }

    fn housekeeping(&mut self, now: MonotonicNs) -> Result<(), RoleError> {
        let mut discovery_changed = false;
        let mut turn = DiscoveryTurn::new(now);
        while let Some(change) = self.participant.poll_discovery(&mut turn) {
            discovery_changed = true;
            match change {
                Discovery::Writer(writer) if !self.participant.owns(writer.guid) => {
                    self.patterns.writer_found(&writer);
                    self.for_each_input(|input, _| input.writer_found(&writer));
                }
                Discovery::WriterGone(guid) => {
                    self.patterns.writers_gone(|writer| writer == guid);
                    self.for_each_input(|input, _| input.writer_gone(guid));
                }
                Discovery::ParticipantGone { prefix, .. } => {
                    self.patterns.writers_gone(|writer| writer.prefix() == prefix);
                    self.for_each_input(|input, _| input.participant_gone(prefix));
                }
                _ => {}
            }
        }
        self.bind_places(now);
        // A topic of a pattern may appear at any time.
        let mut searching = !self.patterns.places().is_empty();
        let (mut resumed, mut matched) = (true, true);
        let mut outcome = Ok(());
        self.for_each_input(|input, participant| {
            let done = input.housekeeping(participant, now);
            outcome = std::mem::replace(&mut outcome, Ok(())).and(done);
            searching |= !input.is_connected() && !input.route.input_topic.is_place();
            resumed &= input.publishers.expected() == 0;
            matched &= input.is_matched_again();
        });
        if self.hold_until.is_some_and(|hold_until| matched || now >= hold_until) {
            self.hold_until = None;
            self.participant.receive_samples();
        }
        let turned = self.participant.have_threads_turned(now);
        self.identity.housekeeping(&self.participant, turned, discovery_changed, now);
        // Not earlier: a publisher releases samples that every matched reader has acknowledged, and the
        // readers of this process have not requested them yet.
        if resumed && !std::mem::replace(&mut self.has_resumed, true) {
            self.resume_until = self.resume_until.min(now.plus_ms(RESUMED_MS));
        }
        if now >= self.resume_until {
            self.role.dispose_former(&self.participant);
        }
        self.role.reload();
        let mut ring = false;
        self.role.status(now, |line| ring = describe(&self.receiving, &mut self.received, line, now));
        if ring {
            self.participant.ring();
        }
        if turned {
            self.role.report_turn(LaneMode::Normal as u8, 0, self.participant.network_refusals());
        }
        let holds = self.hold_until.is_some();
        // What is held back must not wait for the next search.
        self.search_at = (searching && !holds).then(|| now.plus_ms(SEARCHING_MS));
        let interval_ms = if holds { HOLD_POLL_MS } else { HOUSEKEEPING_MS };
        self.housekeeping_at = now.plus_ms(interval_ms);
        outcome
    }

    /// Returns the topics of the former process to their places.
    fn resume_places(&mut self, now: MonotonicNs) {
        for route in self.patterns.places() {
            self.receiving.with_input(route, |input| self.patterns.resume(route, input.bound(), now));
        }
    }

    /// Gives the places of patterns to the topics that discovery has reported.
    fn bind_places(&mut self, now: MonotonicNs) {
        for route in self.patterns.places() {
            self.receiving.with_input(route, |input| self.patterns.samples_at(route, input.bound(), now));
        }
        while let Some((route, topic)) = self.patterns.poll(now) {
            let ring = self.receiving.with_input(route, |input| {
                input.bind(&mut self.participant, &topic);
                self.patterns.writers_of(&topic).for_each(|writer| input.writer_found(writer));
            });
            if ring {
                self.participant.ring();
            }
        }
        self.patterns.housekeeping();
    }

    /// Calls `work` with each input, which the receiving thread cannot use meanwhile.
    fn for_each_input(&mut self, mut work: impl FnMut(&mut Input, &mut Participant)) {
        if self.receiving.for_each_input(|input| work(input, &mut self.participant)) {
            self.participant.ring();
        }
    }
}

/// Opens the pool of each route, with what a standby has prepared.
fn open_pools(
    node: &ShmNode,
    boards: &Boards,
    settings: &Settings,
    prepared: PreparedPools,
) -> Result<Vec<OpenedPool>, ShmError> {
    let pools = prepared.finish(node, settings)?.into_iter().enumerate();
    pools.map(|(route, pool)| Input::open_pool(node, boards, settings, route, pool)).collect()
}

/// The lanes, critical ones first.
fn served_lanes(settings: &Settings, role: &Role) -> Vec<ServedLane> {
    let mut lanes = Vec::with_capacity(settings.lanes.len());
    for class in [TrafficClass::Critical, TrafficClass::Noncritical] {
        for (index, lane) in settings.lanes.iter().enumerate().filter(|(_, lane)| lane.class() == class) {
            let serves = (0..settings.routes.len())
                .map(|route| lane.outputs.iter().any(|output| output.route == route))
                .collect();
            lanes.push(ServedLane { waker: role.boards.waker(index), class, serves });
        }
    }
    lanes
}

/// The routes that ingress receives before all others: those on a critical lane with a priority above the
/// lowest of all routes. A route on noncritical lanes alone never goes before a critical one.
fn urgent_routes(settings: &Settings) -> impl Iterator<Item = usize> {
    let lowest = settings.routes.iter().map(|route| route.priority).min().unwrap_or(0);
    // The ports are bound before a place has a topic.
    let is_fixed = |route: &Route| !route.input_topic.is_place();
    let routes = settings.routes.iter().enumerate();
    routes
        .filter(move |(index, route)| {
            route.priority > lowest && is_fixed(route) && settings.is_critical(*index)
        })
        .map(|(index, _)| index)
}

/// Writes the status line of ingress for the service manager. Returns whether the caller has to ring the
/// receiving thread, because this locks the inputs.
fn describe(receiving: &Receiving, received: &mut Meter, line: &mut String, now: MonotonicNs) -> bool {
    let (mut routes, mut connected, mut total) = (0, 0, 0);
    let (mut drops, mut without) = (Vec::new(), Vec::new());
    let ring = receiving.for_each_input(|input| {
        if !input.has_topic() {
            return;
        }
        routes += 1;
        total += input.counters.get().received;
        drops.push(input.counters.get().drops);
        if input.is_connected() {
            connected += 1;
        } else {
            without.push(input.route.input_topic.to_string());
        }
    });
    let per_s = received.per_s(total, now);
    *line += &format!("reading {connected} of {routes} routes, {per_s:.1} samples/s");
    write_drops(line, drops.iter());
    write_list(line, "; no publisher found yet for", without.iter());
    ring
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::parse;

    fn urgent(routes: &[(&str, u8)]) -> Vec<usize> {
        let mut text = "topics:\n".to_owned();
        for (index, (lanes, priority)) in routes.iter().enumerate() {
            text += &format!(
                "- {{id: r{index}, input_topic: /r{index}, lanes: {lanes}, priority: {priority}}}\n"
            );
        }
        urgent_routes(&parse(&text, "f.yaml", &|_| None).unwrap()).collect()
    }

    #[test]
    fn only_routes_on_a_critical_lane_are_urgent() {
        let (both, noncritical) = ("[critical, noncritical]", "[noncritical]");
        assert_eq!(urgent(&[(both, 0), (noncritical, 9), (both, 1), ("[critical]", 2)]), [2, 3]);
        assert_eq!(urgent(&[(both, 0), (noncritical, 9)]), [] as [usize; 0]);
        assert_eq!(urgent(&[(both, 5), (both, 5)]), [] as [usize; 0], "none is above the lowest");
        assert_eq!(urgent(&[(both, 5), (noncritical, 0)]), [0]);
    }
}
