//! Reads the merged configuration by its declared keys, and collects everything that is wrong with it.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;

use toml::{Table, Value};

use super::Config;
use super::error::{ConfigError, Problem, nearest_key};
use super::value::{self, Entries, Entry, Origin};
use crate::keys::{DefaultHolds, Key, Kind, Rule, Words, expanded, find, join, tables};

/// The merged sources: the entry of the highest layer, by dotted key.
pub(super) type Tree = BTreeMap<String, Entry>;

pub(super) const REGISTRATION: &str = "tracker.registration";
pub(super) const FIDUCIALS: &str = "tracker.registration.fiducials";

/// A message shows at most this many keys of a table.
const FORM_KEYS_MAX: usize = 4;

/// Reports contradictions: `[keys] if CONDITION => "message", arguments;`. See [`Reader::refuse`].
macro_rules! contradictions {
    (
        $reader:expr;
        $([$($key:expr),+] if $is_contradiction:expr => $message:literal $(, $argument:expr)*;)+
    ) => {$(
        if $is_contradiction {
            $reader.refuse(&[$($key),+], format!($message $(, $argument)*));
        }
    )+};
}
pub(super) use contradictions;

/// The merged configuration while it is read.
pub(super) struct Reader {
    /// The given keys; reading adds the defaults of the others.
    pub(super) tree: Tree,
    hardware: bool,
    emulated_tracker: bool,
    /// The keys that exist, each with its allowed values in words; `None` for tables and arrays of tables.
    known: BTreeMap<String, Option<String>>,
    /// Pairs of keys: the value of the second is the upper limit of the first.
    pub(super) limited: Vec<(String, &'static str)>,
    /// The keys that were found wrong or missing.
    failed: BTreeSet<String>,
    /// Each problem with its key, in the order found.
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

    /// Reads the configuration. A wrong value is reported; in the result a placeholder such as NaN or 0 replaces it.
    pub(super) fn read(&mut self) -> Config {
        Config::of(self.table(&Kind::Table(Config::KEYS), &[], "", true))
    }

    /// Reads the table at `path`; `narrowed` has narrower rules for some keys. If it `has_defaults`, keys that are not
    /// given get their defaults.
    fn table(
        &mut self,
        kind: &Kind,
        narrowed: &[(&str, Rule)],
        path: &str,
        has_defaults: bool,
    ) -> Value {
        let keys = match *kind {
            Kind::Either(key, [keys, _]) if self.is_present(&join(path, key)) => keys,
            Kind::Either(_, [_, keys]) | Kind::Table(keys) => keys,
            _ => &[],
        };
        let keys = expanded(keys, narrowed);
        if let Some(entry) = self.tree.get(path).filter(|entry| !entry.value.is_table()) {
            let message =
                format!("{path} is {}, expected a table{}", entry.source_text, form(&keys));
            self.fail(path, path, message);
        }
        let mut table = Table::new();
        for key in &keys {
            let key_path = join(path, key.name);
            let alternative = keys
                .iter()
                .filter(|other| key.is_alternative_to(other))
                .map(|other| join(path, other.name))
                .find_map(|other| self.given(&other).map(|entry| (other, entry)));
            let has_default = has_defaults || key.default_holds == DefaultHolds::Everywhere;
            let given = self.tree.get(&key_path);
            if let Some((other, other_entry)) = alternative {
                let is_same_source = given.is_some_and(|entry| entry.is_same_source(other_entry));
                // The source of higher precedence counts.
                if !is_same_source && given.is_some_and(|entry| entry.layer < other_entry.layer) {
                    self.tree.remove(&key_path);
                }
                contradictions! { self;
                    [&other, &key_path] if is_same_source && key.instead_of.is_some() =>
                        "{key_path} is given along with {other}: give one of the two";
                }
            } else if has_default {
                self.add_default(key, &key_path);
            }
            self.limited.extend(key.at_most.map(|max| (key_path.clone(), max)));
            if let Some(value) = self.value(key, &key.kind, &key_path, has_defaults) {
                table.insert(key.name.to_owned(), value);
            }
        }
        if let Kind::Either(key, [_, others]) = *kind
            && self.given(&join(path, key)).is_some()
            && let Some(Key { name, .. }) = expanded(others, &[])
                .iter()
                .find(|other| self.given(&join(path, other.name)).is_some())
        {
            let message = format!("{path}: {key} are given along with {name}: give one of the two");
            self.fail(path, &join(path, key), message);
        }
        Value::Table(table)
    }

    /// Adds the default of `key`, which is at `path`, where nothing is given.
    fn add_default(&mut self, key: &Key, path: &str) {
        // Defaults complete a given table, unless the table is replaced as a whole.
        let is_merged = !tables(&key.kind).is_empty() && !key.is_whole;
        let is_complete = self.tree.contains_key(path) && !is_merged;
        let holds = match key.default_holds {
            DefaultHolds::ForEmulatedStage => !self.hardware,
            DefaultHolds::ForEmulatedTracker => self.emulated_tracker,
            DefaultHolds::Undecided | DefaultHolds::ForHardware | DefaultHolds::Everywhere => true,
        };
        let Some(default) = key.default.filter(|_| holds && !is_complete) else { return };
        let entries = value::parse_set(&format!("{path}={default}"), 0).unwrap_or_default();
        for (entry_path, entry) in entries {
            self.tree.entry(entry_path).or_insert(entry);
        }
    }

    /// Reads the value at `path`, which is that of `key` or of an element of it; `None` if it is missing or wrong.
    fn value(&mut self, key: &Key, kind: &Kind, path: &str, has_defaults: bool) -> Option<Value> {
        let words = Words::of(kind, &key.rule, key.name);
        let allowed = tables(kind).is_empty().then(|| words.allowed.clone());
        self.known.insert(path.to_owned(), allowed);
        if let Kind::Table(_) | Kind::Either(..) = kind {
            if key.is_optional && !self.is_present(path) {
                return None;
            }
            let has_defaults = has_defaults && !(key.is_whole && self.tree.contains_key(path));
            return Some(self.table(kind, key.narrowed, path, has_defaults));
        }
        let Some(entry) = self.tree.get(path) else {
            if !key.is_optional && !enclosing_keys(path).any(|key| self.failed.contains(key)) {
                let expected = words.expected;
                let message =
                    format!("{path} is missing and has no default here, expected {expected}");
                self.fail(path, path, message);
            }
            return None;
        };
        match (kind, &entry.value) {
            (Kind::Array(of, count), Value::Array(given))
                if count.is_none_or(|count| count == given.len()) =>
            {
                let places = (0..given.len()).map(|i| format!("{path}[{i}]"));
                let elements = places.filter_map(|path| self.value(key, of, &path, true));
                Some(Value::Array(elements.collect()))
            }
            (kind, value) => match scalar(kind, &key.rule, value, &words) {
                Ok(value) => Some(value),
                Err(why) => {
                    let message = format!("{path} is {}, {why}", entry.source_text);
                    self.fail(path, path, message);
                    None
                }
            },
        }
    }

    /// True if the key `path` or a key inside it is present.
    pub(super) fn is_present(&self, path: &str) -> bool {
        self.tree.contains_key(path) || inside(&self.tree, path).next().is_some()
    }

    /// Reports `message` at the place of that one of `keys` whose source has the highest precedence. Reports nothing if
    /// one of them [is invalid](Self::is_invalid) by itself, because its value is unknown.
    pub(super) fn refuse(&mut self, keys: &[&str], message: String) {
        if keys.iter().any(|&key| self.is_invalid(key)) {
            return;
        }
        let entries = keys.iter().filter_map(|&key| Some((key, self.tree.get(key)?)));
        let given = entries.filter(|(_, entry)| entry.layer > 0).max_by_key(|(_, e)| e.layer);
        let problem = match given {
            // `--set a.b is …` would name a key that was not set.
            Some((key, Entry { origin: Origin::Set, .. })) if !message.starts_with(key) => {
                Problem::at(Some(Origin::Set), format!("{key}: {message}"))
            }
            given => Problem::at(given.map(|(_, entry)| entry.origin.clone()), message),
        };
        self.problems.push((keys[0].to_owned(), problem));
    }

    /// True if `key`, a key inside it or a table around it is invalid or missing.
    pub(super) fn is_invalid(&self, key: &str) -> bool {
        enclosing_keys(key).any(|outer| self.failed.contains(outer))
            || self.failed.iter().any(|failed| is_inside(failed, key))
    }

    /// Checks the table at `table_path`, whose kind allows only the keys `known` of the keys in `all`; `what` is the
    /// kind in words. Reports given keys that the kind does not allow. If there are none, reports what else is `wrong`
    /// with the table: the key and the message.
    pub(super) fn check_own_keys(
        &mut self,
        table_path: &str,
        what: &str,
        all: &[Key],
        known: &[&str],
        wrong: Option<(&str, String)>,
    ) {
        if self.is_invalid(table_path) {
            return;
        }
        // A recorded configuration has all defaults in every table.
        let mut defaults = all.iter().filter(|key| key.default.is_some());
        let is_recorded = defaults.all(|key| self.given(&join(table_path, key.name)).is_some());
        for key in all.iter().filter(|key| !known.contains(&key.name)) {
            let key_path = join(table_path, key.name);
            let is_allowed = |entry: &Entry| is_recorded && key.default == Some(&entry.source_text);
            if self.given(&key_path).is_some_and(|entry| !is_allowed(entry)) {
                let known = known.join(", ");
                let message = format!("{key_path}: {what} has no such key, only {known}");
                self.fail(&key_path, &key_path, message);
            }
        }
        if let (false, Some((key, message))) = (self.is_invalid(table_path), wrong) {
            self.fail(table_path, &join(table_path, key), format!("{table_path}: {message}"));
        }
    }

    /// Checks that these `keys` and the tables around them have no problem.
    ///
    /// # Errors
    /// The problems, in the order found.
    pub(super) fn check_found_no_problem_with(&self, keys: &[&str]) -> Result<(), ConfigError> {
        let is_about = |wrong: &str| keys.iter().any(|&key| key == wrong || is_inside(key, wrong));
        let about = self.problems.iter().filter(|(key, _)| is_about(key));
        ConfigError::unless_empty(about.map(|(_, problem)| problem.clone()).collect())
    }

    /// Reports unknown keys, and returns the tree with all defaults.
    ///
    /// # Errors
    /// Every problem found: those in files first, by line.
    pub(super) fn finish(mut self) -> Result<Tree, ConfigError> {
        self.refuse_unknown();
        self.problems.sort_by_key(|(_, problem)| match problem.origin {
            Some(Origin::File { line, .. }) => (0, line),
            Some(Origin::Set) => (1, 0),
            None => (2, 0),
        });
        let problems = self.problems.into_iter().map(|(_, problem)| problem);
        ConfigError::unless_empty(problems.collect())?;
        Ok(self.tree)
    }

    fn refuse_unknown(&mut self) {
        let is_known = |key: &str| self.known.contains_key(key);
        for (key, entry) in self.tree.iter().filter(|(_, entry)| entry.layer > 0) {
            // Nothing is reported inside a table that is wrong or unknown as a whole.
            let is_reported = |outer: &str| {
                self.failed.contains(outer) || self.tree.contains_key(outer) && !is_known(outer)
            };
            if is_known(key) || enclosing_keys(key).skip(1).any(is_reported) {
                continue;
            }
            let hint = match enclosing_keys(key).find_map(|outer| self.known.get_key_value(outer)) {
                Some((value, Some(allowed))) => {
                    format!("{value} has no keys below it; allowed as its value: {allowed}")
                }
                _ if key == "study.seed" => "give it to the study as an option: --seed".to_owned(),
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

    /// The entry of `key`, unless it is a default.
    pub(super) fn given(&self, key: &str) -> Option<&Entry> {
        self.tree.get(key).filter(|entry| entry.layer > 0)
    }

    /// Reports that the source of `keys` is unusable.
    pub(super) fn fail_all(&mut self, keys: Vec<&str>, error: ConfigError) {
        self.problems
            .extend(error.problems.into_iter().map(|problem| (keys[0].to_owned(), problem)));
        self.failed.extend(keys.into_iter().map(str::to_owned));
    }

    /// Reports that `key` is wrong, at the place of the key `given` or of the nearest table around it.
    pub(super) fn fail(&mut self, key: &str, given: &str, message: String) {
        let entry = enclosing_keys(given).find_map(|key| self.given(key));
        let problem = Problem::at(entry.map(|entry| entry.origin.clone()), message);
        self.failed.insert(key.to_owned());
        self.problems.push((key.to_owned(), problem));
    }
}

/// Checks a value that is neither a table nor an array.
///
/// # Errors
/// What was expected or is allowed, in words.
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
        (Kind::Text, Value::String(text)) => match rule {
            Rule::Text(_, accepts) => accepts(text),
            _ => true,
        },
        (Kind::OneOf(names), Value::String(text)) => names.iter().any(|(name, _)| name == text),
        _ => return Err(format!("expected {}", words.expected)),
    };
    if is_allowed { Ok(value.clone()) } else { Err(format!("allowed: {}", words.allowed)) }
}

/// An example of a table with these `keys`, for a message: `, { a = …, b = … }`.
fn form(keys: &[Key]) -> String {
    let shown = keys.iter().take(FORM_KEYS_MAX).map(|key| format!("{} = …", key.name));
    let more = if keys.len() > FORM_KEYS_MAX { ", …" } else { "" };
    format!(", {{ {}{more} }}", shown.collect::<Vec<_>>().join(", "))
}

/// Merges the entries of all layers: a higher layer overrides a lower one. An array and a table that is
/// replaced as a whole are removed from the layers below.
pub(super) fn merge(mut entries: Entries) -> Tree {
    entries.sort_by_key(|(_, entry)| entry.layer);
    let mut tree = Tree::new();
    for (key, entry) in entries {
        let replaced = match entry.value {
            // Fiducials take the place of a pose.
            Value::Array(_) if key == FIDUCIALS => Some(REGISTRATION),
            Value::Array(_) => Some(key.as_str()),
            _ => find(Config::KEYS, &key).filter(|key| key.is_whole).map(|_| key.as_str()),
        };
        if let Some(replaced) = replaced {
            let below = inside(&tree, replaced).filter(|(other, below)| {
                // Two alternatives in one source are both kept, so that the reader refuses them.
                let is_alternative = !is_inside(other, &key) && below.is_same_source(&entry);
                below.layer < entry.layer && !is_alternative
            });
            let removed: Vec<String> = below.map(|(other, _)| other.clone()).collect();
            removed.iter().for_each(|other| drop(tree.remove(other)));
        }
        tree.insert(key, entry);
    }
    tree
}

/// The entries inside `outer`. They are looked up: a goal may have thousands of obstacles.
fn inside<'a>(tree: &'a Tree, outer: &'a str) -> impl Iterator<Item = (&'a String, &'a Entry)> {
    let from = tree.range::<str, _>((Bound::Included(outer), Bound::Unbounded));
    let alike = from.take_while(move |(key, _)| key.starts_with(outer));
    alike.filter(move |(key, _)| is_inside(key, outer))
}

/// True if `key` is a key of the table `outer` or an element of the array `outer`, at any depth.
pub(super) fn is_inside(key: &str, outer: &str) -> bool {
    key.strip_prefix(outer).is_some_and(|rest| rest.starts_with(['.', '[']))
}

/// `key` and the keys around it, innermost first: `a.b[0].c`, `a.b[0]`, `a.b`, `a`.
fn enclosing_keys(key: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(Some(key), |key| key.get(..key.rfind(['.', '['])?))
}
