//! Settings that may not do what the operator expects: sections that are not chosen, pairs of an observer
//! and a control law that do not hold together, a rehearsal without a registration.

use super::reader::{REGISTRATION, Tree, is_inside};
use super::{Config, ObserverKind, TrackerSource};
use crate::control::ControlKind;
use crate::keys::{Field as _, Kind};
use crate::observer::Gains;

/// All warnings about `config`, which `tree` gives.
pub(super) fn all(config: &Config, tree: &Tree) -> Vec<String> {
    let mut warnings = unchosen(config, tree);
    warnings.extend(unregistered(config, tree));
    warnings.extend(pair(config));
    warnings
}

/// Always used, by the check of handedness.
const ALWAYS_USED: &str = "observer.invariant";

/// A warning for each section of `tree` that is given and that `config` does not use. A configuration
/// printed in full, as in a run folder, gives them all and gets none.
fn unchosen(config: &Config, tree: &Tree) -> Vec<String> {
    let (law, observer) = (config.control.kind.to_string(), config.observer.kind.to_string());
    let observers: Vec<String> = config.observer.kinds().iter().map(ToString::to_string).collect();
    let mut warnings = Vec::new();
    for (table, kind, names, used, otherwise) in [
        ("control", &law, ControlKind::KIND, std::slice::from_ref(&law), ""),
        ("observer", &observer, ObserverKind::KIND, &observers, ", or add to observer.shadows"),
    ] {
        let Kind::OneOf(names) = names else { continue };
        let mut printed = tree.iter().filter(|(key, _)| is_inside(key, table));
        if printed.all(|(_, entry)| entry.layer > 0) {
            continue;
        }
        for (name, _) in names.iter().filter(|(name, _)| !used.iter().any(|used| used == name)) {
            // A section is named as its kind.
            let section = format!("{table}.{}", name.replace('-', "_"));
            let given = tree.iter().find(|(key, entry)| {
                entry.layer > 0 && is_inside(key, &section) && !entry.value.is_table()
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

/// Without a registration a rehearsal takes the tracker's frame for the bench's; a run does not.
fn unregistered(config: &Config, tree: &Tree) -> Option<String> {
    let is_real = config.tracker.source != TrackerSource::Emulated;
    let is_given = tree.iter().any(|(key, entry)| is_inside(key, REGISTRATION) && entry.layer > 0);
    (config.emulator.rehearse && is_real && !is_given).then(|| {
        format!(
            "{REGISTRATION} is missing: this rehearsal takes the tracker's frame for the bench's; before \
             a run measure it by needle-bench calibrate registration"
        )
    })
}

/// A warning if the observer that steers does not hold with the law, as measured
/// (`docs/steering.md`).
fn pair(config: &Config) -> Option<String> {
    let (observer, law) = (&config.observer, config.control.kind);
    match (observer.kind, observer.coupled.gains, law) {
        (ObserverKind::FiniteDifference, ..) => Some(
            "observer.kind = \"finite-difference\" is not made for steering, its roll is noise at ±1 mm: set \
             observer.kind = \"invariant\", and add it to observer.shadows"
                .to_owned(),
        ),
        (ObserverKind::Coupled, Gains::Placed, ControlKind::NestedSaturation) => Some(format!(
            "observer.coupled.gains = \"placed\" does not hold with control.kind = \"{law}\": 15% of 300 \
             insertions settled; set gains = \"fading\", or control.kind = \"feedback-linearization\""
        )),
        _ => None,
    }
}
