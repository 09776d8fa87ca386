//! Decides the mode of a lane by its worst subscriber (paper, section III-D), and the safety mode's floor.

use crate::model::{LaneMode, SafetyMode, SafetyRules, SubscriberState, TrafficClass};

/// Why a lane has its mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneReason<'a> {
    /// A critical lane forwards every sample, regardless of its subscribers' links.
    CriticalLane,
    /// Subscribers are not classified.
    ClassifierOff,
    /// Noncritical lanes may not be degraded (`safety.allow_noncritical_degrade`).
    DegradeForbidden,
    /// The lane has no subscribers.
    NoSubscribers,
    /// No subscriber is NONCRITICAL.
    Healthy {
        /// Subscribers of the lane.
        subscribers: usize,
        /// Of those, the UNKNOWN ones. They count as healthy: treating a healthy subscriber as degraded could
        /// cost it samples, and the reverse only costs bandwidth.
        unknown: usize,
    },
    /// At least one subscriber is NONCRITICAL.
    Subscriber {
        /// The id of the first such subscriber.
        worst: &'a str,
        /// The number of such subscribers.
        impaired: usize,
    },
}

impl LaneReason<'_> {
    /// The label in logs and diagnostics.
    pub const fn label(&self) -> &'static str {
        match self {
            Self::CriticalLane => "critical_lane",
            Self::ClassifierOff => "classifier_off",
            Self::DegradeForbidden => "degrade_forbidden",
            Self::NoSubscribers => "no_subscribers",
            Self::Healthy { .. } => "healthy",
            Self::Subscriber { .. } => "subscriber",
        }
    }
}

/// The mode of a lane, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneDecision<'a> {
    /// The mode.
    pub mode: LaneMode,
    /// Why.
    pub reason: LaneReason<'a>,
}

/// The mode that control sets for a lane; `subscribers` are the ids and states of its subscribers.
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

/// The mildest mode that a safety mode allows a lane (paper, section III-E): DEGRADED suspends the
/// noncritical lanes, EMERGENCY stops all. `critical_trouble` is [`SafetyDecision::critical_trouble`]: where
/// the configuration does not preserve the critical path, only its own trouble stops it in DEGRADED.
///
/// [`SafetyDecision::critical_trouble`]: super::SafetyDecision::critical_trouble
pub const fn safety_floor(
    class: TrafficClass,
    safety: SafetyMode,
    critical_trouble: bool,
    rules: &SafetyRules,
) -> LaneMode {
    match (safety, class) {
        (SafetyMode::Emergency, _) => LaneMode::Stopped,
        (SafetyMode::Degraded, TrafficClass::Noncritical) if rules.allow_noncritical_degrade => {
            LaneMode::Suspended
        }
        (SafetyMode::Degraded, TrafficClass::Critical)
            if critical_trouble && !rules.preserve_critical_path =>
        {
            LaneMode::Stopped
        }
        _ => LaneMode::Normal,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_have_the_labels_of_the_diagnostics() {
        let reasons = [
            LaneReason::CriticalLane,
            LaneReason::ClassifierOff,
            LaneReason::DegradeForbidden,
            LaneReason::NoSubscribers,
            LaneReason::Subscriber { worst: "laptop", impaired: 1 },
        ];
        let labels = ["critical_lane", "classifier_off", "degrade_forbidden", "no_subscribers", "subscriber"];
        assert_eq!(reasons.map(|reason| reason.label()), labels);
    }
}
