//! Finds the reachable point nearest to a target if no path reaches the target.

use super::arc::{Arc, RelativePoint, Tip};
use super::field::Field;
use super::lattice::{LEVELS, Lattice, Place, STRAIGHT};
use super::path::Path;
use super::problem::Problem;
use crate::math;
use nalgebra::Vector3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::f64::consts::TAU;

/// At most this many nodes are expanded, and no more than the problem allows.
const EXPANSIONS_MAX: u32 = 20_000;
/// Nodes are ordered by how near to the target they can come, plus this share of their distance from it.
const DISTANCE_SHARE: f64 = 0.1;
/// A smaller gain in distance does not count, mm.
const GAIN_MIN_MM: f64 = 0.05;
/// Maximum number of changes of a path.
const CHANGES_MAX: u32 = 10;
/// All changes together may try this many arcs for each node that the problem allows to expand; in space a search tries
/// about as many arcs per node.
const TRIES_PER_NODE: u32 = 10;
/// Distance between the points at which an arc may leave a path or end, mm.
const LEAVE_MM: f64 = 2.0;
/// Maximum length of such an arc, mm.
const ARC_MAX_MM: f64 = 40.0;
/// Number of directions in which it may bend in space.
const BENDS: u32 = 8;

#[derive(Clone, Copy)]
struct Node {
    place: Place,
    /// The heading at the start of the arc that led here; `None` after a straight.
    previous_heading: Option<Vector3<f64>>,
    length_mm: f64,
    /// The node before, and the arc from it; `None` at the start.
    from: Option<(usize, Arc)>,
}

/// How near an arc from `tip` can come to the target, without obstacles, mm: 0 outside the turning circle, which the
/// needle cannot enter.
fn miss_mm(tip: &Tip, problem: &Problem) -> f64 {
    let RelativePoint { off_axis_mm, ahead_mm, .. } = tip.relative(&problem.target_mm);
    let radius_mm = problem.curvature_per_mm.recip();
    (radius_mm - math::hypot(radius_mm - off_axis_mm, ahead_mm)).max(0.0)
}

/// The sharpest arc from `tip` toward the target, at most `length_max_mm` long, up to where it is nearest
/// to the target.
pub(super) fn sharpest_arc(tip: &Tip, problem: &Problem, length_max_mm: f64) -> Arc {
    let RelativePoint { off_axis_mm, ahead_mm, bend } = tip.relative(&problem.target_mm);
    let curvature_per_mm = problem.curvature_per_mm;
    let radius_mm = curvature_per_mm.recip();
    let turn_rad = math::atan2(ahead_mm, radius_mm - off_axis_mm).max(0.0);
    Arc { bend, curvature_per_mm, length_mm: (turn_rad * radius_mm).min(length_max_mm) }
}

