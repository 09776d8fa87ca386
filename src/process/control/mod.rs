//! The control process: probes and classifies the subscribers, decides each lane's mode, monitors the health
//! of the other processes, publishes diagnostics.
//!
//! The data plane never waits for control. Control writes its decisions to the policy board and confirms them
//! ten times a second; when the confirmations stop, the lanes fall back to safe modes by themselves.

mod absences;
mod diagnostics;
mod intruders;
mod link;
pub(super) mod memory;
mod parameters;
mod safety;
mod subscribers;

use std::time::Duration;

use tracing::{error, info};

use super::HOUSEKEEPING_MS;
use super::count_log::RefusalLog;
use super::error::RoleError;
use super::memory_limit;
use super::notify::write_list;
use super::place::Place;
use super::probes::Trust;
use super::reload::ReloadRequests;
use super::role::{Role, participant_options};
use super::stop::Stop;
use crate::clock;
use crate::config::{Configuration, DdsNetwork, InlineSecret, Settings};
use crate::dds::Participant;
use crate::model::{
    ControlRecord, FixedText, LaneMode, LanePolicy, MonotonicNs, NetworkRefusals, ProbeRefusal,
    RefusalCounts, SafetyMode,
};
use crate::policy::{LaneDecision, LaneReason, safety_floor};
use crate::shm::{BoardWriter, ProcessRole};
use diagnostics::Diagnostics;
use intruders::EndpointMonitor;
use link::{InvalidResponses, Link};
use parameters::ParameterServices;
use safety::Supervision;
use subscribers::Subscribers;

/// Responses that control handles in one turn, of all links together. The rest of a flood waits in the DDS
/// reader, where it overwrites its own messages.
const RESPONSES_PER_TURN: usize = 2048;

/// Runs the control process until `stop` is requested. `secret` is the secret in the configuration file, if
/// the file contains one.
///
/// # Errors
/// Another control process of the instance is running, or shared memory or DDS is not available.
pub fn control(
    settings: &Settings,
    secret: Option<&InlineSecret>,
    reloads: ReloadRequests,
    stop: &Stop,
) -> Result<(), RoleError> {
    let mut control = Control::open(settings, secret, reloads)?;
    info!(
        subscribers = settings.subscribers.len(),
        probes = settings.probes.enabled,
        classifier = settings.classifier.enabled,
        networks = control.participants.len(),
        "control is up"
    );
    while !stop.is_requested() {
        let until = control.turn();
        control.sleep(until);
    }
    control.role.notifier.stopping();
    info!("control is done");
    Ok(())
}

struct Control {
    settings: Settings,
    /// For each lane, the index of its network in `links` and `participants`.
    link_of_lane: Vec<usize>,
    /// Declared before the participants: the DDS library requires readers and writers to be dropped first.
    links: Vec<Link>,
    diagnostics: Diagnostics,
    parameters: ParameterServices,
    endpoints: EndpointMonitor,
    /// One for each network; the first is on the input network.
    participants: Vec<Participant>,
    role: Role,
    record: BoardWriter<ControlRecord>,
    /// `None` if the secret cannot be loaded: then control sends no probes.
    trust: Option<Trust>,
    subscribers: Subscribers,
    supervision: Supervision,
    invalid_responses: InvalidResponses,
    refused_log: RefusalLog,
    accepted_log: RefusalLog,
    /// The last decision for each lane as text, to log changes only.
    decisions: Vec<String>,
    next_probe_at: MonotonicNs,
    next_evaluation_at: MonotonicNs,
    next_supervision_at: MonotonicNs,
    next_housekeeping_at: MonotonicNs,
}

