//! Control: probes every subscriber's host, classifies it, decides each lane's mode, watches the health of
//! all the others, publishes diagnostics.
//!
//! Nothing of the data plane waits for it. What it decides stands on the policy board, which it confirms ten
//! times a second; when it no longer does, the lanes fall back to safe modes by themselves.

mod absences;
mod diagnostics;
mod intruders;
mod link;
mod safety;
mod subscribers;

use std::fmt::Write;
use std::time::Duration;

use tracing::{error, info};

use super::HOUSEKEEPING_MS;
use super::notify::write_list;
use super::probes::{RefusalWatch, Trust};
use super::reload::ReloadRequests;
use super::role::{Role, RoleError, namespace};
use super::stop::Stop;
use crate::clock;
use crate::config::{Configuration, DdsNetwork, InlineSecret, Settings};
use crate::dds::{Participant, ParticipantOptions};
use crate::model::{
    ControlRecord, FixedText, LaneMode, LanePolicy, MonotonicNs, ProbeRefusal, RefusalCounts, SafetyMode,
};
use crate::policy::{LaneDecision, LaneReason, safety_floor};
use crate::shm::{BoardWriter, ProcessRole};
use diagnostics::Diagnostics;
use intruders::Guard;
use link::{Doubts, Link};
use safety::Supervision;
use subscribers::Subscribers;

/// Responses looked at in a turn, of all links together. A flood waits for the next turn, and what it
/// overwrites in the DDS reader meanwhile is its own.
const RESPONSES_PER_TURN: usize = 2048;

/// Runs the control process until `stop` is requested. `secret` is the one that stands in the configuration
/// file, if one does.
///
/// # Errors
/// Control runs already, or shared memory or DDS cannot be had.
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
    control.role.stopping();
    info!("control is done");
    Ok(())
}

struct Control {
    settings: Settings,
    /// The number of each lane's network.
    link_of_lane: Vec<usize>,
    /// Before the participants: the DDS library wants its readers and writers gone first.
    links: Vec<Link>,
    diagnostics: Diagnostics,
    guard: Guard,
    /// The first is that of the input network.
    participants: Vec<Participant>,
    role: Role,
    record: BoardWriter<ControlRecord>,
    /// `None` when the secret cannot be had: then nobody is probed.
    trust: Option<Trust>,
    subscribers: Subscribers,
    supervision: Supervision,
    doubts: Doubts,
    refused: RefusalWatch,
    accepted: RefusalWatch,
    /// What was decided last for each lane, to tell a change.
    decided: Vec<String>,
    probe_at: MonotonicNs,
    evaluate_at: MonotonicNs,
    supervise_at: MonotonicNs,
    housekeeping_at: MonotonicNs,
}

