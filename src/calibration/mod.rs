//! Calibrations of the rig, from recordings to the numbers that the configuration holds.
//!
//! Each calibration is least squares with its own refusals: a result is given only where the
//! recording determines it. Everything here is pure; `needle-bench calibrate` reads the files.

pub mod needle;
mod principal;
pub mod registration;
pub mod table;
pub mod tip;

pub use needle::{BendFit, NeedleFit, NeedleFitError, PathNoise, PosedRow, TorsionFit};
pub use registration::{FiducialPair, RegistrationFit, RegistrationFitError};
pub use table::TableError;
pub use tip::{SensorMount, TipFit, TipFitError, TurnSample};
