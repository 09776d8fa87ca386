//! The report made from two snapshots: counts, and the rates and latencies of the time between them.
//!
//! The types here are the JSON of `status --json`; `docs/status-json.md` documents every key.

mod control;
mod latency;

pub use control::{
    AbsenceReport, IntruderReport, ParametersReport, ProbesReport, SafetyReport, SubscriberReport,
};
pub use latency::{Latency, LatencyTotal};

use super::problem::Problem;
use super::snapshot::{LaneReading, OutputReading, PatternReading, ProcessReading, RouteReading, Snapshot};
use super::text::printable;
use crate::model::{
    DropCounts, Guid, IngressCounters, LaneCounters, LaneMode, MonotonicNs, PublisherAccount, ReaderRecord,
    TypeHash,
};

/// The state of a bridge. Keys that end in a unit are in that unit; an unknown value is null.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    pub(crate) instance: String,
    /// The time of the later snapshot, in milliseconds since the Unix epoch.
    pub(crate) time_unix_ms: u64,
    /// The time between the two snapshots, to which rates, latencies and `drops_in_window` refer.
    pub(crate) window_ms: f64,
    pub(crate) problems: Vec<Problem>,
    pub(crate) safety: SafetyReport,
    pub(crate) processes: Vec<ProcessReport>,
    pub(crate) lanes: Vec<LaneReport>,
    pub(crate) routes: Vec<RouteReport>,
    pub(crate) patterns: Vec<PatternReport>,
    pub(crate) shared_memory: SharedMemoryReport,
    pub(crate) probes: ProbesReport,
    pub(crate) parameters: ParametersReport,
    /// The subscribers that control tracks.
    pub subscribers: Vec<SubscriberReport>,
    pub(crate) intruders: Vec<IntruderReport>,
    /// Intruders seen since control started, including those not listed.
    pub(crate) intruders_seen: u64,
    /// The network interfaces and peers that are away, or came back within the last 15 minutes.
    pub(crate) absences: Vec<AbsenceReport>,
}

/// The shared memory of the pools of all routes, as ingress last reported it.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct SharedMemoryReport {
    /// The most that they may take.
    pub(crate) budget_bytes: u64,
    /// What they have.
    pub(crate) used_bytes: u64,
    /// The most that they have had since ingress started.
    pub(crate) peak_bytes: u64,
}

/// The state of one process.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProcessReport {
    #[serde(flatten)]
    pub(crate) reading: ProcessReading,
    pub(crate) uptime_s: Option<f64>,
    pub(crate) last_turn_age_ms: Option<f64>,
    /// A hash of the settings that it applies, in hexadecimal, to compare processes; null until it is known.
    pub(crate) settings_fingerprint: Option<String>,
}

/// The mode of one lane.
#[derive(Clone, Debug, serde::Serialize)]
pub struct LaneReport {
    pub(crate) name: String,
    pub(crate) class: &'static str,
    /// The mode that results from the policy board.
    pub(crate) mode: &'static str,
    pub(crate) mode_reason: &'static str,
    /// The reason as text for users, with its cause. The wording may change.
    pub(crate) mode_detail: String,
    /// The time until the policy ends unless it is confirmed or set again.
    pub(crate) mode_ends_in_s: Option<f64>,
    /// The epoch of the policy on the board; 0 when no policy was ever set.
    pub(crate) policy_epoch: u64,
    pub(crate) applied_mode: Option<&'static str>,
    pub(crate) applied_policy_epoch: u64,
}

