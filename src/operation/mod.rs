//! Operations: what the stage does without a needle to steer. Home, jog, withdraw, prove.
//!
//! An [`Operation`] is driven as a session is and leaves the same record. It has the same
//! [`Stage`](crate::stage::Stage) under it, and with it the same bring-up, supervision, limits and
//! stops: what would stop a run stops an operation.

mod machine;
mod moving;
mod silence;
#[cfg(test)]
mod tests;

pub use machine::{Done, Operation, OperationConfig};
pub use moving::{Goal, Move};

use crate::stage::{Axis, PerAxis, StageConfig};

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Task {
    /// Let the drives of these axes find their home, one after the other.
    Home(PerAxis<bool>),
    /// Move one axis, the other held.
    Move(Move),
    /// Hold both axes and fall silent, as a bench that has died: both drives must notice.
    Prove,
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
