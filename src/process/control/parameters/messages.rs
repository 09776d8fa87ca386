//! The messages of `rcl_interfaces` in CDR, and the two forms in which a request names itself.

use byteorder::{BigEndian, LittleEndian};
use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::config::Value;
use crate::model::{Encapsulation, Guid};
use crate::telemetry;

/// The first two bytes of the GUIDs of Eclipse Cyclone DDS (RTPS 2.5 clause 9.3.1.5, vendor ids).
const CYCLONE: [u8; 2] = [0x01, 0x10];

/// RTPS lengthens a payload by up to 3 bytes.
const MAX_PADDING: usize = 3;

pub(super) const NOT_SET: u8 = 0;
pub(super) const BOOL: u8 = 1;
pub(super) const INTEGER: u8 = 2;
pub(super) const DOUBLE: u8 = 3;
pub(super) const STRING: u8 = 4;
pub(super) const BOOL_ARRAY: u8 = 6;
pub(super) const INTEGER_ARRAY: u8 = 7;
pub(super) const DOUBLE_ARRAY: u8 = 8;
pub(super) const STRING_ARRAY: u8 = 9;

/// `rcl_interfaces/msg/ParameterValue`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ParameterValue {
    pub kind: u8,
    pub flag: bool,
    pub whole: i64,
    pub decimal: f64,
    pub text: String,
    pub bytes: Vec<u8>,
    pub flags: Vec<bool>,
    pub wholes: Vec<i64>,
    pub decimals: Vec<f64>,
    pub texts: Vec<String>,
}

/// `rcl_interfaces/msg/Parameter`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Parameter {
    pub name: String,
    pub value: ParameterValue,
}

/// The request of `ListParameters`.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct ListRequest {
    pub prefixes: Vec<String>,
    pub depth: u64,
}

/// The reply of `ListParameters`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct ListReply {
    pub names: Vec<String>,
    pub prefixes: Vec<String>,
}

/// `rcl_interfaces/msg/ParameterDescriptor`.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Descriptor {
    pub name: String,
    pub kind: u8,
    pub description: String,
    pub additional_constraints: String,
    pub read_only: bool,
    pub dynamic_typing: bool,
    pub decimals: Vec<DecimalRange>,
    pub wholes: Vec<WholeRange>,
}

/// `rcl_interfaces/msg/FloatingPointRange`; a step of 0 allows every number in between.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct DecimalRange {
    pub least: f64,
    pub most: f64,
    pub step: f64,
}

/// `rcl_interfaces/msg/IntegerRange`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct WholeRange {
    pub least: i64,
    pub most: i64,
    pub step: u64,
}

/// `rcl_interfaces/msg/SetParametersResult`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct SetResult {
    pub successful: bool,
    pub reason: String,
}

/// `rcl_interfaces/msg/LoggerLevel`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct LoggerLevel {
    pub name: String,
    pub level: u32,
}

impl From<&Value> for ParameterValue {
    fn from(value: &Value) -> Self {
        let of = |kind| Self { kind, ..Self::default() };
        match value {
            Value::None => of(NOT_SET),
            Value::Flag(flag) => Self { flag: *flag, ..of(BOOL) },
            Value::Whole(number) => Self { whole: signed(*number), ..of(INTEGER) },
            Value::Decimal(number) => Self { decimal: *number, ..of(DOUBLE) },
            Value::Text(text) => Self { text: text.clone(), ..of(STRING) },
            Value::List(items) if matches!(items.first(), Some(Value::Whole(_))) => {
                let number = |item: &Value| match item {
                    Value::Whole(number) => signed(*number),
                    _ => 0,
                };
                Self { wholes: items.iter().map(number).collect(), ..of(INTEGER_ARRAY) }
            }
            Value::List(items) => {
                Self { texts: items.iter().map(Value::to_string).collect(), ..of(STRING_ARRAY) }
            }
        }
    }
}

