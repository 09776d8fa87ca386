//! Snapshot: one reading of all boards of a bridge.

use std::ops::Range;
use std::path::Path;
use std::thread;
use std::time::Duration;

use super::liveness::ProcessState;
use crate::clock;
use crate::config::{RoutePattern, SetParameters, Settings};
use crate::model::{
    AbsenceRecord, ControlRecord, Guid, IngressCounters, InstanceName, IntruderRecord, LaneCounters,
    LaneMode, LaneName, LanePolicy, LatencyHistogram, MAX_ABSENCES, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS,
    MAX_PUBLISHERS, MAX_SUBSCRIBERS, ModeReason, MonotonicNs, NamedEndpoint, OutputReaders, PatternRecord,
    ProcessHealth, PublisherAccount, RouteId, RouteInfo, StandbyRecord, SubscriberRecord, TopicName,
    TrafficClass, TypeName, WallNs,
};
use crate::policy::mode_and_source;
use crate::shm::{Boards, BridgeShape, ProcessRole, ShmError, Stage};

/// Attempts to read counts of a lane that add up. In the middle of a turn, a lane has updated only some of
/// its counts; with [`WHOLE_PAUSE`] between the attempts they take 20 ms, longer than any turn.
const WHOLE_ATTEMPTS: usize = 100;
/// See [`WHOLE_ATTEMPTS`].
const WHOLE_PAUSE: Duration = Duration::from_micros(200);

/// A standby that has not checked its role for this long is gone; it does so each 50 ms. Longer than the
/// watchdog of `up` waits, which kills one that hangs.
const STANDBY_SILENT_MS: u64 = 3_000;

/// The state of a bridge at one time, read from its boards. Reading blocks no process, so the boards are read
/// one after the other and may differ by the time that this takes.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The name of the bridge's instance.
    pub instance: InstanceName,
    /// The time of the reading.
    pub at: MonotonicNs,
    /// The time of the reading by the wall clock.
    pub at_wall: WallNs,
    /// Ingress, control if it ever ran, then the egress of each lane that has an output.
    pub processes: Vec<ProcessReading>,
    /// The lanes, in the order of the configuration.
    pub lanes: Vec<LaneReading>,
    /// The routes that have a topic, in the order of the configuration.
    pub routes: Vec<RouteReading>,
    /// The patterns, in the order of the configuration.
    pub patterns: Vec<PatternReading>,
    /// Whether the configuration enables probes or classification, which only the control process does.
    pub needs_control: bool,
    /// The control process's record for the whole bridge.
    pub control: ControlRecord,
    /// The parameters that were set while the bridge runs.
    pub set_parameters: SetParameters,
    /// The subscribers that control tracks.
    pub subscribers: Vec<SubscriberReading>,
    /// The intruders that control found.
    pub intruders: Vec<IntruderRecord>,
    /// The network interfaces and peers that are or were away.
    pub absences: Vec<AbsenceRecord>,
    /// The nodes of the inputs' publishers and of the outputs' readers.
    pub named_endpoints: Vec<NamedEndpoint>,
}

/// The record of one subscriber.
#[derive(Clone, Copy, Debug)]
pub struct SubscriberReading {
    /// Its lane, as an index into [`Snapshot::lanes`]; `None` when the record has no valid lane.
    pub lane: Option<usize>,
    /// The record that control writes.
    pub record: SubscriberRecord,
}

/// The health and the state of one process.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProcessReading {
    /// Its name: `ingress`, `control`, `egress-critical`, …
    pub name: String,
    /// Its role.
    #[serde(skip)]
    pub role: ProcessRole,
    /// Its health record.
    #[serde(flatten)]
    pub health: ProcessHealth,
    /// Its standby.
    pub standby: StandbyRecord,
    /// Its state.
    pub state: ProcessState,
}

