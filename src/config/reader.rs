//! Reads the merged configuration by its declared keys, and notes all that is wrong with it.

use std::collections::{BTreeMap, BTreeSet};

use toml::{Table, Value as Toml};

use super::error::{ConfigError, Problem};
use super::layers::{Tree, ancestors, is_inside};
use super::suggest::nearest_key;
use super::value::{self, Entry, Origin, Value, element, join};
use crate::keys::{DefaultHolds, Key, Kind, Rule, ValueError, Words, expanded, tables};

/// Keys shown of the form of a table.
const FORM_KEYS_MAX: usize = 4;

/// The merged configuration while it is read.
pub(super) struct Reader {
    /// What is given; while it is read, the defaults of the rest are laid under it.
    pub(super) tree: Tree,
    hardware: bool,
    emulated_tracker: bool,
    /// The values of the configuration, by key; what they may be, in words.
    values: BTreeMap<String, String>,
    /// The tables of the configuration, and its arrays of tables.
    tables: BTreeSet<String>,
    /// Values that have an upper limit in another key.
    limited: Vec<(String, &'static str)>,
    /// Keys that were found wrong or missing.
    failed: BTreeSet<String>,
    /// By key.
    problems: Vec<(String, Problem)>,
}

/// What a table's keys take over from the tables around it.
#[derive(Clone, Copy)]
struct Around {
    has_defaults: bool,
    narrowed: &'static [(&'static str, Rule)],
}

impl Reader {
    pub(super) fn new(tree: Tree) -> Self {
        let holds =
            |key: &str, value: Value| tree.get(key).is_some_and(|entry| entry.value == value);
        let source = tree.get("tracker.source").map(|entry| &entry.value);
        let is_rehearsal = holds("emulator.rehearse", Value::Boolean(true));
        Reader {
            hardware: holds("stage.hardware", Value::Boolean(true)),
            emulated_tracker: is_rehearsal
                || source.is_none_or(|s| *s == Value::String("emulated".to_owned())),
            values: BTreeMap::new(),
            tables: BTreeSet::new(),
            limited: Vec::new(),
            failed: BTreeSet::new(),
            problems: Vec::new(),
            tree,
        }
    }

    /// The configuration as `keys` declare it. What is wrong in it is noted, and left out.
    pub(super) fn read(&mut self, keys: &'static [Key]) -> Toml {
        let around = Around { has_defaults: true, narrowed: &[] };
        let read = self.table(keys, "", around);
        for (key, max) in std::mem::take(&mut self.limited) {
            let number = |key: &str| match self.tree.get(key)?.value {
                Value::Float(number) => Some(number),
                Value::Integer(number) => Some(number as f64),
                _ => None,
            };
            let (Some(value), Some(limit)) = (number(&key), number(max)) else { continue };
            self.check(&[&key, max], value > limit, || {
                format!("{key} is {value}, allowed: up to {max}, which is {limit}")
            });
        }
        Toml::Table(read)
    }

    fn table(&mut self, keys: &'static [Key], path: &str, around: Around) -> Table {
        let mut table = Table::new();
        let keys = expanded(keys, around.narrowed);
        for key in &keys {
            let at = join(path, key.name);
            let alternative = keys
                .iter()
                .filter(|other| key.is_alternative_to(other))
                .map(|other| join(path, other.name))
                .find(|other| self.is_given(other));
            let has_default = around.has_defaults || key.default_holds == DefaultHolds::Everywhere;
            match alternative {
                None if has_default => self.lay_default(key, &at),
                None => {}
                Some(other) if self.is_beside(&at, &other) => {
                    self.check(&[&other, &at], key.instead_of.is_some(), || {
                        format!("{at} is given along with {other}: give one of the two")
                    });
                }
                // The value of the upper source counts.
                Some(other) if self.layer(&at) < self.layer(&other) => _ = self.tree.remove(&at),
                Some(_) => {}
            }
            if let Some(value) = self.key(key, &at, around) {
                table.insert(key.name.to_owned(), value);
            }
        }
        table
    }

