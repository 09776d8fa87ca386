//! Text helpers. Names come from the network, so they are made safe for terminals and logs.

/// Replaces each control character, so that the text cannot control a terminal or end a line or a string.
pub(super) fn printable(text: &str) -> String {
    text.chars().map(|char| if char.is_control() { char::REPLACEMENT_CHARACTER } else { char }).collect()
}

/// Cuts the text to at most `max_bytes`; an ellipsis marks the cut.
pub fn shortened(text: &str, max_bytes: usize) -> String {
    const ELLIPSIS: &str = "…";
    if text.len() <= max_bytes {
        return text.to_owned();
    }
    let mut cut = max_bytes.saturating_sub(ELLIPSIS.len());
    while !text.is_char_boundary(cut) {
        cut -= 1;
    }
    format!("{}{ELLIPSIS}", &text[..cut])
}

/// A count with its noun, such as `1 sample` or `3 samples`.
pub(super) fn counted(count: u64, noun: &str) -> String {
    if count == 1 { format!("1 {noun}") } else { format!("{count} {noun}s") }
}

/// A number of bytes with a unit, such as `12.0 KiB`.
pub fn bytes_text(bytes: f64) -> String {
    const KIB: f64 = 1024.0;
    match bytes {
        ..KIB => format!("{bytes:.0} B"),
        ..1_048_576.0 => format!("{:.1} KiB", bytes / KIB),
        _ => format!("{:.1} MiB", bytes / KIB / KIB),
    }
}

/// Joins parts into lines of at most `columns`. A part that is longer gets a line of its own.
pub fn wrapped<'a>(
    columns: usize,
    first: &str,
    next: &str,
    parts: impl Iterator<Item = &'a str>,
    between: &str,
) -> String {
    let mut text = String::new();
    let mut line = first.to_owned();
    let mut empty = true;
    for part in parts {
        let length = line.chars().count() + between.len() + part.trim_end().chars().count();
        if !empty && length > columns {
            text += line.trim_end();
            text.push('\n');
            line = next.to_owned();
        } else if !empty {
            line.push_str(between);
        }
        line.push_str(part);
        empty = false;
    }
    text + line.trim_end() + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_replaced() {
        assert_eq!(printable("a\x1b[2Jb\n\0\u{85}ü"), "a\u{fffd}[2Jb\u{fffd}\u{fffd}\u{fffd}ü");
    }

    #[test]
    fn a_text_is_cut_between_characters() {
        assert_eq!(shortened("scan", 4), "scan");
        assert_eq!(shortened("scanner", 6), "sca…");
        assert_eq!(shortened("sücanner", 5), "s…");
        assert_eq!(shortened("scanner", 0), "…");
    }
}
