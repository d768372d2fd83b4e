//! What a key may hold: its kind, range and unit, and the words for them.

use super::value::{Entry, Value};

/// A closed or half-open interval of numbers. Every number in a configuration has one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Range {
    low: f64,
    low_is_allowed: bool,
    high: f64,
}

impl Range {
    /// From `low` to `high`, both allowed.
    pub(super) const fn within(low: f64, high: f64) -> Self {
        Range { low, low_is_allowed: true, high }
    }

    /// Over `low`, up to `high`.
    pub(super) const fn over(low: f64, high: f64) -> Self {
        Range { low, low_is_allowed: false, high }
    }

    fn contains(self, value: f64) -> bool {
        value <= self.high && (value > self.low || self.low_is_allowed && value == self.low)
    }
}

/// What is allowed at a key, in words.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rule {
    /// The kind: `a number in mm`.
    pub(super) expected: String,
    /// The values of that kind: `over 0 to 1000 mm`.
    pub(super) allowed: String,
}

/// How a value breaks its rule.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Wrong {
    /// Of another kind.
    Kind,
    /// NaN or infinite.
    NotFinite,
    /// Of the kind, and not allowed.
    Range,
}

impl Rule {
    pub(super) fn number(name: &str, range: Range) -> Self {
        let Range { low, low_is_allowed, high } = range;
        let over = if low_is_allowed { "" } else { "over " };
        Rule {
            expected: format!("a number{}", in_unit(name)),
            allowed: with_unit(&format!("{over}{low} to {high}"), name),
        }
    }

    pub(super) fn integer(name: &str, low: i128, high: i128) -> Self {
        Rule {
            expected: format!("a whole number{}", in_unit(name)),
            allowed: with_unit(&format!("{low} to {high}"), name),
        }
    }

    /// An array of `count` such values.
    pub(super) fn times(&self, count: usize) -> Self {
        Rule {
            expected: format!("{count} numbers, each {}", self.expected),
            allowed: format!("{count} numbers, each {}", self.allowed),
        }
    }

    /// A kind all of whose values are allowed.
    pub(super) fn any(expected: impl Into<String>) -> Self {
        let expected = expected.into();
        Rule { allowed: expected.clone(), expected }
    }

    /// One of `names`.
    pub(super) fn one_of(names: impl Iterator<Item = String>) -> Self {
        Rule::any(names.collect::<Vec<_>>().join(" or "))
    }

    pub(super) fn complaint(&self, key: &str, written: &str, wrong: Wrong) -> String {
        match wrong {
            Wrong::Kind => format!("{key} is {written}, expected {}", self.expected),
            Wrong::NotFinite => {
                format!("{key} is {written}, not finite, allowed: {}", self.allowed)
            }
            Wrong::Range => format!("{key} is {written}, allowed: {}", self.allowed),
        }
    }
}

pub(super) fn number(entry: &Entry, range: Range) -> Result<f64, Wrong> {
    let value = match entry.value {
        Value::Float(value) => value,
        Value::Integer(value) => value as f64,
        _ => return Err(Wrong::Kind),
    };
    if !value.is_finite() {
        return Err(Wrong::NotFinite);
    }
    if range.contains(value) { Ok(value) } else { Err(Wrong::Range) }
}

pub(super) fn integer(entry: &Entry, low: i128, high: i128) -> Result<i128, Wrong> {
    match entry.value {
        Value::Integer(value) if (low..=high).contains(&value) => Ok(value),
        Value::Integer(_) => Err(Wrong::Range),
        _ => Err(Wrong::Kind),
    }
}

pub(super) fn text(entry: &Entry) -> Result<&str, Wrong> {
    match &entry.value {
        Value::String(text) => Ok(text),
        _ => Err(Wrong::Kind),
    }
}

/// The units that keys end in, longest first: (suffix, in words).
const UNITS: [(&str, &str); 11] = [
    ("_mm_per_s2", "mm/s²"),
    ("_deg_per_s2", "deg/s²"),
    ("_mm_per_s", "mm/s"),
    ("_deg_per_s", "deg/s"),
    ("_deg_per_mm", "deg/mm"),
    ("_per_mm", "per mm"),
    ("_mm", "mm"),
    ("_deg", "deg"),
    ("_ms", "ms"),
    ("_s", "s"),
    ("_hz", "Hz"),
];

/// The unit that a key's name ends in.
fn unit(name: &str) -> Option<&'static str> {
    UNITS.iter().find(|(suffix, _)| name.ends_with(suffix)).map(|&(_, unit)| unit)
}

fn in_unit(name: &str) -> String {
    match unit(name) {
        Some(unit) if unit.starts_with("per ") => format!(" {unit}"),
        Some(unit) => format!(" in {unit}"),
        None => String::new(),
    }
}

fn with_unit(range: &str, name: &str) -> String {
    unit(name).map_or_else(|| range.to_owned(), |unit| format!("{range} {unit}"))
}
