//! Formats figures for the tables and plots of the report.

pub use adaptive_bridge_measure::format::{bytes, decimal as number};

use crate::statistics::Estimate;

/// Formats milliseconds with the precision of the paper's tables: two decimals below 10, one below 100.
pub fn ms(value: f64) -> String {
    let decimals = if value.abs() < 9.995 {
        2
    } else if value.abs() < 99.95 {
        1
    } else {
        0
    };
    number(value, decimals)
}

/// Formats hertz with one decimal, as in the paper.
pub fn hz(value: f64) -> String {
    number(value, 1)
}

/// Formats a count.
pub fn count(value: f64) -> String {
    // The median of an even number of repetitions may lie between two counts.
    number(value, usize::from(value.fract() != 0.0))
}

/// Formats a share as percent.
pub fn percent(share: f64) -> String {
    format!("{} %", number(share * 100.0, if share.abs() < 0.1 { 1 } else { 0 }))
}

/// Formats the deviation of a figure from the paper's, as difference or ratio.
pub fn deviation(ours: f64, paper: f64, shown: fn(f64) -> String) -> String {
    let difference = ours - paper;
    if shown(ours) == shown(paper) {
        return "same".to_owned();
    }
    let signed = |text: String| if difference > 0.0 { format!("+{text}") } else { text };
    if paper == 0.0 {
        return signed(shown(difference));
    }
    let ratio = ours / paper;
    match ratio {
        2.0.. => format!("× {}", number(ratio, usize::from(ratio < 10.0))),
        0.0..=0.5 if ratio > 0.0 => format!("÷ {}", number(1.0 / ratio, usize::from(ratio > 0.1))),
        _ => signed(format!("{} %", number(100.0 * (ratio - 1.0), 0))),
    }
}

/// Formats the interval of an estimate; `None` for a single value, and if both ends are formatted as the
/// median is.
pub fn interval(estimate: &Estimate, shown: fn(f64) -> String) -> Option<String> {
    let [low, median, high] = [estimate.low, estimate.median, estimate.high].map(shown);
    (estimate.count > 1 && (low != median || high != median)).then(|| format!("{low} to {high}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_format_of_the_paper() {
        assert_eq!(ms(15_013.2), "15,013");
        assert_eq!(
            (ms(0.654), ms(9.999), ms(99.96), ms(12.34)),
            ("0.65".into(), "10.0".into(), "100".into(), "12.3".into())
        );
        assert_eq!((hz(30.04), hz(-0.01), hz(-0.06)), ("30.0".into(), "0.0".into(), "−0.1".into()));
        assert_eq!((count(5400.0), count(2.5)), ("5,400".into(), "2.5".into()));
        assert_eq!((percent(0.071), percent(0.42)), ("7.1 %".into(), "42 %".into()));
    }

    #[test]
    fn deviations_are_differences_or_ratios() {
        for (ours, paper, expected) in [
            (1.55, 1.55, "same"),
            (1.24, 1.55, "−20 %"),
            (1.86, 1.55, "+20 %"),
            (30.0, 15.0, "× 2.0"),
            (15_500.0, 1.55, "× 10,000"),
            (1.5, 15_000.0, "÷ 10,000"),
            (5.0, 15.0, "÷ 3.0"),
            (0.4, 0.0, "+0.40"),
            (0.0, 8.5, "−100 %"),
        ] {
            assert_eq!(deviation(ours, paper, ms), expected, "{ours} {paper}");
        }
    }
}
