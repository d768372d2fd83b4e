//! Pairs of an observer and a control law that do not hold together.

use super::{Config, ControlKind, ObserverKind};
use crate::observer::Gains;

/// A warning if the observer that steers does not hold with the law, as measured
/// (`docs/steering.md`).
pub(super) fn warning(config: &Config) -> Option<String> {
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