impl Control {
    fn open(
        settings: &Settings,
        secret: Option<&InlineSecret>,
        reloads: ReloadRequests,
    ) -> Result<Self, RoleError> {
        let how = &settings.control_scheduling;
        let mut role = Role::open(settings, reloads, ProcessRole::Control, "control", how)?;
        let (networks, link_of_lane) = networks(settings);
        let mut participants = Vec::with_capacity(networks.len());
        for network in &networks {
            let options = ParticipantOptions {
                network,
                namespace: namespace(settings),
                node_name: "control".to_owned(),
                graph_gid_bytes: settings.graph_gid_bytes,
            };
            // One participant at most can be said goodbye for by a successor.
            let opened =
                if participants.is_empty() { role.join(&options)? } else { Participant::open(&options)? };
            participants.push(opened);
        }
        // Also while probing is off: it can be switched on by a reload.
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
            guard: Guard::open(&role.boards, settings, &mut participants)?,
            diagnostics: Diagnostics::open(&role.boards, settings, &mut participants[0])?,
            trust: trust(settings, secret),
            settings: settings.clone(),
            link_of_lane,
            links,
            participants,
            record,
            doubts: Doubts::default(),
            refused: RefusalWatch::of_refused(),
            accepted: RefusalWatch::of_accepted(),
            decided: vec![String::new(); settings.lanes.len()],
            probe_at: now,
            evaluate_at: now,
            supervise_at: now,
            housekeeping_at: now,
            role,
        })
    }

    /// Does what is due, and says when the next is.
    fn turn(&mut self) -> MonotonicNs {
        let now = clock::monotonic();
        self.subscribers.awake(now);
        self.receive();
        if now >= self.probe_at {
            self.probe();
            self.probe_at = next(self.probe_at, self.settings.probes.rate_hz, now);
        }
        let is_due = now >= self.evaluate_at || now >= self.supervise_at || now >= self.housekeeping_at;
        if now >= self.evaluate_at {
            self.evaluate(now);
            self.evaluate_at = next(self.evaluate_at, self.settings.classifier.evaluate_rate_hz, now);
        }
        if now >= self.supervise_at {
            self.supervision.evaluate(&self.role.boards, &self.settings, now);
            self.supervise_at = next(self.supervise_at, self.settings.safety.evaluate_rate_hz, now);
        }
        if is_due {
            self.decide(now);
        }
        if now >= self.housekeeping_at {
            self.keep_house(now);
            self.housekeeping_at = now.plus_ms(HOUSEKEEPING_MS);
        }
        [self.probe_at, self.evaluate_at, self.supervise_at].into_iter().fold(self.housekeeping_at, Ord::min)
    }

    /// Sleeps until a response arrives, or until then at most.
    fn sleep(&mut self, until: MonotonicNs) {
        let wait_ns = until.since(clock::monotonic());
        if wait_ns > 0 {
            std::thread::park_timeout(Duration::from_nanos(wait_ns));
        }
        self.subscribers.asleep(until);
    }

    fn receive(&mut self) {
        let Some(trust) = &mut self.trust else { return };
        let mut budget = RESPONSES_PER_TURN;
        let (mut doubts, mut late, mut accepted) = (Doubts::default(), RefusalCounts::default(), 0);
        for (number, link) in self.links.iter_mut().enumerate() {
            while let Some(response) = link.receive(trust, &mut doubts, &mut budget) {
                match self.subscribers.answered(number, link, &response, &self.settings) {
                    Ok(()) => accepted += 1,
                    // It is what a bad link does, and counted as loss: nothing to warn of.
                    Err(ProbeRefusal::Late) => late.add(ProbeRefusal::Late),
                    Err(reason) => doubts.refused.add(reason),
                }
            }
        }
        let counts = [&doubts.refused, &doubts.accepted, &late];
        if accepted > 0 || counts.iter().any(|counts| counts.total() > 0) {
            self.record.update(|record| {
                record.responses_accepted += accepted;
                counts.iter().for_each(|counts| record.refused.merge(counts));
            });
            self.doubts.refused.merge(&doubts.refused);
            self.doubts.accepted.merge(&doubts.accepted);
        }
    }

    fn probe(&mut self) {
        let Some(trust) = self.trust.as_mut().filter(|_| self.settings.probes.enabled) else { return };
        let mut sent = 0;
        for (number, link) in self.links.iter_mut().enumerate() {
            if let Some(probe) = link.send(trust) {
                self.subscribers.sent(number, probe.seq, probe.sent_at);
                sent += 1;
            }
        }
        if sent > 0 {
            self.record.update(|record| record.probes_sent += sent);
        }
    }

    /// One evaluation of the subscribers.
    fn evaluate(&mut self, now: MonotonicNs) {
        for change in self.subscribers.evaluate(&self.settings, now) {
            self.diagnostics.decision(&change, &self.settings);
        }
        self.subscribers.show(&self.settings);
        self.diagnostics.states(&self.subscribers, &self.settings, now);
    }

    /// Writes, or confirms, what each lane is to do.
    fn decide(&mut self, now: MonotonicNs) {
        let decisions: Vec<_> = (0..self.settings.lanes.len()).map(|lane| self.decision(lane)).collect();
        // All of them under one lock, ten times a second.
        let policies = match self.role.boards.policies() {
            Ok(policies) => policies,
            Err(error) => {
                error!(%error, "policies not written");
                self.role.failed();
                return;
            }
        };
        for (lane, (mode, safety_floor)) in decisions.into_iter().enumerate() {
            policies.set(lane, now, |former| LanePolicy {
                mode: mode as u8,
                safety_floor: safety_floor as u8,
                written_at: now,
                ..former
            });
        }
    }

    /// The mode of a lane, and the one that safety demands at least. Says so when they are others.
    fn decision(&mut self, lane: usize) -> (LaneMode, LaneMode) {
        let class = self.settings.lanes[lane].class;
        let decision = self.subscribers.lane_mode(&self.settings, lane);
        let safety_floor = safety_floor(
            class,
            self.supervision.mode(),
            self.supervision.critical_trouble(),
            &self.settings.safety.rules,
        );
        let text = decision_text(&decision, safety_floor, self.supervision.mode());
        if self.decided[lane] != text {
            info!(lane = self.settings.lanes[lane].name.as_str(), "control decides: {text}");
            self.decided[lane] = text;
        }
        (decision.mode, safety_floor)
    }

    /// Shows what was found and decided for the bridge as a whole.
    fn show(&mut self) {
        let shown = ControlRecord {
            safety: self.supervision.mode() as u8,
            safety_since: self.supervision.since(),
            safety_transitions: self.supervision.transitions(),
            safety_reason: FixedText::new(self.supervision.reason()),
            subscribers: self.subscribers.count() as u64,
            intruders: self.guard.shown() as u64,
            intruders_seen: self.guard.seen(),
            classifies: u8::from(
                self.settings.classifier.enabled && self.settings.probes.enabled && self.trust.is_some(),
            ),
            without_secret: u8::from(self.trust.is_none()),
            ..*self.record.get()
        };
        if shown != *self.record.get() {
            self.record.update(|record| *record = shown);
        }
    }

    fn keep_house(&mut self, now: MonotonicNs) {
        if let Some(Configuration { settings, inline_secret }) = self.role.reload() {
            self.settings = settings.clone();
            self.trust = trust(settings, inline_secret.as_ref());
            self.subscribers.adopt(&self.settings, &self.link_of_lane, now);
            // With the modes that follow from it, and not an evaluation later.
            self.subscribers.show(&self.settings);
            self.diagnostics.adopt(&self.settings);
            self.decide(now);
        }
        self.guard.keep_house(&mut self.participants, &self.settings, now);
        self.refused.look(&self.doubts.refused, now);
        self.accepted.look(&self.doubts.accepted, now);
        self.show();
        self.role.turned(self.supervision.mode() as u8, 0);
        // The first turn is over, and with it everything is there.
        self.role.ready();
        self.role.status(now, |line| describe(self.record.get(), &self.settings, &self.decided, line));
    }
}

