//! The planner: best-first search over arcs and straights.

use super::arc::{Arc, Tip};
use super::field::Field;
use super::lattice::{LEVELS, Lattice, Place, Resolution, STRAIGHT};
use super::nearest::path_to_nearest;
use super::obstacle::{Obstacle, World};
use super::path::Path;
use super::problem::Problem;
use super::route::Route;
use derive_more::Display;
use nalgebra::Vector3;
use std::borrow::Cow;

/// A plan is accepted once no other can be shorter by more than this share.
const SLACK: f64 = 0.01;
/// Cost of a change of curvature, mm, so that of two paths of the same length the one with fewer arcs is chosen.
const CHANGE_MM: f64 = 0.02;
/// Width of a bucket of the queue, mm.
const BUCKET_MM: f64 = 0.25;
/// Each level of a search in space may spend the remaining budget divided by this.
const BUDGET_DIVISORS: [u32; LEVELS.len()] = [8, 3, 1];

/// What a search found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
pub enum Status {
    /// A path. At this resolution no path is shorter by more than 1%, or no other path was found.
    #[display("plan")]
    Plan,
    /// No path was found at this resolution, and the search was exhausted. In space a path with little room beside
    /// obstacles may be missed.
    #[display("none")]
    None,
    /// The budget was spent; in space, where each resolution has a share of it, that share. There may be a path, or one
    /// that is shorter than the path found.
    #[display("budget")]
    Budget,
}

/// The answer to a [`Problem`].
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// What the search found.
    pub status: Status,
    /// The path: always present with [`Status::Plan`], never with [`Status::None`].
    pub path: Option<Path>,
    /// Nodes expanded.
    pub expansions: u32,
    /// The resolution of the search.
    pub resolution: Resolution,
    /// Why there is no path.
    pub reason: Option<String>,
    /// True if there is no path, but a needle that bends more may have one.
    pub may_bend_too_little: bool,
    /// The reachable point nearest to the target, mm. With a path it is only the nearest of those that the search
    /// visited. `None` if even the start is not allowed.
    pub nearest_mm: Option<Vector3<f64>>,
}

/// Plans the path to the target, or to a point within its tolerance, with the least sum of length and distance from the
/// target at the end.
///
/// The search is best-first over arcs of full curvature and straights, all of one length, in cells of position
/// and heading that are visited once. Nodes are ordered by the length so far plus a lower bound of the
/// rest: the larger of the arc-then-straight without obstacles and the way around obstacles for a
/// tip that turns on the spot. From each node the target is tried directly. In space, the resolution is
/// refined until a path is found. The same problem has the same answer on every machine.
pub fn plan(world: &World, problem: &Problem) -> Answer {
    let mut field = Field::new(Cow::Borrowed(world), problem.clearance_mm, problem.in_plane);
    let route = Route::new(&mut field, &problem.target_mm);
    plan_thoroughly(&mut field, problem, &route)
}

/// Like [`plan`], with the `route` to the target already known.
pub(super) fn plan_thoroughly(field: &mut Field<'_>, problem: &Problem, route: &Route) -> Answer {
    // No path leaves the workspace, or comes nearer to an obstacle than the clearance.
    let slack_mm = field.world.slack_upper_bound_mm(&problem.target_mm, problem.clearance_mm);
    let is_out_of_bounds = slack_mm < -problem.tolerance_mm;
    let expansions_max = if is_out_of_bounds { 0 } else { problem.expansions_max };
    let mut answer = search_only(field, &Problem { expansions_max, ..problem.clone() }, route);
    if is_out_of_bounds {
        answer.status = Status::None;
    }
    // The search drops nodes from which the target is out of reach, but these may lead nearer to it. Look for them only
    // after an exhausted search: one whose budget was spent does not know what can be reached.
    if let (Status::None, Some(nearest_mm)) = (answer.status, answer.nearest_mm) {
        let path = path_to_nearest(field, problem);
        let end_mm = path.end().position_mm;
        if problem.to_target_mm(&end_mm) < problem.to_target_mm(&nearest_mm) {
            answer.nearest_mm = Some(end_mm);
        }
        if problem.to_target_mm(&end_mm) <= problem.tolerance_mm {
            let (status, path) = (Status::Plan, Some(path));
            answer = Answer { status, path, reason: None, may_bend_too_little: false, ..answer };
        }
    }
    answer
}

