//! The evaluation harness, `adaptive-bridge-eval`. It drives the bridge as its users do, by its program.
//!
//! - [`impairment`]: links that lose and delay packets.
//! - [`scenario`]: what is run.
//! - [`bed`]: the hosts on which it is run.
//! - [`harness`]: makes the runs and records them.
//! - [`statistics`]: what is computed from the records. Pure.
//! - [`report`]: what the records show: tables, figures and verdicts.

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
