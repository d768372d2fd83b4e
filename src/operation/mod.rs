//! Operations use the stage without steering a needle: home, jog, withdraw, prove, check of handedness.
//! Only the check of handedness needs a tracker; the others record what a tracker sends.
//!
//! An operation is a task of a [`Session`], as an insertion is: it has the same bring-up, supervision,
//! limits, stops and teardown, and the same record. What stops an insertion stops an operation.

mod handedness;
mod home;
mod moving;
mod prove;
#[cfg(test)]
mod tests;

pub use moving::{Move, MoveGoal};

use self::handedness::HandednessCheck;
use self::home::HomeAxes;
use self::moving::MoveOneAxis;
use self::prove::Prove;
use crate::session::{Session, SessionConfig, Task};
use crate::stage::{Axis, AxisUse, PerAxis, Stage, StageConfig};
use crate::tracker::Gate;
use crate::units::Time;
use nalgebra::Vector3;

/// An operation of the stage.
#[derive(Debug, Clone, PartialEq)]
pub enum Operation {
    /// Home axes, one after the other.
    Home {
        /// The axes to home.
        axes: PerAxis<bool>,
        /// Home an axis even if it is homed already and stands away from home.
        again: bool,
    },
    /// Move one axis; the other is held.
    Move(Move),
    /// Hold both axes and stop the bench's heartbeat; SYNC and set-points go on. Both drives must notice.
    Prove,
    /// The check of handedness: turn the base in air, and check that a sensor off its axis turns in the same
    /// direction.
    Handedness(Box<HandednessSettings>),
}

/// The settings of the check of handedness.
#[derive(Debug, Clone, PartialEq)]
pub struct HandednessSettings {
    /// The gate that samples must pass. Its position is that of the sensor, without the offset to the tip.
    pub gate: Gate,
    /// Direction of insertion in the bench frame W, of length 1.
    pub axis: Vector3<f64>,
    /// The turn of the base, which is made twice and then back: at most 90 degrees, and well over the tolerance
    /// of 15 degrees.
    pub turn: Move,
}

impl Operation {
    /// Homes the axis `only`, or, for `None`, every axis of `config` that can be homed; `again` even one that is homed
    /// already and stands away from home.
    pub fn home(config: &StageConfig, only: Option<Axis>, again: bool) -> Self {
        let axes = PerAxis::from_fn(|axis| match only {
            Some(only) => axis == only,
            None => config.axis(axis).homing.is_some(),
        });
        Operation::Home { axes, again }
    }

    /// Whether the operation needs a tracker.
    pub fn needs_tracker(&self) -> bool {
        matches!(self, Operation::Handedness(_))
    }
}

/// The configuration of a run: an insertion, or an operation of the stage alone.
#[derive(Debug, Clone)]
pub enum RunConfig {
    /// Steers a needle.
    Insertion(Box<SessionConfig>),
    /// Uses the stage without steering a needle.
    Operation(Box<StageConfig>, Operation),
}

impl RunConfig {
    /// The run as a session that begins at `now`.
    pub fn begin(self, now: Time) -> Session {
        let (config, operation) = match self {
            RunConfig::Insertion(config) => return Session::new(*config, now),
            RunConfig::Operation(config, operation) => (config, operation),
        };
        let purpose = PerAxis::from_fn(|axis| match &operation {
            Operation::Home { axes, again } if axes[axis] => AxisUse::Home { again: *again },
            Operation::Move(request) if request.axis == axis => AxisUse::Move,
            Operation::Home { .. } | Operation::Move(_) => AxisUse::Hold,
            Operation::Prove | Operation::Handedness(_) => AxisUse::Steer,
        });
        let task: Box<dyn Task> = match operation {
            Operation::Home { axes, .. } => Box::new(HomeAxes::new(axes)),
            Operation::Move(request) => Box::new(MoveOneAxis::new(request)),
            Operation::Prove => Box::new(Prove::default()),
            Operation::Handedness(settings) => Box::new(HandednessCheck::new(*settings)),
        };
        Session::begin(Stage::for_use(*config, purpose, now), task, now)
    }
}
