//! The class and mode of a lane, the state of a subscriber and the safety mode of the bridge.

use core::fmt;

use serde::{Deserialize, Serialize};

/// The class of a lane: which samples it forwards, and when. It does not set how the process is scheduled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum TrafficClass {
    /// Every sample, at the publisher's rate, RELIABLE by default.
    Critical,
    /// Rate-limited, the freshest first, BEST_EFFORT by default.
    Noncritical,
}

impl TrafficClass {
    /// `critical` or `noncritical`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Critical => "critical",
            Self::Noncritical => "noncritical",
        }
    }
}

impl fmt::Display for TrafficClass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// The mode of a lane: how much it forwards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum LaneMode {
    /// The configured rate; 10 Hz by default on a noncritical lane.
    #[default]
    Normal = 0,
    /// The reduced rate; 3 Hz by default. A critical lane behaves as in normal mode.
    Degraded = 1,
    /// A noncritical lane forwards nothing; a critical one behaves as in normal mode.
    Suspended = 2,
    /// Nothing is forwarded on any lane (emergency).
    Stopped = 3,
}

impl LaneMode {
    /// Every mode, mildest first.
    pub const ALL: [Self; 4] = [Self::Normal, Self::Degraded, Self::Suspended, Self::Stopped];

    /// The name that the command line and the configuration use.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Degraded => "degraded",
            Self::Suspended => "suspended",
            Self::Stopped => "stopped",
        }
    }

    /// The mode with that number in shared memory; `None` for an undefined number.
    #[inline]
    pub const fn from_u8(value: u8) -> Option<Self> {
        match value {
            0 => Some(Self::Normal),
            1 => Some(Self::Degraded),
            2 => Some(Self::Suspended),
            3 => Some(Self::Stopped),
            _ => None,
        }
    }
}

impl fmt::Display for LaneMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// The classifier's state of one subscriber.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[repr(u8)]
pub enum SubscriberState {
    /// Not enough probe data yet.
    #[default]
    Unknown = 0,
    /// Healthy.
    Critical = 1,
    /// Degraded.
    Noncritical = 2,
}

impl SubscriberState {
    /// `UNKNOWN`, `CRITICAL` or `NONCRITICAL`, as configuration files and diagnostics spell it.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Unknown => "UNKNOWN",
            Self::Critical => "CRITICAL",
            Self::Noncritical => "NONCRITICAL",
        }
    }
}

impl SubscriberState {
    /// The state with that number in shared memory; `None` for an undefined number.
    #[inline]
    pub const fn from_u8(value: u8) -> Option<Self> {
        match value {
            0 => Some(Self::Unknown),
            1 => Some(Self::Critical),
            2 => Some(Self::Noncritical),
            _ => None,
        }
    }
}

impl fmt::Display for SubscriberState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// The safety supervisor's mode of the whole bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum SafetyMode {
    /// No overload.
    #[default]
    Normal = 0,
    /// Overload is near: the noncritical lanes are suspended.
    Degraded = 1,
    /// Extreme failure: all forwarding is stopped and diagnostics are published.
    Emergency = 2,
}

impl SafetyMode {
    /// `normal`, `degraded` or `emergency`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Degraded => "degraded",
            Self::Emergency => "emergency",
        }
    }
}

impl SafetyMode {
    /// The mode with that number in shared memory; `None` for an undefined number.
    #[inline]
    pub const fn from_u8(value: u8) -> Option<Self> {
        match value {
            0 => Some(Self::Normal),
            1 => Some(Self::Degraded),
            2 => Some(Self::Emergency),
            _ => None,
        }
    }
}

impl fmt::Display for SafetyMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
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
}
