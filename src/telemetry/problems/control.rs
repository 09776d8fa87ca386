//! What control found to be wrong, and what is wrong with control and the settings.

use super::{Level, Problem};
use crate::model::{AbsenceKind, MAX_INTRUDERS, ProbeRefusal, SafetyMode, SubscriberState};
use crate::shm::ProcessRole;
use crate::telemetry::report::SubscriberReport;
use crate::telemetry::snapshot::{ModeReason, Snapshot};
use crate::telemetry::text::printable;

/// An answer this old is worth a word: at the default rate ten probes are unanswered.
const SILENT_RESPONDER_MS: f64 = 2_000.0;

/// Control is asked for and never ran. One that ran and is gone is named among the processes.
pub(super) fn missing(now: &Snapshot) -> Option<Problem> {
    let ran = now.processes.iter().any(|process| process.role == ProcessRole::Control);
    (now.needs_control && !ran).then(|| {
        let text = "control was never started: nobody is probed, and lanes stay in their default modes";
        Problem::new("control", Level::Warn, text.to_owned())
    })
}

/// Control runs, and cannot probe.
pub(super) fn without_secret(now: &Snapshot) -> Option<Problem> {
    let mut runs = now.processes.iter().filter(|process| process.role == ProcessRole::Control);
    (now.control.without_secret != 0 && runs.any(|process| process.state.exists())).then(|| {
        let text = "nobody is probed: the secret of the probes cannot be had; the log of control says why, \
                    and after a reload it is tried again";
        Problem::new("probes", Level::Error, text.to_owned())
    })
}

/// The safety supervisor has taken something away.
pub(super) fn safety(now: &Snapshot) -> Option<Problem> {
    let mode = now.control.safety();
    let (level, consequence) = match mode {
        SafetyMode::Normal => return None,
        SafetyMode::Degraded => (Level::Warn, limited_lanes(now)),
        SafetyMode::Emergency => (Level::Error, "all forwarding is stopped".to_owned()),
    };
    let why = match now.control.safety_reason.as_str() {
        "" => String::new(),
        reason => format!(": {}", printable(reason)),
    };
    Some(Problem::new("safety", level, format!("safety is {mode}, {consequence}{why}")))
}

/// The lanes that the safety mode takes something from; the configuration may forbid it.
fn limited_lanes(now: &Snapshot) -> String {
    let limited = now.lanes.iter().filter(|lane| lane.reason == ModeReason::Safety);
    let limited: Vec<String> = limited.map(|lane| format!("lane {} is {}", lane.name, lane.mode)).collect();
    if limited.is_empty() { "all lanes go on".to_owned() } else { limited.join(", ") }
}

/// Processes that apply different settings, and files that were refused.
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
            "the processes apply different settings: {}; reload or restart those that are behind",
            groups.join(" other ones than ")
        );
        problems.push(Problem::new("bridge", Level::Warn, text));
    }
    for process in &now.processes {
        let Some(former) = before.processes.iter().find(|former| former.name == process.name) else {
            continue;
        };
        let grown = |now: u64, before: u64| now.checked_sub(before).filter(|&count| count > 0);
        let about = match process.role {
            ProcessRole::Egress(lane) => now.lanes.get(lane).map_or("bridge".to_owned(), super::about_lane),
            ProcessRole::Ingress | ProcessRole::Control => process.name.clone(),
        };
        if grown(process.health.refused_reloads, former.health.refused_reloads).is_some() {
            let text = format!(
                "{} refused a reload just now and goes on with its former settings; `adaptive-bridge check` \
                 says what is wrong with the file",
                process.name
            );
            problems.push(Problem::new(about.clone(), Level::Warn, text));
        }
        if let Some(errors) = grown(process.health.errors, former.health.errors) {
            let text = format!("{}: {errors} errors just now; its log names them", process.name);
            problems.push(Problem::new(about, Level::Warn, text));
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
                    "network interface {name}{address} {} for {away_s:.0} s: peers behind it are not reached; \
                     `ip addr show` tells, and it is used again as soon as it is back",
                    report.detail
                );
                (Level::Warn, text)
            }
            AbsenceKind::Peer => {
                let node = name.unwrap_or("a node without a name");
                let host = report.host.map_or_else(String::new, |host| format!(" on {host}"));
                let text = format!(
                    "{node}{host}, which {}, is silent for {away_s:.0} s: its link is down, or it ended without \
                     a goodbye",
                    report.detail
                );
                (Level::Stale, text)
            }
        };
        Problem::new("network", level, text)
    })
}

