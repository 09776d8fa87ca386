//! Records that the control process writes to its board, of fixed size as in [`health`](super::health).

use serde::Serialize;

use super::health::FixedText;
use super::modes::{SafetyMode, SubscriberState, numbered};
use super::probe::RefusalCounts;
use super::sample::Guid;
use super::time::MonotonicNs;

/// The most subscribers that control follows at once: those that the configuration lists first, then others
/// that respond to probes.
pub const MAX_SUBSCRIBERS: usize = 64;

/// The most intruders on the board at once; further ones are only counted.
pub const MAX_INTRUDERS: usize = 32;

/// The requests to the parameter services.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct ParameterRequests {
    /// Answered, also those that were refused with a reason.
    pub answered: u64,
    /// Dropped: it is no request of the service.
    pub malformed: u64,
    /// Dropped: request or reply is larger than the bridge allows.
    pub too_large: u64,
    /// Dropped: beyond the rate of one participant.
    pub rate_limited: u64,
    /// Dropped: the participant has no reader for the reply.
    pub no_client: u64,
}

/// The state of the control process and its decisions for the whole bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ControlRecord {
    /// When the safety mode was entered; 0 when control has never run.
    pub safety_since: MonotonicNs,
    /// Changes of the safety mode since control started.
    pub safety_transitions: u64,
    /// Records in use at the start of the subscriber table.
    pub subscribers: u64,
    /// Records in use at the start of the intruder table.
    pub intruders: u64,
    /// Intruders seen since control started, including those not on the board.
    pub intruders_seen: u64,
    /// Probes sent.
    pub probes_sent: u64,
    /// Probe responses accepted.
    pub responses_accepted: u64,
    /// Probe responses refused, by reason.
    pub refused: RefusalCounts,
    /// Requests of ROS 2 nodes to the parameter services.
    pub parameter_requests: ParameterRequests,
    /// The safety mode, as [`SafetyMode`]'s number.
    pub safety: u8,
    /// 1 while subscribers are classified.
    pub classifies: u8,
    /// 1 while control sends no probes because it cannot read their secret.
    pub without_secret: u8,
    /// Always 0.
    pub reserved: [u8; 5],
    /// Why the bridge is in its safety mode; empty in normal mode.
    pub safety_reason: FixedText,
}

impl ControlRecord {
    /// The safety mode; an undefined number counts as normal.
    pub fn safety(&self) -> SafetyMode {
        SafetyMode::from_u8(self.safety).unwrap_or_default()
    }
}

/// The state and the probe figures of one subscriber.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct SubscriberRecord {
    /// Its id; empty for a free record.
    pub id: FixedText,
    /// The number of its lane.
    pub lane: u64,
    /// When its state was entered.
    pub state_since: MonotonicNs,
    /// Changes of its state since control started.
    pub transitions: u64,
    /// Probes in the window that were answered in time or lost.
    pub settled: u64,
    /// Of those, the lost ones: without a response in time.
    pub lost: u64,
    /// Mean round trip within the window, in microseconds.
    pub rtt_mean_us: u64,
    /// 95th percentile of the round trips within the window, in microseconds.
    pub rtt_p95_us: u64,
    /// Jitter within the window, in microseconds.
    pub jitter_us: u64,
    /// When its last response arrived; 0 for never.
    pub last_response_at: MonotonicNs,
    /// Its state, as [`SubscriberState`]'s number.
    pub state: u8,
    /// 1 when the configuration forces the state.
    pub forced: u8,
    /// 1 when the configuration lists the subscriber.
    pub listed: u8,
    /// The figures above their warning threshold, as [`SubscriberWarning`]'s bits.
    pub warnings: u8,
    /// Always 0.
    pub reserved: [u8; 4],
    /// Why it is in its state.
    pub reason: FixedText,
}

impl SubscriberRecord {
    /// Its state; an undefined number counts as unknown.
    pub fn state(&self) -> SubscriberState {
        SubscriberState::from_u8(self.state).unwrap_or_default()
    }

    /// The figures above their warning threshold.
    pub fn warnings(&self) -> impl Iterator<Item = SubscriberWarning> {
        let bits = self.warnings;
        SubscriberWarning::ALL.into_iter().filter(move |&warning| bits & warning as u8 != 0)
    }

    /// Share of the settled probes that were lost, 0 to 1; `None` when none is settled.
    pub fn loss(&self) -> Option<f64> {
        (self.settled > 0).then(|| (self.lost as f64 / self.settled as f64).min(1.0))
    }
}

