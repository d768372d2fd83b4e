//! The points that the tip can still reach, to show them to the operator.

use super::arc::{Arc, Tip};
use super::field::Field;
use super::obstacle::World;
use super::problem::Problem;
use nalgebra::Vector3;
use std::borrow::Cow;

/// Points within this distance of the target are judged, mm.
const AROUND_MM: f64 = 30.0;
/// Distance between two of them in the plane and in space, mm.
const SPACING_MM: [f64; 2] = [1.0, 3.0];

/// Whether one arc of the needle leads from the tip to a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// An arc leads there, keeps the clearance, and stays in the workspace.
    Clear,
    /// The arc comes nearer to an obstacle than the clearance, or leaves the workspace.
    Obstructed,
    /// The needle does not bend enough or is not long enough, or the point is behind it.
    OutOfReach,
}

/// Points around the target, across the heading of `tip`: on a line in the plane, on a disc in space.
pub fn reach_around(world: &World, problem: &Problem, tip: &Tip) -> Vec<(Vector3<f64>, Reach)> {
    let Problem { target_mm, in_plane, .. } = problem;
    let spacing_mm = SPACING_MM[usize::from(!in_plane)];
    let count = (AROUND_MM / spacing_mm) as i32;
    let rows = if *in_plane { 0 } else { count };
    let [first, second] = match in_plane {
        true => [Vector3::new(0.0, tip.heading.z, -tip.heading.y), Vector3::x()],
        false => tip.across(),
    };
    let around = (-rows..=rows).flat_map(|j| (-count..=count).map(move |i| (i, j)));
    let points = around
        .filter(|(i, j)| i * i + j * j <= count * count)
        .map(|(i, j)| target_mm + (first * f64::from(i) + second * f64::from(j)) * spacing_mm);
    // A field in space, because the estimated tip may be off the plane.
    let mut field = Field::new(Cow::Borrowed(world), problem.clearance_mm, false);
    let mut reach = |point_mm: &Vector3<f64>| {
        let arc = tip.arc_to(point_mm);
        let can_reach = |arc: &Arc| {
            // Like a path, the arc may end within the tolerance.
            arc.curvature_per_mm <= problem.curvature_per_mm
                && arc.length_mm <= problem.length_max_mm + problem.tolerance_mm
        };
        match arc.filter(can_reach) {
            None => Reach::OutOfReach,
            Some(arc) if field.is_clear(tip, &arc) => Reach::Clear,
            Some(_) => Reach::Obstructed,
        }
    };
    points.map(|point_mm| (point_mm, reach(&point_mm))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Obstacle;
    use crate::plan::search::tests::{problem, world};

    /// A ball is on one side of the straight path.
    #[test]
    fn points_are_clear_obstructed_or_out_of_reach() {
        let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 8.0, 50.0), radius_mm: 5.0 };
        for in_plane in [true, false] {
            let problem =
                Problem { curvature_per_mm: 1.0 / 250.0, ..problem([0.0, 0.0, 90.0], in_plane) };
            let points = reach_around(&world(vec![ball.clone()]), &problem, &problem.start);
            let at = |y: f64| {
                let is_there =
                    |(p, _): &&(Vector3<f64>, Reach)| (p - Vector3::new(0.0, y, 90.0)).norm() < 1.0;
                points.iter().find(is_there).expect("a point").1
            };
            assert_eq!([at(0.0), at(-12.0)], [Reach::Clear; 2], "{in_plane}");
            assert_eq!([at(15.0), at(27.0)], [Reach::Obstructed, Reach::OutOfReach], "{in_plane}");
        }
    }

    /// One point is 90 mm straight ahead; the arc to another, 30 mm beside it, is 96 mm long.
    #[test]
    fn a_point_beyond_the_length_that_is_left_is_out_of_reach() {
        let problem = problem([0.0, 0.0, 90.0], true);
        let reach = |length_max_mm: f64| {
            let problem = Problem { length_max_mm, ..problem.clone() };
            let points = reach_around(&world(vec![]), &problem, &problem.start);
            [30, 0].map(|i| points[i].1)
        };
        assert_eq!(reach(97.0), [Reach::Clear, Reach::Clear]);
        assert_eq!(reach(89.5), [Reach::Clear, Reach::OutOfReach]);
        assert_eq!(reach(80.0), [Reach::OutOfReach; 2]);
    }

    /// The arc swings 6.8 mm aside. A wall is 5 mm beside its ends.
    #[test]
    fn an_arc_that_leaves_the_workspace_on_its_way_is_obstructed() {
        let problem = problem([0.0, 70.0, 90.0], true);
        let reach = |y_mm: f64| {
            let position_mm = Vector3::new(0.0, y_mm, 0.0);
            let tip = Tip { position_mm, heading: Vector3::new(0.0, 0.3f64.sin(), 0.3f64.cos()) };
            let problem = Problem { target_mm: Vector3::new(0.0, y_mm, 90.0), ..problem.clone() };
            let points = reach_around(&world(vec![]), &problem, &tip);
            let is_target = |(at, _): &&(Vector3<f64>, Reach)| *at == problem.target_mm;
            points.iter().find(is_target).expect("the target").1
        };
        assert_eq!([reach(70.0), reach(60.0)], [Reach::Obstructed, Reach::Clear]);
    }
}
