//! The vocabulary and the decisions of Adaptive Bridge.
//!
//! This crate is `no_std`, so the compiler proves that a decision reads no clock, opens nothing, starts no
//! thread and logs nothing. The time is an argument.
//!
//! - [`model`]: plain data types: time, names, QoS, sample header, modes, drop reasons.
//! - [`policy`]: decisions without side effects.

// Only the tests have the standard library.
#![cfg_attr(not(test), no_std)]
#![cfg_attr(not(test), warn(clippy::disallowed_methods, clippy::expect_used, clippy::unwrap_used))]

extern crate alloc;

pub mod model;
pub mod policy;
