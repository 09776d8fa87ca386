//! A report for the tests of its output formats.

use super::liveness::ProcessState;
use super::problem::{Level, Problem};
use super::report::{
    AbsenceReport, EndpointOrigin, IntruderReport, LaneReport, Latency, LatencyTotal, OutputReport,
    ParametersReport, PatternReport, ProbesReport, ProcessReport, PublisherReport, ReaderReport, Report,
    RouteReport, SafetyReport, SharedMemoryReport, SubscriberReport, UnmatchedReport,
};
use super::snapshot::ProcessReading;
use crate::model::{
    Counts, Guid, IngressCounters, LaneCounters, ProcessHealth, PublisherAccount, ReaderRecord, Reason,
    StandbyRecord,
};
use crate::shm::ProcessRole;

fn counts<R: Reason, const N: usize>(each: u64) -> Counts<R, N> {
    let mut counts = Counts::default();
    R::ALL.iter().for_each(|&reason| counts.add(reason, each));
    counts
}

/// A report in which every list has an item, and numbers and texts have their maximum length.
pub(super) fn wide_report() -> Report {
    let latency = Latency {
        count: 1,
        p50_us: Some(99_940.0),
        p99_us: Some(137_000_000.0),
        max_us: Some(1e9),
        total: LatencyTotal::default(),
    };
    let topic = format!("/{}", "long_name/".repeat(20));
    let output = OutputReport {
        lane: "a_lane_of_24_characters_".into(),
        topic: topic.clone(),
        matched_readers: vec![ReaderReport {
            record: ReaderRecord {
                reader: Guid::default(),
                offered: u64::MAX,
                unacknowledged: u64::MAX,
                overrun: u64::MAX,
                reliable: 0,
            },
            origin: EndpointOrigin { node: Some("/a_node".into()), host: None },
            reliability: "BEST_EFFORT",
        }],
        unmatched_readers: vec![UnmatchedReport {
            guid: "0".repeat(33),
            origin: EndpointOrigin { node: Some("/a_node".into()), host: None },
            policy: "DATA_REPRESENTATION",
        }],
        received: u64::MAX,
        counters: LaneCounters {
            readers: 99_999,
            reader_overrun: u64::MAX,
            unconfirmed: u64::MAX,
            late_joiners_unserved: u64::MAX,
            forwarded: u64::MAX,
            forwarded_bytes: u64::MAX,
            drops: counts(u64::MAX / 100),
            ..LaneCounters::default()
        },
        drops_in_window: counts(u64::MAX / 100),
        whole: true,
        received_hz: Some(99_999.9),
        rate_hz: Some(99_999.9),
        bytes_per_s: Some(1e10),
        last_forwarded_age_ms: None,
        shm: latency,
        dds_out: latency,
        age: latency,
    };
    Report {
        instance: "an_instance_of_24_chars_".into(),
        time_unix_ms: 0,
        window_ms: 1_000.0,
        problems: vec![Problem {
            about: "lane a_lane_of_24_characters_".into(),
            level: Level::Error,
            text: "many words ".repeat(30),
        }],
        processes: vec![process("control"), process("egress-a_lane_of_24_characters_")],
        safety: SafetyReport {
            mode: "emergency",
            reason: Some("the lag of lane noncritical is 1200.0 ms ".repeat(3)),
            since_s: Some(86_399.0),
            transitions: u64::MAX,
        },
        lanes: vec![LaneReport {
            name: output.lane.clone(),
            class: "noncritical",
            mode: "suspended",
            mode_reason: "control",
            mode_detail: "a subscriber of many words ".repeat(9),
            mode_ends_in_s: Some(3_600.0),
            policy_epoch: 1,
            applied_mode: Some("degraded"),
            applied_policy_epoch: 1,
        }],
        patterns: vec![PatternReport {
            id: "any".into(),
            input_topic: "/**".into(),
            max_routes: 64,
            routes: 64,
            waiting: 256,
            first_waiting: Some(format!("/{}", "t".repeat(126))),
            released: u64::MAX,
            refused: u64::MAX,
            forgotten: u64::MAX,
        }],
        shared_memory: SharedMemoryReport { budget_bytes: 1 << 40, used_bytes: 1 << 40, peak_bytes: 1 << 40 },
        routes: vec![RouteReport {
            id: "scan".into(),
            input_topic: topic,
            pattern: None,
            message_type: None,
            type_hash: None,
            has_keys: false,
            counters: IngressCounters {
                writers: 99_999,
                lost_upstream: 9_999_999_999_999,
                drops: counts(u64::MAX / 100),
                ..IngressCounters::default()
            },
            publishers: vec![PublisherReport {
                account: PublisherAccount {
                    writer: Guid([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 0, 0, 1, 3]),
                    first_sequence: 1,
                    last_sequence: i64::MAX,
                    received: u64::MAX,
                    lost_upstream: u64::MAX,
                    repeated: u64::MAX,
                    ..PublisherAccount::default()
                },
                origin: EndpointOrigin { node: Some("/laser".into()), host: Some("10.0.0.7".into()) },
                reliability: Some("RELIABLE"),
                last_received_age_ms: Some(1.0),
            }],
            drops_in_window: counts(0),
            whole: true,
            rate_hz: Some(99_999.9),
            bytes_per_s: Some(1e11),
            last_received_age_ms: None,
            clock_offset_s: Some(-5.0),
            clock_offset_writer: Some("0".repeat(33)),
            dds_in: latency,
            lanes: vec![output],
        }],
        parameters: ParametersReport {
            set: vec!["safety.allow_noncritical_degrade: false".into(); 9],
            ..ParametersReport::default()
        },
        probes: ProbesReport {
            sent: u64::MAX,
            accepted: u64::MAX,
            refused: counts(3),
            refused_in_window: counts(1),
        },
        subscribers: vec![SubscriberReport {
            id: "x".repeat(127),
            lane: Some("a_lane_of_24_characters_".into()),
            listed: false,
            state: "NONCRITICAL",
            forced: false,
            reason: "RTT 1234.5 ms above 50 ms three times in a row ".repeat(3),
            state_since_s: Some(86_399.0),
            transitions: u64::MAX,
            settled: 50,
            lost: 10,
            loss: Some(0.2),
            rtt_mean_ms: Some(99_940.0),
            rtt_p95_ms: Some(137_000_000.0),
            jitter_ms: Some(99_940.0),
            last_response_age_ms: Some(137_000_000.0),
            warnings: vec!["rtt", "loss", "jitter"],
        }],
        intruders: vec![IntruderReport {
            topic: "/scan".into(),
            node: None,
            host: "192.168.100.100, 10.100.100.100, 172.16.100.100".into(),
            remedy: "subscribe to /adaptive_bridge/noncritical/scan instead".into(),
            since_s: Some(3.0),
        }],
        intruders_seen: u64::MAX,
        absences: vec![AbsenceReport {
            kind: "interface",
            name: Some("wlan0".into()),
            host: Some("192.168.100.100".into()),
            detail: "has no link".into(),
            away_s: 15.0,
            back_s: None,
        }],
    }
}

fn process(name: &str) -> ProcessReport {
    ProcessReport {
        reading: ProcessReading {
            name: name.into(),
            role: ProcessRole::Control,
            health: ProcessHealth {
                pid: 4_194_304,
                starts: 100_001,
                errors: 99_999,
                refused_reloads: 99_999,
                network_refusals: counts(99_999),
                ..ProcessHealth::default()
            },
            standby: StandbyRecord {
                pid: 4_194_304,
                take_overs: 99_999,
                took_ns: 99_999_000,
                ..Default::default()
            },
            state: ProcessState::Running,
        },
        uptime_s: Some(86_399.0),
        last_turn_age_ms: Some(99_999.0),
        settings_fingerprint: None,
    }
}
