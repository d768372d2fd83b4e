//! The planning problem.

use super::arc::Tip;
use crate::math;
use nalgebra::Vector3;

/// A planning problem, in the plane frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Where the path starts.
    pub start: Tip,
    /// Where the path should end.
    pub target_mm: Vector3<f64>,
    /// How far from the target the path may end, mm.
    pub tolerance_mm: f64,
    /// The largest curvature, over 0, per mm.
    pub curvature_per_mm: f64,
    /// How near the path may come to an obstacle, mm.
    pub clearance_mm: f64,
    /// The longest path, mm.
    pub length_max_mm: f64,
    /// The path stays in the plane x = 0, where start and target are.
    pub in_plane: bool,
    /// How many nodes may be expanded.
    pub expansions_max: u32,
}

impl Problem {
    /// Distance of a point from the target, mm.
    pub(super) fn to_target_mm(&self, from_mm: &Vector3<f64>) -> f64 {
        (from_mm - self.target_mm).norm()
    }

    /// The corners of a box that no path leaves, plane frame, mm.
    pub(super) fn reach_mm(&self) -> [Vector3<f64>; 2] {
        let Problem { start, curvature_per_mm, length_max_mm, .. } = self;
        // The path that gets farthest along an axis first turns toward that axis, then goes straight.
        let farthest_mm = |along: f64| {
            let away_rad = math::acos(along.clamp(-1.0, 1.0));
            let turn_rad = away_rad.min(curvature_per_mm * length_max_mm);
            let bent_mm = (math::sin(away_rad) - math::sin(away_rad - turn_rad)) / curvature_per_mm;
            let straight_mm = length_max_mm - turn_rad / curvature_per_mm;
            (bent_mm + straight_mm).max(0.0)
        };
        let [down, up] =
            [-1.0, 1.0].map(|sign| start.heading.map(|along| farthest_mm(sign * along)));
        [start.position_mm - down, start.position_mm + up]
    }
}

#[cfg(test)]
mod tests {
    use crate::plan::arc::Arc;
    use crate::plan::search::tests::problem;
    use crate::plan::{Problem, Tip};
    use nalgebra::{Rotation3, Vector3};
    use proptest::prelude::*;

    proptest! {
        /// No two arcs of the full curvature lead out of the box.
        #[test]
        fn no_path_leaves_the_box(
            turn in prop::array::uniform3(-3.0..3.0f64), first_mm in 0.0..150.0f64, bends in prop::array::uniform2(-3.2..3.2f64),
        ) {
            let heading = Rotation3::new(turn.into()) * Vector3::z();
            let start = Tip { position_mm: Vector3::new(1.0, 2.0, 3.0), heading };
            let problem = Problem { start, length_max_mm: 150.0, ..problem([0.0, 0.0, 100.0], false) };
            let [low_mm, high_mm] = problem.reach_mm();
            let mut tip = start;
            for (length_mm, bend) in [first_mm, 150.0 - first_mm].into_iter().zip(bends) {
                let [across, up] = tip.across();
                let bend = across * bend.cos() + up * bend.sin();
                tip = tip.after(&Arc { bend, curvature_per_mm: problem.curvature_per_mm, length_mm });
                for axis in 0..3 {
                    let at_mm = tip.position_mm[axis];
                    prop_assert!(low_mm[axis] - 1e-9 <= at_mm && at_mm <= high_mm[axis] + 1e-9, "{axis}: {at_mm}");
                }
            }
        }
    }

    #[test]
    fn the_box_of_a_needle_that_goes_ahead() {
        let problem = Problem { length_max_mm: 100.0, ..problem([0.0, 0.0, 100.0], false) };
        let radius_mm = 1.0 / problem.curvature_per_mm;
        let aside_mm = radius_mm * (1.0 - (100.0 / radius_mm).cos());
        let [low_mm, high_mm] = problem.reach_mm();
        let expected = problem.start.position_mm + Vector3::new(aside_mm, aside_mm, 100.0);
        assert!((high_mm - expected).norm() < 1e-9, "{high_mm}");
        assert_eq!(low_mm.z, problem.start.position_mm.z);
    }
}