/// The best-first search alone. It visits each cell once, so in space it may miss a path between its cells.
pub(super) fn search_only(field: &mut Field<'_>, problem: &Problem, route: &Route) -> Answer {
    let levels = if problem.in_plane { 1 } else { LEVELS.len() };
    let mut level = 0;
    let mut expansions = 0;
    loop {
        let remaining = problem.expansions_max - expansions;
        let budget = if problem.in_plane { remaining } else { remaining / BUDGET_DIVISORS[level] };
        let visited = std::mem::take(&mut field.visited);
        let lattice = Lattice::new(&field.world.workspace, problem, level, visited);
        let search = Search {
            field,
            problem,
            route,
            moved_mm: route.moved_mm(&problem.target_mm),
            lattice,
            nodes: Vec::new(),
            buckets: Vec::new(),
            first_bound_mm: 0.0,
            best: None,
            nearest: (f64::INFINITY, problem.start.position_mm),
        };
        let answer = search.run(budget);
        expansions += answer.expansions;
        level += 1;
        if level == levels || answer.path.is_some() || answer.nearest_mm.is_none() {
            return Answer { expansions, ..answer };
        }
    }
}

struct Node {
    place: Place,
    /// How far the tip may go from here in any direction, mm.
    slack_mm: f32,
    length_mm: f32,
    changes: u16,
    arc_number: u8,
    /// False if an obstacle is known to be in the way to the target.
    may_be_free: bool,
    parent: u32,
}

/// A path that was found: the last node that it goes through, and the arcs from there on.
struct Found {
    cost_mm: f64,
    node: u32,
    rest: [Arc; 2],
}

/// If obstacles make the way longer by more than this, mm, the target is not tried directly.
const DETOUR_MM: f64 = 2.0;
/// Costs that differ by no more than this are equal up to rounding, mm.
const SAME_MM: f64 = 1e-9;
/// Number of parts of an arc at whose ends a path may end.
const PARTS: u32 = 10;
/// An arc of zero length.
const NO_ARC: Arc =
    Arc { bend: Vector3::new(0.0, 0.0, 0.0), curvature_per_mm: 0.0, length_mm: 0.0 };

struct Search<'a, 'w> {
    field: &'a mut Field<'w>,
    problem: &'a Problem,
    route: &'a Route,
    /// By how much the ways to the target may be shorter than the route says, mm.
    moved_mm: f64,
    lattice: Lattice,
    nodes: Vec<Node>,
    /// The queue: nodes by the lower bound of a whole path through them.
    buckets: Vec<Vec<u32>>,
    /// The lower bound of the first bucket, mm.
    first_bound_mm: f64,
    best: Option<Found>,
    nearest: (f64, Vector3<f64>),
}

impl Search<'_, '_> {
    fn run(mut self, budget: u32) -> Answer {
        let start = self.lattice.start(self.problem.start);
        let mut answer = Answer {
            status: Status::None,
            path: None,
            expansions: 0,
            resolution: self.lattice.resolution,
            reason: self.explain_bad_start(),
            may_bend_too_little: false,
            nearest_mm: None,
        };
        if answer.reason.is_some() {
            return answer;
        }
        self.first_bound_mm = self.lower_bound_mm(&self.problem.start).0;
        let slack_mm = self.field.slack_mm(&self.problem.start.position_mm).max(0.0) as f32;
        self.push(start, slack_mm, 0.0, 0, STRAIGHT, 0);
        let mut bucket = 0;
        while bucket < self.buckets.len() {
            let Some(node) = self.buckets[bucket].pop() else {
                bucket += 1;
                continue;
            };
            let bound_mm = self.first_bound_mm + BUCKET_MM * bucket as f64;
            if self.best.as_ref().is_some_and(|best| best.cost_mm <= bound_mm * (1.0 + SLACK)) {
                break;
            }
            if answer.expansions == budget {
                answer.status = Status::Budget;
                break;
            }
            answer.expansions += 1;
            self.try_target(node);
            bucket = bucket.min(self.expand(node));
        }
        answer.nearest_mm = Some(self.nearest.1);
        answer.path = self.best.take().map(|found| self.path(found));
        if answer.status == Status::None && answer.path.is_some() {
            answer.status = Status::Plan;
        }
        if answer.path.is_none() {
            let (reason, may_bend_too_little) = self.explain_no_path(answer.status);
            answer = Answer { reason: Some(reason), may_bend_too_little, ..answer };
        }
        self.field.visited = self.lattice.visited;
        answer
    }

