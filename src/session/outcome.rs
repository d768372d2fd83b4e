//! How a run ended.

use crate::stage::{Axis, DriveReport, PerAxis, SetPoint};
use serde::Serialize;

/// How a run ended, and why it was stopped.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "outcome", content = "stop_reason", rename_all = "snake_case")]
pub enum Outcome {
    /// The task was completed, and both axes were stopped.
    Completed,
    /// The task was not completed, or the drives did not confirm the end of the stop, for this reason.
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

/// The state in which a run left the stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageAtEnd {
    /// The drives had power, or were about to.
    pub had_power: bool,
    /// The part of a stop that drives with power did not confirm; `None` if they were seen to stand without it.
    pub unknown: Option<&'static str>,
    /// The last report of each drive.
    pub drives: PerAxis<DriveReport>,
    /// Last measured position of both axes; `None` before both drives have sent it.
    pub position: Option<SetPoint>,
}

impl StageAtEnd {
    /// Where `axis` stands, mm or rad; `None` if that is not known: a drive that has restarted may count from another
    /// zero.
    pub fn position_of(&self, axis: Axis) -> Option<f64> {
        let position = self.position.filter(|_| !self.drives[axis].restarted);
        position.map(|position| position.along(axis))
    }
}
