//! Plots as SVG files: bars and lines.

mod bars;
mod lines;

pub use bars::{Bars, Series};
pub use lines::{Line, Panel, Scale, lines};

/// The style sheet of each file. Pages include the files as images, to which a page's style sheet does not
/// apply.
const STYLE: &str = include_str!("style.css");

/// The content of an SVG file with a drawing, the style sheet and a background.
fn file(drawing: &str) -> String {
    let end = drawing.find('>').map_or(0, |at| at + 1);
    let (head, body) = drawing.split_at(end);
    format!("{head}<style>\n{STYLE}</style><rect class=\"back\" width=\"100%\" height=\"100%\"/>{body}\n")
}
