//! The classifier of one subscriber: two sets of thresholds, and hysteresis (paper, section III-C).

use super::probe_window::LinkReading;
use crate::model::{ClassifierThresholds, MonotonicNs, SubscriberState};

/// The settled probes that a reading needs: 2 s of probes at 5 Hz. So few probes cannot resolve the loss
/// thresholds, but the paper's policy is to react to a single loss; the minimum excludes the first moments,
/// when a single slow response is the whole mean. A window of fewer probes is sufficient when it is full.
pub const MIN_SETTLED: usize = 10;

/// The silence after which control removes a subscriber that the configuration does not list, so that a
/// laptop that was closed does not keep its lane degraded. A minute is longer than a fade of the link or a
/// restart of the subscriber takes; until then, unanswered probes count as lost. A listed subscriber is never
/// removed.
pub const FORGET_UNLISTED_MS: u64 = 60_000;

/// Why the state of a subscriber changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TransitionReason {
    /// The configuration forces the state.
    Override,
    /// `hysteresis_count` consecutive readings were beyond a threshold of demotion.
    Demoted {
        /// The last of the readings.
        reading: LinkReading,
        /// Whether its loss is beyond the threshold.
        by_loss: bool,
        /// Whether its mean RTT is beyond the threshold.
        by_rtt: bool,
    },
    /// `hysteresis_count` consecutive readings were within both thresholds of promotion.
    Promoted {
        /// The last of the readings.
        reading: LinkReading,
    },
    /// The classifier was turned off.
    Unclassified,
}

impl TransitionReason {
    /// `override`, `loss`, `rtt`, `loss_and_rtt`, `recovered` or `unclassified`.
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Override => "override",
            Self::Demoted { by_loss: true, by_rtt: true, .. } => "loss_and_rtt",
            Self::Demoted { by_rtt: true, .. } => "rtt",
            Self::Demoted { .. } => "loss",
            Self::Promoted { .. } => "recovered",
            Self::Unclassified => "unclassified",
        }
    }
}

/// A change of a subscriber's state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// The former state.
    pub from: SubscriberState,
    /// The new one.
    pub to: SubscriberState,
    /// Why it changed.
    pub reason: TransitionReason,
}

/// The classifier of one subscriber.
///
/// - The state is UNKNOWN until there is enough data; then the same thresholds lead to CRITICAL or
///   NONCRITICAL. A subscriber that never responded has no data and stays UNKNOWN, which lane modes count as
///   healthy.
/// - A change requires `hysteresis_count` consecutive readings beyond the thresholds; any other reading
///   resets the count.
/// - A forced state takes precedence over readings and applies immediately. When it ends, the classifier
///   continues from that state.
/// - Where UNKNOWN is not allowed, it is shown and treated as CRITICAL.
///
/// One call of [`evaluate`](Self::evaluate) is one evaluation. A caller that was stopped does not repeat
/// missed evaluations: they would all use the same reading.
#[derive(Clone, Copy, Debug, Default)]
pub struct SubscriberClassifier {
    state: SubscriberState,
    forced: bool,
    demotions: u32,
    promotions: u32,
    transitions: u64,
}

impl SubscriberClassifier {
    /// The state as shown and treated: CRITICAL instead of UNKNOWN where UNKNOWN is not allowed.
    pub const fn state(&self, thresholds: &ClassifierThresholds) -> SubscriberState {
        match self.state {
            SubscriberState::Unknown if !thresholds.allow_unknown_state => SubscriberState::Critical,
            state => state,
        }
    }

    /// Whether the state was forced at the last evaluation.
    pub const fn is_forced(&self) -> bool {
        self.forced
    }

    /// Changes of the shown state so far, including those to a forced state.
    pub const fn transitions(&self) -> u64 {
        self.transitions
    }

    /// Evaluates one reading. `forced` is the state that the configuration forces, if any.
    pub fn evaluate(
        &mut self,
        reading: &LinkReading,
        thresholds: &ClassifierThresholds,
        forced: Option<SubscriberState>,
    ) -> Option<Transition> {
        self.forced = forced.is_some();
        if let Some(forced) = forced {
            (self.demotions, self.promotions) = (0, 0);
            return self.change(forced, TransitionReason::Override, thresholds);
        }
        let is_sufficient = reading.settled >= MIN_SETTLED || reading.full;
        let by_loss = reading.loss > thresholds.demote_loss;
        let by_rtt = reading.rtt_mean_ms.is_some_and(|rtt_ms| rtt_ms > thresholds.demote_rtt_ms);
        let is_quick = reading.rtt_mean_ms.is_some_and(|rtt_ms| rtt_ms < thresholds.promote_rtt_ms);
        let demotes = is_sufficient && (by_loss || by_rtt);
        let promotes = is_sufficient && !demotes && is_quick && reading.loss < thresholds.promote_loss;
        self.demotions = if demotes { self.demotions.saturating_add(1) } else { 0 };
        self.promotions = if promotes { self.promotions.saturating_add(1) } else { 0 };
        let needed = thresholds.hysteresis_count.max(1);
        if self.demotions >= needed {
            let reason = TransitionReason::Demoted { reading: *reading, by_loss, by_rtt };
            self.change(SubscriberState::Noncritical, reason, thresholds)
        } else if self.promotions >= needed {
            let reason = TransitionReason::Promoted { reading: *reading };
            self.change(SubscriberState::Critical, reason, thresholds)
        } else {
            None
        }
    }

    /// Resets the state to UNKNOWN: the classifier is off, and the last state would become outdated.
    pub fn unclassified(&mut self, thresholds: &ClassifierThresholds) -> Option<Transition> {
        self.forced = false;
        (self.demotions, self.promotions) = (0, 0);
        self.change(SubscriberState::Unknown, TransitionReason::Unclassified, thresholds)
    }

    /// Changes the state; `None` when the shown state stays the same.
    fn change(
        &mut self,
        to: SubscriberState,
        reason: TransitionReason,
        thresholds: &ClassifierThresholds,
    ) -> Option<Transition> {
        let from = self.state(thresholds);
        self.state = to;
        let to = self.state(thresholds);
        if from == to {
            return None;
        }
        self.transitions += 1;
        Some(Transition { from, to, reason })
    }
}

/// Whether to remove a subscriber that the configuration does not list; `last_response_at` is its last
/// response. Such a subscriber becomes known with its first response, so that there always is one.
pub const fn is_forgotten(last_response_at: MonotonicNs, now: MonotonicNs) -> bool {
    now.since(last_response_at) > FORGET_UNLISTED_MS * 1_000_000
}
