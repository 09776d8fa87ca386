//! Input of the safety supervisor, read from the boards, and the resulting safety mode.

use tracing::{info, warn};

use crate::config::{Lane, Settings};
use crate::model::{DropReason, LatencyHistogram, MonotonicNs, SafetyMode, TrafficClass};
use crate::policy::{ErrorCounts, ProcessLoad, SafetyCause, SafetySupervisor, SafetyTrouble, SourceLag};
use crate::shm::{Boards, ProcessRole, Stage};

/// The counters of one process at the previous evaluation.
#[derive(Default)]
struct PreviousCounters {
    was_running: bool,
    starts: u64,
    errors: ErrorCounts,
    caught_up: u64,
}

/// The safety supervisor and the counters with which it compares the next reading.
pub(super) struct Supervision {
    pub supervisor: SafetySupervisor,
    /// When the safety mode was entered.
    pub since: MonotonicNs,
    /// The cause of the safety mode; empty in normal mode.
    pub reason: String,
    /// Whether a process of the critical path is in trouble.
    pub critical_trouble: bool,
    ingress: PreviousCounters,
    lanes: Vec<PreviousCounters>,
    source_lags: Vec<SourceLag>,
    dds_in: Vec<LatencyHistogram>,
    /// For each lane and route, the latencies from shared memory to the lane and from the lane to the writer.
    lane_latencies: Vec<Vec<(LatencyHistogram, LatencyHistogram)>>,
}

impl Supervision {
    /// Starts with the present counters of the boards; errors before that are not evaluated.
    pub fn new(boards: &Boards, settings: &Settings, now: MonotonicNs) -> Self {
        let routes = settings.routes.len();
        let mut supervision = Self {
            supervisor: SafetySupervisor::default(),
            since: now,
            reason: String::new(),
            critical_trouble: false,
            ingress: PreviousCounters::default(),
            lanes: settings.lanes.iter().map(|_| PreviousCounters::default()).collect(),
            source_lags: vec![SourceLag::default(); routes],
            dds_in: vec![LatencyHistogram::default(); routes],
            lane_latencies: vec![vec![Default::default(); routes]; settings.lanes.len()],
        };
        supervision.read_loads(boards, settings, now);
        supervision
    }

    /// Reads the boards, evaluates the safety mode and logs a change.
    pub fn evaluate(&mut self, boards: &Boards, settings: &Settings, now: MonotonicNs) {
        let loads = self.read_loads(boards, settings, now);
        let decision = self.supervisor.evaluate(&loads, &settings.safety.rules, now);
        self.critical_trouble = decision.critical_trouble;
        let cause = decision.cause.as_ref().filter(|_| decision.mode != SafetyMode::Normal);
        self.reason = cause.map(cause_text).unwrap_or_default();
        let Some(from) = decision.changed_from else { return };
        self.since = now;
        let (from, to) = (from.label(), decision.mode.label());
        if decision.mode as u8 > SafetyMode::Normal as u8 {
            let what = match decision.mode {
                SafetyMode::Emergency => "all forwarding stops",
                _ => "noncritical lanes are suspended",
            };
            warn!(from, to, reason = self.reason, "safety mode changed: {what}");
        } else {
            info!(from, to, "safety mode changed: all lanes forward again");
        }
    }

