//! Statistics, plots and tables that the benchmarks and the evaluation of Adaptive Bridge share.
//!
//! Pure: values in, values and text out. Nothing here measures, reads a file or writes one.
//!
//! - [`statistics`]: quantiles, medians with their confidence interval, growth.
//! - [`cpu_time`]: the CPU time that the hypervisor gave to other machines.
//! - [`mod@format`]: text of values, and of text inside markup.
//! - [`plot`]: axes, frames and elements of SVG, of which both make their charts.
//! - [`table`]: Markdown tables.
//! - [`hop`]: the report of the benchmark `benches/hop`.

#![cfg_attr(not(test), warn(clippy::disallowed_methods, clippy::expect_used, clippy::unwrap_used))]
#![warn(clippy::print_stderr, clippy::print_stdout)]

pub mod cpu_time;
pub mod format;
pub mod hop;
pub mod plot;
pub mod statistics;
pub mod table;
