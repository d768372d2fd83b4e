//! Compares configurations of runs key by key.

use std::collections::BTreeMap;
use toml::{Table, Value};

/// Every key of a configuration with its value in TOML. Tables in arrays are numbered:
/// `emulator.fault[0].kind`.
pub type Keys = BTreeMap<String, String>;

/// A key with different values in two configurations.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The key.
    pub key: String,
    /// Its value in the first configuration; `None` if missing.
    pub a: Option<String>,
    /// Its value in the second configuration.
    pub b: Option<String>,
}

/// The keys of `toml`.
///
/// # Errors
/// Invalid TOML, with its line.
pub fn keys(toml: &str) -> Result<Keys, toml::de::Error> {
    let mut keys = Keys::new();
    flatten("", &toml.parse::<Table>()?, &mut keys);
    Ok(keys)
}

fn flatten(path: &str, table: &Table, keys: &mut Keys) {
    for (name, value) in table {
        let key = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        match value {
            Value::Table(table) => flatten(&key, table, keys),
            Value::Array(values) if values.iter().any(Value::is_table) => {
                for (n, value) in values.iter().enumerate() {
                    let at = format!("{key}[{n}]");
                    match value {
                        Value::Table(table) => flatten(&at, table, keys),
                        other => drop(keys.insert(at, other.to_string())),
                    }
                }
            }
            other => drop(keys.insert(key, other.to_string())),
        }
    }
}

/// The keys whose values differ between `a` and `b`.
pub fn differences(a: &Keys, b: &Keys) -> Vec<Difference> {
    let only_b = b.keys().filter(|key| !a.contains_key(*key));
    let mut all: Vec<&String> = a.keys().chain(only_b).collect();
    all.sort();
    all.into_iter()
        .filter(|key| a.get(*key) != b.get(*key))
        .map(|key| Difference { key: key.clone(), a: a.get(key).cloned(), b: b.get(key).cloned() })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_told_key_by_key() {
        let a = "name = \"a\"\n[needle]\nradius_mm = 122.0\n[needle.torsion]\noffset_deg = 0.0\n";
        let b = "name = \"a\"\n[needle]\nradius_mm = 121.5\n[needle.torsion]\noffset_deg = 0.0\n\
                 [[emulator.fault]]\nkind = \"silent\"\nat_mm = 10.0\n";
        let said: Vec<(String, Option<String>, Option<String>)> =
            differences(&keys(a).unwrap(), &keys(b).unwrap())
                .into_iter()
                .map(|Difference { key, a, b }| (key, a, b))
                .collect();
        let some = |text: &str| Some(text.to_owned());
        assert_eq!(
            said,
            [
                ("emulator.fault[0].at_mm".to_owned(), None, some("10.0")),
                ("emulator.fault[0].kind".to_owned(), None, some("\"silent\"")),
                ("needle.radius_mm".to_owned(), some("122.0"), some("121.5")),
            ]
        );
    }

    #[test]
    fn a_configuration_agrees_with_itself() {
        let keys = keys(crate::config::DEFAULT_TOML).unwrap();
        assert!(keys.len() > 100);
        assert_eq!(differences(&keys, &keys), []);
    }
}
