//! What the processes show: readings of the boards, what they mean, and logs.

mod intervals;
mod liveness;
mod logs;
mod problems;
mod report;
mod snapshot;
mod table;

pub use intervals::{IntervalStatistics, Intervals, WINDOW_SAMPLES};
pub use liveness::ProcessState;
pub use logs::start_logs;
pub use report::{Drops, LaneReport, Latency, OutputReport, ProcessReport, Report, RouteReport};
pub use snapshot::{LaneReading, ModeReason, OutputReading, ProcessReading, RouteReading, Snapshot};