impl Control {
    fn open(
        settings: &Settings,
        secret: Option<&InlineSecret>,
        reloads: ReloadRequests,
    ) -> Result<Self, RoleError> {
        let scheduling = &settings.control_scheduling;
        let place = Place::take(settings, reloads, "control", scheduling)?;
        let mut role = Role::open(place, ProcessRole::Control);
        memory_limit::check(settings, ProcessRole::Control);
        let (networks, link_of_lane) = networks(settings);
        let mut participants = Vec::with_capacity(networks.len());
        for network in &networks {
            let options = participant_options(settings, network, "control");
            // Only the first participant joins through the role: the health board records one participant,
            // which a restarted control disposes of if the former process was killed.
            let opened =
                if participants.is_empty() { role.join(&options)? } else { Participant::open(&options)? };
            participants.push(opened);
        }
        // Opens the links even while probing is off: a reload may switch it on.
        let links = participants.iter_mut().map(|participant| Link::open(participant, settings));
        let links = links.collect::<Result<_, _>>()?;
        let now = clock::monotonic();
        let mut record = role.boards.control_writer();
        record.update(|record| {
            *record = ControlRecord { safety_since: now, ..ControlRecord::default() };
        });
        Ok(Self {
            subscribers: Subscribers::new(&role.boards, settings, &link_of_lane, now),
            supervision: Supervision::new(&role.boards, settings, now),
            endpoints: EndpointMonitor::open(&role.boards, settings, &mut participants)?,
            diagnostics: Diagnostics::open(&role.boards, settings, &mut participants[0])?,
            parameters: ParameterServices::open(
                settings,
                role.parameter_store(),
                &mut participants,
                &link_of_lane,
            )?,
            trust: load_trust(settings, secret),
            settings: settings.clone(),
            link_of_lane,
            links,
            participants,
            record,
            invalid_responses: InvalidResponses::default(),
            refused_log: RefusalLog::new(RefusalCounts::default()),
            accepted_log: RefusalLog::new(RefusalCounts::default()),
            decisions: vec![String::new(); settings.lanes.len()],
            next_probe_at: now,
            next_evaluation_at: now,
            next_supervision_at: now,
            next_housekeeping_at: now,
            role,
        })
    }

    /// Does the work that is due and returns when the next work is due.
    fn turn(&mut self) -> MonotonicNs {
        let now = clock::monotonic();
        self.subscribers.note_awake(now);
        self.receive();
        if now >= self.next_probe_at {
            self.probe();
            self.next_probe_at = next_due(self.next_probe_at, self.settings.probes.rate_hz, now);
        }
        let is_due = now >= self.next_evaluation_at
            || now >= self.next_supervision_at
            || now >= self.next_housekeeping_at;
        if now >= self.next_evaluation_at {
            self.evaluate(now);
            let rate_hz = self.settings.classifier.evaluate_rate_hz;
            self.next_evaluation_at = next_due(self.next_evaluation_at, rate_hz, now);
        }
        if now >= self.next_supervision_at {
            self.supervision.evaluate(&self.role.boards, &self.settings, now);
            let rate_hz = self.settings.safety.evaluate_rate_hz;
            self.next_supervision_at = next_due(self.next_supervision_at, rate_hz, now);
        }
        if is_due {
            self.decide(now);
        }
        if now >= self.next_housekeeping_at {
            self.housekeeping(now);
            self.next_housekeeping_at = now.plus_ms(HOUSEKEEPING_MS);
        }
        let others = [self.next_probe_at, self.next_evaluation_at, self.next_supervision_at];
        others.into_iter().fold(self.next_housekeeping_at, Ord::min)
    }

    /// Sleeps until a response arrives, or until `until` at the latest.
    fn sleep(&mut self, until: MonotonicNs) {
        let wait_ns = until.since(clock::monotonic());
        if wait_ns > 0 {
            #[allow(clippy::disallowed_methods, reason = "control handles no samples")]
            std::thread::park_timeout(Duration::from_nanos(wait_ns));
        }
        self.subscribers.expected_awake_at = until;
    }

