//! TOML text as a flat list of dotted keys, each with its value and its line.

use derive_more::Display;
use serde::Deserialize as _;
use toml::de::{DeArray, DeTable, DeValue, ValueDeserializer};
use toml::{Spanned, Table, Value};

use super::error::{ConfigError, Problem};
use super::reader::is_inside;
use crate::keys::join;
use crate::text::clipped;

/// Where a value was given.
#[derive(Debug, Clone, PartialEq, Eq, Display)]
pub enum Origin {
    /// A line of a file, from 1.
    #[display("{name}:{line}: ")]
    File {
        /// The file's name, as the user gave it.
        name: String,
        /// Number of the line, from 1.
        line: usize,
    },
    /// `--set` on the command line.
    #[display("--set ")]
    Set,
}

/// One value of one source. The keys of a table and the elements of an array, `key[0]`, `key[1]` …, are
/// entries of their own.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    /// Empty for a table. An array has the right number of elements, but not their values.
    pub(super) value: Value,
    /// The value as the user wrote it, on one line.
    pub(super) source_text: String,
    pub(super) origin: Origin,
    /// Precedence of its source: a higher layer overrides a lower one; 0 is the defaults.
    pub(super) layer: usize,
}

impl Entry {
    /// True if both entries come from one source: from one file, or from the command line.
    pub(super) fn is_same_source(&self, other: &Entry) -> bool {
        let is_set = |entry: &Entry| entry.layer > 0 && entry.origin == Origin::Set;
        self.layer == other.layer || is_set(self) && is_set(other)
    }
}

/// Entries of one or more sources, as (dotted key, entry). The entries of one source are in the order of its text.
pub(super) type Entries = Vec<(String, Entry)>;

/// Reads a TOML file.
///
/// # Errors
/// The syntax errors of the file, at most one per line. A duplicate key is one too.
pub(super) fn parse_file(name: &str, text: &str, layer: usize) -> Result<Entries, ConfigError> {
    let (entries, errors) = recover_file(name, text, layer);
    if errors.is_empty() {
        return Ok(entries);
    }
    let problem = |error: toml::de::Error| {
        let span = error.span().unwrap_or(text.len()..text.len());
        let (line, column) = position(text, span.start);
        let found = text.get(span).unwrap_or_default();
        let message = match error.message() {
            "duplicate key" => duplicate_key(&entries, text, line, found),
            message => number_with_unit(text, line).unwrap_or_else(|| message.replace('\n', ", ")),
        };
        let origin = Some(Origin::File { name: name.to_owned(), line });
        Problem { origin, message: format!("{name}:{line}:{column}: {message}") }
    };
    let mut problems: Vec<Problem> = errors.into_iter().map(problem).collect();
    problems.dedup_by(|next, last| next.origin == last.origin);
    Err(ConfigError { problems })
}

/// The part of a TOML file that can be read, and its errors. If a key is given twice, the first one counts.
pub(super) fn recover_file(
    name: &str,
    text: &str,
    layer: usize,
) -> (Entries, Vec<toml::de::Error>) {
    let (table, errors) = DeTable::parse_recoverable(text);
    let mut flat = Flattener { file: Some(name), text, layer, entries: Vec::new() };
    flat.table("", table.get_ref());
    (flat.entries, errors)
}

/// The message for a key or table `found` on `line` of `text` that an earlier line, one of `entries`, gave
/// already.
fn duplicate_key(entries: &Entries, text: &str, line: usize, found: &str) -> String {
    let source_line = text.lines().nth(line - 1).unwrap_or_default().trim_start();
    let table = source_line.strip_prefix('[').and_then(|header| header.split(']').next());
    let name = found.trim_matches(['"', '\'']);
    let before = entries.iter().filter_map(|(key, entry)| match entry.origin {
        Origin::File { line: first, .. } if first < line => Some((key, first)),
        _ => None,
    });
    let first = match table {
        Some(table) => {
            let is_inside = |key: &String| key == table || is_inside(key, table);
            before.filter(|(key, _)| is_inside(key)).min_by_key(|(_, first)| *first)
        }
        // The keys of one table are contiguous.
        None => {
            let is_same = |key: &String| key.rsplit('.').next() == Some(name);
            before.filter(|(key, _)| is_same(key)).max_by_key(|(_, first)| *first)
        }
    };
    let key = table.or(first.map(|(key, _)| key.as_str())).unwrap_or(found);
    let first = first.map(|(_, first)| format!(", first on line {first}")).unwrap_or_default();
    format!("{key} is given twice{first}: keep one")
}