numbered! {
    /// A figure of a subscriber above its configured warning threshold (`probes.*_threshold`). A warning has
    /// no influence on any mode.
    SubscriberWarning:
    /// The mean round trip.
    Rtt = 1, "rtt",
    /// The share of probes lost.
    Loss = 2, "loss",
    /// The jitter.
    Jitter = 4, "jitter",
}

/// A remote subscriber that bypasses the bridge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct IntruderRecord {
    /// The ROS 2 topic that it reads.
    pub topic: FixedText,
    /// Its ROS 2 node; empty when the node has not announced itself.
    pub node: FixedText,
    /// The addresses of its host.
    pub host: FixedText,
    /// What the user can do about it.
    pub remedy: FixedText,
    /// When it was first seen.
    pub since: MonotonicNs,
}

/// The most absences on the board at once; those of interfaces and peers that are still away come first.
pub const MAX_ABSENCES: usize = 32;

numbered! {
    /// What an absence is of: a network interface or a peer.
    #[derive(Default)]
    AbsenceKind:
    /// A network interface of this host.
    #[default]
    Interface = 0, "interface",
    /// A participant on another host.
    Peer = 1, "peer",
}

/// The absence of a network interface of this host or of a peer on another host, current or past.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct AbsenceRecord {
    /// When the absence began; 0 for a free record.
    pub since: MonotonicNs,
    /// When the interface or peer came back; 0 while it is away.
    pub back_at: MonotonicNs,
    /// Whether it is an interface or a peer, as [`AbsenceKind`]'s number.
    pub kind: u64,
    /// The interface as configured, or the peer's node; empty for a peer without one.
    pub name: FixedText,
    /// The address of the interface or of the peer's host; empty when it is not known.
    pub host: FixedText,
    /// What the interface lacks, or what the peer subscribes to and publishes.
    pub detail: FixedText,
}

impl AbsenceRecord {
    /// Whether it is an interface or a peer; an undefined number counts as a peer.
    pub fn kind(&self) -> AbsenceKind {
        if self.kind == AbsenceKind::Interface as u64 { AbsenceKind::Interface } else { AbsenceKind::Peer }
    }

    /// Whether the interface or peer is away at present.
    pub fn is_away(&self) -> bool {
        self.since.0 != 0 && self.back_at.0 == 0
    }
}

/// The most publishers of input topics and readers of outputs whose nodes control records.
pub const MAX_NAMED_ENDPOINTS: usize = 128;

/// The ROS 2 node of one writer of an input topic or one reader of an output.
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
    fn loss_is_at_most_1_even_for_inconsistent_counts() {
        let mut subscriber = SubscriberRecord::default();
        assert_eq!(subscriber.loss(), None);
        (subscriber.settled, subscriber.lost) = (50, 1);
        assert_eq!(subscriber.loss(), Some(0.02));
        subscriber.lost = u64::MAX;
        assert_eq!(subscriber.loss(), Some(1.0));
    }

    #[test]
    fn numbers_of_the_boards_are_read_as_modes_states_and_kinds() {
        let mut control = ControlRecord { safety: SafetyMode::Emergency as u8, ..Default::default() };
        assert_eq!(control.safety(), SafetyMode::Emergency);
        control.safety = 200;
        assert_eq!(control.safety(), SafetyMode::Normal, "an undefined number");
        let state = SubscriberState::Noncritical;
        let mut subscriber = SubscriberRecord { state: state as u8, ..Default::default() };
        assert_eq!(subscriber.state(), state);
        subscriber.state = 200;
        assert_eq!(subscriber.state(), SubscriberState::Unknown, "an undefined number");
        let mut absence = AbsenceRecord::default();
        for (number, kind) in [(0, AbsenceKind::Interface), (1, AbsenceKind::Peer), (2, AbsenceKind::Peer)] {
            absence.kind = number;
            assert_eq!(absence.kind(), kind, "{number}");
        }
    }

    #[test]
    fn warnings_are_the_bits_of_the_record() {
        let mut subscriber = SubscriberRecord::default();
        assert_eq!(subscriber.warnings().count(), 0);
        subscriber.warnings = 0b101;
        let labels: Vec<_> = subscriber.warnings().map(SubscriberWarning::label).collect();
        assert_eq!(labels, ["rtt", "jitter"]);
        assert_eq!(SubscriberWarning::Loss.label(), "loss");
    }

    #[test]
    fn an_absence_lasts_from_its_beginning_until_the_peer_is_back() {
        let mut absence = AbsenceRecord::default();
        assert!(!absence.is_away(), "a free record");
        absence.since = MonotonicNs(1);
        assert!(absence.is_away());
        absence.back_at = MonotonicNs(2);
        assert!(!absence.is_away());
        assert_eq!((AbsenceKind::Interface.label(), AbsenceKind::Peer.label()), ("interface", "peer"));
    }
}
