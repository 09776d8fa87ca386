//! The report made from two snapshots: counts, and the rates and latencies of the time between them.
//!
//! The types here are the JSON of `status --json`; `docs/status-json.md` documents every key.

mod control;
mod latency;

pub use control::{AbsenceReport, IntruderReport, ProbesReport, SafetyReport, SubscriberReport};
pub use latency::{Latency, LatencyTotal};

use super::liveness::ProcessState;
use super::problem::Problem;
use super::snapshot::{LaneReading, OutputReading, ProcessReading, RouteReading, Snapshot};
use super::text::printable;
use crate::model::{
    DropCounts, FixedText, Guid, LaneMode, MonotonicNs, NetworkRefusals, PublisherAccount, ReaderRecord,
};

/// The state of a bridge. Keys that end in a unit are in that unit; an unknown value is null.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    /// The name of the bridge's instance.
    pub instance: String,
    /// The time of the later snapshot, in milliseconds since the Unix epoch.
    pub time_unix_ms: u64,
    /// The time between the two snapshots, to which rates, latencies and `drops_in_window` refer.
    pub window_ms: f64,
    /// The problems, the most severe first.
    pub problems: Vec<Problem>,
    /// The safety supervisor.
    pub safety: SafetyReport,
    /// The processes.
    pub processes: Vec<ProcessReport>,
    /// The lanes.
    pub lanes: Vec<LaneReport>,
    /// The routes.
    pub routes: Vec<RouteReport>,
    /// The probes.
    pub probes: ProbesReport,
    /// The subscribers that control tracks.
    pub subscribers: Vec<SubscriberReport>,
    /// The remote subscribers that bypass the bridge.
    pub intruders: Vec<IntruderReport>,
    /// Intruders seen since control started, including those not listed.
    pub intruders_seen: u64,
    /// The network interfaces and peers that are away, or came back within the last 15 minutes.
    pub absences: Vec<AbsenceReport>,
}

/// The state of one process.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProcessReport {
    /// Its name: `ingress`, `control`, `egress-critical`, …
    pub name: String,
    /// Its process id; 0 when it never ran.
    pub pid: u64,
    /// Its state.
    pub state: ProcessState,
    /// The time since it started.
    pub uptime_s: Option<f64>,
    /// Starts of the process in this bridge, including the first one.
    pub starts: u64,
    /// Turns of its data path.
    pub turns: u64,
    /// The time since its last turn.
    pub last_turn_age_ms: Option<f64>,
    /// Errors of the process, except dropped samples.
    pub errors: u64,
    /// Reloads that it refused because of errors in the configuration file.
    pub refused_reloads: u64,
    /// What its participants refused of the network, by reason.
    pub network_refusals: NetworkRefusals,
    /// A hash of the settings that it applies, in hexadecimal, to compare processes; null until it is known.
    pub settings_fingerprint: Option<String>,
}

/// The mode of one lane.
#[derive(Clone, Debug, serde::Serialize)]
pub struct LaneReport {
    /// Its name.
    pub name: String,
    /// Its class: `critical` or `noncritical`.
    pub class: &'static str,
    /// The mode that results from the policy board.
    pub mode: &'static str,
    /// The reason of the mode: `default`, `by_hand`, `control`, `safety`, `held` or `expired`.
    pub mode_reason: &'static str,
    /// The reason as text for users, with its cause. The wording may change.
    pub mode_detail: String,
    /// The time until the policy ends unless it is confirmed or set again.
    pub mode_ends_in_s: Option<f64>,
    /// The epoch of the policy on the board; 0 when no policy was ever set.
    pub policy_epoch: u64,
    /// The mode that the lane's process applies.
    pub applied_mode: Option<&'static str>,
    /// The epoch of the policy that the lane's process applies.
    pub applied_policy_epoch: u64,
}

/// The counts, rates and latencies of one route.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RouteReport {
    /// Its id.
    pub id: String,
    /// The topic that ingress subscribes to.
    pub input_topic: String,
    /// The message type; null until it is known.
    pub message_type: Option<String>,
    /// Matched publishers.
    pub writers: u64,
    /// Samples that ingress received.
    pub received: u64,
    /// Payload bytes of the received samples.
    pub received_bytes: u64,
    /// Samples published to the lanes.
    pub published: u64,
    /// Published samples that the DDS library assembled in shared memory, so that they were not copied there.
    pub in_place: u64,
    /// Samples lost before ingress, by gaps in the publishers' sequence numbers.
    pub lost_upstream: u64,
    /// Discarded samples that arrived again or after newer ones of their publisher; not included in
    /// `received`.
    pub repeated: u64,
    /// Received samples of publishers without an account, because there are more publishers than accounts.
    pub unmarked: u64,
    /// The publishers that have sent samples.
    pub publishers: Vec<PublisherReport>,
    /// Samples received but not published, by reason.
    pub drops: DropCounts,
    /// Drops within the window, by reason.
    pub drops_in_window: DropCounts,
    /// Whether `received = published + drops`.
    pub whole: bool,
    /// Samples received per second.
    pub rate_hz: Option<f64>,
    /// Payload bytes received per second.
    pub bytes_per_s: Option<f64>,
    /// The time since the last received sample.
    pub last_received_age_ms: Option<f64>,
    /// The offset of a publisher's clock to this computer's, positive when it is ahead; `null` while all
    /// agree.
    pub clock_offset_s: Option<f64>,
    /// The GUID of the DDS writer with that clock offset.
    pub clock_offset_writer: Option<String>,
    /// Latency from the publisher's source timestamp to ingress.
    pub dds_in: Latency,
    /// The outputs of the route, one for each lane that serves it.
    pub lanes: Vec<OutputReport>,
}

