//! Finds what is wrong with a bridge in two snapshots, and describes it for users.

mod control;
mod processes;
mod publishers;
mod readers;

use super::liveness::ProcessState;
use super::problem::{Level, Problem};
use super::snapshot::{LaneReading, OutputReading, RouteReading, Snapshot};
use super::text::counted;
use crate::model::{DropReason, IngressCounters, LaneCounters, LaneMode, TrafficClass};
use crate::shm::ProcessRole;

/// A lane's process writes the mode that it applies ten times a second. After this time without it, the
/// process does not read its policy.
const APPLY_MS: u64 = 1_000;

/// A critical lane that forwarded none of this many published samples is stuck. Fewer may be in transit at
/// the moment of the snapshot.
const SILENT_LANE_SAMPLES: u64 = 5;

/// A reader that acknowledged none of this many offered samples is silent. Fewer may be in transit, because a
/// reader acknowledges at each HEARTBEAT.
const SILENT_READER_SAMPLES: u64 = 5;

/// All problems, the most severe first: processes, counts that do not add up, the safety mode, lanes that
/// forward nothing, drops, absences, subscribers, intruders, publishers.
pub(super) fn of(now: &Snapshot, before: &Snapshot) -> Vec<Problem> {
    let mut problems = Vec::new();
    for process in &now.processes {
        problems.extend(processes::problem(process, now, before));
        problems.extend(processes::take_over_storm(process, now));
    }
    problems.extend(control::missing(now));
    problems.extend(control::without_secret(now));
    for (route, output) in outputs(now) {
        problems.extend(unaccounted(route, output, &now.lanes[output.lane]));
    }
    problems.extend(now.routes.iter().filter_map(unaccounted_by_ingress));
    problems.extend(control::safety(now));
    for (route, output) in outputs(now) {
        problems.extend(forwards_nothing(route, output, now, before));
    }
    problems.extend(now.lanes.iter().filter_map(|lane| not_applied(lane, now)));
    for route in &now.routes {
        dropped(route, now, before, &mut problems);
    }
    problems.extend(now.routes.iter().filter_map(publishers::never_served));
    for (route, output) in outputs(now) {
        problems.extend(readers::unmatched(route, output, now));
        problems.extend(readers::without_history(route, output, now, before));
        slow_readers(route, output, now, before, &mut problems);
    }
    problems.extend(control::settings(now, before));
    problems.extend(control::absences(now));
    problems.extend(control::subscribers(now));
    problems.extend(control::intruders(now));
    problems.extend(control::refusals(now, before));
    problems.extend(now.routes.iter().filter_map(|route| publishers::clock_offset(now, route)));
    problems.extend(now.routes.iter().filter_map(|route| publishers::other_type(now, route)));
    problems.extend(now.routes.iter().filter_map(|route| publishers::unrepaired(now, route)));
    problems.extend(now.routes.iter().filter_map(publishers::no_publisher));
    problems.extend(now.patterns.iter().filter_map(publishers::no_place));
    problems
}

fn outputs(snapshot: &Snapshot) -> impl Iterator<Item = (&RouteReading, &OutputReading)> {
    snapshot.routes.iter().flat_map(|route| route.outputs.iter().map(move |output| (route, output)))
}

/// The time between the two snapshots, such as `1.0 s` or `50 ms`.
fn window_text(now: &Snapshot, before: &Snapshot) -> String {
    let window_ms = now.at.since(before.at) as f64 / 1e6;
    if window_ms < 1_000.0 { format!("{window_ms:.0} ms") } else { format!("{:.1} s", window_ms / 1e3) }
}

fn about_lane(lane: &LaneReading) -> String {
    format!("lane {}", lane.name)
}

/// A lane's counts of an output that do not add up.
fn unaccounted(route: &RouteReading, output: &OutputReading, lane: &LaneReading) -> Option<Problem> {
    let counters = &output.counters;
    (!counters.is_accounted_for()).then(|| {
        let LaneCounters { forwarded, waiting, drops, .. } = counters;
        let text = format!(
            "lane {0}, route {1}: the sample counts do not add up: {2} received, but {forwarded} forwarded + \
             {waiting} waiting + {3} dropped; unless egress-{0} is stopped (SIGSTOP), this is a bug: report it with \
             `adaptive-bridge status --json`",
            lane.name,
            route.id,
            counters.received(),
            drops.total()
        );
        Problem::new(about_lane(lane), Level::Error, text)
    })
}

