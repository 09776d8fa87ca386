//! Valid ids in probe messages, and the reasons for which a probe message is refused.

use core::fmt;

/// The longest id of a sender, a responder or a probe, in bytes.
pub const MAX_ID_BYTES: usize = 127;

/// Whether a text may be the id of a sender, a responder or a probe: 1 to [`MAX_ID_BYTES`] bytes without
/// control characters.
pub fn is_probe_id(text: &str) -> bool {
    (1..=MAX_ID_BYTES).contains(&text.len()) && !text.chars().any(char::is_control)
}

macro_rules! probe_refusals {
    ($($(#[doc = $doc:literal])+ $variant:ident = $label:literal, $meaning:literal,)+) => {
        /// Why a probe request or a probe response was refused. A refused message is counted and has no other
        /// effect.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(u8)]
        pub enum ProbeRefusal {
            $($(#[doc = $doc])+ $variant,)+
        }

        impl ProbeRefusal {
            /// Every reason, in the order of its index.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)+];

            /// The number of reasons.
            pub const COUNT: usize = Self::ALL.len();

            /// The label in logs, `status` and metrics.
            pub const fn label(self) -> &'static str {
                match self {
                    $(Self::$variant => $label,)+
                }
            }

            /// A text for users: what was wrong and, where there is one, the remedy.
            pub const fn meaning(self) -> &'static str {
                match self {
                    $(Self::$variant => $meaning,)+
                }
            }
        }
    };
}

probe_refusals! {
    /// Not a `std_msgs/String` with the JSON that the protocol defines.
    Malformed = "malformed", "not a probe message; something else publishes on the topic",
    /// Larger than a probe message may be.
    Oversized = "oversized", "larger than 4 KiB; something else publishes on the topic",
    /// Of another version of the protocol.
    UnsupportedVersion = "unsupported_version", "not version 1 of the protocol; update the older side",
    /// Without a signature where one is required.
    Unsigned = "unsigned", "carries no nonce and hmac; give its sender the secret (security.enable_probe_hmac)",
    /// The signature is not that of the shared secret.
    BadSignature = "bad_signature", "signed with another secret, or changed in transit",
    /// Signed, and its time is too far in the past or in the future.
    Expired = "expired", "its time is off by more than replay_window_ms; are the clocks synchronized?",
    /// Signed, and received before.
    Replayed = "replayed", "received before; a program on the network repeats recorded messages",
    /// A response to a probe that this bridge did not send.
    Unsolicited = "unsolicited", "answers no probe of this bridge",
    /// A response to a probe that timed out.
    Late = "late", "arrived after timeout_ms, when its probe had been counted as lost",
    /// More messages of one sender than `max_probe_rate_hz`, or more senders than the process tracks.
    RateLimited = "rate_limited", "more than max_probe_rate_hz of one sender, or too many senders",
    /// A response of a responder beyond the largest number that control follows.
    TooManySubscribers = "too_many_subscribers", "more responders than the bridge follows",
    /// A response of a responder other than `classifier.subscriber_id`.
    NotTheSubscriber = "not_the_subscriber", "not the responder that classifier.subscriber_id names",
}

impl fmt::Display for ProbeRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.label())
    }
}

/// Counts of refused probe messages by reason. Sums saturate: the counts may come from shared memory, where
/// any process of the same user could have written any number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct RefusalCounts([u64; ProbeRefusal::COUNT]);

impl RefusalCounts {
    /// Counts one more refusal for `reason`.
    pub fn add(&mut self, reason: ProbeRefusal) {
        let count = &mut self.0[reason as usize];
        *count = count.saturating_add(1);
    }

    /// Refusals for `reason`.
    pub const fn get(&self, reason: ProbeRefusal) -> u64 {
        self.0[reason as usize]
    }

    /// Adds the counts of `other`.
    pub fn merge(&mut self, other: &Self) {
        for (count, more) in self.0.iter_mut().zip(other.0) {
            *count = count.saturating_add(more);
        }
    }

    /// Refusals for all reasons together.
    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |total, count| total.saturating_add(*count))
    }

    /// The refusals since `earlier`, an earlier reading of the same counts.
    pub fn since(&self, earlier: &Self) -> Self {
        let mut difference = *self;
        for (count, before) in difference.0.iter_mut().zip(earlier.0.iter()) {
            *count = count.saturating_sub(*before);
        }
        difference
    }

    /// The reasons that occurred, with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (ProbeRefusal, u64)> + '_ {
        ProbeRefusal::ALL.iter().map(|&reason| (reason, self.get(reason))).filter(|&(_, n)| n > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_its_own_index_and_label() {
        for (index, reason) in ProbeRefusal::ALL.iter().enumerate() {
            assert_eq!(*reason as usize, index);
            let same = ProbeRefusal::ALL.iter().filter(|other| other.label() == reason.label());
            assert_eq!(same.count(), 1, "{reason}");
        }
    }

    #[test]
    fn counts_are_summed_by_reason_and_never_overflow() {
        let mut counts = RefusalCounts::default();
        counts.add(ProbeRefusal::Late);
        counts.add(ProbeRefusal::Malformed);
        counts.add(ProbeRefusal::Late);
        assert_eq!((counts.get(ProbeRefusal::Late), counts.total()), (2, 3));
        let listed: Vec<_> = counts.iter().collect();
        assert_eq!(listed, [(ProbeRefusal::Malformed, 1), (ProbeRefusal::Late, 2)]);
        let mut full = RefusalCounts([u64::MAX; ProbeRefusal::COUNT]);
        full.add(ProbeRefusal::Late);
        assert_eq!(full.total(), u64::MAX);
    }

    #[test]
    fn an_id_is_short_and_printable() {
        for id in ["a", "robot 7/laptop", "Läptop", &"x".repeat(MAX_ID_BYTES)] {
            assert!(is_probe_id(id), "{id:?}");
        }
        for id in ["", "a\nb", "a\0", "\u{85}", &"x".repeat(MAX_ID_BYTES + 1)] {
            assert!(!is_probe_id(id), "{id:?}");
        }
    }
}