    /// Lays the default of a key, at `at`, under what is given of it.
    fn lay_default(&mut self, key: &Key, at: &str) {
        // A table that is given has the defaults of its other keys, unless it is replaced whole.
        let is_merged = !tables(&key.kind).is_empty() && !key.is_whole;
        let is_complete = self.tree.contains_key(at) && !is_merged;
        let holds = match key.default_holds {
            DefaultHolds::ForEmulatedStage => !self.hardware,
            DefaultHolds::ForEmulatedTracker => self.emulated_tracker,
            DefaultHolds::Undecided | DefaultHolds::ForHardware | DefaultHolds::Everywhere => true,
        };
        let Some(default) = key.default.filter(|_| holds && !is_complete) else { return };
        for (path, entry) in value::parse_default(at, default) {
            self.tree.entry(path).or_insert(entry);
        }
    }

    fn key(&mut self, key: &Key, at: &str, around: Around) -> Option<Toml> {
        match &key.kind {
            Kind::Table(_) | Kind::Either(..) => {
                self.tables.insert(at.to_owned());
                if key.is_optional && !self.is_there(at) {
                    return None;
                }
                let is_whole = key.is_whole && self.tree.contains_key(at);
                let has_defaults = around.has_defaults && !is_whole;
                self.checked_table(&key.kind, at, Around { has_defaults, narrowed: key.narrowed })
            }
            kind => {
                self.values.insert(at.to_owned(), Words::of_key(key).allowed);
                if !tables(kind).is_empty() {
                    self.tables.insert(at.to_owned());
                }
                if let Some(max) = key.at_most {
                    self.limited.push((at.to_owned(), max));
                }
                if !self.tree.contains_key(at) && !key.is_optional {
                    self.missing(at, &Words::of_key(key));
                }
                self.value(kind, &key.rule, key.name, at)
            }
        }
    }

    /// The table at the key `at`, or why there is none.
    fn checked_table(&mut self, kind: &Kind, at: &str, around: Around) -> Option<Toml> {
        self.tables.insert(at.to_owned());
        let keys = match *kind {
            Kind::Either(key, [with, _]) if self.is_there(&join(at, key)) => with,
            Kind::Either(_, [_, without]) => without,
            Kind::Table(keys) => keys,
            _ => &[],
        };
        let entry = self.tree.get(at).filter(|entry| entry.value != Value::Table).cloned();
        if entry.is_some() {
            // Before its keys are read, which would be reported as missing.
            self.failed.insert(at.to_owned());
        }
        let table = self.table(keys, at, around);
        if let Some(entry) = entry {
            let expected = format!("a table{}", form(keys));
            let words = Words { allowed: expected.clone(), expected };
            let message = words.complaint(at, &entry.written, ValueError::Kind);
            self.fail(at, Problem::at(Some(entry.origin), message));
        }
        Some(Toml::Table(table))
    }

    /// The value at the key `at`; `None` where there is none, or where it is wrong.
    fn value(&mut self, kind: &Kind, rule: &Rule, name: &str, at: &str) -> Option<Toml> {
        let entry = self.tree.get(at)?;
        let read = match (kind, &entry.value) {
            (Kind::Array(of, None), &Value::Array(count)) => {
                return Some(self.elements(of, rule, name, at, count));
            }
            (Kind::Array(of, Some(count)), Value::Array(given)) if given == count => {
                return Some(self.elements(of, rule, name, at, *count));
            }
            (_, value) => scalar(kind, rule, value),
        };
        match read {
            Ok(value) => value,
            Err(error) => {
                let message = Words::of(kind, rule, name).complaint(at, &entry.written, error);
                let problem = Problem::at(Some(entry.origin.clone()), message);
                self.fail(at, problem);
                None
            }
        }
    }

    fn elements(&mut self, of: &Kind, rule: &Rule, name: &str, at: &str, count: usize) -> Toml {
        let mut elements = Vec::new();
        for i in 0..count {
            let at = element(at, i);
            elements.extend(match of {
                Kind::Table(_) => {
                    let around = Around { has_defaults: true, narrowed: &[] };
                    self.checked_table(of, &at, around)
                }
                _ => {
                    self.values.insert(at.clone(), Words::of(of, rule, name).allowed);
                    self.value(of, rule, name, &at)
                }
            });
        }
        Toml::Array(elements)
    }

