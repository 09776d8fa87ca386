//! The reports of the demo's publisher and subscribers to the demo: a line on their stdout for each scan.

use std::fmt;

use crate::model::MonotonicNs;

/// One line on the stdout of a publisher or subscriber.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Report {
    /// The publisher has started its timer; scan `n` is due `n` periods later.
    Began {
        /// The instant at which scan 0 is due.
        at: MonotonicNs,
    },
    /// The publish call for a scan has returned.
    Published {
        /// The number of the scan.
        number: u64,
        /// The duration of the call.
        call_ns: u64,
        /// Whether the writer accepted the scan.
        written: bool,
    },
    /// A subscriber has received a scan.
    Arrived {
        /// The number of the scan.
        number: u64,
        /// The instant before the publish call.
        taken_at: MonotonicNs,
        /// The instant at which the subscriber took the scan from its reader.
        arrived_at: MonotonicNs,
    },
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Began { at } => write!(f, "began {}", at.0),
            Self::Published { number, call_ns, written } => {
                write!(f, "published {number} {call_ns} {}", u8::from(*written))
            }
            Self::Arrived { number, taken_at, arrived_at } => {
                write!(f, "arrived {number} {} {}", taken_at.0, arrived_at.0)
            }
        }
    }
}

impl Report {
    /// Parses a line; `None` when it is not a report.
    pub fn parse(line: &str) -> Option<Self> {
        let mut words = line.split_ascii_whitespace();
        let kind = words.next()?;
        let numbers: Vec<u64> = words.map(str::parse).collect::<Result<_, _>>().ok()?;
        match (kind, numbers.as_slice()) {
            ("began", &[at]) => Some(Self::Began { at: MonotonicNs(at) }),
            ("published", &[number, call_ns, written]) => {
                Some(Self::Published { number, call_ns, written: written == 1 })
            }
            ("arrived", &[number, taken_at, arrived_at]) => Some(Self::Arrived {
                number,
                taken_at: MonotonicNs(taken_at),
                arrived_at: MonotonicNs(arrived_at),
            }),
            _ => None,
        }
    }
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
            assert_eq!(Report::parse(&report.to_string()), Some(report));
        }
        for line in ["", "arrived", "arrived 1 2", "arrived 1 2 3 4", "published x 1 1", "began -1"] {
            assert_eq!(Report::parse(line), None, "{line}");
        }
    }
}
