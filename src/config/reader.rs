//! Reads the merged configuration by its declared keys, and notes all that is wrong with it.

use std::collections::{BTreeMap, BTreeSet};

use toml::{Table, Value};

use super::Config;
use super::error::{ConfigError, Problem, nearest_key};
use super::value::{self, Entries, Entry, Origin, element, join};
use crate::keys::{DefaultHolds, Key, Kind, Rule, Words, expanded, find, tables};

/// All sources laid over each other, by dotted key.
pub(super) type Tree = BTreeMap<String, Entry>;

pub(super) const REGISTRATION: &str = "tracker.registration";
pub(super) const FIDUCIALS: &str = "tracker.registration.fiducials";

/// Keys shown of the form of a table.
const FORM_KEYS_MAX: usize = 4;

/// The merged configuration while it is read.
pub(super) struct Reader {
    /// The given keys; while they are read, the defaults of the others are laid under them.
    pub(super) tree: Tree,
    hardware: bool,
    emulated_tracker: bool,
    /// The keys of the configuration, each with its allowed values in words; none for tables and arrays of
    /// tables.
    known: BTreeMap<String, Option<String>>,
    /// Keys, each with another whose value is its upper limit.
    pub(super) limited: Vec<(String, &'static str)>,
    /// Keys that were found wrong or missing.
    failed: BTreeSet<String>,
    /// By key.
    problems: Vec<(String, Problem)>,
}

impl Reader {
    pub(super) fn new(tree: Tree) -> Self {
        let is_true =
            |key| tree.get(key).is_some_and(|entry: &Entry| entry.value.as_bool() == Some(true));
        let source = tree.get("tracker.source").map(|entry| entry.value.as_str());
        Reader {
            hardware: is_true("stage.hardware"),
            emulated_tracker: is_true("emulator.rehearse")
                || source.is_none_or(|source| source == Some("emulated")),
            known: BTreeMap::new(),
            limited: Vec::new(),
            failed: BTreeSet::new(),
            problems: Vec::new(),
            tree,
        }
    }

    /// The configuration as `keys` declare it. What is wrong in it is noted, and left out.
    pub(super) fn read(&mut self, keys: &'static [Key]) -> Value {
        self.table(&Kind::Table(keys), &[], "", true)
    }

