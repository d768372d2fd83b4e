//! Controllers: from the estimated tip pose to the base's rotation rate over the next step.

mod bend;
mod feedback_linearization;
mod nested_saturation;
mod spin_guard;

pub use bend::{Bend, BendLaw};
pub use feedback_linearization::{FeedbackLinearization, FeedbackLinearizationConfig};
pub use nested_saturation::{NestedSaturation, NestedSaturationConfig};

use crate::keys::{Rule, choice, over, section};
use crate::needle::{Needle, Reduced};
use crate::observer::Estimate;

/// The effect of a pole faster than 1 per mm decays within a sample.
const RATE: Rule = over(0.0, 1.0);
/// A rotation by more than a whole turn per mm acts like the rest after whole turns.
const ROTATION: Rule = over(0.0, 360.0);

/// A controller's command for the next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// Rotation of the base per mm of insertion, rad/mm.
    pub rotation_rad_per_mm: f64,
    /// True if the law demanded more than its limits allow.
    pub saturated: bool,
}

/// Why there is no command, for example with a needle of zero curvature.
const NOT_FINITE: &str =
    "estimate or command is not finite; check needle.curvature_per_mm and the observer";

/// The reduced state of `estimate`, which must be finite, with a pitch of at most `limit_rad`.
fn state_within(estimate: &Estimate, step_mm: f64, limit_rad: f64) -> Result<Reduced, String> {
    if !estimate.x_pb.is_finite() || !step_mm.is_finite() {
        return Err(NOT_FINITE.to_owned());
    }
    let (state, _) = Reduced::split(&estimate.x_pb);
    match state.pitch_rad.abs() > limit_rad {
        true => Err(format!(
            "estimated pitch is {:.1} deg, the control law holds within {:.0} deg; start nearer to the plane",
            state.pitch_rad.to_degrees(),
            limit_rad.to_degrees()
        )),
        false => Ok(state),
    }
}

/// A control law.
pub trait Controller: Send {
    /// The command for the next `step_mm` of insertion, from the estimate at its start.
    ///
    /// # Errors
    /// Why the law has no valid command; the run must stop for that reason.
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, String>;
}

section! {
    /// `[control]`: the law that steers, and the settings of each. A section is named as its kind, with `_` for
    /// `-`.
    #[derive(Copy)]
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
    /// Builds the law.
    pub fn build(&self, needle: Needle) -> Box<dyn Controller> {
        match self.kind {
            ControlKind::FeedbackLinearization => {
                Box::new(FeedbackLinearization::new(needle, self.feedback_linearization))
            }
            ControlKind::NestedSaturation => {
                Box::new(NestedSaturation::new(needle, self.nested_saturation))
            }
        }
    }

    /// The fastest rotation that the law asks for, rad per mm.
    pub fn rotation_max_rad_per_mm(&self) -> f64 {
        match self.kind {
            ControlKind::FeedbackLinearization => {
                self.feedback_linearization.rotation_max_rad_per_mm
            }
            ControlKind::NestedSaturation => self.nested_saturation.rotation_max_rad_per_mm,
        }
    }
}
