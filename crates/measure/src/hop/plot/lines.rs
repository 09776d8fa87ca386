//! Line charts: panels above each other with a common x axis.

use super::file;
use crate::format::payload;
use crate::plot::axis::Axis;
use crate::plot::frame::{BELOW, Entry, LEFT, RIGHT, grid_x_with, grid_y, legend};
use crate::plot::svg::{Anchor, Svg, TEXT};

const PANEL: f64 = 130.0;

/// A line of a panel.
pub struct Line<'a> {
    pub name: &'a str,
    /// The CSS class of the colour, `a` to `f`. With ` tail` appended, the line is thin and dashed and not in
    /// the legend.
    pub class: String,
    pub points: Vec<(f64, f64)>,
}

/// Lines with common axes.
pub struct Panel<'a> {
    pub title: String,
    pub lines: Vec<Line<'a>>,
}

/// The scale of both axes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Linear, the y axis from 0 on.
    Linear,
    /// Logarithmic, in decades.
    Decades,
    /// Logarithmic; x is a number of bytes, with marks at powers of 4.
    Bytes,
}

/// Draws panels with a common x axis.
pub fn lines(label: &str, x_title: &str, panels: &[Panel], scale: Scale) -> String {
    let mut svg = Svg::default();
    let finite = |panels: &[Panel], of: fn(&(f64, f64)) -> f64| {
        let values = panels.iter().flat_map(|panel| &panel.lines).flat_map(|line| &line.points).map(of);
        values.filter(|value| value.is_finite()).fold(None, |range: Option<(f64, f64)>, value| {
            Some(range.map_or((value, value), |(low, high)| (low.min(value), high.max(value))))
        })
    };
    let range = finite(panels, |point| point.0).unwrap_or((1.0, 10.0));
    // Sizes are powers of 2, so their axis is a linear one of the exponent.
    let of_x = |value: f64| if scale == Scale::Bytes { value.log2() } else { value };
    let x = match scale {
        Scale::Linear => Axis::linear((0.0, range.1), (LEFT, RIGHT)),
        Scale::Decades => Axis::decades(range, (LEFT, RIGHT)),
        Scale::Bytes => Axis::linear((of_x(range.0), of_x(range.1)), (LEFT, RIGHT)),
    };
    let (mut top, mut bottom) = (0.0, 0.0);
    for panel in panels {
        svg.text("t strong", (LEFT, top + TEXT), Anchor::Start, &panel.title);
        let shown = panel.lines.iter().filter(|line| !line.class.contains("tail"));
        let entries: Vec<Entry> =
            shown.map(|line| Entry { text: line.name, class: &line.class, is_line: true }).collect();
        top = legend(&mut svg, top + TEXT + 4.0, &entries) + 4.0;
        bottom = top + PANEL;
        let range = finite(std::slice::from_ref(panel), |point| point.1).unwrap_or((1.0, 10.0));
        let y = match scale {
            Scale::Linear => Axis::linear((0.0, range.1 * 1.05), (bottom, top)),
            Scale::Decades | Scale::Bytes => Axis::decades(range, (bottom, top)),
        };
        grid_y(&mut svg, &y, 5);
        for line in &panel.lines {
            let points: Vec<(f64, f64)> = line
                .points
                .iter()
                .filter(|point| point.1.is_finite())
                .map(|point| (x.at(of_x(point.0)), y.at(point.1)))
                .collect();
            if !points.is_empty() {
                svg.polyline(&format!("line {}", line.class), &points);
            }
        }
        top = bottom + 12.0;
    }
    let mark =
        if scale == Scale::Bytes { |exponent: f64| payload(exponent.exp2() as usize) } else { Axis::label };
    grid_x_with(&mut svg, &x, 8, (bottom, bottom + 4.0), x_title, mark);
    file(&svg.finish(bottom + BELOW, label))
}
