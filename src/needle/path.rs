//! The path that the needle has cut, and withdrawal along it.

use crate::geometry::{Pose, Twist};

/// The least depth from one pose that is kept to the next, mm.
const SPACING_MM: f64 = 0.005;

/// The tip poses of an insertion by depth. A needle that is pulled back retraces them: it cuts no tissue
/// on the way out, so the kinematics are not integrated backwards (paper Section 2).
#[derive(Debug, Clone, Default)]
pub struct InsertedPath {
    points: Vec<(f64, Pose)>,
}

impl InsertedPath {
    /// Adds the tip pose at `depth_mm`. A depth that is not deeper than the last changes nothing, since
    /// that tissue is already cut.
    pub fn advance(&mut self, depth_mm: f64, tip: Pose) {
        if depth_mm.is_finite() && self.points.last().is_none_or(|&(last, _)| depth_mm > last) {
            // The deepest pose is kept, and few of a slow needle.
            if let [.., (before, _), (last, _)] = self.points[..]
                && last - before < SPACING_MM
            {
                self.points.pop();
            }
            self.points.push((depth_mm, tip));
        }
    }

    /// The deepest depth reached, mm.
    pub fn depth_mm(&self) -> Option<f64> {
        self.points.last().map(|&(depth, _)| depth)
    }

    /// The tip pose after a withdrawal to `depth_mm`: on the screw between the two recorded poses around
    /// that depth. `None` outside the recorded depths.
    pub fn at(&self, depth_mm: f64) -> Option<Pose> {
        let after = self.points.partition_point(|&(depth, _)| depth < depth_mm);
        let &(deep, far) = self.points.get(after)?;
        if deep == depth_mm {
            return Some(far);
        }
        let &(shallow, near) = self.points.get(after.checked_sub(1)?)?;
        let fraction = (depth_mm - shallow) / (deep - shallow);
        let screw = (near.inverse() * far).log();
        Some(near * Pose::exp(&Twist { v: screw.v * fraction, w: screw.w * fraction }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::needle::{Increment, Needle};
    use proptest::prelude::*;

    /// However slow it is: 0.1 mm in steps of a count of 0.0002 mm.
    #[test]
    fn a_slow_needle_leaves_few_poses() {
        let mut path = InsertedPath::default();
        let pose = |depth_mm: f64| {
            Pose::exp(&Twist {
                v: nalgebra::Vector3::new(0.0, 0.0, depth_mm),
                w: nalgebra::Vector3::zeros(),
            })
        };
        for count in 0..=500 {
            let depth_mm = f64::from(count) * 2e-4;
            path.advance(depth_mm, pose(depth_mm));
            assert_eq!(path.depth_mm(), Some(depth_mm), "the deepest is kept");
        }
        assert!((10..=30).contains(&path.points.len()), "{}", path.points.len());
        let between = path.at(0.0333).unwrap().translation.z;
        assert!((between - 0.0333).abs() < 1e-9, "{between}");
    }

    proptest! {
        /// Between the recorded depths the retraced pose is the one the needle cut there.
        #[test]
        fn withdrawal_retraces(rates in prop::collection::vec(-1.0..1.0f64, 1..40), f in 0.0..1.0f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let mut path = InsertedPath::default();
            let mut tip = Pose::identity();
            path.advance(0.0, tip);
            for (n, &w) in rates.iter().enumerate() {
                tip = needle.step(&tip, Increment::new(1.0, w).unwrap());
                path.advance(n as f64 + 1.0, tip);
            }
            let depth = f * rates.len() as f64;
            let mut expected = Pose::identity();
            for (n, &w) in rates.iter().enumerate() {
                let part = (depth - n as f64).clamp(0.0, 1.0);
                expected = needle.step(&expected, Increment::new(part, w * part).unwrap());
            }
            let at = path.at(depth).unwrap();
            prop_assert!((at.translation - expected.translation).norm() < 1e-10);
            prop_assert!((at.rotation.matrix() - expected.rotation.matrix()).norm() < 1e-10);
        }
    }

    #[test]
    fn outside_the_path_there_is_no_pose() {
        let mut path = InsertedPath::default();
        assert!(path.at(0.0).is_none());
        path.advance(1.0, Pose::identity());
        path.advance(f64::NAN, Pose::identity());
        path.advance(0.5, Pose::identity());
        assert_eq!(path.depth_mm(), Some(1.0));
        assert!(path.at(0.9).is_none() && path.at(1.1).is_none() && path.at(f64::NAN).is_none());
        assert_eq!(path.at(1.0), Some(Pose::identity()));
    }
}
