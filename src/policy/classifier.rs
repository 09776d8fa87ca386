//! The state of one subscriber: two sets of thresholds, and hysteresis (paper, section III-C).

use super::probe_window::LinkReading;
use crate::model::{ClassifierThresholds, MonotonicNs, SubscriberState};

/// Settled probes below which a reading says too little: 2 s of probes at 5 Hz. The loss thresholds are far
/// below what so few can resolve, but the paper's bias is to react to a single loss; what the minimum keeps
/// out are the first moments, when one slow answer is the whole mean. A window that holds fewer is enough
/// when it is full.
pub const MIN_SETTLED: usize = 10;

/// A subscriber that the configuration doesn't list is forgotten after so long a silence: a laptop that was
/// closed should not keep its lane degraded. A minute is longer than any fade or restart that it comes back
/// from, and until then silence is loss. A listed one stays, silent or not.
pub const FORGET_UNLISTED_MS: u64 = 60_000;

/// Why a subscriber changed its state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TransitionReason {
    /// Forced by hand.
    Override,
    /// So many consecutive readings beyond a threshold of demotion; this is the last.
    Demoted {
        /// The last of the readings.
        reading: LinkReading,
        /// Whether its loss is beyond the threshold.
        by_loss: bool,
        /// Whether its mean RTT is beyond the threshold.
        by_rtt: bool,
    },
    /// So many consecutive readings within both thresholds of promotion; this is the last.
    Promoted {
        /// The last of the readings.
        reading: LinkReading,
    },
    /// Subscribers are not classified any more.
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

/// A change of state, as it is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// The former state.
    pub from: SubscriberState,
    /// The new one.
    pub to: SubscriberState,
    /// What decided.
    pub reason: TransitionReason,
}

/// What one reading speaks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Demotion {
        by_loss: bool,
        by_rtt: bool,
    },
    Promotion,
    /// Between the thresholds, or too little data.
    Neither,
}

/// The classifier of one subscriber.
///
/// - UNKNOWN until there is enough data; the same crossings then lead to CRITICAL or to NONCRITICAL. A
///   subscriber never heard has no data and stays UNKNOWN, which lane modes count as healthy.
/// - A change takes `hysteresis_count` consecutive readings that cross; one in between resets the count.
/// - A state forced by hand goes before everything and applies at once. When it ends, the classifier goes on
///   from that state.
/// - Where UNKNOWN is not allowed it is shown, and counts, as CRITICAL.
///
/// One call of [`evaluate`](Self::evaluate) is one evaluation. A caller that was stopped doesn't make up for
/// the evaluations that it missed: they would all see the same reading.
#[derive(Clone, Copy, Debug, Default)]
pub struct SubscriberClassifier {
    state: SubscriberState,
    forced: bool,
    demotions: u32,
    promotions: u32,
    transitions: u64,
}

impl SubscriberClassifier {
    /// A new subscriber: UNKNOWN.
    pub const fn new() -> Self {
        Self { state: SubscriberState::Unknown, forced: false, demotions: 0, promotions: 0, transitions: 0 }
    }

    /// The state, as it is shown and treated.
    pub const fn state(&self, thresholds: &ClassifierThresholds) -> SubscriberState {
        match self.state {
            SubscriberState::Unknown if !thresholds.allow_unknown_state => SubscriberState::Critical,
            state => state,
        }
    }

    /// Whether the state is forced by hand, as of the last evaluation.
    pub const fn is_forced(&self) -> bool {
        self.forced
    }

    /// Changes of the shown state so far, those by hand included.
    pub const fn transitions(&self) -> u64 {
        self.transitions
    }

    /// One evaluation. `forced` is the state that is set by hand, if any.
    pub fn evaluate(
        &mut self,
        reading: &LinkReading,
        thresholds: &ClassifierThresholds,
        forced: Option<SubscriberState>,
    ) -> Option<Transition> {
        self.forced = forced.is_some();
        if let Some(forced) = forced {
            self.demotions = 0;
            self.promotions = 0;
            return self.change(forced, TransitionReason::Override, thresholds);
        }
        let needed = thresholds.hysteresis_count.max(1);
        match verdict(reading, thresholds) {
            Verdict::Demotion { by_loss, by_rtt } => {
                self.promotions = 0;
                self.demotions = self.demotions.saturating_add(1);
                if self.demotions < needed {
                    return None;
                }
                let reason = TransitionReason::Demoted { reading: *reading, by_loss, by_rtt };
                self.change(SubscriberState::Noncritical, reason, thresholds)
            }
            Verdict::Promotion => {
                self.demotions = 0;
                self.promotions = self.promotions.saturating_add(1);
                if self.promotions < needed {
                    return None;
                }
                let reason = TransitionReason::Promoted { reading: *reading };
                self.change(SubscriberState::Critical, reason, thresholds)
            }
            Verdict::Neither => {
                self.demotions = 0;
                self.promotions = 0;
                None
            }
        }
    }

    /// Nobody classifies this subscriber, and nothing is forced: whatever was found or forced before is no
    /// longer looked after, so that it is UNKNOWN again.
    pub fn unclassified(&mut self, thresholds: &ClassifierThresholds) -> Option<Transition> {
        self.forced = false;
        self.demotions = 0;
        self.promotions = 0;
        self.change(SubscriberState::Unknown, TransitionReason::Unclassified, thresholds)
    }

    /// `None` when nothing changes that is shown.
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

fn verdict(reading: &LinkReading, thresholds: &ClassifierThresholds) -> Verdict {
    let by_loss = reading.loss > thresholds.demote_loss;
    let by_rtt = reading.rtt_mean_ms.is_some_and(|rtt_ms| rtt_ms > thresholds.demote_rtt_ms);
    let is_quick = reading.rtt_mean_ms.is_some_and(|rtt_ms| rtt_ms < thresholds.promote_rtt_ms);
    if !is_sufficient(reading) {
        Verdict::Neither
    } else if by_loss || by_rtt {
        Verdict::Demotion { by_loss, by_rtt }
    } else if is_quick && reading.loss < thresholds.promote_loss {
        Verdict::Promotion
    } else {
        Verdict::Neither
    }
}

/// Whether a reading has enough data to say anything.
const fn is_sufficient(reading: &LinkReading) -> bool {
    reading.settled >= MIN_SETTLED || reading.full
}

/// Whether to forget a subscriber that the configuration doesn't list. One that was never heard is not there
/// to be forgotten: it becomes known with its first answer.
pub const fn is_forgotten(heard_at: MonotonicNs, now: MonotonicNs) -> bool {
    now.since(heard_at) > FORGET_UNLISTED_MS * 1_000_000
}