/// Ingress's counts of a route that do not add up.
fn unaccounted_by_ingress(route: &RouteReading) -> Option<Problem> {
    (!route.is_accounted_for()).then(|| {
        let IngressCounters { received, published, drops, .. } = &route.counters;
        let text = format!(
            "ingress, route {}: the sample counts do not add up: {received} received, but {published} published + {} \
             dropped; this is a bug: report it with `adaptive-bridge status --json`",
            route.id,
            drops.total()
        );
        Problem::new(format!("route {}", route.id), Level::Error, text)
    })
}

/// A critical lane whose process runs but forwards none of the samples that ingress publishes.
fn forwards_nothing(
    route: &RouteReading,
    output: &OutputReading,
    now: &Snapshot,
    before: &Snapshot,
) -> Option<Problem> {
    let lane = &now.lanes[output.lane];
    let process = now.processes.iter().find(|process| process.role == ProcessRole::Egress(output.lane))?;
    let former = before.route(route)?;
    let published = route.counters.published.checked_sub(former.counters.published)?;
    // A sample that was dropped because no reader was matched also shows that the lane makes turns.
    let written = |counters: &LaneCounters| counters.forwarded + counters.drops.get(DropReason::NoReader);
    let forwarded = written(&output.counters).checked_sub(written(&former.output(output)?.counters))?;
    let may_forward = lane.class == TrafficClass::Critical && lane.mode != LaneMode::Stopped;
    (may_forward
        && process.state == ProcessState::Running
        && published >= SILENT_LANE_SAMPLES
        && forwarded == 0)
        .then(|| {
            let text = format!(
                "lane {}, {}: ingress published {published} samples in the last {} and the lane forwarded none; read \
                 the log of {}",
                lane.name,
                output.topic,
                window_text(now, before),
                process.name
            );
            Problem::new(about_lane(lane), Level::Error, text)
        })
}

fn not_applied(lane: &LaneReading, now: &Snapshot) -> Option<Problem> {
    let waited = now.at.since(lane.policy.changed_at) > APPLY_MS * 1_000_000;
    let applies = lane.health.policy_epoch == lane.policy.epoch;
    (lane.health.pid != 0 && waited && !applies && lane.policy.epoch != 0).then(|| {
        let text = format!(
            "lane {0}: egress-{0} has not applied mode {1} within {2} s; read its log, and restart it if it hangs",
            lane.name,
            lane.mode,
            APPLY_MS / 1_000
        );
        Problem::new(about_lane(lane), Level::Warn, text)
    })
}

/// Samples of a route that were dropped, or lost before ingress, within the window.
fn dropped(route: &RouteReading, now: &Snapshot, before: &Snapshot, problems: &mut Vec<Problem>) {
    let window = window_text(now, before);
    let former = before.route(route);
    let about = format!("route {}", route.id);
    let dropped = route.counters.drops.since_reading(former.map(|former| former.counters.drops));
    for (reason, count) in dropped.iter() {
        let text = format!(
            "ingress, route {}: dropped {} in the last {window}: {} ({reason})",
            route.id,
            counted(count, "sample"),
            reason.meaning()
        );
        problems.push(Problem::new(about.clone(), Level::Error, text));
    }
    for output in &route.outputs {
        let lane = &now.lanes[output.lane];
        let former = former.and_then(|former| former.output(output));
        let dropped = output.counters.drops.since_reading(former.map(|former| former.counters.drops));
        for (reason, count) in dropped.iter().filter(|(reason, _)| !reason.is_expected(lane.class)) {
            let level = match lane.class {
                TrafficClass::Critical => Level::Error,
                TrafficClass::Noncritical => Level::Warn,
            };
            let text = format!(
                "lane {}, {}: dropped {} in the last {window}: {} ({reason}){}",
                lane.name,
                output.topic,
                counted(count, "sample"),
                reason.meaning(),
                matched_readers(reason, output)
            );
            problems.push(Problem::new(about_lane(lane), level, text));
        }
    }
    if let Some(former) = former
        && let Some(lost @ 1..) = route.counters.lost_upstream.checked_sub(former.counters.lost_upstream)
    {
        let text = format!(
            "route {}: {} lost in the last {window} between publisher and ingress{}; check the network to the \
             publisher, and the receive buffers with `adaptive-bridge doctor`",
            route.id,
            counted(lost, "sample"),
            publishers::lost_by_publisher(now, route, former)
        );
        problems.push(Problem::new(about, Level::Warn, text));
    }
}