/// The account of one publisher of a route, from the sequence numbers of its DDS writer.
#[derive(Clone, Debug, serde::Serialize)]
pub struct PublisherReport {
    /// The GUID of its DDS writer.
    pub writer: String,
    /// Its ROS 2 node; null while it is unknown.
    pub node: Option<String>,
    /// The address of its host; null while it is unknown.
    pub host: Option<String>,
    /// `RELIABLE` or `BEST_EFFORT`; null when the publisher has left.
    pub reliability: Option<&'static str>,
    /// The sequence number of its first received sample.
    pub first_sequence: i64,
    /// The highest sequence number received.
    pub last_sequence: i64,
    /// Samples received.
    pub received: u64,
    /// Sequence numbers between the first and the last that did not reach the bridge.
    pub lost_upstream: u64,
    /// Discarded samples that arrived again or after newer ones.
    pub repeated: u64,
    /// The time since the last received sample.
    pub last_received_age_ms: Option<f64>,
}

/// The counts, rates and latencies of one output.
#[derive(Clone, Debug, serde::Serialize)]
pub struct OutputReport {
    /// The lane.
    pub lane: String,
    /// The topic that the lane publishes to.
    pub topic: String,
    /// Matched readers.
    pub readers: u64,
    /// The matched readers, 32 at most.
    pub matched_readers: Vec<ReaderReport>,
    /// Samples that left the history before single readers acknowledged them; the other readers have them.
    pub reader_overrun: u64,
    /// Samples offered to the lane since it first started.
    pub received: u64,
    /// Samples that the lane gave to its DDS writer.
    pub forwarded: u64,
    /// Payload bytes of the forwarded samples.
    pub forwarded_bytes: u64,
    /// Forwarded samples that were handed over by reference, not copied.
    pub by_reference: u64,
    /// Forwarded samples that were published while the lane was down.
    pub caught_up: u64,
    /// Samples waiting in the lane.
    pub waiting: u64,
    /// Samples not forwarded, by reason.
    pub drops: DropCounts,
    /// Drops within the window, by reason.
    pub drops_in_window: DropCounts,
    /// Whether `received = forwarded + waiting + drops`.
    pub whole: bool,
    /// Samples offered per second.
    pub received_hz: Option<f64>,
    /// Samples forwarded per second.
    pub rate_hz: Option<f64>,
    /// Payload bytes forwarded per second.
    pub bytes_per_s: Option<f64>,
    /// The time since the last forwarded sample.
    pub last_forwarded_age_ms: Option<f64>,
    /// Latency from ingress to the lane.
    pub shm: Latency,
    /// Latency within the lane, up to its DDS writer.
    pub dds_out: Latency,
    /// Age of the samples when the DDS writer gets them, by their source timestamp.
    pub age: Latency,
}

/// One reader of an output.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ReaderReport {
    /// Its GUID, in hexadecimal.
    pub guid: String,
    /// Its ROS 2 node; null while it is unknown.
    pub node: Option<String>,
    /// The address of its host; null while it is unknown.
    pub host: Option<String>,
    /// `RELIABLE` or `BEST_EFFORT`.
    pub reliability: &'static str,
    /// Samples offered to it: the history when it was matched, and all samples written since.
    pub offered: u64,
    /// Offered samples that it has not acknowledged; 0 for a BEST_EFFORT reader.
    pub unacknowledged: u64,
    /// Offered samples that left the lane's history before the reader acknowledged them.
    pub overrun: u64,
}

