//! One reading of all boards of a bridge.

use std::path::Path;
use std::thread;
use std::time::Duration;

use super::liveness::ProcessState;
use crate::clock;
use crate::config::Settings;
use crate::model::{
    AbsenceRecord, ControlRecord, Guid, IngressCounters, InstanceName, IntruderRecord, LaneCounters,
    LaneMode, LaneName, LanePolicy, LatencyHistogram, MAX_ABSENCES, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS,
    MAX_PUBLISHERS, MAX_SUBSCRIBERS, MonotonicNs, NamedEndpoint, OutputReaders, ProcessHealth,
    PublisherAccount, RouteId, SubscriberRecord, TopicName, TrafficClass, TypeName, WallNs,
};
use crate::policy::effective_mode;
use crate::shm::{Boards, BridgeShape, ProcessRole, ShmError, Stage};

/// Within a turn a lane has counted a sample here and not yet there. A lane that does not add up is looked at
/// again so often, with this pause between: 20 ms, in which every turn ends.
const WHOLE_ATTEMPTS: usize = 100;
const WHOLE_PAUSE: Duration = Duration::from_micros(200);

/// All that the processes of a bridge show of themselves, read at one instant as nearly as can be without
/// making anybody wait.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The bridge.
    pub instance: InstanceName,
    /// When it was read.
    pub at: MonotonicNs,
    /// The same by the wall clock.
    pub at_wall: WallNs,
    /// Ingress, control where it ever ran, then the egress of each lane.
    pub processes: Vec<ProcessReading>,
    /// The lanes, in the order of the configuration.
    pub lanes: Vec<LaneReading>,
    /// The routes, in the order of the configuration.
    pub routes: Vec<RouteReading>,
    /// Whether the configuration asks for what only the control process does: probes or classification.
    pub needs_control: bool,
    /// What control found and decided for the bridge as a whole.
    pub control: ControlRecord,
    /// The subscribers that control follows.
    pub subscribers: Vec<SubscriberReading>,
    /// The remote readers that reach past the bridge, as control found them.
    pub intruders: Vec<IntruderRecord>,
    /// Network interfaces and peers that are or were away, as control found them.
    pub absences: Vec<AbsenceRecord>,
    /// The nodes of the outputs' readers, as control found them.
    pub named_endpoints: Vec<NamedEndpoint>,
}

/// One subscriber, as control sees it.
#[derive(Clone, Copy, Debug)]
pub struct SubscriberReading {
    /// Its lane, as an index into [`Snapshot::lanes`]; `None` when control named none that there is.
    pub lane: Option<usize>,
    /// What control shows of it.
    pub record: SubscriberRecord,
}

/// One process.
#[derive(Clone, Debug)]
pub struct ProcessReading {
    /// `ingress`, `control`, `egress-critical`, …
    pub name: String,
    /// Its role.
    pub role: ProcessRole,
    /// What it shows of itself.
    pub health: ProcessHealth,
    /// Whether it is there.
    pub state: ProcessState,
}

/// One lane.
#[derive(Clone, Debug)]
pub struct LaneReading {
    /// Its name.
    pub name: LaneName,
    /// Critical or noncritical.
    pub class: TrafficClass,
    /// What the policy board says to it.
    pub policy: LanePolicy,
    /// The mode that this comes to.
    pub mode: LaneMode,
    /// Why.
    pub reason: ModeReason,
    /// When the policy ends, unless it is confirmed or set anew.
    pub ends_at: Option<MonotonicNs>,
    /// What its process shows of itself, and with it the mode that it applies.
    pub health: ProcessHealth,
}

/// Why a lane is in its mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModeReason {
    /// Nobody has set one.
    Default,
    /// An operator set it.
    ByHand,
    /// The control process decided on it, and runs.
    Control,
    /// The safety supervisor allows no milder one.
    Safety,
    /// The control process decided on it and does not run; it holds for `policy_hold_s`.
    Held,
    /// The control process is gone for longer than `policy_hold_s`.
    Expired,
}

impl ModeReason {
    /// The name that `status` shows.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::ByHand => "by_hand",
            Self::Control => "control",
            Self::Safety => "safety",
            Self::Held => "held",
            Self::Expired => "expired",
        }
    }
}

