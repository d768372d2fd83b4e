//! Sections of laws and observers that are not chosen: what is set there has no effect.

use super::layers::{Tree, is_inside};
use super::value::Value;
use super::{Config, ControlKind, ObserverKind};

/// A warning for each section of `tree` that is given and that `config` does not use. A configuration
/// printed in full, as in a run folder, gives them all and gets none.
pub(super) fn warnings(config: &Config, tree: &Tree) -> Vec<String> {
    let observes = |kind| config.observer.kind == kind || config.observer.shadows.contains(&kind);
    let law = |kind: ControlKind, section| (config.control.kind == kind, section);
    // [observer.invariant] is missing here: the check of handedness always uses it.
    let sections = [
        law(ControlKind::FeedbackLinearization, "control.feedback_linearization"),
        law(ControlKind::NestedSaturation, "control.nested_saturation"),
        (observes(ObserverKind::Coupled), "observer.coupled"),
        (observes(ObserverKind::FiniteDifference), "observer.finite_difference"),
    ];
    let is_printed = |table: &str| {
        let mut entries = tree.iter().filter(|(key, _)| is_inside(key, table));
        entries.all(|(_, entry)| entry.layer > 0)
    };
    let warning = |section: &str| {
        let (key, entry) = tree.iter().find(|(key, entry)| {
            entry.layer > 0 && is_inside(key, section) && entry.value != Value::Table
        })?;
        let (table, why) = match section.starts_with("control") {
            true => {
                ("control", format!("control.kind is \"{}\": set its section", config.control.kind))
            }
            false => (
                "observer",
                format!(
                    "observer.kind is \"{}\": set its section, or add to observer.shadows",
                    config.observer.kind
                ),
            ),
        };
        let said =
            format!("{}{key} has no effect, since {why}, or choose the other kind", entry.origin);
        (!is_printed(table)).then_some(said)
    };
    let unused = sections.iter().filter(|(is_used, _)| !is_used);
    unused.filter_map(|(_, section)| warning(section)).collect()
}
