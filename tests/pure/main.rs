//! Tests that start no process and open no network: the configuration, policy in virtual time, the fuzz
//! targets on kept inputs, and the rules of this source tree. One file: `cargo test --test pure policy::`.

mod config;
mod control_policy;
mod dumps;
mod memory;
mod patterns;
mod policy;
mod regressions;
mod tidy;
mod units;
