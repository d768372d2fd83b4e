//! Stdout and stderr, of which neither may be taken for granted.

use super::Failure;
use crate::tracker::escape::is_unprintable;
use std::fmt::{Display, Write as _};
use std::io::{self, ErrorKind, Write};

/// Writes `text`, made [`plain`], and a line end to stdout. A reader that has left (`run --json | true`) has read
/// all that it wanted: that is no failure.
pub(super) fn say(text: impl Display) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match writeln!(stdout, "{}", plain(text, "\n\t")).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Environment(format!("stdout: {error}")))
        }
        _ => Ok(()),
    }
}

/// Writes `text`, made [`plain`], and a line end to stderr, as far as anyone takes it.
pub(super) fn tell(text: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{}", plain(text, "\n\t"));
}

/// `text` with what a terminal acts upon as `\u001b`, but for the characters in `kept`. What a peer
/// sends is escaped when it is received; this is for what comes from files, too. The form is JSON's
/// own, so that an object of `--json` stays one.
pub(super) fn plain(text: impl Display, kept: &str) -> String {
    let text = text.to_string();
    let is_acted_upon = |c: char| is_unprintable(c) && !kept.contains(c);
    if !text.contains(is_acted_upon) {
        return text;
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        // Writing to a string cannot fail.
        let _ = match is_acted_upon(c) {
            true => write!(shown, "\\u{:04x}", u32::from(c)),
            false => write!(shown, "{c}"),
        };
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    #[test]
    fn nothing_that_a_terminal_acts_upon_is_printed() {
        let text = "a\u{1b}[2J\r\u{9b}1m\u{7f}\u{202e}b\n\tc";
        assert_eq!(plain(text, "\n\t"), "a\\u001b[2J\\u000d\\u009b1m\\u007f\\u202eb\n\tc");
        assert_eq!(plain("a\nb", ""), "a\\u000ab", "in a line of the run's events");
        let object = json!({ "tool": text });
        let read: Value = serde_json::from_str(&plain(&object, "\n\t")).unwrap();
        assert_eq!(read, object, "it is still the same object");
    }
}