/// Subscribers whose link is bad, or of whom nothing is heard.
pub(super) fn subscribers(now: &Snapshot) -> impl Iterator<Item = Problem> {
    now.subscribers.iter().filter_map(|subscriber| {
        let record = &subscriber.record;
        let report = now.subscriber_report(subscriber);
        let degraded = record.state() == SubscriberState::Noncritical && record.forced == 0;
        let (level, what) = if record.settled > 0 && record.lost >= record.settled {
            let heard = match report.last_response_age_ms {
                Some(age_ms) => format!("does not answer for {:.0} s", age_ms / 1e3),
                None => "has never answered".to_owned(),
            };
            (Level::Stale, format!("{heard}; does `adaptive-bridge responder --id {}` run there?", report.id))
        } else if degraded {
            let silent_ms = report.last_response_age_ms.filter(|&age_ms| age_ms > SILENT_RESPONDER_MS);
            let silent = silent_ms
                .map_or_else(String::new, |age_ms| format!(", last answer {:.0} s ago", age_ms / 1e3));
            (Level::Warn, format!("is NONCRITICAL: {}{silent}", report.figures()))
        } else if report.warnings.is_empty() {
            return None;
        } else {
            (
                Level::Warn,
                format!(
                    "is above its warning threshold of {}: {}",
                    report.warnings.join(", "),
                    full_figures(&report)
                ),
            )
        };
        let on_lane = report.lane.as_ref().map_or(String::new(), |lane| format!(" on lane {lane}"));
        let text = format!("subscriber {}{on_lane} {what}", report.id);
        Some(Problem::new(format!("subscriber {}", report.id), level, text))
    })
}

fn full_figures(report: &SubscriberReport) -> String {
    let jitter = report.jitter_ms.map_or(String::new(), |ms| format!(", jitter {ms:.1} ms"));
    format!("{}{jitter}", report.figures())
}

/// Remote readers that take samples past the bridge, each with what mends it.
pub(super) fn intruders(now: &Snapshot) -> Vec<Problem> {
    let warn = |text| Problem::new("intruders", Level::Warn, text);
    let mut problems: Vec<Problem> = now
        .intruders
        .iter()
        .map(|intruder| {
            let text = |text: &str| printable(text);
            let node = match intruder.node.as_str() {
                "" => "a node without a name".to_owned(),
                node => text(node),
            };
            let (topic, host) = (text(intruder.topic.as_str()), text(intruder.host.as_str()));
            let remedy = text(intruder.remedy.as_str());
            warn(format!("{node} on {host} reads {topic} past the bridge: {remedy}"))
        })
        .collect();
    let seen = now.control.intruders_seen;
    if now.intruders.len() == MAX_INTRUDERS && seen > MAX_INTRUDERS as u64 {
        problems.push(warn(format!("{seen} remote readers were seen past the bridge; no more are listed")));
    }
    problems
}

