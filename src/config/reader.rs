//! The merged configuration while it is read: what was asked for, and what was found wrong.

use std::collections::{BTreeMap, BTreeSet};

use super::error::{ConfigError, Problem};
use super::layers::{Tree, ancestors, is_inside};
use super::rule::Rule;
use super::section::Section;
use super::suggest::nearest;
use super::value::{Entry, Origin, Value, element};

/// Keys shown of the form of a table.
const FORM_KEYS_MAX: usize = 4;

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

/// The merged configuration while it is read.
pub(super) struct Reader {
    pub(super) tree: Tree,
    /// Keys that were asked for.
    pub(super) keys: Vec<Key>,
    /// Tables that were asked for.
    pub(super) sections: BTreeSet<String>,
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
        Section::root(self)
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
        self.problems.push(match given {
            // `--set a.b is …` would name a key that was not set.
            Some((key, Entry { origin: Origin::Set, .. })) if !message.starts_with(key) => {
                Problem::at(Some(Origin::Set), format!("{key}: {message}"))
            }
            given => Problem::at(given.map(|(_, entry)| entry.origin.clone()), message),
        });
    }

    /// True where `key`, a part of it or what it is in was found wrong or missing.
    pub(super) fn is_wrong(&self, key: &str) -> bool {
        let is_part = |failed: &String| failed == key || is_inside(failed, key);
        self.failed.iter().any(is_part) || ancestors(key).any(|outer| self.failed.contains(outer))
    }

    /// What was found wrong so far; keys that nothing asked for are not looked at.
    ///
    /// # Errors
    /// The problems, in the order found.
    pub(super) fn so_far(self) -> Result<(), ConfigError> {
        let problems = self.problems;
        if problems.is_empty() { Ok(()) } else { Err(ConfigError { problems }) }
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
        let leaves: BTreeMap<&str, &str> =
            self.keys.iter().map(|key| (key.key.as_str(), key.allowed.as_str())).collect();
        let is_element = |key: &str| {
            let array = ancestors(key).next().filter(|array| leaves.contains_key(array));
            array.is_some_and(|array| match self.tree.get(array).map(|entry| &entry.value) {
                Some(Value::Array(count)) => (0..*count).any(|i| element(array, i) == key),
                _ => false,
            })
        };
        let is_known =
            |key: &str| leaves.contains_key(key) || self.sections.contains(key) || is_element(key);
        for (key, entry) in &self.tree {
            // Inside what is wrong or unknown as a whole there is nothing more to say.
            let is_reported = |outer: &str| {
                self.failed.contains(outer) || self.tree.contains_key(outer) && !is_known(outer)
            };
            if is_known(key) || ancestors(key).any(is_reported) {
                continue;
            }
            let above = ancestors(key).find(|outer| is_known(outer));
            let hint = match above.filter(|outer| !self.sections.contains(*outer)) {
                Some(value) => {
                    let takes = leaves.get(value).map(|allowed| format!(": it takes {allowed}"));
                    format!("{value} has no keys below it{}", takes.unwrap_or_default())
                }
                None => nearest(key, leaves.keys().copied(), &self.sections),
            };
            self.problems.push(Problem::unknown_key(entry.origin.clone(), key, &hint));
        }
    }

    /// Where `key` was given; `None` for a default.
    pub(super) fn origin(&self, key: &str) -> Option<Origin> {
        let entry = self.tree.get(key).filter(|entry| entry.layer > 0)?;
        Some(entry.origin.clone())
    }

    /// How the table `path` is written, from the keys that were read of it: `, { a = …, b = … }`.
    pub(super) fn form(&self, path: &str) -> String {
        let inside =
            self.keys.iter().filter_map(|key| key.key.strip_prefix(path)?.strip_prefix('.'));
        let mut names: Vec<&str> = inside.filter(|name| !name.contains(['.', '['])).collect();
        let is_cut = names.len() > FORM_KEYS_MAX;
        names.truncate(FORM_KEYS_MAX);
        let mut fields: Vec<String> = names.iter().map(|name| format!("{name} = …")).collect();
        if is_cut {
            fields.push("…".to_owned());
        }
        match fields.is_empty() {
            true => String::new(),
            false => format!(", {{ {} }}", fields.join(", ")),
        }
    }

    /// Notes that a key is not there.
    pub(super) fn missing(&mut self, key: &str, rule: &Rule) {
        if ancestors(key).any(|outer| self.failed.contains(outer)) {
            return;
        }
        let given_in = ancestors(key).filter_map(|outer| self.tree.get(outer));
        let origin =
            given_in.filter(|entry| entry.layer > 0).map(|entry| entry.origin.clone()).next();
        let message =
            format!("{key} is missing and has no default here, expected {}", rule.expected);
        self.fail(key, Problem::at(origin, message));
    }

    /// Suppresses errors inside `key`, which is reported later.
    pub(super) fn fail_silently(&mut self, key: &str) {
        self.failed.insert(key.to_owned());
    }

    /// Notes that a key is wrong.
    pub(super) fn fail(&mut self, key: &str, problem: Problem) {
        self.failed.insert(key.to_owned());
        self.problems.push(problem);
    }
}
