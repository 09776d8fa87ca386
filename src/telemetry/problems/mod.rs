//! What is wrong with a bridge, in words.

mod control;
mod publishers;

use super::liveness::ProcessState;
use super::report::drops_since;
use super::snapshot::{LaneReading, OutputReading, ProcessReading, RouteReading, Snapshot};
use crate::model::{DropReason, LaneCounters, LaneMode, TrafficClass};
use crate::shm::ProcessRole;

/// A lane writes the mode that it applies ten times a second; one that has not after so long does not look.
const APPLY_MS: u64 = 1_000;

/// Fewer samples may be on their way at the moment of the reading.
const SILENT_LANE_SAMPLES: u64 = 5;

/// Fewer samples may be on their way to a reader that acknowledges at each HEARTBEAT.
const SILENT_READER_SAMPLES: u64 = 5;

/// How grave something is: the levels of `diagnostic_msgs/DiagnosticStatus`, with their numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Level {
    /// Nothing is wrong.
    Ok = 0,
    /// Something is wrong and the bridge does its work.
    Warn = 1,
    /// Something does not do its work.
    Error = 2,
    /// Nothing is heard of it.
    Stale = 3,
}

impl Level {
    /// `ok`, `warn`, `error` or `stale`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Error => "error",
            Self::Stale => "stale",
        }
    }

    /// The graver of two. An error is graver than silence, which is no more than a suspicion.
    pub const fn worse(self, other: Self) -> Self {
        const fn rank(level: Level) -> u8 {
            match level {
                Level::Ok => 0,
                Level::Warn => 1,
                Level::Stale => 2,
                Level::Error => 3,
            }
        }
        if rank(other) > rank(self) { other } else { self }
    }
}

/// Something that is wrong. Its JSON is the sentence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// The part of the bridge: `bridge`, `ingress`, `control`, `safety`, `probes`, `network`, `intruders`,
    /// `lane NAME`, `route ID` or `subscriber ID`.
    pub about: String,
    /// How grave.
    pub level: Level,
    /// A sentence for people.
    pub text: String,
}

impl Problem {
    fn new(about: impl Into<String>, level: Level, text: String) -> Self {
        Self { about: about.into(), level, text }
    }
}

impl serde::Serialize for Problem {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.text)
    }
}

/// What is wrong, the gravest first: processes, accounts that do not add up, safety, lanes that forward
/// nothing, drops, what is away, subscribers, intruders, then what is only missing.
pub(super) fn of(now: &Snapshot, before: &Snapshot) -> Vec<Problem> {
    let mut problems = Vec::new();
    for process in &now.processes {
        let former = before.processes.iter().find(|former| former.name == process.name);
        problems.extend(process_problem(process, former, now));
    }
    problems.extend(control::missing(now));
    problems.extend(control::without_secret(now));
    for (route, output) in outputs(now) {
        problems.extend(unaccounted(route, output, &now.lanes[output.lane]));
    }
    problems.extend(now.routes.iter().filter_map(unaccounted_by_ingress));
    problems.extend(control::safety(now));
    for (route, output) in outputs(now) {
        problems.extend(silent(now, route, output, before.route(route)));
    }
    problems.extend(now.lanes.iter().filter_map(|lane| not_applied(lane, now)));
    for route in &now.routes {
        dropped(now, route, before.route(route), &mut problems);
    }
    for (route, output) in outputs(now) {
        let former = before.route(route).and_then(|former| former.output(output));
        overrun(now, output, former, &mut problems);
    }
    problems.extend(control::settings(now, before));
    problems.extend(control::absences(now));
    problems.extend(control::subscribers(now));
    problems.extend(control::intruders(now));
    problems.extend(control::refusals(now, before));
    problems.extend(now.routes.iter().filter_map(|route| publishers::clock_offset(now, route)));
    problems.extend(now.routes.iter().filter_map(|route| publishers::unrepaired(now, route)));
    problems.extend(now.routes.iter().filter_map(publishers::no_publisher));
    problems
}

fn outputs(snapshot: &Snapshot) -> impl Iterator<Item = (&RouteReading, &OutputReading)> {
    snapshot.routes.iter().flat_map(|route| route.outputs.iter().map(move |output| (route, output)))
}

