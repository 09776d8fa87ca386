//! What the control process shows of itself: plain records of fixed size, as in [`health`](super::health).

use super::health::FixedText;
use super::modes::{SafetyMode, SubscriberState};
use super::probe::RefusalCounts;
use super::sample::Guid;
use super::time::MonotonicNs;

/// Subscribers that are followed at once: listed ones first, then those that answer without being listed.
pub const MAX_SUBSCRIBERS: usize = 64;

/// Intruders that are shown at once; further ones are counted only.
pub const MAX_INTRUDERS: usize = 32;

/// What control has found and decided for the bridge as a whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ControlRecord {
    /// When the safety mode was entered; 0 while control never ran.
    pub safety_since: MonotonicNs,
    /// Changes of the safety mode since control came up.
    pub safety_transitions: u64,
    /// Places taken in the table of subscribers, from the first on.
    pub subscribers: u64,
    /// Places taken in the table of intruders, from the first on.
    pub intruders: u64,
    /// Intruders ever seen since control came up, those not shown included.
    pub intruders_seen: u64,
    /// Probes sent.
    pub probes_sent: u64,
    /// Responses that were taken for what they claim to be.
    pub responses_accepted: u64,
    /// Responses that were not, by reason.
    pub refused: RefusalCounts,
    /// The safety mode, as [`SafetyMode`]'s number.
    pub safety: u8,
    /// 1 while subscribers are classified.
    pub classifies: u8,
    /// 1 while nobody is probed because the secret of the probes cannot be had.
    pub without_secret: u8,
    /// Always 0.
    pub reserved: [u8; 5],
    /// What brought the safety mode about; empty in normal mode.
    pub safety_reason: FixedText,
}

impl ControlRecord {
    /// The safety mode; a number that is none reads as normal.
    pub fn safety(&self) -> SafetyMode {
        SafetyMode::from_u8(self.safety).unwrap_or_default()
    }
}

/// What control knows of one subscriber.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct SubscriberRecord {
    /// Its id; empty for a place that is free.
    pub id: FixedText,
    /// The number of its lane.
    pub lane: u64,
    /// When its state was entered.
    pub state_since: MonotonicNs,
    /// Changes of its state since control came up.
    pub transitions: u64,
    /// Probes in the window whose fate is known.
    pub settled: u64,
    /// Of those, the ones without a response in time.
    pub lost: u64,
    /// Mean round trip within the window, in microseconds.
    pub rtt_mean_us: u64,
    /// 95th percentile of the round trips within the window, in microseconds.
    pub rtt_p95_us: u64,
    /// Jitter within the window, in microseconds.
    pub jitter_us: u64,
    /// When its last response came; 0 for never.
    pub last_response_at: MonotonicNs,
    /// Its state, as [`SubscriberState`]'s number.
    pub state: u8,
    /// 1 when the configuration forces the state.
    pub forced: u8,
    /// 1 when the configuration lists the subscriber.
    pub listed: u8,
    /// The figures that are above their warning threshold, as [`SubscriberWarning`]'s bits.
    pub warnings: u8,
    /// Always 0.
    pub reserved: [u8; 4],
    /// Why it is in its state.
    pub reason: FixedText,
}

impl SubscriberRecord {
    /// Its state; a number that is none reads as unknown.
    pub fn state(&self) -> SubscriberState {
        SubscriberState::from_u8(self.state).unwrap_or_default()
    }

    /// The figures that are above their warning threshold.
    pub fn warnings(&self) -> impl Iterator<Item = SubscriberWarning> {
        let bits = self.warnings;
        SubscriberWarning::ALL.into_iter().filter(move |&warning| bits & warning as u8 != 0)
    }

    /// Share of the settled probes that were lost, 0 to 1; `None` when none is settled.
    pub fn loss(&self) -> Option<f64> {
        (self.settled > 0).then(|| (self.lost as f64 / self.settled as f64).min(1.0))
    }
}

/// A figure of a subscriber that may be above the warning threshold which the configuration sets for it
/// (`probes.*_threshold`). A warning decides nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum SubscriberWarning {
    /// The mean round trip.
    Rtt = 1,
    /// The share of probes lost.
    Loss = 2,
    /// The jitter.
    Jitter = 4,
}

impl SubscriberWarning {
    /// Every warning.
    pub const ALL: [Self; 3] = [Self::Rtt, Self::Loss, Self::Jitter];

    /// `rtt`, `loss` or `jitter`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Rtt => "rtt",
            Self::Loss => "loss",
            Self::Jitter => "jitter",
        }
    }
}

/// A remote reader that reaches past the bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct IntruderRecord {
    /// The ROS 2 topic that it reads.
    pub topic: FixedText,
    /// Its ROS 2 node; empty when it has not said.
    pub node: FixedText,
    /// The addresses of its host.
    pub host: FixedText,
    /// What to do about it.
    pub remedy: FixedText,
    /// When it was first seen.
    pub since: MonotonicNs,
}

/// Interfaces and peers that are shown as away, or as back, at once; those that are away come first.
pub const MAX_ABSENCES: usize = 32;

/// What is or was away.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum AbsenceKind {
    /// A network interface of this host.
    #[default]
    Interface = 0,
    /// A participant on another host.
    Peer = 1,
}

impl AbsenceKind {
    /// `interface` or `peer`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Interface => "interface",
            Self::Peer => "peer",
        }
    }
}

/// A network interface of this host, or a peer on another one, that was there and is or was away.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct AbsenceRecord {
    /// Since when it is away; 0 for a place that is free.
    pub since: MonotonicNs,
    /// When it came back; 0 while it is away.
    pub back_at: MonotonicNs,
    /// What it is, as [`AbsenceKind`]'s number.
    pub kind: u64,
    /// The interface as configured; or the peer's node, empty where it has none.
    pub name: FixedText,
    /// The address of the interface, or of the peer's host; empty where it is not known.
    pub host: FixedText,
    /// What the interface lacks; or what the peer subscribes to and publishes.
    pub detail: FixedText,
}

impl AbsenceRecord {
    /// What it is; a number that is none reads as a peer.
    pub fn kind(&self) -> AbsenceKind {
        if self.kind == AbsenceKind::Interface as u64 { AbsenceKind::Interface } else { AbsenceKind::Peer }
    }

    /// Whether it is away.
    pub fn is_away(&self) -> bool {
        self.since.0 != 0 && self.back_at.0 == 0
    }
}

/// Publishers of input topics and readers of outputs whose nodes control names.
pub const MAX_NAMED_ENDPOINTS: usize = 128;

/// The ROS 2 node that has a writer of an input topic or a reader of an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct NamedEndpoint {
    /// The writer or reader; all zero for none.
    pub endpoint: Guid,
    /// Its ROS 2 node; empty when the node has not announced itself.
    pub node: FixedText,
    /// The address of its host; empty when it is not known.
    pub host: FixedText,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_is_a_share_whatever_the_board_says() {
        let mut subscriber = SubscriberRecord::default();
        assert_eq!(subscriber.loss(), None);
        (subscriber.settled, subscriber.lost) = (50, 1);
        assert_eq!(subscriber.loss(), Some(0.02));
        subscriber.lost = u64::MAX;
        assert_eq!(subscriber.loss(), Some(1.0));
    }
}
