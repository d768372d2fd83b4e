//! The reachable point nearest to a target that no path reaches.

use super::Tip;
use super::field::Field;
use super::lattice::{LEVELS, Lattice, Place, STRAIGHT};
use super::search::Problem;
use crate::math;
use nalgebra::Vector3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Nodes that are expanded at most.
const EXPANSIONS_MAX: usize = 20_000;
/// Nodes are ordered by how near they can come, plus this share of how far they are.
const DISTANCE_SHARE: f64 = 0.1;
/// Points that are nearer by less are not looked for, mm.
const GAIN_MIN_MM: f64 = 0.05;

struct Node {
    place: Place,
    /// The heading at the start of the arc that led here; none of a straight.
    before: Option<Vector3<f64>>,
    length_mm: f64,
}

/// How near an arc from `tip` can come to the target with nothing in the way, mm: the needle cannot turn
/// into the circle beside it.
fn miss_mm(tip: &Tip, problem: &Problem) -> f64 {
    let apart_mm = problem.target_mm - tip.position_mm;
    let ahead_mm = apart_mm.dot(&tip.heading);
    let aside_mm = (apart_mm - tip.heading * ahead_mm).norm();
    let radius_mm = problem.curvature_per_mm.recip();
    (radius_mm - math::hypot(radius_mm - aside_mm, ahead_mm)).max(0.0)
}

/// The point nearest to the target, mm: `nearest_mm`, or the end of an arc that a best-first search from
/// the start finds.
pub(super) fn nearest_of_all_mm(
    field: &mut Field<'_>,
    problem: &Problem,
    mut nearest_mm: Vector3<f64>,
) -> Vector3<f64> {
    let level = LEVELS.len() - 1;
    let workspace = &field.world.workspace;
    let mut lattice = Lattice::new(workspace, problem.curvature_per_mm, problem.in_plane, level);
    let start = Node { place: lattice.start(problem.start), before: None, length_mm: 0.0 };
    let distance_mm = |at: &Vector3<f64>| (at - problem.target_mm).norm();
    // In nm, so that the order is the same everywhere.
    let rank = |tip: &Tip| {
        let mm = miss_mm(tip, problem) + DISTANCE_SHARE * distance_mm(&tip.position_mm);
        Reverse((mm * 1e6) as u64)
    };
    let mut queue = BinaryHeap::from([(rank(&problem.start), 0)]);
    let mut nodes = vec![start];
    for _ in 0..EXPANSIONS_MAX {
        let Some((_, from)) = queue.pop() else { break };
        let Node { place, before, length_mm } = nodes[from];
        let length_mm = length_mm + lattice.resolution.step_mm;
        let to_beat_mm = distance_mm(&nearest_mm) - GAIN_MIN_MM;
        let is_hopeless =
            length_mm > problem.length_max_mm || miss_mm(&place.tip, problem) > to_beat_mm;
        // A cell is taken by the best that comes to it.
        if is_hopeless || !lattice.visit(&place) {
            continue;
        }
        for by in 0..lattice.arcs() {
            let next = lattice.next(&place, before, by);
            let arc = lattice.arc(&place.tip, before, by);
            if !field.is_clear(&place.tip, &arc) {
                continue;
            }
            if distance_mm(&next.tip.position_mm) < distance_mm(&nearest_mm) {
                nearest_mm = next.tip.position_mm;
            }
            queue.push((rank(&next.tip), nodes.len()));
            let before = (by != STRAIGHT).then_some(place.tip.heading);
            nodes.push(Node { place: next, before, length_mm });
        }
    }
    nearest_mm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Workspace, World, plan};

    fn distance_mm(target_mm: [f64; 3], in_plane: bool) -> f64 {
        let [min_mm, max_mm] = [[-50.0, -75.0, 0.0], [50.0, 75.0, 150.0]].map(Vector3::from);
        let world = World { obstacles: vec![], workspace: Workspace { min_mm, max_mm } };
        let problem = Problem {
            start: Tip { position_mm: Vector3::zeros(), heading: Vector3::z() },
            target_mm: target_mm.into(),
            tolerance_mm: 1.0,
            curvature_per_mm: 1.0 / 122.0,
            clearance_mm: 2.0,
            length_max_mm: 300.0,
            in_plane,
            expansions_max: 100_000,
        };
        let answer = plan(&world, &problem);
        (answer.nearest_mm.expect("the start is allowed") - problem.target_mm).norm()
    }

    /// The target is 42.4 mm inside the circle that the needle cannot turn into.
    #[test]
    fn the_nearest_point_is_on_the_sharpest_arc() {
        for (in_plane, most_mm) in [(true, 42.7), (false, 43.5)] {
            let found_mm = distance_mm([0.0, 60.0, 50.0], in_plane);
            assert!((42.3..most_mm).contains(&found_mm), "{in_plane}: {found_mm}");
        }
    }
}
