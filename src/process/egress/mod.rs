//! Egress: the process of one lane. It takes the samples of the lane's routes from shared memory and writes
//! them with its own DDS writers.
//!
//! Each lane, critical or noncritical, is a process of this code; lanes are isolated because their processes
//! are separate. A critical lane sends every sample, in order, at once; [`noncritical`] chooses which samples
//! to send and when; [`output`] writes samples and accounts for them.

mod arena;
mod bound_topic;
mod early_send;
mod former_readers;
mod former_samples;
mod gaps;
mod history;
mod late_joiners;
pub(super) mod memory;
mod noncritical;
mod offer;
mod output;
mod overrun;
mod unsent;
mod writer_record;

use std::time::Duration;

use tracing::{info, warn};

use super::HOUSEKEEPING_MS;
use super::error::RoleError;
use super::identity::Identity;
use super::memory_limit;
use super::notify::{Meter, Notifier, write_drops, write_list};
use super::place::Place;
use super::reload::ReloadRequests;
use super::role::{Role, lane_index, participant_options};
use super::stop::Stop;
use super::successor::Leave;
use crate::clock;
use crate::config::{self, Configuration, Forwarding, Lane, Settings};
use crate::dds::{Discovery, DiscoveryTurn, Participant, ParticipantOptions};
use crate::model::{Guid, LaneCounters, LaneMode, LaneName, LanePolicy, MonotonicNs, TrafficClass};
use crate::policy::mode_and_source;
use crate::shm::{Boards, LaneSleeper, ProcessRole};
use arena::CopyArena;
use noncritical::Noncritical;
use output::Output;

/// Samples that a critical lane takes from one route before it serves the next one, and the samples of higher
/// priorities that it sends meanwhile. Both are limited, so that each route has its turn.
const SAMPLES_PER_TURN: usize = 32;

/// At shutdown, how long a critical lane continues to forward samples that wait or still arrive.
const LAST_SAMPLES_MS: u64 = 200;

/// At shutdown, how long a lane waits for its readers to acknowledge the last samples. The sum of both times
/// and one housekeeping interval is well below the second within which a process has to end.
const LAST_ACKNOWLEDGEMENTS_MS: u64 = 300;

/// How often a lane checks whether the DDS library has sent the samples that it accepted. The library's
/// thread takes some 100 µs for a small sample in fragments.
const UNSENT_POLL_NS: u64 = 250_000;

/// How often a lane checks whether the readers have matched that its samples wait for after a restart, and
/// whether ingress has delivered the samples of the former process.
const HOLD_POLL_MS: u64 = 1;

/// How often a lane that catches up checks whether readers have acknowledged the samples before. In the time
/// between two checks the subscribers take what was sent.
const PACE_POLL_MS: u64 = 5;

/// What the lane does after a turn.
enum Turn {
    /// Take another turn at once: samples were handled, and more may wait.
    Busy,
    /// Sleep until a sample arrives, at most until this time.
    UntilWoken(MonotonicNs),
    /// Sleep until this time: the lane may not send earlier, whatever arrives.
    Until(MonotonicNs),
}

/// Runs the egress of the lane called `name` until `stop` is requested.
///
/// # Errors
/// There is no such lane, another process serves it, or shared memory or DDS cannot be opened.
pub fn egress(
    settings: &Settings,
    name: &str,
    reloads: ReloadRequests,
    stop: &Stop,
) -> Result<(), RoleError> {
    let index = lane_index(settings, name)?;
    let Lane { scheduling, standby, .. } = &settings.lanes[index];
    let role_name = format!("egress-{name}");
    let role = (ProcessRole::Egress(index), &*role_name);
    // A standby opens no queue: ingress would deliver samples to it.
    let mut prepare = |_: &_, _: &_| ();
    let waited = Place::wait(settings, reloads, role, scheduling, *standby, stop, &mut prepare)?;
    let Some(place) = waited else {
        return Ok(());
    };
    let settings = &place.settings().clone();
    let mut egress = Egress::open(settings, index, place, &role_name)?;
    let lane = &settings.lanes[index];
    info!(
        lane = name,
        class = lane.class().label(),
        routes = lane.outputs.len(),
        domain_id = lane.network.domain_id,
        "egress is up"
    );
    let leave = loop {
        if stop.is_requested() {
            match egress.leave() {
                Leave::Soon => {}
                leave => break leave,
            }
        }
        let turn = egress.turn();
        egress.sleep(&turn);
    };
    egress.role.notifier.stopping();
    if leave == Leave::HandOver {
        info!(lane = name, "egress hands over to its standby");
        // As if it were killed: what is dropped would say goodbye, and give up the writers.
        std::mem::forget(egress);
        return Ok(());
    }
    egress.shut_down();
    info!(lane = name, "egress is done");
    Ok(())
}