fn process_problem(
    process: &ProcessReading,
    former: Option<&ProcessReading>,
    now: &Snapshot,
) -> Option<Problem> {
    let (name, pid) = (&process.name, process.health.pid);
    let consequence = match process.role {
        ProcessRole::Ingress => "nothing is taken in".to_owned(),
        ProcessRole::Control => "lanes keep their modes, then fall back to safe ones".to_owned(),
        ProcessRole::Egress(lane) => match now.lanes.get(lane) {
            Some(lane) => format!("lane {} forwards nothing", lane.name),
            None => "its lane forwards nothing".to_owned(),
        },
    };
    let about = match process.role {
        ProcessRole::Egress(lane) => now.lanes.get(lane).map_or("bridge".to_owned(), about_lane),
        ProcessRole::Ingress | ProcessRole::Control => name.clone(),
    };
    let text = match process.state {
        // Somebody wanted that; what follows is worth a word all the same.
        ProcessState::Ended => {
            return Some(Problem::new(about, Level::Warn, format!("{name} has ended: {consequence}")));
        }
        ProcessState::Dead => format!("{name} (pid {pid}) is dead: {consequence}"),
        ProcessState::Stopped => {
            format!("{name} (pid {pid}) is stopped: {consequence}; `kill -CONT {pid}` lets it go on")
        }
        ProcessState::Silent => {
            let silent_s = now.at.since(process.health.alive_at) as f64 / 1e9;
            format!("{name} (pid {pid}) has not turned for {silent_s:.1} s: {consequence}")
        }
        ProcessState::NotStarted => format!("{name} was never started: {consequence}"),
        ProcessState::Running => {
            let restarts = process.health.starts.checked_sub(former?.health.starts).filter(|&n| n > 0)?;
            let times = if restarts == 1 { "once".to_owned() } else { format!("{restarts} times") };
            return Some(Problem::new(about, Level::Warn, format!("{name} was restarted just now, {times}")));
        }
    };
    Some(Problem::new(about, Level::Error, text))
}

fn about_lane(lane: &LaneReading) -> String {
    format!("lane {}", lane.name)
}

fn unaccounted(route: &RouteReading, output: &OutputReading, lane: &LaneReading) -> Option<Problem> {
    let counters = &output.counters;
    (!counters.is_whole()).then(|| {
        let text = format!(
            "lane {}, route {}: does not add up: {} received, {} forwarded, {} waiting, {} dropped",
            lane.name,
            route.id,
            counters.received(),
            counters.forwarded,
            counters.waiting,
            counters.drops.total()
        );
        Problem::new(about_lane(lane), Level::Error, text)
    })
}

fn unaccounted_by_ingress(route: &RouteReading) -> Option<Problem> {
    let counters = &route.counters;
    (!route.is_whole()).then(|| {
        let text = format!(
            "ingress, route {}: does not add up: {} received, {} published, {} dropped",
            route.id,
            counters.received,
            counters.published,
            counters.drops.total()
        );
        Problem::new(format!("route {}", route.id), Level::Error, text)
    })
}

/// A critical lane that is there, and forwards nothing of what comes in.
fn silent(
    now: &Snapshot,
    route: &RouteReading,
    output: &OutputReading,
    former: Option<&RouteReading>,
) -> Option<Problem> {
    let lane = &now.lanes[output.lane];
    let process = now.processes.iter().find(|process| process.role == ProcessRole::Egress(output.lane))?;
    let former = former?;
    let published = route.counters.published.checked_sub(former.counters.published)?;
    // A sample that no reader was there for shows that the lane turns.
    let written = |counters: &LaneCounters| counters.forwarded + counters.drops.get(DropReason::NoReader);
    let forwarded = written(&output.counters).checked_sub(written(&former.output(output)?.counters))?;
    let may_forward = lane.class == TrafficClass::Critical && lane.mode != LaneMode::Stopped;
    (may_forward
        && process.state == ProcessState::Running
        && published >= SILENT_LANE_SAMPLES
        && forwarded == 0)
        .then(|| {
            let text = format!(
                "lane {}, {}: {published} samples came in just now and none was forwarded",
                lane.name, output.topic
            );
            Problem::new(about_lane(lane), Level::Error, text)
        })
}

fn not_applied(lane: &LaneReading, now: &Snapshot) -> Option<Problem> {
    let waited = now.at.since(lane.policy.changed_at) > APPLY_MS * 1_000_000;
    let applies = lane.health.policy_epoch == lane.policy.epoch;
    (lane.health.pid != 0 && waited && !applies && lane.policy.epoch != 0).then(|| {
        let text = format!(
            "lane {}: mode {} was set and the lane's process has not applied it",
            lane.name, lane.mode
        );
        Problem::new(about_lane(lane), Level::Warn, text)
    })
}

