//! The JSON messages of the original package: diagnostics and classifier decisions, each a `std_msgs/String`.
//!
//! Fields may be added; a reader should skip fields that it does not know.

use byteorder::LittleEndian;
use bytes::Bytes;
use serde::Serialize;

use super::report::Report;
use super::text::{printable, shortened};
use crate::model::{DdsType, SubscriberState, TypeHash, WallNs};

/// The DDS type of `std_msgs/String`.
pub const STRING_TYPE: DdsType = DdsType {
    name: "std_msgs::msg::dds_::String_",
    hash: TypeHash::from_hex(b"df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    has_keys: false,
};

/// The topic of the classifier's decisions, as in the original package.
pub const DECISION_TOPIC: &str = "/adaptive_bridge/classifier/state";

/// The version of these messages.
const VERSION: u32 = 1;

/// The longest id or reason in a decision, in bytes.
const MAX_TEXT_BYTES: usize = 256;

#[derive(Serialize)]
struct Message<'a, T> {
    v: u32,
    r#type: &'static str,
    #[serde(flatten)]
    body: &'a T,
}

/// The report as a message for `diagnostics.topic`: the JSON of `status --json`, with `v` and `type` added in
/// front. Its size grows with the number of routes and lanes.
pub fn diagnostics_json(report: &Report) -> Bytes {
    message("diagnostics", report)
}

/// The classifier's state of one subscriber. Control publishes it with each change and once a second.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Decision<'a> {
    /// The id of its responder.
    pub subscriber_id: &'a str,
    /// Its lane.
    pub lane: &'a str,
    /// Its state.
    #[serde(serialize_with = "state_label")]
    pub state: SubscriberState,
    /// The state before the last change; the same as `state` before the first change.
    #[serde(serialize_with = "state_label")]
    pub previous_state: SubscriberState,
    /// The reason of the state, as text for users.
    pub reason: &'a str,
    /// Mean round trip within the sliding window, in milliseconds; null when it has no response.
    pub rtt_ms: Option<f64>,
    /// Share of lost probes, 0 to 1; null while no probe has been answered or has timed out.
    pub loss: Option<f64>,
    /// The time of the decision, in nanoseconds since the Unix epoch.
    #[serde(rename = "time_ns")]
    pub time: WallNs,
}

impl Decision<'_> {
    /// The message for [`DECISION_TOPIC`]. Long texts are cut, so it has at most 2 KiB.
    pub fn payload(&self) -> Bytes {
        let short = |text: &str| shortened(&printable(text), MAX_TEXT_BYTES);
        let (subscriber_id, lane, reason) = (short(self.subscriber_id), short(self.lane), short(self.reason));
        message(
            "decision",
            &Decision { subscriber_id: &subscriber_id, lane: &lane, reason: &reason, ..self.clone() },
        )
    }
}

fn state_label<S: serde::Serializer>(state: &SubscriberState, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(state.label())
}

fn message(r#type: &'static str, body: &impl Serialize) -> Bytes {
    // Serializing numbers, strings and lists under string keys does not fail.
    string_message(&serde_json::to_string(&Message { v: VERSION, r#type, body }).unwrap_or_default())
}

/// Serializes a `std_msgs/String` in plain little-endian CDR, without the encapsulation header.
pub fn string_message(data: &str) -> Bytes {
    cdr(&data, data.len() + 5)
}

/// Serializes a message in plain little-endian CDR
/// ([`Encapsulation::CDR_LE`](crate::model::Encapsulation::CDR_LE)).
pub fn cdr(message: &impl Serialize, expected_bytes: usize) -> Bytes {
    // Writing to memory does not fail, and the messages contain only types that CDR supports.
    let bytes = cdr_encoding::to_vec_with_size_hint::<_, LittleEndian>(message, expected_bytes);
    Bytes::from(bytes.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::super::test_report::wide_report;
    use super::*;

    /// Parses the JSON in a `std_msgs/String`, decoded by hand after the definition of CDR.
    fn read(payload: &[u8]) -> Value {
        let length = u32::from_le_bytes(payload[..4].try_into().unwrap()) as usize;
        assert_eq!((payload.len(), payload[payload.len() - 1]), (4 + length, 0));
        serde_json::from_slice(&payload[4..payload.len() - 1]).unwrap()
    }

    #[test]
    fn a_string_is_its_length_its_bytes_and_a_zero() {
        assert_eq!(string_message("ab"), [3, 0, 0, 0, b'a', b'b', 0].as_slice());
        assert_eq!(string_message(""), [1, 0, 0, 0, 0].as_slice());
    }

    #[test]
    fn diagnostics_are_the_report_with_a_version_and_a_type() {
        let mut found = read(&diagnostics_json(&wide_report()));
        let head = found.as_object_mut().unwrap();
        assert_eq!(head.remove("v"), Some(json!(1)));
        assert_eq!(head.remove("type"), Some(json!("diagnostics")));
        assert_eq!(found, serde_json::to_value(wide_report()).unwrap());
    }

    #[test]
    fn a_decision_has_the_documented_fields() {
        let decision = Decision {
            subscriber_id: "laptop",
            lane: "noncritical",
            state: SubscriberState::Noncritical,
            previous_state: SubscriberState::Critical,
            reason: "RTT 81.2 ms above 50 ms, 3 times",
            rtt_ms: Some(81.25),
            loss: None,
            time: WallNs(1_763_000_000_123_456_789),
        };
        let expected = json!({
            "v": 1, "type": "decision", "subscriber_id": "laptop", "lane": "noncritical", "state": "NONCRITICAL",
            "previous_state": "CRITICAL", "reason": "RTT 81.2 ms above 50 ms, 3 times", "rtt_ms": 81.25,
            "loss": null, "time_ns": 1_763_000_000_123_456_789_u64
        });
        assert_eq!(read(&decision.payload()), expected);
    }

    #[test]
    fn a_decision_is_small_even_with_long_texts() {
        let long = "\"\\\n\u{1}é".repeat(10_000);
        let payload = Decision {
            subscriber_id: &long,
            lane: &long,
            state: SubscriberState::Unknown,
            previous_state: SubscriberState::Unknown,
            reason: &long,
            rtt_ms: Some(f64::NAN),
            loss: Some(f64::INFINITY),
            time: WallNs(u64::MAX),
        }
        .payload();
        assert!(payload.len() < 2_048, "{}", payload.len());
        let found = read(&payload);
        assert_eq!((&found["rtt_ms"], &found["time_ns"]), (&Value::Null, &json!(u64::MAX)));
        assert!(!found["reason"].as_str().unwrap().chars().any(char::is_control));
    }
}