/// The policy and the mode of one lane.
#[derive(Clone, Debug)]
pub struct LaneReading {
    /// Its name.
    pub name: LaneName,
    /// Critical or noncritical.
    pub class: TrafficClass,
    /// Its policy, from the policy board.
    pub policy: LanePolicy,
    /// The mode that results from the policy.
    pub mode: LaneMode,
    /// The reason of the mode.
    pub reason: ModeReason,
    /// The time at which the policy ends unless it is confirmed or set again.
    pub ends_at: Option<MonotonicNs>,
    /// The health record of its process, which includes the applied mode.
    pub health: ProcessHealth,
    /// Whether it has an output; else it has no process and is not shown.
    pub is_used: bool,
}

/// The state of one pattern.
#[derive(Clone, Debug)]
pub struct PatternReading {
    /// Its entry in the configuration.
    pub settings: RoutePattern,
    /// The record of ingress.
    pub record: PatternRecord,
}

/// The counters and latencies of one route.
#[derive(Clone, Debug)]
pub struct RouteReading {
    /// Its id.
    pub id: RouteId,
    /// The topic that ingress subscribes to.
    pub input_topic: TopicName,
    /// The id of its entry in `topics` if that is a pattern.
    pub pattern: Option<RouteId>,
    /// The message type if it is known; the ROS 2 name if it is a ROS 2 type.
    pub message_type: Option<String>,
    /// What the publishers announce of the type.
    pub info: RouteInfo,
    /// The counters of ingress.
    pub counters: IngressCounters,
    /// The accounts of its publishers; a publisher that has sent no sample has none.
    pub publishers: Vec<PublisherAccount>,
    /// Latency from the publisher's source timestamp to ingress.
    pub dds_in: LatencyHistogram,
    /// Its outputs, one for each lane that serves it.
    pub outputs: Vec<OutputReading>,
}

/// The counters and latencies of one output, which is a route on a lane.
#[derive(Clone, Debug)]
pub struct OutputReading {
    /// The lane, as an index into [`Snapshot::lanes`].
    pub lane: usize,
    /// The topic that the lane publishes to.
    pub topic: TopicName,
    /// The counters of the lane.
    pub counters: LaneCounters,
    /// The matched readers.
    pub readers: OutputReaders,
    /// Latency from ingress to the lane.
    pub shm: LatencyHistogram,
    /// Latency within the lane, up to its DDS writer.
    pub dds_out: LatencyHistogram,
    /// Age of the samples when the lane's DDS writer gets them, by their source timestamp.
    pub age: LatencyHistogram,
}

impl Snapshot {
    /// Reads the boards of the bridge with these settings below `root`; `None` when it does not run. It only
    /// reads: it creates, writes and locks nothing.
    ///
    /// # Errors
    /// The boards have other settings or another version, or cannot be opened.
    pub fn take(root: &Path, settings: &Settings) -> Result<Option<Self>, ShmError> {
        let boards = Boards::find(root, &settings.instance, &BridgeShape::of(settings))?;
        let snapshot = boards.map(|boards| Self::read(&boards, settings)).transpose()?;
        Ok(snapshot.filter(Self::is_running))
    }

