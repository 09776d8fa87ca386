//! Plots as SVG files. Axes, frames and SVG elements are shared with the report of the evaluation; the charts
//! are the bench's own.

#[allow(
    dead_code,
    unused_imports,
    reason = "shared with the report of the evaluation, which uses and tests it all"
)]
#[path = "../../../../src/eval/report/plot/axis.rs"]
mod axis;
mod bars;
#[allow(dead_code, unused_imports, reason = "as above")]
#[path = "../../../../src/eval/report/plot/frame.rs"]
mod frame;
mod lines;
#[allow(dead_code, unused_imports, reason = "as above")]
#[path = "../../../../src/eval/report/plot/svg.rs"]
mod svg;

pub use bars::{Bars, Series};
pub use lines::{Line, Panel, lines};

/// The style sheet of each file. Pages include the files as images, to which a page's style sheet does not
/// apply.
const STYLE: &str = include_str!("style.css");

/// The content of an SVG file with a drawing, the style sheet and a background.
fn file(drawing: &str) -> String {
    let end = drawing.find('>').map_or(0, |at| at + 1);
    let (head, body) = drawing.split_at(end);
    format!("{head}<style>\n{STYLE}</style><rect class=\"back\" width=\"100%\" height=\"100%\"/>{body}\n")
}
