//! The picture of a demo: an SVG of the scans that the critical subscriber received in both phases.
//!
//! One file for light and dark: a style sheet follows the reader's colour scheme, and the drawing has a
//! background of its own, because a page may have another scheme than the reader's system. Pure.

use std::fmt::Write;

use super::outcome::Outcome;
use super::tally::{BIN_MS, Figures};
use super::{HISTORY_SCANS, RATE_HZ, STALL_EVERY_MS, STALL_MS};

const WIDTH: f64 = 800.0;
const HEIGHT: f64 = 484.0;
/// The left and right ends of both plots.
const LEFT: f64 = 62.0;
const RIGHT: f64 = 776.0;
const TOPS: [f64; 2] = [118.0, 288.0];
const PLOT_HEIGHT: f64 = 110.0;
/// The upper end of the rate axis: the rate, and room above its line.
const MOST_HZ: f64 = RATE_HZ as f64 * 1.2;
const MARKS: u64 = 12;

const STYLE: &str = "
  .back{fill:#fff} text{fill:#1f2328;font:14px system-ui,'Segoe UI',Helvetica,Arial,sans-serif}
  .title{font-size:18px;font-weight:600} .name{font-weight:600} .minor{fill:#59636e;font-size:13px}
  .end{text-anchor:end} .middle{text-anchor:middle}
  .stall{fill:#ffe3d3} .stalled{fill:#a33a00;font-size:13px;text-anchor:middle}
  .area{fill:#0969da;fill-opacity:.13} .curve{fill:none;stroke:#0969da;stroke-width:2}
  .axis{stroke:#818b98} .grid{stroke:#818b98;stroke-opacity:.35}
  @media (prefers-color-scheme:dark){
    .back{fill:#0d1117} text{fill:#f0f6fc} .minor{fill:#9198a1}
    .stall{fill:#4a2410} .stalled{fill:#ffb083}
    .area{fill:#58a6ff} .curve{stroke:#58a6ff}
  }
";

pub(super) fn picture(outcome: &Outcome) -> String {
    let phases = [
        ("Without the bridge: one writer for both", &outcome.without_bridge),
        ("With the bridge: a writer for each", &outcome.with_bridge),
    ];
    let [without, with] = [&outcome.without_bridge.critical, &outcome.with_bridge.critical];
    let title = format!(
        "Critical subscriber: {} of {} scans missed, {} with the bridge",
        without.lost,
        without.lost + without.received,
        with.lost
    );
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\">\n\
         <title>{title}</title>\n<style>{STYLE}</style>\n\
         <rect class=\"back\" width=\"{WIDTH}\" height=\"{HEIGHT}\" rx=\"6\"/>\n"
    );
    text(&mut svg, "title", (24.0, 36.0), &title);
    let subtitle = "Scans received per second by the critical subscriber, whose own link works all the time";
    text(&mut svg, "minor", (24.0, 60.0), subtitle);
    let seconds = outcome.seconds_per_phase;
    for ((name, figures), top) in phases.into_iter().zip(TOPS) {
        plot(&mut svg, name, figures, seconds, top);
    }
    let source = format!(
        "adaptive-bridge demo: {RATE_HZ} scans a second, a history of {HISTORY_SCANS} scans at the publisher;",
    );
    text(&mut svg, "minor", (24.0, HEIGHT - 34.0), &source);
    let stalls = format!(
        "the remote subscriber is stopped for {} s of every {} s and acknowledges nothing",
        STALL_MS / 1_000,
        STALL_EVERY_MS / 1_000,
    );
    text(&mut svg, "minor", (24.0, HEIGHT - 16.0), &stalls);
    svg + "</svg>\n"
}

fn plot(svg: &mut String, name: &str, figures: &Figures, seconds: u64, top: f64) {
    let bottom = top + PLOT_HEIGHT;
    let x = |at_s: f64| LEFT + at_s / seconds as f64 * (RIGHT - LEFT);
    let y = |rate_hz: f64| bottom - rate_hz.min(MOST_HZ) / MOST_HZ * PLOT_HEIGHT;
    text(svg, "name", (LEFT, top - 14.0), name);
    let critical = &figures.critical;
    let result = format!(
        "{} of {} scans, longest silence {:.2} s",
        critical.received,
        figures.publisher.due,
        critical.silence_max_ms / 1e3
    );
    text(svg, "end", (RIGHT, top - 14.0), &result);

    for (index, stall) in figures.timeline.stalls_s.iter().enumerate() {
        let (from, to) = (x(stall.start), x(stall.end));
        let width = to - from;
        // Writing to a string cannot fail.
        let _ = writeln!(
            svg,
            "<rect class=\"stall\" x=\"{from:.1}\" y=\"{top}\" width=\"{width:.1}\" height=\"{PLOT_HEIGHT}\"/>"
        );
        if index == 0 && width > 100.0 {
            text(svg, "stalled", ((from + to) / 2.0, top + 14.0), "remote link fails");
        }
    }
    for rate_hz in [0, RATE_HZ / 2, RATE_HZ] {
        let at = y(rate_hz as f64);
        let class = if rate_hz == 0 { "axis" } else { "grid" };
        let _ = writeln!(
            svg,
            "<line class=\"{class}\" x1=\"{LEFT}\" y1=\"{at:.1}\" x2=\"{RIGHT}\" y2=\"{at:.1}\"/>"
        );
        text(svg, "minor end", (LEFT - 8.0, at + 4.0), &format!("{rate_hz}"));
    }
    text(svg, "minor", (24.0, top - 14.0), "Hz");

    let bin_s = BIN_MS as f64 / 1e3;
    let mut steps = String::new();
    for (index, scans) in figures.timeline.critical.iter().enumerate() {
        let (from, to) = (x(index as f64 * bin_s), x((index + 1) as f64 * bin_s));
        let at = y(*scans as f64 / bin_s);
        let _ = write!(steps, " {from:.1},{at:.1} {to:.1},{at:.1}");
    }
    let steps = steps.trim_start();
    if !steps.is_empty() {
        let end = x(figures.timeline.critical.len() as f64 * bin_s);
        let _ = writeln!(
            svg,
            "<polygon class=\"area\" points=\"{LEFT},{bottom} {steps} {end:.1},{bottom}\"/>\n\
             <polyline class=\"curve\" points=\"{steps}\"/>"
        );
    }

    let every_s = [1, 2, 3, 6, 15, 30, 60].into_iter().find(|every_s| seconds / every_s <= MARKS);
    for at_s in (0..=seconds).step_by(every_s.unwrap_or(60) as usize) {
        let unit = if at_s == 0 { " s" } else { "" };
        text(svg, "minor middle", (x(at_s as f64), bottom + 18.0), &format!("{at_s}{unit}"));
    }
}

/// Adds a text, which has no characters that XML would need to escape.
fn text(svg: &mut String, class: &str, (x, y): (f64, f64), text: &str) {
    let _ = writeln!(svg, "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\">{text}</text>");
}
