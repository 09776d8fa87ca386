//! Writes the SVG elements that the plots need. Colours and line styles are classes, so that the page's style
//! sheet has a dark and a light mode for the same plot.

use std::fmt::{Display, Write as _};

use crate::format::escape;

/// The width of every plot in its own units. On a phone's screen, about 340 pixels wide, a text of [`TEXT`]
/// units is 9 pixels high.
pub const WIDTH: f64 = 480.0;

/// The height of all text but headings, which are a unit larger.
pub const TEXT: f64 = 13.0;

/// Estimates the width of a text in a typical sans-serif font.
pub fn text_width(text: &str) -> f64 {
    text.chars().count() as f64 * TEXT * 0.54
}

/// The alignment of a text relative to its point.
#[derive(Clone, Copy)]
pub enum Anchor {
    /// The text starts at the point.
    Start,
    /// The text is centred at the point.
    Middle,
    /// The text ends at the point.
    End,
}

/// An SVG drawing to which elements are added.
#[derive(Default)]
pub struct Svg {
    body: String,
}

impl Svg {
    /// Adds a line.
    pub fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        let [x1, y1, x2, y2] = [from.0, from.1, to.0, to.1].map(short);
        self.put(format_args!(r#"<line class="{class}" x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}"/>"#));
    }

    /// Adds a polyline.
    pub fn polyline(&mut self, class: &str, points: &[(f64, f64)]) {
        let mut list = String::new();
        for (index, (x, y)) in points.iter().enumerate() {
            let space = if index > 0 { " " } else { "" };
            let _ = write!(list, "{space}{},{}", short(*x), short(*y));
        }
        self.put(format_args!(r#"<polyline class="{class}" points="{list}"/>"#));
    }

    /// Adds a rectangle; browsers show `tip` when the pointer is over it.
    pub fn rect(&mut self, class: &str, corner: (f64, f64), size: (f64, f64), tip: Option<&str>) {
        let [x, y, width, height] = [corner.0, corner.1, size.0.max(0.0), size.1.max(0.0)].map(short);
        let attributes = format!(r#"class="{class}" x="{x}" y="{y}" width="{width}" height="{height}""#);
        match tip {
            Some(tip) => self.put(format_args!("<rect {attributes}><title>{}</title></rect>", escape(tip))),
            None => self.put(format_args!("<rect {attributes}/>")),
        }
    }

    /// Adds a text whose baseline is at the point.
    pub fn text(&mut self, class: &str, at: (f64, f64), anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let [x, y] = [at.0, at.1].map(short);
        let text = escape(text);
        self.put(format_args!(
            r#"<text class="{class}" x="{x}" y="{y}" text-anchor="{anchor}">{text}</text>"#
        ));
    }

    /// Returns the SVG element, [`WIDTH`] wide; `label` is the text alternative for screen readers.
    pub fn finish(self, height: f64, label: &str) -> String {
        let (width, height) = (short(WIDTH), short(height));
        let attributes =
            format!(r#"viewBox="0 0 {width} {height}" role="img" aria-label="{}""#, escape(label));
        format!(r#"<svg xmlns="http://www.w3.org/2000/svg" {attributes}>{}</svg>"#, self.body)
    }

    fn put(&mut self, element: impl Display) {
        let _ = writeln!(self.body, "{element}");
    }
}

/// Formats a coordinate with one decimal; more would not be visible.
fn short(value: f64) -> String {
    let tenths = (value * 10.0).round();
    if !tenths.is_finite() {
        return "0".to_owned();
    }
    // Adding 0.0 turns -0.0 into 0.0.
    format!("{}", (tenths + 0.0) / 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_closed_and_escaped_with_rounded_coordinates() {
        let mut svg = Svg::default();
        svg.line("a", (0.04, -0.04), (1.0, f64::NAN));
        svg.polyline("b", &[(1.234, 2.0), (3.0, 4.06)]);
        svg.rect("c", (1.0, 2.0), (-3.0, 4.0), Some("x < y"));
        svg.text("d", (1.0, 2.0), Anchor::End, "\"é\"");
        let text = svg.finish(10.0, "a & b");
        assert!(text.contains(r#"<line class="a" x1="0" y1="0" x2="1" y2="0"/>"#), "{text}");
        assert!(text.contains(r#"points="1.2,2 3,4.1""#), "{text}");
        assert!(text.contains(r#"width="0" height="4"><title>x &lt; y</title></rect>"#), "{text}");
        assert!(text.contains(r#"text-anchor="end">&quot;é&quot;</text>"#), "{text}");
        assert!(text.contains(r#"aria-label="a &amp; b""#), "{text}");
    }
}
