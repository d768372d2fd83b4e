//! Text from outside, such as a tool's name: made safe to show on a terminal, and short.

use std::borrow::Cow;

/// True for a character that a terminal acts upon or that hides what follows it: control characters
/// (C0, DEL and C1), line and paragraph separators, and the marks, embeddings, overrides and isolates
/// of bidirectional text.
pub fn is_unprintable(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{061C}' | '\u{200E}' | '\u{200F}')
        || matches!(c, '\u{2028}'..='\u{202E}' | '\u{2066}'..='\u{2069}')
}

/// `text` with its unprintable characters as Rust escapes, such as `\n` and `\u{1b}`. Escaping twice
/// changes nothing more.
pub fn escaped(text: &str) -> Cow<'_, str> {
    if !text.contains(is_unprintable) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match is_unprintable(c) {
            true => shown.extend(c.escape_default()),
            false => shown.push(c),
        }
    }
    Cow::Owned(shown)
}

/// The first `max` characters of `text`, the last of them `…` where there are more.
pub fn clipped(text: &str, max: usize) -> Cow<'_, str> {
    if text.chars().nth(max).is_none() {
        return Cow::Borrowed(text);
    }
    Cow::Owned(text.chars().take(max.saturating_sub(1)).chain(['…']).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_a_terminal_acts_upon_is_shown_as_an_escape() {
        assert_eq!(
            escaped("a\nb\r\t\u{1b}[2J\u{7f}\u{9b}1m\u{202e}x\u{2066}y\u{2028}é\u{1F600}\\"),
            "a\\nb\\r\\t\\u{1b}[2J\\u{7f}\\u{9b}1m\\u{202e}x\\u{2066}y\\u{2028}é\u{1F600}\\"
        );
        assert!(matches!(escaped("NeedleToTracker \"é\""), Cow::Borrowed(_)));
    }

    #[test]
    fn text_is_clipped_at_a_character() {
        assert_eq!(clipped("é\u{1F600}x", 3), "é\u{1F600}x");
        assert_eq!(clipped("é\u{1F600}xy", 3), "é\u{1F600}…");
        assert_eq!(clipped("abc", 0), "…");
    }

    proptest! {
        #[test]
        fn nothing_unprintable_is_left_and_escaping_twice_changes_nothing(text: String) {
            let once = escaped(&text).into_owned();
            prop_assert!(!once.contains(is_unprintable));
            prop_assert_eq!(escaped(&once), once.as_str());
        }
    }
}
