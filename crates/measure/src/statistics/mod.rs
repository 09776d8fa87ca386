//! Figures computed from measured values. Pure: numbers in, numbers out.

mod distribution;
mod repetitions;
mod values;

pub use distribution::Distribution;
pub use repetitions::Estimate;
pub use values::{Growth, growth, median, median_interval, quantile};
