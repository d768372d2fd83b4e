//! Makes text from outside, such as a tool's name, safe to show on a terminal, and short. Renders screens from
//! templates, and tables.

use minijinja::syntax::SyntaxConfig;
use minijinja::value::Serde;
use minijinja::{Environment, Error, UndefinedBehavior, Value, context};
use serde::Serialize;
use std::borrow::Cow;
use std::fmt::Display;

/// True for a character that a terminal acts upon, or that changes how the text after it is shown: control
/// characters (C0, DEL and C1), line and paragraph separators, and the marks, embeddings, overrides and
/// isolates of bidirectional text.
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

/// `word`, such as a path, quoted for a shell if necessary.
pub fn shell_word(word: impl Display) -> String {
    let word = word.to_string();
    let is_bare = |c: char| c.is_ascii_alphanumeric() || "_-./=:,+%".contains(c);
    match !word.is_empty() && word.chars().all(is_bare) {
        true => word,
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

/// `text` truncated to `max` characters; the last of them is `…` if anything was cut.
pub fn clipped(text: &str, max: usize) -> Cow<'_, str> {
    if text.chars().nth(max).is_none() {
        return Cow::Borrowed(text);
    }
    Cow::Owned(text.chars().take(max.saturating_sub(1)).chain(['…']).collect())
}

/// Longest line of an operator's message, characters.
const LINE_MAX: usize = 199;
/// Indentation of the continuation of a broken line.
const INDENT: &str = "       ";

/// `text` with its longer lines broken in their second half: after the last semicolon there, otherwise at
/// the last space.
pub fn wrapped(text: &str) -> Cow<'_, str> {
    if text.lines().all(|line| line.chars().nth(LINE_MAX).is_none()) {
        return Cow::Borrowed(text);
    }
    let mut lines = Vec::new();
    for mut unbroken in text.split('\n') {
        let mut indent = "";
        while let Some((end, _)) = unbroken.char_indices().nth(LINE_MAX - indent.len()) {
            let line = &unbroken[..end];
            let in_second_half = |space: &usize| *space > end / 2;
            let semicolon = line.rfind("; ").map(|semicolon| semicolon + 1).filter(in_second_half);
            let space = semicolon.or_else(|| line.rfind(' ').filter(in_second_half));
            let Some(space) = space else { break };
            lines.push(format!("{indent}{}", &line[..space]));
            (unbroken, indent) = (&unbroken[space + 1..], INDENT);
        }
        lines.push(format!("{indent}{unbroken}"));
    }
    Cow::Owned(lines.join("\n"))
}

/// The screen that `template` (minijinja) describes, with the fields of `object` and the values of
/// `more`. A template line that holds only a statement gives no line. The filters `escaped`, `fixed` and `table`
/// are [`escaped`], [`fixed`] and the lines of [`table`].
///
/// # Errors
/// A mistake in the template, or a value that is missing.
pub fn screen(template: &str, object: &impl Serialize, more: Value) -> Result<String, Error> {
    let mut environment = Environment::new();
    environment.set_syntax(SyntaxConfig::builder().trim_blocks(true).lstrip_blocks(true).build()?);
    environment.set_undefined_behavior(UndefinedBehavior::Strict);
    environment.add_filter("escaped", |text: &str| escaped(text).into_owned());
    environment.add_filter("fixed", fixed);
    environment.add_filter("part_of", part_of);
    environment.add_filter("table", |rows: Vec<Vec<String>>| table(&rows).join("\n"));
    let values = context! { ..more, ..Value::from(Serde(object)) };
    let screen = environment.template_from_str(template)?.render(values)?;
    Ok(screen.trim_end_matches('\n').to_owned())
}

/// ` (1 of 2)` if a figure comes from some of the recordings; empty if it comes from all or none of them.
fn part_of(count: u64, total: u64) -> String {
    if (1..total).contains(&count) { format!(" ({count} of {total})") } else { String::new() }
}

