//! Plans again at each step of a run, and decides what the needle does next.

use super::arc::{Arc, Tip};
use super::field::{CLEARANCE_MIN_MM, Field};
use super::nearest::path_to_nearest;
use super::obstacle::World;
use super::path::{Path, bend_after};
use super::problem::Problem;
use super::reserve::RESERVE_MM;
use super::route::Route;
use super::search::{Answer, Status, plan_thoroughly, search_only};
use nalgebra::Vector3;
use std::borrow::Cow;

mod known;
mod step;

pub use step::{StartRefused, Steer, Step, StopReason, TipEstimate};

/// This many standard deviations of the position count as its uncertainty: paths keep that much more than the
/// clearance from obstacles, and the estimated tip may be that much nearer.
const SDS: f64 = 2.0;
/// The same for the position one step ahead. It is less, because the next estimate may be nearer to an obstacle.
const NEXT_STEP_SDS: f64 = 1.0;
/// A path is remembered, to come back to it, only if the position's standard deviation is at most this, mm.
const REMEMBER_SD_MAX_MM: f64 = 0.3;
/// If the heading's standard deviation is over this, rad, the tip may still be on the remembered path, …
const HEADING_UNKNOWN_SD_RAD: f64 = 0.01;
/// … even if it is farther off than the position's deviation by this much, mm: whole turns of the base disturb it.
const ON_PATH_MM: f64 = 0.1;
/// A tip has arrived if the target is no farther ahead than this, mm.
const ARRIVED_MM: f64 = 0.02;
/// Without a path the needle is bent toward the target for this depth, mm, since a later estimate may give a path.
const WITHOUT_PATH_MAX_MM: f64 = 5.0;
/// After a whole turn of the base, the path may end farther from the target by this much, mm.
const TURN_LOSS_MAX_MM: f64 = 0.05;
/// On a path that does not surely lead to the target, this much of the way ahead must be clear of obstacles, mm; and
/// at least as much as the needle may go before the next step can stop it.
const CLEAR_AHEAD_MM: f64 = 3.0;
/// A new path may be longer than the rest of the last one by this much, mm, …
const LONGER_MAX_MM: f64 = 10.0;
/// … and this share of the rest. A whole circle, which would come back to a target that was missed, is longer.
const LONGER_MAX_SHARE: f64 = 0.25;
/// The way ahead is tested at points at most this far apart, mm.
const AHEAD_SPACING_MM: f64 = 0.25;

/// Keeps the plan of a run. It uses no clock: the budget of each call is a number of expansions.
#[derive(Debug, Clone)]
pub struct Replanner {
    field: Field<'static>,
    route: Route,
    /// Its start is the tip at the last step; its `length_max_mm` is the longest path from there.
    problem: Problem,
    /// The depth that may still be inserted, mm.
    depth_left_mm: f64,
    /// How long a path may be, given the length of the last one found, mm.
    longest_mm: f64,
    /// How far the needle may go on after a stop, mm.
    stopping_mm: f64,
    /// True once a step was made.
    has_begun: bool,
    /// The path of the last step, from where the tip was then.
    path: Option<Path>,
    /// The last path that was found with a well-known position, from where it was found, and how far the tip
    /// has come along it, mm.
    remembered: Option<(Path, f64)>,
    /// The reserve that known paths keep if they can, mm: as much as the path at the start.
    reserve_mm: f64,
    /// The share of the curvature that paths leave unused if they can.
    curvature_margin: f64,
    /// Depth inserted since a path was found, mm.
    without_path_mm: f64,
    /// Nodes that the searches of this step may still expand.
    expansions_left: u32,
}

