//! Cumulative distributions of latency (Figure 5 of the paper).

use adaptive_bridge_measure::plot::axis::Axis;
use adaptive_bridge_measure::plot::frame::{BELOW, Entry, LEFT, RIGHT, grid_x, grid_y, legend};
use adaptive_bridge_measure::plot::svg::{Anchor, Svg, TEXT};

use crate::statistics::Distribution;

const HEIGHT: f64 = 190.0;

/// Points of a curve: about one for each unit of the frame's width; more would not be visible.
const POINTS: usize = 400;

/// The distribution of a curve, with its name and style.
pub struct Curve<'a> {
    pub name: &'a str,
    pub class: &'a str,
    pub latencies_ms: Distribution,
}

/// Draws cumulative distributions: the share of samples with at most a latency. The logarithmic axis covers
/// `range_ms`, so that two plots with the same range can be compared.
pub fn cdf(label: &str, curves: &[Curve], range_ms: (f64, f64)) -> String {
    let mut svg = Svg::default();
    let names: Vec<Entry> =
        curves.iter().map(|curve| Entry { text: curve.name, class: curve.class, is_line: true }).collect();
    let top = legend(&mut svg, 0.0, &names) + 6.0;
    let bottom = top + HEIGHT;
    let x = Axis::decades(range_ms, (LEFT, RIGHT));
    let y = Axis::linear((0.0, 1.0), (bottom, top));
    grid_x(&mut svg, &x, 9, (top, bottom), "latency of the critical subscriber, ms");
    grid_y(&mut svg, &y, 5);
    for curve in curves {
        let mut points = Vec::with_capacity(2 * POINTS);
        for (value, share) in curve.latencies_ms.curve(POINTS) {
            let (at, level) = (x.at(value), y.at(share));
            // Steps: the share increases at its value, not before.
            let before = points.last().map_or(bottom, |point: &(f64, f64)| point.1);
            points.push((at, before));
            points.push((at, level));
        }
        if points.is_empty() {
            continue;
        }
        svg.polyline(&format!("line {}", curve.class), &points);
    }
    if curves.iter().all(|curve| curve.latencies_ms.count() == 0) {
        svg.text("t", ((LEFT + RIGHT) / 2.0, (top + bottom) / 2.0), Anchor::Middle, "not run");
    }
    svg.finish(bottom + BELOW + TEXT * 0.2, label)
}
