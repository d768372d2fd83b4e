//! `[control]`: the law that steers, and its settings. A law needs a kind, a section, and what it is
//! told, all of them here.

use super::schema::{Rule, choice, over, section, within};
use crate::control::{FeedbackLinearizationConfig, NestedSaturationConfig};
use crate::session;

/// Faster than 1 per mm a pole is done within a sample.
const RATE: Rule = over(0.0, 1.0);
/// A faster rotation has the same effect as its remainder.
const ROTATION: Rule = over(0.0, 360.0);

section! {
    /// `[control]`.
    pub struct ControlConfig {
        /// The law that steers.
        kind: ControlKind = "nested-saturation";
        /// The nested saturation.
        nested_saturation: NestedSaturationSection;
        /// The feedback linearisation.
        feedback_linearization: FeedbackLinearizationSection;
    }
}

choice! {
    /// A control law.
    pub enum ControlKind {
        /// The paper's.
        FeedbackLinearization = "feedback-linearization",
        /// The one that converges from every pose.
        NestedSaturation = "nested-saturation",
    }
}

section! {
    /// `[control.nested_saturation]`.
    pub struct NestedSaturationSection {
        /// Decay rate of the distance from the plane, per mm.
        distance_rate_per_mm: f64 [RATE] = 0.08;
        /// Decay rate of the pitch error, per mm.
        pitch_rate_per_mm: f64 [RATE] = 0.2;
        /// The law never steers towards the plane at more than this pitch, degrees.
        pitch_demand_max_deg: f64 [over(0.0, 60.0)] = 30.0;
        /// Part of the needle's bend that the way into the plane counts on.
        bend_part: f64 [over(0.0, 1.0)] = 0.9;
        /// The law never turns the base faster, degrees per mm.
        rotation_max_deg_per_mm: f64 [ROTATION] = 60.0;
        /// Smaller turns of the tip do not make the base cross the torsion's band, degrees.
        reversal_min_deg: f64 [within(0.0, 45.0)] = 4.5;
        /// Nor do turns under so many standard deviations of that band's width.
        reversal_sd: f64 [within(0.0, 10.0)] = 1.0;
        /// Part of each turn that is withheld while the roll is unknown.
        caution: f64 [within(0.0, 1.0)] = 0.5;
    }
}

section! {
    /// `[control.feedback_linearization]`.
    pub struct FeedbackLinearizationSection {
        /// Decay rates of the distance from the plane, per mm.
        poles_per_mm: [f64; 3] [RATE] = [0.05, 0.05, 0.05];
        /// The law never asks for more roll than this, degrees.
        roll_demand_max_deg: f64 [over(0.0, 85.0)] = 60.0;
        /// The law never turns the base faster, degrees per mm.
        rotation_max_deg_per_mm: f64 [ROTATION] = 20.0;
    }
}

impl ControlConfig {
    /// The fastest rotation that the chosen law asks for, and its key.
    pub fn rotation_max_deg_per_mm(&self) -> (f64, &'static str) {
        match self.kind {
            ControlKind::FeedbackLinearization => (
                self.feedback_linearization.rotation_max_deg_per_mm,
                "control.feedback_linearization.rotation_max_deg_per_mm",
            ),
            ControlKind::NestedSaturation => (
                self.nested_saturation.rotation_max_deg_per_mm,
                "control.nested_saturation.rotation_max_deg_per_mm",
            ),
        }
    }

    /// What a session is told.
    pub fn to_session(&self) -> session::ControlConfig {
        let (linearization, saturation) = (&self.feedback_linearization, &self.nested_saturation);
        match self.kind {
            ControlKind::FeedbackLinearization => {
                session::ControlConfig::FeedbackLinearization(FeedbackLinearizationConfig {
                    poles_per_mm: linearization.poles_per_mm,
                    roll_demand_max_rad: linearization.roll_demand_max_deg.to_radians(),
                    rotation_max_rad_per_mm: linearization.rotation_max_deg_per_mm.to_radians(),
                })
            }
            ControlKind::NestedSaturation => {
                session::ControlConfig::NestedSaturation(NestedSaturationConfig {
                    distance_rate_per_mm: saturation.distance_rate_per_mm,
                    pitch_rate_per_mm: saturation.pitch_rate_per_mm,
                    pitch_demand_max_rad: saturation.pitch_demand_max_deg.to_radians(),
                    bend_part: saturation.bend_part,
                    rotation_max_rad_per_mm: saturation.rotation_max_deg_per_mm.to_radians(),
                    reversal_min_rad: saturation.reversal_min_deg.to_radians(),
                    reversal_sd: saturation.reversal_sd,
                    caution: saturation.caution,
                })
            }
        }
    }
}
