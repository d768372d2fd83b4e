//! `[observer]`: which observer steers, which run alongside, and their settings. To add an observer, add its
//! kind, its section, and its settings in `ObserverSection::of_kind`. The section has the name of the kind, with `_`
//! for `-`; its keys are declared beside the observer.

use crate::geometry::FixedAngles;
use crate::keys::{Rule, choice, section, within};
use crate::observer::{CoupledConfig, FiniteDifferenceConfig, InvariantConfig, ObserverConfig};
use crate::session::Samples;

const START_PITCH: Rule = within(-80.0, 80.0);

section! {
    /// `[observer]`.
    pub struct ObserverSection {
        /// The observer that steers.
        kind: ObserverKind = "invariant";
        /// Observers that run alongside on the same stream: logged, never steering.
        shadows: Vec<ObserverKind> = ["coupled", "finite-difference"];
        /// Positions that correct the observers.
        samples: Samples = "all";
        /// Angles assumed at the start, in the plane frame; the position is the first measured one.
        start: FixedAngles => "{ yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }",
            narrowed(&[("pitch_deg", START_PITCH)]);
        /// The invariant observer; the check of the stream's handedness uses it as well.
        invariant: InvariantConfig;
        /// The coupled observer.
        coupled: CoupledConfig;
        /// The finite differences.
        finite_difference: FiniteDifferenceConfig;
    }
}

choice! {
    /// The kind of an observer.
    pub enum ObserverKind {
        /// The paper's coupled observer.
        Coupled = "coupled",
        /// Three positions differenced.
        FiniteDifference = "finite-difference",
        /// A bank of invariant Kalman filters, without local coordinates.
        Invariant = "invariant",
    }
}

impl ObserverSection {
    /// The observer that steers, then its shadows: each kind once, in the given order.
    pub(super) fn kinds(&self) -> Vec<ObserverKind> {
        let mut kinds = vec![self.kind];
        for shadow in &self.shadows {
            if !kinds.contains(shadow) {
                kinds.push(*shadow);
            }
        }
        kinds
    }

    /// The observer that steers.
    pub(super) fn steering(&self) -> ObserverConfig {
        self.of_kind(self.kind)
    }

    /// The observer that steers, then its shadows.
    pub fn observers(&self) -> impl Iterator<Item = ObserverConfig> + '_ {
        self.kinds().into_iter().map(|kind| self.of_kind(kind))
    }

    /// The settings of the observer of this `kind`.
    fn of_kind(&self, kind: ObserverKind) -> ObserverConfig {
        match kind {
            ObserverKind::Invariant => ObserverConfig::Invariant(self.invariant),
            ObserverKind::Coupled => ObserverConfig::Coupled(self.coupled),
            ObserverKind::FiniteDifference => {
                ObserverConfig::FiniteDifference(self.finite_difference)
            }
        }
    }
}