/// Matched readers that missed samples within the window, or acknowledge none.
fn slow_readers(
    route: &RouteReading,
    output: &OutputReading,
    now: &Snapshot,
    before: &Snapshot,
    problems: &mut Vec<Problem>,
) {
    let lane = &now.lanes[output.lane];
    let former = before.route(route).and_then(|former| former.output(output));
    for record in output.readers.iter() {
        let mut earlier = former.iter().flat_map(|former| former.readers.iter());
        let Some(earlier) = earlier.find(|earlier| earlier.reader == record.reader) else { continue };
        let missed = record.missed_since(earlier);
        // The lane offered samples within the window and the reader acknowledged none of them, nor any of
        // the older unacknowledged ones.
        let offered = record.offered.saturating_sub(earlier.offered);
        let is_silent = offered >= SILENT_READER_SAMPLES
            && record.unacknowledged.saturating_sub(earlier.unacknowledged) == offered
            && earlier.unacknowledged > 0;
        let reader = now.endpoint_name("reader", record.reader);
        // On a noncritical lane fresher samples supersede those that are not acknowledged, by design.
        let text = if missed > 0 && lane.class == TrafficClass::Critical {
            format!(
                "lane {}, {}: {reader} missed {} in the last {}: it acknowledges too slowly \
                 (reader_overrun); the other subscribers have them; raise window_samples, or move it to a slower lane",
                lane.name,
                output.topic,
                counted(missed, "sample"),
                window_text(now, before)
            )
        } else if is_silent {
            format!(
                "lane {}, {}: {reader} acknowledges no samples, {} so far; check that its process runs and \
                 that its link is up",
                lane.name, output.topic, record.unacknowledged
            )
        } else {
            continue;
        };
        problems.push(Problem::new(about_lane(lane), Level::Warn, text));
    }
}

