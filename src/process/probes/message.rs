//! Encoding of probe requests and responses: JSON in a `std_msgs/String`, with the fields of the original
//! package and, added by this one, `nonce` and `hmac`. Unknown fields are ignored, so that older and newer
//! versions work together.

use bytes::Bytes;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::model::{DdsType, Encapsulation, ProbeRefusal, WallNs, is_probe_id};
use crate::telemetry::{STRING_TYPE, string_message};

/// The DDS type of both topics.
pub const PROBE_TYPE: DdsType = STRING_TYPE;

/// The largest message that is decoded, in bytes of its serialized payload.
pub const MAX_MESSAGE_BYTES: usize = 4096;

/// The only version of the protocol.
const VERSION: u64 = 1;

/// The largest time or sequence number, so that every language can store them in a signed 64-bit integer.
const MAX_NUMBER: u64 = i64::MAX as u64;

/// Identifies a probe. This package sends text; a number, which the original package may send, is returned as
/// a number.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ProbeId {
    /// 1 to 127 bytes without control characters.
    Text(String),
    /// 0 to 2⁶³ - 1.
    Number(u64),
}

impl ProbeId {
    fn is_valid(&self) -> bool {
        match self {
            Self::Text(text) => is_probe_id(text),
            Self::Number(number) => *number <= MAX_NUMBER,
        }
    }
}

impl std::fmt::Display for ProbeId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Text(text) => f.write_str(text),
            Self::Number(number) => number.fmt(f),
        }
    }
}

/// Proves that the sender of a message has the secret and that the message is no replay.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Signature {
    /// Differs in every message.
    #[serde(serialize_with = "as_hex", deserialize_with = "from_hex_text")]
    pub nonce: [u8; 16],
    /// HMAC-SHA-256 of the message.
    #[serde(serialize_with = "as_hex", deserialize_with = "from_hex_text")]
    pub hmac: [u8; 32],
}

/// A probe request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProbeRequest {
    /// The sequence number of the probe, counted by its sender.
    pub seq: u64,
    /// When it was sent, in the sender's wall-clock time.
    #[serde(rename = "send_time_ns")]
    pub send_time: WallNs,
    /// The id of the bridge that sends it.
    pub sender_id: String,
    /// The id of the probe, which the response repeats.
    pub probe_id: ProbeId,
    /// `None` if it is unsigned or its signature is malformed.
    #[serde(flatten, skip_deserializing)]
    pub signature: Option<Signature>,
}

/// The response to a probe. Its times are the responder's wall-clock times.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProbeResponse {
    /// The sequence number in the request.
    pub seq: u64,
    /// The probe id in the request.
    pub probe_id: ProbeId,
    /// When the request was received.
    #[serde(rename = "recv_time_ns")]
    pub recv_time: WallNs,
    /// When the responder started the response.
    #[serde(rename = "reply_time_ns")]
    pub reply_time: WallNs,
    /// When the response was sent.
    #[serde(rename = "response_send_time_ns")]
    pub response_send_time: WallNs,
    /// The id of the responder.
    pub responder_id: String,
    /// `None` if it is unsigned or its signature is malformed.
    #[serde(flatten, skip_deserializing)]
    pub signature: Option<Signature>,
}

/// Only the version of a message: the other fields of an unsupported version are not checked.
#[derive(Deserialize)]
struct Version {
    v: u64,
}

impl ProbeRequest {
    /// Decodes a request from a sample's payload and encapsulation, without checking its signature.
    ///
    /// # Errors
    /// The message is oversized, malformed or of another version.
    pub fn decode(payload: &[u8], encapsulation: Encapsulation) -> Result<Self, ProbeRefusal> {
        let (request, signature): (Self, _) = parse(payload, encapsulation)?;
        let numbers = [request.seq, request.send_time.0];
        check(&numbers, &request.sender_id, &request.probe_id)?;
        Ok(Self { signature, ..request })
    }

    /// Encodes the message as the payload of a sample with encapsulation [`Encapsulation::CDR_LE`].
    pub fn encode(&self) -> Bytes {
        serialize(self)
    }
}

impl ProbeResponse {
    /// Decodes a response from a sample's payload and encapsulation, without checking its signature.
    ///
    /// # Errors
    /// The message is oversized, malformed or of another version.
    pub fn decode(payload: &[u8], encapsulation: Encapsulation) -> Result<Self, ProbeRefusal> {
        let (response, signature): (Self, _) = parse(payload, encapsulation)?;
        let [received, begun, sent] =
            [response.recv_time, response.reply_time, response.response_send_time].map(|time| time.0);
        check(&[response.seq, received, begun, sent], &response.responder_id, &response.probe_id)?;
        Ok(Self { signature, ..response })
    }

