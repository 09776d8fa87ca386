//! Tests with several hosts, which are network namespaces: they need root or a user namespace, and the DDS
//! peers (`make peers`). One file: `cargo test --test hosts networks::`.

mod chaos;
mod churn;
mod control;
mod control_faults;
mod crowds;
mod cut_through;
mod faults;
mod floods;
mod forged_participants;
mod fragments;
mod hangs;
mod hostile;
mod hostile_readers;
mod identity;
mod interop;
mod intruders;
mod keyed;
mod kilted;
mod lane_restarts;
mod large_samples;
mod latched;
mod networks;
mod noncritical_readers;
mod original_probes;
mod parameters;
mod patterns;
mod qos_table;
mod readers;
mod repairs;
mod responder;
mod restarts;
mod ros2;
mod standby;
mod visits;
