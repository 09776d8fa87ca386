//! Valid ids in probe messages, and the reasons for which a probe message is refused.

use super::counts::{Counts, reasons};

/// The longest id of a sender, a responder or a probe, in bytes.
pub const MAX_ID_BYTES: usize = 127;

/// Whether a text may be such an id: 1 to [`MAX_ID_BYTES`] bytes without control characters.
pub fn is_probe_id(text: &str) -> bool {
    (1..=MAX_ID_BYTES).contains(&text.len()) && !text.chars().any(char::is_control)
}

reasons! {
    /// Why a probe message was refused. A refused message is counted and has no other effect.
    ProbeRefusal:
    /// Not a `std_msgs/String` with the JSON that the protocol defines.
    Malformed = "malformed", "not a probe message; something else publishes on the topic",
    Oversized = "oversized", "larger than 4 KiB; something else publishes on the topic",
    UnsupportedVersion = "unsupported_version", "not version 1 of the protocol; update the older side",
    Unsigned = "unsigned", "carries no nonce and hmac; give its sender the secret (security.enable_probe_hmac)",
    BadSignature = "bad_signature", "signed with another secret, or changed in transit",
    Expired = "expired", "its time is off by more than replay_window_ms; are the clocks synchronized?",
    Replayed = "replayed", "received before; a program on the network repeats recorded messages",
    Unsolicited = "unsolicited", "answers no probe of this bridge",
    Late = "late", "arrived after timeout_ms, when its probe had been counted as lost",
    RateLimited = "rate_limited", "more than max_probe_rate_hz of one sender, or too many senders",
    TooManySubscribers = "too_many_subscribers", "more responders than the bridge follows",
    NotTheSubscriber = "not_the_subscriber", "not the responder that classifier.subscriber_id names",
}

/// Counts of refused probe messages by reason.
pub type RefusalCounts = Counts<ProbeRefusal, { ProbeRefusal::COUNT }>;

#[cfg(test)]
mod tests {
    use super::*;

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