/// The message for a number with a unit behind it, such as `depth_mm = 20 mm`.
fn number_with_unit(text: &str, line: usize) -> Option<String> {
    let (key, value) = text.lines().nth(line - 1)?.split_once('=')?;
    let value = value.split('#').next()?.trim();
    let is_of_number = |c: char| c.is_ascii_digit() || "+-._".contains(c);
    let (number, unit) = value.split_at(value.find(|c| !is_of_number(c))?);
    let is_of_unit = |c: char| c.is_alphabetic() || "°µ%/²^".contains(c) || c.is_ascii_digit();
    // A "0" may be the beginning of a hexadecimal number, "0x…".
    number.parse::<f64>().ok().filter(|_| number != "0")?;
    let (key, unit) = (key.trim(), unit.trim());
    let is_unit = unit.chars().all(is_of_unit) && !unit.starts_with(|c: char| c.is_ascii_digit());
    is_unit.then(|| {
        format!("{key} is {number} {unit}: write only the number, in the unit of the key's name")
    })
}

/// Reads one `key=value` of `--set`. A default is read in the same way, in layer 0.
///
/// The value is TOML. A value that is not valid TOML is a string, because shells remove quotes:
/// `--set can.interface=can0` and `--set 'can.interface="can0"'` are the same.
///
/// # Errors
/// If the key or the value is missing, or if the value begins like a TOML string, array or table but is
/// not valid.
pub(super) fn parse_set(text: &str, layer: usize) -> Result<Entries, ConfigError> {
    let refusal = |message: String| ConfigError::at(Some(Origin::Set), message);
    let (key, written) =
        text.split_once('=').map(|(k, v)| (k.trim(), v.trim())).unwrap_or_default();
    if key.is_empty() || written.is_empty() || key.split('.').any(str::is_empty) {
        return Err(refusal(format!(
            "{text}: expected key=value, for example insertion.depth_mm=100"
        )));
    }
    match DeValue::parse(written) {
        Ok(value) => {
            let mut flat = Flattener { file: None, text: written, layer, entries: Vec::new() };
            flat.value(key.to_owned(), &value);
            Ok(flat.entries)
        }
        Err(error) if written.starts_with(['"', '\'', '[', '{']) => {
            let found = error.span().and_then(|span| written.get(span)).unwrap_or_default();
            let message = match error.message() {
                "duplicate key" => format!("{found} is given twice: keep one"),
                message => {
                    format!("{written} is not a TOML value: {}", message.replace('\n', ", "))
                }
            };
            Err(refusal(format!("{key}: {message}")))
        }
        Err(_) => {
            let value = Value::String(written.to_owned());
            let source_text = format!("{written:?}");
            Ok(vec![(key.to_owned(), Entry { value, source_text, origin: Origin::Set, layer })])
        }
    }
}

/// Line and column of a byte offset, both from 1; the column counts characters.
fn position(text: &str, offset: usize) -> (usize, usize) {
    let before = text.get(..offset.min(text.len())).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    let column = before[line_start..].chars().count() + 1;
    (before.matches('\n').count() + 1, column)
}

/// Turns the tables of one source into entries.
struct Flattener<'a> {
    /// The file's name; `None` on the command line.
    file: Option<&'a str>,
    text: &'a str,
    layer: usize,
    entries: Entries,
}

impl Flattener<'_> {
    fn table(&mut self, path: &str, table: &DeTable<'_>) {
        for (name, value) in table {
            self.value(join(path, name.get_ref()), value);
        }
    }

    fn value(&mut self, key: String, spanned: &Spanned<DeValue<'_>>) {
        let value = match spanned.get_ref() {
            // Such as 1e999, which is infinite.
            DeValue::Float(float) => Value::from(float.as_str().parse().unwrap_or(f64::NAN)),
            DeValue::Array(array) => Value::from(vec![false; array.len()]),
            DeValue::Table(_) => Value::from(Table::new()),
            // No key takes an integer of more than 64 bits.
            _ => Value::deserialize(ValueDeserializer::from(spanned.clone()))
                .unwrap_or(Value::from(i64::MAX)),
        };
        let origin = self.file.map_or(Origin::Set, |name| {
            let (line, _) = position(self.text, spanned.span().start);
            Origin::File { name: name.to_owned(), line }
        });
        let source_text = self.source_text(&value, spanned);
        let entry = Entry { value, source_text, origin, layer: self.layer };
        self.entries.push((key.clone(), entry));
        match spanned.get_ref() {
            DeValue::Table(table) => self.table(&key, table),
            DeValue::Array(array) => {
                for (i, item) in array.iter().enumerate() {
                    self.value(format!("{key}[{i}]"), item);
                }
            }
            _ => {}
        }
    }

    /// The value as the user wrote it, on one line, truncated to 60 characters and `…`.
    fn source_text(&self, value: &Value, spanned: &Spanned<DeValue<'_>>) -> String {
        if value.is_table() {
            return "a table".to_owned();
        }
        let text = self.text.get(spanned.span()).unwrap_or_default();
        let tables = |array: &DeArray<'_>| array.iter().all(|item| item.get_ref().is_table());
        if text.starts_with("[[") && spanned.get_ref().as_array().is_some_and(tables) {
            return "an array of tables".to_owned();
        }
        clipped(&text.split_whitespace().collect::<Vec<_>>().join(" "), 61).into_owned()
    }
}