/// One route.
#[derive(Clone, Debug)]
pub struct RouteReading {
    /// Its id.
    pub id: RouteId,
    /// What ingress subscribes to.
    pub input_topic: TopicName,
    /// The message type as far as it is known, in the terms of ROS 2 where it is one of those.
    pub message_type: Option<String>,
    /// What ingress counted.
    pub counters: IngressCounters,
    /// The accounts of its publishers; one of which no sample came has none.
    pub publishers: Vec<PublisherAccount>,
    /// From the publisher's source timestamp to ingress.
    pub dds_in: LatencyHistogram,
    /// The lanes that serve it.
    pub outputs: Vec<OutputReading>,
}

/// One route on one lane.
#[derive(Clone, Debug)]
pub struct OutputReading {
    /// The lane, as an index into [`Snapshot::lanes`].
    pub lane: usize,
    /// What the lane publishes to.
    pub topic: TopicName,
    /// What the lane counted.
    pub counters: LaneCounters,
    /// The readers that are matched with it.
    pub readers: OutputReaders,
    /// From ingress to the lane.
    pub shm: LatencyHistogram,
    /// Within the lane, up to its DDS writer.
    pub dds_out: LatencyHistogram,
    /// From the source timestamp to the lane's DDS writer.
    pub age: LatencyHistogram,
}

impl Snapshot {
    /// Reads the boards of the bridge that these settings describe, below `root`. `None` when it does not
    /// run; nothing is created then, and nothing of it is written or locked at any time.
    ///
    /// # Errors
    /// The boards are those of other settings or of another version, or may not be opened.
    pub fn take(root: &Path, settings: &Settings) -> Result<Option<Self>, ShmError> {
        let boards = Boards::find(root, &settings.instance, &BridgeShape::of(settings))?;
        let snapshot = boards.map(|boards| Self::read(&boards, settings)).transpose()?;
        Ok(snapshot.filter(Self::is_running))
    }

    /// Reads boards, whether anybody runs or not.
    ///
    /// # Errors
    /// A value changes faster than it can be read, which no process of ours does.
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
            let policy = steady(boards.policy(index))?;
            let hold_ms = settings.policy_hold_ms;
            let (reason, ends_at) = reason(&policy, control_runs, now, hold_ms);
            lanes.push(LaneReading {
                name: lane.name.clone(),
                class: lane.class,
                policy,
                mode: effective_mode(&policy, lane.class, now, hold_ms),
                reason,
                ends_at,
                health: egress.health,
            });
            processes.push(egress);
        }
        let routes = (0..settings.routes.len())
            .map(|route| read_route(boards, settings, route))
            .collect::<Result<_, _>>()?;
        let control = steady(boards.control())?;
        Ok(Self {
            instance: settings.instance.clone(),
            at: now,
            at_wall: clock::wall(),
            processes,
            routes,
            needs_control: settings.probes.enabled || settings.classifier.enabled,
            subscribers: read_subscribers(boards, &control, lanes.len())?,
            intruders: read_intruders(boards, &control)?,
            absences: read_absences(boards)?,
            named_endpoints: read_named_endpoints(boards)?,
            control,
            lanes,
        })
    }

    /// Whether any process of the bridge is there.
    pub fn is_running(&self) -> bool {
        self.processes.iter().any(|process| process.state.exists())
    }
}

fn read_subscribers(
    boards: &Boards,
    control: &ControlRecord,
    lanes: usize,
) -> Result<Vec<SubscriberReading>, ShmError> {
    let mut subscribers = Vec::new();
    for place in places(control.subscribers, MAX_SUBSCRIBERS) {
        let record = steady(boards.subscriber(place))?;
        if !record.id.as_str().is_empty() {
            let lane = usize::try_from(record.lane).ok().filter(|lane| *lane < lanes);
            subscribers.push(SubscriberReading { lane, record });
        }
    }
    Ok(subscribers)
}

fn read_intruders(boards: &Boards, control: &ControlRecord) -> Result<Vec<IntruderRecord>, ShmError> {
    let mut intruders = Vec::new();
    for place in places(control.intruders, MAX_INTRUDERS) {
        let record = steady(boards.intruder(place))?;
        if !record.topic.as_str().is_empty() {
            intruders.push(record);
        }
    }
    Ok(intruders)
}

fn read_absences(boards: &Boards) -> Result<Vec<AbsenceRecord>, ShmError> {
    let mut absences = Vec::new();
    for place in 0..MAX_ABSENCES {
        let record = steady(boards.absence(place))?;
        if record.since != MonotonicNs::default() {
            absences.push(record);
        }
    }
    Ok(absences)
}

fn read_named_endpoints(boards: &Boards) -> Result<Vec<NamedEndpoint>, ShmError> {
    let mut named = Vec::new();
    for place in 0..MAX_NAMED_ENDPOINTS {
        let record = steady(boards.named_endpoint(place))?;
        if record.endpoint != Guid::default() {
            named.push(record);
        }
    }
    Ok(named)
}

