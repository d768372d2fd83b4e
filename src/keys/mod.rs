//! How the keys of the configuration are declared: each with its type, range, default and text, and
//! whether hardware must give it. A folder declares the keys of its own settings beside the code that
//! uses them. `config` reads, prints and explains them all.

mod declare;
mod field;
mod reference;
mod units;
mod words;

pub(crate) use declare::{choice, section};
pub(crate) use field::Field;
pub(crate) use reference::{json_schema, toml_reference};
pub(crate) use units::unit_of;
pub(crate) use words::Words;

use toml::Value;
use units::converted;

/// The declaration of a key.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Key {
    pub(crate) name: &'static str,
    /// Its documentation, line by line.
    pub(crate) text: &'static str,
    pub(crate) kind: Kind,
    pub(crate) rule: Rule,
    /// True if the key may be omitted although it has no default.
    pub(crate) is_optional: bool,
    /// The default, in TOML.
    pub(crate) default: Option<&'static str>,
    pub(crate) default_holds: DefaultHolds,
    /// True if the value is converted from the unit in the key's name to mm, rad or s.
    pub(crate) is_converted: bool,
    /// A table whose keys are written in the enclosing table.
    pub(crate) is_flat: bool,
    /// A table that is replaced as a whole when it is given.
    pub(crate) is_whole: bool,
    /// The key of the same table to which this one is an alternative.
    pub(crate) instead_of: Option<&'static str>,
    /// The dotted key whose value is the upper limit of this one.
    pub(crate) at_most: Option<&'static str>,
    /// Narrower ranges of keys inside this table.
    pub(crate) narrowed: &'static [(&'static str, Rule)],
}

/// When a default holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DefaultHolds {
    /// Always. The declaration does not say whether hardware must give the key; for a key of a drive this does not
    /// compile.
    Undecided,
    /// With an emulated tracker only.
    ForEmulatedTracker,
    /// With an emulated stage only: hardware must give the key.
    ForEmulatedStage,
    /// For hardware as well.
    ForHardware,
    /// Always, even inside a table that is replaced as a whole.
    Everywhere,
}

/// The type of a value.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Kind {
    Number,
    /// A whole number from the first to the second.
    Integer(f64, f64),
    Boolean,
    Text,
    /// One of these words, each with its meaning.
    OneOf(&'static [(&'static str, &'static str)]),
    /// The type of the elements, and their number if it is fixed.
    Array(&'static Kind, Option<usize>),
    Table(&'static [Key]),
    /// One of two tables: the first if it has this key, else the second.
    Either(&'static str, [&'static [Key]; 2]),
}

/// The allowed values of a type.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Rule {
    Any,
    Range(Range),
    /// One of these whole numbers.
    Integers(&'static [i64]),
    /// Text that the function accepts, described in words.
    Text(&'static str, fn(&str) -> bool),
    /// Either this word, which stands for no value, or a value, which the second text describes.
    Or(&'static str, &'static str),
    /// Tables with the keys that this text lists.
    Fields(&'static str),
}

/// A closed or half-open interval of numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Range {
    pub(crate) low: f64,
    pub(crate) low_is_allowed: bool,
    pub(crate) high: f64,
}

/// From `low` to `high`, both allowed.
pub(crate) const fn within(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: true, high })
}

/// Over `low`, up to `high`.
pub(crate) const fn over(low: f64, high: f64) -> Rule {
    Rule::Range(Range { low, low_is_allowed: false, high })
}

/// Text that is not blank; `what` describes it.
pub(crate) const fn not_blank(what: &'static str) -> Rule {
    Rule::Text(what, |text| !text.trim().is_empty())
}

impl Range {
    pub(crate) fn contains(self, value: f64) -> bool {
        value <= self.high && (value > self.low || self.low_is_allowed && value == self.low)
    }
}

impl Kind {
    /// The numbers of this kind that `rule` allows.
    pub(crate) fn range(&self, rule: &Rule) -> Option<Range> {
        match (self, *rule) {
            (Kind::Number | Kind::Integer(..), Rule::Range(range)) => Some(range),
            (&Kind::Integer(low, high), _) => Some(Range { low, low_is_allowed: true, high }),
            _ => None,
        }
    }
}

/// Methods that return the declaration with one property changed.
macro_rules! setters {
    ($($name:ident($($argument:ident: $type:ty)?) { $property:ident: $value:expr })*) => {$(
        pub(crate) const fn $name(self $(, $argument: $type)?) -> Self {
            Key { $property: $value, ..self }
        }
    )*};
}

