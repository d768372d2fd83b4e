//! Observers: the tip's full pose from its measured positions and the stage's measured inputs.
//!
//! Measured increments advance an observer ([`Observer::predict`]) and measured positions correct
//! it ([`Observer::correct`]). Its state belongs to the depth of the last call. A tip position is
//! older than the newest position of the stage, so it corrects the state at the depth where it was
//! measured. [`Observer::estimate_after`] then predicts the estimate at the present depth, without
//! changing the state.
//!
//! All poses are `X_PB`: tip B in plane frame P.

mod coupled;
mod estimate;
mod finite_difference;
mod handedness;
mod invariant;
mod mixture;
mod start;
mod whiteness;

pub use coupled::{Coupled, CoupledConfig, Gains};
pub use estimate::{Belief, Estimate, Shaft, Slack, standard_deviations};
pub use finite_difference::{FiniteDifference, FiniteDifferenceConfig};
pub use handedness::{HandednessWatch, ROLL_JUDGED_SD_MAX_RAD};
pub use invariant::{Invariant, InvariantConfig, NoiseConfig};
pub use whiteness::{PositionNoise, Whiteness};

use crate::geometry::FixedAngles;
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use nalgebra::Vector3;
use std::f64::consts::PI;

/// An observer of the tip's pose. It has no estimate before the first [`correct`](Self::correct), since it takes
/// its start position from there; some need more positions.
pub trait Observer: Send {
    /// Advances the state by one measured increment.
    fn predict(&mut self, increment: Increment);

    /// Corrects the state with a position measured at the state's depth, in the plane frame. It carries as much
    /// information as `independent` positions with independent noise: more than 1 for a mean, less than 1 if
    /// its noise is correlated with that of others.
    fn correct(&mut self, tip_meas: &TipPosition, independent: f64);

    /// The estimate as it would be after `increments`; `None` while the observer has none.
    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate>;

    /// Whether the estimate may be used for steering.
    ///
    /// # Errors
    /// Why not: the run must stop with that reason.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }

    /// What the operator should know of the last corrections, once; `None` for nothing.
    fn take_warning(&mut self) -> Option<String> {
        None
    }

    /// The estimated position at the state's depth, plane frame, mm; `None` while the observer has
    /// none. It equals the position of [`Observer::estimate`] and costs less.
    fn position_mm(&self) -> Option<Vector3<f64>> {
        self.estimate().map(|estimate| estimate.x_pb.translation)
    }

    /// The estimate at the state's depth; `None` while the observer has none.
    fn estimate(&self) -> Option<Estimate> {
        self.estimate_after(&[])
    }
}

/// The registry of observers: each kind with its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ObserverConfig {
    /// The bank of invariant Kalman filters.
    Invariant(InvariantConfig),
    /// The paper's coupled observer.
    Coupled(CoupledConfig),
    /// The paper's finite differences.
    FiniteDifference(FiniteDifferenceConfig),
}

impl ObserverConfig {
    /// Builds the observer.
    pub fn build(&self, needle: Needle, torsion: Torsion) -> Box<dyn Observer> {
        match *self {
            ObserverConfig::Invariant(config) => Box::new(Invariant::new(needle, torsion, config)),
            ObserverConfig::Coupled(config) => config.build(needle),
            ObserverConfig::FiniteDifference(config) => {
                Box::new(FiniteDifference::new(needle, config.baseline_mm))
            }
        }
    }

    /// The same observer with the roll at the start unknown; `None` if the observer must know it.
    pub fn with_roll_unknown(&self) -> Option<Self> {
        match *self {
            ObserverConfig::Invariant(config) => {
                let start_sd = FixedAngles { roll: PI, ..config.start_sd };
                Some(ObserverConfig::Invariant(InvariantConfig { start_sd, ..config }))
            }
            ObserverConfig::Coupled(config) if config.gains == Gains::Fading => {
                let start_sd = FixedAngles { roll: PI, ..config.start_sd };
                Some(ObserverConfig::Coupled(CoupledConfig { start_sd, ..config }))
            }
            ObserverConfig::Coupled(_) | ObserverConfig::FiniteDifference(_) => None,
        }
    }

    /// The standard deviation that the observer assumes for each coordinate of a position, mm; `None` if
    /// it does not weigh positions.
    pub fn position_sd_mm(&self) -> Option<f64> {
        match self {
            ObserverConfig::Invariant(config) => Some(config.position_sd_mm),
            ObserverConfig::Coupled(config) => Some(config.position_sd_mm),
            ObserverConfig::FiniteDifference(_) => None,
        }
    }

    /// Standard deviations that the observer assumes at the start: of the angles, rad, and of the
    /// curvature, as a share of it. `None` for an observer that does not state how well it knows the tip.
    pub fn start_sd(&self) -> Option<(FixedAngles, f64)> {
        match self {
            ObserverConfig::Invariant(config) => Some((config.start_sd, config.curvature_sd)),
            ObserverConfig::Coupled(config) if config.gains == Gains::Fading => {
                Some((config.start_sd, 0.0))
            }
            ObserverConfig::Coupled(_) | ObserverConfig::FiniteDifference(_) => None,
        }
    }

    /// The name used in configuration, records and figures.
    pub fn name(&self) -> &'static str {
        match self {
            ObserverConfig::Invariant(_) => "invariant",
            ObserverConfig::Coupled(_) => "coupled",
            ObserverConfig::FiniteDifference(_) => "finite-difference",
        }
    }
}