/// The places of a table that are taken; the board may say any number.
fn places(taken: u64, size: usize) -> std::ops::Range<usize> {
    0..usize::try_from(taken).unwrap_or(size).min(size)
}

fn process(
    boards: &Boards,
    name: String,
    role: ProcessRole,
    now: MonotonicNs,
) -> Result<ProcessReading, ShmError> {
    let health = steady(boards.health(role))?;
    Ok(ProcessReading { name, role, health, state: ProcessState::look(&health, now) })
}

/// As `effective_mode`, which says what and not why.
fn reason(
    policy: &LanePolicy,
    control_runs: bool,
    now: MonotonicNs,
    policy_hold_ms: u64,
) -> (ModeReason, Option<MonotonicNs>) {
    let confirmed = policy.is_confirmed(now, policy_hold_ms);
    let holds_until = policy.written_at.plus_ms(policy_hold_ms);
    let below_floor = if policy.is_overridden(now) { policy.mode_by_hand } else { policy.mode };
    if confirmed && policy.safety_floor > below_floor {
        (ModeReason::Safety, Some(holds_until))
    } else if policy.is_overridden(now) {
        (ModeReason::ByHand, Some(policy.expires_at).filter(|at| at.0 != 0))
    } else if policy.written_at.0 == 0 {
        (ModeReason::Default, None)
    } else if !confirmed {
        (ModeReason::Expired, None)
    } else if control_runs {
        (ModeReason::Control, Some(holds_until))
    } else {
        (ModeReason::Held, Some(holds_until))
    }
}

fn read_route(boards: &Boards, settings: &Settings, index: usize) -> Result<RouteReading, ShmError> {
    let route = &settings.routes[index];
    let found = steady(boards.route_info(index))?;
    let found = match found.dds_type.as_str() {
        "" => None,
        dds_type => Some(TypeName::from_dds(dds_type).map_or(dds_type.to_owned(), |name| name.to_string())),
    };
    let mut outputs = Vec::new();
    for (lane, configured) in settings.lanes.iter().enumerate() {
        for output in configured.outputs.iter().filter(|output| output.route == index) {
            outputs.push(OutputReading {
                lane,
                topic: output.topic.clone(),
                counters: read_lane(boards, lane, index)?,
                readers: steady(boards.output_readers(lane, index))?,
                shm: boards.histogram(Stage::Shm(lane), index),
                dds_out: boards.histogram(Stage::DdsOut(lane), index),
                age: boards.histogram(Stage::Age(lane), index),
            });
        }
    }
    let counters = steady(boards.ingress(index))?;
    Ok(RouteReading {
        publishers: read_publishers(boards, index, &counters)?,
        counters,
        id: route.id.clone(),
        input_topic: route.input_topic.clone(),
        message_type: found.or_else(|| route.message_type.as_ref().map(ToString::to_string)),
        dds_in: boards.histogram(Stage::DdsIn, index),
        outputs,
    })
}

fn read_publishers(
    boards: &Boards,
    route: usize,
    counters: &IngressCounters,
) -> Result<Vec<PublisherAccount>, ShmError> {
    let mut accounts = Vec::new();
    for place in 0..MAX_PUBLISHERS {
        let account = steady(boards.publisher(route, place))?;
        // While a process counts a sample, and after it died there, the account is with the counts only.
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
    let mut counters = steady(boards.lane(lane, route))?;
    for _ in 0..WHOLE_ATTEMPTS {
        if counters.is_whole() {
            break;
        }
        thread::sleep(WHOLE_PAUSE);
        counters = steady(boards.lane(lane, route))?;
    }
    Ok(counters)
}

/// A value that was read while it stood still.
fn steady<T>(value: Option<T>) -> Result<T, ShmError> {
    value.ok_or_else(|| ShmError::Failed {
        what: "to read a board".to_owned(),
        path: "/dev/shm".into(),
        reason: "its writer changes it faster than it can be read".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    #[test]
    fn a_mode_has_the_reason_that_its_policy_gives() {
        let mut policy = LanePolicy::default();
        let of = |policy: &LanePolicy, control_runs, ms| reason(policy, control_runs, at(ms), 5_000);
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
    fn each_reason_names_the_part_of_the_policy_that_gives_the_mode() {
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
            let effective = effective_mode(&policy, TrafficClass::Noncritical, at(at_ms), 5_000);
            let expected = match reason(&policy, true, at(at_ms), 5_000).0 {
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