    /// Why the start is not allowed; `None` if it is.
    fn explain_bad_start(&self) -> Option<String> {
        let Problem { start, clearance_mm, .. } = self.problem;
        let (world, at) = (&self.field.world, &start.position_mm);
        let out_mm = -world.workspace.depth_mm(at);
        if out_mm > 0.0 {
            return Some(format!(
                "the start is {out_mm:.1} mm outside goal.workspace_mm; start inside, or widen it"
            ));
        }
        let distance_mm = world.distance_mm(at);
        (distance_mm < *clearance_mm).then(|| {
            let place = describe_distance(world, distance_mm);
            format!("the start is {place}, goal.clearance_mm is {clearance_mm}; start elsewhere")
        })
    }

    /// A lower bound of length plus remaining distance from `tip`, mm, and whether the direct way may be free.
    fn lower_bound_mm(&self, tip: &Tip) -> (f64, bool) {
        let Problem { target_mm, curvature_per_mm, tolerance_mm, in_plane, .. } = self.problem;
        let unobstructed_mm =
            tip.shortest_mm(target_mm, *curvature_per_mm, *tolerance_mm, *in_plane);
        let route_mm = self.route.length_mm(&tip.position_mm) - self.moved_mm;
        match route_mm.is_finite() {
            true => (unobstructed_mm.max(route_mm), unobstructed_mm > route_mm - DETOUR_MM),
            // The search goes on, to find the point nearest to the target. If the target has moved to where none of the
            // route's ways begins, the route knows no way to it.
            false => (unobstructed_mm, self.moved_mm.is_infinite()),
        }
    }

    /// Adds a node, unless every path through it is too long. Returns its bucket, or `usize::MAX`.
    fn push(
        &mut self,
        place: Place,
        slack_mm: f32,
        length_mm: f64,
        changes: u16,
        arc_number: u8,
        parent: u32,
    ) -> usize {
        let distance_mm = self.problem.to_target_mm(&place.tip.position_mm);
        if distance_mm < self.nearest.0 {
            self.nearest = (distance_mm, place.tip.position_mm);
        }
        let (lower_bound_mm, may_be_free) = self.lower_bound_mm(&place.tip);
        if length_mm + lower_bound_mm - self.problem.tolerance_mm > self.problem.length_max_mm {
            return usize::MAX;
        }
        let bound_mm = length_mm + f64::from(changes) * CHANGE_MM + lower_bound_mm;
        let bucket = ((bound_mm - self.first_bound_mm) / BUCKET_MM).max(0.0) as usize;
        if bucket >= self.buckets.len() {
            self.buckets.resize_with(bucket + 1, Vec::new);
        }
        self.buckets[bucket].push(self.nodes.len() as u32);
        self.nodes.push(Node {
            place,
            slack_mm,
            length_mm: length_mm as f32,
            changes,
            arc_number,
            may_be_free,
            parent,
        });
        bucket
    }