/// The counts, rates and latencies of one route.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RouteReport {
    pub(crate) id: String,
    pub(crate) input_topic: String,
    /// The id of its entry in `topics` if that is a pattern.
    pub(crate) pattern: Option<String>,
    /// The message type; null until it is known.
    pub(crate) message_type: Option<String>,
    /// The hash of the message type's definition that the outputs announce; null while it is unknown.
    pub(crate) type_hash: Option<String>,
    /// Whether the type has keys, as the publishers announce it.
    pub(crate) has_keys: bool,
    #[serde(flatten)]
    pub(crate) counters: IngressCounters,
    /// The publishers that have sent samples.
    pub(crate) publishers: Vec<PublisherReport>,
    pub(crate) drops_in_window: DropCounts,
    /// Whether `received = published + drops`.
    pub(crate) whole: bool,
    pub(crate) rate_hz: Option<f64>,
    pub(crate) bytes_per_s: Option<f64>,
    pub(crate) last_received_age_ms: Option<f64>,
    /// How far a publisher's clock is ahead of this computer's; `null` while all agree.
    pub(crate) clock_offset_s: Option<f64>,
    pub(crate) clock_offset_writer: Option<String>,
    /// Latency from the publisher's source timestamp to ingress.
    pub(crate) dds_in: Latency,
    /// The outputs of the route, one for each lane that serves it.
    pub(crate) lanes: Vec<OutputReport>,
}

/// The places of one pattern.
#[derive(Clone, Debug, serde::Serialize)]
pub struct PatternReport {
    /// The id of its entry in `topics`.
    pub(crate) id: String,
    pub(crate) input_topic: String,
    pub(crate) max_routes: usize,
    /// Places that have a topic.
    pub(crate) routes: usize,
    /// Topics that match and wait for a place.
    pub(crate) waiting: u64,
    /// The topic that has waited longest; null if none waits.
    pub(crate) first_waiting: Option<String>,
    /// Places that a topic has had to leave for another one, since ingress started.
    pub(crate) released: u64,
    /// Matching topics that have no valid output, each time one of their writers is discovered.
    pub(crate) refused: u64,
    /// Times that a waiting topic was forgotten because too many waited.
    pub(crate) forgotten: u64,
}

/// The account of one publisher of a route, from the sequence numbers of its DDS writer.
#[derive(Clone, Debug, serde::Serialize)]
pub struct PublisherReport {
    #[serde(flatten)]
    pub(crate) account: PublisherAccount,
    #[serde(flatten)]
    pub(crate) origin: EndpointOrigin,
    /// `RELIABLE` or `BEST_EFFORT`; null when the publisher has left.
    pub(crate) reliability: Option<&'static str>,
    pub(crate) last_received_age_ms: Option<f64>,
}

/// The counts, rates and latencies of one output.
#[derive(Clone, Debug, serde::Serialize)]
pub struct OutputReport {
    pub(crate) lane: String,
    pub(crate) topic: String,
    /// The matched readers, 32 at most.
    pub(crate) matched_readers: Vec<ReaderReport>,
    /// Readers of the topic that request a stricter QoS than the lane offers, 8 at most.
    pub(crate) unmatched_readers: Vec<UnmatchedReport>,
    /// Samples offered to the lane since it first started.
    pub(crate) received: u64,
    #[serde(flatten)]
    pub(crate) counters: LaneCounters,
    pub(crate) drops_in_window: DropCounts,
    /// Whether `received = forwarded + waiting + drops`.
    pub(crate) whole: bool,
    /// Samples offered per second.
    pub(crate) received_hz: Option<f64>,
    /// Samples forwarded per second.
    pub(crate) rate_hz: Option<f64>,
    pub(crate) bytes_per_s: Option<f64>,
    pub(crate) last_forwarded_age_ms: Option<f64>,
    /// Latency from ingress to the lane.
    pub(crate) shm: Latency,
    /// Latency within the lane, up to its DDS writer.
    pub(crate) dds_out: Latency,
    /// Age of the samples when the DDS writer gets them, by their source timestamp.
    pub(crate) age: Latency,
}

/// A reader of an output's topic that gets nothing, because it requests a stricter QoS than the lane offers.
#[derive(Clone, Debug, serde::Serialize)]
pub struct UnmatchedReport {
    /// Its GUID, in hexadecimal.
    pub(crate) guid: String,
    #[serde(flatten)]
    pub(crate) origin: EndpointOrigin,
    /// The QoS policy for which it does not match.
    pub(crate) policy: &'static str,
}

