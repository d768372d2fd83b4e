//! Reads typed values out of one table.
//!
//! Each read names the key, its kind and its range once. From that one place come the check, the
//! error, the nearest-key suggestions and the list of keys.

use crate::canopen::NodeId;

use super::error::Problem;
use super::layers::ancestors;
use super::reader::{Key, Reader};
use super::rule::{self, Range, Rule, Wrong};
use super::value::{Entry, Origin, Value, element, join};

/// A set of names, each for one value.
pub(super) trait Choice: Copy + 'static {
    const ALL: &'static [(&'static str, Self)];
}

/// One table of the configuration while it is read.
pub(super) struct Section<'a> {
    reader: &'a mut Reader,
    path: String,
}

impl<'a> Section<'a> {
    /// The top of the configuration.
    pub(super) fn root(reader: &'a mut Reader) -> Self {
        Section { reader, path: String::new() }
    }
}

impl Section<'_> {
    /// The table `name`, read by `read`.
    pub(super) fn section<T>(&mut self, name: &str, read: impl FnOnce(&mut Section<'_>) -> T) -> T {
        let path = join(&self.path, name);
        self.table(path, read)
    }

    /// The table `name`, if any of it is given.
    pub(super) fn optional_section<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&mut Section<'_>) -> T,
    ) -> Option<T> {
        if !self.is_given(name) {
            self.reader.sections.insert(join(&self.path, name));
            return None;
        }
        Some(self.section(name, read))
    }

    /// True if the key `name`, or any of the table `name`, is given.
    pub(super) fn is_given(&self, name: &str) -> bool {
        let path = join(&self.path, name);
        let tree = &self.reader.tree;
        tree.keys().any(|key| *key == path || ancestors(key).any(|outer| outer == path))
    }

    /// The tables `[[name]]`, each read by `read`; none when the key is absent.
    pub(super) fn tables<T>(
        &mut self,
        name: &str,
        fields: &str,
        mut read: impl FnMut(&mut Section<'_>) -> T,
    ) -> Vec<T> {
        let rule = Rule::any(format!("tables of {fields}"));
        let count = self.optional(name, &rule, array).unwrap_or(0);
        let path = join(&self.path, name);
        self.reader.sections.insert(path.clone());
        (0..count)
            .map(|i| {
                let path = element(&path, i);
                self.table(path, &mut read)
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
        let rule = of_each.times(N);
        let count =
            |entry: &Entry| if entry.value == Value::Array(N) { Ok(N) } else { Err(Wrong::Kind) };
        let mut numbers = [f64::NAN; N];
        if self.required(name, &rule, count).is_some() {
            let read = self.elements(name, N, &of_each, |entry| rule::number(entry, range));
            numbers.iter_mut().zip(read).for_each(|(number, read)| *number = read);
        }
        numbers
    }

    /// A lowest and a highest number, both in `range`, or nothing.
    pub(super) fn optional_interval(&mut self, name: &str, range: Range) -> Option<[f64; 2]> {
        let key = join(&self.path, name);
        if !self.reader.tree.contains_key(&key) {
            return self.optional(name, &Rule::number(name, range).times(2), |_| Ok([f64::NAN; 2]));
        }
        let [low, high] = self.numbers(name, range);
        self.reader.check(&[&key], low > high, || {
            format!("{key} is [{low}, {high}], allowed: the lower number first")
        });
        Some([low, high])
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
        self.integer_or(name, "any", "a whole number of 32 bits", 0, u32::MAX)
    }

    /// A whole number, or nothing for `word` and when the key is absent. `number` says in words
    /// what the number is.
    pub(super) fn integer_or<T>(
        &mut self,
        name: &str,
        word: &str,
        number: &str,
        low: T,
        high: T,
    ) -> Option<T>
    where
        T: Copy + Into<i128> + TryFrom<i128>,
    {
        let rule = Rule::any(format!("{number} or \"{word}\""));
        let convert = |entry: &Entry| match &entry.value {
            Value::String(text) if text == word => Ok(None),
            _ => integer(entry, low, high).map(Some),
        };
        self.optional(name, &rule, convert).flatten()
    }

    /// `true` or `false`.
    pub(super) fn boolean(&mut self, name: &str) -> bool {
        self.required(name, &Rule::any("true or false"), boolean).unwrap_or_default()
    }

    /// `true` or `false`, or nothing.
    pub(super) fn optional_boolean(&mut self, name: &str) -> Option<bool> {
        self.optional(name, &Rule::any("true or false"), boolean)
    }

    /// A string that `is_allowed`, which `allowed` says in words.
    pub(super) fn text(
        &mut self,
        name: &str,
        allowed: &str,
        is_allowed: impl Fn(&str) -> bool,
    ) -> String {
        let rule = Rule { expected: "a string".to_owned(), allowed: allowed.to_owned() };
        let text = |entry: &Entry| text(entry, &is_allowed);
        self.required(name, &rule, text).unwrap_or_default()
    }

    /// A string that `is_allowed`, which `allowed` says in words, or nothing.
    pub(super) fn optional_text_that(
        &mut self,
        name: &str,
        allowed: &str,
        is_allowed: impl Fn(&str) -> bool,
    ) -> Option<String> {
        let rule = Rule { expected: "a string".to_owned(), allowed: allowed.to_owned() };
        self.optional(name, &rule, |entry| text(entry, &is_allowed))
    }

    /// A string that is not blank, `what` in words, or nothing.
    pub(super) fn optional_text(&mut self, name: &str, what: &str) -> Option<String> {
        let rule = Rule { expected: "a string".to_owned(), allowed: what.to_owned() };
        self.optional(name, &rule, not_blank)
    }

    /// Exactly `N` strings that are not blank, each `what` in words.
    pub(super) fn texts<const N: usize>(&mut self, name: &str, what: &str) -> [String; N] {
        if !self.reader.tree.contains_key(&join(&self.path, name)) {
            self.reader.missing(&join(&self.path, name), &strings(N, what));
        }
        self.optional_texts(name, what).unwrap_or([const { String::new() }; N])
    }

    /// Exactly `N` strings that are not blank, each `what` in words, or nothing.
    pub(super) fn optional_texts<const N: usize>(
        &mut self,
        name: &str,
        what: &str,
    ) -> Option<[String; N]> {
        self.optional(name, &strings(N, what), |entry| match entry.value {
            Value::Array(count) if count == N => Ok(()),
            _ => Err(Wrong::Kind),
        })?;
        let of_each = Rule { expected: "a string".to_owned(), allowed: what.to_owned() };
        self.elements(name, N, &of_each, not_blank).try_into().ok()
    }

    /// One of the names of `T`, the first of them when it is wrong.
    pub(super) fn choice<T: Choice>(&mut self, name: &str) -> T {
        let rule = Rule::one_of(names::<T>());
        self.required(name, &rule, choice::<T>).unwrap_or(T::ALL[0].1)
    }

    /// One of the names of `T`, or nothing.
    pub(super) fn optional_choice<T: Choice>(&mut self, name: &str) -> Option<T> {
        self.optional(name, &Rule::one_of(names::<T>()), choice::<T>)
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

    /// Notes that this table as a whole is wrong, at its key `name`; suppresses further errors in it.
    pub(super) fn refuse(&mut self, name: &str, message: &str) {
        let origin = self.origin(name).or_else(|| self.reader.origin(&self.path));
        let problem = Problem::at(origin, format!("{}: {message}", self.path));
        let path = self.path.clone();
        self.reader.fail(&path, problem);
    }

    /// Notes that the key `name` of this table is wrong; `message` says why.
    pub(super) fn refuse_key(&mut self, name: &str, message: &str) {
        let key = join(&self.path, name);
        let problem = Problem::at(self.origin(name), format!("{key}: {message}"));
        self.reader.fail(&key, problem);
    }

    /// True where an error was found in this table.
    pub(super) fn is_wrong(&self) -> bool {
        self.reader.is_wrong(&self.path)
    }

    fn origin(&self, name: &str) -> Option<Origin> {
        self.reader.origin(&join(&self.path, name))
    }

    /// The table `path`, read by `read`.
    fn table<T>(&mut self, path: String, read: impl FnOnce(&mut Section<'_>) -> T) -> T {
        self.reader.sections.insert(path.clone());
        let entry = self.reader.tree.get(&path);
        let other = entry.filter(|entry| entry.value != Value::Table).cloned();
        if other.is_some() {
            // Before its keys are read, which would be reported as missing.
            self.reader.fail_silently(&path);
        }
        let value = read(&mut Section { reader: self.reader, path: path.clone() });
        if let Some(entry) = other {
            let expected = format!("a table{}", self.reader.form(&path));
            let message = Rule::any(expected).complaint(&path, &entry.written, Wrong::Kind);
            self.reader.fail(&path, Problem::at(Some(entry.origin), message));
        }
        value
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

fn boolean(entry: &Entry) -> Result<bool, Wrong> {
    match entry.value {
        Value::Boolean(value) => Ok(value),
        _ => Err(Wrong::Kind),
    }
}

fn text(entry: &Entry, is_allowed: impl Fn(&str) -> bool) -> Result<String, Wrong> {
    match rule::text(entry)? {
        text if is_allowed(text) => Ok(text.to_owned()),
        _ => Err(Wrong::Range),
    }
}

/// The rule of an array of `count` strings.
fn strings(count: usize, what: &str) -> Rule {
    Rule::any(format!("{count} strings, each {what}"))
}

fn not_blank(entry: &Entry) -> Result<String, Wrong> {
    match rule::text(entry)? {
        text if text.trim().is_empty() => Err(Wrong::Range),
        text => Ok(text.to_owned()),
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
