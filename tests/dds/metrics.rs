//! The metrics page as a scraper sees it: over HTTP, through the parser of Prometheus' own Python client.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::time::Duration;

use adaptive_bridge::config::{MetricsListener, RoutePattern, SetParameters};
use adaptive_bridge::model::{
    ControlRecord, DropReason, FixedText, IngressCounters, InstanceName, LaneCounters, LaneMode, LaneName,
    LanePolicy, LatencyHistogram, ModeReason, MonotonicNs, PatternRecord, ProbeRefusal, ProcessHealth,
    RouteId, RouteInfo, StandbyRecord, SubscriberRecord, SubscriberState, TopicName, TopicPattern,
    TrafficClass, WallNs,
};
use adaptive_bridge::shm::ProcessRole;
use adaptive_bridge::telemetry::{
    LaneReading, MetricsServer, OutputReading, PatternReading, ProcessReading, ProcessState, Report,
    RouteReading, Snapshot, SubscriberReading,
};
use serde_json::Value;
use support::prometheus::{parse, python};

/// Would end its label, its line and its name, if it were not escaped.
const HOSTILE: &str = "x\"} 1\nadaptive_bridge_info{a=\"\\";

/// A bridge of one route, its critical lane and one subscriber.
fn report() -> Report {
    let at = MonotonicNs(100_000_000_000);
    // Each figure has a value of its own, so that no other one can stand for it.
    let health = ProcessHealth {
        pid: 7,
        alive_at: at,
        starts: 3,
        turns: 4_000,
        errors: 5,
        refused_reloads: 6,
        ..ProcessHealth::default()
    };
    let mut ingress = IngressCounters {
        received: 103,
        received_bytes: 10_300,
        published: 100,
        in_place: 41,
        lost_upstream: 42,
        repeated: 43,
        unmarked: 44,
        writers: 1,
        pool_bytes: 45,
        pool_peak_bytes: 46,
        budget_bytes: 100,
        budget_used_bytes: 47,
        budget_peak_bytes: 48,
        ..Default::default()
    };
    ingress.drops.add(DropReason::TooLarge, 3);
    let mut lane = LaneCounters {
        first_sequence: 1,
        last_sequence: 100,
        forwarded: 90,
        forwarded_bytes: 9_000,
        by_reference: 21,
        caught_up: 22,
        waiting: 4,
        readers: 2,
        reader_overrun: 23,
        unconfirmed: 24,
        late_joiners_unserved: 25,
        ..LaneCounters::default()
    };
    lane.drops.add(DropReason::LaneDown, 5);
    let mut latency = LatencyHistogram::default();
    for latency_us in 1..=100 {
        latency.record(latency_us * 10_000);
    }
    let mut control = ControlRecord {
        probes_sent: 50,
        responses_accepted: 49,
        safety_transitions: 8,
        intruders_seen: 9,
        subscribers: 1,
        ..ControlRecord::default()
    };
    control.refused.add(ProbeRefusal::Replayed, 1);
    let subscriber = SubscriberRecord {
        id: FixedText::new("laptop"),
        settled: 50,
        lost: 1,
        rtt_mean_us: 81_250,
        state: SubscriberState::Noncritical as u8,
        ..SubscriberRecord::default()
    };
    let snapshot = Snapshot {
        instance: InstanceName::try_from("default").unwrap(),
        at,
        at_wall: WallNs(1_763_000_000_123_000_000),
        processes: vec![ProcessReading {
            name: "ingress".into(),
            role: ProcessRole::Ingress,
            health,
            standby: StandbyRecord { pid: 9, take_overs: 2, ..StandbyRecord::default() },
            state: ProcessState::Running,
        }],
        lanes: vec![LaneReading {
            name: LaneName::critical(),
            class: TrafficClass::Critical,
            policy: LanePolicy::default(),
            mode: LaneMode::Degraded,
            reason: ModeReason::Default,
            ends_at: None,
            is_used: true,
            health,
        }],
        patterns: vec![PatternReading {
            settings: RoutePattern {
                entry: RouteId::try_from("camera").unwrap(),
                input_topic: TopicPattern::try_from("/camera/**").unwrap(),
                exclude: Vec::new(),
                first_route: 1,
                max_routes: 2,
            },
            record: PatternRecord { waiting: 45, ..PatternRecord::default() },
        }],
        routes: vec![RouteReading {
            id: RouteId::try_from("scan").unwrap(),
            input_topic: TopicName::try_from("/scan").unwrap(),
            pattern: None,
            message_type: None,
            info: RouteInfo::default(),
            counters: ingress,
            publishers: Vec::new(),
            dds_in: latency,
            outputs: vec![OutputReading {
                lane: 0,
                topic: TopicName::try_from("/critical/scan").unwrap(),
                readers: Default::default(),
                counters: lane,
                shm: latency,
                dds_out: LatencyHistogram::default(),
                age: latency,
            }],
        }],
        needs_control: true,
        set_parameters: SetParameters::new(),
        control,
        subscribers: vec![SubscriberReading { lane: Some(0), record: subscriber }],
        named_endpoints: Vec::new(),
        absences: Vec::new(),
        intruders: Vec::new(),
    };
    let mut report = snapshot.report_since(&snapshot);
    report.subscribers[0].id = HOSTILE.to_owned();
    report
}