    /// Adds the nodes that the arcs from a node lead to. Returns the lowest bucket that one was added to.
    fn expand(&mut self, from: u32) -> usize {
        let Node { place, slack_mm, length_mm, changes, arc_number: last, .. } =
            self.nodes[from as usize];
        let previous_heading = self.previous_heading(from);
        let step_mm = self.lattice.resolution.step_mm;
        let mut lowest = usize::MAX;
        for arc_number in (0..self.lattice.arcs()).rev() {
            let next = self.lattice.next(&place, previous_heading, arc_number);
            let cell = self.lattice.cell(&next);
            if self.lattice.visited.contains(cell) {
                continue;
            }
            // The end first: most arcs that are not clear fail there.
            let next_slack_mm = self.field.slack_mm(&next.tip.position_mm);
            if next_slack_mm < 0.0 {
                continue;
            }
            let slacks_mm = [f64::from(slack_mm), next_slack_mm];
            if slacks_mm.iter().sum::<f64>() < step_mm {
                let arc = self.lattice.arc(&place.tip, previous_heading, arc_number);
                if !self.field.is_clear_between(&place.tip, &arc, slacks_mm) {
                    continue;
                }
            }
            self.lattice.visited.insert(cell);
            let changes = changes + u16::from(arc_number != last);
            let length_mm = f64::from(length_mm) + step_mm;
            let bucket =
                self.push(next, next_slack_mm as f32, length_mm, changes, arc_number, from);
            lowest = lowest.min(bucket);
        }
        lowest
    }

    /// The heading at the start of the arc that led to `node`.
    fn previous_heading(&self, node: u32) -> Option<Vector3<f64>> {
        let Node { parent, arc_number, .. } = self.nodes[node as usize];
        (arc_number != STRAIGHT).then(|| self.nodes[parent as usize].place.tip.heading)
    }

    /// Tries to end on an arc from this node, or to go to the target directly.
    fn try_target(&mut self, node: u32) {
        let Problem { target_mm, tolerance_mm, curvature_per_mm, .. } = self.problem;
        let Node { place: Place { tip, .. }, length_mm, changes, may_be_free, .. } =
            self.nodes[node as usize];
        let length_mm = f64::from(length_mm);
        let distance_mm = self.problem.to_target_mm(&tip.position_mm);
        let ends_near = distance_mm <= *tolerance_mm + self.lattice.resolution.step_mm;
        let near = if ends_near { self.nearest_on_arcs(node) } else { None };
        // The route's grid is too coarse to judge a target that is near.
        let tip_aims = Some(tip).filter(|_| may_be_free || ends_near);
        let turning =
            tip_aims.and_then(|tip| tip.arc_then_straight_to(target_mm, *curvature_per_mm));
        let bent = tip_aims.and_then(|tip| tip.arc_to(target_mm));
        let bent = bent.filter(|arc| arc.curvature_per_mm <= *curvature_per_mm);
        // Of equal costs the first wins: the direct ways, which end at the target.
        let ways = [turning.map(|arcs| (0.0, arcs)), bent.map(|arc| (0.0, [arc, NO_ARC])), near];
        for (left_mm, rest) in ways.into_iter().flatten() {
            let whole_mm = length_mm + rest.iter().map(|arc| arc.length_mm).sum::<f64>();
            let cost_mm = whole_mm + f64::from(changes) * CHANGE_MM + left_mm;
            let is_better = self.best.as_ref().is_none_or(|best| cost_mm < best.cost_mm - SAME_MM);
            if is_better && whole_mm <= self.problem.length_max_mm && self.are_clear(&tip, &rest) {
                self.best = Some(Found { cost_mm, node, rest });
            }
        }
    }

    /// The cheapest end within the tolerance on the arcs from `node`: its distance from the target, and the arcs
    /// there.
    fn nearest_on_arcs(&self, node: u32) -> Option<(f64, [Arc; 2])> {
        let (tip, previous_heading) =
            (self.nodes[node as usize].place.tip, self.previous_heading(node));
        let arcs = (0..self.lattice.arcs())
            .map(|arc_number| self.lattice.arc(&tip, previous_heading, arc_number));
        let parts = arcs.flat_map(|arc| {
            (0..=PARTS).map(move |part| {
                arc.with_length(arc.length_mm * f64::from(part) / f64::from(PARTS))
            })
        });
        let ends = parts
            .map(|arc| (self.problem.to_target_mm(&tip.after(&arc).position_mm), [arc, NO_ARC]));
        let cost_mm = |(left_mm, [arc, _]): &(f64, [Arc; 2])| left_mm + arc.length_mm;
        ends.filter(|(left_mm, _)| *left_mm <= self.problem.tolerance_mm)
            .min_by(|a, b| cost_mm(a).total_cmp(&cost_mm(b)))
    }

