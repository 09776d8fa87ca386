//! Tests of the encoded diagnostics, with a decoder that is written after the message definitions.

use std::collections::BTreeMap;

use super::super::problem::Problem;
use super::super::test_report::wide_report;
use super::*;

struct Reader<'a> {
    cdr: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn u8(&mut self) -> u8 {
        self.at += 1;
        self.cdr[self.at - 1]
    }

    fn u32(&mut self) -> u32 {
        self.at = self.at.next_multiple_of(4);
        self.at += 4;
        u32::from_le_bytes(self.cdr[self.at - 4..self.at].try_into().unwrap())
    }

    fn string(&mut self) -> String {
        let length = self.u32() as usize;
        let text = self.cdr[self.at..self.at + length - 1].to_vec();
        assert_eq!(self.cdr[self.at + length - 1], 0);
        self.at += length;
        assert!(!text.contains(&0));
        String::from_utf8(text).unwrap()
    }
}

#[derive(Debug)]
struct Status {
    level: u8,
    message: String,
    hardware_id: String,
    values: BTreeMap<String, String>,
}

/// Decodes the statuses of all arrays, by name.
fn read(arrays: &[Bytes]) -> BTreeMap<String, Status> {
    let mut found = BTreeMap::new();
    for array in arrays {
        assert!(array.len() <= MAX_ARRAY_BYTES, "{}", array.len());
        let mut cdr = Reader { cdr: array, at: 0 };
        let (_sec, nanosec, frame_id) = (cdr.u32(), cdr.u32(), cdr.string());
        assert!(nanosec < 1_000_000_000 && frame_id.is_empty());
        for _ in 0..cdr.u32() {
            let level = cdr.u8();
            let (name, message, hardware_id) = (cdr.string(), cdr.string(), cdr.string());
            let values = (0..cdr.u32()).map(|_| (cdr.string(), cdr.string())).collect();
            let former = found.insert(name.clone(), Status { level, message, hardware_id, values });
            assert!(former.is_none(), "{name} twice");
        }
        assert_eq!(cdr.at, array.len());
    }
    found
}

/// diagnostic_msgs/DiagnosticArray: `Header header, DiagnosticStatus[] status`. Header: `Time stamp` of
/// `int32 sec, uint32 nanosec`, `string frame_id`. DiagnosticStatus: `byte level, string name, string
/// message, string hardware_id, KeyValue[] values`. KeyValue: `string key, string value`. Values of 4 bytes
/// are aligned to 4 bytes.
#[test]
fn an_array_has_the_layout_of_the_message_definitions() {
    let header = Header { stamp_sec: 0x0102_0304, stamp_nanosec: 5, frame_id: "" };
    let pair = |key: &str, value: &str| KeyValue { key: key.into(), value: value.into() };
    let status = |level, name: &str, values| DiagnosticStatus {
        level,
        name: name.into(),
        message: "m".into(),
        hardware_id: String::new(),
        values,
    };
    let statuses = [status(2, "abc", vec![pair("k", "12")]), status(3, "d", Vec::new())];
    let found = cdr(&DiagnosticArray { header: &header, status: &statuses }, 0);
    #[rustfmt::skip]
    let expected: &[u8] = &[
        4, 3, 2, 1, 5, 0, 0, 0,                          // stamp
        1, 0, 0, 0, 0, 0, 0, 0,                          // frame_id "", padding
        2, 0, 0, 0,                                      // two statuses
        2, 0, 0, 0,                                      // level ERROR, padding
        4, 0, 0, 0, b'a', b'b', b'c', 0,                 // name
        2, 0, 0, 0, b'm', 0, 0, 0,                       // message, padding
        1, 0, 0, 0, 0, 0, 0, 0,                          // hardware_id "", padding
        1, 0, 0, 0,                                      // one value
        2, 0, 0, 0, b'k', 0, 0, 0,                       // key, padding
        3, 0, 0, 0, b'1', b'2', 0,                       // value
        3,                                               // level STALE, where the string ended
        2, 0, 0, 0, b'd', 0, 0, 0,                       // name, padding
        2, 0, 0, 0, b'm', 0, 0, 0,                       // message, padding
        1, 0, 0, 0, 0, 0, 0, 0,                          // hardware_id "", padding
        0, 0, 0, 0,                                      // no values
    ];
    assert_eq!(found, expected);
}

