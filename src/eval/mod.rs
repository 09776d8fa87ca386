//! The evaluation harness, `adaptive-bridge-eval`. It drives the bridge as its users do, by its program.
//!
//! - [`impairment`]: links that lose and delay packets.

mod cli;
pub mod impairment;

pub use cli::main;
