//! What the processes show: logs, and readings of the boards.

mod logs;

pub use logs::start_logs;