/// `value` with this many `decimals`. Infinity, a depth or time that is never reached, is `never`; `None` is a
/// dash. A zero has no sign.
pub fn fixed(value: Option<f64>, decimals: usize) -> String {
    match value {
        None => "-".to_owned(),
        Some(f64::INFINITY) => "never".to_owned(),
        Some(value) => {
            let text = format!("{value:.decimals$}");
            let is_zero = |digits: &&str| digits.bytes().all(|byte| matches!(byte, b'0' | b'.'));
            text.strip_prefix('-').filter(is_zero).map_or(text.clone(), str::to_owned)
        }
    }
}

/// Lines from rows of cells. Each column is as wide as its widest cell. The first and the last
/// column are aligned left, the others right.
pub fn table(rows: &[Vec<String>]) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max()
    };
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, width))| {
            if column == 0 || column + 1 == columns {
                format!("{cell:<width$}")
            } else {
                format!("{cell:>width$}")
            }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_value_that_rounds_to_zero_has_no_sign() {
        let text = [-0.0, -0.04, -0.06].map(|value| fixed(Some(value), 1));
        assert_eq!(text, ["0.0", "0.0", "-0.1"]);
    }

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(
            escaped("a\nb\r\t\u{1b}[2J\u{7f}\u{9b}1m\u{202e}x\u{2066}y\u{2028}é\u{1F600}\\"),
            "a\\nb\\r\\t\\u{1b}[2J\\u{7f}\\u{9b}1m\\u{202e}x\\u{2066}y\\u{2028}é\u{1F600}\\"
        );
        assert!(matches!(escaped("NeedleToTracker \"é\""), Cow::Borrowed(_)));
    }

    #[test]
    fn a_path_is_one_word_for_a_shell() {
        let words = ["runs/a-1.toml", "my runs/a", "it's", ""].map(shell_word);
        assert_eq!(words, ["runs/a-1.toml", "'my runs/a'", r"'it'\''s'", "''"]);
    }

    #[test]
    fn long_lines_are_wrapped_at_a_semicolon_or_a_space() {
        let short = "a short line\nanother";
        assert!(matches!(wrapped(short), Cow::Borrowed(_)));
        let (half, rest) = ("é".repeat(110), "word ".repeat(50));
        let text = format!("first\n{half}; {rest}end");
        let lines: Vec<String> = wrapped(&text).lines().map(str::to_owned).collect();
        assert_eq!(lines[..2], ["first".to_owned(), format!("{half};")]);
        assert!(lines.iter().all(|line| line.chars().count() <= LINE_MAX), "{lines:?}");
        assert!(lines[2..].iter().all(|line| line.starts_with("       word")), "{lines:?}");
        assert_eq!(lines.join("\n").replace("\n       ", " "), text);
        let path = "x".repeat(300);
        assert_eq!(wrapped(&path), path, "it has no place to break");
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

    #[test]
    fn numbers_are_rounded_and_a_missing_one_is_a_dash() {
        assert_eq!(fixed(Some(0.15), 1), "0.1");
        assert_eq!(
            (fixed(Some(f64::INFINITY), 1), fixed(None, 1)),
            ("never".to_owned(), "-".to_owned())
        );
    }

    #[test]
    fn a_template_statement_leaves_no_empty_line() {
        let template = "a\n{% for n in [1, none] %}\n{{ n|fixed(2) }} {{ unit }}\n{% endfor %}\n";
        let object = std::collections::BTreeMap::from([("unit", "mm")]);
        assert_eq!(screen(template, &object, context! {}).unwrap(), "a\n1.00 mm\n- mm");
        let absent = screen("{{ absent }}", &object, context! {}).unwrap_err().to_string();
        assert!(absent.contains("undefined"), "{absent}");
    }

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let rows = [["a", "1.0", "x y"], ["long", "100.0", ""]];
        let rows = rows.map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(table(&rows), ["a       1.0  x y", "long  100.0"]);
    }
}