    fn receive(&mut self) {
        let Some(trust) = &mut self.trust else { return };
        let share = RESPONSES_PER_TURN / self.links.len().max(1);
        let (mut invalid, mut late, mut accepted) =
            (InvalidResponses::default(), RefusalCounts::default(), 0);
        for (number, link) in self.links.iter_mut().enumerate() {
            // A flood on one network takes nothing from the others.
            let mut budget = share;
            while let Some(response) = link.receive(trust, &mut invalid, &mut budget) {
                match self.subscribers.on_response(number, link, &response, &self.settings) {
                    Ok(()) => accepted += 1,
                    // Expected on a bad link and already counted as loss: not logged.
                    Err(ProbeRefusal::Late) => late.add(ProbeRefusal::Late, 1),
                    Err(reason) => invalid.refused.add(reason, 1),
                }
            }
        }
        let counts = [&invalid.refused, &invalid.accepted, &late];
        if accepted > 0 || counts.iter().any(|counts| counts.total() > 0) {
            self.record.update(|record| {
                record.responses_accepted += accepted;
                counts.iter().for_each(|counts| record.refused.merge(counts));
            });
            self.invalid_responses.refused.merge(&invalid.refused);
            self.invalid_responses.accepted.merge(&invalid.accepted);
        }
    }

    fn probe(&mut self) {
        let Some(trust) = self.trust.as_mut().filter(|_| self.settings.probes.enabled) else { return };
        let mut sent = 0;
        for (number, link) in self.links.iter_mut().enumerate() {
            if let Some(probe) = link.send(trust) {
                self.subscribers.on_probe_sent(number, probe.seq, probe.sent_at);
                sent += 1;
            }
        }
        if sent > 0 {
            self.record.update(|record| record.probes_sent += sent);
        }
    }

    fn evaluate(&mut self, now: MonotonicNs) {
        self.subscribers.evaluate(&self.settings, now, |changed| self.diagnostics.publish(changed));
        self.subscribers.write_table(&self.settings);
        self.diagnostics.publish_states(self.subscribers.decisions(&self.settings), now);
    }

    /// Writes or confirms the policy of each lane.
    fn decide(&mut self, now: MonotonicNs) {
        let decisions: Vec<_> = (0..self.settings.lanes.len()).map(|lane| self.decide_lane(lane)).collect();
        // One lock for the policies of all lanes.
        let policies = match self.role.boards.policies() {
            Ok(policies) => policies,
            Err(error) => {
                error!(%error, "cannot write the policies");
                self.role.failed();
                return;
            }
        };
        for (lane, (mode, safety_floor)) in decisions.into_iter().enumerate() {
            policies.set(lane, now, |previous| LanePolicy {
                mode: mode as u8,
                safety_floor: safety_floor as u8,
                written_at: now,
                ..previous
            });
        }
    }

    /// Decides a lane's mode and its safety floor, the mildest mode that the supervisor allows.
    fn decide_lane(&mut self, lane: usize) -> (LaneMode, LaneMode) {
        let class = self.settings.lanes[lane].class();
        let decision = self.subscribers.lane_mode(&self.settings, lane);
        let safety_floor = safety_floor(
            class,
            self.supervision.supervisor.mode(),
            self.supervision.critical_trouble,
            &self.settings.safety.rules,
        );
        let text = decision_text(&decision, safety_floor, self.supervision.supervisor.mode());
        if self.decisions[lane] != text {
            info!(lane = self.settings.lanes[lane].name.as_str(), "control decided: {text}");
            self.decisions[lane] = text;
        }
        (decision.mode, safety_floor)
    }

    /// Writes the state of the whole bridge to control's record on the boards.
    fn write_record(&mut self) {
        let record = ControlRecord {
            safety: self.supervision.supervisor.mode() as u8,
            safety_since: self.supervision.since,
            safety_transitions: self.supervision.supervisor.transitions(),
            safety_reason: FixedText::new(&self.supervision.reason),
            subscribers: self.subscribers.count() as u64,
            intruders: self.endpoints.intruder_count as u64,
            intruders_seen: self.endpoints.intruders_seen(),
            classifies: u8::from(
                self.settings.classifier.enabled && self.settings.probes.enabled && self.trust.is_some(),
            ),
            without_secret: u8::from(self.trust.is_none()),
            parameter_requests: self.parameters.counts(),
            ..*self.record.get()
        };
        self.record.set(record);
    }

