//! The safety supervisor (paper, section III-E) decides the safety mode of the whole bridge from queues,
//! lags, errors and silence.
//!
//! EMERGENCY stops every lane, so it must not be entered by mistake. Only signs that the bridge itself no
//! longer keeps up on the critical path call for it: a full queue, samples that wait for seconds between
//! shared memory and their writer, samples lost in shared memory, a process that is gone for long. Causes
//! outside the bridge do not:
//!
//! - noncritical lanes: DEGRADED at most;
//! - a subscriber that does not keep up (`reader_overrun`): no effect; other subscribers receive the samples;
//! - a write that DDS refuses (`write_failed`): DEGRADED at most;
//! - a publisher's clock: the lag from source to shared memory leads to DEGRADED at most, see [`SourceLag`];
//! - a restart: EMERGENCY requires six consecutive readings, 3 s by default, and the samples that wait for a
//!   process without turns do not count as its queue;
//! - a lane that waits for its rate: the caller excludes that time from its lag.

use crate::model::{FixedText, MonotonicNs, SafetyMode, SafetyRules, TrafficClass};

/// The largest plausible lag from source to shared memory; a larger one is a difference between clocks.
pub const MAX_SOURCE_LAG_MS: f64 = 10_000.0;

/// The period of the minimum lag, which is that of the current and the previous period.
const BASELINE_MS: u64 = 60_000;

/// Time without a turn after which a full queue is no sign of overload. Every process turns ten times a
/// second; one that does not hangs, is stopped or is gone. Its queue fills within 0.3 s, while a watchdog
/// takes 2 s: stopping the other lanes, and then the restarted one, would only prolong the gap.
const STALLED_MS: u64 = 500;

/// The smallest queue whose occupancy is meaningful: a single sample could fill a smaller one.
const MIN_QUEUE: u64 = 8;

/// The increase of the source lag of one route.
///
/// The lag is measured with the clocks of the publisher and this host, so that a constant part of it may be a
/// difference between clocks. Only the increase above the minimum of the last one to two minutes counts. When
/// a clock steps, the minimum includes the new difference after two minutes at most. A lag that is negative
/// or above [`MAX_SOURCE_LAG_MS`] is certainly a difference between clocks and is ignored.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SourceLag {
    since: MonotonicNs,
    min_ms: Option<f64>,
    previous_min_ms: Option<f64>,
}

impl SourceLag {
    /// Applies the p99 lag of one evaluation, from a `LatencyHistogram`, and returns its increase above the
    /// minimum; `None` for a difference between clocks.
    pub fn excess_ms(&mut self, p99_ms: f64, now: MonotonicNs) -> Option<f64> {
        if !(0.0..=MAX_SOURCE_LAG_MS).contains(&p99_ms) {
            return None;
        }
        let elapsed_ns = now.since(self.since);
        if elapsed_ns > BASELINE_MS * 1_000_000 {
            let recent = elapsed_ns <= 2 * BASELINE_MS * 1_000_000;
            self.previous_min_ms = if recent { self.min_ms } else { None };
            self.min_ms = None;
            self.since = now;
        }
        let min_ms = self.min_ms.map_or(p99_ms, |min_ms| min_ms.min(p99_ms));
        self.min_ms = Some(min_ms);
        let min_ms = self.previous_min_ms.map_or(min_ms, |previous_ms| previous_ms.min(min_ms));
        // The histogram rounds up by at most a sixteenth, which is much if the clocks differ by much.
        Some((p99_ms - min_ms - p99_ms / 16.0).max(0.0))
    }
}

/// Errors of one process since the last evaluation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounts {
    /// Samples that the DDS library refused.
    pub write_failed: u64,
    /// Samples for which the pool had no free slot.
    pub pool_exhausted: u64,
    /// Samples overwritten before a critical lane took them. They are ignored on a noncritical lane, where a
    /// limited rate causes them.
    pub queue_overflow: u64,
    /// Starts of the process.
    pub restarts: u64,
}

