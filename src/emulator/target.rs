//! A target that moves, which the emulated tracker sees as a tool of its own.

use super::tracker::TrackerModel;
use nalgebra::Vector3;

/// The noise of the target is not that of the tip.
const TARGET_SEED: u64 = 0x7a96_e700_0000_0000;

/// The emulated target: tissue moves as the needle goes in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetModel {
    /// Where it is before the insertion, plane frame, mm.
    pub start_mm: Vector3<f64>,
    /// How far it moves with each millimetre that is inserted, mm.
    pub drift_mm_per_mm: Vector3<f64>,
}

impl TargetModel {
    /// Where it is at this depth, plane frame, mm.
    pub fn position_mm(&self, insertion_mm: f64) -> Vector3<f64> {
        self.start_mm + self.drift_mm_per_mm * insertion_mm.max(0.0)
    }

    /// How the tracker that sees the tip as `tip` sees the target: noise of its own.
    pub fn seen_by(tip: TrackerModel) -> TrackerModel {
        TrackerModel { seed: tip.seed ^ TARGET_SEED, ..tip }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_target_moves_with_the_needle() {
        let target = TargetModel {
            start_mm: Vector3::new(0.0, 5.0, 100.0),
            drift_mm_per_mm: Vector3::new(0.0, 0.03, 0.0),
        };
        assert_eq!(target.position_mm(-1.0), target.start_mm, "not before the insertion");
        assert!((target.position_mm(100.0) - Vector3::new(0.0, 8.0, 100.0)).norm() < 1e-12);
    }
}