#[test]
fn every_part_has_a_status_with_the_keys_of_the_report() {
    let mut report = wide_report();
    report.instance = "default".into();
    report.time_unix_ms = 1_763_000_000_123;
    let arrays = diagnostic_arrays(&report);
    let stamp = Reader { cdr: &arrays[0], at: 0 }.u32();
    assert_eq!(stamp, 1_763_000_000);
    let found = read(&arrays);
    let lane = "a_lane_of_24_characters_";
    let subscriber = format!("adaptive_bridge: subscriber {}", "x".repeat(127));
    let names = [
        "adaptive_bridge: bridge",
        "adaptive_bridge: control",
        "adaptive_bridge: intruders",
        &format!("adaptive_bridge: lane {lane}"),
        "adaptive_bridge: network",
        "adaptive_bridge: probes",
        "adaptive_bridge: route scan",
        "adaptive_bridge: safety",
        &subscriber,
    ];
    assert_eq!(found.keys().map(String::as_str).collect::<Vec<_>>(), names);
    assert!(found.values().all(|status| status.hardware_id == "default"));
    assert_eq!(found[&subscriber].values["rtt_mean_ms"], "99940");
    assert_eq!(found["adaptive_bridge: route scan"].values[&format!("{lane}.age.p50_us")], "99940");
    assert_eq!(found["adaptive_bridge: safety"].values["mode"], "emergency");
    assert_eq!(found["adaptive_bridge: probes"].values["refused.replayed"], "3");
    assert_eq!(found[&format!("adaptive_bridge: lane {lane}")].values["process.state"], "running");
}

#[test]
fn a_problem_gives_its_part_a_level_and_a_message() {
    let mut report = wide_report();
    report.instance = "left".into();
    let problem = |about: &str, level, text: &str| Problem { about: about.into(), level, text: text.into() };
    report.problems = vec![
        problem("route scan", Level::Error, "one"),
        problem("route scan", Level::Stale, "two"),
        problem("probes", Level::Warn, "three"),
    ];
    let found = read(&diagnostic_arrays(&report));
    let of = |part: &str| {
        let status = &found[&format!("adaptive_bridge_left: {part}")];
        (status.level, status.message.as_str())
    };
    assert_eq!(of("route scan"), (2, "one; two"));
    assert_eq!(of("probes"), (1, "three"));
    assert_eq!(of("safety"), (0, "emergency"));
}

#[test]
fn a_large_report_is_split_into_arrays_of_limited_size() {
    let mut report = wide_report();
    let (route, subscriber) = (report.routes[0].clone(), report.subscribers[0].clone());
    for number in 0..300 {
        let mut route = route.clone();
        route.id = format!("route_{number}");
        route.lanes = (0..12)
            .map(|lane| {
                let mut output = route.lanes[0].clone();
                output.lane = format!("lane_{lane}");
                output
            })
            .collect();
        report.routes.push(route);
    }
    for number in 0..64 {
        let mut subscriber = subscriber.clone();
        subscriber.id = format!("{number}\0\n\x1b[2J{}", "é".repeat(500));
        subscriber.reason = "\0".repeat(10_000);
        report.subscribers.push(subscriber);
    }
    report.intruders = vec![report.intruders[0].clone(); 32];
    for (number, intruder) in report.intruders.iter_mut().enumerate() {
        intruder.topic = format!("/{number}{}", "t".repeat(1_000));
    }
    let arrays = diagnostic_arrays(&report);
    assert!(arrays.len() > 1);
    let found = read(&arrays);
    assert_eq!(found.len(), 6 + report.lanes.len() + report.routes.len() + report.subscribers.len());
    assert!(
        found["adaptive_bridge_an_instance_of_24_chars_: route route_7"]
            .values
            .contains_key("values_omitted")
    );
}
