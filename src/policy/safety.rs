//! The safety supervisor (paper, section III-E): a mode for the whole bridge, from queues, lags, errors and
//! silence.
//!
//! Who can stop a robot's data by mistake? EMERGENCY stops every lane, so only what shows that the bridge
//! itself no longer keeps up on the critical path speaks for it: a full queue, samples that wait for seconds
//! between shared memory and their writer, samples lost in shared memory, a process that is gone for long.
//! What others can bring about does not:
//!
//! - noncritical lanes, whatever they do: DEGRADED at most;
//! - a subscriber that does not keep up (`reader_overrun`): nothing. The other subscribers have its samples;
//! - a write that DDS refuses (`write_failed`): DEGRADED at most;
//! - a publisher's clock: the lag from source to shared memory leads to DEGRADED at most, see [`SourceLag`];
//! - a restart: the way up takes six readings in a row, 3 s by default, and what waits for a process that
//!   doesn't turn doesn't count as its queue;
//! - a lane that waits for its token on purpose: the caller leaves that time out of its lag.

use crate::model::{FixedText, MonotonicNs, SafetyMode, SafetyRules, TrafficClass};

/// A lag from source to shared memory beyond this is a difference between two hosts' clocks.
pub const MAX_SOURCE_LAG_MS: f64 = 10_000.0;

/// How long the least lag is remembered, once to twice.
const BASELINE_MS: u64 = 60_000;

/// Every process turns ten times a second. One that has not for so long hangs, is stopped or is gone, and a
/// full queue is no sign of overload then: it fills within 0.3 s, while a watchdog takes 2 s. To stop other
/// lanes, and in the end the restarted one, would only make the gap longer.
const STALLED_MS: u64 = 500;

/// The occupancy of a shorter queue says nothing: one sample under way would fill it.
const MIN_QUEUE: u64 = 8;

/// How much the source lag of one route has grown.
///
/// It is measured with the publisher's clock and ours, so that a constant part of it may be a difference
/// between clocks. What counts is how far it is above the least of the last one to two minutes. When a clock
/// steps, the new difference is the least after two minutes at most. A lag that is negative or beyond
/// [`MAX_SOURCE_LAG_MS`] is such a difference for sure and is not looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SourceLag {
    since: MonotonicNs,
    least_ms: Option<f64>,
    least_before_ms: Option<f64>,
}

impl SourceLag {
    /// A route that was never measured.
    pub const fn new() -> Self {
        Self { since: MonotonicNs(0), least_ms: None, least_before_ms: None }
    }

    /// Takes in the p99 of one evaluation, as `LatencyHistogram` gives it, and says how much of it is lag of
    /// ours; `None` for a difference between clocks.
    pub fn excess_ms(&mut self, p99_ms: f64, now: MonotonicNs) -> Option<f64> {
        if !(0.0..=MAX_SOURCE_LAG_MS).contains(&p99_ms) {
            return None;
        }
        let elapsed_ns = now.since(self.since);
        if elapsed_ns > BASELINE_MS * 1_000_000 {
            let recent = elapsed_ns <= 2 * BASELINE_MS * 1_000_000;
            self.least_before_ms = if recent { self.least_ms } else { None };
            self.least_ms = None;
            self.since = now;
        }
        let least_ms = self.least_ms.map_or(p99_ms, |least_ms| least_ms.min(p99_ms));
        self.least_ms = Some(least_ms);
        let least_ms = self.least_before_ms.map_or(least_ms, |before_ms| before_ms.min(least_ms));
        // The histogram rounds up by a sixteenth at most: of a large difference that is a lot.
        Some((p99_ms - least_ms - p99_ms / 16.0).max(0.0))
    }
}

