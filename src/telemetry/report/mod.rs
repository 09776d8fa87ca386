//! What two readings of the boards say together: counts, and rates and latencies of the time between.
//!
//! The types here are the JSON of `status --json`; `docs/status-json.md` documents every key.

mod control;
mod latency;

use serde::ser::{Serialize, SerializeMap, Serializer};

pub use control::{AbsenceReport, IntruderReport, ProbesReport, Refusals, SafetyReport, SubscriberReport};
pub use latency::{Latency, LatencyTotal};

use super::liveness::ProcessState;
use super::problems::{self, Problem};
use super::snapshot::{LaneReading, OutputReading, ProcessReading, RouteReading, Snapshot};
use super::text::printable;
use crate::model::{
    DropCounts, DropReason, FixedText, Guid, IngressCounters, LaneMode, MonotonicNs, PublisherAccount,
    ReaderRecord,
};

/// The state of a bridge. Keys that end in a unit are in that unit; what cannot be told is null.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    /// The bridge.
    pub instance: String,
    /// When the boards were read, in milliseconds since the Unix epoch.
    pub time_unix_ms: u64,
    /// The time between the two readings: rates, latencies and `drops_in_window` are of it.
    pub window_ms: f64,
    /// What is wrong, a sentence each, the gravest first.
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
    /// The subscribers that control follows.
    pub subscribers: Vec<SubscriberReport>,
    /// The remote readers that reach past the bridge.
    pub intruders: Vec<IntruderReport>,
    /// Such readers ever seen since control came up, those not shown included.
    pub intruders_seen: u64,
    /// The network interfaces and peers that are away, and those that came back lately.
    pub absences: Vec<AbsenceReport>,
}

/// One process.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProcessReport {
    /// `ingress`, `control`, `egress-critical`, …
    pub name: String,
    /// Its process id; 0 when it never ran.
    pub pid: u64,
    /// Whether it is there and turns.
    pub state: ProcessState,
    /// How long ago it came up.
    pub uptime_s: Option<f64>,
    /// How often it was started in this bridge, the first time included.
    pub starts: u64,
    /// Turns of its data path.
    pub turns: u64,
    /// How long ago it turned last.
    pub last_turn_age_ms: Option<f64>,
    /// What failed in it, samples apart.
    pub errors: u64,
    /// Reloads that it refused because the file was bad.
    pub refused_reloads: u64,
    /// Tells the settings that it applies from others, in hexadecimal; null when it has not said.
    pub settings_fingerprint: Option<String>,
}

/// One lane.
#[derive(Clone, Debug, serde::Serialize)]
pub struct LaneReport {
    /// Its name.
    pub name: String,
    /// `critical` or `noncritical`.
    pub class: &'static str,
    /// The mode that the policy board gives it.
    pub mode: &'static str,
    /// Why: `default`, `by_hand`, `control`, `safety`, `held` or `expired`.
    pub mode_reason: &'static str,
    /// The same in a sentence with what lies behind it. For people: wording may change.
    pub mode_detail: String,
    /// When the policy ends, unless it is confirmed or set anew.
    pub mode_ends_in_s: Option<f64>,
    /// The epoch of the policy on the board; 0 when nobody has set one.
    pub policy_epoch: u64,
    /// The mode that the lane's process applies.
    pub applied_mode: Option<&'static str>,
    /// The epoch of the policy that the lane's process applies.
    pub applied_policy_epoch: u64,
}

/// One route.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RouteReport {
    /// Its id.
    pub id: String,
    /// What ingress subscribes to.
    pub input_topic: String,
    /// The message type; null until it is known.
    pub message_type: Option<String>,
    /// Publishers matched.
    pub writers: u64,
    /// Samples taken in.
    pub received: u64,
    /// Payload bytes of those.
    pub received_bytes: u64,
    /// Samples published to the lanes.
    pub published: u64,
    /// Of those, the ones that were put together in shared memory, and not copied there.
    pub in_place: u64,
    /// Samples that the publisher numbered and that never reached the bridge.
    pub lost_upstream: u64,
    /// Samples that arrived after they or younger ones of their publisher had been taken, and were discarded;
    /// not among the received.
    pub repeated: u64,
    /// Of the received, those of publishers that have no account because there are too many.
    pub unmarked: u64,
    /// The publishers whose samples came.
    pub publishers: Vec<PublisherReport>,
    /// Samples received and not published, by reason.
    pub drops: Drops,
    /// Of those, the ones within the window.
    pub drops_in_window: Drops,
    /// Whether `received = published + drops`.
    pub whole: bool,
    /// Samples received per second.
    pub rate_hz: Option<f64>,
    /// Payload bytes received per second.
    pub bytes_per_s: Option<f64>,
    /// How long ago the last sample was received.
    pub last_received_age_ms: Option<f64>,
    /// How far the clock of a publisher is ahead of this computer's; `null` while the clocks of all agree.
    pub clock_offset_s: Option<f64>,
    /// The GUID of that publisher's DDS writer.
    pub clock_offset_writer: Option<String>,
    /// From the publisher's source timestamp to ingress.
    pub dds_in: Latency,
    /// The lanes that serve the route.
    pub lanes: Vec<OutputReport>,
}

