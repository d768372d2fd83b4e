//! Operations: what the stage does without a needle to steer. Home, jog, withdraw, prove.
//! A tracker is listened to by one alone, the check of handedness.
//!
//! An [`Operation`] is driven as a session is and leaves the same record. It has the same
//! [`Stage`](crate::stage::Stage) under it, and with it the same bring-up, supervision, limits and
//! stops: what would stop a run stops an operation.

mod answer;
mod machine;
mod moving;
mod silence;
#[cfg(test)]
mod tests;

pub use machine::{Done, Operation, OperationConfig};
pub use moving::{Goal, Move};

use crate::stage::{Axis, PerAxis, StageConfig};
use crate::tracker::GateSettings;
use nalgebra::Vector3;

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Task {
    /// Let the drives of these axes find their home, one after the other.
    Home(PerAxis<bool>),
    /// Move one axis, the other held.
    Move(Move),
    /// Hold both axes and fall silent, as a bench that has died: both drives must notice.
    Prove,
    /// Turn the base in air and see that a sensor off its axis turns the same way.
    Answer(Box<AnswerSettings>),
}

/// What the check of a sensor's answer needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerSettings {
    /// What a sample must pass; the position is the sensor's, without its offset to the tip.
    pub gate: GateSettings,
    /// Direction of insertion in the bench frame W, of length 1.
    pub axis: Vector3<f64>,
    /// The turn, made twice and then back: between a few degrees and 90.
    pub turn: Move,
}

impl Task {
    /// Homes `only` this axis, or every axis of `config` that can be homed.
    pub fn home(config: &StageConfig, only: Option<Axis>) -> Self {
        Task::Home(PerAxis::from_fn(|axis| match only {
            Some(only) => axis == only,
            None => config.axis(axis).homing.is_some(),
        }))
    }
}