    /// Reads boards, whether the bridge runs or not.
    ///
    /// # Errors
    /// A value changes faster than it can be read, which no process of the bridge does.
    pub fn read(boards: &Boards, settings: &Settings) -> Result<Self, ShmError> {
        let now = clock::monotonic();
        let ingress = process(boards, "ingress".to_owned(), ProcessRole::Ingress, now)?;
        let control = process(boards, "control".to_owned(), ProcessRole::Control, now)?;
        let control_runs = control.state.exists();
        let mut processes = vec![ingress];
        processes.extend((control.state != ProcessState::NotStarted).then_some(control));
        let mut lanes = Vec::with_capacity(settings.lanes.len());
        for (index, lane) in settings.lanes.iter().enumerate() {
            let egress = process(boards, format!("egress-{}", lane.name), ProcessRole::Egress(index), now)?;
            let policy = consistent(boards.policy(index))?;
            let hold_ms = settings.policy_hold_ms;
            let (mode, reason, ends_at) = mode_of(&policy, lane.class(), control_runs, now, hold_ms);
            lanes.push(LaneReading {
                name: lane.name.clone(),
                class: lane.class(),
                policy,
                mode,
                reason,
                ends_at,
                health: egress.health,
                is_used: lane.is_used(),
            });
            processes.extend(lane.is_used().then_some(egress));
        }
        let routes = (0..settings.routes.len())
            .filter_map(|route| read_route(boards, settings, route).transpose())
            .collect::<Result<_, _>>()?;
        let pattern = |pattern: &RoutePattern| {
            let record = consistent(boards.pattern(pattern.first_route))?;
            Ok(PatternReading { settings: pattern.clone(), record })
        };
        let patterns = settings.patterns.iter().map(pattern).collect::<Result<_, ShmError>>()?;
        let control = consistent(boards.control())?;
        Ok(Self {
            instance: settings.instance.clone(),
            at: now,
            at_wall: clock::wall(),
            processes,
            routes,
            patterns,
            set_parameters: settings.set_parameters.clone(),
            needs_control: settings.probes.enabled || settings.classifier.enabled,
            subscribers: read_subscribers(boards, &control, lanes.len())?,
            intruders: records(
                places(control.intruders, MAX_INTRUDERS),
                |place| boards.intruder(place),
                |one| !one.topic.as_str().is_empty(),
            )?,
            absences: records(
                0..MAX_ABSENCES,
                |place| boards.absence(place),
                |one| one.since != MonotonicNs::default(),
            )?,
            named_endpoints: records(
                0..MAX_NAMED_ENDPOINTS,
                |place| boards.named_endpoint(place),
                |one| one.endpoint != Guid::default(),
            )?,
            control,
            lanes,
        })
    }

    /// Whether any process of the bridge exists.
    pub fn is_running(&self) -> bool {
        self.processes.iter().any(|process| process.state.exists())
    }
}

fn read_subscribers(
    boards: &Boards,
    control: &ControlRecord,
    lanes: usize,
) -> Result<Vec<SubscriberReading>, ShmError> {
    let places = places(control.subscribers, MAX_SUBSCRIBERS);
    let records = records(places, |place| boards.subscriber(place), |one| !one.id.as_str().is_empty())?;
    let records = without_moved(records);
    let reading = |record: SubscriberRecord| {
        let lane = usize::try_from(record.lane).ok().filter(|lane| *lane < lanes);
        SubscriberReading { lane, record }
    };
    Ok(records.into_iter().map(reading).collect())
}

/// Drops records that control has just moved one place down, and not yet overwritten in their old place.
fn without_moved(mut records: Vec<SubscriberRecord>) -> Vec<SubscriberRecord> {
    records.dedup_by(|old, moved| old.id == moved.id);
    records
}

/// Reads the records in use at these places of a table.
fn records<T>(
    places: Range<usize>,
    read: impl Fn(usize) -> Option<T>,
    is_used: impl Fn(&T) -> bool,
) -> Result<Vec<T>, ShmError> {
    let records = places.map(|place| consistent(read(place)));
    records.filter(|record| record.as_ref().map_or(true, &is_used)).collect()
}

/// The places in use of a table with `size` places. The board may contain any number.
fn places(taken: u64, size: usize) -> Range<usize> {
    0..usize::try_from(taken).unwrap_or(size).min(size)
}

fn process(
    boards: &Boards,
    name: String,
    role: ProcessRole,
    now: MonotonicNs,
) -> Result<ProcessReading, ShmError> {
    let health = consistent(boards.health(role))?;
    let mut standby = consistent(boards.standby(role))?;
    if now.since(standby.alive_at) > STANDBY_SILENT_MS * 1_000_000 {
        standby.pid = 0;
    }
    Ok(ProcessReading { name, role, health, standby, state: ProcessState::read(&health, now) })
}

