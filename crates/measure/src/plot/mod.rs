//! Draws parts of plots as SVG, without a library, as no small one has what the reports need
//! (docs/decisions/0008-report.md).

pub mod axis;
pub mod frame;
pub mod svg;