/// A whole number of a setting; none is beyond the range of ROS 2.
pub(super) fn signed(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

impl ParameterValue {
    /// The value in YAML; `None` for no value and for one of a type that no key has.
    pub fn yaml(&self) -> Option<String> {
        // JSON is YAML, with every text in quotes. Serializing texts and numbers does not fail.
        let json = match self.kind {
            BOOL => serde_json::to_string(&self.flag),
            INTEGER => serde_json::to_string(&self.whole),
            // Not in JSON, which has no infinity. The reader refuses what is no number.
            DOUBLE => return Some(self.decimal.to_string()),
            STRING => serde_json::to_string(&self.text),
            BOOL_ARRAY => serde_json::to_string(&self.flags),
            INTEGER_ARRAY => serde_json::to_string(&self.wholes),
            DOUBLE_ARRAY => serde_json::to_string(&self.decimals),
            STRING_ARRAY => serde_json::to_string(&self.texts),
            _ => return None,
        };
        json.ok()
    }
}

/// The identity of a request in front of its payload, where Cyclone DDS has it; the reply repeats it. Other
/// libraries have it in the inline QoS, as DDS-RPC defines (`related_sample_identity`).
pub(super) type Front = Option<(u64, i64)>;

/// Decodes a request of the DDS writer `client`.
pub(super) fn decode<T: DeserializeOwned>(
    client: Guid,
    payload: &[u8],
    encapsulation: Encapsulation,
) -> Option<(Front, T)> {
    if client.0.starts_with(&CYCLONE) {
        let (client, number, request) = plain::<(u64, i64, T)>(payload, encapsulation)?;
        return Some((Some((client, number)), request));
    }
    Some((None, plain(payload, encapsulation)?))
}

fn plain<T: DeserializeOwned>(payload: &[u8], encapsulation: Encapsulation) -> Option<T> {
    let (message, used) = match encapsulation.representation() {
        [0, 0] => cdr_encoding::from_bytes::<T, BigEndian>(payload).ok()?,
        [0, 1] => cdr_encoding::from_bytes::<T, LittleEndian>(payload).ok()?,
        _ => return None,
    };
    (payload.len() - used <= MAX_PADDING).then_some(message)
}

/// Encodes a reply in the form of its request, in plain little-endian CDR.
pub(super) fn encode(front: Front, reply: &impl Serialize) -> Bytes {
    match front {
        Some((client, number)) => telemetry::cdr(&(client, number, reply), 1024),
        None => telemetry::cdr(reply, 1024),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FAST: Guid = Guid([1, 0x0f, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 0, 0, 1, 3]);
    const OF_CYCLONE: Guid = Guid([1, 0x10, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 0, 0, 1, 3]);

    #[test]
    fn a_request_of_cyclone_dds_is_answered_with_its_header_and_any_other_without() {
        let names = vec!["a.b".to_owned()];
        let body = [&[1, 0, 0, 0, 4, 0, 0, 0][..], b"a.b\0"].concat();
        let header = [7, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0];
        let framed = [&header[..], &body].concat();
        assert_eq!(decode(FAST, &body, Encapsulation::CDR_LE), Some((None, names.clone())));
        let decoded = decode(OF_CYCLONE, &framed, Encapsulation::CDR_LE);
        assert_eq!(decoded, Some((Some((7, 9)), names.clone())));
        assert_eq!(encode(None, &names), body);
        assert_eq!(encode(Some((7, 9)), &names), framed);
        let big_endian = [0, 0, 0, 1, 0, 0, 0, 2, b'a', 0];
        let decoded = decode::<Vec<String>>(FAST, &big_endian, Encapsulation([0, 0, 0, 0]));
        assert_eq!(decoded, Some((None, vec!["a".to_owned()])));
    }

    #[test]
    fn a_parameter_has_the_layout_of_the_message_definition() {
        let value = ParameterValue::from(&Value::Whole(5));
        let parameter = Parameter { name: "ab".to_owned(), value };
        let mut expected = vec![3, 0, 0, 0, b'a', b'b', 0];
        expected.extend([INTEGER, 0]);
        expected.resize(16, 0);
        expected.extend(5_i64.to_le_bytes());
        expected.extend(0_f64.to_le_bytes());
        expected.extend([1, 0, 0, 0, 0, 0, 0, 0]);
        expected.extend([0; 20]);
        assert_eq!(encode(None, &parameter), expected);
    }

    #[test]
    fn a_truncated_request_and_one_with_false_counts_are_refused() {
        let parameter = |name: &str| Parameter {
            name: name.to_owned(),
            value: ParameterValue { kind: STRING, text: "text".to_owned(), ..ParameterValue::default() },
        };
        let request = encode(None, &vec![parameter("a.b"), parameter("c")]);
        let decoded = |bytes: &[u8]| decode::<Vec<Parameter>>(FAST, bytes, Encapsulation::CDR_LE);
        assert!(decoded(&request).is_some());
        for length in 0..request.len() {
            assert_eq!(decoded(&request[..length]), None, "{length} bytes");
        }
        assert_eq!(decoded(&[&request[..], &[0; 4]].concat()), None);
        // Each word in turn has the largest value.
        for word in 0..request.len() / 4 {
            let mut forged = request.to_vec();
            forged[word * 4..][..4].fill(0xff);
            let _ = decoded(&forged);
        }
        assert_eq!(decode::<Vec<Parameter>>(FAST, &request, Encapsulation([0, 7, 0, 0])), None);
    }

    #[test]
    fn a_value_in_yaml_keeps_its_type() {
        let yaml = |value: ParameterValue| value.yaml();
        let of = |kind| ParameterValue { kind, ..ParameterValue::default() };
        assert_eq!(yaml(ParameterValue { flag: true, ..of(BOOL) }).unwrap(), "true");
        assert_eq!(yaml(ParameterValue { decimal: 4.0, ..of(DOUBLE) }).unwrap(), "4");
        assert_eq!(yaml(ParameterValue { text: "a\": 1".to_owned(), ..of(STRING) }).unwrap(), r#""a\": 1""#);
        assert_eq!(yaml(ParameterValue { wholes: vec![1, 2], ..of(INTEGER_ARRAY) }).unwrap(), "[1,2]");
        assert_eq!((yaml(of(NOT_SET)), yaml(of(5)), yaml(of(77))), (None, None, None));
    }
}
