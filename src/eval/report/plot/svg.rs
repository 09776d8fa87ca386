//! The few elements of SVG that the plots need. Colours and line styles are classes, so that the page's style
//! sheet can show the same plot in dark and in light.

use std::fmt::{Display, Write as _};

use super::super::format::escape;

/// The width of every plot in its own units. At the width of a phone's screen, some 340 pixels, a text of
/// [`TEXT`] units still is 9 pixels high.
pub const WIDTH: f64 = 480.0;

/// The height of all text but headings, which are a unit larger.
pub const TEXT: f64 = 13.0;

/// How wide a text of so many characters is, about: with a typical sans-serif font of that size.
pub fn text_width(text: &str) -> f64 {
    text.chars().count() as f64 * TEXT * 0.54
}

/// Where a text is put.
#[derive(Clone, Copy)]
pub enum Anchor {
    /// It begins here.
    Start,
    /// It is centred here.
    Middle,
    /// It ends here.
    End,
}

/// A drawing that grows.
#[derive(Default)]
pub struct Svg {
    body: String,
}

impl Svg {
    /// A line.
    pub fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        let [x1, y1, x2, y2] = [from.0, from.1, to.0, to.1].map(short);
        self.put(format_args!(r#"<line class="{class}" x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}"/>"#));
    }

    /// Lines from point to point.
    pub fn polyline(&mut self, class: &str, points: &[(f64, f64)]) {
        let mut list = String::new();
        for (index, (x, y)) in points.iter().enumerate() {
            let space = if index > 0 { " " } else { "" };
            let _ = write!(list, "{space}{},{}", short(*x), short(*y));
        }
        self.put(format_args!(r#"<polyline class="{class}" points="{list}"/>"#));
    }

    /// A rectangle; `tip` is shown by browsers when it is pointed at.
    pub fn rect(&mut self, class: &str, corner: (f64, f64), size: (f64, f64), tip: Option<&str>) {
        let [x, y, width, height] = [corner.0, corner.1, size.0.max(0.0), size.1.max(0.0)].map(short);
        let attributes = format!(r#"class="{class}" x="{x}" y="{y}" width="{width}" height="{height}""#);
        match tip {
            Some(tip) => self.put(format_args!("<rect {attributes}><title>{}</title></rect>", escape(tip))),
            None => self.put(format_args!("<rect {attributes}/>")),
        }
    }

    /// A text whose baseline is at the point.
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

    /// The whole drawing, [`WIDTH`] wide; `label` tells those who can't see it what it shows.
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

/// A coordinate with a tenth of a unit, which no screen can tell from more.
fn short(value: f64) -> String {
    let tenths = (value * 10.0).round();
    if !tenths.is_finite() {
        return "0".to_owned();
    }
    // No "-0".
    format!("{}", (tenths + 0.0) / 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_closed_short_and_escaped() {
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
