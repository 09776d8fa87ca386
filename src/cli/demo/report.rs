//! The reports of the demo's publisher and subscribers to the demo: a line of JSON on stdout for each scan.

use serde::{Deserialize, Serialize};

use crate::model::MonotonicNs;

/// One line on the stdout of a publisher or subscriber.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Report {
    /// The publisher has started its timer; scan `n` is due `n` periods later.
    Began {
        /// The instant at which scan 0 is due.
        at: MonotonicNs,
    },
    /// The publish call for a scan has returned.
    Published {
        number: u64,
        call_ns: u64,
        /// Whether the writer accepted the scan.
        written: bool,
    },
    /// A subscriber has received a scan.
    Arrived {
        number: u64,
        /// The instant before the publish call.
        taken_at: MonotonicNs,
        /// The instant at which the subscriber took the scan from its reader.
        arrived_at: MonotonicNs,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_printed_report_is_parsed_to_the_same_report() {
        let reports = [
            Report::Began { at: MonotonicNs(u64::MAX) },
            Report::Published { number: 7, call_ns: 100_123_456, written: false },
            Report::Published { number: 8, call_ns: 0, written: true },
            Report::Arrived { number: 9, taken_at: MonotonicNs(1), arrived_at: MonotonicNs(2) },
        ];
        for report in reports {
            let line = serde_json::to_string(&report).unwrap();
            assert!(!line.contains('\n'));
            assert_eq!(serde_json::from_str::<Report>(&line).unwrap(), report);
        }
        let arrived = |fields: &str| format!("{{\"Arrived\":{{{fields}}}}}");
        assert!(
            serde_json::from_str::<Report>(&arrived(r#""number":1,"taken_at":2,"arrived_at":3"#)).is_ok()
        );
        for line in [
            String::new(),
            "arrived 1 2 3".to_owned(),
            "\"Arrived\"".to_owned(),
            arrived(r#""number":1,"taken_at":2"#),
            arrived(r#""number":"x","taken_at":2,"arrived_at":3"#),
            arrived(r#""number":-1,"taken_at":2,"arrived_at":3"#),
        ] {
            assert!(serde_json::from_str::<Report>(&line).is_err(), "{line}");
        }
    }
}
