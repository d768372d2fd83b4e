//! The distance to the obstacles on a grid, computed on demand.

use super::arc::{Arc, Tip};
use super::lattice::Visited;
use super::obstacle::World;
use nalgebra::Vector3;
use std::borrow::Cow;

/// The shortest step along an arc when it is tested against the obstacles, mm. Between two tests a path may violate
/// a clearance of 1 mm by 0.0013 mm, and one of 0.1 mm, the least that is allowed with obstacles, by 0.0134 mm. With
/// a clearance under half a step a path could lead through a thin obstacle.
const TEST_STEP_MM: f64 = 0.1;
/// The least clearance from obstacles, mm.
pub const CLEARANCE_MIN_MM: f64 = 0.1;
/// An arc longer than this, mm, is first tested at a few points, at these fractions of its length.
const FEW_POINTS_MM: f64 = 5.0;
const PARTS: [f64; 7] = [0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875];
/// If the slack is surely above this, mm, a lower bound of the slack is enough.
const AMPLE_MM: f64 = 0.5;
/// Distance between two nodes, mm: in the plane and in space.
const SPACING_MM: [f64; 2] = [1.0, 4.0];
/// Maximum number of nodes along a coordinate: in the plane and in space.
const NODES_MAX: [f64; 2] = [400.0, 60.0];

/// A grid of nodes over the bounds of a workspace: in space, or in the plane x = 0.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Grid {
    first_mm: Vector3<f64>,
    pub(super) spacing_mm: f64,
    /// Half the diagonal of a cell: no point is farther from the nearest node.
    pub(super) radius_mm: f64,
    pub(super) counts: [usize; 3],
}

impl Grid {
    fn new(world: &World, in_plane: bool) -> Self {
        let [mut first_mm, last_mm] = world.workspace.bounds_mm();
        let mut extent_mm = last_mm - first_mm;
        if in_plane {
            (extent_mm.x, first_mm.x) = (0.0, 0.0);
        }
        let [index, dimensions] = if in_plane { [0, 2] } else { [1, 3] };
        let spacing_mm = SPACING_MM[index].max(extent_mm.max() / NODES_MAX[index]);
        let radius_mm = 0.5 * spacing_mm * (dimensions as f64).sqrt();
        let counts = extent_mm.map(|mm| (mm / spacing_mm).ceil() as usize + 1).into();
        Grid { first_mm, spacing_mm, radius_mm, counts }
    }

    pub(super) fn nodes(&self) -> usize {
        self.counts.iter().product()
    }

    pub(super) fn node(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.counts[1] + y) * self.counts[0] + x
    }

    pub(super) fn indices(&self, node: usize) -> [usize; 3] {
        let [nx, ny, _] = self.counts;
        [node % nx, node / nx % ny, node / nx / ny]
    }

    pub(super) fn position_mm(&self, indices: [usize; 3]) -> Vector3<f64> {
        self.first_mm + Vector3::from(indices.map(|index| index as f64)) * self.spacing_mm
    }

    /// The lower corner of the cell around a point of the workspace.
    pub(super) fn below(&self, point_mm: &Vector3<f64>) -> [usize; 3] {
        std::array::from_fn(|i| {
            let index = ((point_mm[i] - self.first_mm[i]) / self.spacing_mm) as usize;
            index.min(self.counts[i].saturating_sub(2))
        })
    }

    /// True if the nearest node of `point_mm` is within the radius. The start of a run may be outside the grid.
    fn covers(&self, point_mm: &Vector3<f64>) -> bool {
        (0..3).all(|i| {
            let along = (point_mm[i] - self.first_mm[i]) / self.spacing_mm;
            (-0.5..=self.counts[i] as f64 - 0.5).contains(&along)
        })
    }

    fn nearest(&self, point_mm: &Vector3<f64>) -> [usize; 3] {
        std::array::from_fn(|i| {
            let index = (point_mm[i] - self.first_mm[i]) / self.spacing_mm + 0.5;
            (index as usize).min(self.counts[i] - 1)
        })
    }
}

/// The region in which the tip may be: inside the workspace, with the clearance from the obstacles.
#[derive(Debug, Clone)]
pub(super) struct Field<'a> {
    pub(super) world: Cow<'a, World>,
    pub(super) clearance_mm: f64,
    pub(super) grid: Grid,
    pub(super) in_plane: bool,
    /// Distance of each node to the nearest obstacle, mm; NaN until it is computed.
    distances_mm: Vec<f32>,
    /// The visited cells of the last search, whose memory the next one reuses.
    pub(super) visited: Visited,
}

impl<'a> Field<'a> {
    /// The field around the obstacles of `world`. With `in_plane` all points must be in the plane x = 0.
    pub(super) fn new(world: Cow<'a, World>, clearance_mm: f64, in_plane: bool) -> Self {
        let grid = Grid::new(&world, in_plane);
        let distances_mm = vec![f32::NAN; grid.nodes()];
        Field { world, clearance_mm, grid, in_plane, distances_mm, visited: Visited::default() }
    }

    /// The slack of a node, mm.
    pub(super) fn node_slack_mm(&mut self, node: usize) -> f64 {
        if self.distances_mm[node].is_nan() {
            let position_mm = self.grid.position_mm(self.grid.indices(node));
            self.distances_mm[node] = self.world.distance_mm(&position_mm) as f32;
        }
        f64::from(self.distances_mm[node]) - self.clearance_mm
    }

