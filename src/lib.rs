//! Adaptive Bridge: a proxy between a robot's publishers and its subscribers.
//!
//! The modules are layers: each may use those listed above it and none of those below. `tests/pure/tidy`
//! checks this, and the compiler for the first two, which are a crate of their own (`crates/policy`).
//!
//! - [`model`]: plain data types: time, names, QoS, sample header, modes, drop reasons.
//! - [`policy`]: decisions without side effects; the time is an argument.
//! - [`config`]: reads YAML into validated settings.
//! - [`clock`]: the only module that reads the operating system's clocks.
//! - [`dds`]: DDS readers, writers and discovery, on RustDDS.
//! - [`shm`]: channels, boards and pools in shared memory, on iceoryx2.
//! - [`telemetry`]: snapshots of the boards, status, metrics, diagnostics, logs.
//! - [`process`]: ingress, egress, control, responder and supervisor; the only module that combines DDS,
//!   shared memory and policy.
//! - [`cli`]: the subcommands.

// Of the library and not of its tests, hence not in Cargo.toml.
#![cfg_attr(not(test), warn(clippy::disallowed_methods, clippy::expect_used, clippy::unwrap_used))]

pub mod cli;
pub mod clock;
pub mod config;
pub mod dds;
pub mod process;
pub mod shm;
pub mod telemetry;

pub use adaptive_bridge_policy::{model, policy};
