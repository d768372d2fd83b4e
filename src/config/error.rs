//! The errors of a configuration, one line for each, and hints for unknown keys.

use std::collections::BTreeSet;
use std::fmt;

use super::value::Origin;

/// At most this many problems are printed.
const SHOWN_MAX: usize = 10;

/// One error in a configuration: its place, the key, the value, and what is allowed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Where the offending value was given; `None` for a key that is not given.
    pub origin: Option<Origin>,
    /// The whole message, which begins with the place.
    pub message: String,
}

impl Problem {
    /// A problem at `origin`; `message` begins with its key.
    pub(super) fn at(origin: Option<Origin>, message: impl fmt::Display) -> Self {
        let place = origin.as_ref().map(Origin::to_string).unwrap_or_default();
        Problem { message: format!("{place}{message}"), origin }
    }
}

/// All errors of a configuration that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct ConfigError {
    /// At least one.
    pub problems: Vec<Problem>,
}

impl ConfigError {
    /// Fails with the `problems`, if there are any.
    pub(super) fn unless_empty(problems: Vec<Problem>) -> Result<(), Self> {
        if problems.is_empty() { Ok(()) } else { Err(ConfigError { problems }) }
    }

    /// One problem at `origin`.
    pub(super) fn at(origin: Option<Origin>, message: impl fmt::Display) -> Self {
        ConfigError { problems: vec![Problem::at(origin, message)] }
    }
}

/// One problem without a place in a file.
impl From<String> for ConfigError {
    fn from(message: String) -> Self {
        ConfigError::at(None, message)
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = self.problems.iter().take(SHOWN_MAX).map(|problem| problem.message.as_str());
        f.write_str(&shown.collect::<Vec<_>>().join("\n"))?;
        match self.problems.len().saturating_sub(SHOWN_MAX) {
            0 => Ok(()),
            more => write!(f, "\nand {more} more"),
        }
    }
}

/// Lowest similarity, from 0 to 1, at which a known key is suggested.
const SIMILARITY_MIN: f64 = 0.55;

/// Longest list of keys in a message, characters.
const LISTED_MAX: usize = 110;

/// A hint for the unknown `key`: the nearest of the known `keys`, or the keys and sections of its section.
pub fn nearest_key<'a>(key: &str, keys: impl Iterator<Item = &'a str> + Clone) -> String {
    let rated = keys.clone().map(|known| (similarity(key, known), known));
    if let Some((similarity, known)) = rated.max_by(|a, b| a.0.total_cmp(&b.0))
        && similarity >= SIMILARITY_MIN
    {
        return format!("did you mean \"{known}\"?");
    }
    let (section, _) = split(key);
    let below = |known: &'a str| match section {
        "" => Some(known),
        _ => known.strip_prefix(section)?.strip_prefix('.'),
    };
    let names = keys.filter_map(below).map(|path| path.split('.').next().unwrap_or(path));
    let siblings: Vec<&str> = names.collect::<BTreeSet<_>>().into_iter().collect();
    match (siblings.is_empty(), section) {
        (true, _) => "no known key is like it".to_owned(),
        (false, "") => format!("known are {}", listed(&siblings)),
        (false, section) => format!("known in [{section}] are {}", listed(&siblings)),
    }
}

/// As many of `names` as fit into [`LISTED_MAX`], and the number of the others.
fn listed(names: &[&str]) -> String {
    let mut length = 0;
    let fitting = names.iter().take_while(|name| {
        length += name.len() + 2;
        length <= LISTED_MAX
    });
    let shown: Vec<&str> = fitting.copied().collect();
    match names.len() - shown.len() {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

/// Similarity of two dotted keys, from 0 to 1. The last part counts most, so that a key in the wrong section is
/// found too.
fn similarity(key: &str, known: &str) -> f64 {
    let ((section, name), (known_section, known_name)) = (split(key), split(known));
    0.8 * strsim::normalized_damerau_levenshtein(name, known_name)
        + 0.2 * strsim::normalized_damerau_levenshtein(section, known_section)
}

/// (section, name) of a dotted key.
fn split(key: &str) -> (&str, &str) {
    key.rsplit_once('.').unwrap_or(("", key))
}
