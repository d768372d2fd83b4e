//! Operations: what the stage does without a needle to steer. Home, jog, withdraw, prove.
//! Only the check of handedness needs a tracker; the others record what a tracker sends.
//!
//! An operation is a task of a [`Session`], as an insertion is: the same bring-up, supervision,
//! limits, stops and teardown, and the same record. What would stop a run stops an operation.

mod answer;
mod home;
mod moving;
mod prove;
#[cfg(test)]
mod tests;

pub use moving::{Goal, Move};

use self::answer::Answering;
use self::home::Homing;
use self::moving::MoveOneAxis;
use self::prove::Prove;
use crate::session::{Session, SessionConfig, Task};
use crate::stage::{Axis, PerAxis, Stage, StageConfig};
use crate::tracker::Gate;
use crate::units::Time;
use nalgebra::Vector3;

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Operation {
    /// Let the drives of these axes find their home, one after the other.
    Home(PerAxis<bool>),
    /// Move one axis, the other held.
    Move(Move),
    /// Hold both axes and stop the bench's heartbeat, as if the bench had died: both drives must notice.
    Prove,
    /// Turn the base in air and see that a sensor off its axis turns the same way.
    Answer(Box<AnswerSettings>),
}

/// What the check of a sensor's answer needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerSettings {
    /// What a sample must pass; the position is the sensor's, without its offset to the tip.
    pub gate: Gate,
    /// Direction of insertion in the bench frame W, of length 1.
    pub axis: Vector3<f64>,
    /// The turn, made twice and then back: well over 15 degrees, by which it may be off, and up to 90.
    pub turn: Move,
}

/// Everything an operation needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct OperationConfig {
    /// The two drives.
    pub stage: StageConfig,
    /// What is to be done.
    pub operation: Operation,
}

impl Operation {
    /// Homes `only` this axis, or every axis of `config` that can be homed.
    pub fn home(config: &StageConfig, only: Option<Axis>) -> Self {
        Operation::Home(PerAxis::from_fn(|axis| match only {
            Some(only) => axis == only,
            None => config.axis(axis).homing.is_some(),
        }))
    }

    /// Whether it needs a tracker.
    pub fn needs_tracker(&self) -> bool {
        matches!(self, Operation::Answer(_))
    }
}

impl OperationConfig {
    /// The operation as a session that begins at `now`.
    ///
    /// # Errors
    /// Where the stage refuses its configuration, or an axis is to be homed without being told how.
    pub fn begin(self, now: Time) -> Result<Session, String> {
        let OperationConfig { stage: config, operation } = self;
        let stage = match operation {
            Operation::Home(axes) => Stage::for_homing(config.clone(), axes, now),
            _ => Stage::new(config.clone(), now),
        };
        let stage = stage.map_err(|error| format!("stage: {error}"))?;
        let task: Box<dyn Task> = match operation {
            Operation::Home(axes) => Box::new(Homing::new(&config, axes)),
            Operation::Move(way) => Box::new(MoveOneAxis::new(&config, way)),
            Operation::Prove => Box::new(Prove::new(&config)),
            Operation::Answer(settings) => Box::new(Answering::new(&config, *settings)),
        };
        Ok(Session::begin(stage, config, task, now))
    }
}

/// What a run is: an insertion, or an operation of the stage alone.
#[derive(Debug, Clone)]
pub enum Plan {
    /// A needle is steered.
    Insertion(Box<SessionConfig>),
    /// The stage is moved without one.
    Operation(Box<OperationConfig>),
}

impl Plan {
    /// The run as a session that begins at `now`.
    ///
    /// # Errors
    /// Where an observer or the stage refuses its configuration.
    pub fn begin(self, now: Time) -> Result<Session, String> {
        match self {
            Plan::Insertion(config) => Session::new(*config, now),
            Plan::Operation(config) => config.begin(now),
        }
    }
}

impl From<SessionConfig> for Plan {
    fn from(config: SessionConfig) -> Self {
        Plan::Insertion(Box::new(config))
    }
}

impl From<OperationConfig> for Plan {
    fn from(config: OperationConfig) -> Self {
        Plan::Operation(Box::new(config))
    }
}
