//! Warnings of settings that may not do what the operator expects: unused sections, an observer that does
//! not converge with the control law, a rehearsal without a registration.

use super::reader::{REGISTRATION, Tree, is_inside};
use super::value::{Entry, Origin};
use super::{Config, ObserverKind, TrackerSource};
use crate::control::ControlKind;
use crate::keys::{Field as _, Kind};
use crate::observer::Gains;

/// All warnings about `config`, which was read from `tree`.
pub(super) fn all(config: &Config, tree: &Tree) -> Vec<String> {
    let mut warnings = unused_sections(config, tree);
    warnings.extend(missing_registration(config, tree));
    warnings.extend(unsuitable_pair(config));
    warnings.extend(exact_model(config));
    warnings.extend(torsion_not_followed(config));
    warnings
}

/// A warning for each section of `tree` that is given and that `config` does not use. A configuration
/// printed in full, as in a run folder, gives all sections: only `--set` gets a warning there.
fn unused_sections(config: &Config, tree: &Tree) -> Vec<String> {
    // The check of handedness always uses the section of the invariant observer.
    let observers = config.observer.kinds().into_iter().chain([ObserverKind::Invariant]);
    let observers = observers.map(|kind| kind.to_string()).collect();
    let mut warnings = Vec::new();
    for (table, kinds, used, or_shadow) in [
        ("control", ControlKind::KIND, vec![config.control.kind.to_string()], false),
        ("observer", ObserverKind::KIND, observers, true),
    ] {
        let Kind::OneOf(kinds) = kinds else { continue };
        let mut in_table = tree.iter().filter(|(key, _)| is_inside(key, table));
        let is_printed_in_full = in_table.all(|(_, entry)| entry.layer > 0);
        for (kind, _) in kinds.iter().filter(|(kind, _)| used.iter().all(|used| used != kind)) {
            let section = format!("{table}.{}", section_name(kind));
            let given = tree.iter().find(|(key, entry)| {
                let is_meant = !is_printed_in_full || entry.origin == Origin::Set;
                is_meant && entry.layer > 0 && is_inside(key, &section) && !entry.value.is_table()
            });
            let Some((key, Entry { origin, .. })) = given else { continue };
            let or = format!(", or add \"{kind}\" to observer.shadows");
            warnings.push(format!(
                "{origin}{key} has no effect, since {table}.kind is \"{}\": choose {table}.kind = \
                 \"{kind}\"{}",
                used[0],
                if or_shadow { or.as_str() } else { "" },
            ));
        }
    }
    warnings
}

/// The name of the section with the keys of an observer or a control law of this `kind`.
pub(super) fn section_name(kind: &str) -> String {
    kind.replace('-', "_")
}

/// A warning for a rehearsal without a registration, which uses the tracker's frame as the bench's. A run
/// would be refused.
fn missing_registration(config: &Config, tree: &Tree) -> Option<String> {
    let is_real = config.tracker.source != TrackerSource::Emulated;
    let is_given = tree.iter().any(|(key, entry)| is_inside(key, REGISTRATION) && entry.layer > 0);
    (config.emulator.rehearse && is_real && !is_given).then(|| {
        format!(
            "{REGISTRATION} is missing: this rehearsal takes the tracker's frame for the bench's; before \
             a run measure it by needle-bench calibrate registration"
        )
    })
}

/// A warning for a real stage whose default observer takes needle and tissue to be exactly like the model. Where
/// they differ, its standard deviation is far too small (`docs/hazards.md`).
fn exact_model(config: &Config) -> Option<String> {
    let walks = ["position_mm", "axial_mm", "heading_deg", "roll_deg", "curvature"];
    let is_exact =
        walks.iter().all(|key| config.number(&format!("observer.invariant.noise.{key}")) == 0.0);
    let is_real = config.stage.hardware && config.observer.kind == ObserverKind::Invariant;
    (is_real && is_exact).then(|| {
        "observer.invariant.noise is 0: where tissue or shaft differ from the model, the estimate is wrong by far \
         more than it states; rig-epos4.toml has values to start with"
            .to_owned()
    })
}

/// A warning for a torsion that the steering observer does not follow, as measured in studies.
fn torsion_not_followed(config: &Config) -> Option<String> {
    let torsion = config.needle.torsion;
    let has_band = torsion.half_width_rad > 0.0 || torsion.half_width_rad_per_mm > 0.0;
    let creeps = torsion.creep_mm > 0.0 || torsion.creep_mm_per_mm > 0.0;
    match config.observer.kind {
        ObserverKind::Invariant if has_band && creeps => Some(
            "needle.torsion has a band and a creep: the observer follows either, but is wrong by far more than it \
             states with both; keep the one that fits the needle better"
                .to_owned(),
        ),
        ObserverKind::Coupled if has_band || creeps || torsion.offset_rad != 0.0 => Some(
            "needle.torsion has no effect on observer.kind = \"coupled\", which takes the shaft to be rigid: its roll \
             will be wrong by the torsion; use \"invariant\""
                .to_owned(),
        ),
        _ => None,
    }
}

/// A warning if the steering observer and the control law do not work together, as measured
/// (`docs/steering.md`).
fn unsuitable_pair(config: &Config) -> Option<String> {
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
