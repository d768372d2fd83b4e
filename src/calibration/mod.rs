//! Calibrations of the rig: from recordings to numbers in the configuration.
//!
//! Each calibration is a least-squares fit. It refuses a recording that does not determine the
//! result. Everything here is pure; `needle-bench calibrate` reads the files.

mod error;
pub mod needle;
mod principal;
mod record;
pub mod registration;
pub mod tip;
pub mod tracker;

pub use error::CalibrationError;
pub use needle::{BendFit, NeedleFit, PathNoise, PosedRow, TorsionFit};
pub use record::{NeedleRecord, Provenance, RegistrationRecord, TipRecord};
pub use registration::{FiducialPair, RegistrationFit};
pub use tip::{SensorMount, TipFit, TurnSample};
pub use tracker::{AxisNoise, Measured, NoiseFit, RestSample, TrackerFit};