/// Messages on the probe topics that were not believed. Late responses are the link's and show as loss.
pub(super) fn refusals(now: &Snapshot, before: &Snapshot) -> Vec<Problem> {
    let refused = now.control.refused.since(&before.control.refused);
    let refused = refused.iter().filter(|(reason, _)| *reason != ProbeRefusal::Late);
    refused
        .map(|(reason, count)| {
            let text = format!("{count} probe messages refused just now: {} ({reason})", reason.meaning());
            Problem::new("probes", Level::Warn, text)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{after, sound};
    use super::*;
    use crate::model::{
        FixedText, IntruderRecord, LaneMode, ProcessHealth, SubscriberRecord, SubscriberWarning,
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
            last_response_at: sound().at,
            ..SubscriberRecord::default()
        };
        change(&mut record);
        after(|now| now.subscribers = vec![SubscriberReading { lane: Some(1), record }])
    }

    fn control() -> ProcessReading {
        let health = ProcessHealth { pid: 9, starts: 1, ..ProcessHealth::default() };
        ProcessReading {
            name: "control".into(),
            role: ProcessRole::Control,
            health,
            state: ProcessState::Running,
        }
    }

    #[test]
    fn a_control_that_cannot_probe_is_an_error_while_it_is_there() {
        let said = after(|now| {
            now.control.without_secret = 1;
            now.processes.push(control());
        });
        assert_eq!(said.len(), 1);
        assert!(said[0].starts_with("nobody is probed: the secret"), "{said:?}");
        assert_eq!(after(|now| now.control.without_secret = 1), [""; 0]);
    }

    #[test]
    fn control_is_missed_where_it_is_asked_for_and_never_ran() {
        let said = after(|now| now.needs_control = true);
        assert_eq!(said.len(), 1);
        assert!(said[0].starts_with("control was never started: nobody is probed"), "{said:?}");
        let said = after(|now| {
            now.needs_control = true;
            now.processes.insert(1, control());
        });
        assert_eq!(said, [""; 0]);
    }

    #[test]
    fn what_safety_takes_away_is_said_with_its_reason() {
        let said = after(|now| {
            now.control.safety = SafetyMode::Degraded as u8;
            now.control.safety_reason = FixedText::new("lane critical lags by 120.0 ms");
            now.lanes[1].reason = ModeReason::Safety;
            now.lanes[1].mode = LaneMode::Suspended;
        });
        let expected = "safety is degraded, lane noncritical is suspended: lane critical lags by 120.0 ms";
        assert_eq!(said, [expected]);
        let said = after(|now| now.control.safety = SafetyMode::Emergency as u8);
        assert_eq!(said, ["safety is emergency, all forwarding is stopped"]);
    }

    #[test]
    fn a_subscriber_is_named_for_what_is_wrong_with_its_link() {
        assert_eq!(subscriber(|_| {}), [""; 0]);
        let said = subscriber(|record| record.state = SubscriberState::Noncritical as u8);
        assert_eq!(said, ["subscriber laptop on lane noncritical is NONCRITICAL: RTT 81.2 ms, loss 2.0 %"]);
        let forced = |record: &mut SubscriberRecord| {
            record.state = SubscriberState::Noncritical as u8;
            record.forced = 1;
        };
        assert_eq!(subscriber(forced), [""; 0]);
        let warnings = SubscriberWarning::Rtt as u8 | SubscriberWarning::Jitter as u8;
        let said = subscriber(|record| record.warnings = warnings);
        let expected = "subscriber laptop on lane noncritical is above its warning threshold of rtt, jitter: \
                        RTT 81.2 ms, loss 2.0 %, jitter 30.0 ms";
        assert_eq!(said, [expected]);
    }

    #[test]
    fn a_subscriber_that_does_not_answer_is_named_with_the_program_to_start() {
        let said = subscriber(|record| record.lost = 50);
        let program = "does `adaptive-bridge responder --id laptop` run there?";
        assert_eq!(
            said,
            [format!("subscriber laptop on lane noncritical does not answer for 1 s; {program}")]
        );
        let said = subscriber(|record| {
            record.lost = 50;
            record.last_response_at = crate::model::MonotonicNs(0);
        });
        assert_eq!(said, [format!("subscriber laptop on lane noncritical has never answered; {program}")]);
    }

    #[test]
    fn an_intruder_is_named_with_its_remedy_and_steers_no_terminal() {
        let said = after(|now| {
            now.intruders = vec![IntruderRecord {
                topic: FixedText::new("/scan"),
                node: FixedText::new("/rviz\x1b[2J"),
                host: FixedText::new("192.168.0.7"),
                remedy: FixedText::new("subscribe to /n/scan"),
                ..IntruderRecord::default()
            }];
        });
        assert_eq!(
            said,
            ["/rviz\u{fffd}[2J on 192.168.0.7 reads /scan past the bridge: subscribe to /n/scan"]
        );
    }

    #[test]
    fn settings_that_differ_and_reloads_that_were_refused_are_named() {
        let said = after(|now| {
            for (process, fingerprint) in now.processes.iter_mut().zip([1, 2, 1]) {
                process.health.settings_fingerprint = fingerprint;
            }
            now.processes[1].health.refused_reloads = 1;
            now.processes[2].health.errors = 3;
        });
        assert_eq!(
            said[0],
            "the processes apply different settings: ingress and egress-noncritical other ones than \
             egress-critical; reload or restart those that are behind"
        );
        assert!(said[1].starts_with("egress-critical refused a reload just now"), "{said:?}");
        assert_eq!(said[2], "egress-noncritical: 3 errors just now; its log names them");
        assert_eq!(said.len(), 3);
    }

    #[test]
    fn refused_probe_messages_are_named_but_for_late_ones() {
        let said = after(|now| {
            for refusal in [ProbeRefusal::Late, ProbeRefusal::Replayed, ProbeRefusal::Replayed] {
                now.control.refused.add(refusal);
            }
        });
        assert_eq!(said.len(), 1);
        assert!(said[0].starts_with("2 probe messages refused just now: seen before"), "{said:?}");
    }
}
