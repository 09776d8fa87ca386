//! Formats values and text for tables and plots.

/// Escapes text for XML: replaces markup, quotes and control characters.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for char in text.chars() {
        match char {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            '\n' | '\t' => escaped.push(' '),
            // XML forbids control characters and the noncharacters U+FFFE and U+FFFF.
            char if char.is_control() || matches!(char, '\u{fffe}' | '\u{ffff}') => escaped.push('\u{fffd}'),
            char => escaped.push(char),
        }
    }
    escaped
}

/// A value with about three significant digits and a comma between thousands; a dash without a value.
pub fn number(value: Option<f64>) -> String {
    let Some(value) = value.filter(|value| value.is_finite()) else { return "–".to_owned() };
    let magnitude = value.abs();
    let decimals = if magnitude < 10.0 { 2 } else { usize::from(magnitude < 100.0) };
    let text = format!("{value:.decimals$}");
    let (whole, rest) = text.split_once('.').map_or((text.as_str(), ""), |(whole, rest)| (whole, rest));
    let (sign, digits) = whole.strip_prefix('-').map_or(("", whole), |digits| ("-", digits));
    let grouped = grouped(digits);
    if rest.is_empty() { format!("{sign}{grouped}") } else { format!("{sign}{grouped}.{rest}") }
}

/// A value with this many decimals and a comma between thousands.
pub fn decimal(value: f64, decimals: usize) -> String {
    let text = format!("{:.decimals$}", value.abs());
    let (whole, fraction) = text.split_once('.').unwrap_or((&text, ""));
    let mut shown = grouped(whole);
    if !fraction.is_empty() {
        shown.push('.');
        shown.push_str(fraction);
    }
    let is_zero = shown.chars().all(|c| matches!(c, '0' | '.'));
    if value < 0.0 && !is_zero { format!("−{shown}") } else { shown }
}

/// Digits with a comma between thousands.
fn grouped(digits: &str) -> String {
    let mut grouped = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped
}

/// The range from the lowest to the highest value.
pub fn range(values: &[f64]) -> String {
    let of = |better: fn(f64, f64) -> f64| values.iter().copied().reduce(better);
    match (of(f64::min), of(f64::max)) {
        (Some(low), Some(high)) => format!("{} to {}", number(Some(low)), number(Some(high))),
        _ => "–".to_owned(),
    }
}

/// A count with a comma between thousands.
pub fn count(value: u64) -> String {
    number(Some(value as f64)).split('.').next().unwrap_or_default().to_owned()
}

/// A number of bytes with one decimal, in the largest unit that gives at least 1.
pub fn bytes(value: f64) -> String {
    for (unit, size) in [("GiB", 1_073_741_824.0), ("MiB", 1_048_576.0), ("KiB", 1024.0)] {
        if value >= size {
            return format!("{} {unit}", decimal(value / size, 1));
        }
    }
    format!("{} B", decimal(value, 0))
}

/// The size of a payload with a unit: `64 B`, `2,948 B`, `64 KiB`, `1 MiB`, `2 MB`.
pub fn payload(bytes: usize) -> String {
    match bytes {
        bytes if bytes >= 1 << 20 && bytes.is_multiple_of(1 << 20) => format!("{} MiB", bytes >> 20),
        bytes if bytes >= 1 << 10 && bytes.is_multiple_of(1 << 10) => format!("{} KiB", bytes >> 10),
        bytes if bytes >= 1_000_000 && bytes.is_multiple_of(1_000_000) => format!("{} MB", bytes / 1_000_000),
        bytes => format!("{} B", count(bytes as u64)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_commas_and_units() {
        assert_eq!((decimal(1_234_567.0, 0), decimal(999.0, 0)), ("1,234,567".into(), "999".into()));
        assert_eq!((decimal(-1_500.26, 1), decimal(-0.01, 1)), ("−1,500.3".into(), "0.0".into()));
        assert_eq!(
            (bytes(512.0), bytes(614_400.0), bytes(4_194_304.0)),
            ("512 B".into(), "600.0 KiB".into(), "4.0 MiB".into())
        );
    }

    #[test]
    fn markup_and_control_characters_are_escaped() {
        assert_eq!(escape("<a b='c'>&\"\u{1b}\n"), "&lt;a b=&#39;c&#39;&gt;&amp;&quot;\u{fffd} ");
    }
}
