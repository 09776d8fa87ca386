//! Problems that control found, and problems of control itself and of the settings.

use super::{Level, Problem};
use crate::model::{
    AbsenceKind, MAX_INTRUDERS, ModeReason, NetworkRefusal, ProbeRefusal, SafetyMode, SubscriberState,
};
use crate::shm::ProcessRole;
use crate::telemetry::report::IntruderReport;
use crate::telemetry::snapshot::Snapshot;
use crate::telemetry::text::{counted, printable};

/// The problem of a NONCRITICAL subscriber shows the age of the last probe response when it is above this
/// value: ten unanswered probes at the default rate.
const OLD_RESPONSE_MS: f64 = 2_000.0;

/// Control is needed but never ran. A control process that ran before is a problem of `processes`.
pub(super) fn missing(now: &Snapshot) -> Option<Problem> {
    let ran = now.processes.iter().any(|process| process.role == ProcessRole::Control);
    (now.needs_control && !ran).then(|| {
        let text = "control was never started: no subscriber is probed, and lanes keep their default modes; start its \
                    service or run `adaptive-bridge control`";
        Problem::new("control", Level::Warn, text.to_owned())
    })
}

/// Control runs but cannot probe, because it has no secret to sign probe requests with.
pub(super) fn without_secret(now: &Snapshot) -> Option<Problem> {
    let mut runs = now.processes.iter().filter(|process| process.role == ProcessRole::Control);
    (now.control.without_secret != 0 && runs.any(|process| process.state.exists())).then(|| {
        let text = "no subscriber is probed: control has no secret for the probes; read its log for the cause, correct \
                    it, then run `adaptive-bridge reload`";
        Problem::new("probes", Level::Error, text.to_owned())
    })
}

/// The safety mode is not normal.
pub(super) fn safety(now: &Snapshot) -> Option<Problem> {
    let mode = now.control.safety();
    let (level, consequence) = match mode {
        SafetyMode::Normal => return None,
        SafetyMode::Degraded => (Level::Warn, limited_lanes(now)),
        SafetyMode::Emergency => (Level::Error, "all forwarding is stopped".to_owned()),
    };
    let cause = match now.control.safety_reason.as_str() {
        "" => String::new(),
        reason => format!("; cause: {}", printable(reason)),
    };
    let text = format!(
        "the safety mode is {mode}, {consequence}{cause}; it returns to normal by itself when the cause is removed"
    );
    Some(Problem::new("safety", level, text))
}

/// The lanes whose mode the safety mode sets. None where `safety.allow_noncritical_degrade` forbids it.
fn limited_lanes(now: &Snapshot) -> String {
    let limited = now.lanes.iter().filter(|lane| lane.reason == ModeReason::Safety);
    let limited: Vec<String> = limited.map(|lane| format!("lane {} is {}", lane.name, lane.mode)).collect();
    if limited.is_empty() { "no lane is limited".to_owned() } else { limited.join(", ") }
}

/// Processes that apply different settings, refused reloads, and errors of the processes.
pub(super) fn settings(now: &Snapshot, before: &Snapshot) -> Vec<Problem> {
    let mut problems = Vec::new();
    let mut groups: Vec<(u64, Vec<&str>)> = Vec::new();
    for process in now.processes.iter().filter(|process| process.state.exists()) {
        let fingerprint = process.health.settings_fingerprint;
        match groups.iter_mut().find(|(known, _)| *known == fingerprint) {
            _ if fingerprint == 0 => {}
            Some((_, names)) => names.push(&process.name),
            None => groups.push((fingerprint, vec![&process.name])),
        }
    }
    if groups.len() > 1 {
        let groups: Vec<String> = groups.iter().map(|(_, names)| names.join(" and ")).collect();
        let text = format!(
            "the processes use different settings: {}; run `adaptive-bridge reload`, and restart a process that still \
             differs",
            groups.join(" versus ")
        );
        problems.push(Problem::new("bridge", Level::Warn, text));
    }
    let window = super::window_text(now, before);
    for process in &now.processes {
        let Some(former) = before.processes.iter().find(|former| former.name == process.name) else {
            continue;
        };
        let grown = |now: u64, before: u64| now.checked_sub(before).filter(|&count| count > 0);
        let about = super::processes::about(process, now);
        if grown(process.health.refused_reloads, former.health.refused_reloads).is_some() {
            let text = format!(
                "{} refused a reload in the last {window} and keeps its settings; run `adaptive-bridge check` to see \
                 the errors of the configuration file",
                process.name
            );
            problems.push(Problem::new(about.clone(), Level::Warn, text));
        }
        if let Some(errors) = grown(process.health.errors, former.health.errors) {
            let errors = counted(errors, "error");
            let text = format!("{}: {errors} in the last {window}; read its log", process.name);
            problems.push(Problem::new(about.clone(), Level::Warn, text));
        }
        let refused = process.health.network_refusals.since(&former.health.network_refusals);
        // A malformed datagram, as of a port scan, is counted and harms nothing.
        let refused = refused.iter().filter(|(reason, _)| *reason != NetworkRefusal::MalformedDatagram);
        for (reason, count) in refused {
            let meaning = reason.meaning();
            let effect = match reason {
                NetworkRefusal::UnfinishedSample => {
                    "large samples lose fragments on their way, or a host sends parts of samples or \
                     announcements; `tcpdump -n udp` shows from where; if all inputs together exceed their limit, \
                     a smaller max_sample_bytes of routes with small samples leaves more for the others"
                }
                _ => {
                    "nodes that start now may not be found; `tcpdump -n udp portrange 7400-7500` shows which host \
                     announces so many"
                }
            };
            let text =
                format!("{}: {count} {meaning} in the last {window} ({reason}); {effect}", process.name);
            problems.push(Problem::new(about.clone(), Level::Warn, text));
        }
    }
    problems
}

