//! What an observer may take for a measurement.

use nalgebra::Vector3;

/// A measured tip position in mm, every coordinate finite.
///
/// Observers take nothing else, so a NaN or an infinite coordinate cannot reach one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipPosition(Vector3<f64>);

impl TipPosition {
    /// `position_mm` as a measurement; `None` when a coordinate is NaN or infinite.
    pub fn new(position_mm: Vector3<f64>) -> Option<Self> {
        position_mm.iter().all(|c| c.is_finite()).then_some(TipPosition(position_mm))
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
    fn takes_finite_positions_only() {
        assert!(TipPosition::new(Vector3::new(1.0, 2.0, 3.0)).is_some());
        assert!(TipPosition::new(Vector3::new(1.0, f64::NAN, 3.0)).is_none());
        assert!(TipPosition::new(Vector3::new(1.0, 2.0, f64::NEG_INFINITY)).is_none());
    }
}
