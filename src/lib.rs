//! Adaptive Bridge: a proxy between a robot's publishers and its subscribers.
//!
//! The layers, in the order in which they may use each other: a module uses those above it and none below.
//! `tests/tidy.rs` enforces it.
//!
//! - [`model`]: vocabulary: time, names, QoS, sample header, modes, drop reasons.
//! - [`policy`]: pure decisions; time is an argument.
//! - [`config`]: YAML to validated settings.
//! - [`clock`]: the only reader of the operating system's clocks.
//! - [`dds`]: the RTPS edge, on RustDDS.
//! - [`shm`]: the shared-memory edge, on iceoryx2.
//! - [`telemetry`]: what the processes show: readings of the boards, logs.
//! - [`process`]: the roles; the only place where the edges meet policy.
//! - [`cli`]: one file for each subcommand.
//! - [`eval`]: with the feature of that name, the evaluation harness.

#![warn(missing_docs)]
#![cfg_attr(not(feature = "eval"), allow(rustdoc::broken_intra_doc_links))]

pub mod cli;
pub mod clock;
pub mod config;
pub mod dds;
#[cfg(feature = "eval")]
pub mod eval;
pub mod model;
pub mod policy;
pub mod process;
pub mod shm;
pub mod telemetry;
