//! Lengths of the shortest ways to the target around the obstacles, for a tip that could turn on the spot.

use super::field::{Field, Grid};
use nalgebra::Vector3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// In the plane: how far a step over the nodes reaches, and how much longer than a straight line a way over
/// nodes may be.
const PLANE: (i32, f64) = (2, 1.0275);
/// The same in space.
const SPACE: (i32, f64) = (1, 1.128);
/// Resolution of lengths in the queue, mm.
const TICK_MM: f64 = 1e-3;

/// Lengths of the shortest ways to the target, on a grid of nodes over the workspace.
#[derive(Debug, Clone)]
pub(super) struct Route {
    grid: Grid,
    /// The length from each node; infinite if there is no way.
    lengths_mm: Vec<f32>,
    longer: f64,
    target_mm: Vector3<f64>,
}

impl Route {
    /// The ways to `target_mm` that keep the clearance of `field`.
    ///
    /// A node is blocked only if no point near it is free. So if this finds no way, there is none; and its
    /// lengths, divided by how much longer ways over nodes may be, are lower bounds.
    pub(super) fn new(field: &mut Field<'_>, target_mm: &Vector3<f64>) -> Self {
        let grid = field.grid.clone();
        let (reach, longer) = if field.in_plane { PLANE } else { SPACE };
        let steps = steps(reach, grid.counts);
        let mut lengths = vec![u32::MAX; grid.nodes()];
        let mut queue = BinaryHeap::new();
        for at in corners(&grid, target_mm) {
            let away_mm = (grid.position_mm(at) - target_mm).norm();
            let node = grid.node(at);
            lengths[node] = (away_mm / TICK_MM) as u32;
            queue.push(Reverse((lengths[node], node)));
        }
        while let Some(Reverse((length, node))) = queue.pop() {
            if length > lengths[node] {
                continue;
            }
            let at = grid.indices(node);
            for (step, nodes) in &steps {
                let Some(next) = neighbour(&grid, at, *step) else { continue };
                let length = length + (nodes * grid.spacing_mm / TICK_MM) as u32;
                if length < lengths[next] && field.node_slack_mm(next) >= -grid.radius_mm {
                    lengths[next] = length;
                    queue.push(Reverse((length, next)));
                }
            }
        }
        let to_mm = |length: u32| match length {
            u32::MAX => f32::INFINITY,
            length => (f64::from(length) * TICK_MM) as f32,
        };
        let lengths_mm = lengths.into_iter().map(to_mm).collect();
        Route { grid, lengths_mm, longer, target_mm: *target_mm }
    }

    /// By how much a way to `target_mm` may be shorter than the way from the same point to this route's target, mm.
    /// This is the length of the way between the two targets, around the obstacles; infinite if no way is known.
    pub(super) fn moved_mm(&self, target_mm: &Vector3<f64>) -> f64 {
        if *target_mm == self.target_mm {
            return 0.0;
        }
        // A way over the nodes may end at any open corner around the target.
        let from_corner = |at: [usize; 3]| {
            let away_mm = (self.grid.position_mm(at) - target_mm).norm();
            f64::from(self.lengths_mm[self.grid.node(at)]) - away_mm
        };
        let open = corners(&self.grid, target_mm).map(from_corner).filter(|mm| mm.is_finite());
        open.reduce(f64::max).map_or(f64::INFINITY, |longest_mm| longest_mm / self.longer)
    }

    /// The length of the shortest way from `point_mm`, in the workspace; infinite if there is none.
    pub(super) fn length_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        let by_way_of = |at: [usize; 3]| {
            let away_mm = (self.grid.position_mm(at) - point_mm).norm();
            f64::from(self.lengths_mm[self.grid.node(at)]) + away_mm
        };
        corners(&self.grid, point_mm).map(by_way_of).fold(f64::INFINITY, f64::min) / self.longer
    }
}

/// The nodes around a point.
fn corners(grid: &Grid, point_mm: &Vector3<f64>) -> impl Iterator<Item = [usize; 3]> {
    let low = grid.below(point_mm);
    let [nx, ny, nz] = grid.counts.map(|count| count.min(2));
    (0..nx * ny * nz).map(move |i| [low[0] + i % nx, low[1] + i / nx % ny, low[2] + i / nx / ny])
}

fn neighbour(grid: &Grid, at: [usize; 3], step: [i32; 3]) -> Option<usize> {
    let mut next = [0; 3];
    for (i, next) in next.iter_mut().enumerate() {
        *next = at[i].checked_add_signed(step[i] as isize).filter(|to| *to < grid.counts[i])?;
    }
    Some(grid.node(next))
}

/// Steps to the neighbours, each with its length in nodes: up to `reach` in each coordinate, without steps that are
/// multiples of another.
fn steps(reach: i32, counts: [usize; 3]) -> Vec<([i32; 3], f64)> {
    let [rx, ry, rz] = counts.map(|count| if count > 1 { reach } else { 0 });
    let mut steps = Vec::new();
    for x in -rx..=rx {
        for y in -ry..=ry {
            for z in -rz..=rz {
                let is_multiple = [x, y, z].iter().all(|step| step % 2 == 0);
                if !is_multiple {
                    steps.push(([x, y, z], f64::from(x * x + y * y + z * z).sqrt()));
                }
            }
        }
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Obstacle;
    use crate::plan::search::tests::{problem, world};
    use std::borrow::Cow;

    /// The ways to a target that has moved are at least as long as the bounds of the route to where it was, also
    /// where it has moved to the other side of an obstacle.
    #[test]
    fn a_route_bounds_the_ways_to_a_target_that_has_moved() {
        let wall = Obstacle::Box {
            min_mm: Vector3::new(-40.0, -12.0, 90.0),
            max_mm: Vector3::new(40.0, 60.0, 94.0),
        };
        let world = world(vec![wall]);
        for in_plane in [true, false] {
            let problem = problem([0.0, 5.0, 99.3], in_plane);
            let mut field = Field::new(Cow::Borrowed(&world), problem.clearance_mm, in_plane);
            let route = Route::new(&mut field, &problem.target_mm);
            for moved_mm in [[0.0, 0.4, 0.0], [0.0, -3.0, 2.0], [0.0, 8.0, 4.0], [0.0, 2.0, -17.0]]
            {
                let target_mm = problem.target_mm + Vector3::from(moved_mm);
                let anew = Route::new(&mut field, &target_mm);
                let mut bounded = 0;
                for at in 0..20_u32 {
                    let tip_mm = Vector3::new(0.0, -20.0 + 2.0 * f64::from(at), 60.0);
                    let bound_mm = route.length_mm(&tip_mm) - route.moved_mm(&target_mm);
                    // Lengths are rounded down to whole ticks.
                    let most_mm = anew.length_mm(&tip_mm) + 0.1;
                    assert!(bound_mm <= most_mm, "{moved_mm:?} {at}: {bound_mm} over {most_mm}");
                    bounded += u32::from(bound_mm > 0.0);
                }
                assert!(bounded > 0, "no bound says anything");
            }
            assert_eq!(route.moved_mm(&problem.target_mm), 0.0);
        }
    }
}
