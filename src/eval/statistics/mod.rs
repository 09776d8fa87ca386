//! What is computed from the records of runs. Pure: numbers in, numbers out.
//!
//! Times are seconds since the run began to be measured; latencies and gaps are in the unit of what is handed
//! in. Every definition that the paper gives is followed (section IV-D), and where it gives none the choice
//! is told beside the function.

mod distribution;
mod repetitions;
mod sequence;
mod states;
mod windows;

pub use distribution::Distribution;
pub use repetitions::Estimate;
pub use sequence::{Received, Reception, longest_silence_s, outstanding, received};
pub use states::{Change, Reaction, reactions, share_in, transitions};
pub use windows::{RateOverTime, Spread, WINDOW_S, mean_level, sliding_rate};