/// Errors of one process since the last evaluation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounts {
    /// Samples that the DDS library refused.
    pub write_failed: u64,
    /// Samples for which shared memory had no slot.
    pub pool_exhausted: u64,
    /// Samples overwritten before a critical lane took them. On a noncritical lane that is what a limited
    /// rate does, and not looked at.
    pub queue_overflow: u64,
    /// Starts of the process.
    pub restarts: u64,
}

/// One process of the data plane, as its counters show it. A process that never fed its health board, or that
/// said goodbye when it was told to shut down, is not there rather than silent: the caller leaves it out.
#[derive(Clone, Copy, Debug)]
pub struct ProcessLoad<'a> {
    /// Its name in logs and diagnostics: `ingress`, or the lane.
    pub name: &'a str,
    /// The class of its lane; ingress is on the critical path.
    pub class: TrafficClass,
    /// Since its data path last turned.
    pub silent_ms: u64,
    /// Since the last evaluation.
    pub errors: ErrorCounts,
    /// Samples that wait in shared memory for a critical lane, of the route where it is the largest share.
    pub queued: u64,
    /// For how many of those there is room; 0 where there is no such queue.
    pub queue_capacity: u64,
    /// Samples that wait in a noncritical lane, of the route where they are most.
    pub waiting: u64,
    /// Ingress: the largest [`SourceLag::excess_ms`] of all routes; `None` when nothing came.
    pub source_lag_ms: Option<f64>,
    /// p99 of the time from shared memory to the writer in this evaluation, without what a sample waited for
    /// its token and without samples caught up with after a restart; `None` when nothing was written.
    pub writer_lag_ms: Option<f64>,
}

impl<'a> ProcessLoad<'a> {
    /// A process that does nothing.
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

/// What one evaluation goes by.
#[derive(Clone, Copy, Debug)]
pub struct SafetyInputs<'a> {
    /// Every process of the data plane that is, or should be, there.
    pub processes: &'a [ProcessLoad<'a>],
}

/// What is wrong, with the number that decided and the threshold that it reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SafetyTrouble {
    /// A critical lane doesn't take its samples out of shared memory.
    Queue {
        /// Samples that wait.
        queued: u64,
        /// For how many there is room.
        capacity: u64,
    },
    /// Too many samples wait in a noncritical lane.
    Waiting {
        /// How many.
        samples: u64,
        /// `safety.max_noncritical_queue`.
        limit: u64,
    },
    /// Samples take long from their source to shared memory.
    SourceLag {
        /// p99, as far as it has grown.
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
    /// Samples are lost, or the process is started again and again.
    Errors {
        /// Errors per second.
        per_s: f64,
        /// The threshold.
        limit_per_s: f64,
    },
    /// The process doesn't turn.
    Silent {
        /// Since when.
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

/// What is wrong and who has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyCause {
    /// The name of the process.
    pub who: FixedText,
    /// Whether it is on the critical path.
    pub class: TrafficClass,
    /// What is wrong.
    pub trouble: SafetyTrouble,
    /// What it speaks for: DEGRADED or EMERGENCY.
    pub speaks_for: SafetyMode,
}

/// The outcome of one evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyDecision {
    /// The mode from now on.
    pub mode: SafetyMode,
    /// The former mode, when this evaluation changed it.
    pub changed_from: Option<SafetyMode>,
    /// The worst of this reading; of a clean one in a mode other than NORMAL, the last there was.
    pub cause: Option<SafetyCause>,
    /// Whether this reading was clean.
    pub clean: bool,
    /// Whether the critical path has had trouble of its own since NORMAL was left, other than of source lag.
    pub critical_trouble: bool,
}

