//! Texts of others: names of nodes and hosts come from the network and end on terminals and in log files.

/// The text with each control character replaced, so that it can steer no terminal and end no line or string.
pub(super) fn printable(text: &str) -> String {
    text.chars().map(|char| if char.is_control() { char::REPLACEMENT_CHARACTER } else { char }).collect()
}

/// The text, cut to so many bytes at most, an ellipsis in place of what is missing.
pub(super) fn shortened(text: &str, max_bytes: usize) -> String {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_steers_a_terminal() {
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
