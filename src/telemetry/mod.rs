//! What the processes show: readings of the boards, what they mean, and logs.

mod cpu_time;
mod diagnostics;
mod intervals;
mod journal;
mod json;
mod liveness;
mod logs;
mod metrics;
mod problems;
mod report;
#[cfg(test)]
mod samples;
mod snapshot;
mod table;
mod text;

pub use cpu_time::CpuTime;
pub use diagnostics::{DIAGNOSTIC_ARRAY_TYPE, DIAGNOSTICS_TOPIC, MAX_ARRAY_BYTES, diagnostic_arrays};
pub use intervals::{IntervalStatistics, Intervals, WINDOW_SAMPLES};
pub use json::{DECISION_TOPIC, Decision, STRING_TYPE, diagnostics_json, string_message};
pub use liveness::ProcessState;
pub use logs::{set_verbosity, start_logs};
pub use metrics::{CONTENT_TYPE, MetricsError, MetricsServer, metrics_page};
pub use problems::{Level, Problem};
pub use report::{
    Drops, IntruderReport, LaneReport, Latency, LatencyTotal, OutputReport, ProbesReport, ProcessReport,
    PublisherReport, ReaderReport, Refusals, Report, RouteReport, SafetyReport, SubscriberReport,
};
pub use snapshot::{
    LaneReading, ModeReason, OutputReading, ProcessReading, RouteReading, Snapshot, SubscriberReading,
};
