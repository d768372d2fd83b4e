//! The state machine of a run, sans-IO, and its record.
//!
//! Live, emulated and replayed runs are one [`Session`]: `handle(now, input)`, drain `poll()` to
//! `None`, wait until `deadline()`, repeat. A session is a shell around a task: the shell brings the
//! stage up, supervises it, stops it and takes power off; the task is an insertion, or an operation
//! of the stage alone (`crate::operation`).

mod config;
mod estimation;
mod goal;
mod insert;
mod insertion;
mod machine;
mod news;
mod outcome;
mod peak;
mod profile;
mod reach;
mod record;
mod shell;
mod state;
mod steering;
mod target;
mod task;
mod tracking;

pub use crate::observer::ObserverConfig;
pub use config::{
    HoldConfig, InsertionConfig, InsertionMode, PlaneOutOfReach, Resume, Samples, SessionConfig,
    TrackerConfig,
};
pub use goal::{Approach, Goal, Pursuit};
pub use machine::{AxisMove, Input, Machine, OperatorCommand, Output, Progress, STALLED, Session};
pub use outcome::{Outcome, StageAtEnd};
pub use peak::{PROFILE_PEAK, rotation_peak};
pub use record::{Direction, Lane, Record, SampleRecord, Severity, StepRecord};
pub use state::State;
pub use steering::{Decision, Steering};
pub use target::{MovingMean, TargetTool};

pub(crate) use insertion::ARRIVAL_TIMEOUT;
pub(crate) use news::{stage_news, tracker_news};
pub(crate) use profile::Profile;
pub(crate) use shell::Shell;
pub(crate) use task::Task;

/// Prefix of the event that reports what an operation has proved.
pub const PROVED: &str = "proved: ";

use news::unconfirmed_stop;