    fn housekeeping(&mut self, now: MonotonicNs) {
        if let Some(Configuration { settings, inline_secret }) = self.role.reload() {
            self.settings = settings.clone();
            let trust = load_trust(settings, inline_secret.as_ref());
            self.trust = match (trust, self.trust.take()) {
                (Some(trust), Some(former)) => Some(trust.continuing(former)),
                (trust, _) => trust,
            };
            self.subscribers.apply(&self.settings, &self.link_of_lane, now);
            self.links.iter_mut().for_each(|link| link.apply(&self.settings, now));
            // At once, together with the resulting modes, instead of at the next evaluation.
            self.subscribers.write_table(&self.settings);
            self.diagnostics.apply(&self.settings);
            self.parameters.apply(&self.settings);
            self.decide(now);
        }
        self.endpoints.housekeeping(&mut self.participants, &self.settings, now);
        self.refused_log.log_refused(&self.invalid_responses.refused, now);
        self.accepted_log.log_accepted(&self.invalid_responses.accepted, now);
        self.write_record();
        // Checks every participant, also after one has failed, because the check wakes its threads.
        let turned = self.participants.iter_mut().map(|participant| participant.have_threads_turned(now));
        if turned.fold(true, |all, one| all & one) {
            let mut refusals = NetworkRefusals::default();
            for participant in &self.participants {
                refusals.merge(&participant.network_refusals());
            }
            self.role.report_turn(self.supervision.supervisor.mode() as u8, 0, refusals);
        }
        // Only the first call has an effect: control has completed its first turn.
        self.role.notifier.ready();
        self.role.status(now, |line| {
            let record = self.record.get();
            *line += &format!("safety mode {}; {} subscribers", record.safety(), record.subscribers);
            let lanes = self.settings.lanes.iter().zip(&self.decisions);
            write_list(line, "; lanes:", lanes.map(|(lane, decision)| format!("{} {decision}", lane.name)));
        });
    }
}

/// Loads the secret. Without it control runs on, but sends no probes.
fn load_trust(settings: &Settings, secret: Option<&InlineSecret>) -> Option<Trust> {
    let failed = "no subscriber is probed, so that every subscriber keeps its state";
    Trust::load(&settings.security, secret).inspect_err(|error| error!("{failed}: {error}")).ok()
}

/// The next instant of periodic work that was due at `due`. Missed periods are skipped.
fn next_due(due: MonotonicNs, rate_hz: f64, now: MonotonicNs) -> MonotonicNs {
    let period_ns = (1e9 / rate_hz).round() as u64;
    let next = due.plus_ns(period_ns);
    if next > now { next } else { now.plus_ns(period_ns) }
}

/// The networks that control joins, the input network first, and the index of each lane's network.
pub(super) fn networks(settings: &Settings) -> (Vec<DdsNetwork>, Vec<usize>) {
    let mut networks = vec![settings.input.clone()];
    let mut of_lane = Vec::with_capacity(settings.lanes.len());
    for lane in &settings.lanes {
        let known = networks.iter().position(|network| *network == lane.network);
        of_lane.push(known.unwrap_or_else(|| {
            networks.push(lane.network.clone());
            networks.len() - 1
        }));
    }
    (networks, of_lane)
}

fn decision_text(decision: &LaneDecision<'_>, safety_floor: LaneMode, safety: SafetyMode) -> String {
    if safety_floor as u8 > decision.mode as u8 {
        return format!("{safety_floor} (safety mode {safety})");
    }
    let mode = decision.mode.label();
    match decision.reason {
        LaneReason::Subscriber { worst, impaired: 1 } => format!("{mode}, because of subscriber {worst}"),
        LaneReason::Subscriber { worst, impaired } => {
            format!("{mode}, because of {impaired} subscribers, {worst} among them")
        }
        reason => format!("{mode} ({})", reason.label()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periodic_work_keeps_its_period_and_skips_missed_ones() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        assert_eq!(next_due(at(1_000), 5.0, at(1_003)), at(1_200));
        assert_eq!(next_due(at(1_000), 5.0, at(9_000)), at(9_200));
    }
}