/// One publisher of a route, by the sequence numbers of its DDS writer.
#[derive(Clone, Debug, serde::Serialize)]
pub struct PublisherReport {
    /// Its DDS writer.
    pub writer: String,
    /// Its ROS 2 node; null while it is not known.
    pub node: Option<String>,
    /// The address of its host; null while it is not known.
    pub host: Option<String>,
    /// `RELIABLE` or `BEST_EFFORT`; null when the publisher is gone.
    pub reliability: Option<&'static str>,
    /// The number of the first sample taken.
    pub first_sequence: i64,
    /// The highest number taken.
    pub last_sequence: i64,
    /// Samples taken.
    pub received: u64,
    /// Numbers between the first and the last that never reached the bridge.
    pub lost_upstream: u64,
    /// Samples that arrived again, or after younger ones, and were discarded.
    pub repeated: u64,
    /// How long ago the last sample was taken.
    pub last_received_age_ms: Option<f64>,
}

/// One route on one lane.
#[derive(Clone, Debug, serde::Serialize)]
pub struct OutputReport {
    /// The lane.
    pub lane: String,
    /// What the lane publishes to.
    pub topic: String,
    /// Readers matched.
    pub readers: u64,
    /// Those readers, 32 at most.
    pub matched_readers: Vec<ReaderReport>,
    /// Samples that single readers missed because they did not keep up; the others have them.
    pub reader_overrun: u64,
    /// Samples that the lane was offered since it began to account.
    pub received: u64,
    /// Samples given to the DDS writer.
    pub forwarded: u64,
    /// Payload bytes of those.
    pub forwarded_bytes: u64,
    /// Of the forwarded, those handed over by reference.
    pub by_reference: u64,
    /// Of the forwarded, those published while the lane was down.
    pub caught_up: u64,
    /// Samples waiting in the lane.
    pub waiting: u64,
    /// Samples not forwarded, by reason.
    pub drops: Drops,
    /// Of those, the ones within the window.
    pub drops_in_window: Drops,
    /// Whether `received = forwarded + waiting + drops`.
    pub whole: bool,
    /// Samples offered per second.
    pub received_hz: Option<f64>,
    /// Samples forwarded per second.
    pub rate_hz: Option<f64>,
    /// Payload bytes forwarded per second.
    pub bytes_per_s: Option<f64>,
    /// How long ago the last sample was forwarded.
    pub last_forwarded_age_ms: Option<f64>,
    /// From ingress to the lane.
    pub shm: Latency,
    /// Within the lane, up to its DDS writer.
    pub dds_out: Latency,
    /// From the source timestamp to the lane's DDS writer.
    pub age: Latency,
}

/// One reader of an output.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ReaderReport {
    /// Its GUID, in hexadecimal.
    pub guid: String,
    /// Its ROS 2 node; null while control does not know it.
    pub node: Option<String>,
    /// The address of its host; null while control does not know it.
    pub host: Option<String>,
    /// `RELIABLE` or `BEST_EFFORT`.
    pub reliability: &'static str,
    /// Samples written since it was matched, and the history that it was offered then.
    pub offered: u64,
    /// Of those, samples that it has not acknowledged; 0 for a BEST_EFFORT reader.
    pub unacknowledged: u64,
    /// Of those, samples that left the lane's history before the reader had them.
    pub overrun: u64,
}

/// Drops, by name. In JSON every reason is there, so that a key that is missing is a mistake in its name.
#[derive(Clone, Copy, Debug, Default)]
pub struct Drops(pub DropCounts);

impl Serialize for Drops {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(DropReason::COUNT))?;
        for reason in DropReason::ALL {
            map.serialize_entry(reason.label(), &self.0.get(*reason))?;
        }
        map.end()
    }
}