    /// Reads the loads of ingress and of the lanes that are running.
    fn read_loads<'a>(
        &mut self,
        boards: &Boards,
        settings: &'a Settings,
        now: MonotonicNs,
    ) -> Vec<ProcessLoad<'a>> {
        let mut loads = Vec::with_capacity(1 + settings.lanes.len());
        let published: Vec<u64> = (0..settings.routes.len())
            .map(|route| boards.ingress(route).map_or(0, |counters| counters.published))
            .collect();
        loads.extend(self.read_ingress(boards, settings, now));
        for (lane, configured) in settings.lanes.iter().enumerate() {
            loads.extend(self.read_lane(boards, lane, configured, &published, now));
        }
        loads
    }

    fn read_ingress<'a>(
        &mut self,
        boards: &Boards,
        settings: &Settings,
        now: MonotonicNs,
    ) -> Option<ProcessLoad<'a>> {
        let mut source_lag_ms: Option<f64> = None;
        for route in 0..settings.routes.len() {
            let read = boards.histogram(Stage::DdsIn, route);
            let window = read.since(&self.dds_in[route]);
            self.dds_in[route] = read;
            if let Some(p99_ns) = window.quantile_ns(0.99)
                && let Some(excess_ms) = self.source_lags[route].excess_ms(p99_ns as f64 / 1e6, now)
            {
                source_lag_ms = larger(source_lag_ms, Some(excess_ms));
            }
        }
        let counters = (0..settings.routes.len()).filter_map(|route| boards.ingress(route));
        let pool_exhausted = counters.map(|counters| counters.drops.get(DropReason::PoolExhausted)).sum();
        let total = ErrorCounts { pool_exhausted, ..ErrorCounts::default() };
        let (silent_ms, errors) = self.ingress.advance(boards, ProcessRole::Ingress, total, now)?;
        let load = ProcessLoad::idle("ingress", TrafficClass::Critical);
        Some(ProcessLoad { silent_ms, errors, source_lag_ms, ..load })
    }

    fn read_lane<'a>(
        &mut self,
        boards: &Boards,
        lane: usize,
        configured: &'a Lane,
        published: &[u64],
        now: MonotonicNs,
    ) -> Option<ProcessLoad<'a>> {
        let mut total = ErrorCounts::default();
        let (mut queued, mut waiting, mut caught_up) = (0, 0, 0);
        let mut writer_lag_ms: Option<f64> = None;
        for output in &configured.outputs {
            let counters = boards.lane(lane, output.route).unwrap_or_default();
            let drops = |reason| counters.drops.get(reason);
            total.write_failed += drops(DropReason::WriteFailed);
            total.queue_overflow += drops(DropReason::QueueOverflow);
            if counters.last_sequence > 0 {
                // Samples that ingress has published and the lane has not taken.
                queued = queued.max(published[output.route].saturating_sub(counters.last_sequence));
            }
            waiting = waiting.max(counters.waiting);
            caught_up += counters.caught_up;
            let lag_ms = self.read_writer_lag_ms(boards, lane, output.route, configured.class());
            writer_lag_ms = larger(writer_lag_ms, lag_ms);
        }
        let previous = &mut self.lanes[lane];
        // Samples with which the lane catches up waited while it was down; their latency is not its present
        // speed.
        if std::mem::replace(&mut previous.caught_up, caught_up) != caught_up {
            writer_lag_ms = None;
        }
        let (silent_ms, errors) = previous.advance(boards, ProcessRole::Egress(lane), total, now)?;
        let is_critical = configured.class() == TrafficClass::Critical;
        Some(ProcessLoad {
            silent_ms,
            errors,
            queued: if is_critical { queued } else { 0 },
            queue_capacity: if is_critical { configured.queue_depth as u64 } else { 0 },
            waiting: if is_critical { 0 } else { waiting },
            writer_lag_ms,
            ..ProcessLoad::idle(configured.name.as_str(), configured.class())
        })
    }

    /// p99 of the latency from shared memory to the writer since the previous evaluation. For a noncritical
    /// lane without the time in shared memory, where samples wait for a token.
    fn read_writer_lag_ms(
        &mut self,
        boards: &Boards,
        lane: usize,
        route: usize,
        class: TrafficClass,
    ) -> Option<f64> {
        let read = (boards.histogram(Stage::Shm(lane), route), boards.histogram(Stage::DdsOut(lane), route));
        let previous = &mut self.lane_latencies[lane][route];
        let (shm, dds_out) = (read.0.since(&previous.0), read.1.since(&previous.1));
        *previous = read;
        let ms = |window: &LatencyHistogram| window.quantile_ns(0.99).map(|ns| ns as f64 / 1e6);
        match class {
            TrafficClass::Critical => Some(ms(&shm)? + ms(&dds_out)?),
            TrafficClass::Noncritical => ms(&dds_out),
        }
    }
}

impl PreviousCounters {
    /// Stores the present counters; returns for how long the process is silent and its errors since the
    /// previous call. `None` while the process is not expected to run: it never started, or ended normally.
    fn advance(
        &mut self,
        boards: &Boards,
        role: ProcessRole,
        total: ErrorCounts,
        now: MonotonicNs,
    ) -> Option<(u64, ErrorCounts)> {
        let health = boards.health(role)?;
        let is_running = health.pid != 0 && health.ended == 0;
        let before = std::mem::replace(&mut self.errors, total);
        let starts = std::mem::replace(&mut self.starts, health.starts);
        if !is_running || !std::mem::replace(&mut self.was_running, is_running) {
            self.was_running = is_running;
            // The first reading of this process: earlier errors are not evaluated.
            return is_running.then(|| (now.since(health.alive_at) / 1_000_000, ErrorCounts::default()));
        }
        let errors = ErrorCounts {
            write_failed: total.write_failed.saturating_sub(before.write_failed),
            pool_exhausted: total.pool_exhausted.saturating_sub(before.pool_exhausted),
            queue_overflow: total.queue_overflow.saturating_sub(before.queue_overflow),
            restarts: health.starts.saturating_sub(starts),
        };
        Some((now.since(health.alive_at) / 1_000_000, errors))
    }
}

fn larger(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    one.into_iter().chain(other).reduce(f64::max)
}

/// The cause of a safety mode, as a sentence that fits into [`FixedText`](crate::model::FixedText).
fn cause_text(cause: &SafetyCause) -> String {
    let process = cause.process.as_str();
    match cause.trouble {
        SafetyTrouble::Queue { queued, capacity } => {
            // A stopped lane can fall behind by more samples than its queue holds.
            let queued = queued.min(capacity);
            format!("{process}: {queued} of {capacity} samples wait in shared memory")
        }
        SafetyTrouble::Waiting { samples, limit } => {
            format!("{process}: {samples} samples wait, more than {limit}")
        }
        SafetyTrouble::SourceLag { lag_ms, limit_ms } => {
            format!("{process}: {lag_ms:.0} ms from source to shared memory (limit {limit_ms:.0})")
        }
        SafetyTrouble::WriterLag { lag_ms, limit_ms } => {
            format!("{process}: {lag_ms:.0} ms from shared memory to the writer (limit {limit_ms:.0})")
        }
        SafetyTrouble::Errors { per_s, limit_per_s } => {
            format!("{process}: {per_s:.1} errors per second (limit {limit_per_s})")
        }
        SafetyTrouble::Silent { silent_ms, limit_ms } => {
            format!(
                "{process}: no turn of its main loop for {:.1} s (limit {:.1})",
                silent_ms as f64 / 1e3,
                limit_ms as f64 / 1e3
            )
        }
    }
}