    /// True if there is a key `at`, or any of the table `at`.
    fn is_there(&self, at: &str) -> bool {
        self.tree.contains_key(at) || self.tree.keys().any(|key| is_inside(key, at))
    }

    /// Notes a contradiction between `keys` when there is one, at the key given last. Says nothing
    /// when one of them is wrong already. `message` is asked only if `contradiction`.
    pub(super) fn check(
        &mut self,
        keys: &[&str],
        contradiction: bool,
        message: impl FnOnce() -> String,
    ) {
        if !contradiction || keys.iter().any(|&key| self.failed.contains(key)) {
            return;
        }
        let entries = keys.iter().filter_map(|&key| Some((key, self.tree.get(key)?)));
        let given = entries.filter(|(_, entry)| entry.layer > 0).max_by_key(|(_, e)| e.layer);
        let message = message();
        let problem = match given {
            // `--set a.b is …` would name a key that was not set.
            Some((key, Entry { origin: Origin::Set, .. })) if !message.starts_with(key) => {
                Problem::at(Some(Origin::Set), format!("{key}: {message}"))
            }
            given => Problem::at(given.map(|(_, entry)| entry.origin.clone()), message),
        };
        self.problems.push((keys[0].to_owned(), problem));
    }

    /// True where `key`, a part of it or what it is in was found wrong or missing.
    pub(super) fn is_wrong(&self, key: &str) -> bool {
        let is_part = |failed: &String| failed == key || is_inside(failed, key);
        self.failed.iter().any(is_part) || ancestors(key).any(|outer| self.failed.contains(outer))
    }

    /// Notes that the key `at`, or the table that it is in, is wrong, as `message` says.
    pub(super) fn refuse(&mut self, at: &str, place: &str, message: &str) {
        let origin = self.origin(place).or_else(|| self.origin(at));
        self.fail(at, Problem::at(origin, format!("{at}: {message}")));
    }

    /// What was found wrong with these `keys`, or with what they are in.
    ///
    /// # Errors
    /// The problems, in the order found.
    pub(super) fn about(&self, keys: &[&str]) -> Result<(), ConfigError> {
        let is_about = |wrong: &str| keys.iter().any(|&key| key == wrong || is_inside(key, wrong));
        let about = self.problems.iter().filter(|(key, _)| is_about(key));
        ConfigError::unless_empty(about.map(|(_, problem)| problem.clone()).collect())
    }

    /// Ends the reading: keys that are not declared are unknown.
    ///
    /// # Errors
    /// Everything found wrong, files first, by line.
    pub(super) fn finish(&mut self) -> Result<(), ConfigError> {
        self.find_unknown();
        let problems = std::mem::take(&mut self.problems).into_iter();
        let mut problems: Vec<Problem> = problems.map(|(_, problem)| problem).collect();
        problems.sort_by_key(|problem| match problem.origin {
            Some(Origin::File { line, .. }) => (0, line),
            Some(Origin::Set) => (1, 0),
            None => (2, 0),
        });
        ConfigError::unless_empty(problems)
    }

    fn find_unknown(&mut self) {
        let is_known = |key: &str| self.values.contains_key(key) || self.tables.contains(key);
        for (key, entry) in self.tree.iter().filter(|(_, entry)| entry.layer > 0) {
            // Inside what is wrong or unknown as a whole there is nothing more to say.
            let is_reported = |outer: &str| {
                self.failed.contains(outer) || self.tree.contains_key(outer) && !is_known(outer)
            };
            if is_known(key) || ancestors(key).any(is_reported) {
                continue;
            }
            let above = ancestors(key).find(|outer| is_known(outer));
            let hint = match above.filter(|outer| !self.tables.contains(*outer)) {
                Some(value) => {
                    let takes =
                        self.values.get(value).map(|allowed| format!(": it takes {allowed}"));
                    format!("{value} has no keys below it{}", takes.unwrap_or_default())
                }
                None => {
                    let known = self.values.keys().chain(&self.tables);
                    nearest_key(key, known.map(String::as_str))
                }
            };
            let problem = Problem::unknown_key(entry.origin.clone(), key, &hint);
            self.problems.push((key.clone(), problem));
        }
    }

