//! Tests that need root and a part of the system: systemd, Docker, colcon, real-time scheduling.
//! One file: `cargo test --test root systemd::`.

mod colcon;
mod docker;
mod scheduling;
mod systemd;
