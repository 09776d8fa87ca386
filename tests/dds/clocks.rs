//! A publisher whose clock disagrees with the bridge's: the shipped binary, real DDS, source timestamps as an
//! unsynchronised computer writes them. Domain 119.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos};
use adaptive_bridge::model::{Durability, Encapsulation, QosProfile, Reliability, SourceTimestamp, WallNs};
use bytes::Bytes;
use serde_json::Value;
use support::bridge::Bridge;
use support::flow::lane;
use support::wait_until;

const DOMAIN_ID: u16 = 119;
const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";

fn participant(name: &str) -> Participant {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(DOMAIN_ID),
        namespace: "/clocks".into(),
        node_name: name.into(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
    .unwrap()
}

/// A subscriber of the noncritical lane, without which the lane forwards nothing.
fn subscribe(bridge: &Bridge) -> (Participant, RawReader) {
    let mut participant = participant("subscriber");
    let qos = ReaderQos {
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 1,
        deadline_ms: None,
    };
    let reader = participant.create_reader("rt/adaptive_bridge/noncritical/scan", TYPE, &qos).unwrap();
    bridge.wait_status("the subscriber", |status| lane(status, "noncritical")["readers"] == 1);
    (participant, reader)
}

/// A publisher of 50 samples per second whose clock can be set.
struct Publisher {
    /// How far its clock is ahead of the true time.
    shift_ms: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    _participant: Participant,
}

impl Publisher {
    fn start(shift_ms: i64) -> Self {
        let mut participant = participant("publisher");
        let writer: RawWriter =
            participant.create_writer("rt/scan", TYPE, &QosProfile::CRITICAL, 1_000).unwrap();
        wait_until("ingress to match the publisher", || writer.matched_readers().next().is_some());
        let shift_ms = Arc::new(AtomicI64::new(shift_ms));
        let stop = Arc::new(AtomicBool::new(false));
        let (shift, stopped) = (Arc::clone(&shift_ms), Arc::clone(&stop));
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let shift_ns = shift.load(Ordering::Relaxed) * 1_000_000;
                let stamp = WallNs(clock::wall().0.saturating_add_signed(shift_ns));
                let stamp = SourceTimestamp::from_wall(stamp);
                // The bridge acknowledges at once; a refusal would show as a sample less.
                let _ = writer.write(Bytes::from_static(&[0; 8]), Encapsulation::CDR_LE, stamp);
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        Self { shift_ms, stop, thread: Some(thread), _participant: participant }
    }

    fn set_clock(&self, shift_ms: i64) {
        self.shift_ms.store(shift_ms, Ordering::Relaxed);
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn forwarded(status: &Value) -> u64 {
    lane(status, "noncritical")["forwarded"].as_u64().unwrap()
}

fn stale(status: &Value) -> u64 {
    lane(status, "noncritical")["drops"]["stale"].as_u64().unwrap()
}

/// Waits until the noncritical lane forwards, and nothing is stale meanwhile.
fn wait_served(bridge: &Bridge) {
    wait_until("the noncritical lane to forward without a stale sample", || {
        let before = bridge.status();
        bridge.wait_status("the noncritical lane", |status| {
            forwarded(status) >= forwarded(&before) + 10 || stale(status) > stale(&before)
        });
        stale(&bridge.status()) == stale(&before)
    });
}

/// Waits until `status` shows an offset of that many seconds, and names it among the problems; or none.
fn wait_offset(bridge: &Bridge, offset_s: Option<f64>) {
    let status = bridge.wait_status(&format!("an offset of {offset_s:?} s"), |status| {
        match (status["routes"][0]["clock_offset_s"].as_f64(), offset_s) {
            (Some(found), Some(expected)) => (found - expected).abs() < 0.5,
            (found, expected) => found == expected,
        }
    });
    let problems = status["problems"].as_array().unwrap().iter();
    let named = problems.filter_map(Value::as_str).find(|problem| problem.contains("the clock of "));
    assert_eq!(named.is_some(), offset_s.is_some(), "{status}");
    if let Some(problem) = named {
        let route = &status["routes"][0];
        let writer = route["clock_offset_writer"].as_str().unwrap();
        let account = route["publishers"].as_array().unwrap().iter().find(|one| one["writer"] == writer);
        let name = account.and_then(|one| one["node"].as_str()).unwrap_or(writer);
        assert!(problem.contains(name), "{problem} of {name}");
    }
}

#[test]
fn a_publisher_whose_clock_disagrees_is_served_and_named_and_its_late_samples_are_stale() {
    // Samples this late would suspend the noncritical lane as well, and count as suspended, not as stale.
    let bridge = Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: {DOMAIN_ID}}}\n\
         topics: [{{id: scan, input_topic: /scan, message_type: std_msgs/msg/UInt8MultiArray, \
         max_sample_bytes: 1024}}]\n\
         shared_memory: {{root_path: {{folder}}/root}}\nclassifier: {{enabled: false}}\n\
         safety: {{degraded_lag_ms: 3000000, emergency_lag_ms: 3600000}}\n"
    ));
    let _up = bridge.start("up");
    bridge.wait_status("all processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.iter().filter(|process| process["state"] == "running").count() == 4
    });
    let _subscriber = subscribe(&bridge);
    for shift_ms in [-5_000, 5_000] {
        let publisher = Publisher::start(shift_ms);
        wait_offset(&bridge, Some(shift_ms as f64 / 1e3));
        wait_served(&bridge);
        let status = bridge.status();
        let age_us = lane(&status, "noncritical")["age"]["p50_us"].as_f64();
        assert!(age_us.is_none_or(|age_us| age_us < 2e6), "the age has the offset in it: {status}");

        // The clock is set: to the other side, then right.
        publisher.set_clock(-shift_ms);
        wait_offset(&bridge, Some(-shift_ms as f64 / 1e3));
        wait_served(&bridge);
        publisher.set_clock(0);
        wait_offset(&bridge, None);
        wait_served(&bridge);

        // Source timestamps that fall behind no faster than time passes are those of a queue: the samples are
        // late, however long that lasts.
        let before = stale(&bridge.status());
        for late_ms in (0..1_500).step_by(10) {
            publisher.set_clock(-late_ms);
            std::thread::sleep(Duration::from_millis(20));
        }
        std::thread::sleep(Duration::from_secs(4));
        let sent = forwarded(&bridge.status());
        bridge.wait_status("stale samples", |status| stale(status) > before + 20);
        wait_until("samples that stay stale", || stale(&bridge.status()) > before + 100);
        assert_eq!(forwarded(&bridge.status()), sent);
        wait_offset(&bridge, None);
        publisher.set_clock(0);
        wait_served(&bridge);
    }
}
