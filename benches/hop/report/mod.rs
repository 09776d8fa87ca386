//! What a run of the bench gave, and what is made of it: tables, plots, targets, the page
//! docs/performance.md. Pure: numbers in, text out, so that a test can hand in made-up runs.

mod figures;
mod format;
mod page;
mod plot;
pub mod statistics;
mod summary;
mod table;
mod tables;
pub mod targets;

pub use figures::figures;
pub use page::{fill, readme, runs_named};
pub use summary::{
    Attempt, Call, Isolation, Latency, Loss, Lossy, Machine, Quantiles, Resource, Scale, Soak, SoakSeries,
    Summary, Throughput,
};
pub use tables::{payload, soak_failures};
pub use targets::JUDGED_HZ;