/// The mode of a lane, its reason, and the time at which the policy ends.
fn mode_of(
    policy: &LanePolicy,
    class: TrafficClass,
    control_runs: bool,
    now: MonotonicNs,
    policy_hold_ms: u64,
) -> (LaneMode, ModeReason, Option<MonotonicNs>) {
    let (mode, reason) = mode_and_source(policy, class, now, policy_hold_ms);
    let reason = if reason == ModeReason::Control && !control_runs { ModeReason::Held } else { reason };
    let ends_at = match reason {
        ModeReason::Default | ModeReason::Expired => None,
        ModeReason::ByHand => Some(policy.expires_at).filter(|at| at.0 != 0),
        ModeReason::Safety | ModeReason::Control | ModeReason::Held => {
            Some(policy.written_at.plus_ms(policy_hold_ms))
        }
    };
    (mode, reason, ends_at)
}

/// Reads a route; `None` for a place of a pattern that has had no topic yet.
fn read_route(boards: &Boards, settings: &Settings, index: usize) -> Result<Option<RouteReading>, ShmError> {
    let route = &settings.routes[index];
    let info = consistent(boards.route_info(index))?;
    let Some(input_topic) = route.input_topic.resolve(&info) else { return Ok(None) };
    let discovered_type = info.announced_type().map(|dds_type| type_name(dds_type.name));
    let mut outputs = Vec::new();
    for (lane, configured) in settings.lanes.iter().enumerate() {
        for output in configured.outputs.iter().filter(|output| output.route == index) {
            let Some(topic) = output.topic.resolve(Some(&input_topic)) else { continue };
            outputs.push(OutputReading {
                lane,
                topic,
                counters: read_lane(boards, lane, index)?,
                readers: consistent(boards.output_readers(lane, index))?,
                shm: boards.histogram(Stage::Shm(lane), index),
                dds_out: boards.histogram(Stage::DdsOut(lane), index),
                age: boards.histogram(Stage::Age(lane), index),
            });
        }
    }
    let counters = consistent(boards.ingress(index))?;
    Ok(Some(RouteReading {
        publishers: read_publishers(boards, index, &counters)?,
        counters,
        id: route.id.clone(),
        input_topic,
        pattern: route.input_topic.is_place().then(|| route.entry.clone()),
        message_type: discovered_type.or_else(|| route.message_type.as_ref().map(ToString::to_string)),
        info,
        dds_in: boards.histogram(Stage::DdsIn, index),
        outputs,
    }))
}

/// The name of a type; the ROS 2 name if it is a ROS 2 type.
pub(super) fn type_name(dds_name: &str) -> String {
    TypeName::from_dds(dds_name).map_or(dds_name.to_owned(), |name| name.to_string())
}

fn read_publishers(
    boards: &Boards,
    route: usize,
    counters: &IngressCounters,
) -> Result<Vec<PublisherAccount>, ShmError> {
    let mut accounts = Vec::new();
    for place in 0..MAX_PUBLISHERS {
        let account = consistent(boards.publisher(route, place))?;
        // While ingress counts a sample, and if it died then, the new account is only in the counters.
        let changed = &counters.changed_account;
        let is_behind = counters.changed_place == place as u64
            && !changed.is_vacant()
            && (account.writer != changed.writer || account.last_sequence < changed.last_sequence);
        let account = if is_behind { *changed } else { account };
        if !account.is_vacant() {
            accounts.push(account);
        }
    }
    Ok(accounts)
}

fn read_lane(boards: &Boards, lane: usize, route: usize) -> Result<LaneCounters, ShmError> {
    let mut counters = consistent(boards.lane(lane, route))?;
    for _ in 0..WHOLE_ATTEMPTS {
        if counters.is_accounted_for() {
            break;
        }
        #[allow(clippy::disallowed_methods, reason = "readers of the boards handle no samples")]
        thread::sleep(WHOLE_PAUSE);
        counters = consistent(boards.lane(lane, route))?;
    }
    Ok(counters)
}

