//! Reads sections out of the merged configuration.
//!
//! Each read names the key, its kind and its range once. From that one place come the check, the
//! error, the nearest-key suggestions and the list of keys.

use std::collections::BTreeSet;

use crate::canopen::frame::NodeId;

use super::error::{ConfigError, Problem};
use super::layers::{Tree, ancestors};
use super::rule::{self, Range, Rule, Wrong};
use super::suggest::nearest;
use super::value::{Entry, Origin, Value, element, join};

/// A key of the configuration, for documentation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    /// Dotted.
    pub key: String,
    /// The values it takes, with the unit: `over 0 to 1000 mm`.
    pub allowed: String,
    /// As the sources give it; `None` for a key left out.
    pub value: Option<String>,
}

/// A set of names, each for one value.
pub(super) trait Choice: Copy + 'static {
    const ALL: &'static [(&'static str, Self)];
}

/// The merged configuration while it is read.
pub(super) struct Reader {
    tree: Tree,
    keys: Vec<Key>,
    sections: BTreeSet<String>,
    /// Keys that were found wrong or missing.
    failed: BTreeSet<String>,
    problems: Vec<Problem>,
}

impl Reader {
    pub(super) fn new(tree: Tree) -> Self {
        let (keys, sections, failed) = (Vec::new(), BTreeSet::new(), BTreeSet::new());
        Reader { tree, keys, sections, failed, problems: Vec::new() }
    }

    /// The top of the configuration.
    pub(super) fn root(&mut self) -> Section<'_> {
        Section { reader: self, path: String::new() }
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
        let entries = keys.iter().filter_map(|&key| self.tree.get(key));
        let given = entries.filter(|entry| entry.layer > 0).max_by_key(|entry| entry.layer);
        let origin = given.map(|entry| entry.origin.clone());
        self.problems.push(Problem::at(origin, message()));
    }

    /// Ends the reading: keys that nothing asked for are unknown.
    ///
    /// # Errors
    /// Everything found wrong, files first, by line.
    pub(super) fn finish(mut self) -> Result<Vec<Key>, ConfigError> {
        self.find_unknown();
        if self.problems.is_empty() {
            return Ok(self.keys);
        }
        self.problems.sort_by_key(|problem| match problem.origin {
            Some(Origin::File { line, .. }) => (0, line),
            Some(Origin::Set) => (1, 0),
            None => (2, 0),
        });
        Err(ConfigError { problems: self.problems })
    }

    fn find_unknown(&mut self) {
        let leaves: BTreeSet<&str> = self.keys.iter().map(|key| key.key.as_str()).collect();
        let known = |key: &str| leaves.contains(key) || self.sections.contains(key);
        for (key, entry) in &self.tree {
            // Inside something that is unknown or wrong as a whole there is nothing more to say.
            let said = |outer: &str| {
                leaves.contains(outer)
                    || self.failed.contains(outer)
                    || self.tree.contains_key(outer) && !known(outer)
            };
            if known(key) || ancestors(key).any(said) {
                continue;
            }
            let hint = nearest(key, leaves.iter().copied(), &self.sections);
            self.problems.push(Problem::unknown_key(entry.origin.clone(), key, &hint));
        }
    }

    fn missing(&mut self, key: &str, rule: &Rule) {
        let given_in = ancestors(key).filter_map(|outer| self.tree.get(outer));
        let origin =
            given_in.filter(|entry| entry.layer > 0).map(|entry| entry.origin.clone()).next();
        let message =
            format!("{key} is missing and has no default here, expected {}", rule.expected);
        self.fail(key, Problem::at(origin, message));
    }

    fn fail(&mut self, key: &str, problem: Problem) {
        self.failed.insert(key.to_owned());
        self.problems.push(problem);
    }
}

/// One table of the configuration while it is read.
pub(super) struct Section<'a> {
    reader: &'a mut Reader,
    path: String,
}

