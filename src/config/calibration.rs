//! `[calibration]`: how long what was measured at the rig counts.

use crate::keys::{over, section};

section! {
    /// `[calibration]`.
    #[derive(Copy)]
    pub struct CalibrationConfig {
        /// After so many days the preflight asks for a calibration, or `stage prove`, to be done again.
        max_age_days: f64 [over(0.0, 10_000.0)] = 90.0;
    }
}
