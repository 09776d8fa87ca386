//! Diagnostics of the bridge: decisions and reports published as ROS 2 topics, and the metrics page.
//!
//! Decisions are published as they are made. A separate thread makes the reports, so that reading and
//! encoding all boards delays neither a probe nor a policy.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use bytes::Bytes;
use tracing::{debug, error, warn};

use super::super::error::RoleError;
use crate::clock;
use crate::config::Settings;
use crate::dds::{Participant, RawWriter};
use crate::model::{Encapsulation, History, MonotonicNs, QosProfile, SourceTimestamp};
use crate::shm::Boards;
use crate::telemetry::{self, Decision, MetricsServer, Report, Snapshot};

/// The QoS with which ROS 2 nodes publish diagnostics and `diagnostic_aggregator` subscribes to them.
const QOS: QosProfile = QosProfile { history: History::KeepLast { depth: 10 }, ..QosProfile::CRITICAL };

/// Unacknowledged messages that a writer retains; older ones are evicted, and a slow reader misses them.
const WINDOW_SAMPLES: usize = 64;

/// Interval at which all states are published again, for subscribers that join late.
const STATES_MS: u64 = 1_000;

/// Publishes decisions, and reports from a separate thread.
pub(super) struct Diagnostics {
    enabled: bool,
    decisions: RawWriter,
    next_states_at: MonotonicNs,
    /// The reporting thread, which ends when the sender of reloaded settings is dropped.
    reporter: Option<(Sender<Settings>, JoinHandle<()>)>,
}

struct Reporter {
    boards: Boards,
    array: RawWriter,
    json: RawWriter,
    metrics: Option<MetricsServer>,
    settings: Settings,
}

impl Diagnostics {
    pub fn open(
        boards: &Boards,
        settings: &Settings,
        participant: &mut Participant,
    ) -> Result<Self, RoleError> {
        // Creates all writers even while diagnostics are off: a reload may switch them on.
        let mut writer = |topic: &str, dds_type| {
            participant.create_writer(&format!("rt{topic}"), dds_type, &QOS, WINDOW_SAMPLES)
        };
        let decisions = writer(telemetry::DECISION_TOPIC, telemetry::STRING_TYPE)?;
        let array = writer(telemetry::DIAGNOSTICS_TOPIC, telemetry::DIAGNOSTIC_ARRAY_TYPE)?;
        let json = writer(settings.diagnostics.topic.as_str(), telemetry::STRING_TYPE)?;
        // A failed metrics page does not stop the bridge.
        let metrics = settings.diagnostics.metrics.as_ref().and_then(|listener| {
            MetricsServer::start(listener).inspect_err(|error| error!(%error, "metrics are not served")).ok()
        });
        let reporter = Reporter { boards: boards.clone(), array, json, metrics, settings: settings.clone() };
        let (sender, reloaded) = channel();
        let thread = std::thread::Builder::new().name("report".to_owned());
        let thread = thread.spawn(move || reporter.run(&reloaded))?;
        let enabled = settings.diagnostics.enabled;
        Ok(Self { enabled, decisions, next_states_at: MonotonicNs(0), reporter: Some((sender, thread)) })
    }

    pub fn apply(&mut self, settings: &Settings) {
        self.enabled = settings.diagnostics.enabled;
        if let Some((reloaded, _)) = &self.reporter {
            // Fails only if the thread has panicked, which ends the process.
            let _ = reloaded.send(settings.clone());
        }
    }

    /// Publishes the states of all subscribers, once a second.
    pub fn publish_states<'a>(&mut self, states: impl Iterator<Item = Decision<'a>>, now: MonotonicNs) {
        if now >= self.next_states_at {
            self.next_states_at = now.plus_ms(STATES_MS);
            states.for_each(|state| self.publish(&state));
        }
    }

    pub fn publish(&self, decision: &Decision<'_>) {
        if self.enabled {
            write(&self.decisions, decision.payload());
        }
    }
}

impl Drop for Diagnostics {
    fn drop(&mut self) {
        if let Some((reloaded, reporter)) = self.reporter.take() {
            drop(reloaded);
            if reporter.join().is_err() {
                warn!("the reporting thread panicked");
            }
        }
    }
}

impl Reporter {
    fn run(mut self, reloaded: &Receiver<Settings>) {
        let mut previous: Option<Snapshot> = None;
        let mut next_report_at = clock::monotonic();
        loop {
            let now = clock::monotonic();
            #[allow(clippy::disallowed_methods, reason = "control handles no samples")]
            let reload = reloaded.recv_timeout(Duration::from_nanos(next_report_at.since(now)));
            match reload {
                Ok(settings) => self.settings = settings,
                Err(RecvTimeoutError::Disconnected) => return,
                Err(RecvTimeoutError::Timeout) => {
                    next_report_at =
                        clock::monotonic().plus_ms(self.settings.diagnostics.publish_interval_ms);
                    self.report(&mut previous);
                }
            }
        }
    }

    fn report(&self, previous: &mut Option<Snapshot>) {
        match Snapshot::read(&self.boards, &self.settings) {
            Ok(snapshot) => {
                if let Some(previous) = previous {
                    self.publish(snapshot.report_since(previous), self.settings.diagnostics.enabled);
                }
                *previous = Some(snapshot);
            }
            Err(error) => warn!(%error, "cannot read the boards; this report is skipped"),
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
