//! Time lines of runs: panels of several quantities above each other, with one time axis.

use adaptive_bridge_measure::plot::axis::Axis;
use adaptive_bridge_measure::plot::frame::{BELOW, Entry, LEFT, RIGHT, grid_x, grid_y, legend};
use adaptive_bridge_measure::plot::svg::{Anchor, Svg, TEXT, text_width};

use crate::statistics::Change;

const PANEL: f64 = 78.0;
const STRIP: f64 = 20.0;

/// A line of a panel.
pub struct Line<'a> {
    pub name: &'a str,
    pub class: &'a str,
    /// Seconds and value; a value that is not finite is a gap.
    pub points: Vec<(f64, f64)>,
}

/// A panel: a quantity over time.
pub struct Panel<'a> {
    pub title: &'a str,
    pub lines: Vec<Line<'a>>,
    pub logarithmic: bool,
    /// The axis covers at least this value.
    pub at_least: f64,
    pub target: Option<f64>,
}

/// A strip: states over time, as coloured bars.
pub struct Strip<'a> {
    pub title: String,
    pub changes: &'a [Change<String>],
}

/// A time line of a run.
pub struct Timeline<'a> {
    /// The text alternative for screen readers.
    pub label: &'a str,
    pub end_s: f64,
    /// Spans of time in which the link was impaired, drawn shaded.
    pub impaired: Vec<(f64, f64)>,
    /// Events, drawn as marks with a text.
    pub events: Vec<(f64, String)>,
    pub panels: Vec<Panel<'a>>,
    pub strips: Vec<Strip<'a>>,
}

impl Timeline<'_> {
    /// Draws the time line.
    pub fn draw(&self) -> String {
        let mut svg = Svg::default();
        let x = Axis::linear((0.0, self.end_s), (LEFT, RIGHT));
        let mut top = 0.0;
        let mut bottom = 0.0;
        for (index, panel) in self.panels.iter().enumerate() {
            svg.text("t strong", (0.0, top + TEXT), Anchor::Start, panel.title);
            top += TEXT + 3.0;
            if panel.lines.len() > 1 {
                let entries: Vec<Entry> = panel
                    .lines
                    .iter()
                    .map(|line| Entry { text: line.name, class: line.class, is_line: true })
                    .collect();
                top = legend(&mut svg, top, &entries) - 2.0;
            }
            top += 6.0;
            bottom = top + PANEL;
            self.draw_panel(&mut svg, panel, &x, (top, bottom), index == 0);
            top = bottom + 10.0;
        }
        for strip in &self.strips {
            svg.text("t strong", (0.0, top + TEXT), Anchor::Start, &strip.title);
            top += TEXT + 6.0;
            bottom = top + STRIP;
            self.draw_strip(&mut svg, strip, &x, top);
            top = bottom + 8.0;
        }
        grid_x(&mut svg, &x, 6, (bottom, bottom + 4.0), "time in the measured window, s");
        svg.finish(bottom + BELOW, self.label)
    }

    fn draw_panel(
        &self,
        svg: &mut Svg,
        panel: &Panel,
        x: &Axis,
        (top, bottom): (f64, f64),
        with_events: bool,
    ) {
        for (from_s, to_s) in &self.impaired {
            let (from, to) = (x.at(*from_s), x.at(*to_s));
            svg.rect("impaired", (from, top), (to - from, bottom - top), Some("link impaired"));
        }
        let values = || panel.lines.iter().flat_map(|line| &line.points).map(|point| point.1);
        let finite = || values().filter(|value| value.is_finite()).chain(panel.target);
        let high = finite().fold(panel.at_least, f64::max);
        let y = if panel.logarithmic {
            let low = finite().filter(|value| *value > 0.0).fold(high.max(1e-3), f64::min);
            Axis::decades((low, high), (bottom, top))
        } else {
            Axis::linear((0.0, high * 1.05), (bottom, top))
        };
        grid_y(svg, &y, 4);
        if let Some(target) = panel.target {
            svg.line("line target", (LEFT, y.at(target)), (RIGHT, y.at(target)));
        }
        for (at_s, word) in &self.events {
            let at = x.at(*at_s);
            svg.line("event", (at, top), (at, bottom));
            if with_events {
                let anchor = if at > (LEFT + RIGHT) / 2.0 { Anchor::End } else { Anchor::Start };
                let away = if at > (LEFT + RIGHT) / 2.0 { -3.0 } else { 3.0 };
                svg.text("t", (at + away, bottom - 5.0), anchor, word);
            }
        }
        for line in &panel.lines {
            for piece in line.points.split(|point| !point.1.is_finite()).filter(|piece| !piece.is_empty()) {
                let points: Vec<(f64, f64)> =
                    piece.iter().map(|(at_s, value)| (x.at(*at_s), y.at(*value))).collect();
                svg.polyline(&format!("line {}", line.class), &points);
            }
        }
    }

    fn draw_strip(&self, svg: &mut Svg, strip: &Strip, x: &Axis, top: f64) {
        for (index, change) in strip.changes.iter().enumerate() {
            let until_s = strip.changes.get(index + 1).map_or(self.end_s, |next| next.at_s);
            let (from, to) = (x.at(change.at_s), x.at(until_s));
            if to <= from {
                continue;
            }
            let state = change.to.to_lowercase();
            svg.rect(
                &format!("state {}", state_class(&state)),
                (from, top),
                (to - from, STRIP),
                Some(&state),
            );
            if text_width(&state) + 6.0 < to - from {
                svg.text("t on-state", ((from + to) / 2.0, top + STRIP - 6.0), Anchor::Middle, &state);
            }
        }
    }
}

/// The style class of a state or mode; unknown states are grey.
fn state_class(state: &str) -> &'static str {
    match state {
        "critical" | "normal" => "good",
        "noncritical" | "degraded" => "fair",
        "suspended" | "stopped" | "emergency" => "poor",
        _ => "none",
    }
}