/// The load of one process of the data plane, from its counters. The caller leaves out a process that never
/// wrote its health record or that shut down in order: it is absent, not silent.
#[derive(Clone, Copy, Debug)]
pub struct ProcessLoad<'a> {
    /// Its name in logs and diagnostics: `ingress`, or the lane.
    pub name: &'a str,
    /// The class of its lane; ingress is on the critical path.
    pub class: TrafficClass,
    /// Time since its last turn.
    pub silent_ms: u64,
    /// Errors since the last evaluation.
    pub errors: ErrorCounts,
    /// Samples that wait in shared memory for a critical lane, of the route with the highest occupancy.
    pub queued: u64,
    /// The capacity of that queue; 0 when there is no such queue.
    pub queue_capacity: u64,
    /// Samples that wait in a noncritical lane, of the route with the most.
    pub waiting: u64,
    /// Ingress: the largest [`SourceLag::excess_ms`] of all routes; `None` when no sample arrived.
    pub source_lag_ms: Option<f64>,
    /// p99 of the time from shared memory to the writer in this evaluation, excluding the wait for the rate
    /// and samples that the lane caught up with after a restart; `None` when nothing was written.
    pub writer_lag_ms: Option<f64>,
}

impl<'a> ProcessLoad<'a> {
    /// The load of an idle process.
    pub const fn idle(name: &'a str, class: TrafficClass) -> Self {
        Self {
            name,
            class,
            silent_ms: 0,
            errors: ErrorCounts { write_failed: 0, pool_exhausted: 0, queue_overflow: 0, restarts: 0 },
            queued: 0,
            queue_capacity: 0,
            waiting: 0,
            source_lag_ms: None,
            writer_lag_ms: None,
        }
    }
}

/// What is wrong with a process, with the measured value and the threshold that it reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SafetyTrouble {
    /// A critical lane takes its samples out of shared memory too slowly.
    Queue {
        /// Samples that wait.
        queued: u64,
        /// The capacity of the queue.
        capacity: u64,
    },
    /// Too many samples wait in a noncritical lane.
    Waiting {
        /// Samples that wait.
        samples: u64,
        /// `safety.max_noncritical_queue`.
        limit: u64,
    },
    /// Samples take long from their source to shared memory.
    SourceLag {
        /// The increase of the p99 above its minimum.
        lag_ms: f64,
        /// The threshold.
        limit_ms: f64,
    },
    /// Samples take long from shared memory to the writer.
    WriterLag {
        /// p99.
        lag_ms: f64,
        /// The threshold.
        limit_ms: f64,
    },
    /// Samples are lost, or the process restarts repeatedly.
    Errors {
        /// Errors per second.
        per_s: f64,
        /// The threshold.
        limit_per_s: f64,
    },
    /// The process makes no turns.
    Silent {
        /// Time since its last turn.
        silent_ms: u64,
        /// The threshold.
        limit_ms: u64,
    },
}

impl SafetyTrouble {
    /// `queue`, `waiting`, `source_lag`, `writer_lag`, `errors` or `silent`.
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Queue { .. } => "queue",
            Self::Waiting { .. } => "waiting",
            Self::SourceLag { .. } => "source_lag",
            Self::WriterLag { .. } => "writer_lag",
            Self::Errors { .. } => "errors",
            Self::Silent { .. } => "silent",
        }
    }
}

/// The trouble of one process, and the mode that it calls for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyCause {
    /// The name of the process.
    pub process: FixedText,
    /// Whether it is on the critical path.
    pub class: TrafficClass,
    /// The trouble.
    pub trouble: SafetyTrouble,
    /// The mode that it calls for: DEGRADED or EMERGENCY.
    pub speaks_for: SafetyMode,
}

/// The outcome of one evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyDecision {
    /// The mode from now on.
    pub mode: SafetyMode,
    /// The former mode, if this evaluation changed it.
    pub changed_from: Option<SafetyMode>,
    /// The worst trouble of this reading, or else of an earlier one, until the bridge is in NORMAL again.
    pub cause: Option<SafetyCause>,
    /// Whether this reading had no trouble.
    pub clean: bool,
    /// Whether the critical path itself, apart from source lag, has had trouble since NORMAL was left.
    pub critical_trouble: bool,
}

/// The safety supervisor.
///
/// DEGRADED requires `hysteresis_count` consecutive readings that call for DEGRADED or worse; EMERGENCY then
/// requires as many that call for EMERGENCY. Each step back requires `recovery_count` consecutive readings:
/// none that calls for EMERGENCY for the step to DEGRADED, none with trouble for the step to NORMAL. DEGRADED
/// frees the resources of the noncritical lanes, so that the trouble may return with these lanes; the larger
/// `recovery_count` prevents frequent switching.
#[derive(Clone, Copy, Debug, Default)]
pub struct SafetySupervisor {
    mode: SafetyMode,
    /// Consecutive readings that call for DEGRADED or worse.
    degraded_run: u32,
    /// Consecutive readings that call for EMERGENCY.
    emergency_run: u32,
    /// Consecutive readings that allow the step back.
    recovery_run: u32,
    /// Consecutive readings in which the critical path itself has trouble.
    critical_run: u32,
    critical_trouble: bool,
    cause: Option<SafetyCause>,
    evaluated_at: Option<MonotonicNs>,
    transitions: u64,
}