/// The page that a server hands out.
fn scrape(report: Report) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.sock");
    let server = MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap();
    server.set_report(Arc::new(report));
    let mut client = UnixStream::connect(&path).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
    client.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    answer.split_once("\r\n\r\n").expect(&answer).1.to_owned()
}

#[test]
fn the_parser_of_prometheus_reads_the_page() {
    let Some(python) = python() else {
        support::skip("the_parser_of_prometheus_reads_the_page", "no python3-prometheus-client");
        return;
    };
    let families = parse(python, &scrape(report()));
    let mut names: Vec<&str> = families.iter().map(|(name, _, _)| name.as_str()).collect();
    assert!(names.len() > 40, "{names:?}");
    assert!(names.iter().all(|name| name.starts_with("adaptive_bridge_")), "{names:?}");
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), families.len(), "a family twice");
    for (name, kind, samples) in &families {
        assert!(["counter", "gauge", "histogram"].contains(&kind.as_str()), "{name} is {kind}");
        let mut series: Vec<String> = samples.iter().map(|one| format!("{}{}", one[0], one[1])).collect();
        series.sort_unstable();
        series.dedup();
        assert!(!series.is_empty() && series.len() == samples.len(), "{name}: a series twice");
        let is_total = |one: &Value| one[0].as_str().is_some_and(|name| name.ends_with("_total"));
        assert_eq!(samples.iter().all(is_total), kind == "counter", "{name}");
    }

    let value = |name: &str, labels: &[(&str, &str)]| -> f64 {
        let has = |one: &Value| labels.iter().all(|(label, value)| one[1][label] == *value);
        let mut all = families.iter().flat_map(|(_, _, samples)| samples);
        let sample = all.find(|one| one[0] == name && has(one));
        sample.unwrap_or_else(|| panic!("{name} {labels:?}"))[2].as_str().unwrap().parse().unwrap()
    };
    for (name, expected) in [
        ("process_starts_total", 3.0),
        ("process_turns_total", 4_000.0),
        ("process_errors_total", 5.0),
        ("process_refused_reloads_total", 6.0),
        ("route_publishers", 1.0),
        ("route_received_samples_total", 103.0),
        ("route_received_bytes_total", 10_300.0),
        ("route_published_samples_total", 100.0),
        ("route_in_place_samples_total", 41.0),
        ("route_pool_bytes", 45.0),
        ("route_pool_peak_bytes", 46.0),
        ("shared_memory_budget_bytes", 100.0),
        ("shared_memory_used_bytes", 47.0),
        ("shared_memory_peak_bytes", 48.0),
        ("route_lost_upstream_samples_total", 42.0),
        ("route_repeated_samples_total", 43.0),
        ("route_unmarked_samples_total", 44.0),
        ("pattern_waiting_topics", 45.0),
        ("lane_subscribers", 2.0),
        ("lane_reader_overrun_samples_total", 23.0),
        ("lane_unconfirmed_samples_total", 24.0),
        ("lane_late_joiners_unserved_total", 25.0),
        ("lane_offered_samples_total", 99.0),
        ("lane_forwarded_samples_total", 90.0),
        ("lane_forwarded_bytes_total", 9_000.0),
        ("lane_by_reference_samples_total", 21.0),
        ("lane_caught_up_samples_total", 22.0),
        ("lane_waiting_samples", 4.0),
        ("probes_sent_total", 50.0),
        ("probe_responses_total", 49.0),
        ("safety_changes_total", 8.0),
        ("intruders_seen_total", 9.0),
    ] {
        assert_eq!(value(&format!("adaptive_bridge_{name}"), &[]), expected, "{name}");
    }
    let lane_down = [("lane", "critical"), ("route", "scan"), ("reason", "lane_down")];
    assert_eq!(value("adaptive_bridge_lane_dropped_samples_total", &lane_down), 5.0);
    let too_large = [("route", "scan"), ("reason", "too_large")];
    assert_eq!(value("adaptive_bridge_route_dropped_samples_total", &too_large), 3.0);
    assert_eq!(value("adaptive_bridge_lane_mode", &[("lane", "critical"), ("mode", "degraded")]), 1.0);
    assert_eq!(value("adaptive_bridge_probe_refusals_total", &[("reason", "replayed")]), 1.0);
    assert_eq!(value("adaptive_bridge_process_up", &[("process", "ingress")]), 1.0);
    assert_eq!(value("adaptive_bridge_report_timestamp_seconds", &[]), 1_763_000_000.123);
    let hostile = [("subscriber", HOSTILE), ("lane", "critical")];
    assert_eq!(value("adaptive_bridge_subscriber_rtt_mean_seconds", &hostile), 0.08125);
    assert_eq!(value("adaptive_bridge_subscriber_loss_ratio", &hostile), 0.02);

    let stage = "adaptive_bridge_lane_shm_latency_seconds";
    let bucket = |edge: &str| value(&format!("{stage}_bucket"), &[("route", "scan"), ("le", edge)]);
    // 10 µs to 1 ms in steps of 10 µs.
    assert_eq!(["0.000016384", "0.000131072", "0.001048576", "+Inf"].map(bucket), [1.0, 13.0, 100.0, 100.0]);
    assert_eq!(value(&format!("{stage}_count"), &[("lane", "critical")]), 100.0);
    let sum_s = value(&format!("{stage}_sum"), &[("lane", "critical")]);
    assert!((sum_s / 0.0505 - 1.0).abs() < 0.032, "{sum_s}");
}