/// What control found and decided, in a line for the service manager.
fn describe(record: &ControlRecord, settings: &Settings, decided: &[String], line: &mut String) {
    // Writing to a String cannot fail.
    let _ = write!(line, "safety mode {}; {} subscribers", record.safety(), record.subscribers);
    let lanes = settings.lanes.iter().zip(decided);
    write_list(line, "; lanes:", lanes.map(|(lane, decided)| format!("{} {decided}", lane.name)));
}

/// Control does more than to probe, and goes on without it.
fn trust(settings: &Settings, secret: Option<&InlineSecret>) -> Option<Trust> {
    match Trust::load(&settings.security, secret) {
        Ok(trust) => Some(trust),
        Err(error) => {
            error!("nobody is probed, so that every subscriber stays as it is: {error}");
            None
        }
    }
}

/// The next instant of something periodic. What was missed is not made up for.
fn next(due: MonotonicNs, rate_hz: f64, now: MonotonicNs) -> MonotonicNs {
    let period_ns = (1e9 / rate_hz).round() as u64;
    let next = due.plus_ns(period_ns);
    if next > now { next } else { now.plus_ns(period_ns) }
}

/// The networks that control joins, that of the input first, and the number of each lane's.
fn networks(settings: &Settings) -> (Vec<DdsNetwork>, Vec<usize>) {
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
    fn something_periodic_keeps_its_beat_and_makes_up_for_nothing() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        assert_eq!(next(at(1_000), 5.0, at(1_003)), at(1_200));
        assert_eq!(next(at(1_000), 5.0, at(9_000)), at(9_200));
    }
}
