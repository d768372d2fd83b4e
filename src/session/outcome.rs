//! How a run ended.

use crate::stage::{DriveReport, PerAxis, SetPoint};
use serde::Serialize;

/// Whether the run reached its depth.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "outcome", content = "stop_reason", rename_all = "snake_case")]
pub enum Outcome {
    /// The configured depth was reached and the stage was stopped in order.
    Completed,
    /// The run was stopped before, for the reason given.
    Stopped(String),
}

impl Outcome {
    /// The reason of a stopped run.
    pub fn stop_reason(&self) -> Option<&str> {
        match self {
            Outcome::Completed => None,
            Outcome::Stopped(reason) => Some(reason),
        }
    }
}

/// What a run has left of the stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Left {
    /// The drives had power, or were about to.
    pub had_power: bool,
    /// What is not known of drives that had power; `None` where they were seen to stand without it.
    pub unknown: Option<&'static str>,
    /// What each drive has last said of itself.
    pub drives: PerAxis<DriveReport>,
    /// Where the axes were last measured; `None` before both drives have said it.
    pub position: Option<SetPoint>,
}
