//! A flow of 200 numbered samples per second through a bridge with one route, `/scan`, from a publisher to
//! one subscriber of each lane, all in the test's own process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::dds::{Participant, RawReader, RawWriter, ReaderQos, Take};
use adaptive_bridge::model::{Durability, Encapsulation, QosProfile, Reliability, SourceTimestamp};
use bytes::Bytes;
use serde_json::Value;

use super::bridge::Bridge;
use super::wait_until;

const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";

/// Writes numbered samples at this interval until `stop` is set and the last one is acknowledged. Returns how
/// many, and the writer, which remains in DDS until it is dropped.
pub fn write_numbers(
    writer: RawWriter,
    interval: Duration,
    stop: &Arc<AtomicBool>,
) -> JoinHandle<(u32, RawWriter)> {
    let is_stopped = Arc::clone(stop);
    std::thread::spawn(move || {
        let mut number = 0_u32;
        while !is_stopped.load(Ordering::Relaxed) {
            let payload = [number.to_le_bytes(), [0; 4]].concat();
            let stamp = SourceTimestamp::from_wall(clock::wall());
            writer.write(Bytes::from(payload), Encapsulation::CDR_LE, stamp).unwrap();
            number += 1;
            std::thread::sleep(interval);
        }
        writer.wait_acknowledged(super::patience());
        (number, writer)
    })
}

/// Takes the numbered samples that have arrived.
pub fn take_numbers(reader: &RawReader, numbers: &mut Vec<u32>) {
    let mut on_sample =
        |payload: &[u8], _| numbers.push(u32::from_le_bytes(payload[..4].try_into().unwrap()));
    while reader.take(&mut on_sample) != Take::Empty {}
}

/// A subscriber of each lane and a publisher, which publishes from when the bridge has matched all three.
pub struct Flow {
    reader: RawReader,
    _noncritical: RawReader,
    received: Vec<u32>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<(u32, RawWriter)>>,
    _participants: [Participant; 2],
}

impl Flow {
    /// Starts the flow. `join` opens a participant of a given name in the bridge's network.
    pub fn start(bridge: &Bridge, join: impl Fn(&str) -> Participant) -> Self {
        let mut publisher = join("publisher");
        let writer: RawWriter =
            publisher.create_writer("rt/scan", TYPE, &QosProfile::CRITICAL, 1_000).unwrap();
        wait_until("ingress matched by the publisher", || writer.matched_readers().next().is_some());
        let mut subscriber = join("subscriber");
        let qos = ReaderQos {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            depth: 100_000,
            deadline_ms: None,
        };
        let reader = subscriber.create_reader("rt/adaptive_bridge/critical/scan", TYPE, &qos).unwrap();
        let qos = ReaderQos { reliability: Reliability::BestEffort, depth: 1, ..qos };
        let noncritical =
            subscriber.create_reader("rt/adaptive_bridge/noncritical/scan", TYPE, &qos).unwrap();
        bridge.wait_status("the subscribers", |status| {
            ["critical", "noncritical"].iter().all(|name| lane(status, name)["readers"] == 1)
        });
        let stop = Arc::new(AtomicBool::new(false));
        let thread = write_numbers(writer, Duration::from_millis(5), &stop);
        let participants = [publisher, subscriber];
        Self {
            reader,
            _noncritical: noncritical,
            received: Vec::new(),
            stop,
            thread: Some(thread),
            _participants: participants,
        }
    }

    /// Takes the samples that have arrived; returns the number of samples received so far.
    pub fn received(&mut self) -> usize {
        take_numbers(&self.reader, &mut self.received);
        self.received.len()
    }

    /// Waits until so many more samples have arrived.
    pub fn wait_more(&mut self, samples: usize) {
        let before = self.received();
        wait_until("samples at the critical subscriber", || self.received() >= before + samples);
    }

    /// Ends the flow. Asserts that the critical subscriber received every sample in order, and that the
    /// bridge accounts for each sample on both lanes.
    pub fn end_whole(mut self, bridge: &Bridge) -> Value {
        let sent = self.stop();
        wait_until("every sample at the critical subscriber", || self.received() >= sent as usize);
        assert_eq!(self.received, (0..sent).collect::<Vec<_>>());
        let status = wait_accounted(bridge, sent);
        assert_eq!(lane(&status, "critical")["forwarded"], sent, "{status}");
        status
    }

    /// Ends a flow that the bridge stopped for a part of the time. Asserts that the samples at the critical
    /// subscriber are in order, and that the bridge accounts for each sample on both lanes.
    pub fn end_accounted(mut self, bridge: &Bridge) -> Value {
        let sent = self.stop();
        let status = wait_accounted(bridge, sent);
        let forwarded = lane(&status, "critical")["forwarded"].as_u64().unwrap();
        wait_until("every forwarded sample", || self.received() as u64 >= forwarded);
        assert!(self.received.is_sorted_by(|one, next| one < next), "{:?}", self.received);
        assert_eq!(self.received.len() as u64, forwarded, "{status}");
        status
    }

    fn stop(&mut self) -> u32 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap().0
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Waits until both lanes have settled all samples and asserts that they account for each; returns the
/// status.
fn wait_accounted(bridge: &Bridge, sent: u32) -> Value {
    let status = bridge.wait_status("every sample accounted for", |status| {
        let settled = |name| {
            let lane = lane(status, name);
            lane["received"] == sent && lane["waiting"] == 0
        };
        settled("critical") && settled("noncritical")
    });
    assert_eq!(status["routes"][0]["whole"], true, "{status}");
    for name in ["critical", "noncritical"] {
        assert_eq!(lane(&status, name)["whole"], true, "{status}");
    }
    status
}

/// The output of a lane of the first route in a status.
pub fn lane<'a>(status: &'a Value, name: &str) -> &'a Value {
    let lanes = status["routes"][0]["lanes"].as_array().unwrap();
    lanes.iter().find(|lane| lane["lane"] == name).unwrap_or_else(|| panic!("{name} in {status}"))
}
