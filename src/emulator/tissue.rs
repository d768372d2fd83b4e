//! The emulated needle in its tissue.

use crate::geometry::{Pose, Twist};
use crate::needle::{Increment, InsertedPath, Needle};
use nalgebra::Vector3;

/// A needle that cuts tissue: driven by the true position of the stage, it knows its true tip.
#[derive(Debug, Clone)]
pub(crate) struct Tissue {
    needle: Needle,
    path: InsertedPath,
    /// True depth of the base, mm, and its rotation, rad, at the last advance.
    insertion_true_mm: f64,
    rotation_true_rad: f64,
    /// Tip `X_PB`: of the cut path at its deepest, or of the withdrawn needle.
    tip_true: Pose,
}

impl Tissue {
    /// A needle whose tip is at `start` (`X_PB`) when the stage is at (0, 0).
    pub(crate) fn new(needle: Needle, start: Pose) -> Self {
        let mut path = InsertedPath::default();
        path.advance(0.0, start);
        Tissue { needle, path, insertion_true_mm: 0.0, rotation_true_rad: 0.0, tip_true: start }
    }

    /// Moves the base to the true stage position given; both axes moved in proportion on the way.
    ///
    /// Deeper than ever before it cuts (paper Eq. 1); in the channel it has cut it slides along
    /// it, and turning there turns the bevel on the spot.
    pub(crate) fn advance(&mut self, insertion_true_mm: f64, rotation_true_rad: f64) {
        let turn_rad = rotation_true_rad - self.rotation_true_rad;
        let cut_mm = self.path.depth_mm().unwrap_or(0.0);
        let (from_mm, to_mm) = (self.insertion_true_mm, insertion_true_mm);
        let new_mm = (to_mm - from_mm.max(cut_mm)).max(0.0);
        if new_mm > 0.0 {
            if let Ok(increment) = Increment::new(new_mm, turn_rad) {
                self.tip_true = self.needle.step(&self.tip_true, increment);
                self.path.advance(to_mm, self.tip_true);
            }
        } else {
            let turned = Twist { v: Vector3::zeros(), w: Vector3::new(0.0, 0.0, turn_rad) };
            if to_mm == from_mm {
                self.tip_true = self.tip_true * Pose::exp(&turned);
            } else if let Some(tip) = self.path.at(to_mm) {
                self.tip_true = tip;
            }
        }
        self.insertion_true_mm = to_mm;
        self.rotation_true_rad = rotation_true_rad;
    }

    /// The true tip pose `X_PB`.
    pub(crate) fn tip_true(&self) -> &Pose {
        &self.tip_true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;

    fn tissue() -> Tissue {
        Tissue::new(Needle::new(1.0 / 122.0).unwrap(), Pose::identity())
    }

    #[test]
    fn cuts_by_the_kinematics_and_retraces_on_the_way_out() {
        let mut tissue = tissue();
        let mut path = Vec::new();
        for n in 1..=50 {
            tissue.advance(f64::from(n), 0.05 * f64::from(n));
            path.push(*tissue.tip_true());
        }
        let needle = Needle::new(1.0 / 122.0).unwrap();
        let mut expected = Pose::identity();
        for _ in 0..50 {
            expected = needle.step(&expected, Increment::new(1.0, 0.05).unwrap());
        }
        assert!((tissue.tip_true().translation - expected.translation).norm() < 1e-9);
        tissue.advance(20.0, 2.5);
        assert!((tissue.tip_true().translation - path[19].translation).norm() < 1e-9);
    }

    #[test]
    fn turning_on_the_spot_turns_the_bevel_alone() {
        let mut tissue = tissue();
        tissue.advance(10.0, 0.0);
        let before = *tissue.tip_true();
        tissue.advance(10.0, 0.7);
        let turned =
            FixedAngles::from_rotation(&(before.rotation.inverse() * tissue.tip_true().rotation));
        assert_eq!(tissue.tip_true().translation, before.translation);
        assert!((turned.roll - 0.7).abs() < 1e-12);
    }

    #[test]
    fn a_needle_pulled_back_and_pushed_again_cuts_on_from_its_deepest() {
        let mut tissue = tissue();
        tissue.advance(10.0, 0.0);
        let deepest = *tissue.tip_true();
        tissue.advance(5.0, 0.0);
        tissue.advance(10.0, 0.0);
        assert!((tissue.tip_true().translation - deepest.translation).norm() < 1e-9);
        tissue.advance(12.0, 0.0);
        let on =
            Needle::new(1.0 / 122.0).unwrap().step(&deepest, Increment::new(2.0, 0.0).unwrap());
        assert!((tissue.tip_true().translation - on.translation).norm() < 1e-9);
    }
}