    /// True if the key `key` is given, not by default.
    pub(super) fn is_given(&self, key: &str) -> bool {
        self.origin(key).is_some()
    }

    /// True if both keys are given in one source.
    fn is_beside(&self, key: &str, other: &str) -> bool {
        let both = self.tree.get(key).zip(self.tree.get(other));
        both.is_some_and(|(one, other)| one.is_beside(other))
    }

    /// The layer that a key is of; 0 for a default, and where there is none.
    fn layer(&self, key: &str) -> usize {
        self.tree.get(key).map_or(0, |entry| entry.layer)
    }

    /// Where `key` was given; `None` for a default.
    fn origin(&self, key: &str) -> Option<Origin> {
        let entry = self.tree.get(key).filter(|entry| entry.layer > 0)?;
        Some(entry.origin.clone())
    }

    /// Notes that a key is not there.
    fn missing(&mut self, key: &str, words: &Words) {
        if std::iter::once(key).chain(ancestors(key)).any(|key| self.failed.contains(key)) {
            return;
        }
        let origin = ancestors(key).find_map(|outer| self.origin(outer));
        let expected = &words.expected;
        let message = format!("{key} is missing and has no default here, expected {expected}");
        self.fail(key, Problem::at(origin, message));
    }

    /// Notes that what was to give `keys` is wrong.
    pub(super) fn fail_all(&mut self, keys: Vec<&'static str>, problems: Vec<Problem>) {
        self.problems.extend(problems.into_iter().map(|problem| (keys.concat(), problem)));
        self.failed.extend(keys.into_iter().map(str::to_owned));
    }

    /// Notes that a key is wrong.
    fn fail(&mut self, key: &str, problem: Problem) {
        self.failed.insert(key.to_owned());
        self.problems.push((key.to_owned(), problem));
    }
}

/// A value of the kind, if it is allowed; `None` for the word that stands for none.
fn scalar(kind: &Kind, rule: &Rule, value: &Value) -> Result<Option<Toml>, ValueError> {
    let allowed = |is_allowed: bool, value: Toml| match is_allowed {
        true => Ok(Some(value)),
        false => Err(ValueError::NotAllowed),
    };
    match (kind, value) {
        (_, Value::String(text)) if matches!(rule, Rule::Or(word, _) if word == text) => {
            Ok(Some(Toml::String(text.clone())))
        }
        (Kind::Number, &Value::Integer(integer)) => {
            scalar(kind, rule, &Value::Float(integer as f64))
        }
        (Kind::Number, Value::Float(number)) if !number.is_finite() => Err(ValueError::NotFinite),
        (Kind::Number, &Value::Float(number)) => {
            let is_allowed = !matches!(rule, Rule::Range(range) if !range.contains(number));
            allowed(is_allowed, Toml::Float(number))
        }
        (&Kind::Integer(low, high), &Value::Integer(integer)) => {
            let is_allowed = (low..=high).contains(&(integer as f64))
                && match rule {
                    Rule::Range(range) => range.contains(integer as f64),
                    Rule::Integers(values) => values.iter().any(|&one| i128::from(one) == integer),
                    _ => true,
                };
            allowed(is_allowed, Toml::Integer(i64::try_from(integer).unwrap_or(i64::MAX)))
        }
        (Kind::Boolean, &Value::Boolean(boolean)) => Ok(Some(Toml::Boolean(boolean))),
        (Kind::Text, Value::String(text)) => {
            let is_allowed = !matches!(rule, Rule::Text(_, accepts) if !accepts(text));
            allowed(is_allowed, Toml::String(text.clone()))
        }
        (Kind::OneOf(names), Value::String(text)) => {
            allowed(names.iter().any(|(name, _)| name == text), Toml::String(text.clone()))
        }
        _ => Err(ValueError::Kind),
    }
}

/// How a table of these `keys` is written: `, { a = …, b = … }`.
fn form(keys: &[Key]) -> String {
    let keys = expanded(keys, &[]);
    let mut fields: Vec<String> = keys.iter().map(|key| format!("{} = …", key.name)).collect();
    if fields.len() > FORM_KEYS_MAX {
        fields.truncate(FORM_KEYS_MAX);
        fields.push("…".to_owned());
    }
    format!(", {{ {} }}", fields.join(", "))
}
