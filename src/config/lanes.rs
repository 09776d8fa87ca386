//! Reads the lanes: their networks, queues, rates and scheduling.

use super::environment::Environment;
use super::field::Field;
use super::qos::{PartialQos, Profiles};
use super::rates::{self, RoutingPolicy};
use super::settings::{
    DEFAULT_WINDOW_SAMPLES, DdsNetwork, Forwarding, Lane, NetworkSelector, Scheduling, SchedulingPolicy,
    Standby,
};
use crate::model::{LaneName, TrafficClass};

/// The most lanes. Each is a process with its own DDS participant, and a domain allows 120 participants on a
/// host (RTPS 2.5 clause 9.6.2.3).
const MAX_LANES: usize = 32;

/// The nice value of noncritical lanes: when a sample wakes several lanes and one CPU is free, the critical
/// lane gets it. The scheduler gives a noncritical lane a ninth of the critical lane's weight.
const NONCRITICAL_NICE: u8 = 10;

/// The shortest slice that Linux grants, so that a critical lane preempts other processes when a sample
/// arrives (docs/decisions/0010-time-slices.md).
const CRITICAL_SLICE_US: u32 = 100;

/// Longer than the default slice of other programs, which is 0.7 to 2.8 ms depending on the number of CPUs,
/// so that each of them preempts a noncritical lane when it wakes. Short compared with the 100 ms between the
/// lane's samples.
const NONCRITICAL_SLICE_US: u32 = 10_000;

/// The default of ingress and of the critical lane: a subscriber then waits for tens of milliseconds when the
/// process ends, not for a start (docs/decisions/0027-warm-standby.md).
pub(super) const CRITICAL_STANDBY: Standby = Standby::Warm;

/// The samples of a route that may wait for a noncritical lane in shared memory. Fourteen static publishers
/// are discovered at once, while the lane sleeps or creates its writer.
const NONCRITICAL_QUEUE: usize = 16;

/// The default scheduling of a process: of a lane by its class, of others with `None`.
pub(super) fn default_scheduling(class: Option<TrafficClass>) -> Scheduling {
    let (nice, slice_us) = match class {
        Some(TrafficClass::Critical) => (0, Some(CRITICAL_SLICE_US)),
        Some(TrafficClass::Noncritical) => (NONCRITICAL_NICE, Some(NONCRITICAL_SLICE_US)),
        None => (0, None),
    };
    Scheduling { nice, slice_us, ..Scheduling::default() }
}

/// A lane without its outputs, and the default QoS of its outputs.
pub(super) struct LaneDraft {
    pub lane: Lane,
    pub qos: PartialQos,
}

/// Reads all lanes, without outputs: `critical`, `noncritical`, then the user's in the order of the file.
pub(super) fn read(
    root: &Field<'_>,
    profiles: &Profiles<'_>,
    input: &DdsNetwork,
    environment: &Environment,
    max_noncritical_queue: u64,
) -> Vec<LaneDraft> {
    let section = root.section("lanes");
    let policy = RoutingPolicy::read(root, max_noncritical_queue);
    let mut lanes: Vec<(LaneName, Field<'_>)> = [LaneName::critical(), LaneName::noncritical()]
        .into_iter()
        .map(|name| (name.clone(), section.section(name.as_str())))
        .collect();
    for (name, field) in section.entries() {
        if name == LaneName::critical().as_str() || name == LaneName::noncritical().as_str() {
            continue;
        }
        match LaneName::try_from(name) {
            // `topics[].qos_overrides.input` is the QoS of the ingress reader.
            Ok(_) if name == "input" => {
                field.report_key(
                    "must be a lane name other than input, which qos_overrides uses for the input",
                );
            }
            Ok(name) => lanes.push((name, field)),
            Err(error) => {
                field.report_key(&format!("must be a lane name: {}", error.allowed));
            }
        }
    }
    if lanes.len() > MAX_LANES {
        section.report_key(&format!("must be at most {MAX_LANES} lanes, each of which is a process"));
        lanes.truncate(MAX_LANES);
    }
    let reader = LaneReader { profiles, input, environment, policy };
    lanes.into_iter().map(|(name, field)| reader.read(name, &field)).collect()
}

struct LaneReader<'a> {
    profiles: &'a Profiles<'a>,
    input: &'a DdsNetwork,
    environment: &'a Environment,
    policy: RoutingPolicy,
}

impl LaneReader<'_> {
    fn read(&self, name: LaneName, field: &Field<'_>) -> LaneDraft {
        field.entries();
        let (class, queue_depth, window_samples, forwarding) = if name == LaneName::critical() {
            rates::refuse_rates(field);
            (TrafficClass::Critical, 64, Some(DEFAULT_WINDOW_SAMPLES), Forwarding::Everything)
        } else {
            let forwarding = Forwarding::Limited(self.policy.lane_rates(field));
            (TrafficClass::Noncritical, NONCRITICAL_QUEUE, None, forwarding)
        };
        let qos = field.get("qos");
        let default_dscp = match class {
            TrafficClass::Critical => EXPEDITED_FORWARDING,
            TrafficClass::Noncritical => 0,
        };
        let lane = Lane {
            dscp: field.get("dscp").count().unwrap_or(default_dscp),
            name,
            forwarding,
            network: network(field, self.input, self.environment),
            outputs: Vec::new(),
            queue_depth: field.get("queue_depth").count().unwrap_or(queue_depth),
            max_borrowed: field.get("max_borrowed").count_or_default(),
            by_reference_min_bytes: field.get("by_reference_min_bytes").count_or_default(),
            window_samples: field.get("window_samples").count().or(window_samples),
            scheduling: scheduling(&field.section("scheduling"), default_scheduling(Some(class))),
            standby: standby(&field.get("standby"), class),
        };
        let qos =
            if qos.is_map() { PartialQos::read(&qos) } else { self.profiles.named(&qos).unwrap_or_default() };
        LaneDraft { lane, qos }
    }
}