/// Network interfaces and peers that are away.
pub(super) fn absences(now: &Snapshot) -> impl Iterator<Item = Problem> {
    now.absences.iter().filter(|absence| absence.is_away()).map(|absence| {
        let report = now.absence_report(absence);
        let name = report.name.as_deref();
        let away_s = report.away_s;
        let (level, text) = match absence.kind() {
            AbsenceKind::Interface => {
                let address = report.host.map_or_else(String::new, |address| format!(" ({address})"));
                let name = name.unwrap_or_default();
                let text = format!(
                    "network interface {name}{address} {}, away for {away_s:.0} s: the bridge does not reach the peers \
                     behind it; check it with `ip addr show`; the bridge uses it again as soon as it is back",
                    report.detail
                );
                (Level::Warn, text)
            }
            AbsenceKind::Peer => {
                let node = name.unwrap_or("a node of unknown name");
                let host = report.host.map_or_else(String::new, |host| format!(" on {host}"));
                let text = format!(
                    "{node}{host}, which {}, has been silent for {away_s:.0} s: its link is down, or its process \
                     crashed; check both on its host; the bridge serves it again when it is back",
                    report.detail
                );
                (Level::Stale, text)
            }
        };
        Problem::new("network", level, text)
    })
}

/// Subscribers whose link is bad, or that answer no probes.
pub(super) fn subscribers(now: &Snapshot) -> impl Iterator<Item = Problem> {
    now.subscribers.iter().filter_map(|subscriber| {
        let record = &subscriber.record;
        let report = now.subscriber_report(subscriber);
        let degraded = record.state() == SubscriberState::Noncritical && record.forced == 0;
        let (level, trouble) = if record.settled > 0 && record.lost >= record.settled {
            let silence = match report.last_response_age_ms {
                Some(age_ms) => format!("has not answered a probe for {:.0} s", age_ms / 1e3),
                None => "has never answered a probe".to_owned(),
            };
            let remedy = format!(
                "check its link, and that `adaptive-bridge responder --id {}` runs on its host",
                report.id
            );
            (Level::Stale, format!("{silence}; {remedy}"))
        } else if degraded {
            let old_ms = report.last_response_age_ms.filter(|&age_ms| age_ms > OLD_RESPONSE_MS);
            let age =
                old_ms.map_or_else(String::new, |ms| format!(", last response {:.0} s ago", ms / 1e3));
            let text = format!(
                "is NONCRITICAL because its link is bad: {}{age}; check its link; it becomes CRITICAL when the link is \
                 good again",
                report.figures()
            );
            (Level::Warn, text)
        } else if report.warnings.is_empty() {
            return None;
        } else {
            let jitter = report.jitter_ms.map_or(String::new(), |ms| format!(", jitter {ms:.1} ms"));
            let text = format!(
                "is above the warning threshold of {}: {}{jitter}; check its link, or raise probes.*_threshold",
                report.warnings.join(", "),
                report.figures()
            );
            (Level::Warn, text)
        };
        let on_lane = report.lane.as_ref().map_or(String::new(), |lane| format!(" on lane {lane}"));
        let text = format!("subscriber {}{on_lane} {trouble}", report.id);
        Some(Problem::new(format!("subscriber {}", report.id), level, text))
    })
}

