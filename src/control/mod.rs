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
use thiserror::Error;

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

/// Why a controller has no command; the run must stop.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ControlError {
    /// The estimate or the command is not finite, for example with a needle of zero curvature.
    #[error("estimate or command is not finite; check needle.curvature_per_mm and the observer")]
    NotFinite,
    /// Pitch is outside the domain of the law.
    #[error(
        "estimated pitch is {:.1} deg, the control law holds within {:.0} deg; start nearer to the plane",
        .pitch_rad.to_degrees(), .limit_rad.to_degrees()
    )]
    PitchOutOfDomain {
        /// Estimated pitch, rad.
        pitch_rad: f64,
        /// The limit, rad.
        limit_rad: f64,
    },
    /// The roll estimate stays near the singularity of the law.
    #[error(
        "estimated roll has been over {:.0} deg from the plane for {depth_mm:.0} mm: the control law divides by its cosine there; check the assumed start and the observer's poles",
        .limit_rad.to_degrees()
    )]
    RollOutOfDomain {
        /// The limit, rad.
        limit_rad: f64,
        /// Insertion with that roll estimate, mm.
        depth_mm: f64,
    },
    /// The law keeps turning the needle in one direction: it follows an error of the estimate.
    #[error(
        "the needle was asked to turn {:.0} deg within {window_mm:.0} mm (limit {:.0}): the control law is spinning it",
        .turned_rad.to_degrees(), .limit_rad.to_degrees()
    )]
    Spinning {
        /// Net rotation commanded, rad.
        turned_rad: f64,
        /// Length of the window, mm.
        window_mm: f64,
        /// The limit, rad.
        limit_rad: f64,
    },
}

/// The reduced state of `estimate`, which must be finite, with a pitch of at most `limit_rad`.
fn state_within(
    estimate: &Estimate,
    step_mm: f64,
    limit_rad: f64,
) -> Result<Reduced, ControlError> {
    if !estimate.x_pb.is_finite() || !step_mm.is_finite() {
        return Err(ControlError::NotFinite);
    }
    let (state, _) = Reduced::split(&estimate.x_pb);
    let pitch_rad = state.pitch_rad;
    match pitch_rad.abs() > limit_rad {
        true => Err(ControlError::PitchOutOfDomain { pitch_rad, limit_rad }),
        false => Ok(state),
    }
}

/// A control law.
pub trait Controller: Send {
    /// The command for the next `step_mm` of insertion, from the estimate at its start.
    ///
    /// # Errors
    /// [`ControlError`] if the law has no valid command; the run must stop for that reason.
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, ControlError>;
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