impl Section<'_> {
    /// The table `name`, read by `read`.
    pub(super) fn section<T>(&mut self, name: &str, read: impl FnOnce(&mut Section<'_>) -> T) -> T {
        let path = join(&self.path, name);
        self.reader.sections.insert(path.clone());
        self.expect_table(&path);
        read(&mut Section { reader: self.reader, path })
    }

    /// The table `name`, if any of it is given.
    pub(super) fn optional_section<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&mut Section<'_>) -> T,
    ) -> Option<T> {
        let path = join(&self.path, name);
        let given = self
            .reader
            .tree
            .keys()
            .any(|key| *key == path || ancestors(key).any(|outer| outer == path));
        if !given {
            self.reader.sections.insert(path);
            return None;
        }
        Some(self.section(name, read))
    }

    /// The tables `[[name]]`, each read by `read`; none when the key is absent.
    pub(super) fn tables<T>(
        &mut self,
        name: &str,
        fields: &str,
        mut read: impl FnMut(&mut Section<'_>) -> T,
    ) -> Vec<T> {
        let rule = Rule::any(format!("tables of {fields}"));
        let count = self.optional(name, &rule, |entry| array(entry)).unwrap_or(0);
        let path = join(&self.path, name);
        self.reader.sections.insert(path.clone());
        (0..count)
            .map(|i| {
                let path = element(&path, i);
                self.reader.sections.insert(path.clone());
                self.expect_table(&path);
                read(&mut Section { reader: self.reader, path })
            })
            .collect()
    }

    /// A number in `range`.
    pub(super) fn number(&mut self, name: &str, range: Range) -> f64 {
        let rule = Rule::number(name, range);
        self.required(name, &rule, |entry| rule::number(entry, range)).unwrap_or(f64::NAN)
    }

    /// A number in `range`, or nothing.
    pub(super) fn optional_number(&mut self, name: &str, range: Range) -> Option<f64> {
        let rule = Rule::number(name, range);
        self.optional(name, &rule, |entry| rule::number(entry, range))
    }

    /// Exactly `N` numbers in `range`.
    pub(super) fn numbers<const N: usize>(&mut self, name: &str, range: Range) -> [f64; N] {
        let of_each = Rule::number(name, range);
        let rule = Rule {
            expected: format!("{N} numbers, each {}", of_each.expected),
            allowed: format!("{N} numbers, each {}", of_each.allowed),
        };
        let count =
            |entry: &Entry| if entry.value == Value::Array(N) { Ok(N) } else { Err(Wrong::Kind) };
        let mut numbers = [f64::NAN; N];
        if self.required(name, &rule, count).is_some() {
            let read = self.elements(name, N, &of_each, |entry| rule::number(entry, range));
            numbers.iter_mut().zip(read).for_each(|(number, read)| *number = read);
        }
        numbers
    }

    /// A whole number from `low` to `high`.
    pub(super) fn integer<T>(&mut self, name: &str, low: T, high: T) -> T
    where
        T: Copy + Into<i128> + TryFrom<i128>,
    {
        let rule = Rule::integer(name, low.into(), high.into());
        self.required(name, &rule, |entry| integer(entry, low, high)).unwrap_or(low)
    }

    /// A whole number from `low` to `high`, or nothing.
    pub(super) fn optional_integer<T>(&mut self, name: &str, low: T, high: T) -> Option<T>
    where
        T: Copy + Into<i128> + TryFrom<i128>,
    {
        let rule = Rule::integer(name, low.into(), high.into());
        self.optional(name, &rule, |entry| integer(entry, low, high))
    }

    /// Any number of whole numbers from `low` to `high`; none when the key is absent.
    pub(super) fn integers<T>(&mut self, name: &str, low: T, high: T) -> Vec<T>
    where
        T: Copy + Into<i128> + TryFrom<i128>,
    {
        let of_each = Rule::integer(name, low.into(), high.into());
        let rule = Rule::any(format!("an array of whole numbers, each {}", of_each.allowed));
        let count = self.optional(name, &rule, array).unwrap_or(0);
        self.elements(name, count, &of_each, |entry| integer(entry, low, high))
    }

    /// One of a few whole numbers, the first of them when it is wrong.
    pub(super) fn integer_of<T>(&mut self, name: &str, allowed: &[T], otherwise: T) -> T
    where
        T: Copy + Into<i128> + std::fmt::Display,
    {
        let rule = Rule::one_of(allowed.iter().map(T::to_string));
        let find = |entry: &Entry| match entry.value {
            Value::Integer(given) => {
                allowed.iter().copied().find(|&value| value.into() == given).ok_or(Wrong::Range)
            }
            _ => Err(Wrong::Kind),
        };
        self.required(name, &rule, find).unwrap_or(otherwise)
    }

    /// A node number of CANopen, 1 to 127.
    pub(super) fn node(&mut self, name: &str) -> NodeId {
        let rule = Rule::integer(name, 1, 127);
        let node = |entry: &Entry| NodeId::new(integer(entry, 1u8, 127)?).ok_or(Wrong::Range);
        self.required(name, &rule, node).unwrap_or(const { NodeId::new(1).unwrap() })
    }

    /// A 32-bit number to compare with a drive's, or `"any"`; any, too, when the key is absent.
    pub(super) fn identity(&mut self, name: &str) -> Option<u32> {
        let rule = Rule::any("a whole number of 32 bits or \"any\"");
        let identity = |entry: &Entry| match &entry.value {
            Value::String(text) if text == "any" => Ok(None),
            _ => integer(entry, 0, u32::MAX).map(Some),
        };
        self.optional(name, &rule, identity).flatten()
    }

    /// `true` or `false`.
    pub(super) fn boolean(&mut self, name: &str) -> bool {
        let boolean = |entry: &Entry| match entry.value {
            Value::Boolean(value) => Ok(value),
            _ => Err(Wrong::Kind),
        };
        self.required(name, &Rule::any("true or false"), boolean).unwrap_or_default()
    }

    /// A string that `is_allowed`, which `allowed` says in words.
    pub(super) fn text(
        &mut self,
        name: &str,
        allowed: &str,
        is_allowed: impl Fn(&str) -> bool,
    ) -> String {
        let rule = Rule { expected: "a string".to_owned(), allowed: allowed.to_owned() };
        let text = |entry: &Entry| match rule::text(entry)? {
            text if is_allowed(text) => Ok(text.to_owned()),
            _ => Err(Wrong::Range),
        };
        self.required(name, &rule, text).unwrap_or_default()
    }

    /// One of the names of `T`, the first of them when it is wrong.
    pub(super) fn choice<T: Choice>(&mut self, name: &str) -> T {
        let rule = Rule::one_of(names::<T>());
        self.required(name, &rule, choice::<T>).unwrap_or(T::ALL[0].1)
    }

    /// Any number of the names of `T`.
    pub(super) fn choices<T: Choice>(&mut self, name: &str) -> Vec<T> {
        let of_each = Rule::one_of(names::<T>());
        let rule = Rule::any(format!("an array of {}", of_each.expected));
        let count = self.required(name, &rule, array).unwrap_or(0);
        self.elements(name, count, &of_each, choice::<T>)
    }

    /// At most one of two numbers; both given is an error.
    pub(super) fn either(
        &mut self,
        first: (&str, Range),
        second: (&str, Range),
    ) -> (Option<f64>, Option<f64>) {
        let values =
            (self.optional_number(first.0, first.1), self.optional_number(second.0, second.1));
        let keys = [join(&self.path, first.0), join(&self.path, second.0)];
        let [a, b] = &keys;
        self.reader.check(&[a, b], values.0.is_some() && values.1.is_some(), || {
            format!("{b} is given along with {a}: give one of the two")
        });
        values
    }

    fn expect_table(&mut self, path: &str) {
        let Some(entry) = self.reader.tree.get(path) else { return };
        if entry.value != Value::Table {
            let message = Rule::any("a table").complaint(path, &entry.written, Wrong::Kind);
            let problem = Problem::at(Some(entry.origin.clone()), message);
            self.reader.fail(path, problem);
        }
    }

    fn elements<T>(
        &mut self,
        name: &str,
        count: usize,
        rule: &Rule,
        convert: impl Fn(&Entry) -> Result<T, Wrong>,
    ) -> Vec<T> {
        let path = join(&self.path, name);
        (0..count).filter_map(|i| self.convert(&element(&path, i), rule, &convert)).collect()
    }

    fn required<T>(
        &mut self,
        name: &str,
        rule: &Rule,
        convert: impl Fn(&Entry) -> Result<T, Wrong>,
    ) -> Option<T> {
        let key = join(&self.path, name);
        if !self.reader.tree.contains_key(&key) {
            self.reader.missing(&key, rule);
        }
        self.optional(name, rule, convert)
    }

    fn optional<T>(
        &mut self,
        name: &str,
        rule: &Rule,
        convert: impl Fn(&Entry) -> Result<T, Wrong>,
    ) -> Option<T> {
        let key = join(&self.path, name);
        let value = self.reader.tree.get(&key).map(|entry| entry.written.clone());
        self.reader.keys.push(Key { key: key.clone(), allowed: rule.allowed.clone(), value });
        self.convert(&key, rule, convert)
    }

    fn convert<T>(
        &mut self,
        key: &str,
        rule: &Rule,
        convert: impl Fn(&Entry) -> Result<T, Wrong>,
    ) -> Option<T> {
        let entry = self.reader.tree.get(key)?;
        match convert(entry) {
            Ok(value) => Some(value),
            Err(wrong) => {
                let message = rule.complaint(key, &entry.written, wrong);
                let problem = Problem::at(Some(entry.origin.clone()), message);
                self.reader.fail(key, problem);
                None
            }
        }
    }
}

fn array(entry: &Entry) -> Result<usize, Wrong> {
    match entry.value {
        Value::Array(count) => Ok(count),
        _ => Err(Wrong::Kind),
    }
}

fn integer<T>(entry: &Entry, low: T, high: T) -> Result<T, Wrong>
where
    T: Into<i128> + TryFrom<i128>,
{
    let value = rule::integer(entry, low.into(), high.into())?;
    T::try_from(value).map_err(|_| Wrong::Range)
}

fn names<T: Choice>() -> impl Iterator<Item = String> {
    T::ALL.iter().map(|(name, _)| format!("\"{name}\""))
}

fn choice<T: Choice>(entry: &Entry) -> Result<T, Wrong> {
    let text = rule::text(entry)?;
    T::ALL.iter().find(|(name, _)| *name == text).map(|&(_, value)| value).ok_or(Wrong::Range)
}
