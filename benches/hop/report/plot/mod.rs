//! Plots as SVG files: the drawing is that of the evaluation's report, so that there is one of it; the
//! charts are the bench's own.

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

/// A page shows the file as an image, which has no style sheet but its own.
const STYLE: &str = include_str!("style.css");

/// A drawing as a file of its own.
fn file(drawing: &str) -> String {
    let end = drawing.find('>').map_or(0, |at| at + 1);
    let (head, body) = drawing.split_at(end);
    format!("{head}<style>\n{STYLE}</style><rect class=\"back\" width=\"100%\" height=\"100%\"/>{body}\n")
}
