//! Calibrations of the rig: from recordings to numbers for the configuration.
//!
//! Each calibration is a least-squares fit that refuses recordings which do not determine the
//! result. Everything here is pure; `needle-bench calibrate` reads the files.

pub mod needle;
mod principal;
pub mod registration;
pub mod table;
pub mod tip;

pub use needle::{BendFit, NeedleFit, NeedleFitError, PathNoise, PosedRow, TorsionFit};
pub use registration::{FiducialPair, RegistrationFit, RegistrationFitError};
pub use table::TableError;
pub use tip::{SensorMount, TipFit, TipFitError, TurnSample};