/// Logs that the process of lane `name` ends because the lane has no output, and reports to the service
/// manager that it has started as it should.
pub fn end_unused(name: &str) {
    info!(lane = name, "no route has an output on this lane, so its process ends");
    Notifier::new().ready();
}

/// Logs that the service of a standby ends because the configuration has no standby for its role, and reports
/// to the service manager that it has started as it should.
pub fn end_standby(role: &str) {
    info!(role, "the configuration has no standby for this role, so this process ends");
    Notifier::new().ready();
}

/// Opens the participant of a lane: that of the former process if the lane is critical and others can't tell
/// the two apart.
fn join(
    role: &mut Role,
    lane: &Lane,
    process: ProcessRole,
    role_name: &str,
    options: &ParticipantOptions,
) -> Result<(Participant, Option<Identity>), RoleError> {
    if lane.class() != TrafficClass::Critical {
        return Ok((role.join(options)?, None));
    }
    let open = |kept| Participant::open_kept(options, kept);
    let (participant, identity, continued) =
        Identity::join(role, process, role_name, options, lane.standby, open)?;
    if !continued {
        role.dispose_former(&participant);
    }
    Ok((participant, Some(identity)))
}

struct Egress {
    index: usize,
    /// Those of the highest priority first. Declared before the participant, because the DDS library requires
    /// readers and writers to be dropped first.
    outputs: Vec<Output>,
    /// For each output, how many before it have a higher priority.
    more_urgent: Vec<usize>,
    participant: Participant,
    /// `None` if the lane does not keep its identity.
    identity: Option<Identity>,
    role: Role,
    /// Chooses which samples to send, and when; `None` in a critical lane.
    noncritical: Option<Noncritical>,
    arena: CopyArena,
    sleeper: LaneSleeper,
    /// How often boards of partial samples had changed at the last check.
    seen_progress: u32,
    policy: PolicyWatch,
    housekeeping_at: MonotonicNs,
    applied_mode: LaneMode,
    offered: Meter,
    forwarded: Meter,
}

impl Egress {
    fn open(settings: &Settings, index: usize, place: Place, role_name: &str) -> Result<Self, RoleError> {
        let lane = &settings.lanes[index];
        let process = ProcessRole::Egress(index);
        let role = Role::open(place, process);
        memory_limit::check(settings, process);
        let node = format!("egress_{}", lane.name);
        let options =
            ParticipantOptions { dscp: lane.dscp, ..participant_options(settings, &lane.network, &node) };
        let (role, queues, (mut participant, identity)) = role.open_beside(
            |node, _| {
                let queue = |output: &config::Output| Output::open_queue(node, settings, lane, output.route);
                lane.outputs.iter().map(queue).collect::<Result<Vec<_>, _>>()
            },
            |role| join(role, lane, process, role_name, &options),
        )?;
        let mut outputs = Vec::with_capacity(lane.outputs.len());
        let mut more_urgent = Vec::with_capacity(lane.outputs.len());
        let priority = |output: &config::Output| settings.routes[output.route].priority;
        for (output, queue) in lane.outputs.iter().zip(queues) {
            more_urgent.push(lane.outputs.partition_point(|other| priority(other) > priority(output)));
            outputs.push(Output::open(&role, &mut participant, settings, index, output, queue)?);
        }
        let now = clock::monotonic();
        let noncritical = match &lane.forwarding {
            Forwarding::Everything => None,
            Forwarding::Limited(rates) => {
                Some(Noncritical::new(lane, &more_urgent, *rates, &settings.safety.rules, now))
            }
        };
        let sleeper = role.boards.sleeper(index);
        let mut egress = Self {
            index,
            policy: PolicyWatch {
                lane: index,
                name: lane.name.clone(),
                class: lane.class(),
                policy_hold_ms: settings.policy_hold_ms,
                policy: LanePolicy::default(),
                mode: LaneMode::Normal,
            },
            role,
            participant,
            identity,
            outputs,
            more_urgent,
            noncritical,
            arena: CopyArena::new(),
            seen_progress: sleeper.progress(),
            sleeper,
            housekeeping_at: now,
            applied_mode: LaneMode::Normal,
            offered: Meter::default(),
            forwarded: Meter::default(),
        };
        egress.collect_former();
        egress.housekeeping(now);
        egress.role.is_up();
        Ok(egress)
    }

