//! The allowed values of a key, in words.

use super::{Key, Kind, Range, Rule, unit_of};

/// The allowed values of a key.
pub(crate) struct Words {
    /// The kind: `a number in mm`.
    pub(crate) expected: String,
    /// The values of that kind: `over 0 to 1000 mm`.
    pub(crate) allowed: String,
}

impl Words {
    /// The allowed values of this kind and rule, in the unit that `name` ends in.
    pub(crate) fn of(kind: &Kind, rule: &Rule, name: &str) -> Self {
        let both = |expected: String| Words { allowed: expected.clone(), expected };
        match (kind, *rule) {
            (Kind::Array(of, Some(count)), _) => {
                let each = Words::of(of, rule, name).allowed;
                both(format!("{count} {}, each {each}", plural(of)))
            }
            (Kind::Array(Kind::Table(_), None), Rule::Fields(fields)) => {
                both(format!("tables of {fields}"))
            }
            (Kind::Array(of, None), _) => {
                let each = Words::of(of, rule, name).allowed;
                both(format!("an array of {}, each {each}", plural(of)))
            }
            (_, Rule::Or(word, number)) => both(format!("{number} or \"{word}\"")),
            (_, Rule::Integers(values)) => both(joined_by_or(values.iter().map(i64::to_string))),
            (_, Rule::Text(what, _)) => Words { expected: "a string".into(), allowed: what.into() },
            (Kind::OneOf(words), _) => {
                both(joined_by_or(words.iter().map(|(word, _)| format!("\"{word}\""))))
            }
            (Kind::Boolean, _) => both("true or false".into()),
            (Kind::Text, _) => Words { expected: "a string".into(), allowed: "any text".into() },
            (Kind::Number | Kind::Integer(..), _) => {
                let whole = if matches!(kind, Kind::Number) { "" } else { "whole " };
                let expected = format!("a {whole}number{}", in_unit(name));
                let range = kind.range(rule).map(|range| with_unit(range, name));
                Words { allowed: range.unwrap_or_else(|| expected.clone()), expected }
            }
            (Kind::Table(_) | Kind::Either(..), _) => both("a table".into()),
        }
    }

    /// The allowed values of `key`.
    pub(crate) fn of_key(key: &Key) -> Self {
        Words::of(&key.kind, &key.rule, key.name)
    }
}

fn plural(kind: &Kind) -> &'static str {
    match kind {
        Kind::Number => "numbers",
        Kind::Integer(..) => "whole numbers",
        Kind::Boolean => "booleans",
        Kind::Text | Kind::OneOf(_) => "strings",
        Kind::Array(..) => "arrays",
        Kind::Table(_) | Kind::Either(..) => "tables",
    }
}

fn joined_by_or(names: impl Iterator<Item = String>) -> String {
    names.collect::<Vec<_>>().join(" or ")
}

fn in_unit(name: &str) -> String {
    match unit_of(name) {
        Some(unit) if unit.starts_with("per ") => format!(" {unit}"),
        Some(unit) => format!(" in {unit}"),
        None => String::new(),
    }
}

fn with_unit(Range { low, low_is_allowed, high }: Range, name: &str) -> String {
    let over = if low_is_allowed { "" } else { "over " };
    let unit = unit_of(name).map(|unit| format!(" {unit}")).unwrap_or_default();
    format!("{over}{low} to {high}{unit}")
}