impl Replanner {
    /// A replanner for `problem`, in which `expansions_max` is the budget of each call. `path` is the plan
    /// with which the run begins, if there is one. Paths leave the share `curvature_margin` of the needle's
    /// curvature unused if they can.
    pub fn new(world: World, problem: Problem, curvature_margin: f64, path: Option<Path>) -> Self {
        let mut field = Field::new(Cow::Owned(world), problem.clearance_mm, problem.in_plane);
        let route = Route::new(&mut field, &problem.target_mm);
        let distance_mm = |path: &Path| path.distance_mm(&field.world);
        let room_mm = path.as_ref().map_or(f64::INFINITY, distance_mm) - problem.clearance_mm;
        Replanner {
            reserve_mm: room_mm.clamp(0.0, RESERVE_MM),
            field,
            route,
            depth_left_mm: problem.length_max_mm,
            longest_mm: path.as_ref().map_or(f64::INFINITY, longest_after_mm),
            stopping_mm: 0.0,
            has_begun: false,
            problem,
            curvature_margin,
            remembered: path.clone().map(|path| (path, 0.0)),
            path,
            without_path_mm: 0.0,
            expansions_left: 0,
        }
    }

    /// The replanner of a needle that may go on by `stopping_mm` after a stop.
    #[must_use]
    pub fn with_stopping_mm(self, stopping_mm: f64) -> Self {
        Replanner { stopping_mm, ..self }
    }

    /// Sets the position of the target, plane frame, mm.
    pub fn set_target(&mut self, target_mm: Vector3<f64>) {
        self.problem.target_mm = target_mm;
    }

    /// The position of the target, plane frame, mm.
    pub fn target_mm(&self) -> Vector3<f64> {
        self.problem.target_mm
    }

