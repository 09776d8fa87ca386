//! Diagnostics of the bridge: decisions and reports published as ROS 2 topics, and the metrics page.
//!
//! Decisions are published as they are made. A separate thread makes the reports, so that reading and
//! encoding all boards delays neither a probe nor a policy.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use bytes::Bytes;
use tracing::{debug, error, warn};

use super::super::role::RoleError;
use super::subscribers::{Change, Subscribers};
use crate::clock;
use crate::config::Settings;
use crate::dds::{Participant, RawWriter};
use crate::model::{
    Durability, Encapsulation, History, MonotonicNs, QosProfile, Reliability, SourceTimestamp,
};
use crate::policy::LinkReading;
use crate::shm::Boards;
use crate::telemetry::{self, Decision, MetricsServer, Report, Snapshot};

/// The QoS with which ROS 2 nodes publish diagnostics and `diagnostic_aggregator` subscribes to them.
const QOS: QosProfile = QosProfile {
    reliability: Reliability::Reliable,
    history: History::KeepLast { depth: 10 },
    durability: Durability::Volatile,
    lifespan_ms: None,
    deadline_ms: None,
};

/// Unacknowledged messages that a writer retains; older ones are evicted, and a slow reader misses them.
const WINDOW_SAMPLES: usize = 64;

/// Interval at which all states are published again, for subscribers that join late.
const STATES_MS: u64 = 1_000;

/// Publishes decisions, and reports from a separate thread.
pub(super) struct Diagnostics {
    enabled: bool,
    decisions: RawWriter,
    next_states_at: MonotonicNs,
    shared: Arc<Shared>,
    reporter: Option<JoinHandle<()>>,
}

/// State that control shares with the reporting thread.
struct Shared {
    /// Set when the thread has to end.
    end: AtomicBool,
    settings: Mutex<Settings>,
}