/// The path that ends nearest to the target, as found by a best-first search from the start and then by changes
/// of that path.
pub(super) fn path_to_nearest(field: &mut Field<'_>, problem: &Problem) -> Path {
    let level = LEVELS.len() - 1;
    let visited = std::mem::take(&mut field.visited);
    let length_max_mm = problem.length_max_mm;
    let mut lattice = Lattice::new(&field.world.workspace, problem, level, visited);
    let step_mm = lattice.resolution.step_mm;
    let place = lattice.start(problem.start);
    let mut nodes = vec![Node { place, previous_heading: None, length_mm: 0.0, from: None }];
    let distance_mm = |tip: &Tip| problem.to_target_mm(&tip.position_mm);
    // Whole nanometres, so that the order is the same on every machine.
    let rank = |tip: &Tip| {
        let mm = miss_mm(tip, problem) + DISTANCE_SHARE * distance_mm(tip);
        Reverse((mm * 1e6) as u64)
    };
    let mut queue = BinaryHeap::from([(rank(&problem.start), 0)]);
    let mut best = (distance_mm(&problem.start), 0, None);
    for _ in 0..EXPANSIONS_MAX.min(problem.expansions_max) {
        let Some((_, from)) = queue.pop() else { break };
        let Node { place, previous_heading, length_mm, .. } = nodes[from];
        let is_hopeless = miss_mm(&place.tip, problem) > best.0 - GAIN_MIN_MM;
        // The first node that comes to a cell is the best one; later ones are dropped.
        if is_hopeless || !lattice.visited.insert(lattice.cell(&place)) {
            continue;
        }
        let left_mm = length_max_mm - length_mm;
        let sharpest = field.clear_part(&place.tip, sharpest_arc(&place.tip, problem, left_mm));
        let end_mm = distance_mm(&place.tip.after(&sharpest));
        if end_mm < best.0 {
            best = (end_mm, from, Some(sharpest));
        }
        for arc_number in (0..lattice.arcs()).filter(|_| step_mm <= left_mm) {
            let next = lattice.next(&place, previous_heading, arc_number);
            let arc = lattice.arc(&place.tip, previous_heading, arc_number);
            if !field.is_clear(&place.tip, &arc) {
                continue;
            }
            let to = nodes.len();
            if distance_mm(&next.tip) < best.0 {
                best = (distance_mm(&next.tip), to, None);
            }
            queue.push((rank(&next.tip), to));
            let previous_heading = (arc_number != STRAIGHT).then_some(place.tip.heading);
            let length_mm = length_mm + step_mm;
            nodes.push(Node { place: next, previous_heading, length_mm, from: Some((from, arc)) });
        }
    }
    field.visited = lattice.visited;
    let (_, mut node, last) = best;
    let mut arcs = Vec::from_iter(last);
    while let Some((from, arc)) = nodes[node].from {
        arcs.push(arc);
        node = from;
    }
    arcs.reverse();
    improved(field, problem, Path { start: problem.start, arcs }.joined())
}

/// Improves the path by changes that bring its end nearer to the target, each time by the best change.
fn improved(field: &mut Field<'_>, problem: &Problem, mut path: Path) -> Path {
    let mut tries_left = problem.expansions_max.saturating_mul(TRIES_PER_NODE);
    for _ in 0..CHANGES_MAX {
        let change = best_change(field, problem, &path, &mut tries_left);
        let Some((along_mm, ways)) = change else { break };
        path = Path { arcs: [path.first(along_mm), ways.to_vec()].concat(), ..path }.joined();
    }
    path
}

/// The change of `path` that brings its end nearest to the target: leave the path on one arc, then continue on the
/// sharpest arc toward the target. Returns the length along the path at which to leave it, mm, and the two arcs; `None`
/// if the gain is too small. Each arc that is tried uses up one of `tries_left`.
fn best_change(
    field: &mut Field<'_>,
    problem: &Problem,
    path: &Path,
    tries_left: &mut u32,
) -> Option<(f64, [Arc; 2])> {
    let Problem { curvature_per_mm, in_plane, length_max_mm, .. } = *problem;
    let mut best_mm = problem.to_target_mm(&path.end().position_mm) - GAIN_MIN_MM;
    let mut best = None;
    for point in 0..=(path.length_mm() / LEAVE_MM) as u32 {
        let along_mm = LEAVE_MM * f64::from(point);
        let (tip, _) = path.at(along_mm);
        for (bend, share) in bends(&tip, in_plane) {
            let arc = Arc {
                bend,
                curvature_per_mm: share * curvature_per_mm,
                length_mm: ARC_MAX_MM.min(length_max_mm - along_mm),
            };
            if *tries_left == 0 {
                return best;
            }
            *tries_left -= 1;
            let clear_mm = field.clear_part(&tip, arc).length_mm;
            let parts = (clear_mm / LEAVE_MM).ceil();
            for part in 1..=parts as u32 {
                let arc = arc.with_length(clear_mm * f64::from(part) / parts);
                let to = tip.after(&arc);
                if miss_mm(&to, problem) > best_mm {
                    continue;
                }
                if *tries_left == 0 {
                    return best;
                }
                *tries_left -= 1;
                let left_mm = length_max_mm - along_mm - arc.length_mm;
                let sharpest = field.clear_part(&to, sharpest_arc(&to, problem, left_mm));
                let end_mm = problem.to_target_mm(&to.after(&sharpest).position_mm);
                if end_mm < best_mm {
                    (best_mm, best) = (end_mm, Some((along_mm, [arc, sharpest])));
                }
            }
        }
    }
    best
}