impl SafetySupervisor {
    /// The mode.
    pub const fn mode(&self) -> SafetyMode {
        self.mode
    }

    /// Changes of the mode so far.
    pub const fn transitions(&self) -> u64 {
        self.transitions
    }

    /// Evaluates one reading of `processes`: every process of the data plane that runs or should run. A
    /// caller that was stopped does not repeat missed evaluations.
    pub fn evaluate(
        &mut self,
        processes: &[ProcessLoad<'_>],
        rules: &SafetyRules,
        now: MonotonicNs,
    ) -> SafetyDecision {
        // The first reading has no errors per second: the time in which its errors occurred is unknown.
        let elapsed_s = self.evaluated_at.map(|last| now.since(last) as f64 / 1e9);
        self.evaluated_at = Some(now);
        let reading = Reading::of(processes, rules, elapsed_s.filter(|&elapsed_s| elapsed_s > 0.0));
        let level = reading.worst.map_or(SafetyMode::Normal, |worst| worst.speaks_for);
        let up = rules.hysteresis_count.max(1);
        let back = rules.recovery_count.max(1);

        count(&mut self.degraded_run, level != SafetyMode::Normal);
        count(&mut self.emergency_run, level == SafetyMode::Emergency);
        count(&mut self.critical_run, reading.critical);
        let mode = match self.mode {
            SafetyMode::Normal => {
                if self.emergency_run >= up && !rules.overload_drop_noncritical_first {
                    SafetyMode::Emergency
                } else if self.degraded_run >= up {
                    SafetyMode::Degraded
                } else {
                    SafetyMode::Normal
                }
            }
            SafetyMode::Degraded => {
                count(&mut self.recovery_run, level == SafetyMode::Normal);
                if self.emergency_run >= up {
                    SafetyMode::Emergency
                } else if self.recovery_run >= back {
                    SafetyMode::Normal
                } else {
                    SafetyMode::Degraded
                }
            }
            SafetyMode::Emergency => {
                count(&mut self.recovery_run, level != SafetyMode::Emergency);
                if self.recovery_run >= back { SafetyMode::Degraded } else { SafetyMode::Emergency }
            }
        };
        let changed_from = (mode != self.mode).then_some(self.mode);
        if changed_from.is_some() {
            self.mode = mode;
            self.transitions += 1;
            (self.degraded_run, self.emergency_run, self.recovery_run) = (0, 0, 0);
        }
        self.critical_trouble =
            mode != SafetyMode::Normal && (self.critical_trouble || self.critical_run >= up);
        let back_to_normal = mode == SafetyMode::Normal && changed_from.is_none();
        self.cause = reading.worst.or(if back_to_normal { None } else { self.cause });
        SafetyDecision {
            mode,
            changed_from,
            cause: self.cause,
            clean: reading.worst.is_none(),
            critical_trouble: self.critical_trouble,
        }
    }
}

/// Counts a reading in a run of consecutive ones, or resets the run.
fn count(run: &mut u32, continues: bool) {
    *run = if continues { run.saturating_add(1) } else { 0 };
}

/// The troubles of one evaluation.
#[derive(Default)]
struct Reading {
    worst: Option<SafetyCause>,
    /// Whether the critical path itself, apart from source lag, has trouble.
    critical: bool,
}

impl Reading {
    fn of(processes: &[ProcessLoad<'_>], rules: &SafetyRules, elapsed_s: Option<f64>) -> Self {
        let mut reading = Self::default();
        for process in processes {
            match process.class {
                TrafficClass::Critical => reading.critical_path(process, rules, elapsed_s),
                TrafficClass::Noncritical => reading.noncritical_lane(process, rules, elapsed_s),
            }
        }
        reading
    }

    fn critical_path(&mut self, process: &ProcessLoad<'_>, rules: &SafetyRules, elapsed_s: Option<f64>) {
        let silent_ms = process.silent_ms;
        if silent_ms >= rules.silent_ms {
            // Its queue, lag and errors are consequences of the silence.
            let is_long = rules.emergency_silent_ms != 0 && silent_ms >= rules.emergency_silent_ms;
            let limit_ms = if is_long { rules.emergency_silent_ms } else { rules.silent_ms };
            return self.add(process, SafetyTrouble::Silent { silent_ms, limit_ms }, is_long);
        }
        if silent_ms >= STALLED_MS {
            return;
        }
        if process.queue_capacity >= MIN_QUEUE {
            let occupancy = process.queued as f64 / process.queue_capacity as f64;
            if occupancy >= rules.degraded_queue_occupancy {
                let trouble =
                    SafetyTrouble::Queue { queued: process.queued, capacity: process.queue_capacity };
                self.add(process, trouble, occupancy >= rules.emergency_queue_occupancy);
            }
        }
        if let Some(lag_ms) = process.writer_lag_ms
            && lag_ms >= rules.degraded_lag_ms
        {
            let is_extreme = lag_ms >= rules.emergency_lag_ms;
            let limit_ms = if is_extreme { rules.emergency_lag_ms } else { rules.degraded_lag_ms };
            self.add(process, SafetyTrouble::WriterLag { lag_ms, limit_ms }, is_extreme);
        }
        if let Some(lag_ms) = process.source_lag_ms
            && (rules.degraded_lag_ms..=MAX_SOURCE_LAG_MS).contains(&lag_ms)
        {
            let limit_ms = rules.degraded_lag_ms;
            self.add(process, SafetyTrouble::SourceLag { lag_ms, limit_ms }, false);
        }
        if let Some(elapsed_s) = elapsed_s {
            let errors = &process.errors;
            let lost = errors.queue_overflow.saturating_add(errors.pool_exhausted);
            let lost_per_s = lost as f64 / elapsed_s;
            let per_s =
                lost.saturating_add(errors.write_failed).saturating_add(errors.restarts) as f64 / elapsed_s;
            if lost_per_s >= rules.emergency_errors_per_s {
                let limit_per_s = rules.emergency_errors_per_s;
                self.add(process, SafetyTrouble::Errors { per_s: lost_per_s, limit_per_s }, true);
            } else if per_s >= rules.degraded_errors_per_s {
                let limit_per_s = rules.degraded_errors_per_s;
                self.add(process, SafetyTrouble::Errors { per_s, limit_per_s }, false);
            }
        }
    }

    /// DEGRADED suspends all noncritical lanes. Trouble of one of them that does not affect the others, such
    /// as a reader that does not acknowledge, must not call for it.
    fn noncritical_lane(&mut self, process: &ProcessLoad<'_>, rules: &SafetyRules, elapsed_s: Option<f64>) {
        let is_silent = process.silent_ms >= rules.silent_ms;
        if !is_silent {
            let limit = rules.max_noncritical_queue as u64;
            if process.waiting > limit {
                self.add(process, SafetyTrouble::Waiting { samples: process.waiting, limit }, false);
            }
            if let Some(lag_ms) = process.writer_lag_ms
                && lag_ms >= rules.degraded_lag_ms
            {
                let limit_ms = rules.degraded_lag_ms;
                self.add(process, SafetyTrouble::WriterLag { lag_ms, limit_ms }, false);
            }
        }
        let errors = &process.errors;
        let counted = errors.write_failed.saturating_add(errors.restarts);
        let counted_per_s = elapsed_s.map_or(0.0, |elapsed_s| counted as f64 / elapsed_s);
        // Silence counts as one error per second, which by default does not suspend the noncritical lanes.
        let per_s = counted_per_s + if is_silent { 1.0 } else { 0.0 };
        if per_s >= rules.degraded_errors_per_s {
            let limit_per_s = rules.degraded_errors_per_s;
            self.add(process, SafetyTrouble::Errors { per_s, limit_per_s }, false);
        }
    }

    /// Keeps the worst trouble: EMERGENCY before DEGRADED, then the critical path first, then the first one.
    fn add(&mut self, process: &ProcessLoad<'_>, trouble: SafetyTrouble, is_extreme: bool) {
        let class = process.class;
        let is_critical = class == TrafficClass::Critical;
        self.critical |= is_critical && !matches!(trouble, SafetyTrouble::SourceLag { .. });
        let rank = |is_extreme, class| (is_extreme, class == TrafficClass::Critical);
        let is_worse = self.worst.is_none_or(|worst| {
            rank(is_extreme, class) > rank(worst.speaks_for == SafetyMode::Emergency, worst.class)
        });
        if is_worse {
            let speaks_for = if is_extreme { SafetyMode::Emergency } else { SafetyMode::Degraded };
            self.worst =
                Some(SafetyCause { process: FixedText::new(process.name), class, trouble, speaks_for });
        }
    }
}