impl Shared {
    #[allow(clippy::disallowed_methods, reason = "held for a copy of the settings, by control only")]
    fn settings(&self) -> Settings {
        self.settings.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// State of the reporting thread.
struct Reporter {
    boards: Boards,
    array: RawWriter,
    json: RawWriter,
    metrics: Option<MetricsServer>,
    shared: Arc<Shared>,
}

impl Diagnostics {
    pub fn open(
        boards: &Boards,
        settings: &Settings,
        participant: &mut Participant,
    ) -> Result<Self, RoleError> {
        let shared = Arc::new(Shared { end: AtomicBool::new(false), settings: Mutex::new(settings.clone()) });
        // Creates all writers even while diagnostics are off: a reload may switch them on.
        let mut writer =
            |topic: &str, dds_type| participant.create_writer(topic, dds_type, &QOS, WINDOW_SAMPLES);
        let decisions = writer(&dds_topic(telemetry::DECISION_TOPIC), telemetry::STRING_TYPE)?;
        let array = writer(&dds_topic(telemetry::DIAGNOSTICS_TOPIC), telemetry::DIAGNOSTIC_ARRAY_TYPE)?;
        let json = writer(&settings.diagnostics.topic.to_dds(), telemetry::STRING_TYPE)?;
        // A failed metrics page does not stop the bridge.
        let metrics = settings.diagnostics.metrics.as_ref().and_then(|listener| {
            MetricsServer::start(listener).inspect_err(|error| error!(%error, "metrics are not served")).ok()
        });
        let reporting_thread =
            Reporter { boards: boards.clone(), array, json, metrics, shared: Arc::clone(&shared) };
        let thread = std::thread::Builder::new().name("report".to_owned());
        let reporter = Some(thread.spawn(move || reporting_thread.run())?);
        let enabled = settings.diagnostics.enabled;
        Ok(Self { enabled, decisions, next_states_at: MonotonicNs(0), shared, reporter })
    }

    /// Applies a reloaded configuration.
    #[allow(clippy::disallowed_methods, reason = "held for a copy of the settings, by control only")]
    pub fn apply(&mut self, settings: &Settings) {
        self.enabled = settings.diagnostics.enabled;
        *self.shared.settings.lock().unwrap_or_else(PoisonError::into_inner) = settings.clone();
    }

    /// Publishes the change of a subscriber's state.
    pub fn publish_change(&self, change: &Change, settings: &Settings) {
        self.publish_decision(&Decision {
            subscriber_id: &change.subscriber,
            lane: settings.lanes[change.lane].name.as_str(),
            state: change.transition.to,
            previous_state: change.transition.from,
            reason: &change.reason,
            rtt_ms: change.reading.rtt_mean_ms,
            loss: loss(&change.reading),
            time: clock::wall(),
        });
    }

    /// Publishes the states of all subscribers, once a second.
    pub fn publish_states(&mut self, subscribers: &Subscribers, settings: &Settings, now: MonotonicNs) {
        if now < self.next_states_at {
            return;
        }
        self.next_states_at = now.plus_ms(STATES_MS);
        for subscriber in subscribers.iter(settings) {
            self.publish_decision(&Decision {
                subscriber_id: subscriber.id,
                lane: subscriber.lane,
                state: subscriber.state,
                previous_state: subscriber.previous_state,
                reason: subscriber.reason,
                rtt_ms: subscriber.reading.rtt_mean_ms,
                loss: loss(subscriber.reading),
                time: clock::wall(),
            });
        }
    }

    fn publish_decision(&self, decision: &Decision<'_>) {
        if self.enabled {
            write(&self.decisions, decision.payload());
        }
    }
}

impl Drop for Diagnostics {
    fn drop(&mut self) {
        self.shared.end.store(true, Ordering::Relaxed);
        if let Some(reporter) = self.reporter.take() {
            reporter.thread().unpark();
            if reporter.join().is_err() {
                warn!("the reporting thread panicked");
            }
        }
    }
}

impl Reporter {
    fn run(self) {
        let mut previous: Option<Snapshot> = None;
        let mut next_report_at = clock::monotonic();
        while !self.shared.end.load(Ordering::Relaxed) {
            let now = clock::monotonic();
            if now < next_report_at {
                // Until the next report, or until `drop` wakes the thread.
                std::thread::park_timeout(Duration::from_nanos(next_report_at.since(now)));
                continue;
            }
            let settings = self.shared.settings();
            next_report_at = now.plus_ms(settings.diagnostics.publish_interval_ms);
            match Snapshot::read(&self.boards, &settings) {
                Ok(snapshot) => {
                    if let Some(previous) = &previous {
                        self.publish(snapshot.report_since(previous), settings.diagnostics.enabled);
                    }
                    previous = Some(snapshot);
                }
                Err(error) => warn!(%error, "cannot read the boards; this report is skipped"),
            }
        }
    }

    fn publish(&self, report: Report, enabled: bool) {
        if enabled {
            for message in telemetry::diagnostic_arrays(&report) {
                write(&self.array, message);
            }
            write(&self.json, telemetry::diagnostics_json(&report));
        }
        if let Some(metrics) = &self.metrics {
            metrics.set_report(Arc::new(report));
        }
    }
}

/// Writes a message. One that the DDS library refuses is dropped: the next message repeats the whole state.
fn write(writer: &RawWriter, payload: Bytes) {
    if let Err(error) =
        writer.write(payload, Encapsulation::CDR_LE, SourceTimestamp::from_wall(clock::wall()))
    {
        debug!(%error, "cannot publish a diagnostics message");
    }
}

fn loss(reading: &LinkReading) -> Option<f64> {
    (reading.settled > 0).then_some(reading.loss)
}

fn dds_topic(topic: &str) -> String {
    // The DDS name of a ROS 2 topic (design.ros2.org, "Topic and Service name mapping to DDS").
    format!("rt{topic}")
}