/// For a failed write, the number of matched readers: any of them, local or remote, may be the cause.
fn matched_readers(reason: DropReason, output: &OutputReading) -> String {
    if reason != DropReason::WriteFailed {
        return String::new();
    }
    let readers = counted(output.counters.readers, "subscriber");
    format!("; {readers} matched, see matched_readers in `adaptive-bridge status --json`")
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::snapshot::ProcessReading;
    use super::*;
    use crate::config::SetParameters;
    use crate::model::{
        ControlRecord, Guid, IngressCounters, InstanceName, LaneCounters, LaneName, LanePolicy,
        LatencyHistogram, ModeReason, MonotonicNs, OutputReaders, ProcessHealth, ReaderRecord, RouteId,
        RouteInfo, StandbyRecord, TakeOverCause, TopicName, WallNs,
    };

    /// A bridge without problems: one route and two lanes, each of which has forwarded 100 samples.
    pub(in crate::telemetry) fn healthy() -> Snapshot {
        let at = MonotonicNs(100_000_000_000);
        let health = ProcessHealth { pid: 7, alive_at: at, starts: 1, ..ProcessHealth::default() };
        let process = |name: &str, role| ProcessReading {
            name: name.into(),
            role,
            health,
            standby: StandbyRecord::default(),
            state: ProcessState::Running,
        };
        let lane = |name, class| LaneReading {
            name,
            class,
            policy: LanePolicy::default(),
            mode: LaneMode::Normal,
            reason: ModeReason::Default,
            ends_at: None,
            health,
            is_used: true,
        };
        let output = |lane, topic| OutputReading {
            lane,
            topic: TopicName::try_from(topic).unwrap(),
            counters: LaneCounters { last_sequence: 100, forwarded: 100, ..LaneCounters::default() },
            readers: OutputReaders::default(),
            shm: LatencyHistogram::default(),
            dds_out: LatencyHistogram::default(),
            age: LatencyHistogram::default(),
        };
        Snapshot {
            instance: InstanceName::try_from("default").unwrap(),
            at,
            at_wall: WallNs(0),
            processes: vec![
                process("ingress", ProcessRole::Ingress),
                process("egress-critical", ProcessRole::Egress(0)),
                process("egress-noncritical", ProcessRole::Egress(1)),
            ],
            lanes: vec![
                lane(LaneName::critical(), TrafficClass::Critical),
                lane(LaneName::noncritical(), TrafficClass::Noncritical),
            ],
            patterns: Vec::new(),
            routes: vec![RouteReading {
                id: RouteId::try_from("scan").unwrap(),
                input_topic: TopicName::try_from("/scan").unwrap(),
                pattern: None,
                message_type: None,
                info: RouteInfo::default(),
                counters: IngressCounters {
                    received: 100,
                    published: 100,
                    writers: 1,
                    ..IngressCounters::default()
                },
                publishers: Vec::new(),
                dds_in: LatencyHistogram::default(),
                outputs: vec![output(0, "/c/scan"), output(1, "/n/scan")],
            }],
            needs_control: false,
            set_parameters: SetParameters::new(),
            control: ControlRecord::default(),
            subscribers: Vec::new(),
            intruders: Vec::new(),
            named_endpoints: Vec::new(),
            absences: Vec::new(),
        }
    }

    /// The problems of a healthy bridge that changes within a window of 1 s.
    pub(in crate::telemetry) fn problems_after(change: impl FnOnce(&mut Snapshot)) -> Vec<String> {
        let before = healthy();
        let mut now = before.clone();
        now.at = now.at.plus_ms(1_000);
        change(&mut now);
        of(&now, &before).into_iter().map(|problem| problem.text).collect()
    }

    fn drop_on(now: &mut Snapshot, output: usize, reason: DropReason, count: u64) {
        let counters = &mut now.routes[0].outputs[output].counters;
        counters.drops.add(reason, count);
        counters.last_sequence += count;
    }

    #[test]
    fn a_healthy_bridge_has_no_problems() {
        assert_eq!(problems_after(|_| {}), [""; 0]);
        assert_eq!(problems_after(|now| drop_on(now, 1, DropReason::Superseded, 90)), [""; 0]);
    }

    #[test]
    fn a_process_that_hangs_is_dead_or_was_restarted_is_a_problem() {
        let found = problems_after(|now| {
            now.processes[0].state = ProcessState::Silent;
            now.processes[1].health.starts = 3;
            now.processes[2].state = ProcessState::Dead;
        });
        assert_eq!(
            found,
            [
                "ingress (pid 7) hangs, its main loop made no turn for 1.0 s: the bridge receives no samples; check \
                 the CPU load and its log, and restart it if it does not recover",
                "egress-critical was restarted 2 times in the last 1.0 s; read its log for the cause",
                "egress-noncritical (pid 7) is dead: lane noncritical forwards nothing; read its log, and if it is not \
                 restarted automatically, start its service or run `adaptive-bridge egress --lane noncritical`",
            ]
        );
    }

    #[test]
    fn a_standby_that_takes_over_again_and_again_is_a_problem() {
        let take_overs = |in_a_row| {
            problems_after(|now| {
                let taken_over_at = MonotonicNs(now.at.0 - 1);
                let cause = TakeOverCause::Ended as u8;
                let standby = &mut now.processes[1].standby;
                *standby = StandbyRecord { taken_over_at, in_a_row, cause, ..StandbyRecord::default() };
            })
        };
        assert_eq!(take_overs(4), [""; 0]);
        assert_eq!(
            take_overs(5),
            [
                "the standby of egress-critical took over 5 times, each time within a minute of the last, because \
                 the active process ended: read its log for the cause; samples are lost when it fails before the \
                 next standby has started",
            ]
        );
    }

    #[test]
    fn a_process_that_ended_normally_is_a_warning() {
        let mut now = healthy();
        now.processes[0].state = ProcessState::Ended;
        let expected = "ingress has ended: the bridge receives no samples; if it should run, start its service or run \
                        `adaptive-bridge ingress`";
        assert_eq!(of(&now, &healthy()), [Problem::new("ingress", Level::Warn, expected.into())]);
    }

    #[test]
    fn sample_counts_that_do_not_add_up_are_a_problem() {
        let found = problems_after(|now| {
            now.routes[0].counters.received += 2;
            now.routes[0].outputs[1].counters.last_sequence += 1;
        });
        assert_eq!(
            found,
            [
                "lane noncritical, route scan: the sample counts do not add up: 101 received, but 100 forwarded + 0 \
                 waiting + 0 dropped; unless egress-noncritical is stopped (SIGSTOP), this is a bug: report it with \
                 `adaptive-bridge status --json`",
                "ingress, route scan: the sample counts do not add up: 102 received, but 100 published + 0 dropped; \
                 this is a bug: report it with `adaptive-bridge status --json`",
            ]
        );
    }

    #[test]
    fn a_critical_lane_that_runs_and_forwards_nothing_is_a_problem() {
        let publish = |now: &mut Snapshot| {
            now.routes[0].counters.received += 50;
            now.routes[0].counters.published += 50;
        };
        let found = problems_after(publish);
        let expected = "lane critical, /c/scan: ingress published 50 samples in the last 1.0 s and the lane forwarded \
                        none; read the log of egress-critical";
        assert_eq!(found, [expected]);
        let found = problems_after(|now| {
            publish(now);
            now.lanes[0].mode = LaneMode::Stopped;
        });
        assert_eq!(found, [""; 0]);
    }

    #[test]
    fn unexpected_drops_within_the_window_are_problems() {
        let found = problems_after(|now| {
            now.routes[0].counters.received += 1;
            now.routes[0].counters.drops.add(DropReason::TooLarge, 1);
            now.routes[0].counters.lost_upstream += 4;
            now.routes[0].outputs[0].counters.readers = 2;
            drop_on(now, 0, DropReason::WriteFailed, 3);
            drop_on(now, 0, DropReason::Superseded, 1);
        });
        assert_eq!(found.len(), 4, "{found:?}");
        let too_large = DropReason::TooLarge.meaning();
        let expected =
            format!("ingress, route scan: dropped 1 sample in the last 1.0 s: {too_large} (too_large)");
        assert_eq!(found[0], expected);
        assert!(
            found[1].contains("lane critical, /c/scan: dropped 3 samples in the last 1.0 s"),
            "{found:?}"
        );
        assert!(found[1].contains("(write_failed); 2 subscribers matched"), "{found:?}");
        assert!(found[2].ends_with("(superseded)"), "{found:?}");
        assert!(
            found[3].contains("4 samples lost in the last 1.0 s between publisher and ingress"),
            "{found:?}"
        );
        let mut before = healthy();
        drop_on(&mut before, 0, DropReason::WriteFailed, 3);
        assert_eq!(of(&before, &before), []);
    }

    #[test]
    fn a_reader_that_missed_samples_is_a_problem_also_if_it_was_matched_anew_meanwhile() {
        let missed_since = |offered, overrun| {
            let record = |offered, overrun| ReaderRecord {
                reader: Guid([1; 16]),
                offered,
                overrun,
                reliable: 1,
                ..ReaderRecord::default()
            };
            let mut before = healthy();
            before.routes[0].outputs[0].readers.records[0] = record(1_000, 40);
            let mut now = before.clone();
            now.at = now.at.plus_ms(1_000);
            now.routes[0].outputs[0].readers.records[0] = record(offered, overrun);
            of(&now, &before).into_iter().map(|problem| problem.text).collect::<Vec<_>>()
        };
        assert_eq!(missed_since(1_100, 40), [""; 0]);
        assert_eq!(missed_since(300, 0), [""; 0]);
        for (offered, overrun, missed) in [(1_100, 45, 5), (300, 45, 45), (300, 40, 40), (1_100, 30, 30)] {
            let found = missed_since(offered, overrun);
            let expected = format!("missed {missed} samples in the last 1.0 s");
            assert!(found.len() == 1 && found[0].contains(&expected), "{offered}, {overrun}: {found:?}");
        }
    }

    #[test]
    fn a_mode_that_is_not_applied_and_a_missing_publisher_are_problems() {
        let found = problems_after(|now| {
            now.lanes[1].policy = LanePolicy { epoch: 1, ..LanePolicy::default() };
            now.lanes[1].mode = LaneMode::Suspended;
            now.routes[0].counters.writers = 0;
        });
        assert_eq!(
            found,
            [
                "lane noncritical: egress-noncritical has not applied mode suspended within 1 s; read its log, and \
                 restart it if it hangs",
                "route scan: lost the last publisher of /scan; check that its node runs and that its link is up",
            ]
        );
    }
}
