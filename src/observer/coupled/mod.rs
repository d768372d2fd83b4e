//! The paper's coupled observer (Section 5.4): as in the paper ([`Coupled`]), and for any roll at the start
//! ([`CoupledBank`]).

mod bank;
mod single;
#[cfg(test)]
mod tests;

pub use single::Coupled;

use super::Observer;
use crate::geometry::FixedAngles;
use crate::keys::{Rule, choice, over, section, within};
use crate::needle::Needle;
use bank::CoupledBank;

/// The effect of a pole faster than 1 per mm decays within a sample.
const POLE: Rule = over(0.0, 1.0);
/// A standard deviation of an angle; over 90 degrees a roll is not known at all.
const ANGLE_SD: Rule = within(0.0, 180.0);

choice! {
    /// The gains of the coupled observer.
    pub enum Gains {
        /// Those of a fading memory, with a stated uncertainty; from any roll that `start_sd` allows.
        Fading = "fading",
        /// The paper's: fixed poles, from one start near the true one.
        Placed = "placed",
    }
}

section! {
    /// `[observer.coupled]`: parameters of the observer.
    ///
    /// The default rate of the placed poles, 0.07, was chosen from 400 starts
    /// (`tests/pure/steering.rs`). Without noise all six errors are below 3e-7 (mm, rad) at 300 mm
    /// (0.06 leaves 2e-6). With ±1 mm noise the roll is within 2.2° RMS (0.1 gives 5.5°) and every
    /// start settles.
    #[derive(Copy)]
    pub struct CoupledConfig {
        /// How its gains are found.
        gains: Gains = "fading";
        /// Fading gains: insertion over which the weight of a position falls to 1/e.
        memory_mm: f64 [within(1.0, 1000.0)] = 20.0;
        /// Fading gains: standard deviations of `observer.start`. A roll of over 22.5 takes copies
        /// around the circle, a roll of over 90 is not known at all.
        start_sd: FixedAngles => "{ yaw_deg = 12.0, pitch_deg = 8.0, roll_deg = 180.0 }", narrowed(
            &[("yaw_deg", ANGLE_SD), ("pitch_deg", ANGLE_SD), ("roll_deg", ANGLE_SD)]
        );
        /// Placed poles exp(-rate * step): rates of x, sin(pitch), and curvature * cos(pitch) *
        /// sin(roll), per mm.
        reduced_poles_per_mm: [f64; 3] [POLE] = [0.07, 0.07, 0.07];
        /// Placed poles: rates of y and z, and the heading in the plane, per mm.
        fibre_poles_per_mm: [f64; 2] [POLE] = [0.07, 0.07];
    }
    beside {
        /// Angles assumed at the start; the position is the first measured one.
        pub start: FixedAngles = FixedAngles::default(),
        /// Standard deviation of each coordinate of a measured position, mm.
        pub position_sd_mm: f64 = 0.577,
    }
}

impl CoupledConfig {
    /// Builds the observer.
    pub fn build(self, needle: Needle) -> Box<dyn Observer> {
        match self.gains {
            Gains::Placed => Box::new(Coupled::new(needle, self)),
            Gains::Fading => Box::new(CoupledBank::new(needle, self)),
        }
    }
}