/// The supervisor.
///
/// Up: `hysteresis_count` readings in a row that speak for DEGRADED or worse, and from there as many that
/// speak for EMERGENCY. Back: `recovery_count` readings in a row, below EMERGENCY for the step to DEGRADED
/// and clean for that to NORMAL. DEGRADED frees what the noncritical lanes used, so that the trouble may
/// return when they do; the longer way back keeps them from being switched on and off all the time.
#[derive(Clone, Copy, Debug, Default)]
pub struct SafetySupervisor {
    mode: SafetyMode,
    /// Readings in a row that speak for DEGRADED or worse.
    degraded_run: u32,
    /// Readings in a row that speak for EMERGENCY.
    emergency_run: u32,
    /// Readings in a row that speak for the way back.
    recovery_run: u32,
    /// Readings in a row in which the critical path itself has trouble.
    critical_run: u32,
    critical_trouble: bool,
    cause: Option<SafetyCause>,
    evaluated_at: Option<MonotonicNs>,
    transitions: u64,
}

impl SafetySupervisor {
    /// In NORMAL.
    pub const fn new() -> Self {
        Self {
            mode: SafetyMode::Normal,
            degraded_run: 0,
            emergency_run: 0,
            recovery_run: 0,
            critical_run: 0,
            critical_trouble: false,
            cause: None,
            evaluated_at: None,
            transitions: 0,
        }
    }

    /// The mode.
    pub const fn mode(&self) -> SafetyMode {
        self.mode
    }

    /// Changes of the mode so far.
    pub const fn transitions(&self) -> u64 {
        self.transitions
    }

    /// One evaluation. A caller that was stopped doesn't make up for those that it missed.
    pub fn evaluate(
        &mut self,
        inputs: &SafetyInputs<'_>,
        rules: &SafetyRules,
        now: MonotonicNs,
    ) -> SafetyDecision {
        // Nobody knows in what time the errors of the first reading came about.
        let elapsed_s = self.evaluated_at.map(|last| now.since(last) as f64 / 1e9);
        self.evaluated_at = Some(now);
        let reading = Reading::of(inputs, rules, elapsed_s.filter(|&elapsed_s| elapsed_s > 0.0));
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

fn count(run: &mut u32, goes_on: bool) {
    *run = if goes_on { run.saturating_add(1) } else { 0 };
}

/// What one evaluation sees.
#[derive(Default)]
struct Reading {
    worst: Option<SafetyCause>,
    /// Whether the critical path itself has trouble, other than of source lag.
    critical: bool,
}

impl Reading {
    fn of(inputs: &SafetyInputs<'_>, rules: &SafetyRules, elapsed_s: Option<f64>) -> Self {
        let mut reading = Self::default();
        for process in inputs.processes {
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
            // What waits for it, and what it had not done, is the same trouble once more.
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
            let ours = errors.queue_overflow.saturating_add(errors.pool_exhausted);
            let ours_per_s = ours as f64 / elapsed_s;
            let per_s =
                ours.saturating_add(errors.write_failed).saturating_add(errors.restarts) as f64 / elapsed_s;
            if ours_per_s >= rules.emergency_errors_per_s {
                let limit_per_s = rules.emergency_errors_per_s;
                self.add(process, SafetyTrouble::Errors { per_s: ours_per_s, limit_per_s }, true);
            } else if per_s >= rules.degraded_errors_per_s {
                let limit_per_s = rules.degraded_errors_per_s;
                self.add(process, SafetyTrouble::Errors { per_s, limit_per_s }, false);
            }
        }
    }

    /// DEGRADED suspends all noncritical lanes, so that what is wrong with one of them and harms nobody else,
    /// a reader that doesn't acknowledge, must not speak for it.
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
        // Its silence is an error a second: by default that suspends nobody.
        let per_s = counted_per_s + if is_silent { 1.0 } else { 0.0 };
        if per_s >= rules.degraded_errors_per_s {
            let limit_per_s = rules.degraded_errors_per_s;
            self.add(process, SafetyTrouble::Errors { per_s, limit_per_s }, false);
        }
    }

    /// Of two that speak for the same, that of the critical path counts, then the first.
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
            self.worst = Some(SafetyCause { who: FixedText::new(process.name), class, trouble, speaks_for });
        }
    }
}
