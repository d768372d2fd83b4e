//! `[control]`: the law that steers, and its settings. A new law needs a kind and a section here.

use crate::control::{FeedbackLinearizationConfig, NestedSaturationConfig};
use crate::keys::{choice, section};
use crate::session;

section! {
    /// `[control]`.
    pub struct ControlConfig {
        /// The law that steers.
        kind: ControlKind = "nested-saturation";
        /// The nested saturation.
        nested_saturation: NestedSaturationConfig;
        /// The feedback linearisation.
        feedback_linearization: FeedbackLinearizationConfig;
    }
}

choice! {
    /// A control law.
    pub enum ControlKind {
        /// Feedback linearisation, as in the paper.
        FeedbackLinearization = "feedback-linearization",
        /// Nested saturation, which converges from every pose.
        NestedSaturation = "nested-saturation",
    }
}

impl ControlConfig {
    /// The fastest rotation that the chosen law asks for, rad per mm, and its key.
    pub fn rotation_max_rad_per_mm(&self) -> (f64, &'static str) {
        match self.kind {
            ControlKind::FeedbackLinearization => (
                self.feedback_linearization.rotation_max_rad_per_mm,
                "control.feedback_linearization.rotation_max_deg_per_mm",
            ),
            ControlKind::NestedSaturation => (
                self.nested_saturation.rotation_max_rad_per_mm,
                "control.nested_saturation.rotation_max_deg_per_mm",
            ),
        }
    }

    /// The settings of the chosen law.
    pub fn to_session(&self) -> session::ControlConfig {
        match self.kind {
            ControlKind::FeedbackLinearization => {
                session::ControlConfig::FeedbackLinearization(self.feedback_linearization)
            }
            ControlKind::NestedSaturation => {
                session::ControlConfig::NestedSaturation(self.nested_saturation)
            }
        }
    }
}