/// One reader of an output.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ReaderReport {
    #[serde(flatten)]
    pub(crate) record: ReaderRecord,
    #[serde(flatten)]
    pub(crate) origin: EndpointOrigin,
    /// `RELIABLE` or `BEST_EFFORT`.
    pub(crate) reliability: &'static str,
}

/// Where a publisher or a reader is.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct EndpointOrigin {
    /// Its ROS 2 node; null while it is unknown.
    pub(crate) node: Option<String>,
    /// The address of its host; null while it is unknown.
    pub(crate) host: Option<String>,
}

impl Snapshot {
    /// The report of [`Snapshot::report_since`], with these problems.
    pub(super) fn report_with(&self, earlier: &Self, problems: Vec<Problem>) -> Report {
        let window_ms = self.at.since(earlier.at) as f64 / 1e6;
        Report {
            instance: self.instance.to_string(),
            time_unix_ms: self.at_wall.0 / 1_000_000,
            window_ms,
            problems,
            processes: self.processes.iter().map(|process| process_report(process, self.at)).collect(),
            safety: self.safety_report(),
            lanes: self
                .lanes
                .iter()
                .enumerate()
                .filter(|(_, lane)| lane.is_used)
                .map(|(number, lane)| self.lane_report(number, lane))
                .collect(),
            patterns: self.patterns.iter().map(|pattern| self.pattern_report(pattern)).collect(),
            routes: self
                .routes
                .iter()
                .map(|route| self.route_report(route, earlier.route(route), window_ms))
                .collect(),
            shared_memory: self.shared_memory_report(),
            probes: self.probes_report(earlier),
            parameters: self.parameters_report(),
            subscribers: self.subscribers.iter().map(|one| self.subscriber_report(one)).collect(),
            intruders: self.intruders.iter().map(|one| self.intruder_report(one)).collect(),
            intruders_seen: self.control.intruders_seen,
            absences: self.absences.iter().map(|one| self.absence_report(one)).collect(),
        }
    }

    /// Each route has the same numbers, of the moment at which ingress wrote its board; the largest are the
    /// latest, but for a pool that has just given memory back.
    fn shared_memory_report(&self) -> SharedMemoryReport {
        let most = |of: fn(&IngressCounters) -> u64| {
            self.routes.iter().map(|route| of(&route.counters)).max().unwrap_or(0)
        };
        SharedMemoryReport {
            budget_bytes: most(|counters| counters.budget_bytes),
            used_bytes: most(|counters| counters.budget_used_bytes),
            peak_bytes: most(|counters| counters.budget_peak_bytes),
        }
    }

    /// The route with the same id in this snapshot, unless it had another topic then.
    pub(super) fn route(&self, other: &RouteReading) -> Option<&RouteReading> {
        self.routes.iter().find(|route| route.id == other.id && route.input_topic == other.input_topic)
    }

    fn pattern_report(&self, pattern: &PatternReading) -> PatternReport {
        let PatternReading { settings, record } = pattern;
        let first = printable(record.first_waiting.as_str());
        let is_of = |route: &&RouteReading| route.pattern.as_ref() == Some(&settings.entry);
        PatternReport {
            id: settings.entry.to_string(),
            input_topic: settings.input_topic.to_string(),
            max_routes: settings.max_routes,
            routes: self.routes.iter().filter(is_of).count(),
            waiting: record.waiting,
            first_waiting: Some(first).filter(|first| !first.is_empty()),
            released: record.released,
            refused: record.refused,
            forgotten: record.forgotten,
        }
    }

    fn lane_report(&self, number: usize, lane: &LaneReading) -> LaneReport {
        let applied = LaneMode::from_u8(lane.health.mode);
        LaneReport {
            name: lane.name.to_string(),
            class: lane.class.label(),
            mode: lane.mode.label(),
            mode_reason: lane.reason.label(),
            mode_detail: self.mode_detail(number, lane),
            mode_ends_in_s: lane.ends_at.map(|at| at.since(self.at) as f64 / 1e9),
            policy_epoch: lane.policy.epoch,
            applied_mode: applied.filter(|_| lane.health.pid != 0).map(|mode| mode.label()),
            applied_policy_epoch: lane.health.policy_epoch,
        }
    }

