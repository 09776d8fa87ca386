//! Common parts of plots: grid lines with labels, and a legend.

use super::axis::Axis;
use super::svg::{Anchor, Svg, TEXT, WIDTH, text_width};

/// The left edge of the frame.
pub const LEFT: f64 = 52.0;
/// The right edge of the frame.
pub const RIGHT: f64 = WIDTH - 18.0;

/// Height below a frame for the labels of its marks and of its axis.
pub const BELOW: f64 = 2.0 * TEXT + 14.0;

/// An entry of a legend: a text and the class of its swatch.
pub struct Entry<'a> {
    /// The text.
    pub text: &'a str,
    /// The CSS class of the swatch's colour.
    pub class: &'a str,
    /// Whether the swatch is a line; otherwise it is a filled square.
    pub is_line: bool,
}

/// Draws a legend below `top`, in as many lines as needed; returns the y coordinate of its end.
pub fn legend(svg: &mut Svg, top: f64, entries: &[Entry]) -> f64 {
    const SWATCH: f64 = 22.0;
    const GAP: f64 = 14.0;
    let (mut x, mut y) = (LEFT, top + TEXT);
    for entry in entries {
        let width = SWATCH + text_width(entry.text) + GAP;
        if x > LEFT && x + width > RIGHT + GAP {
            x = LEFT;
            y += TEXT + 5.0;
        }
        if entry.is_line {
            svg.line(&format!("line {}", entry.class), (x, y - 4.0), (x + SWATCH - 5.0, y - 4.0));
        } else {
            svg.rect(&format!("fill {}", entry.class), (x + 3.0, y - TEXT + 3.0), (11.0, 11.0), None);
        }
        svg.text("t", (x + SWATCH, y), Anchor::Start, entry.text);
        x += width;
    }
    y + 9.0
}

/// Draws horizontal grid lines with their labels at the left.
pub fn grid_y(svg: &mut Svg, axis: &Axis, most: usize) {
    for mark in axis.marks(most) {
        let y = axis.at(mark);
        svg.line("grid", (LEFT, y), (RIGHT, y));
        svg.text("t", (LEFT - 6.0, y + TEXT * 0.35), Anchor::End, &Axis::label(mark));
    }
}

/// Draws vertical grid lines with their labels below, and the title of the axis.
pub fn grid_x(svg: &mut Svg, axis: &Axis, most: usize, extent: (f64, f64), title: &str) {
    grid_x_with(svg, axis, most, extent, title, Axis::label);
}

/// As [`grid_x`], with the texts of the marks.
pub fn grid_x_with(
    svg: &mut Svg,
    axis: &Axis,
    most: usize,
    (top, bottom): (f64, f64),
    title: &str,
    text: fn(f64) -> String,
) {
    for mark in axis.marks(most) {
        let x = axis.at(mark);
        svg.line("grid", (x, top), (x, bottom));
        svg.text("t", (x, bottom + TEXT + 3.0), Anchor::Middle, &text(mark));
    }
    svg.text("t", ((LEFT + RIGHT) / 2.0, bottom + 2.0 * TEXT + 8.0), Anchor::Middle, title);
}
