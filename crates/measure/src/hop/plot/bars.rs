//! Bar charts with groups of bars.

use super::file;
use crate::plot::axis::Axis;
use crate::plot::frame::{Entry, LEFT, RIGHT, grid_y, legend};
use crate::plot::svg::{Anchor, Svg, TEXT};

const HEIGHT: f64 = 190.0;

/// The bars of one kind: a value for each group, `None` where nothing was measured.
pub struct Series<'a> {
    pub name: &'a str,
    /// The CSS class of the colour, `a` to `f`.
    pub class: &'a str,
    pub values: Vec<Option<f64>>,
}

/// A bar chart.
pub struct Bars<'a> {
    /// The text alternative for screen readers.
    pub label: &'a str,
    /// The quantity and unit of the values.
    pub title: &'a str,
    pub groups: Vec<String>,
    pub series: Vec<Series<'a>>,
    pub logarithmic: bool,
    /// Formats a value for the text above its bar.
    pub shown: fn(Option<f64>) -> String,
}

impl Bars<'_> {
    pub fn draw(&self) -> String {
        let mut svg = Svg::default();
        svg.text("t strong", (LEFT, TEXT), Anchor::Start, self.title);
        let entries: Vec<Entry> = self
            .series
            .iter()
            .map(|series| Entry { text: series.name, class: series.class, is_line: false })
            .collect();
        let top = legend(&mut svg, TEXT + 4.0, &entries) + TEXT + 4.0;
        let bottom = top + HEIGHT;
        let axis = self.axis((bottom, top));
        grid_y(&mut svg, &axis, 6);
        let group_width = (RIGHT - LEFT) / self.groups.len().max(1) as f64;
        let bar_width = group_width * 0.86 / self.series.len().max(1) as f64;
        for (group, name) in self.groups.iter().enumerate() {
            let left = LEFT + group_width * (group as f64 + 0.07);
            for (place, series) in self.series.iter().enumerate() {
                let x = left + bar_width * place as f64;
                let Some(value) = series.values.get(group).copied().flatten() else { continue };
                let y = axis.at(value);
                let shown = (self.shown)(Some(value));
                let tip = format!("{name}, {}: {shown}", series.name);
                let (corner, size) = ((x + 1.0, y), (bar_width - 2.0, bottom - y));
                svg.rect(&format!("fill {}", series.class), corner, size, Some(&tip));
                svg.text("t", (x + bar_width / 2.0, y - 4.0), Anchor::Middle, &shown);
            }
            // Every other name is one line lower, so that long names do not overlap.
            let lower = if self.groups.len() > 4 && group % 2 == 1 { TEXT + 2.0 } else { 0.0 };
            let at = (left + group_width * 0.43, bottom + TEXT + 4.0 + lower);
            svg.text("t", at, Anchor::Middle, name);
        }
        file(&svg.finish(bottom + 2.0 * TEXT + 16.0, self.label))
    }

    fn axis(&self, extent: (f64, f64)) -> Axis {
        let values: Vec<f64> =
            self.series.iter().flat_map(|series| series.values.iter().flatten().copied()).collect();
        let high = values.iter().copied().fold(0.0, f64::max);
        if self.logarithmic {
            let low = values.iter().copied().filter(|value| *value > 0.0).fold(f64::INFINITY, f64::min);
            // The axis begins at half the lowest value, so that the lowest bar is visible.
            Axis::decades((if low.is_finite() { low / 2.0 } else { 1.0 }, high), extent)
        } else {
            Axis::linear((0.0, high * 1.05), extent)
        }
    }
}
