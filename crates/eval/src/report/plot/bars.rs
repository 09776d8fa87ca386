//! Bar charts by impairment (Figure 4 of the paper).

use adaptive_bridge_measure::plot::axis::Axis;
use adaptive_bridge_measure::plot::frame::{Entry, LEFT, RIGHT, grid_y, legend};
use adaptive_bridge_measure::plot::svg::{Anchor, Svg, TEXT};

use crate::statistics::Estimate;

const HEIGHT: f64 = 170.0;

/// A series of bars, one for each group; `None` if it was not run.
pub struct Series<'a> {
    pub name: &'a str,
    pub class: &'a str,
    pub values: Vec<Option<Estimate>>,
    /// The paper's values, drawn as marks.
    pub paper: Vec<Option<f64>>,
}

/// A bar chart.
pub struct Bars<'a> {
    /// The text alternative for screen readers.
    pub label: &'a str,
    pub groups: Vec<&'a str>,
    pub series: Vec<Series<'a>>,
    pub logarithmic: bool,
    /// The value of a dashed line, such as the nominal rate.
    pub target: Option<f64>,
    /// Formats the values above the bars.
    pub shown: fn(f64) -> String,
}

impl Bars<'_> {
    /// Draws the chart. A thin line through a bar's end is the interval over repetitions.
    pub fn draw(&self) -> String {
        let mut svg = Svg::default();
        let mut entries: Vec<Entry> = self
            .series
            .iter()
            .map(|series| Entry { text: series.name, class: series.class, is_line: false })
            .collect();
        if self.series.iter().any(|series| series.paper.iter().any(Option::is_some)) {
            entries.push(Entry { text: "paper", class: "paper", is_line: true });
        }
        let top = legend(&mut svg, 0.0, &entries) + TEXT + 4.0;
        let bottom = top + HEIGHT;
        let axis = self.axis((bottom, top));
        grid_y(&mut svg, &axis, if self.logarithmic { 8 } else { 5 });
        if let Some(target) = self.target {
            svg.line("line target", (LEFT, axis.at(target)), (RIGHT, axis.at(target)));
        }
        let group_width = (RIGHT - LEFT) / self.groups.len().max(1) as f64;
        let bar_width = group_width * 0.8 / self.series.len().max(1) as f64;
        for (group, name) in self.groups.iter().enumerate() {
            let left = LEFT + group_width * (group as f64 + 0.1);
            for (place, series) in self.series.iter().enumerate() {
                let x = left + bar_width * place as f64;
                self.bar(&mut svg, &axis, series, group, (x, bar_width), bottom);
            }
            svg.text("t", (left + group_width * 0.4, bottom + TEXT + 4.0), Anchor::Middle, name);
        }
        svg.finish(bottom + TEXT + 12.0, self.label)
    }

    fn bar(
        &self,
        svg: &mut Svg,
        axis: &Axis,
        series: &Series,
        group: usize,
        (x, width): (f64, f64),
        bottom: f64,
    ) {
        let middle = x + width / 2.0;
        let paper = series.paper.get(group).copied().flatten();
        match series.values.get(group).copied().flatten() {
            Some(estimate) => {
                let y = axis.at(estimate.median);
                let tip =
                    format!("{}, {}: {}", self.groups[group], series.name, (self.shown)(estimate.median));
                let (corner, size) = ((x + 1.0, y), (width - 2.0, bottom - y));
                svg.rect(&format!("fill {}", series.class), corner, size, Some(&tip));
                let mut above = y;
                if estimate.count > 1 {
                    let (low, high) = (axis.at(estimate.low), axis.at(estimate.high));
                    svg.line("whisker", (middle, low), (middle, high));
                    above = high;
                }
                // Move the text above the paper's mark if they would overlap.
                if let Some(mark) =
                    paper.map(|paper| axis.at(paper)).filter(|mark| (above - TEXT..=above).contains(mark))
                {
                    above = mark;
                }
                svg.text("t", (middle, above - 4.0), Anchor::Middle, &(self.shown)(estimate.median));
            }
            None => svg.text("t weak", (middle, bottom - 4.0), Anchor::Middle, "–"),
        }
        if let Some(paper) = paper {
            let y = axis.at(paper);
            svg.line("line paper", (x - 1.0, y), (x + width + 1.0, y));
        }
    }

    fn axis(&self, extent: (f64, f64)) -> Axis {
        let ours = self.series.iter().flat_map(|series| series.values.iter().flatten());
        let paper = self.series.iter().flat_map(|series| series.paper.iter().flatten().copied());
        let values: Vec<f64> =
            ours.flat_map(|one| [one.median, one.low, one.high]).chain(paper).chain(self.target).collect();
        let high = values.iter().copied().fold(0.0, f64::max);
        if self.logarithmic {
            let low = values.iter().copied().filter(|value| *value > 0.0).fold(f64::INFINITY, f64::min);
            Axis::decades((if low.is_finite() { low } else { 1.0 }, high), extent)
        } else {
            Axis::linear((0.0, high * 1.05), extent)
        }
    }
}
