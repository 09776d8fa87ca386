//! Observes a running bridge: snapshots of its boards, the report with its problems, its formats, and logs.

mod diagnostics;
mod intervals;
mod journal;
mod json;
mod liveness;
mod log_limit;
mod log_writer;
mod logs;
mod metrics;
mod problem;
mod problems;
mod report;
mod snapshot;
mod table;
#[cfg(test)]
mod test_report;
mod text;
mod threads;

pub use diagnostics::{DIAGNOSTIC_ARRAY_TYPE, DIAGNOSTICS_TOPIC, MAX_ARRAY_BYTES, diagnostic_arrays};
pub use intervals::{IntervalStatistics, Intervals};
pub use json::{DECISION_TOPIC, Decision, STRING_TYPE, cdr, diagnostics_json, string_message};
pub use liveness::{ProcessState, StatFile};
pub use log_limit::log_left_out;
pub use log_writer::{flush_logs, write_log_line};
pub use logs::{set_verbosity, start_logs};
pub use metrics::{CONTENT_TYPE, MetricsError, MetricsServer, metrics_page};
pub use problem::{Level, Problem};
pub use report::{Report, SubscriberReport};
pub use snapshot::{
    LaneReading, OutputReading, PatternReading, ProcessReading, RouteReading, Snapshot, SubscriberReading,
};
pub use text::{bytes_text, shortened, wrapped};
pub use threads::{Starvation, ThreadFiles, may_go_on};

impl Snapshot {
    /// The report of this snapshot, with rates and latencies since `earlier`. A bridge that was restarted in
    /// between has no rates yet.
    pub fn report_since(&self, earlier: &Self) -> Report {
        self.report_with(earlier, problems::of(self, earlier))
    }
}
