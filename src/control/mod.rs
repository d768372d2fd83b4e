//! Controllers: from an estimated tip pose to the rotation rate of the next millimetre.

mod feedback_linearization;
mod nested_saturation;
mod spin_guard;

pub use feedback_linearization::{FeedbackLinearization, FeedbackLinearizationConfig};
pub use nested_saturation::{NestedSaturation, NestedSaturationConfig};

use crate::observer::Estimate;
use thiserror::Error;

/// What a controller asks of the stage for the next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// Rotation of the base per mm of insertion, rad/mm.
    pub rotation_rad_per_mm: f64,
    /// The law asked for more than its own limits let through.
    pub saturated: bool,
}

/// Why a controller has no command: the run must be stopped.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ControlError {
    /// The estimate, or what follows from it, is not finite; as of a needle without curvature.
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
    /// The roll estimate stands at the end of the law's coordinates.
    #[error(
        "estimated roll has been over {:.0} deg from the plane for {depth_mm:.0} mm: the control law divides by its cosine there; check the assumed start and the observer's poles",
        .limit_rad.to_degrees()
    )]
    RollOutOfDomain {
        /// The limit, rad.
        limit_rad: f64,
        /// How far the needle was inserted with it, mm.
        depth_mm: f64,
    },
    /// The law keeps turning the needle the same way: it chases its own error.
    #[error(
        "the needle was asked to turn {:.0} deg within {window_mm:.0} mm (limit {:.0}): the control law is spinning it",
        .turned_rad.to_degrees(), .limit_rad.to_degrees()
    )]
    Spinning {
        /// Net rotation commanded, rad.
        turned_rad: f64,
        /// Over how many mm.
        window_mm: f64,
        /// The limit, rad.
        limit_rad: f64,
    },
}

/// What every controller does.
pub trait Controller: Send {
    /// The command for the next `step_mm` of insertion, from the estimate at its start.
    ///
    /// # Errors
    /// [`ControlError`] where the law does not hold: the run is to be stopped with that reason.
    fn command(&mut self, estimate: &Estimate, step_mm: f64) -> Result<Command, ControlError>;
}