    fn turn(&mut self) -> Turn {
        let now = clock::monotonic();
        if now >= self.housekeeping_at {
            self.housekeeping(now);
        }
        let mode = self.policy.update(&self.role.boards, now);
        if mode != self.applied_mode {
            for output in &mut self.outputs {
                output.set_mode(mode);
            }
            self.applied_mode = mode;
        }
        if let Some(lane) = &mut self.noncritical {
            return lane.step(&mut self.outputs, &mut self.participant, &mut self.arena, mode);
        }
        let progress = self.sleeper.progress();
        if std::mem::replace(&mut self.seen_progress, progress) != progress {
            // Before samples are taken: a sample is published before the next one is on the board.
            for output in &mut self.outputs {
                output.read_progress();
            }
        }
        self.collect_former();
        let mut turn = Turn::UntilWoken(MonotonicNs(u64::MAX));
        for place in 0..self.outputs.len() {
            // The samples of higher priorities that may still go first; the count of wakes at the last check.
            let (mut ahead, mut seen) = (SAMPLES_PER_TURN, None);
            for _ in 0..SAMPLES_PER_TURN {
                let Some(sample) = self.outputs[place].take() else {
                    self.outputs[place].follow_progress();
                    break;
                };
                turn = Turn::Busy;
                let wakes = Some(self.sleeper.wakes());
                if std::mem::replace(&mut seen, wakes) != wakes {
                    for urgent in 0..self.more_urgent[place] {
                        while ahead > 0
                            && let Some(sample) = self.outputs[urgent].take()
                        {
                            ahead -= 1;
                            self.outputs[urgent].send(sample, &mut self.participant, &mut self.arena);
                        }
                    }
                }
                self.outputs[place].send(sample, &mut self.participant, &mut self.arena);
                if ahead == 0 {
                    break;
                }
            }
        }
        turn
    }

    fn collect_former(&mut self) {
        for output in &mut self.outputs {
            output.collect_former(&mut self.participant, &mut self.arena);
        }
    }

    fn sleep(&mut self, turn: &Turn) {
        let (until, woken) = match *turn {
            Turn::Busy => return,
            Turn::UntilWoken(until) => (until, true),
            Turn::Until(until) => (until, false),
        };
        let mut until = MonotonicNs(until.0.min(self.housekeeping_at.0));
        let now = clock::monotonic();
        if self.count_sent() {
            until = MonotonicNs(until.0.min(now.plus_ns(UNSENT_POLL_NS).0));
        }
        if self.outputs.iter().any(|output| output.is_held() || output.collects_former()) {
            until = MonotonicNs(until.0.min(now.plus_ms(HOLD_POLL_MS).0));
        } else if self.outputs.iter().any(Output::is_paced) {
            until = MonotonicNs(until.0.min(now.plus_ms(PACE_POLL_MS).0));
        }
        let wait_ns = until.since(now);
        if wait_ns == 0 {
            return;
        }
        if woken {
            self.sleeper.sleep(Duration::from_nanos(wait_ns));
        } else {
            #[allow(clippy::disallowed_methods, reason = "no sample may end this wait")]
            std::thread::sleep(Duration::from_nanos(wait_ns));
        }
    }

    /// Counts the samples that the DDS library has sent by now, and returns whether some are still unsent.
    fn count_sent(&mut self) -> bool {
        let mut unsent = false;
        for output in &mut self.outputs {
            unsent |= output.count_sent();
        }
        unsent
    }

    fn housekeeping(&mut self, now: MonotonicNs) {
        let mut gone = Vec::new();
        let mut discovery_changed = false;
        let mut turn = DiscoveryTurn::new(now);
        while let Some(change) = self.participant.poll_discovery(&mut turn) {
            discovery_changed = true;
            if matches!(change, Discovery::ReaderGone(_) | Discovery::ParticipantGone { .. }) {
                gone.push(change);
            }
        }
        for output in &mut self.outputs {
            output.housekeeping(&mut self.participant, now);
            // After housekeeping, which may have recorded a reader that is already gone as unmatched.
            if !gone.is_empty() {
                output.forget_unmatched(|reader| gone.iter().any(|change| takes_away(change, reader)));
            }
        }
        let turned = self.participant.have_threads_turned(now);
        if let Some(identity) = &mut self.identity {
            identity.housekeeping(&self.participant, turned, discovery_changed, now);
        }
        if let Some(lane) = &mut self.noncritical
            && self
                .outputs
                .iter_mut()
                .fold(false, |changed, output| output.durability.take_change() | changed)
        {
            lane.follow_publishers(&mut self.outputs, now);
        }
        self.reload(now);
        // While a thread of the DDS library hangs, the lane forwards nothing. Without this report the
        // watchdog restarts the process.
        if turned {
            let refusals = self.participant.network_refusals();
            self.role.report_turn(self.policy.mode as u8, self.policy.policy.epoch, refusals);
        }
        self.role.status(now, |line| {
            let counters = || self.outputs.iter().map(|output| output.counters.get());
            let offered_per_s = self.offered.per_s(counters().map(LaneCounters::received).sum(), now);
            let forwarded_per_s = self.forwarded.per_s(counters().map(|one| one.forwarded).sum(), now);
            let mode = self.policy.mode;
            *line += &format!("mode {mode}; forwarding {forwarded_per_s:.1} of {offered_per_s:.1} samples/s");
            write_drops(line, counters().map(|one| &one.drops));
            let without = self.outputs.iter().filter(|output| output.writer.is_none());
            write_list(line, "; type not known yet for route", without.map(|output| &output.id));
        });
        self.housekeeping_at = now.plus_ms(HOUSEKEEPING_MS);
    }

