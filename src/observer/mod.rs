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

pub use coupled::{Coupled, CoupledConfig, CoupledError};
pub use estimate::Estimate;
pub use finite_difference::FiniteDifference;

use crate::needle::{Increment, TipPosition};
use nalgebra::Matrix3;

/// What every observer does.
pub trait Observer: Send {
    /// Carries the state on by one measured increment.
    fn predict(&mut self, increment: Increment);

    /// Corrects the state with a position measured at the state's depth, in the plane frame.
    fn correct(&mut self, tip_meas: &TipPosition);

    /// The estimate as it would be after `increments`; `None` while the observer has none.
    fn estimate_after(&self, increments: &[Increment]) -> Option<Estimate>;

    /// The estimate at the state's depth; `None` while the observer has none.
    fn estimate(&self) -> Option<Estimate> {
        self.estimate_after(&[])
    }

    /// Covariance of the estimated position at the state's depth, plane frame, mm²; `None` for an
    /// observer that carries none.
    fn position_covariance_mm2(&self) -> Option<Matrix3<f64>> {
        None
    }
}
