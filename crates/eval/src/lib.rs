//! The evaluation harness, `adaptive-bridge-eval`. It starts the bridge as users do, by its program.
//!
//! - [`impairment`]: links that lose and delay packets.
//! - [`scenario`]: the experiments, read from YAML files.
//! - [`bed`]: test beds, the hosts that experiments run on.
//! - [`harness`]: executes runs and records them.
//! - [`statistics`]: pure functions that compute figures from the records.
//! - [`report`]: tables, figures and verdicts from the records.

#![cfg_attr(not(test), warn(clippy::disallowed_methods, clippy::expect_used, clippy::unwrap_used))]

pub mod bed;
mod cli;
mod error;
pub mod harness;
pub mod impairment;
pub mod report;
pub mod scenario;
pub mod statistics;

pub use cli::main;
pub use error::EvalError;