    fn reload(&mut self, now: MonotonicNs) {
        let Some(Configuration { settings, .. }) = self.role.reload() else {
            return;
        };
        self.policy.policy_hold_ms = settings.policy_hold_ms;
        let forwarding = &settings.lanes[self.index].forwarding;
        if let (Some(lane), Forwarding::Limited(rates)) = (&mut self.noncritical, forwarding) {
            lane.set_rates(*rates, &settings.safety.rules, &mut self.outputs, now);
        }
        for output in &mut self.outputs {
            output.set_forwarding(forwarding);
        }
    }

    fn leave(&mut self) -> Leave {
        let now = clock::monotonic();
        let leave = |identity: &mut Identity| identity.leave(&self.participant, now);
        self.identity.as_mut().map_or(Leave::ForGood, leave)
    }

    /// Forwards the samples that still wait, as far as the lane's mode allows, and accounts for the rest.
    fn shut_down(&mut self) {
        let began_at = clock::monotonic();
        if let Some(lane) = &mut self.noncritical {
            lane.shut_down(&mut self.outputs);
        } else {
            self.outputs.iter_mut().for_each(Output::end_hold);
            let last_at = began_at.plus_ms(LAST_SAMPLES_MS);
            while clock::monotonic() < last_at && matches!(self.turn(), Turn::Busy) {}
        }
        if let Some(identity) = &mut self.identity {
            identity.end();
        }
        let give_up_at = began_at.plus_ms(LAST_SAMPLES_MS + LAST_ACKNOWLEDGEMENTS_MS);
        for output in &mut self.outputs {
            let timeout = Duration::from_nanos(give_up_at.since(clock::monotonic()));
            let writer = output.writer.as_ref();
            if !writer.is_none_or(|writer| writer.wait_acknowledged(timeout)) {
                warn!(
                    route = output.id,
                    "a reader had not acknowledged the last samples when the lane shut down"
                );
            }
        }
        while self.count_sent() && clock::monotonic() < give_up_at {
            #[allow(clippy::disallowed_methods, reason = "the lane shuts down")]
            std::thread::sleep(Duration::from_nanos(UNSENT_POLL_NS));
        }
        for output in &mut self.outputs {
            output.shut_down();
            // The next process counts as unconfirmed what is not acknowledged now.
            output.record_readers(clock::monotonic());
        }
    }
}

/// Whether a change of discovery is the end of a reader.
fn takes_away(change: &Discovery, reader: Guid) -> bool {
    match change {
        Discovery::ReaderGone(gone) => *gone == reader,
        Discovery::ParticipantGone { prefix, .. } => *prefix == reader.prefix(),
        _ => false,
    }
}

/// Follows this lane's policy on the policy board.
struct PolicyWatch {
    lane: usize,
    name: LaneName,
    class: TrafficClass,
    policy_hold_ms: u64,
    policy: LanePolicy,
    mode: LaneMode,
}

impl PolicyWatch {
    /// Reads the policy board and returns the mode in force now. While the board cannot be read, the policy
    /// of the last call applies.
    fn update(&mut self, boards: &Boards, now: MonotonicNs) -> LaneMode {
        if let Some(policy) = boards.policy(self.lane) {
            self.policy = policy;
        }
        let (mode, _) = mode_and_source(&self.policy, self.class, now, self.policy_hold_ms);
        if mode != self.mode {
            info!(
                lane = self.name.as_str(),
                from = self.mode.label(),
                to = mode.label(),
                by_hand = self.policy.is_overridden(now),
                "mode changed"
            );
            self.mode = mode;
        }
        mode
    }
}
