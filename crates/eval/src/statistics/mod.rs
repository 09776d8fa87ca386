//! Figures computed from the records of runs. Pure: numbers in, numbers out.
//!
//! Times are seconds since the start of the measured window; latencies and gaps have the unit of the
//! arguments. Definitions are the paper's where it gives them (section IV-D); otherwise the function's
//! comment gives the choice.

#![warn(clippy::print_stderr, clippy::print_stdout)]

mod sequence;
mod states;
mod windows;

pub use adaptive_bridge_measure::statistics::{Distribution, Estimate};
pub use sequence::{Received, Reception, longest_silence_s, outstanding, received};
pub use states::{Change, Reaction, reactions, share_in, transitions};
pub use windows::{RateOverTime, Spread, WINDOW_S, mean_level, sliding_rate};