    /// The slack at `point_mm`, mm: how far the tip may go from there in any direction; a lower bound if that is far.
    /// Negative if the tip must not be at `point_mm`.
    pub(super) fn slack_mm(&mut self, point_mm: &Vector3<f64>) -> f64 {
        let depth_mm = self.world.workspace.depth_mm(point_mm);
        if depth_mm < 0.0 {
            return depth_mm;
        }
        if !self.grid.covers(point_mm) {
            return (self.world.distance_mm(point_mm) - self.clearance_mm).min(depth_mm);
        }
        let node = self.grid.node(self.grid.nearest(point_mm));
        let node_slack_mm = self.node_slack_mm(node);
        let [least_mm, most_mm] =
            [-1.0, 1.0].map(|sign| node_slack_mm + sign * self.grid.radius_mm);
        let slack_mm = if least_mm >= AMPLE_MM {
            least_mm
        } else if most_mm < 0.0 {
            most_mm
        } else {
            self.world.distance_mm(point_mm) - self.clearance_mm
        };
        slack_mm.min(depth_mm)
    }

    /// The slack of the point at `along_mm` of `arc` from `tip`, mm.
    fn slack_on_arc_mm(&mut self, tip: &Tip, arc: &Arc, along_mm: f64) -> f64 {
        self.slack_mm(&tip.after(&arc.with_length(along_mm)).position_mm)
    }

    /// True if `arc` from `tip` stays in the workspace and keeps the clearance from all obstacles.
    pub(super) fn is_clear(&mut self, tip: &Tip, arc: &Arc) -> bool {
        let mut slack_at_mm = |along_mm| self.slack_on_arc_mm(tip, arc, along_mm);
        let slacks_mm = [0.0, arc.length_mm].map(&mut slack_at_mm);
        // A few points first: most arcs that are not clear fail there.
        let parts = if arc.length_mm > FEW_POINTS_MM { PARTS.as_slice() } else { &[] };
        slacks_mm.iter().all(|slack_mm| *slack_mm >= 0.0)
            && !parts.iter().any(|part| slack_at_mm(part * arc.length_mm) < 0.0)
            && self.is_clear_between(tip, arc, slacks_mm)
    }

    /// The first part of `arc` from `tip` that is clear; its length is 0 if the tip must not be where it is.
    pub(super) fn clear_part(&mut self, tip: &Tip, arc: Arc) -> Arc {
        let mut along_mm = 0.0;
        let mut clear_mm = 0.0;
        loop {
            let slack_mm = self.slack_on_arc_mm(tip, &arc, along_mm);
            if slack_mm < 0.0 {
                return arc.with_length(clear_mm);
            }
            clear_mm = along_mm;
            if along_mm >= arc.length_mm {
                return arc;
            }
            along_mm = (along_mm + slack_mm.max(TEST_STEP_MM)).min(arc.length_mm);
        }
    }

    /// Like [`Field::is_clear`], with the slacks of both ends given, mm; neither is negative.
    pub(super) fn is_clear_between(
        &mut self,
        tip: &Tip,
        arc: &Arc,
        [slack_mm, end_slack_mm]: [f64; 2],
    ) -> bool {
        // Within its slack the tip may go anywhere.
        let mut along_mm = slack_mm.max(TEST_STEP_MM);
        while along_mm < arc.length_mm - end_slack_mm {
            let slack_mm = self.slack_on_arc_mm(tip, arc, along_mm);
            if slack_mm < 0.0 {
                return false;
            }
            along_mm += slack_mm.max(TEST_STEP_MM);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Obstacle;
    use crate::plan::search::tests::world;

    #[test]
    fn the_least_clearance_leaves_no_way_through_a_thin_obstacle() {
        let tip = Tip { position_mm: Vector3::zeros(), heading: Vector3::z() };
        let ahead = Arc { bend: Vector3::y(), curvature_per_mm: 0.0, length_mm: 40.0 };
        let is_clear = |at_mm: f64, clearance_mm| {
            let thin = Obstacle::Box {
                min_mm: Vector3::new(-9.0, -9.0, at_mm),
                max_mm: Vector3::new(9.0, 9.0, at_mm + 1e-6),
            };
            let world = world(vec![thin]);
            Field::new(Cow::Borrowed(&world), clearance_mm, true).is_clear(&tip, &ahead)
        };
        let places = || (0..200).map(|i| 21.0 + 0.001 * f64::from(i));
        assert!(places().all(|at_mm| !is_clear(at_mm, 0.1)));
        assert!(places().any(|at_mm| is_clear(at_mm, 0.0)), "so 0 is not allowed");
    }

    /// A run may begin outside the grid, where the nearest node says nothing of an obstacle behind the start.
    #[test]
    fn an_obstacle_behind_the_start_counts_outside_the_grid() {
        let centre_mm = Vector3::new(0.0, 0.0, -4.0);
        let world = world(vec![Obstacle::Sphere { centre_mm, radius_mm: 1.5 }]);
        let mut field = Field::new(Cow::Owned(world), 0.1, true);
        field.world.to_mut().workspace.begin_at(Vector3::zeros(), Vector3::zeros());
        assert!(field.slack_mm(&Vector3::new(0.0, 0.0, -2.0)) > 0.0);
        assert!(field.slack_mm(&Vector3::new(0.0, 0.0, -2.9)) < 0.0);
    }
}