    fn route_report(&self, now: &RouteReading, before: Option<&RouteReading>, window_ms: f64) -> RouteReport {
        let (counters, former) = (&now.counters, before.map(|before| before.counters));
        let rate = |now, before: Option<u64>| per_s(now, before, window_ms);
        RouteReport {
            id: now.id.to_string(),
            input_topic: now.input_topic.to_string(),
            pattern: now.pattern.as_ref().map(ToString::to_string),
            message_type: now.message_type.as_deref().map(printable),
            type_hash: Some(now.info.type_hash).filter(TypeHash::is_known).map(|hash| hash.to_string()),
            has_keys: now.info.has_keys != 0,
            counters: *counters,
            publishers: now.publishers.iter().map(|account| self.publisher_report(account)).collect(),
            drops_in_window: counters.drops.since_reading(former.map(|former| former.drops)),
            whole: now.is_accounted_for(),
            rate_hz: rate(counters.received, former.map(|former| former.received)),
            bytes_per_s: rate(counters.received_bytes, former.map(|former| former.received_bytes)),
            last_received_age_ms: age_ms(counters.last_received_at, self.at),
            clock_offset_s: counters.clock_offset_s(),
            clock_offset_writer: counters.clock_offset_s().map(|_| counters.clock_writer.to_string()),
            dds_in: Latency::of(&now.dds_in, before.map(|before| &before.dds_in)),
            lanes: now
                .outputs
                .iter()
                .map(|output| {
                    let before = before.and_then(|before| before.output(output));
                    self.output_report(output, before, window_ms)
                })
                .collect(),
        }
    }

    fn publisher_report(&self, account: &PublisherAccount) -> PublisherReport {
        PublisherReport {
            account: *account,
            origin: self.origin(account.writer),
            reliability: match account.offered_reliability {
                PublisherAccount::OFFERS_RELIABLE => Some("RELIABLE"),
                PublisherAccount::OFFERS_BEST_EFFORT => Some("BEST_EFFORT"),
                _ => None,
            },
            last_received_age_ms: age_ms(account.last_at, self.at),
        }
    }

    fn output_report(
        &self,
        now: &OutputReading,
        before: Option<&OutputReading>,
        window_ms: f64,
    ) -> OutputReport {
        let (counters, former) = (&now.counters, before.map(|before| before.counters));
        let rate = |now, before: Option<u64>| per_s(now, before, window_ms);
        let matched = now.readers.iter().map(|record| ReaderReport {
            record: *record,
            origin: self.origin(record.reader),
            reliability: if record.reliable == 1 { "RELIABLE" } else { "BEST_EFFORT" },
        });
        let unmatched = now.readers.unmatched().map(|(reader, policy)| UnmatchedReport {
            guid: reader.to_string(),
            origin: self.origin(reader),
            policy: policy.label(),
        });
        OutputReport {
            lane: self.lanes[now.lane].name.to_string(),
            topic: now.topic.to_string(),
            matched_readers: matched.collect(),
            unmatched_readers: unmatched.collect(),
            received: counters.received(),
            counters: *counters,
            drops_in_window: counters.drops.since_reading(former.map(|former| former.drops)),
            whole: counters.is_accounted_for(),
            received_hz: rate(counters.received(), former.map(|former| former.received())),
            rate_hz: rate(counters.forwarded, former.map(|former| former.forwarded)),
            bytes_per_s: rate(counters.forwarded_bytes, former.map(|former| former.forwarded_bytes)),
            last_forwarded_age_ms: age_ms(counters.last_forwarded_at, self.at),
            shm: Latency::of(&now.shm, before.map(|before| &before.shm)),
            dds_out: Latency::of(&now.dds_out, before.map(|before| &before.dds_out)),
            age: Latency::of(&now.age, before.map(|before| &before.age)),
        }
    }