    /// The path of the last step; `None` if there was none.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_ref()
    }

    /// The obstacles, and where the tip may be.
    pub fn world(&self) -> &World {
        &self.field.world
    }

    /// Checks, before the first step, that a path of allowed length and of at most `curvature_per_mm` leads from
    /// `start` to the target: the known path, or one that a search finds. The tip was measured at `tip_mm`.
    ///
    /// # Errors
    /// No path was found; the error has the reason, and the reachable point nearest to the target.
    pub fn check_start(
        &mut self,
        start: Tip,
        tip_mm: &Vector3<f64>,
        curvature_per_mm: f64,
    ) -> Result<(), StartRefused> {
        self.begin_at(tip_mm, &start);
        self.problem.start = start;
        self.problem.curvature_per_mm = curvature_per_mm;
        let last = self.path.as_ref().map(|path| rest_of(path, 0.0, start));
        let length_max_mm = self.problem.length_max_mm;
        let known = self.known(last.as_ref()).filter(|path| path.length_mm() <= length_max_mm);
        if let Some(path) = known {
            self.longest_mm = self.longest_mm.max(longest_after_mm(&path));
            return Ok(());
        }
        let answer = plan_thoroughly(&mut self.field, &self.problem, &self.route);
        let Answer { status, path, reason, nearest_mm, .. } = answer;
        if let Some(path) = path {
            self.longest_mm = self.longest_mm.max(longest_after_mm(&path));
            return Ok(());
        }
        let reason = match status {
            Status::Budget => format!(
                "goal.step_expansions_max, {}, was spent before one was found; raise it",
                self.problem.expansions_max
            ),
            _ => reason.unwrap_or_default(),
        };
        Err(StartRefused { reason, nearest_mm, status })
    }

    /// What to do for the next `step_mm`, from the present `estimate`. Since the last call, the tip was inserted
    /// by `inserted_mm`.
    ///
    /// Known paths are tried first, in this order: one arc to the target; the last path up to some point, then
    /// directly to the target; the sharpest arc toward the target, or the last path as it is, if that ends
    /// within the tolerance; in the plane, back onto the remembered path. They keep the clearance, plus twice the
    /// standard deviation of the position, plus the reserve if a path is left with it. Then a path is searched
    /// for. If that fails and the estimate is so uncertain that the tip may still be on the remembered path, and this
    /// may end within the tolerance, it is followed. The last resort is a known path at the clearance minus twice the
    /// deviation.
    ///
    /// No path is much longer than the rest of the last one that was found. At the end of the path, with the target
    /// beside or behind the tip and no path to it, the tip has arrived, however far off it is.
    pub fn step(&mut self, estimate: &TipEstimate, inserted_mm: f64, step_mm: f64) -> Step {
        let TipEstimate { mut tip, position_sd_mm, heading_sd_rad, .. } = *estimate;
        if self.problem.in_plane {
            tip = in_plane(&tip);
        }
        if !self.has_begun {
            self.begin_at(&estimate.tip.position_mm, &tip);
            self.has_begun = true;
        }
        let error_mm = self.problem.to_target_mm(&estimate.tip.position_mm);
        let ahead_mm = (self.problem.target_mm - tip.position_mm).dot(&tip.heading);
        if ahead_mm <= ARRIVED_MM && error_mm <= self.problem.tolerance_mm.max(step_mm) {
            return Step::Arrived { error_mm };
        }
        self.depth_left_mm = (self.depth_left_mm - inserted_mm).max(0.0);
        // If the next step stops the needle, the needle goes on while it brakes, but no farther than a target ahead.
        let next_mm = step_mm + self.stopping_mm;
        let to_target_mm = if ahead_mm > 0.0 { ahead_mm } else { f64::INFINITY };
        let ways_mm = [step_mm, next_mm].map(|mm| mm.min(to_target_mm));
        if let Some(reason) = self.stop_reason(estimate, &tip, ways_mm) {
            return Step::Stop(reason);
        }
        self.problem.start = tip;
        let last = self.path.take().map(|path| rest_of(&path, inserted_mm, tip));
        let is_at_end = last.as_ref().is_none_or(|last| last.length_mm() <= step_mm);
        self.longest_mm = (self.longest_mm - inserted_mm).max(0.0);
        self.problem.length_max_mm = self.depth_left_mm.min(self.longest_mm);
        if let Some((_, along_mm)) = &mut self.remembered {
            *along_mm += inserted_mm;
        }
        let path = self.find(estimate, next_mm, last.as_ref());
        self.without_path_mm = match path {
            Some(_) => 0.0,
            None => self.without_path_mm + inserted_mm,
        };
        if let Some(path) = &path {
            self.longest_mm = longest_after_mm(path);
            if position_sd_mm <= REMEMBER_SD_MAX_MM {
                self.remembered = Some((path.clone(), 0.0));
            }
        }
        let is_ahead = ahead_mm > ARRIVED_MM;
        let clear_mm = next_mm.max(CLEAR_AHEAD_MM);
        let path = path
            .or_else(|| self.last_path_within_uncertainty(last?, heading_sd_rad, clear_mm))
            .or_else(|| self.nearest_path(estimate))
            .or_else(|| self.toward_target(heading_sd_rad, clear_mm).filter(|_| is_ahead));
        let Some(path) = path else {
            return match is_at_end && !is_ahead {
                true => Step::Arrived { error_mm },
                false => Step::Stop(StopReason::NoPath),
            };
        };
        let first = path.arcs.iter().find(|arc| arc.length_mm > 0.0).copied();
        let first =
            first.unwrap_or(Arc { bend: tip.across()[0], curvature_per_mm: 0.0, length_mm: 0.0 });
        let steer = Steer {
            bend: first.bend,
            curvature_per_mm: mean_curvature_per_mm(&path, &first, step_mm),
            remaining_mm: path.length_mm(),
            error_mm: self.miss_mm(&path),
        };
        self.path = Some(path);
        Step::Steer(steer)
    }

    fn begin_at(&mut self, tip_mm: &Vector3<f64>, start: &Tip) {
        self.field.world.to_mut().workspace.begin_at(*tip_mm, start.position_mm);
    }

    /// The reason why the tip must not go on, if there is one. Checks the estimated tip, the same `tip` moved into the
    /// plane, and the points straight ahead, up to `step_mm` (a step) and up to `stopped_mm` (a step and the stop that
    /// may follow it). While its base turns, the needle may go straight ahead, and off a plane that its path stays in.
    fn stop_reason(
        &self,
        estimate: &TipEstimate,
        tip: &Tip,
        [step_mm, stopped_mm]: [f64; 2],
    ) -> Option<StopReason> {
        let Tip { position_mm, heading } = estimate.tip;
        let world = &self.field.world;
        // However uncertain the estimate is, it must not be in an obstacle.
        let limit_mm =
            |sds: f64| (self.problem.clearance_mm - sds * estimate.position_sd_mm).max(0.0);
        let reason_at = |at: Vector3<f64>, limit_mm: f64, [wall, obstacle]: [StopReason; 2]| {
            if world.workspace.depth_mm(&at) < 0.0 {
                return Some(wall);
            }
            (world.distance_mm(&at) < limit_mm).then_some(obstacle)
        };
        let at_tip = [StopReason::TipOutside, StopReason::TipNearObstacle];
        let here = [position_mm, tip.position_mm];
        let here = here.into_iter().find_map(|at| reason_at(at, limit_mm(SDS), at_tip));
        let here_mm = world.distance_mm(&position_mm);
        let ahead = |way_mm: f64, limit_mm: f64| {
            let points = (way_mm / AHEAD_SPACING_MM).ceil().max(1.0) as u32;
            (1..=points).find_map(|point| {
                let ahead_mm = way_mm * f64::from(point) / f64::from(points);
                // A tip that is already too near must be able to leave.
                let limit_mm = if point == points { limit_mm } else { limit_mm.min(here_mm) };
                // The needle may bend to any side.
                let aside_mm = 0.5 * estimate.curvature_per_mm * ahead_mm * ahead_mm;
                let at = position_mm + heading * ahead_mm;
                let reasons = [StopReason::WallAhead, StopReason::ObstacleAhead];
                reason_at(at, limit_mm + aside_mm, reasons)
            })
        };
        here.or_else(|| ahead(step_mm, limit_mm(NEXT_STEP_SDS)))
            .or_else(|| ahead(stopped_mm, limit_mm(SDS)))
    }

    /// True if a path to the target is left after `turn_mm` straight ahead, the distance that the needle goes while
    /// the base turns once around. The new path must end about as near to the target as the path of the last step,
    /// keep the same distance from obstacles, and leave the curvature margin unused even if the last path does not,
    /// because it must make up for the turn. If the path of the last step ends before the turn does, the way straight
    /// ahead need only be clear.
    pub fn may_turn(&mut self, estimate: &TipEstimate, turn_mm: f64) -> bool {
        let Some(path) = self.path.as_ref() else { return true };
        let (start, remaining_mm) = (path.start, path.length_mm());
        let length_mm = turn_mm.min(remaining_mm);
        let straight = Arc { bend: start.across()[0], curvature_per_mm: 0.0, length_mm };
        let after = start.after(&straight);
        let (rest, miss_mm) = (rest_of(path, turn_mm, after), self.miss_mm(path));
        self.problem.curvature_per_mm = estimate.curvature_per_mm * (1.0 - self.curvature_margin);
        if !self.field.is_clear(&start, &straight) {
            return false;
        }
        if remaining_mm <= turn_mm {
            return true;
        }
        let length_max_mm = self.problem.length_max_mm;
        (self.problem.start, self.problem.length_max_mm) = (after, length_max_mm - turn_mm);
        let path_after = self.known(Some(&rest));
        (self.problem.start, self.problem.length_max_mm) = (start, length_max_mm);
        path_after.is_some_and(|path| self.miss_mm(&path) <= miss_mm + TURN_LOSS_MAX_MM)
    }

    /// Distance of the end of `path` from the target, mm.
    fn miss_mm(&self, path: &Path) -> f64 {
        self.problem.to_target_mm(&path.end().position_mm)
    }

    /// A path whose distance from obstacles suits the uncertainty of the estimate. The searches share one budget; each
    /// may spend half of what remains.
    fn find(&mut self, estimate: &TipEstimate, next_mm: f64, last: Option<&Path>) -> Option<Path> {
        let uncertainty_mm = SDS * estimate.position_sd_mm;
        let (clearance_mm, margin) = (self.problem.clearance_mm, self.curvature_margin);
        let (cautious_mm, tip) = (clearance_mm + uncertainty_mm, self.problem.start);
        self.expansions_left = self.problem.expansions_max;
        let set_limits = |this: &mut Self, clearance_mm, margin| {
            this.field.clearance_mm = clearance_mm;
            this.problem.curvature_per_mm = estimate.curvature_per_mm * (1.0 - margin);
        };
        let known =
            [(cautious_mm + self.reserve_mm, margin), (cautious_mm, margin), (cautious_mm, 0.0)];
        for (clearance_mm, margin) in known {
            set_limits(self, clearance_mm, margin);
            if let Some(path) = self.known(last) {
                return Some(path);
            }
        }
        set_limits(self, cautious_mm, margin);
        let searched = self.search().or_else(|| {
            set_limits(self, clearance_mm, 0.0);
            self.known(last).or_else(|| self.search())
        });
        searched.or_else(|| {
            // A path leads through no obstacle, however uncertain the estimate is.
            let least_mm = (clearance_mm - uncertainty_mm).max(CLEARANCE_MIN_MM.min(clearance_mm));
            set_limits(self, least_mm, 0.0);
            self.remembered_from(tip, estimate, next_mm).or_else(|| self.known(last))
        })
    }

    fn search(&mut self) -> Option<Path> {
        let clearance_mm = self.field.clearance_mm;
        let expansions_max = self.expansions_left.div_ceil(2);
        let problem = Problem { clearance_mm, expansions_max, ..self.problem.clone() };
        let answer = search_only(&mut self.field, &problem, &self.route);
        self.expansions_left -= answer.expansions;
        answer.path
    }

    /// The path that ends nearest to the target, if that is within the tolerance: the searches may have missed it.
    /// This spends the rest of the budget.
    fn nearest_path(&mut self, estimate: &TipEstimate) -> Option<Path> {
        if self.expansions_left == 0 {
            return None;
        }
        let Problem { clearance_mm, tolerance_mm, .. } = self.problem;
        self.field.clearance_mm = clearance_mm;
        self.problem.curvature_per_mm = estimate.curvature_per_mm;
        let expansions_max = self.expansions_left;
        let problem = Problem { expansions_max, ..self.problem.clone() };
        let path = path_to_nearest(&mut self.field, &problem);
        (self.miss_mm(&path) <= tolerance_mm).then_some(path)
    }

    /// The sharpest arc toward the target, if a path was found recently ([`WITHOUT_PATH_MAX_MM`]) and the arc's next
    /// `clear_mm` are clear; or if the whole arc is clear and, given the uncertainty of the heading, may end within the
    /// tolerance.
    fn toward_target(&mut self, heading_sd_rad: f64, clear_mm: f64) -> Option<Path> {
        let path = self.sharpest();
        let was_lately =
            self.without_path_mm < WITHOUT_PATH_MAX_MM && self.begins_clear(&path, clear_mm);
        let may_end_near = self.may_end_near(&path, heading_sd_rad)
            && self.field.is_clear(&path.start, &path.arcs[0]);
        (was_lately || may_end_near).then_some(path)
    }

    /// The `last` path unchanged, if its next `clear_mm` are clear and, given the uncertainty of the heading, it may
    /// end within the tolerance.
    fn last_path_within_uncertainty(
        &mut self,
        last: Path,
        heading_sd_rad: f64,
        clear_mm: f64,
    ) -> Option<Path> {
        let is_free =
            self.may_end_near(&last, heading_sd_rad) && self.begins_clear(&last, clear_mm);
        is_free.then_some(last)
    }

    /// The rest of the remembered path, moved to start at `tip`, if the tip may still be on it, its next `next_mm` are
    /// clear and, given the uncertainty of the heading, it may end within the tolerance: the target may have moved.
    fn remembered_from(&mut self, tip: Tip, estimate: &TipEstimate, next_mm: f64) -> Option<Path> {
        let (path, along_mm) = self.remembered.as_ref()?;
        let (expected, _) = path.at(*along_mm);
        let off_mm = (expected.position_mm - tip.position_mm).norm();
        let off_rad = (expected.heading - tip.heading).norm();
        let may_be_on = off_mm <= SDS * estimate.position_sd_mm + ON_PATH_MM
            && off_rad <= SDS * estimate.heading_sd_rad;
        if !may_be_on || estimate.heading_sd_rad <= HEADING_UNKNOWN_SD_RAD {
            return None;
        }
        let rest = rest_of(path, *along_mm, tip);
        let is_free =
            self.may_end_near(&rest, estimate.heading_sd_rad) && self.begins_clear(&rest, next_mm);
        is_free.then_some(rest)
    }

    fn may_end_near(&self, path: &Path, heading_sd_rad: f64) -> bool {
        self.miss_mm(path) <= self.problem.tolerance_mm + SDS * heading_sd_rad * path.length_mm()
    }

    fn begins_clear(&mut self, path: &Path, ahead_mm: f64) -> bool {
        let mut remaining_mm = ahead_mm;
        path.pieces().all(|(start, arc)| {
            let next = arc.with_length(arc.length_mm.min(remaining_mm));
            remaining_mm -= next.length_mm;
            self.field.is_clear(&start, &next)
        })
    }
}