impl Snapshot {
    /// As [`Snapshot::report_since`], with these problems.
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
            routes: self
                .routes
                .iter()
                .map(|route| self.route_report(route, earlier.route(route), window_ms))
                .collect(),
            probes: self.probes_report(earlier),
            subscribers: self.subscribers.iter().map(|one| self.subscriber_report(one)).collect(),
            intruders: self.intruders.iter().map(|one| self.intruder_report(one)).collect(),
            intruders_seen: self.control.intruders_seen,
            absences: self.absences.iter().map(|one| self.absence_report(one)).collect(),
        }
    }

    /// The route with the same id in this snapshot.
    pub(super) fn route(&self, other: &RouteReading) -> Option<&RouteReading> {
        self.routes.iter().find(|route| route.id == other.id)
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
        RouteReport {
            id: now.id.to_string(),
            input_topic: now.input_topic.to_string(),
            message_type: now.message_type.as_deref().map(printable),
            writers: counters.writers,
            received: counters.received,
            received_bytes: counters.received_bytes,
            published: counters.published,
            in_place: counters.in_place,
            lost_upstream: counters.lost_upstream,
            repeated: counters.repeated,
            unmarked: counters.unmarked,
            publishers: now.publishers.iter().map(|account| self.publisher_report(account)).collect(),
            drops: counters.drops,
            drops_in_window: counters.drops.since_reading(former.map(|former| former.drops)),
            whole: now.is_accounted_for(),
            rate_hz: per_s(counters.received, former.map(|former| former.received), window_ms),
            bytes_per_s: per_s(
                counters.received_bytes,
                former.map(|former| former.received_bytes),
                window_ms,
            ),
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
        let (node, host) = self.node_and_host(account.writer);
        PublisherReport {
            writer: account.writer.to_string(),
            node,
            host,
            reliability: match account.offered_reliability {
                PublisherAccount::OFFERS_RELIABLE => Some("RELIABLE"),
                PublisherAccount::OFFERS_BEST_EFFORT => Some("BEST_EFFORT"),
                _ => None,
            },
            first_sequence: account.first_sequence,
            last_sequence: account.last_sequence,
            received: account.received,
            lost_upstream: account.lost_upstream,
            repeated: account.repeated,
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
        OutputReport {
            lane: self.lanes[now.lane].name.to_string(),
            topic: now.topic.to_string(),
            readers: counters.readers,
            matched_readers: now.readers.iter().map(|record| self.reader_report(record)).collect(),
            reader_overrun: counters.reader_overrun,
            received: counters.received(),
            forwarded: counters.forwarded,
            forwarded_bytes: counters.forwarded_bytes,
            by_reference: counters.by_reference,
            caught_up: counters.caught_up,
            waiting: counters.waiting,
            drops: counters.drops,
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
}

impl Snapshot {
    fn reader_report(&self, record: &ReaderRecord) -> ReaderReport {
        let (node, host) = self.node_and_host(record.reader);
        ReaderReport {
            guid: record.reader.to_string(),
            node,
            host,
            reliability: if record.reliable == 1 { "RELIABLE" } else { "BEST_EFFORT" },
            offered: record.offered,
            unacknowledged: record.unacknowledged,
            overrun: record.overrun,
        }
    }

    /// The ROS 2 node of an endpoint and the address of its host, if they are known.
    fn node_and_host(&self, endpoint: Guid) -> (Option<String>, Option<String>) {
        let Some(named) = self.named_endpoints.iter().find(|named| named.endpoint == endpoint) else {
            return (None, None);
        };
        let text = |text: &FixedText| Some(printable(text.as_str())).filter(|text| !text.is_empty());
        (text(&named.node), text(&named.host))
    }

    /// A name for a publisher: its node, or its GUID if the node is unknown, and its host if it is known.
    pub(super) fn publisher_name(&self, writer: Guid) -> String {
        let (node, host) = self.node_and_host(writer);
        let node = node.unwrap_or_else(|| format!("writer {writer}"));
        host.map_or_else(|| node.clone(), |host| format!("{node} on {host}"))
    }

    /// A name for a reader: its node, or its GUID if the node is unknown, and its host if it is known.
    pub(super) fn reader_name(&self, record: &ReaderRecord) -> String {
        let report = self.reader_report(record);
        let node = report.node.unwrap_or_else(|| format!("reader {}", report.guid));
        match report.host {
            Some(host) => format!("{node} on {host}"),
            None => node,
        }
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
        name: process.name.clone(),
        pid: health.pid,
        state: process.state,
        uptime_s: age_ms(health.started_at, now).filter(|_| process.state.exists()).map(|ms| ms / 1e3),
        starts: health.starts,
        turns: health.turns,
        last_turn_age_ms: age_ms(health.alive_at, now),
        errors: health.errors,
        refused_reloads: health.refused_reloads,
        network_refusals: health.network_refusals,
        settings_fingerprint: (health.settings_fingerprint != 0)
            .then(|| format!("{:016x}", health.settings_fingerprint)),
    }
}

/// The time since `at`; `None` for 0, which means that the event never happened.
fn age_ms(at: MonotonicNs, now: MonotonicNs) -> Option<f64> {
    (at.0 != 0).then(|| now.since(at) as f64 / 1e6)
}

/// The rate of a count; `None` without an earlier reading, and when the count decreased because the bridge
/// was restarted.
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
        for (list, item) in [
            ("subscribers", &report["subscribers"][0]),
            ("intruders", &report["intruders"][0]),
            ("absences", &report["absences"][0]),
            ("routes[].publishers", publisher),
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
