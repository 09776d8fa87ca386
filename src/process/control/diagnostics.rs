//! What control tells the ROS 2 graph and the metrics page about the bridge.
//!
//! Decisions are published as they are made. The report of everything is made by a thread of its own, so that
//! to read all boards and to encode them delays neither a probe nor a policy.

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

/// As ROS 2 nodes publish diagnostics, and as `diagnostic_aggregator` subscribes.
const QOS: QosProfile = QosProfile {
    reliability: Reliability::Reliable,
    history: History::KeepLast { depth: 10 },
    durability: Durability::Volatile,
    lifespan_ms: None,
    deadline_ms: None,
};

/// Unacknowledged messages at most: who does not read them does not get them.
const WINDOW_SAMPLES: usize = 64;

/// States are told again so often, for those who come late.
const STATES_MS: u64 = 1_000;

/// Publishes decisions, and reports in a thread of its own.
pub(super) struct Diagnostics {
    enabled: bool,
    decisions: RawWriter,
    states_at: MonotonicNs,
    shared: Arc<Shared>,
    reporter: Option<JoinHandle<()>>,
}

/// What the reporting thread is told.
struct Shared {
    end: AtomicBool,
    settings: Mutex<Settings>,
}

impl Shared {
    fn settings(&self) -> Settings {
        self.settings.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The reporting thread's own.
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
        // All of them, also while diagnostics are off: a reload may switch them on.
        let mut writer =
            |topic: &str, dds_type| participant.create_writer(topic, dds_type, &QOS, WINDOW_SAMPLES);
        let decisions = writer(&dds_topic(telemetry::DECISION_TOPIC), telemetry::STRING_TYPE)?;
        let array = writer(&dds_topic(telemetry::DIAGNOSTICS_TOPIC), telemetry::DIAGNOSTIC_ARRAY_TYPE)?;
        let json = writer(&settings.diagnostics.topic.to_dds(), telemetry::STRING_TYPE)?;
        // The bridge can do without its page.
        let metrics = settings.diagnostics.metrics.as_ref().and_then(|listener| {
            MetricsServer::start(listener).inspect_err(|error| error!(%error, "no metrics page")).ok()
        });
        let reporting =
            Reporter { boards: boards.clone(), array, json, metrics, shared: Arc::clone(&shared) };
        let thread = std::thread::Builder::new().name("report".to_owned());
        let reporter = Some(thread.spawn(move || reporting.run())?);
        let enabled = settings.diagnostics.enabled;
        Ok(Self { enabled, decisions, states_at: MonotonicNs(0), shared, reporter })
    }

    /// Applies a configuration.
    pub fn adopt(&mut self, settings: &Settings) {
        self.enabled = settings.diagnostics.enabled;
        *self.shared.settings.lock().unwrap_or_else(PoisonError::into_inner) = settings.clone();
    }

    /// A subscriber changed its state.
    pub fn decision(&self, change: &Change, settings: &Settings) {
        self.say(&Decision {
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

    /// The states of all subscribers, once a second.
    pub fn states(&mut self, subscribers: &Subscribers, settings: &Settings, now: MonotonicNs) {
        if now < self.states_at {
            return;
        }
        self.states_at = now.plus_ms(STATES_MS);
        for shown in subscribers.iter(settings) {
            self.say(&Decision {
                subscriber_id: shown.id,
                lane: shown.lane,
                state: shown.state,
                previous_state: shown.previous_state,
                reason: shown.reason,
                rtt_ms: shown.reading.rtt_mean_ms,
                loss: loss(shown.reading),
                time: clock::wall(),
            });
        }
    }

    fn say(&self, decision: &Decision<'_>) {
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
        let mut former: Option<Snapshot> = None;
        let mut report_at = clock::monotonic();
        while !self.shared.end.load(Ordering::Relaxed) {
            let now = clock::monotonic();
            if now < report_at {
                // Until then, or until it is to end.
                std::thread::park_timeout(Duration::from_nanos(report_at.since(now)));
                continue;
            }
            let settings = self.shared.settings();
            report_at = now.plus_ms(settings.diagnostics.publish_interval_ms);
            match Snapshot::read(&self.boards, &settings) {
                Ok(snapshot) => {
                    if let Some(former) = &former {
                        self.publish(snapshot.since(former), settings.diagnostics.enabled);
                    }
                    former = Some(snapshot);
                }
                Err(error) => warn!(%error, "no diagnostics this time"),
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
            metrics.show(Arc::new(report));
        }
    }
}

/// Whoever does not read what was written before does not get this either; the next message says all anew.
fn write(writer: &RawWriter, payload: Bytes) {
    if let Err(error) =
        writer.write(payload, Encapsulation::CDR_LE, SourceTimestamp::from_wall(clock::wall()))
    {
        debug!(%error, "diagnostics not published");
    }
}

fn loss(reading: &LinkReading) -> Option<f64> {
    (reading.settled > 0).then_some(reading.loss)
}

fn dds_topic(topic: &str) -> String {
    // A ROS 2 topic's DDS name (design.ros2.org, "Topic and Service name mapping to DDS").
    format!("rt{topic}")
}