/// How long the next path may be once `path` was found, mm.
fn longest_after_mm(path: &Path) -> f64 {
    path.length_mm() * (1.0 + LONGER_MAX_SHARE) + LONGER_MAX_MM
}

/// The tip moved into the plane, where the control law will bring it.
fn in_plane(tip: &Tip) -> Tip {
    let flat = |v: &Vector3<f64>| Vector3::new(0.0, v.y, v.z);
    let heading = flat(&tip.heading).try_normalize(1e-9).unwrap_or(Vector3::z());
    Tip { position_mm: flat(&tip.position_mm), heading }
}

/// The rest of `path` after `inserted_mm`, moved to start at `tip`.
fn rest_of(path: &Path, inserted_mm: f64, tip: Tip) -> Path {
    let mut remaining_mm = inserted_mm;
    let mut rest = Vec::new();
    let mut to = tip;
    for (start, arc) in path.pieces() {
        let cut_mm = remaining_mm.min(arc.length_mm);
        remaining_mm -= cut_mm;
        let bend = bend_after(&start, &arc.with_length(cut_mm));
        // The bend must be across the heading that the tip has now.
        let bend = bend - to.heading * bend.dot(&to.heading);
        let bend = bend.try_normalize(1e-9).unwrap_or_else(|| to.across()[0]);
        let arc = Arc { bend, length_mm: arc.length_mm - cut_mm, ..arc };
        to = to.after(&arc);
        rest.push(arc);
    }
    Path { start: tip, arcs: rest }.joined()
}

/// The mean curvature toward the bend of the first arc over the next `step_mm`. If two arcs bend to opposite
/// sides, it is less than the curvature of either.
fn mean_curvature_per_mm(path: &Path, first: &Arc, step_mm: f64) -> f64 {
    let mut remaining_mm = step_mm.min(path.length_mm());
    let whole_mm = remaining_mm;
    let mut turn_rad = 0.0;
    for (_, arc) in path.pieces() {
        let length_mm = remaining_mm.min(arc.length_mm);
        turn_rad += arc.curvature_per_mm * length_mm * arc.bend.dot(&first.bend);
        remaining_mm -= length_mm;
    }
    if whole_mm > 0.0 { turn_rad / whole_mm } else { 0.0 }
}

#[cfg(test)]
mod tests;
