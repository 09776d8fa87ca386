//! The class and mode of a lane, the state of a subscriber, the QoS policy for which one does not match, and
//! the safety mode of the bridge.

use serde::{Deserialize, Serialize};

/// Declares an enum whose values have labels, and numbers in shared memory.
macro_rules! numbered {
    ($(#[$attribute:meta])* $name:ident:
     $($(#[$of_variant:meta])+ $variant:ident = $number:literal, $label:literal,)+) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[repr(u8)]
        pub enum $name {
            $($(#[$of_variant])+ $variant = $number,)+
        }

        impl $name {
            /// Every value, in the order of the numbers.
            pub const ALL: [Self; [$($number,)+].len()] = [$(Self::$variant,)+];

            /// The label on the command line, in the configuration, `status` and diagnostics.
            pub const fn label(self) -> &'static str {
                match self {
                    $(Self::$variant => $label,)+
                }
            }

            /// The value with that number in shared memory; `None` for an undefined number.
            #[inline]
            pub const fn from_u8(number: u8) -> Option<Self> {
                match number {
                    $($number => Some(Self::$variant),)+
                    _ => None,
                }
            }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                f.write_str(self.label())
            }
        }
    };
}
pub(super) use numbered;

numbered! {
    /// The class of a lane: which samples it forwards, and when; not how its process is scheduled.
    #[derive(Serialize, Deserialize)]
    TrafficClass:
    /// Every sample, at the publisher's rate, RELIABLE by default.
    Critical = 0, "critical",
    /// Rate-limited, the freshest first, with a short history by default.
    Noncritical = 1, "noncritical",
}

numbered! {
    /// The mode of a lane: how much it forwards.
    #[derive(Default)]
    LaneMode:
    /// The configured rate; 10 Hz by default on a noncritical lane.
    #[default]
    Normal = 0, "normal",
    /// The reduced rate; 3 Hz by default. A critical lane behaves as in normal mode.
    Degraded = 1, "degraded",
    /// A noncritical lane forwards nothing; a critical one behaves as in normal mode.
    Suspended = 2, "suspended",
    /// Nothing is forwarded on any lane (emergency).
    Stopped = 3, "stopped",
}

numbered! {
    /// The reason of a lane's mode.
    ModeReason:
    /// No mode was ever set.
    Default = 0, "default",
    /// An operator has set the mode.
    ByHand = 1, "by_hand",
    /// The control process has set the mode, and its confirmation has not expired.
    Control = 2, "control",
    /// The safety supervisor requires this mode at least.
    Safety = 3, "safety",
    /// The control process has set the mode and no longer runs; the mode holds for `policy_hold_s`.
    Held = 4, "held",
    /// The control process has not confirmed its policy for `policy_hold_s`: the safe default.
    Expired = 5, "expired",
}

numbered! {
    /// The classifier's state of one subscriber.
    #[derive(Default, Serialize, Deserialize)]
    SubscriberState:
    /// Not enough probe data yet.
    #[default]
    Unknown = 0, "UNKNOWN",
    /// Healthy.
    Critical = 1, "CRITICAL",
    /// Degraded.
    Noncritical = 2, "NONCRITICAL",
}

numbered! {
    /// The QoS policy for which a reader does not match a writer (DDS 1.4 clause 2.2.3).
    #[derive(Default)]
    UnmatchedPolicy:
    /// None of the others.
    #[default]
    Other = 0, "QoS",
    /// RELIABILITY: the reader requests RELIABLE, the writer offers BEST_EFFORT.
    Reliability = 1, "RELIABILITY",
    /// DURABILITY: the reader requests TRANSIENT_LOCAL or more, the writer offers less.
    Durability = 2, "DURABILITY",
    /// DEADLINE: the reader requests a shorter period than the writer offers.
    Deadline = 3, "DEADLINE",
    /// LIVELINESS: the reader requests another kind or a shorter lease than the writer offers.
    Liveliness = 4, "LIVELINESS",
    /// OWNERSHIP: the kinds differ.
    Ownership = 5, "OWNERSHIP",
    /// PRESENTATION: the reader requests coherent or ordered access.
    Presentation = 6, "PRESENTATION",
    /// LATENCY_BUDGET: the reader requests a shorter delay.
    LatencyBudget = 7, "LATENCY_BUDGET",
    /// DESTINATION_ORDER: the reader requests the order of the source timestamps.
    DestinationOrder = 8, "DESTINATION_ORDER",
    /// DATA_REPRESENTATION: the reader does not accept that of the writer.
    DataRepresentation = 9, "DATA_REPRESENTATION",
}

numbered! {
    /// Why a standby has taken its role over.
    TakeOverCause:
    /// The active process has ended: it crashed or was killed.
    Ended = 1, "ended",
    /// A signal had stopped the active process, and the standby killed it.
    Stopped = 2, "stopped",
    /// The active process was asked to end, and handed the role over.
    HandedOver = 3, "handed_over",
    /// The active process made no progress, and the standby killed it.
    Hung = 4, "hung",
}

numbered! {
    /// The safety supervisor's mode of the whole bridge.
    #[derive(Default)]
    SafetyMode:
    /// No overload.
    #[default]
    Normal = 0, "normal",
    /// Overload is near: the noncritical lanes are suspended.
    Degraded = 1, "degraded",
    /// Extreme failure: all forwarding is stopped and diagnostics are published.
    Emergency = 2, "emergency",
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lane_mode_converts_to_its_number_and_back() {
        for mode in LaneMode::ALL {
            assert_eq!(LaneMode::from_u8(mode as u8), Some(mode));
        }
        assert_eq!(LaneMode::from_u8(4), None);
    }

    #[test]
    fn classes_are_shown_by_their_labels() {
        let labels = [TrafficClass::Critical, TrafficClass::Noncritical].map(|class| class.to_string());
        assert_eq!(labels, ["critical", "noncritical"]);
    }
}
