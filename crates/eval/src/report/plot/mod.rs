//! Draws the charts of the report as inline SVG.

mod bars;
mod cdf;
mod timeline;

pub use bars::{Bars, Series};
pub use cdf::{Curve, cdf};
pub use timeline::{Line, Panel, Strip, Timeline};