/// Only critical lanes may have a standby: other lanes keep no identity for it to continue.
fn standby(field: &Field<'_>, class: TrafficClass) -> Standby {
    let standby = field.choice();
    match class {
        TrafficClass::Critical => standby.unwrap_or(CRITICAL_STANDBY),
        TrafficClass::Noncritical => {
            if standby == Some(Standby::Warm) {
                field.report::<()>(
                    "must be none, because only the critical lane and ingress can have a standby",
                );
            }
            Standby::None
        }
    }
}

/// The DSCP of what must arrive soon (RFC 3246). Wi-Fi sends it before the rest, in the queue for video.
const EXPEDITED_FORWARDING: u8 = 46;

/// Reads `domain_id`, `networks` and `static_peers` of a section; missing values are those of `base`.
pub(super) fn network(section: &Field<'_>, base: &DdsNetwork, environment: &Environment) -> DdsNetwork {
    let domain = section.get("domain_id").count();
    let interfaces = section.get("networks").items().map(|items| {
        let selectors =
            items.iter().filter_map(|item| item.parsed(NetworkSelector::ALLOWED, NetworkSelector::parse));
        selectors.collect()
    });
    let interfaces = interfaces.unwrap_or_else(|| base.interfaces.clone());
    let peers = section.get("static_peers");
    let static_peers = peers.items().map(|items| {
        if items.len() > DdsNetwork::MAX_STATIC_PEERS {
            peers.report_key(&format!("must be at most {} addresses", DdsNetwork::MAX_STATIC_PEERS));
        }
        items.iter().filter_map(|item| item.parsed("an IPv4 address", |text| text.parse().ok())).collect()
    });
    DdsNetwork {
        static_peers: static_peers.unwrap_or_else(|| base.static_peers.clone()),
        domain_id: domain.unwrap_or(base.domain_id),
        interfaces: if interfaces.is_empty() { environment.default_interfaces() } else { interfaces },
    }
}

/// Reads a `scheduling` section; missing values are those of `default`.
pub(super) fn scheduling(section: &Field<'_>, default: Scheduling) -> Scheduling {
    let policy = section.get("policy");
    let priority = section.get("priority");
    let kind = policy.choice_or_default();
    let priority = match kind {
        // If the policy itself is wrong, the allowed priority is unknown.
        SchedulingPolicy::Other if policy.was_reported() => 0,
        SchedulingPolicy::Other => priority
            .whole_where("must be 0 unless policy is fifo or rr", |priority| priority == 0)
            .unwrap_or(0),
        SchedulingPolicy::Fifo | SchedulingPolicy::RoundRobin => {
            if !priority.is_given() {
                priority.report::<()>("must be a whole number from 1 to 99, because policy is fifo or rr");
            }
            priority.count().unwrap_or(1)
        }
    };
    let given_nice = section.get("nice").count();
    let slice_ms = section.get("slice_ms").decimal();
    let cpus = section.get("cpus").items().unwrap_or_default();
    Scheduling {
        policy: kind,
        priority: u8::try_from(priority).unwrap_or(0),
        nice: given_nice.unwrap_or(default.nice),
        slice_us: slice_ms.map(|ms| (ms * 1_000.0).round() as u32).or(default.slice_us),
        cpus: cpus.iter().filter_map(|cpu| usize::try_from(cpu.whole_in(0..=1023)?).ok()).collect(),
        lock_memory: section.get("lock_memory").flag_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use super::MAX_LANES;
    use crate::config::{DdsNetwork, parse};

    #[test]
    fn as_many_lanes_and_addresses_as_allowed_are_accepted_and_more_are_not() {
        let problems = |lanes: usize, addresses: usize| {
            let lanes: String = (2..lanes).map(|number| format!("  l{number}: {{}}\n")).collect();
            let addresses = vec!["10.0.0.1"; addresses].join(", ");
            let text = format!(
                "topics: [{{id: scan, input_topic: /scan}}]\nros: {{static_peers: [{addresses}]}}\nlanes:\n{lanes}"
            );
            parse(&text, "f.yaml", &|_| None).map_or_else(|error| error.to_string(), |_| String::new())
        };
        let peers = DdsNetwork::MAX_STATIC_PEERS;
        assert_eq!(problems(MAX_LANES, peers), "");
        assert!(problems(MAX_LANES + 1, peers).starts_with("f.yaml:3: lanes: must be at most 32 lanes"));
        for more in [1, 2] {
            let problems = problems(MAX_LANES, peers + more);
            assert_eq!(problems, "f.yaml:2: ros.static_peers: must be at most 16 addresses");
        }
    }
}