    fn origin(&self, endpoint: Guid) -> EndpointOrigin {
        let named = self.named_endpoints.iter().find(|named| named.endpoint == endpoint);
        named.map_or_else(EndpointOrigin::default, |named| EndpointOrigin {
            node: some_text(named.node.as_str()),
            host: some_text(named.host.as_str()),
        })
    }

    /// A name for a writer or reader: its node, or else its GUID, and its host if it is known.
    pub(super) fn endpoint_name(&self, kind: &str, endpoint: Guid) -> String {
        let EndpointOrigin { node, host } = self.origin(endpoint);
        let node = node.unwrap_or_else(|| format!("{kind} {endpoint}"));
        host.map_or_else(|| node.clone(), |host| format!("{node} on {host}"))
    }
}

impl RouteReading {
    /// Whether every received sample was published or dropped for a named reason.
    pub fn is_accounted_for(&self) -> bool {
        self.counters.received == self.counters.published + self.counters.drops.total()
    }

    /// The output with the same lane and topic in this reading.
    pub(super) fn output(&self, other: &OutputReading) -> Option<&OutputReading> {
        self.outputs.iter().find(|output| output.lane == other.lane && output.topic == other.topic)
    }
}

fn process_report(process: &ProcessReading, now: MonotonicNs) -> ProcessReport {
    let health = &process.health;
    ProcessReport {
        reading: process.clone(),
        uptime_s: age_ms(health.started_at, now).filter(|_| process.state.exists()).map(|ms| ms / 1e3),
        last_turn_age_ms: age_ms(health.alive_at, now),
        settings_fingerprint: (health.settings_fingerprint != 0)
            .then(|| format!("{:016x}", health.settings_fingerprint)),
    }
}

fn some_text(text: &str) -> Option<String> {
    (!text.is_empty()).then(|| printable(text))
}

/// The time since `at`; `None` for 0, which means that the event never happened.
fn age_ms(at: MonotonicNs, now: MonotonicNs) -> Option<f64> {
    (at.0 != 0).then(|| now.since(at) as f64 / 1e6)
}

/// The rate of a count; `None` without an earlier reading, and when the bridge was restarted.
fn per_s(now: u64, before: Option<u64>, window_ms: f64) -> Option<f64> {
    let grown = now.checked_sub(before?)?;
    (window_ms > 0.0).then(|| grown as f64 * 1e3 / window_ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_the_growth_of_a_count_within_the_window() {
        assert_eq!(per_s(150, Some(100), 500.0), Some(100.0));
        assert_eq!(per_s(100, Some(100), 500.0), Some(0.0));
    }

    #[test]
    fn without_an_earlier_reading_of_the_same_bridge_there_is_no_rate() {
        assert_eq!(per_s(150, None, 500.0), None);
        assert_eq!(per_s(99, Some(100), 500.0), None);
        assert_eq!(per_s(150, Some(100), 0.0), None);
    }

    /// tests/dds/cli.rs compares the other keys with the output of a running bridge.
    #[test]
    fn every_key_of_a_subscriber_an_intruder_and_a_publisher_is_documented() {
        let report = serde_json::to_value(crate::telemetry::test_report::wide_report()).unwrap();
        let page = include_str!("../../../docs/status-json.md");
        let publisher = &report["routes"][0]["publishers"][0];
        let lanes = report["routes"][0]["lanes"].as_array().unwrap();
        let unmatched = lanes.iter().find_map(|lane| lane["unmatched_readers"].get(0)).unwrap();
        for (list, item) in [
            ("subscribers", &report["subscribers"][0]),
            ("intruders", &report["intruders"][0]),
            ("absences", &report["absences"][0]),
            ("routes[].publishers", publisher),
            ("routes[].lanes[].unmatched_readers", unmatched),
        ] {
            let item = item.as_object().unwrap();
            let documented = page.matches(&format!("\n| `{list}[].")).count();
            assert_eq!(documented, item.len(), "{list}");
            for (key, value) in item {
                let list_mark = if value.is_array() { "[]" } else { "" };
                let row = format!("\n| `{list}[].{key}{list_mark}` |");
                assert!(page.contains(&row), "{row}");
            }
        }
    }
}
