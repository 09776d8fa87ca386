//! Tests with DDS and processes on this host, without root: the shipped binary, real shared memory, DDS
//! participants on sockets of this host. One file: `cargo test --test dds reload::`.
//!
//! Tests run at the same time in one process, so each has a DDS domain of its own. Two files are programs of
//! their own, because they change the whole process: `edge.rs` stops it for a moment, `allocations.rs`
//! replaces its allocator.

mod cli;
mod clocks;
mod demo;
mod graph;
mod idle;
mod metrics;
mod patterns;
mod priority;
mod reload;
mod up;