    fn are_clear(&mut self, tip: &Tip, arcs: &[Arc; 2]) -> bool {
        let [first, second] = arcs;
        self.field.is_clear(tip, first) && self.field.is_clear(&tip.after(first), second)
    }

    fn path(&self, found: Found) -> Path {
        let mut arcs = Vec::new();
        let mut node = found.node;
        while node != 0 {
            let Node { parent, arc_number, .. } = self.nodes[node as usize];
            let tip = self.nodes[parent as usize].place.tip;
            arcs.push(self.lattice.arc(&tip, self.previous_heading(parent), arc_number));
            node = parent;
        }
        arcs.reverse();
        arcs.extend(found.rest);
        Path { start: self.problem.start, arcs }.joined()
    }

    /// Why the search found no path, and whether a needle that bends more may have one.
    fn explain_no_path(&self, status: Status) -> (String, bool) {
        let Problem { start, target_mm, tolerance_mm, clearance_mm, length_max_mm, .. } =
            self.problem;
        let world = &self.field.world;
        let out_mm = -world.workspace.depth_mm(target_mm);
        if out_mm > *tolerance_mm {
            let behind_mm = (start.position_mm - target_mm).dot(&start.heading);
            let behind = match behind_mm > *tolerance_mm {
                true => format!(", {behind_mm:.1} mm behind the start"),
                false => String::new(),
            };
            let reason = format!("the target is {out_mm:.1} mm outside goal.workspace_mm{behind}");
            return (reason, false);
        }
        let distance_mm = world.distance_mm(target_mm);
        if distance_mm < clearance_mm - tolerance_mm {
            let place = describe_distance(world, distance_mm);
            let reason = format!("the target is {place}, goal.clearance_mm is {clearance_mm}");
            return (reason, false);
        }
        // The route leads to the target itself, but a path may end beside it. So only a search that was not cut short
        // shows that there is none.
        let is_closed = self.route.length_mm(&start.position_mm).is_infinite();
        if is_closed && self.moved_mm.is_finite() && status == Status::None {
            let reason =
                "the obstacles close every way to the target, even for a needle that bends at will";
            return (reason.to_owned(), false);
        }
        let curvature_per_mm = self.problem.curvature_per_mm;
        let least_mm =
            start.shortest_mm(target_mm, curvature_per_mm, *tolerance_mm, self.problem.in_plane);
        if least_mm - tolerance_mm > *length_max_mm {
            let reason = format!(
                "the target is out of reach: with nothing in the way, a needle of {:.0} mm radius takes \
                 {least_mm:.0} mm at least, allowed are {length_max_mm:.0}, insertion.depth_mm",
                curvature_per_mm.recip()
            );
            let straight_mm = self.problem.to_target_mm(&start.position_mm);
            return (reason, straight_mm - tolerance_mm <= *length_max_mm);
        }
        match status {
            Status::Budget => {
                let reason = format!(
                    "the budget of expansions was spent before a path was found: raise \
                     goal.expansions_max, which is {}",
                    self.problem.expansions_max
                );
                (reason, false)
            }
            _ => {
                let cell_mm = self.lattice.resolution.cell_mm;
                let coarse = match self.lattice.is_coarse {
                    true => " (goal.workspace_mm is large: narrow it)",
                    false => "",
                };
                let reason = format!(
                    "no path was found, and all cells of {cell_mm:.1} mm{coarse} within reach were tried"
                );
                (reason, true)
            }
        }
    }
}

/// Describes the distance of a point from an obstacle; the distance from a mask is a lower bound.
fn describe_distance(world: &World, distance_mm: f64) -> String {
    let has_mask = world.obstacles.iter().any(|it| matches!(it, Obstacle::Mask(_)));
    match distance_mm < 0.0 {
        true => format!("{:.1} mm inside an obstacle", -distance_mm),
        false if has_mask => format!("{distance_mm:.1} mm or more from an obstacle"),
        false => format!("{distance_mm:.1} mm from an obstacle"),
    }
}

#[cfg(test)]
pub(super) mod tests;
