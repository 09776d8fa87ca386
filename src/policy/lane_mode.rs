//! The mode of a lane (paper, section III-D): the worst of its subscribers decides, and the safety mode goes
//! over it.

use crate::model::{LaneMode, SafetyMode, SafetyRules, SubscriberState, TrafficClass};

/// Why a lane has its mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneReason<'a> {
    /// A critical lane forwards every sample, whatever its subscribers' links are like.
    CriticalLane,
    /// Subscribers are not classified.
    ClassifierOff,
    /// Noncritical lanes may not be degraded (`safety.allow_noncritical_degrade`).
    DegradeForbidden,
    /// Nobody who could be degraded.
    NoSubscribers,
    /// No subscriber is NONCRITICAL.
    Healthy {
        /// Of how many.
        subscribers: usize,
        /// Of those, UNKNOWN: they count as healthy, because to take a healthy subscriber for a degraded one
        /// could cost it samples, and the reverse only costs bandwidth.
        unknown: usize,
    },
    /// A subscriber is NONCRITICAL.
    Subscriber {
        /// Which; the first, if there are several.
        worst: &'a str,
        /// How many are.
        impaired: usize,
    },
    /// The safety supervisor is in DEGRADED.
    SafetyDegraded,
    /// The safety supervisor is in EMERGENCY.
    SafetyEmergency,
}

impl LaneReason<'_> {
    /// A word for logs and diagnostics.
    pub const fn label(&self) -> &'static str {
        match self {
            Self::CriticalLane => "critical_lane",
            Self::ClassifierOff => "classifier_off",
            Self::DegradeForbidden => "degrade_forbidden",
            Self::NoSubscribers => "no_subscribers",
            Self::Healthy { .. } => "healthy",
            Self::Subscriber { .. } => "subscriber",
            Self::SafetyDegraded => "safety_degraded",
            Self::SafetyEmergency => "safety_emergency",
        }
    }
}

/// The mode of a lane, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneDecision<'a> {
    /// What the lane is told to do.
    pub mode: LaneMode,
    /// Why.
    pub reason: LaneReason<'a>,
}

/// The mode that the classifier gives a lane of that class. `subscribers` are those of the lane, by id and
/// state.
pub fn lane_mode<'a>(
    class: TrafficClass,
    classifier_enabled: bool,
    subscribers: impl IntoIterator<Item = (&'a str, SubscriberState)>,
    rules: &SafetyRules,
) -> LaneDecision<'a> {
    let normal = |reason| LaneDecision { mode: LaneMode::Normal, reason };
    if class == TrafficClass::Critical {
        return normal(LaneReason::CriticalLane);
    }
    if !classifier_enabled {
        return normal(LaneReason::ClassifierOff);
    }
    if !rules.allow_noncritical_degrade {
        return normal(LaneReason::DegradeForbidden);
    }
    let (mut count, mut unknown, mut impaired) = (0, 0, 0);
    let mut worst = None;
    for (id, state) in subscribers {
        count += 1;
        match state {
            SubscriberState::Critical => {}
            SubscriberState::Unknown => unknown += 1,
            SubscriberState::Noncritical => {
                impaired += 1;
                worst = worst.or(Some(id));
            }
        }
    }
    match worst {
        Some(worst) => {
            LaneDecision { mode: LaneMode::Degraded, reason: LaneReason::Subscriber { worst, impaired } }
        }
        None if count == 0 => normal(LaneReason::NoSubscribers),
        None => normal(LaneReason::Healthy { subscribers: count, unknown }),
    }
}

/// What a safety mode makes of a lane's mode (paper, section III-E): DEGRADED suspends the noncritical lanes,
/// EMERGENCY stops all. `critical_trouble` is [`SafetyDecision::critical_trouble`]: where the configuration
/// doesn't preserve the critical path, it is given up for its own trouble only.
///
/// [`SafetyDecision::critical_trouble`]: super::SafetyDecision::critical_trouble
pub const fn under_safety<'a>(
    decision: LaneDecision<'a>,
    class: TrafficClass,
    safety: SafetyMode,
    critical_trouble: bool,
    rules: &SafetyRules,
) -> LaneDecision<'a> {
    match (safety, class) {
        (SafetyMode::Emergency, _) => {
            LaneDecision { mode: LaneMode::Stopped, reason: LaneReason::SafetyEmergency }
        }
        (SafetyMode::Degraded, TrafficClass::Noncritical) if rules.allow_noncritical_degrade => {
            LaneDecision { mode: LaneMode::Suspended, reason: LaneReason::SafetyDegraded }
        }
        (SafetyMode::Degraded, TrafficClass::Critical)
            if critical_trouble && !rules.preserve_critical_path =>
        {
            LaneDecision { mode: LaneMode::Stopped, reason: LaneReason::SafetyDegraded }
        }
        _ => decision,
    }
}
