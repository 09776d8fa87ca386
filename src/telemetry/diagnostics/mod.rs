//! The report as `diagnostic_msgs/DiagnosticArray`, for `/diagnostics` and its aggregator.
//!
//! Each part of the bridge has a status, named as diagnostic_updater does it: the node, a colon, the part.
//! `startswith: ["adaptive_bridge"]` matches all of them, and the aggregator marks a part that is no longer
//! reported as stale. The keys of a status are those of `status --json`.

mod parts;

use bytes::Bytes;
use serde::Serialize;

use super::json::cdr;
use super::problem::Level;
use super::report::Report;
use super::text::{printable, shortened};
use crate::model::{DdsType, TypeHash};
use parts::Part;

/// The topic of the diagnostics.
pub const DIAGNOSTICS_TOPIC: &str = "/diagnostics";

/// The DDS type of `diagnostic_msgs/DiagnosticArray`.
pub const DIAGNOSTIC_ARRAY_TYPE: DdsType = DdsType {
    name: "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    hash: TypeHash::from_hex(b"5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"),
    has_keys: false,
};

/// The maximum size of an array, so that each fits in one UDP datagram. A larger report is split into several
/// arrays; an aggregator identifies statuses by their names.
pub const MAX_ARRAY_BYTES: usize = 48 * 1024;

/// The node in the names of the statuses. The name of an instance other than the default is appended to it.
const NODE: &str = "adaptive_bridge";
const DEFAULT_INSTANCE: &str = "default";

/// The maximum lengths of texts in bytes, and the maximum number of values of a status.
const MAX_NAME_BYTES: usize = 256;
const MAX_MESSAGE_BYTES: usize = 1024;
const MAX_KEY_BYTES: usize = 96;
const MAX_VALUE_BYTES: usize = 192;
const MAX_VALUES: usize = 128;

// A status of the maximum size fits in an array.
const _: () = {
    let values = (MAX_VALUES + 1) * (MAX_KEY_BYTES + MAX_VALUE_BYTES + 16);
    assert!(HEADER_BYTES + MAX_NAME_BYTES + MAX_MESSAGE_BYTES + 256 + values <= MAX_ARRAY_BYTES);
};

/// `diagnostic_msgs/msg/DiagnosticArray`.
#[derive(Serialize)]
struct DiagnosticArray<'a> {
    header: &'a Header,
    status: &'a [DiagnosticStatus],
}

/// `std_msgs/msg/Header`; its first two fields are `builtin_interfaces/msg/Time`.
#[derive(Serialize)]
struct Header {
    stamp_sec: i32,
    stamp_nanosec: u32,
    frame_id: &'static str,
}

/// `diagnostic_msgs/msg/DiagnosticStatus`.
#[derive(Serialize)]
struct DiagnosticStatus {
    level: u8,
    name: String,
    message: String,
    hardware_id: String,
    values: Vec<KeyValue>,
}

/// `diagnostic_msgs/msg/KeyValue`.
#[derive(Serialize)]
struct KeyValue {
    key: String,
    value: String,
}

/// The report as messages for [`DIAGNOSTICS_TOPIC`], each of at most [`MAX_ARRAY_BYTES`], in plain
/// little-endian CDR without the encapsulation header. Most bridges need one message.
pub fn diagnostic_arrays(report: &Report) -> Vec<Bytes> {
    let header = Header {
        stamp_sec: i32::try_from(report.time_unix_ms / 1_000).unwrap_or(i32::MAX),
        stamp_nanosec: (report.time_unix_ms % 1_000) as u32 * 1_000_000,
        frame_id: "",
    };
    let statuses: Vec<DiagnosticStatus> =
        parts::of(report).into_iter().map(|part| DiagnosticStatus::of(part, report)).collect();
    let mut arrays = Vec::new();
    let mut rest = statuses.as_slice();
    while !rest.is_empty() {
        let mut bytes = HEADER_BYTES;
        let fitting = rest.iter().take_while(|status| {
            bytes += status.max_encoded_bytes();
            bytes <= MAX_ARRAY_BYTES
        });
        // The limits of a status ensure that one always fits.
        let (now, later) = rest.split_at(fitting.count().max(1));
        arrays.push(cdr(&DiagnosticArray { header: &header, status: now }, bytes));
        rest = later;
    }
    arrays
}

/// The encoded size of the stamp, an empty string with its padding, and the number of statuses.
const HEADER_BYTES: usize = 8 + 8 + 4;

impl DiagnosticStatus {
    fn of(part: Part, report: &Report) -> Self {
        let about = || report.problems.iter().filter(|problem| problem.about == part.name);
        let level = about().fold(part.level, |level, problem| level.worse(problem.level));
        let problems: Vec<&str> = about().map(|problem| problem.text.as_str()).collect();
        let message = if problems.is_empty() { part.message } else { problems.join("; ") };
        let node = match report.instance.as_str() {
            DEFAULT_INSTANCE => NODE.to_owned(),
            instance => format!("{NODE}_{instance}"),
        };
        let mut values: Vec<KeyValue> = part
            .values
            .iter()
            .take(MAX_VALUES)
            .map(|(key, value)| KeyValue {
                key: bounded(key, MAX_KEY_BYTES),
                value: bounded(value, MAX_VALUE_BYTES),
            })
            .collect();
        if let Some(omitted @ 1..) = part.values.len().checked_sub(MAX_VALUES) {
            values.push(KeyValue { key: "values_omitted".to_owned(), value: omitted.to_string() });
        }
        Self {
            level: level as u8,
            name: bounded(&format!("{node}: {}", part.name), MAX_NAME_BYTES),
            message: bounded(&message, MAX_MESSAGE_BYTES),
            hardware_id: report.instance.clone(),
            values,
        }
    }

    /// The maximum encoded size: each string has a length, a zero byte and up to three bytes of padding.
    fn max_encoded_bytes(&self) -> usize {
        let string = |text: &str| 4 + text.len() + 1 + 3;
        let values: usize = self.values.iter().map(|pair| string(&pair.key) + string(&pair.value)).sum();
        4 + string(&self.name) + string(&self.message) + string(&self.hardware_id) + 4 + values
    }
}

/// Replaces control characters and cuts the text. A zero byte would end the string early in C and C++.
fn bounded(text: &str, max_bytes: usize) -> String {
    shortened(&printable(text), max_bytes)
}

#[cfg(test)]
mod tests;