    /// Encodes the message as the payload of a sample with encapsulation [`Encapsulation::CDR_LE`].
    pub fn encode(&self) -> Bytes {
        serialize(self)
    }
}

/// Checks that no number of a message is too large, and that the ids of its sender and probe are valid.
fn check(numbers: &[u64], sender: &str, probe: &ProbeId) -> Result<(), ProbeRefusal> {
    let is_valid =
        numbers.iter().all(|number| *number <= MAX_NUMBER) && is_probe_id(sender) && probe.is_valid();
    if is_valid { Ok(()) } else { Err(ProbeRefusal::Malformed) }
}

/// Decodes a message and its signature. A malformed signature is treated as absent, so that a receiver that
/// checks no signatures accepts the message.
fn parse<'a, T: Deserialize<'a>>(
    payload: &'a [u8],
    encapsulation: Encapsulation,
) -> Result<(T, Option<Signature>), ProbeRefusal> {
    if payload.len() > MAX_MESSAGE_BYTES {
        return Err(ProbeRefusal::Oversized);
    }
    let json = decode_string(payload, encapsulation).ok_or(ProbeRefusal::Malformed)?;
    let version: Version = serde_json::from_str(json).map_err(|_| ProbeRefusal::Malformed)?;
    if version.v != VERSION {
        return Err(ProbeRefusal::UnsupportedVersion);
    }
    let message = serde_json::from_str(json).map_err(|_| ProbeRefusal::Malformed)?;
    Ok((message, serde_json::from_str(json).ok()))
}

fn serialize(message: &impl Serialize) -> Bytes {
    #[derive(Serialize)]
    struct Versioned<'a, T> {
        v: u64,
        #[serde(flatten)]
        message: &'a T,
    }
    // Cannot fail: the fields are numbers and strings, and all keys are strings.
    let json = serde_json::to_string(&Versioned { v: VERSION, message });
    string_message(&json.unwrap_or_default())
}

/// Decodes the text of a `std_msgs/String`, in any encapsulation that uses plain CDR for a final type (RTPS
/// 2.5 table 10.3, and XTypes 1.3 table 60, which has other numbers for CDR2). Up to three bytes of padding
/// may follow.
fn decode_string(payload: &[u8], encapsulation: Encapsulation) -> Option<&str> {
    let (length, rest) = payload.split_first_chunk::<4>()?;
    let length = match encapsulation.representation() {
        [0, 0x00 | 0x06 | 0x10] => u32::from_be_bytes(*length),
        [0, 0x01 | 0x07 | 0x11] => u32::from_le_bytes(*length),
        _ => return None,
    };
    let (text, padding) = rest.split_at_checked(usize::try_from(length).ok()?)?;
    let text = text.strip_suffix(&[0])?;
    if padding.len() > 3 { None } else { std::str::from_utf8(text).ok() }
}

fn as_hex<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&to_hex(bytes))
}

fn from_hex_text<'de, D: Deserializer<'de>, const N: usize>(deserializer: D) -> Result<[u8; N], D::Error> {
    let text = String::deserialize(deserializer)?;
    from_hex(&text).ok_or_else(|| serde::de::Error::custom("not lowercase hexadecimal digits"))
}

