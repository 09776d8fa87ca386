//! What the processes show: readings of the boards, what they mean, and logs.

mod intervals;
mod liveness;
mod logs;
mod problems;
mod report;
#[cfg(test)]
mod samples;
mod snapshot;
mod table;
mod text;

pub use intervals::{IntervalStatistics, Intervals, WINDOW_SAMPLES};
pub use liveness::ProcessState;
pub use logs::start_logs;
pub use problems::{Level, Problem};
pub use report::{
    Drops, IntruderReport, LaneReport, Latency, LatencyTotal, OutputReport, ProbesReport, ProcessReport,
    Refusals, Report, RouteReport, SafetyReport, SubscriberReport,
};
pub use snapshot::{
    LaneReading, ModeReason, OutputReading, ProcessReading, RouteReading, Snapshot, SubscriberReading,
};
