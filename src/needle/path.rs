//! The path that the needle has cut, and withdrawal along it.

use crate::geometry::{Pose, Twist};
use nalgebra::Vector3;

/// Minimum distance between two poses that are kept, mm.
const SPACING_MM: f64 = 0.005;

/// The tip as it was when it cut one place of the path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cut {
    /// Pose of the tip.
    pub tip: Pose,
    /// Sum of the tip's rotations about its own axis up to here, rad.
    pub roll_rad: f64,
}

impl Cut {
    /// The pose of a tip that is back at this place after it has rolled to `roll_rad`: the channel constrains
    /// position and heading, but not the roll.
    pub fn tip_rolled_to(&self, roll_rad: f64) -> Pose {
        let w = Vector3::new(0.0, 0.0, roll_rad - self.roll_rad);
        self.tip * Pose::exp(&Twist { v: Vector3::zeros(), w })
    }
}

/// The channel that an insertion has cut, by depth. A needle that is pulled back retraces it: it cuts no
/// tissue on the way out, so the kinematics are not integrated backwards (paper Section 2).
#[derive(Debug, Clone, Default)]
pub struct InsertedPath {
    points: Vec<(f64, Cut)>,
}

impl InsertedPath {
    /// Adds the tip at `depth_mm`. A depth that is not deeper than the last changes nothing, since that
    /// tissue is already cut.
    pub fn advance(&mut self, depth_mm: f64, cut: Cut) {
        if depth_mm.is_finite() && self.points.last().is_none_or(|&(last, _)| depth_mm > last) {
            // A slow needle has very dense poses. The deepest is kept, but few of the others.
            if let [.., (before, _), (last, _)] = self.points[..]
                && last - before < SPACING_MM
            {
                self.points.pop();
            }
            self.points.push((depth_mm, cut));
        }
    }

    /// The deepest depth reached, mm.
    pub fn depth_mm(&self) -> Option<f64> {
        self.points.last().map(|&(depth, _)| depth)
    }

    /// The tip as it was at `depth_mm`, interpolated on the screw motion between the two recorded poses around
    /// that depth. `None` outside the recorded depths.
    pub fn at(&self, depth_mm: f64) -> Option<Cut> {
        let after = self.points.partition_point(|&(depth, _)| depth < depth_mm);
        let &(deep, far) = self.points.get(after)?;
        if deep == depth_mm {
            return Some(far);
        }
        let &(shallow, near) = self.points.get(after.checked_sub(1)?)?;
        let fraction = (depth_mm - shallow) / (deep - shallow);
        let screw = (near.tip.inverse() * far.tip).log();
        Some(Cut {
            tip: near.tip * Pose::exp(&Twist { v: screw.v * fraction, w: screw.w * fraction }),
            roll_rad: near.roll_rad + (far.roll_rad - near.roll_rad) * fraction,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::needle::{Increment, Needle};
    use proptest::prelude::*;

    fn start() -> Cut {
        Cut { tip: Pose::identity(), roll_rad: 0.0 }
    }

    /// 0.1 mm in steps of one count, 0.0002 mm.
    #[test]
    fn a_slow_needle_leaves_few_poses() {
        let mut path = InsertedPath::default();
        let cut = |depth_mm: f64| {
            let v = Vector3::new(0.0, 0.0, depth_mm);
            Cut { tip: Pose::exp(&Twist { v, w: Vector3::zeros() }), roll_rad: 0.0 }
        };
        for count in 0..=500 {
            let depth_mm = f64::from(count) * 2e-4;
            path.advance(depth_mm, cut(depth_mm));
            assert_eq!(path.depth_mm(), Some(depth_mm), "the deepest is kept");
        }
        assert!((10..=30).contains(&path.points.len()), "{}", path.points.len());
        let between = path.at(0.0333).unwrap().tip.translation.z;
        assert!((between - 0.0333).abs() < 1e-9, "{between}");
    }

    proptest! {
        /// Between two recorded depths the pose is the one that the needle had there.
        #[test]
        fn withdrawal_retraces_the_inserted_path(rates in prop::collection::vec(-1.0..1.0f64, 1..40), f in 0.0..1.0f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let mut path = InsertedPath::default();
            let mut cut = start();
            path.advance(0.0, cut);
            for (n, &w) in rates.iter().enumerate() {
                let tip = needle.step(&cut.tip, Increment::new(1.0, w).unwrap());
                cut = Cut { tip, roll_rad: cut.roll_rad + w };
                path.advance(n as f64 + 1.0, cut);
            }
            let depth = f * rates.len() as f64;
            let mut expected = start();
            for (n, &w) in rates.iter().enumerate() {
                let part = (depth - n as f64).clamp(0.0, 1.0);
                expected.tip = needle.step(&expected.tip, Increment::new(part, w * part).unwrap());
                expected.roll_rad += w * part;
            }
            let at = path.at(depth).unwrap();
            let (tip, expected_tip) = (at.tip, expected.tip);
            prop_assert!((tip.translation - expected_tip.translation).norm() < 1e-10);
            prop_assert!((tip.rotation.matrix() - expected_tip.rotation.matrix()).norm() < 1e-10);
            prop_assert!((at.roll_rad - expected.roll_rad).abs() < 1e-10);
        }
    }

    #[test]
    fn outside_the_path_there_is_no_pose() {
        let mut path = InsertedPath::default();
        assert!(path.at(0.0).is_none());
        path.advance(1.0, start());
        path.advance(f64::NAN, start());
        path.advance(0.5, start());
        assert_eq!(path.depth_mm(), Some(1.0));
        assert!(path.at(0.9).is_none() && path.at(1.1).is_none() && path.at(f64::NAN).is_none());
        assert_eq!(path.at(1.0), Some(start()));
    }
}
