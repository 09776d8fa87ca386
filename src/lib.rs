//! Adaptive Bridge: a proxy between a robot's publishers and its subscribers.
//!
//! The layers, in the order in which they may use each other: a module uses those above it and none below.
//! `tests/tidy.rs` enforces it.
//!
//! - [`model`]: vocabulary: time, names, QoS, sample header, modes, drop reasons.
//! - [`policy`]: pure decisions; time is an argument.
//! - [`config`]: YAML to validated settings.
//! - [`clock`]: the only reader of the operating system's clocks.
//! - [`shm`]: the shared-memory edge: samples, wake-ups, boards, locks and what dead processes leave behind.

#![warn(missing_docs)]

pub mod clock;
pub mod config;
pub mod model;
pub mod policy;
pub mod shm;
