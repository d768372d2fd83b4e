//! A measured tip position, checked to be finite.

use super::kinematics::MAGNITUDE_MAX;
use nalgebra::Vector3;

/// A measured tip position in mm, every coordinate within ±1e6.
///
/// Observers take only this type, so no NaN and no overflow can reach them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipPosition(Vector3<f64>);

impl TipPosition {
    /// The largest magnitude of a coordinate, mm.
    pub const COORDINATE_MAX_MM: f64 = MAGNITUDE_MAX;

    /// `position_mm` as a measurement; `None` if a coordinate is NaN, infinite or over 1e6 in
    /// magnitude.
    pub fn new(position_mm: Vector3<f64>) -> Option<Self> {
        position_mm
            .iter()
            .all(|c| c.abs() <= Self::COORDINATE_MAX_MM)
            .then_some(TipPosition(position_mm))
    }

    /// The position, mm.
    pub fn mm(&self) -> Vector3<f64> {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_finite_positions_within_1e6_mm_are_taken() {
        let at = |x_mm| TipPosition::new(Vector3::new(x_mm, 2.0, 3.0));
        assert!(at(1.0).is_some() && at(-1e6).is_some());
        assert!(TipPosition::new(Vector3::new(1.0, f64::NAN, 3.0)).is_none());
        assert!(TipPosition::new(Vector3::new(1.0, 2.0, f64::NEG_INFINITY)).is_none());
        assert!(at(1_000_001.0).is_none() && at(-1e308).is_none());
    }
}