/// What was dropped or lost on a route within the window.
fn dropped(now: &Snapshot, route: &RouteReading, former: Option<&RouteReading>, problems: &mut Vec<Problem>) {
    let about = format!("route {}", route.id);
    let dropped = drops_since(&route.counters.drops, former.map(|former| former.counters.drops));
    for (reason, count) in dropped.iter() {
        let what = reason.meaning();
        let text =
            format!("ingress, route {}: {count} samples dropped just now: {what} ({reason})", route.id);
        problems.push(Problem::new(about.clone(), Level::Error, text));
    }
    for output in &route.outputs {
        let lane = &now.lanes[output.lane];
        let former = former.and_then(|former| former.output(output));
        let dropped = drops_since(&output.counters.drops, former.map(|former| former.counters.drops));
        for (reason, count) in dropped.iter().filter(|(reason, _)| !is_expected(*reason, lane.class)) {
            let level = match lane.class {
                TrafficClass::Critical => Level::Error,
                TrafficClass::Noncritical => Level::Warn,
            };
            let text = format!(
                "lane {}, {}: {count} samples dropped just now: {} ({reason}){}",
                lane.name,
                output.topic,
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
            "route {}: {lost} samples lost just now on their way from the publisher to the bridge{}",
            route.id,
            publishers::lost_by_publisher(now, route, former)
        );
        problems.push(Problem::new(about, Level::Warn, text));
    }
}

/// Readers that missed samples within the window, or acknowledge nothing, by node.
fn overrun(
    now: &Snapshot,
    output: &OutputReading,
    former: Option<&OutputReading>,
    problems: &mut Vec<Problem>,
) {
    let lane = &now.lanes[output.lane];
    for record in output.readers.iter() {
        let before = former.and_then(|former| {
            former.readers.iter().find(|earlier| earlier.reader == record.reader).copied()
        });
        let Some(before) = before else { continue };
        let missed = record.overrun.saturating_sub(before.overrun);
        // It was offered samples and has acknowledged not one of them, nor of those that waited before.
        let offered = record.offered.saturating_sub(before.offered);
        let is_silent = offered >= SILENT_READER_SAMPLES
            && record.unacknowledged.saturating_sub(before.unacknowledged) == offered
            && before.unacknowledged > 0;
        let reader = now.reader_name(record);
        let text = if missed > 0 {
            format!(
                "lane {}, {}: {reader} missed {missed} samples just now: it does not keep up (reader_overrun); \
                 the other subscribers have them",
                lane.name, output.topic
            )
        } else if is_silent {
            format!(
                "lane {}, {}: {reader} acknowledges nothing, {} samples so far: is it stopped, or its link down?",
                lane.name, output.topic, record.unacknowledged
            )
        } else {
            continue;
        };
        problems.push(Problem::new(about_lane(lane), Level::Warn, text));
    }
}

/// Who may be to blame for a write that failed: one of the matched readers, and not always a remote one.
fn matched_readers(reason: DropReason, output: &OutputReading) -> String {
    match (reason, output.counters.readers) {
        (DropReason::WriteFailed, 1) => "; 1 reader is matched".to_owned(),
        (DropReason::WriteFailed, readers) => format!("; {readers} readers are matched"),
        _ => String::new(),
    }
}

/// Drops that are how a noncritical lane works. A critical lane has none of these.
const fn is_expected(reason: DropReason, class: TrafficClass) -> bool {
    match reason {
        DropReason::Superseded | DropReason::QueueFull | DropReason::Suspended => {
            matches!(class, TrafficClass::Noncritical)
        }
        // The lane's mode says it, or the number of its readers, or that it was restarted just now.
        DropReason::Stopped | DropReason::NoReader => true,
        _ => false,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::snapshot::ModeReason;
    use super::*;
    use crate::model::{
        ControlRecord, IngressCounters, InstanceName, LaneCounters, LaneName, LanePolicy, LatencyHistogram,
        MonotonicNs, OutputReaders, ProcessHealth, RouteId, TopicName, WallNs,
    };

    /// A bridge of one route and the two lanes on which 100 samples came through, and nothing is wrong.
    pub(in crate::telemetry) fn sound() -> Snapshot {
        let at = MonotonicNs(100_000_000_000);
        let health = ProcessHealth { pid: 7, alive_at: at, starts: 1, ..ProcessHealth::default() };
        let process = |name: &str, role| ProcessReading {
            name: name.into(),
            role,
            health,
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
            routes: vec![RouteReading {
                id: RouteId::try_from("scan").unwrap(),
                input_topic: TopicName::try_from("/scan").unwrap(),
                message_type: None,
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
            control: ControlRecord::default(),
            subscribers: Vec::new(),
            intruders: Vec::new(),
            named_endpoints: Vec::new(),
            absences: Vec::new(),
        }
    }

    /// What is said of a bridge that was sound and then changed.
    pub(in crate::telemetry) fn after(change: impl FnOnce(&mut Snapshot)) -> Vec<String> {
        let before = sound();
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
    fn of_a_sound_bridge_nothing_is_said() {
        assert_eq!(after(|_| {}), [""; 0]);
        assert_eq!(after(|now| drop_on(now, 1, DropReason::Superseded, 90)), [""; 0]);
    }

    #[test]
    fn a_process_that_hangs_or_was_restarted_is_named() {
        let said = after(|now| {
            now.processes[0].state = ProcessState::Silent;
            now.processes[1].health.starts = 3;
            now.processes[2].state = ProcessState::Dead;
        });
        assert_eq!(
            said,
            [
                "ingress (pid 7) has not turned for 1.0 s: nothing is taken in",
                "egress-critical was restarted just now, 2 times",
                "egress-noncritical (pid 7) is dead: lane noncritical forwards nothing",
            ]
        );
    }

    #[test]
    fn a_process_that_was_told_to_end_is_no_error() {
        let mut now = sound();
        now.processes[0].state = ProcessState::Ended;
        let expected = Problem::new("ingress", Level::Warn, "ingress has ended: nothing is taken in".into());
        assert_eq!(of(&now, &sound()), [expected]);
    }

    #[test]
    fn an_account_that_does_not_add_up_is_shown() {
        let said = after(|now| {
            now.routes[0].counters.received += 2;
            now.routes[0].outputs[1].counters.last_sequence += 1;
        });
        assert_eq!(
            said,
            [
                "lane noncritical, route scan: does not add up: 101 received, 100 forwarded, 0 waiting, \
             0 dropped",
                "ingress, route scan: does not add up: 102 received, 100 published, 0 dropped",
            ]
        );
    }

    #[test]
    fn a_critical_lane_that_lives_and_forwards_nothing_is_named() {
        let come = |now: &mut Snapshot| {
            now.routes[0].counters.received += 50;
            now.routes[0].counters.published += 50;
        };
        let said = after(come);
        assert_eq!(said, ["lane critical, /c/scan: 50 samples came in just now and none was forwarded"]);
        let said = after(|now| {
            come(now);
            now.lanes[0].mode = LaneMode::Stopped;
        });
        assert_eq!(said, [""; 0]);
    }

    #[test]
    fn drops_that_are_no_part_of_the_work_are_named_while_they_go_on() {
        let said = after(|now| {
            now.routes[0].counters.received += 1;
            now.routes[0].counters.drops.add(DropReason::TooLarge, 1);
            now.routes[0].counters.lost_upstream += 4;
            now.routes[0].outputs[0].counters.readers = 2;
            drop_on(now, 0, DropReason::WriteFailed, 3);
            drop_on(now, 0, DropReason::Superseded, 1);
        });
        assert_eq!(said.len(), 4, "{said:?}");
        assert!(
            said[0].starts_with("ingress, route scan: 1 samples dropped just now: larger than"),
            "{said:?}"
        );
        assert!(said[1].contains("lane critical, /c/scan: 3 samples"), "{said:?}");
        assert!(said[1].ends_with("(write_failed); 2 readers are matched"), "{said:?}");
        assert!(said[2].ends_with("(superseded)"), "{said:?}");
        assert!(said[3].contains("4 samples lost just now on their way"), "{said:?}");
        let mut before = sound();
        drop_on(&mut before, 0, DropReason::WriteFailed, 3);
        assert_eq!(of(&before, &before), []);
    }

    #[test]
    fn a_mode_that_is_not_applied_and_a_publisher_that_is_missing_are_named() {
        let said = after(|now| {
            now.lanes[1].policy = LanePolicy { epoch: 1, ..LanePolicy::default() };
            now.lanes[1].mode = LaneMode::Suspended;
            now.routes[0].counters.writers = 0;
        });
        assert_eq!(
            said,
            [
                "lane noncritical: mode suspended was set and the lane's process has not applied it",
                "route scan: the publisher of /scan is gone",
            ]
        );
    }
}
