//! Writes the text exposition format of Prometheus, version 0.0.4.

use std::fmt::{Display, Write};

use crate::model::{Counts, Reason};
use crate::telemetry::report::LatencyTotal;

/// The media type of the format.
pub const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// The labels of a sample: fixed names, and values that may be any text.
pub(super) type Labels<'a> = &'a [(&'static str, &'a str)];

/// A page that is being written.
#[derive(Debug, Default)]
pub(super) struct Page {
    pub(super) text: String,
    /// The head of the current family until its first sample is written. A family without samples is omitted.
    head: Option<String>,
    /// The prefix of the names of all families.
    prefix: &'static str,
    name: &'static str,
}

/// The type of a metric family.
#[derive(Clone, Copy, Debug)]
pub(super) enum Kind {
    Counter,
    Gauge,
    Histogram,
}

impl Page {
    pub(super) fn with_prefix(prefix: &'static str) -> Self {
        Self { prefix, ..Self::default() }
    }

    /// Begins a family; its samples follow. `help` must not contain line breaks or backslashes.
    pub(super) fn family(&mut self, name: &'static str, kind: Kind, help: &str) {
        let kind = match kind {
            Kind::Counter => "counter",
            Kind::Gauge => "gauge",
            Kind::Histogram => "histogram",
        };
        let prefix = self.prefix;
        self.head = Some(format!("# HELP {prefix}{name} {help}\n# TYPE {prefix}{name} {kind}\n"));
        self.name = name;
    }

    /// Adds a sample to the family; `None` adds nothing.
    pub(super) fn sample(&mut self, labels: Labels<'_>, value: Option<impl Display>) {
        if let Some(value) = value {
            self.put("", labels, None, value);
        }
    }

    /// Adds one sample for each reason of the counts.
    pub(super) fn counts<R: Reason, const N: usize>(&mut self, labels: Labels<'_>, counts: &Counts<R, N>) {
        for &reason in R::ALL {
            self.put("", labels, Some(("reason", &reason.to_string())), counts.get(reason));
        }
    }

    /// Adds one sample for each possible state: 1 for the present state, 0 for the others.
    pub(super) fn states(&mut self, labels: Labels<'_>, name: &'static str, all: &[&str], present: &str) {
        for state in all {
            self.put("", labels, Some((name, state)), u64::from(*state == present));
        }
    }

    /// Adds a histogram to the family.
    pub(super) fn histogram(&mut self, labels: Labels<'_>, total: &LatencyTotal) {
        for (edge_ns, below) in LatencyTotal::EDGES_NS.iter().zip(total.below) {
            let edge = (*edge_ns as f64 / 1e9).to_string();
            self.put("_bucket", labels, Some(("le", &edge)), below);
        }
        self.put("_bucket", labels, Some(("le", "+Inf")), total.count);
        self.put("_sum", labels, None, total.sum_ns as f64 / 1e9);
        self.put("_count", labels, None, total.count);
    }

    /// Adds a line; `last` is the label after the others.
    fn put(&mut self, suffix: &str, labels: Labels<'_>, last: Option<(&str, &str)>, value: impl Display) {
        self.text.push_str(&self.head.take().unwrap_or_default());
        let escaped = |value: &str| value.replace('\\', r"\\").replace('"', r#"\""#).replace('\n', r"\n");
        let labels = labels.iter().copied().chain(last);
        let labels: Vec<String> =
            labels.map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        // Writing to a string does not fail.
        let _ = writeln!(self.text, "{}{}{suffix}{labels} {value}", self.prefix, self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_family_has_one_head_and_a_line_for_each_sample() {
        let mut page = Page::default();
        page.family("a_total", Kind::Counter, "What a is.");
        page.sample(&[("route", "scan")], Some(u64::MAX));
        page.sample(&[], Some(0.5));
        page.family("b", Kind::Gauge, "Without samples.");
        page.sample(&[], None::<u64>);
        page.family("c", Kind::Gauge, "States.");
        page.states(&[("lane", "x")], "mode", &["on", "off"], "off");
        let expected = "# HELP a_total What a is.\n# TYPE a_total counter\n\
                        a_total{route=\"scan\"} 18446744073709551615\na_total 0.5\n\
                        # HELP c States.\n# TYPE c gauge\nc{lane=\"x\",mode=\"on\"} 0\nc{lane=\"x\",mode=\"off\"} 1\n";
        assert_eq!(page.text, expected);
    }

    #[test]
    fn the_value_of_a_label_is_escaped() {
        let mut page = Page::default();
        page.family("a", Kind::Gauge, "A.");
        page.sample(&[("id", "x\"} 1\nb{c=\"\\")], Some(f64::NAN));
        let line = page.text.lines().last().unwrap();
        assert_eq!(line, r#"a{id="x\"} 1\nb{c=\"\\"} NaN"#);
    }

    #[test]
    fn a_histogram_ends_with_an_infinite_bucket() {
        let mut total = LatencyTotal { count: 9, sum_ns: 1_500_000_000, ..LatencyTotal::default() };
        total.below[20] = 7;
        let mut page = Page::default();
        page.family("h_seconds", Kind::Histogram, "H.");
        page.histogram(&[("lane", "x")], &total);
        let text = page.text;
        assert_eq!(text.matches("h_seconds_bucket").count(), 22);
        let first = "\nh_seconds_bucket{lane=\"x\",le=\"0.000016384\"} 0\n";
        assert!(text.contains(first), "{text}");
        let end = "le=\"17.179869184\"} 7\nh_seconds_bucket{lane=\"x\",le=\"+Inf\"} 9\n\
                   h_seconds_sum{lane=\"x\"} 1.5\nh_seconds_count{lane=\"x\"} 9\n";
        assert!(text.ends_with(end), "{text}");
    }
}
