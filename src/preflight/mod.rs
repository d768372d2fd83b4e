//! The checks before a run, while nothing has power, as one list.
//!
//! The caller inspects the bus, the drives, the tracker, earlier runs and the disk; this folder judges what it
//! found. After a [`Verdict::Fail`] nothing moves.

mod calibration;
mod equipment;
mod listening;

pub use calibration::{Earlier, calibrations, changes, proof, start_roll};
pub use equipment::{BusFacts, bus, disk, drive, plane, tracker};
pub use listening::{Listening, TrackerReport};

use derive_more::Display;
use serde::Serialize;

/// Length of the longest name of a check.
const NAME_WIDTH: usize = 23;

/// The result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Display, Serialize)]
#[display(rename_all = "UPPERCASE")]
#[serde(rename_all = "UPPERCASE")]
pub enum Verdict {
    /// As it should be.
    Pass,
    /// The operator decides.
    Warn,
    /// The run is refused.
    Fail,
}

/// One line of the list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// What was checked.
    pub name: String,
    /// Its result.
    pub verdict: Verdict,
    /// What was found, a number with its unit.
    pub found: String,
    /// What is allowed.
    pub limit: String,
    /// What to do, if the check did not pass; a line for each thing.
    pub next_step: Option<String>,
}

impl Check {
    /// A check that passes, of what was `found` and what is allowed.
    pub fn new(
        name: impl Into<String>,
        found: impl Into<String>,
        limit: impl Into<String>,
    ) -> Self {
        let (name, found, limit) = (name.into(), found.into(), limit.into());
        Check { name, verdict: Verdict::Pass, found, limit, next_step: None }
    }

    /// A check without a limit, such as that of an emulated bus.
    pub fn unlimited(name: impl Into<String>, found: impl Into<String>) -> Self {
        Check::new(name, found, "no limit")
    }

    /// This check if it `passes`, else [`with`](Self::with) that verdict and the next step.
    pub fn unless(self, passes: bool, verdict: Verdict, next_step: impl Into<String>) -> Self {
        if passes { self } else { self.with(verdict, next_step) }
    }

    /// This check with that verdict and the next step, added to those of the same verdict; unchanged if its verdict is
    /// worse already.
    pub fn with(self, verdict: Verdict, next_step: impl Into<String>) -> Self {
        let next_step = next_step.into();
        let next_step = match self.next_step.as_ref().filter(|_| self.verdict == verdict) {
            Some(first) => format!("{first}\n{next_step}"),
            None => next_step,
        };
        match self.verdict > verdict {
            true => self,
            false => Check { verdict, next_step: Some(next_step), ..self },
        }
    }
}

/// The list for a screen: a line for each check; below a check that did not pass, its next step.
pub fn to_text(checks: &[Check]) -> String {
    let lines = checks.iter().map(|Check { name, verdict, found, limit, next_step }| {
        let next_step = next_step.iter().flat_map(|next| next.lines());
        let next_step: String = next_step.map(|line| format!("\n      {line}")).collect();
        format!("{verdict}  {name:<NAME_WIDTH$}  {found} ({limit}){next_step}")
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests;
