//! Draws plots as inline SVG, without a library, as no small one has what the report needs
//! (docs/decisions/0008-report.md).

mod axis;
mod bars;
mod cdf;
mod frame;
mod svg;
mod timeline;

pub use bars::{Bars, Series};
pub use cdf::{Curve, cdf};
pub use timeline::{Line, Panel, Strip, Timeline};