    /// The table at `path`, with narrower rules for some keys. Where it `has_defaults`, the keys that are not
    /// given have theirs.
    fn table(
        &mut self,
        kind: &Kind,
        narrowed: &[(&str, Rule)],
        path: &str,
        has_defaults: bool,
    ) -> Value {
        let keys = match *kind {
            Kind::Either(key, [with, _]) if self.is_there(&join(path, key)) => with,
            Kind::Either(_, [_, keys]) | Kind::Table(keys) => keys,
            _ => &[],
        };
        let keys = expanded(keys, narrowed);
        if let Some(entry) = self.tree.get(path).filter(|entry| !entry.value.is_table()) {
            let message = format!("{path} is {}, expected a table{}", entry.written, form(&keys));
            self.fail(path, Some(entry.origin.clone()), message);
        }
        let mut table = Table::new();
        for key in &keys {
            let at = join(path, key.name);
            let alternative = keys
                .iter()
                .filter(|other| key.is_alternative_to(other))
                .map(|other| join(path, other.name))
                .find(|other| self.is_given(other));
            let has_default = has_defaults || key.default_holds == DefaultHolds::Everywhere;
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
            self.limited.extend(key.at_most.map(|max| (at.clone(), max)));
            if let Some(value) = self.value(key, &key.kind, &at, has_defaults) {
                table.insert(key.name.to_owned(), value);
            }
        }
        Value::Table(table)
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

    /// The value at `at`, which is that of `key` or an element of it; `None` where it is left out or wrong.
    fn value(&mut self, key: &Key, kind: &Kind, at: &str, has_defaults: bool) -> Option<Value> {
        let words = Words::of(kind, &key.rule, key.name);
        let allowed = tables(kind).is_empty().then(|| words.allowed.clone());
        self.known.insert(at.to_owned(), allowed);
        if let Kind::Table(_) | Kind::Either(..) = kind {
            if key.is_optional && !self.is_there(at) {
                return None;
            }
            let has_defaults = has_defaults && !(key.is_whole && self.tree.contains_key(at));
            return Some(self.table(kind, key.narrowed, at, has_defaults));
        }
        let Some(entry) = self.tree.get(at) else {
            if !key.is_optional {
                self.missing(at, &words.expected);
            }
            return None;
        };
        match (kind, &entry.value) {
            (Kind::Array(of, count), Value::Array(given))
                if count.is_none_or(|count| count == given.len()) =>
            {
                let places = (0..given.len()).map(|i| element(at, i));
                let elements = places.filter_map(|at| self.value(key, of, &at, true));
                Some(Value::Array(elements.collect()))
            }
            (kind, value) => match scalar(kind, &key.rule, value, &words) {
                Ok(value) => Some(value),
                Err(why) => {
                    let message = format!("{at} is {}, {why}", entry.written);
                    self.fail(at, Some(entry.origin.clone()), message);
                    None
                }
            },
        }
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

    /// Notes why what `keys` describe cannot be `made`, when it cannot.
    pub(super) fn check_made<T>(&mut self, keys: &[&str], made: Result<T, ConfigError>) {
        if let Err(error) = made {
            self.check(keys, true, || error.to_string());
        }
    }

    /// True where `key`, a part of it or what it is in was found wrong or missing.
    pub(super) fn is_wrong(&self, key: &str) -> bool {
        let is_part = |failed: &String| failed == key || is_inside(failed, key);
        self.failed.iter().any(is_part) || ancestors(key).any(|outer| self.failed.contains(outer))
    }

    /// Notes that the key `at`, or the table that it is in, is wrong, as `message` says.
    pub(super) fn refuse(&mut self, at: &str, place: &str, message: &str) {
        let origin = self.origin(place).or_else(|| self.origin(at));
        self.fail(at, origin, format!("{at}: {message}"));
    }

    /// Notes what is wrong with the table `at`, in words `what`: the keys of `all` that are given and that it
    /// does not have, since it has only those in `known`; else the key that kept it from being `made`, and why.
    pub(super) fn check_own_keys<T>(
        &mut self,
        at: &str,
        what: &str,
        all: &[Key],
        known: &[&str],
        made: Result<T, (&'static str, String)>,
    ) {
        if self.is_wrong(at) {
            return;
        }
        // A recorded configuration has all defaults in every table.
        let mut defaults = all.iter().filter(|key| key.default.is_some());
        let is_recorded = defaults.all(|key| self.is_given(&join(at, key.name)));
        for key in all.iter().filter(|key| !known.contains(&key.name)) {
            let path = join(at, key.name);
            let is_allowed = |entry: &Entry| is_recorded && key.default == Some(&entry.written);
            if self.given(&path).is_some_and(|entry| !is_allowed(entry)) {
                let known = known.join(", ");
                self.refuse(&path, &path, &format!("{what} has no such key, only {known}"));
            }
        }
        if let (false, Err((key, message))) = (self.is_wrong(at), made) {
            self.refuse(at, &join(at, key), &message);
        }
    }

    /// The problems found with these `keys`, or with the tables that they are in.
    ///
    /// # Errors
    /// The problems, in the order found.
    pub(super) fn about(&self, keys: &[&str]) -> Result<(), ConfigError> {
        let is_about = |wrong: &str| keys.iter().any(|&key| key == wrong || is_inside(key, wrong));
        let about = self.problems.iter().filter(|(key, _)| is_about(key));
        ConfigError::unless_empty(about.map(|(_, problem)| problem.clone()).collect())
    }

    /// Ends the reading; gives the tree with all defaults. Keys that are not declared are unknown.
    ///
    /// # Errors
    /// Everything found wrong, files first, by line.
    pub(super) fn finish(mut self) -> Result<Tree, ConfigError> {
        self.find_unknown();
        self.problems.sort_by_key(|(_, problem)| match problem.origin {
            Some(Origin::File { line, .. }) => (0, line),
            Some(Origin::Set) => (1, 0),
            None => (2, 0),
        });
        let problems = self.problems.into_iter().map(|(_, problem)| problem);
        ConfigError::unless_empty(problems.collect())?;
        Ok(self.tree)
    }

    fn find_unknown(&mut self) {
        let is_known = |key: &str| self.known.contains_key(key);
        for (key, entry) in self.tree.iter().filter(|(_, entry)| entry.layer > 0) {
            // Nothing is reported inside a table that is wrong or unknown as a whole.
            let is_reported = |outer: &str| {
                self.failed.contains(outer) || self.tree.contains_key(outer) && !is_known(outer)
            };
            if is_known(key) || ancestors(key).any(is_reported) {
                continue;
            }
            let hint = match ancestors(key).find_map(|outer| self.known.get_key_value(outer)) {
                Some((value, Some(allowed))) => {
                    format!("{value} has no keys below it: it takes {allowed}")
                }
                _ => nearest_key(key, self.known.keys().map(String::as_str)),
            };
            let message = match entry.origin {
                Origin::File { .. } => format!("unknown key \"{key}\"; {hint}"),
                Origin::Set => format!("{key}: unknown key; {hint}"),
            };
            let problem = Problem::at(Some(entry.origin.clone()), message);
            self.problems.push((key.clone(), problem));
        }
    }

    /// What is given at `key`, not by default.
    fn given(&self, key: &str) -> Option<&Entry> {
        self.tree.get(key).filter(|entry| entry.layer > 0)
    }

    pub(super) fn is_given(&self, key: &str) -> bool {
        self.given(key).is_some()
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
        self.given(key).map(|entry| entry.origin.clone())
    }

    /// Notes that a key is not there.
    fn missing(&mut self, key: &str, expected: &str) {
        if std::iter::once(key).chain(ancestors(key)).any(|key| self.failed.contains(key)) {
            return;
        }
        let origin = ancestors(key).find_map(|outer| self.origin(outer));
        let message = format!("{key} is missing and has no default here, expected {expected}");
        self.fail(key, origin, message);
    }

    /// Notes that what was to give `keys` is wrong.
    pub(super) fn fail_all(&mut self, keys: Vec<&str>, error: ConfigError) {
        self.problems
            .extend(error.problems.into_iter().map(|problem| (keys[0].to_owned(), problem)));
        self.failed.extend(keys.into_iter().map(str::to_owned));
    }

    /// Notes that a key is wrong.
    fn fail(&mut self, key: &str, origin: Option<Origin>, message: String) {
        self.failed.insert(key.to_owned());
        self.problems.push((key.to_owned(), Problem::at(origin, message)));
    }
}

/// A value of the kind, if it is allowed, or the word that stands for none; else what was expected.
fn scalar(kind: &Kind, rule: &Rule, value: &Value, words: &Words) -> Result<Value, String> {
    let is_allowed = match (kind, value) {
        (_, Value::String(text)) if matches!(rule, Rule::Or(word, _) if word == text) => true,
        (Kind::Number, &Value::Integer(integer)) => {
            return scalar(kind, rule, &Value::Float(integer as f64), words);
        }
        (Kind::Number, Value::Float(number)) if !number.is_finite() => {
            return Err(format!("not finite, allowed: {}", words.allowed));
        }
        (Kind::Number, &Value::Float(number)) => {
            kind.range(rule).is_none_or(|range| range.contains(number))
        }
        (Kind::Integer(..), &Value::Integer(integer)) => match rule {
            Rule::Integers(values) => values.contains(&integer),
            _ => kind.range(rule).is_none_or(|range| range.contains(integer as f64)),
        },
        (Kind::Boolean, Value::Boolean(_)) => true,
        (Kind::Text, Value::String(text)) => {
            !matches!(rule, Rule::Text(_, accepts) if !accepts(text))
        }
        (Kind::OneOf(names), Value::String(text)) => names.iter().any(|(name, _)| name == text),
        _ => return Err(format!("expected {}", words.expected)),
    };
    if is_allowed { Ok(value.clone()) } else { Err(format!("allowed: {}", words.allowed)) }
}

/// How a table of these `keys` is written: `, { a = …, b = … }`.
fn form(keys: &[Key]) -> String {
    let mut fields: Vec<String> = keys.iter().map(|key| format!("{} = …", key.name)).collect();
    if fields.len() > FORM_KEYS_MAX {
        fields.truncate(FORM_KEYS_MAX);
        fields.push("…".to_owned());
    }
    format!(", {{ {} }}", fields.join(", "))
}

/// Lays `layers` over each other, the lowest first.
pub(super) fn merge(layers: Vec<Entries>) -> Tree {
    let mut tree = Tree::new();
    for (key, entry) in layers.into_iter().flatten() {
        lay(&mut tree, key, entry);
    }
    tree
}

/// Lays an entry over `tree`. A value that is replaced as a whole is removed from the layers below.
fn lay(tree: &mut Tree, key: String, entry: Entry) {
    let layer = entry.layer;
    let replaced = match entry.value {
        // Fiducials take the place of a pose.
        Value::Array(_) if key == FIDUCIALS => Some(REGISTRATION),
        Value::Array(_) => Some(key.as_str()),
        _ => find(Config::KEYS, &key).filter(|key| key.is_whole).map(|_| key.as_str()),
    };
    if let Some(replaced) = replaced {
        tree.retain(|other, below| {
            // Alternatives in one source are both kept, to be refused.
            let is_alternative = !is_inside(other, &key) && below.is_beside(&entry);
            below.layer >= layer || is_alternative || !is_inside(other, replaced)
        });
    }
    tree.insert(key, entry);
}

/// True for keys of the table `key` and elements of the array `key`.
pub(super) fn is_inside(other: &str, key: &str) -> bool {
    other.strip_prefix(key).is_some_and(|rest| rest.starts_with(['.', '[']))
}

/// The keys around `key`, nearest first: of `a.b[0].c`: `a.b[0]`, `a.b`, `a`.
pub(super) fn ancestors(key: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(outer(key), |key| outer(key))
}

fn outer(key: &str) -> Option<&str> {
    key.rfind(['.', '[']).and_then(|end| key.get(..end))
}