impl Key {
    pub(crate) const fn new<T: Field>(name: &'static str, text: &'static str) -> Self {
        Key {
            name,
            text,
            kind: T::KIND,
            rule: Rule::Any,
            is_optional: T::IS_OPTIONAL,
            default: None,
            default_holds: DefaultHolds::Undecided,
            is_converted: false,
            is_flat: false,
            is_whole: false,
            instead_of: None,
            at_most: None,
            narrowed: &[],
        }
    }

    setters! {
        rule(rule: Rule) { rule: rule }
        default(toml: &'static str) { default: Some(toml) }
        converted() { is_converted: true }
        flat() { is_flat: true }
        table(keys: &'static [Key]) { kind: Kind::Table(keys) }
        whole() { is_whole: true }
        instead_of(other: &'static str) { instead_of: Some(other) }
        at_most(other: &'static str) { at_most: Some(other) }
        narrowed(narrowed: &'static [(&'static str, Rule)]) { narrowed: narrowed }
        hardware_must_give() { default_holds: DefaultHolds::ForEmulatedStage }
        hardware_may_omit() { default_holds: DefaultHolds::ForHardware }
        tracker_must_give() { default_holds: DefaultHolds::ForEmulatedTracker }
        everywhere() { default_holds: DefaultHolds::Everywhere }
    }

    /// The default, if there is one.
    pub(crate) fn default_value(&self) -> Option<Value> {
        self.default?.parse().ok()
    }

    /// The keys of a table; none of a value.
    pub(crate) const fn keys(&self) -> &'static [Key] {
        match self.kind {
            Kind::Table(keys) => keys,
            _ => &[],
        }
    }

    /// The value of this key in `table`, converted to mm, rad or s if it `is_converted`; `None` for the word
    /// that stands for no value.
    pub(crate) fn value_in(&self, table: Option<&Value>) -> Option<Value> {
        let value = if self.is_flat { table? } else { table?.get(self.name)? };
        match (self.rule, value) {
            (Rule::Or(word, _), Value::String(text)) if text == word => None,
            (_, value) if self.is_converted => Some(converted(self.name, value)),
            (_, value) => Some(value.clone()),
        }
    }

    /// True if one of the two keys can replace the other.
    pub(crate) fn is_alternative_to(&self, other: &Key) -> bool {
        self.instead_of == Some(other.name) || other.instead_of == Some(self.name)
    }
}

/// Stands for the name of a key that this axis does not have.
pub(crate) const NO_KEY: &str = "";

/// True if the declaration of each of `keys` says whether hardware must give it.
pub(crate) const fn hardware_is_decided(keys: &[Key]) -> bool {
    match keys {
        [] => true,
        [key, rest @ ..] => {
            let is_decided = match key.default_holds {
                DefaultHolds::Undecided => key.is_flat && hardware_is_decided(key.keys()),
                _ => true,
            };
            is_decided && hardware_is_decided(rest)
        }
    }
}

/// The keys of a table, with those of the flat tables in it. The rules in `narrowed` replace the declared ones.
pub(crate) fn expanded(keys: &[Key], narrowed: &[(&str, Rule)]) -> Vec<Key> {
    let mut all = Vec::new();
    for key in keys.iter().filter(|key| key.name != NO_KEY) {
        if key.is_flat {
            all.extend(expanded(key.keys(), narrowed));
        } else {
            let rule = narrowed.iter().find(|(name, _)| *name == key.name);
            all.push(rule.map_or(*key, |(_, rule)| key.rule(*rule)));
        }
    }
    all
}

/// The key `name` in the table `path`. Names that need quotes in TOML keep them, so that they are
/// never taken for a dotted key.
pub(crate) fn join(path: &str, name: &str) -> String {
    let bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    let quoted = !name.chars().all(bare) || name.is_empty();
    let name = if quoted { format!("{name:?}") } else { name.to_owned() };
    if path.is_empty() { name } else { format!("{path}.{name}") }
}

/// The key at the dotted `path` in a table with these `keys`.
pub(crate) fn find(keys: &[Key], path: &str) -> Option<Key> {
    let (name, rest) = path.split_once('.').unwrap_or((path, ""));
    let name = name.split('[').next().unwrap_or(name);
    let key = expanded(keys, &[]).into_iter().find(|key| key.name == name)?;
    match rest {
        "" => Some(key),
        rest => tables(&key.kind).into_iter().find_map(|keys| find(keys, rest)),
    }
}

/// The tables that a value of this kind may be, or be made of.
pub(crate) fn tables(kind: &Kind) -> Vec<&'static [Key]> {
    match *kind {
        Kind::Table(keys) => vec![keys],
        Kind::Either(_, tables) => tables.to_vec(),
        Kind::Array(of, _) => tables(of),
        _ => Vec::new(),
    }
}
