//! The run machine, sans-IO, and its record.
//!
//! Live, emulated and replayed runs are one [`Session`]: `handle(now, input)`, drain `poll()` to
//! `None`, wait until `deadline()`, repeat.

mod config;
mod contract;
mod estimation;
mod insertion;
mod machine;
mod news;
mod outcome;
mod peak;
mod profile;
mod reach;
mod record;
mod state;
mod steering;
mod tracking;

pub use config::{
    ControlConfig, InsertionConfig, InsertionMode, ObserverConfig, PlaneOutOfReach, Resume,
    SessionConfig, TrackerConfig,
};
pub use contract::{HELD_UP, Machine};
pub use machine::{Input, Output, Progress, Session, SessionError};
pub use outcome::Outcome;
pub use peak::{PROFILE_PEAK, rotation_peak};
pub use record::{Direction, Lane, Record, SampleRecord, Severity, StageRecord, StepRecord};
pub use state::{ControlState, ObserverState, SessionState, StageState, State, TrackerState};
pub use steering::{Decision, Steering, SteeringError};

pub(crate) use news::{left_unknown, news};
pub(crate) use profile::Profile;