/// The value of a board that was read without a change meanwhile, or an error.
fn consistent<T>(value: Option<T>) -> Result<T, ShmError> {
    value.ok_or_else(|| ShmError::Failed {
        what: "reading a board".to_owned(),
        path: "/dev/shm".into(),
        reason: "its writer changes it faster than it can be read".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::FixedText;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    #[test]
    fn a_subscriber_that_moves_in_the_table_is_read_once() {
        let record = |id: &str, lane| SubscriberRecord { id: FixedText::new(id), lane, ..Default::default() };
        let table = vec![record("desk", 1), record("laptop", 2), record("laptop", 3), record("tablet", 4)];
        let read = without_moved(table);
        let read: Vec<_> = read.iter().map(|one| (one.id.as_str(), one.lane)).collect();
        assert_eq!(read, [("desk", 1), ("laptop", 2), ("tablet", 4)]);
    }

    #[test]
    fn the_reason_follows_from_the_policy() {
        let mut policy = LanePolicy::default();
        let of = |policy: &LanePolicy, control_runs, ms| {
            let (_, reason, ends_at) =
                mode_of(policy, TrafficClass::Noncritical, control_runs, at(ms), 5_000);
            (reason, ends_at)
        };
        assert_eq!(of(&policy, true, 1), (ModeReason::Default, None));
        policy.written_at = at(1_000);
        assert_eq!(of(&policy, true, 6_000), (ModeReason::Control, Some(at(6_000))));
        assert_eq!(of(&policy, false, 6_000), (ModeReason::Held, Some(at(6_000))));
        assert_eq!(of(&policy, false, 6_001), (ModeReason::Expired, None));
        policy.by_hand = 1;
        assert_eq!(of(&policy, false, 1_000_000), (ModeReason::ByHand, None));
        policy.expires_at = at(9_000);
        assert_eq!(of(&policy, false, 8_999), (ModeReason::ByHand, Some(at(9_000))));
        assert_eq!(of(&policy, true, 9_000), (ModeReason::Expired, None));
        policy.safety_floor = LaneMode::Suspended as u8;
        assert_eq!(of(&policy, true, 6_000), (ModeReason::Safety, Some(at(6_000))));
        policy.mode_by_hand = LaneMode::Stopped as u8;
        assert_eq!(of(&policy, true, 6_000), (ModeReason::ByHand, Some(at(9_000))));
    }

    #[test]
    fn the_reason_agrees_with_the_mode() {
        let modes = LaneMode::ALL.map(|mode| mode as u8);
        for (mode, safety_floor, mode_by_hand, by_hand, at_ms) in modes
            .iter()
            .flat_map(|&mode| modes.iter().map(move |&floor| (mode, floor)))
            .flat_map(|(mode, floor)| {
                [(3 - mode, 0, 2_000), (3 - mode, 1, 2_000), (3 - mode, 1, 9_000)]
                    .map(|(hand, by_hand, at_ms)| (mode, floor, hand, by_hand, at_ms))
            })
        {
            let policy = LanePolicy {
                epoch: 1,
                written_at: at(1_000),
                expires_at: at(3_000),
                mode,
                safety_floor,
                by_hand,
                mode_by_hand,
                ..LanePolicy::default()
            };
            let (effective, reason, _) = mode_of(&policy, TrafficClass::Noncritical, true, at(at_ms), 5_000);
            let expected = match reason {
                ModeReason::Safety => safety_floor,
                ModeReason::ByHand => mode_by_hand,
                ModeReason::Control => mode,
                ModeReason::Expired => LaneMode::Degraded as u8,
                other => panic!("{other:?}"),
            };
            assert_eq!(effective as u8, expected, "{policy:?} at {at_ms} ms");
        }
    }
}
