//! How a run ended.

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
