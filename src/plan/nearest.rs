//! The reachable point nearest to a target that no path reaches.

use super::arc::{Arc, Seen, Tip};
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
    let Seen { off_axis_mm, ahead_mm, .. } = tip.sees(&problem.target_mm);
    let radius_mm = problem.curvature_per_mm.recip();
    (radius_mm - math::hypot(radius_mm - off_axis_mm, ahead_mm)).max(0.0)
}

/// The sharpest arc from `tip` toward the target, at most `length_max_mm` long, up to where it is nearest
/// to the target.
pub(super) fn sharpest_arc(tip: &Tip, problem: &Problem, length_max_mm: f64) -> Arc {
    let Seen { off_axis_mm, ahead_mm, bend } = tip.sees(&problem.target_mm);
    let curvature_per_mm = problem.curvature_per_mm;
    let radius_mm = curvature_per_mm.recip();
    let turn_rad = math::atan2(ahead_mm, radius_mm - off_axis_mm).max(0.0);
    Arc { bend, curvature_per_mm, length_mm: (turn_rad * radius_mm).min(length_max_mm) }
}

/// The point nearest to the target, mm: `nearest_mm`, or the end of an arc that a best-first search from
/// the start finds. From each node the sharpest arc toward the target is tried.
pub(super) fn nearest_of_all_mm(
    field: &mut Field<'_>,
    problem: &Problem,
    mut nearest_mm: Vector3<f64>,
) -> Vector3<f64> {
    let level = LEVELS.len() - 1;
    let visited = std::mem::take(&mut field.visited);
    let Problem { curvature_per_mm, in_plane, .. } = *problem;
    let workspace = &field.world.workspace;
    let mut lattice = Lattice::new(workspace, curvature_per_mm, in_plane, level, visited);
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
        if is_hopeless || !lattice.visited.add(lattice.cell(&place)) {
            continue;
        }
        let sharpest = sharpest_arc(&place.tip, problem, problem.length_max_mm - length_mm);
        let end_mm = place.tip.after(&sharpest).position_mm;
        if distance_mm(&end_mm) < distance_mm(&nearest_mm) && field.is_clear(&place.tip, &sharpest)
        {
            nearest_mm = end_mm;
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
    use crate::plan::plan;
    use crate::plan::search::tests::{problem, world};

    /// The target is 42.35 mm inside the circle that the needle cannot turn into, whichever way it bends.
    #[test]
    fn the_nearest_point_is_on_the_sharpest_arc() {
        for (target_mm, in_plane) in
            [([0.0, 60.0, 50.0], true), ([0.0, 60.0, 50.0], false), ([36.0, 48.0, 50.0], false)]
        {
            let problem = problem(target_mm, in_plane);
            let nearest_mm =
                plan(&world(vec![]), &problem).nearest_mm.expect("the start is allowed");
            let found_mm = (nearest_mm - problem.target_mm).norm();
            assert!((42.3..42.5).contains(&found_mm), "{target_mm:?}, {in_plane}: {found_mm}");
        }
    }
}
