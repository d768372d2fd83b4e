//! Observers: the tip's full pose from its measured positions and the stage's measured inputs.
//!
//! An observer is carried on with measured increments ([`Observer::predict`]) and corrected at a
//! measurement ([`Observer::correct`]). Its state stands at the depth of the last call; a
//! measurement that is older than the stage is applied at its own depth, and the estimate is then
//! carried forward ([`Observer::estimate_after`]) without moving the state.
//! All poses are `X_PB`: tip B in plane frame P.

mod coupled;
mod estimate;
mod finite_difference;
mod handedness;
mod invariant;
mod whiteness;

pub use coupled::{Coupled, CoupledConfig, CoupledError};
pub use estimate::{Belief, Estimate, Shaft, Slack, standard_deviations};
pub use finite_difference::{BaselineError, FiniteDifference};
pub use handedness::{HandednessWatch, StreamContradiction};
pub use invariant::{Invariant, InvariantConfig, NoiseConfig};
pub use whiteness::Whiteness;

use crate::geometry::FixedAngles;
use crate::needle::{Increment, Needle, TipPosition, Torsion};
use nalgebra::Vector3;
use std::f64::consts::PI;
use thiserror::Error;

/// Why an estimate is not to be steered by any more.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum Divergence {
    /// Every hypothesis came to a state or a covariance that is none.
    #[error(
        "the estimate is no longer finite, or its covariance no longer positive, at {depth_mm:.1} mm"
    )]
    NotSound {
        /// Insertion since the first measurement, mm.
        depth_mm: f64,
    },
    /// The measurements contradict the model.
    #[error(
        "the last {samples} tip positions are {times:.1} times as far from their prediction as \
         observer.invariant.position_sd_mm explains (limit {limit:.1}); check the registration and \
         the needle that is configured"
    )]
    InnovationsOff {
        /// Measurements over which it was seen.
        samples: usize,
        /// Root mean square of the innovations over what their covariance explains.
        times: f64,
        /// The limit.
        limit: f64,
    },
}

/// Why an observer refused its configuration.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ObserverError {
    /// The coupled observer.
    #[error("coupled: {0}")]
    Coupled(#[from] CoupledError),
    /// The observer by finite differences.
    #[error("finite-difference: {0}")]
    FiniteDifference(#[from] BaselineError),
}

/// What every observer does.
pub trait Observer: Send {
    /// Carries the state on by one measured increment.
    fn predict(&mut self, increment: Increment);

    /// Corrects the state with a position measured at the state's depth, in the plane frame. It is
    /// worth as much as `independent` positions of independent noise: more than one for a mean.
    fn correct(&mut self, tip_meas: &TipPosition, independent: f64);

    /// The estimate as it would be after `increments`; `None` while the observer has none.
    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate>;

    /// Whether the estimate may be steered by.
    ///
    /// # Errors
    /// [`Divergence`] where it may not be: the run is to be stopped with that reason.
    fn check(&self) -> Result<(), Divergence> {
        Ok(())
    }

    /// The estimated position at the state's depth, plane frame, mm; `None` while the observer has
    /// none. It is that of [`Observer::estimate`], and costs less.
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
    FiniteDifference {
        /// Distance between the positions, mm.
        baseline_mm: f64,
    },
}

impl ObserverConfig {
    /// Builds the observer.
    ///
    /// # Errors
    /// [`ObserverError`] if the observer refuses its parameters.
    pub fn build(
        &self,
        needle: Needle,
        torsion: Torsion,
    ) -> Result<Box<dyn Observer>, ObserverError> {
        Ok(match *self {
            ObserverConfig::Invariant(config) => Box::new(Invariant::new(needle, torsion, config)),
            ObserverConfig::Coupled(config) => Box::new(Coupled::new(needle, config)?),
            ObserverConfig::FiniteDifference { baseline_mm } => {
                Box::new(FiniteDifference::new(needle, baseline_mm)?)
            }
        })
    }

    /// The same observer with the roll at the start unknown; `None` if the observer must know it.
    pub fn with_roll_unknown(&self) -> Option<Self> {
        match *self {
            ObserverConfig::Invariant(config) => {
                let start_sd = FixedAngles { roll: PI, ..config.start_sd };
                Some(ObserverConfig::Invariant(InvariantConfig { start_sd, ..config }))
            }
            ObserverConfig::Coupled(_) | ObserverConfig::FiniteDifference { .. } => None,
        }
    }

    /// The name used in configuration, records and figures.
    pub fn name(&self) -> &'static str {
        match self {
            ObserverConfig::Invariant(_) => "invariant",
            ObserverConfig::Coupled(_) => "coupled",
            ObserverConfig::FiniteDifference { .. } => "finite-difference",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An operator reads them at a glance, with the part that says them in front.
    #[test]
    fn a_divergence_is_said_within_200_characters() {
        for divergence in [
            Divergence::NotSound { depth_mm: 1000.0 },
            Divergence::InnovationsOff { samples: 20, times: 1234.5, limit: 100.0 },
        ] {
            let text = format!("observer: {divergence}");
            assert!(text.len() <= 200, "{} characters: {text}", text.len());
        }
    }
}
