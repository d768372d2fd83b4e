//! The run machine, sans-IO, and its record.

mod outcome;
mod record;

pub use outcome::Outcome;
pub use record::{Direction, Lane, Record, SampleRecord, Severity, StageRecord, StepRecord};