/// Intruders, each with its remedy.
pub(super) fn intruders(now: &Snapshot) -> Vec<Problem> {
    let warn = |text| Problem::new("intruders", Level::Warn, text);
    let intruders = now.intruders.iter().map(|intruder| {
        let IntruderReport { topic, node, host, remedy, .. } = now.intruder_report(intruder);
        let node = node.as_deref().unwrap_or("a node of unknown name");
        warn(format!("{node} on {host} bypasses the bridge, it subscribes to {topic}: {remedy}"))
    });
    let mut problems: Vec<Problem> = intruders.collect();
    let seen = now.control.intruders_seen;
    if now.intruders.len() == MAX_INTRUDERS && seen > MAX_INTRUDERS as u64 {
        let text = format!(
            "{seen} remote subscribers have bypassed the bridge since control started, {MAX_INTRUDERS} of them are \
             listed; point all of them at noncritical outputs"
        );
        problems.push(warn(text));
    }
    problems
}

/// Refused messages on the probe topics. Late responses are no problem here: they count as loss of the link.
pub(super) fn refusals(now: &Snapshot, before: &Snapshot) -> Vec<Problem> {
    let window = super::window_text(now, before);
    let refused = now.control.refused.since(&before.control.refused);
    let refused = refused.iter().filter(|(reason, _)| *reason != ProbeRefusal::Late);
    refused
        .map(|(reason, count)| {
            let count = counted(count, "probe message");
            let text = format!("refused {count} in the last {window}: {} ({reason})", reason.meaning());
            Problem::new("probes", Level::Warn, text)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{healthy, problems_after};
    use super::*;
    use crate::model::{
        FixedText, IntruderRecord, LaneMode, ProcessHealth, StandbyRecord, SubscriberRecord,
        SubscriberWarning,
    };
    use crate::telemetry::liveness::ProcessState;
    use crate::telemetry::snapshot::{ProcessReading, SubscriberReading};

    fn subscriber(change: impl FnOnce(&mut SubscriberRecord)) -> Vec<String> {
        let mut record = SubscriberRecord {
            id: FixedText::new("laptop"),
            settled: 50,
            lost: 1,
            rtt_mean_us: 81_250,
            jitter_us: 30_000,
            state: SubscriberState::Critical as u8,
            last_response_at: healthy().at,
            ..SubscriberRecord::default()
        };
        change(&mut record);
        problems_after(|now| now.subscribers = vec![SubscriberReading { lane: Some(1), record }])
    }

    fn control() -> ProcessReading {
        let health = ProcessHealth { pid: 9, starts: 1, ..ProcessHealth::default() };
        ProcessReading {
            name: "control".into(),
            role: ProcessRole::Control,
            health,
            standby: StandbyRecord::default(),
            state: ProcessState::Running,
        }
    }

    #[test]
    fn control_without_a_secret_is_a_problem_while_it_runs() {
        let found = problems_after(|now| {
            now.control.without_secret = 1;
            now.processes.push(control());
        });
        assert_eq!(found.len(), 1);
        assert!(found[0].starts_with("no subscriber is probed: control has no secret"), "{found:?}");
        assert_eq!(problems_after(|now| now.control.without_secret = 1), [""; 0]);
    }

    #[test]
    fn control_that_is_needed_and_never_ran_is_a_problem() {
        let found = problems_after(|now| now.needs_control = true);
        assert_eq!(found.len(), 1);
        assert!(found[0].starts_with("control was never started: no subscriber is probed"), "{found:?}");
        let found = problems_after(|now| {
            now.needs_control = true;
            now.processes.insert(1, control());
        });
        assert_eq!(found, [""; 0]);
    }

    #[test]
    fn a_safety_mode_is_a_problem_with_the_limited_lanes_and_the_cause() {
        let found = problems_after(|now| {
            now.control.safety = SafetyMode::Degraded as u8;
            now.control.safety_reason = FixedText::new("lane critical lags by 120.0 ms");
            now.lanes[1].reason = ModeReason::Safety;
            now.lanes[1].mode = LaneMode::Suspended;
        });
        let end = "it returns to normal by itself when the cause is removed";
        let expected = format!(
            "the safety mode is degraded, lane noncritical is suspended; cause: lane critical lags by 120.0 ms; {end}"
        );
        assert_eq!(found, [expected]);
        let found = problems_after(|now| now.control.safety = SafetyMode::Emergency as u8);
        assert_eq!(found, [format!("the safety mode is emergency, all forwarding is stopped; {end}")]);
    }

    #[test]
    fn a_subscriber_with_a_bad_link_is_a_problem() {
        assert_eq!(subscriber(|_| {}), [""; 0]);
        let found = subscriber(|record| record.state = SubscriberState::Noncritical as u8);
        let expected = "subscriber laptop on lane noncritical is NONCRITICAL because its link is bad: RTT 81.2 ms, \
                        loss 2.0 %; check its link; it becomes CRITICAL when the link is good again";
        assert_eq!(found, [expected]);
        let forced = |record: &mut SubscriberRecord| {
            record.state = SubscriberState::Noncritical as u8;
            record.forced = 1;
        };
        assert_eq!(subscriber(forced), [""; 0]);
        let warnings = SubscriberWarning::Rtt as u8 | SubscriberWarning::Jitter as u8;
        let found = subscriber(|record| record.warnings = warnings);
        let expected = "subscriber laptop on lane noncritical is above the warning threshold of rtt, jitter: \
                        RTT 81.2 ms, loss 2.0 %, jitter 30.0 ms; check its link, or raise probes.*_threshold";
        assert_eq!(found, [expected]);
    }

    #[test]
    fn a_subscriber_that_answers_no_probe_is_a_problem_with_the_program_to_start() {
        let found = subscriber(|record| record.lost = 50);
        let remedy = "check its link, and that `adaptive-bridge responder --id laptop` runs on its host";
        let laptop = "subscriber laptop on lane noncritical";
        assert_eq!(found, [format!("{laptop} has not answered a probe for 1 s; {remedy}")]);
        let found = subscriber(|record| {
            record.lost = 50;
            record.last_response_at = crate::model::MonotonicNs(0);
        });
        assert_eq!(found, [format!("{laptop} has never answered a probe; {remedy}")]);
    }

    #[test]
    fn an_intruder_is_a_problem_with_its_remedy_and_without_control_characters() {
        let found = problems_after(|now| {
            now.intruders = vec![IntruderRecord {
                topic: FixedText::new("/scan"),
                node: FixedText::new("/rviz\x1b[2J"),
                host: FixedText::new("192.168.0.7"),
                remedy: FixedText::new("subscribe to /n/scan"),
                ..IntruderRecord::default()
            }];
        });
        assert_eq!(
            found,
            [
                "/rviz\u{fffd}[2J on 192.168.0.7 bypasses the bridge, it subscribes to /scan: subscribe to /n/scan"
            ]
        );
    }

    #[test]
    fn different_settings_refused_reloads_and_errors_are_problems() {
        let found = problems_after(|now| {
            for (process, fingerprint) in now.processes.iter_mut().zip([1, 2, 1]) {
                process.health.settings_fingerprint = fingerprint;
            }
            now.processes[1].health.refused_reloads = 1;
            now.processes[2].health.errors = 3;
        });
        assert_eq!(
            found[0],
            "the processes use different settings: ingress and egress-noncritical versus egress-critical; run \
             `adaptive-bridge reload`, and restart a process that still differs"
        );
        assert!(found[1].starts_with("egress-critical refused a reload in the last 1.0 s"), "{found:?}");
        assert_eq!(found[2], "egress-noncritical: 3 errors in the last 1.0 s; read its log");
        assert_eq!(found.len(), 3);
    }

    #[test]
    fn refused_announcements_are_problems_and_malformed_datagrams_are_not() {
        let found = problems_after(|now| {
            let refusals = &mut now.processes[1].health.network_refusals;
            refusals.add(NetworkRefusal::MalformedDatagram, 7);
            refusals.add(NetworkRefusal::TooManyParticipants, 9);
            now.processes[0].health.network_refusals.add(NetworkRefusal::UnfinishedSample, 2);
        });
        let [unfinished, found] = &found[..] else { panic!("{found:?}") };
        assert!(
            unfinished.starts_with("ingress: 2 samples discarded of which fragments were"),
            "{unfinished}"
        );
        assert!(unfinished.contains("max_sample_bytes") && !unfinished.contains("nodes"), "{unfinished}");
        let meaning = NetworkRefusal::TooManyParticipants.meaning();
        let text = format!("egress-critical: 9 {meaning} in the last 1.0 s (too_many_participants); ");
        assert!(found.starts_with(&text), "{found}");
    }

    #[test]
    fn refused_probe_messages_are_problems_except_late_ones() {
        let found = problems_after(|now| {
            for refusal in [ProbeRefusal::Late, ProbeRefusal::Replayed, ProbeRefusal::Replayed] {
                now.control.refused.add(refusal, 1);
            }
        });
        let replayed = ProbeRefusal::Replayed.meaning();
        assert_eq!(found, [format!("refused 2 probe messages in the last 1.0 s: {replayed} (replayed)")]);
    }
}