/// Formats bytes as lowercase hexadecimal digits.
pub(super) fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Parses lowercase hexadecimal digits only: the signature covers the nonce as text, which must be
/// unambiguous.
fn from_hex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    for (byte, digits) in bytes.iter_mut().zip(text.as_bytes().chunks(2)) {
        *byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
    }
    (to_hex(&bytes) == text).then_some(bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::Value;

    use super::*;

    const REQUEST: &str = r#"{"v": 1, "seq": 7, "send_time_ns": 1763000000000000001, "sender_id": "bridge",
        "probe_id": "p-7"}"#;
    const RESPONSE: &str = r#"{"v":1,"seq":7,"probe_id":"p-7","recv_time_ns":2,"reply_time_ns":3,
        "response_send_time_ns":4,"responder_id":"laptop"}"#;

    fn cdr(json: &str) -> Vec<u8> {
        string_message(json).to_vec()
    }

    fn request(json: &str) -> Result<ProbeRequest, ProbeRefusal> {
        ProbeRequest::decode(&cdr(json), Encapsulation::CDR_LE)
    }

    fn expected() -> ProbeRequest {
        ProbeRequest {
            seq: 7,
            send_time: WallNs(1_763_000_000_000_000_001),
            sender_id: "bridge".to_owned(),
            probe_id: ProbeId::Text("p-7".to_owned()),
            signature: None,
        }
    }

    #[test]
    fn messages_of_the_original_package_are_decoded() {
        assert_eq!(request(REQUEST), Ok(expected()));
        let response = ProbeResponse::decode(&cdr(RESPONSE), Encapsulation::CDR_LE).unwrap();
        assert_eq!((response.seq, response.probe_id.to_string().as_str()), (7, "p-7"));
        let times = (response.recv_time, response.reply_time, response.response_send_time);
        assert_eq!(times, (WallNs(2), WallNs(3), WallNs(4)));
        assert_eq!((response.responder_id.as_str(), response.signature), ("laptop", None));
    }

    #[test]
    fn an_unsigned_message_has_exactly_the_fields_of_the_original_package() {
        let keys = |bytes: Bytes| -> Vec<String> {
            let json: Value =
                serde_json::from_str(decode_string(&bytes, Encapsulation::CDR_LE).unwrap()).unwrap();
            json.as_object().unwrap().keys().cloned().collect()
        };
        assert_eq!(keys(expected().encode()), ["probe_id", "send_time_ns", "sender_id", "seq", "v"]);
        let response = ProbeResponse::decode(&cdr(RESPONSE), Encapsulation::CDR_LE).unwrap();
        let all = [
            "probe_id",
            "recv_time_ns",
            "reply_time_ns",
            "responder_id",
            "response_send_time_ns",
            "seq",
            "v",
        ];
        assert_eq!(keys(response.encode()), all);
    }

    #[test]
    fn every_plain_encapsulation_is_decoded_in_its_byte_order() {
        let little = cdr(REQUEST);
        let mut big = little.clone();
        big[..4].reverse();
        for (id, bytes) in [(0, &big), (1, &little), (6, &big), (7, &little), (0x10, &big), (0x11, &little)] {
            let read = ProbeRequest::decode(bytes, Encapsulation([0, id, 0, 0]));
            assert_eq!(read, Ok(expected()), "{id:#x}");
        }
        for id in [2, 3, 4, 8, 9, 10, 11, 0x12, 0x14, 0xff] {
            let read = ProbeRequest::decode(&little, Encapsulation([0, id, 0, 0]));
            assert_eq!(read, Err(ProbeRefusal::Malformed), "{id:#x}");
        }
    }

    #[test]
    fn a_payload_that_is_not_a_string_message_is_malformed() {
        let whole = cdr(REQUEST);
        for wrong in [
            vec![],
            vec![0; 3],
            vec![0; 4],
            whole[..whole.len() - 1].to_vec(),
            [&whole[..], &[0; 4]].concat(),
            [&u32::MAX.to_le_bytes(), &whole[4..]].concat(),
            [&(whole.len() as u32 - 5).to_le_bytes(), &whole[4..]].concat(),
        ] {
            let read = ProbeRequest::decode(&wrong, Encapsulation::CDR_LE);
            assert_eq!(read, Err(ProbeRefusal::Malformed), "{wrong:?}");
        }
        let padded = [&whole[..], &[0; 3]].concat();
        assert_eq!(ProbeRequest::decode(&padded, Encapsulation::CDR_LE), Ok(expected()));
        let mut invalid_utf8 = whole;
        invalid_utf8[70] = 0xff;
        assert_eq!(ProbeRequest::decode(&invalid_utf8, Encapsulation::CDR_LE), Err(ProbeRefusal::Malformed));
    }

    #[test]
    fn an_invalid_message_is_refused_with_the_right_reason() {
        let with = |from: &str, to: &str| {
            assert!(REQUEST.contains(from), "{from}");
            request(&REQUEST.replace(from, to))
        };
        for (from, to) in [
            ("\"seq\": 7, ", ""),
            ("7,", "-7,"),
            ("7,", "7.5,"),
            ("7,", "\"7\","),
            ("7,", "9223372036854775808,"),
            ("7,", "99999999999999999999999999,"),
            ("1763000000000000001", "9223372036854775808"),
            ("\"bridge\"", "\"\""),
            ("\"bridge\"", "null"),
            ("bridge", "bri\\ndge"),
            ("bridge", "bri\\u0000dge"),
            ("bridge", &"x".repeat(128)),
            ("\"p-7\"", "[1]"),
            ("\"p-7\"", "-1"),
            ("p-7", ""),
            ("\"v\": 1", "\"v\": 1, \"seq\": 8"),
            ("\"v\": 1, ", ""),
            ("\"v\": 1", "\"v\": \"1\""),
            ("}", ""),
            ("}", "} {}"),
        ] {
            assert_eq!(with(from, to), Err(ProbeRefusal::Malformed), "{from} {to}");
        }
        assert_eq!(with("\"v\": 1", "\"v\": 2"), Err(ProbeRefusal::UnsupportedVersion));
        assert_eq!(request(r#"{"v": 0}"#), Err(ProbeRefusal::UnsupportedVersion));
        for wrong in ["", "[]", "1", "null", "{", &"[".repeat(4000)] {
            assert_eq!(request(wrong), Err(ProbeRefusal::Malformed), "{wrong}");
        }
    }

    #[test]
    fn a_message_of_more_than_4_kib_is_refused() {
        let with_spaces = |bytes: usize| format!("{REQUEST}{}", " ".repeat(bytes - 5 - REQUEST.len()));
        assert_eq!(request(&with_spaces(4096)), Ok(expected()));
        assert_eq!(request(&with_spaces(4097)), Err(ProbeRefusal::Oversized));
    }

    #[test]
    fn unknown_fields_and_malformed_signatures_are_ignored() {
        for field in [
            r#""zone": {"a": [1, 2]}"#,
            r#""hmac": "swordfish", "nonce": 7"#,
            r#""nonce": null, "hmac": null"#,
            r#""nonce": "00112233445566778899aabbccddeeff""#,
        ] {
            assert_eq!(request(&REQUEST.replace("\"v\": 1", &format!("\"v\": 1, {field}"))), Ok(expected()));
        }
    }

    #[test]
    fn a_numeric_probe_id_is_encoded_as_a_number() {
        let numbered = request(&REQUEST.replace("\"p-7\"", "12")).unwrap();
        assert_eq!(numbered.probe_id, ProbeId::Number(12));
        assert!(numbered.encode().windows(14).any(|part| part == b"\"probe_id\":12}"));
    }

    #[test]
    fn hexadecimal_digits_are_lowercase() {
        assert_eq!(to_hex(&[0x0a, 0xff]), "0aff");
        assert_eq!(from_hex("0aff"), Some([0x0a, 0xff]));
        for wrong in ["0Aff", "0af", "0aff0", "0ag0", "+aff", "ä0f"] {
            assert_eq!(from_hex::<2>(wrong), None, "{wrong}");
        }
    }

    proptest! {
        #[test]
        fn messages_are_the_same_after_encoding_and_decoding(
            seq in 0..=MAX_NUMBER,
            time in 0..=MAX_NUMBER,
            id in "[^\\p{C}]{1,31}",
            probe_id in prop_oneof![
                "[^\\p{C}]{1,31}".prop_map(ProbeId::Text),
                (0..=MAX_NUMBER).prop_map(ProbeId::Number),
            ],
            signature in proptest::option::of(
                any::<([u8; 16], [u8; 32])>().prop_map(|(nonce, hmac)| Signature { nonce, hmac })
            ),
        ) {
            let request = ProbeRequest {
                seq,
                send_time: WallNs(time),
                sender_id: id.clone(),
                probe_id: probe_id.clone(),
                signature,
            };
            prop_assert_eq!(ProbeRequest::decode(&request.encode(), Encapsulation::CDR_LE), Ok(request));
            let response = ProbeResponse {
                seq,
                probe_id,
                recv_time: WallNs(time),
                reply_time: WallNs(seq),
                response_send_time: WallNs(time / 2),
                responder_id: id,
                signature,
            };
            prop_assert_eq!(ProbeResponse::decode(&response.encode(), Encapsulation::CDR_LE), Ok(response));
        }

        #[test]
        fn decoding_any_bytes_does_not_panic(bytes: Vec<u8>, id in 0_u8..=0x15) {
            let _ = ProbeRequest::decode(&bytes, Encapsulation([0, id, 0, 0]));
            let _ = ProbeResponse::decode(&bytes, Encapsulation([0, id, 0, 0]));
        }
    }
}
