//! The summary of a bench run and the reports made from it: tables, plots, targets, and the page
//! docs/performance-runs.md. Pure, so that tests can pass invented runs.

mod figures;
pub mod large;
mod page;
mod plot;
mod summary;
mod tables;
pub mod targets;

pub use crate::format::payload;
pub use figures::figures;
pub use page::{fill, readme, runs_named};
pub use summary::{
    Attempt, Call, Isolation, Large, Latency, Loss, Lossy, Machine, Quantiles, Resource, Scale, Soak,
    SoakSeries, Summary, Throughput,
};
pub use tables::soak_failures;
pub use targets::TARGET_HZ;