impl Snapshot {
    /// What this reading says, with rates and latencies since `earlier`. A bridge that was started anew in
    /// between has no rates yet.
    pub fn since(&self, earlier: &Self) -> Report {
        let window_ms = self.at.since(earlier.at) as f64 / 1e6;
        Report {
            instance: self.instance.to_string(),
            time_unix_ms: self.at_wall.0 / 1_000_000,
            window_ms,
            problems: problems::of(self, earlier),
            processes: self.processes.iter().map(|process| process_report(process, self.at)).collect(),
            safety: self.safety_report(),
            lanes: self
                .lanes
                .iter()
                .enumerate()
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

    /// The same route in this reading.
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
            drops: Drops(counters.drops),
            drops_in_window: Drops(drops_since(&counters.drops, former.map(|former| former.drops))),
            whole: now.is_whole(),
            rate_hz: per_s(counters.received, former.map(|former| former.received), window_ms),
            bytes_per_s: per_s(
                counters.received_bytes,
                former.map(|former| former.received_bytes),
                window_ms,
            ),
            last_received_age_ms: age_ms(counters.last_received_at, self.at),
            clock_offset_s: clock_offset_s(counters),
            clock_offset_writer: clock_offset_s(counters).map(|_| counters.clock_writer.to_string()),
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
            drops: Drops(counters.drops),
            drops_in_window: Drops(drops_since(&counters.drops, former.map(|former| former.drops))),
            whole: counters.is_whole(),
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

    /// The ROS 2 node of an endpoint and the address of its host, as far as they are known.
    fn node_and_host(&self, endpoint: Guid) -> (Option<String>, Option<String>) {
        let Some(named) = self.named_endpoints.iter().find(|named| named.endpoint == endpoint) else {
            return (None, None);
        };
        let text = |text: &FixedText| Some(printable(text.as_str())).filter(|text| !text.is_empty());
        (text(&named.node), text(&named.host))
    }

    /// A publisher by its node and host, as far as they are known, for people.
    pub(super) fn publisher_name(&self, writer: Guid) -> String {
        let (node, host) = self.node_and_host(writer);
        let node = node.unwrap_or_else(|| format!("the writer {writer}"));
        host.map_or_else(|| node.clone(), |host| format!("{node} on {host}"))
    }

    /// A reader by its node and host, as far as they are known, for people.
    pub(super) fn reader_name(&self, record: &ReaderRecord) -> String {
        let report = self.reader_report(record);
        let node = report.node.unwrap_or_else(|| format!("the reader {}", report.guid));
        match report.host {
            Some(host) => format!("{node} on {host}"),
            None => node,
        }
    }
}

impl RouteReading {
    /// Whether every sample received was published or dropped for a named reason.
    pub fn is_whole(&self) -> bool {
        self.counters.received == self.counters.published + self.counters.drops.total()
    }

    /// The same lane's output in this reading.
    pub(super) fn output(&self, other: &OutputReading) -> Option<&OutputReading> {
        self.outputs.iter().find(|output| output.lane == other.lane && output.topic == other.topic)
    }
}

/// What was dropped since an earlier reading; nothing when there is none, or when it is of another bridge.
pub(super) fn drops_since(now: &DropCounts, before: Option<DropCounts>) -> DropCounts {
    let mut drops = DropCounts::default();
    if let Some(before) = before {
        for &reason in DropReason::ALL {
            drops.add(reason, now.get(reason).saturating_sub(before.get(reason)));
        }
    }
    drops
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
        settings_fingerprint: (health.settings_fingerprint != 0)
            .then(|| format!("{:016x}", health.settings_fingerprint)),
    }
}

/// `None` for an instant that never was.
/// How far the clock of a publisher is ahead of ours; `None` while all agree.
pub(super) fn clock_offset_s(counters: &IngressCounters) -> Option<f64> {
    (counters.clock_offset_ns != 0).then(|| -(counters.clock_offset_ns as f64) / 1e9)
}

fn age_ms(at: MonotonicNs, now: MonotonicNs) -> Option<f64> {
    (at.0 != 0).then(|| now.since(at) as f64 / 1e6)
}

/// `None` without an earlier reading, and when the count went back: then it is another bridge's.
fn per_s(now: u64, before: Option<u64>, window_ms: f64) -> Option<f64> {
    let grown = now.checked_sub(before?)?;
    (window_ms > 0.0).then(|| grown as f64 * 1e3 / window_ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_what_came_in_the_window() {
        assert_eq!(per_s(150, Some(100), 500.0), Some(100.0));
        assert_eq!(per_s(100, Some(100), 500.0), Some(0.0));
    }

    #[test]
    fn there_is_no_rate_without_a_reading_before_of_the_same_bridge() {
        assert_eq!(per_s(150, None, 500.0), None);
        assert_eq!(per_s(99, Some(100), 500.0), None);
        assert_eq!(per_s(150, Some(100), 0.0), None);
    }

    #[test]
    fn drops_of_another_bridge_are_not_news() {
        let mut now = DropCounts::default();
        now.add(DropReason::Stale, 3);
        assert_eq!(drops_since(&now, None).total(), 0);
        let mut before = DropCounts::default();
        before.add(DropReason::Stale, 1);
        before.add(DropReason::NoReader, 9);
        let since: Vec<_> = drops_since(&now, Some(before)).iter().collect();
        assert_eq!(since, [(DropReason::Stale, 2)]);
    }
    /// The other keys are compared with what a real bridge prints (tests/cli.rs).
    #[test]
    fn every_key_of_a_subscriber_an_intruder_and_a_publisher_is_documented() {
        let report = serde_json::to_value(crate::telemetry::samples::wide()).unwrap();
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