/// The directions in which an arc may bend, each with a share of the curvature.
fn bends(tip: &Tip, in_plane: bool) -> Vec<(Vector3<f64>, f64)> {
    let [first, second] = match in_plane {
        true => [Vector3::new(0.0, -tip.heading.z, tip.heading.y), Vector3::zeros()],
        false => tip.across(),
    };
    let count = if in_plane { 2 } else { BENDS };
    let sides = (0..count).map(|side| {
        let (sin, cos) = math::sin_cos(TAU * f64::from(side) / f64::from(count));
        first * cos + second * sin
    });
    let bent = sides.flat_map(|bend| [(bend, 1.0), (bend, 0.5)]);
    bent.chain([(first, 0.0)]).collect()
}

#[cfg(test)]
mod tests {
    use crate::plan::search::tests::{problem, world};
    use crate::plan::{Obstacle, Problem, Status, plan};
    use nalgebra::Vector3;

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

    fn ball(centre_mm: [f64; 3], radius_mm: f64) -> Vec<Obstacle> {
        vec![Obstacle::Sphere { centre_mm: centre_mm.into(), radius_mm }]
    }

    /// The target is in a ball. The nearest point with the clearance is 8.4 mm away, on the far side; straight ahead
    /// it is 14 mm away.
    #[test]
    fn the_nearest_point_to_a_target_in_an_obstacle_is_on_its_far_side() {
        for in_plane in [true, false] {
            let world = world(ball([0.0, 3.0, 118.0], 10.0));
            let sharp = problem([0.0, 0.0, 120.0], in_plane);
            let problem = Problem { curvature_per_mm: 1.0 / 90.0, ..sharp };
            let nearest_mm = plan(&world, &problem).nearest_mm.expect("the start is allowed");
            let found_mm = (nearest_mm - problem.target_mm).norm();
            assert!((8.39..8.6).contains(&found_mm), "{in_plane}: {found_mm}");
            let slack_mm = world.slack_mm(&nearest_mm, problem.clearance_mm);
            assert!(slack_mm > -2e-3, "{slack_mm}");
        }
    }

    #[test]
    fn a_target_outside_the_workspace_has_a_nearest_point() {
        for in_plane in [true, false] {
            let answer = plan(&world(vec![]), &problem([0.0, 0.0, 160.0], in_plane));
            assert!(answer.reason.expect("no path").contains("10.0 mm outside goal.workspace_mm"));
            let nearest_mm = answer.nearest_mm.expect("the start is allowed");
            assert!((nearest_mm - Vector3::new(0.0, 0.0, 150.0)).norm() < 0.3, "{nearest_mm}");
        }
    }

    /// The cells of the search are too coarse for the only path past this ball.
    #[test]
    fn a_nearest_point_within_the_tolerance_is_a_plan() {
        let world = world(ball([0.0, 0.0, 60.0], 8.0));
        let problem = problem([0.0, 0.0, 120.0], true);
        let answer = plan(&world, &problem);
        let path = answer.path.as_ref().expect("a way is left");
        assert_eq!((answer.status, &answer.reason), (Status::Plan, &None));
        assert!((path.end().position_mm - problem.target_mm).norm() <= problem.tolerance_mm);
        assert!(path.distance_mm(&world) >= problem.clearance_mm - 2e-3);
        assert!(path.arcs.iter().all(|arc| arc.curvature_per_mm <= problem.curvature_per_mm));
    }
}
