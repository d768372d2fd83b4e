//! Sections of laws and observers that are not chosen: what is set there has no effect.

use super::Config;
use super::layers::{Tree, is_inside};
use super::value::Value;
use crate::keys::{Kind, find};

/// Always used, by the check of handedness.
const ALWAYS_USED: &str = "observer.invariant";

/// A warning for each section of `tree` that is given and that `config` does not use. A configuration
/// printed in full, as in a run folder, gives them all and gets none.
pub(super) fn warnings(config: &Config, tree: &Tree) -> Vec<String> {
    let (law, observer) = (config.control.kind.to_string(), config.observer.kind.to_string());
    let observers: Vec<String> = config.observers().map(|o| o.name().to_owned()).collect();
    let chosen = [
        ("control", &law, std::slice::from_ref(&law), ""),
        ("observer", &observer, &observers, ", or add to observer.shadows"),
    ];
    let mut warnings = Vec::new();
    for (table, kind, used, otherwise) in chosen {
        let key = find(Config::KEYS, &format!("{table}.kind")).map(|key| key.kind);
        let Some(Kind::OneOf(names)) = key else { continue };
        let mut printed = tree.iter().filter(|(key, _)| is_inside(key, table));
        if printed.all(|(_, entry)| entry.layer > 0) {
            continue;
        }
        for (name, _) in names.iter().filter(|(name, _)| !used.iter().any(|used| used == name)) {
            // A section is named as its kind.
            let section = format!("{table}.{}", name.replace('-', "_"));
            let given = tree.iter().find(|(key, entry)| {
                entry.layer > 0 && is_inside(key, &section) && entry.value != Value::Table
            });
            warnings.extend(given.filter(|_| section != ALWAYS_USED).map(|(key, entry)| {
                format!(
                    "{}{key} has no effect, since {table}.kind is \"{kind}\": set its section\
                     {otherwise}, or choose the other kind",
                    entry.origin
                )
            }));
        }
    }
    warnings
}
