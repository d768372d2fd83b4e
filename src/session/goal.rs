//! Steering to a target: each step plans the path again, and a control law follows it.

use super::config::SessionConfig;
use super::target::TargetTool;
use crate::control::{Bend, BendLaw, Command};
use crate::geometry::Pose;
use crate::observer::Estimate;
use crate::plan::{
    self, Path, Problem, Replanner, RoomyPath, StartRefused, Status, Step, Tip, World,
    plan_with_reserve,
};
use nalgebra::Vector3;

/// A target, the obstacles, and the path with which a run begins.
#[derive(Debug, Clone, PartialEq)]
pub struct Goal {
    /// The obstacles.
    pub world: World,
    /// The target, and the limits of a path; `expansions_max` is the budget of each step.
    pub problem: Problem,
    /// The share of the needle's curvature that a path leaves unused.
    pub curvature_margin: f64,
    /// The path planned before the run.
    pub path: Path,
    /// The target's tool, if the tracker sees the target.
    pub tool: Option<TargetTool>,
}

impl Goal {
    /// Plans the path with which the run begins, with at most `problem.expansions_max` expansions. The path
    /// stays at least `reserve_mm` farther from the obstacles than the clearance. Each step of the run may spend
    /// `step_expansions_max` expansions.
    ///
    /// # Errors
    /// Why no path is found, and the reachable point that is nearest to the target.
    pub fn new(
        mut world: World,
        problem: Problem,
        reserve_mm: f64,
        curvature_margin: f64,
        step_expansions_max: u32,
    ) -> Result<Self, String> {
        let (shortest, target_mm) = (plan::plan(&world, &problem), problem.target_mm);
        let roomy = plan_with_reserve(&world, &problem, reserve_mm, &shortest);
        let RoomyPath { path, .. } = roomy.map_err(|reason| {
            let nearest = shortest.nearest_mm.filter(|_| shortest.path.is_none());
            let nearest = nearest.map(|at| explain_nearest(&at, &target_mm, shortest.status));
            let may_bend_too_little = || {
                let clearance_mm = problem.clearance_mm + reserve_mm;
                let curvature_per_mm = problem.curvature_per_mm / (1.0 - curvature_margin);
                let whole = Problem { clearance_mm, curvature_per_mm, ..problem.clone() };
                let keeps_reserve = || plan::plan(&world, &whole).path.is_some();
                shortest.may_bend_too_little || shortest.path.is_some() && keeps_reserve()
            };
            let hint = (curvature_margin > 0.0 && may_bend_too_little()).then(|| {
                format!(
                    "; {curvature_margin} of the curvature is left unused, see goal.curvature_margin"
                )
            });
            format!("goal: {reason}{}{}", nearest.unwrap_or_default(), hint.unwrap_or_default())
        })?;
        let problem = Problem { expansions_max: step_expansions_max, ..problem };
        world.workspace.start_mm = Some([problem.start.position_mm; 2]);
        Ok(Goal { world, problem, curvature_margin, path, tool: None })
    }

    /// Sets the position of the target, plane frame, mm. A path in the plane leads to the point of the plane that
    /// is nearest to it.
    pub(super) fn set_target(&mut self, target_mm: Vector3<f64>) {
        let x_mm = if self.problem.in_plane { 0.0 } else { target_mm.x };
        self.problem.target_mm = Vector3::new(x_mm, target_mm.y, target_mm.z);
    }

    /// A replanner that begins with the path planned before the run.
    fn replanner(&self) -> Replanner {
        let (world, problem) = (self.world.clone(), self.problem.clone());
        Replanner::new(world, problem, self.curvature_margin, Some(self.path.clone()))
    }

    /// Checks that a path leads to the target from a tip that is seen at `tip_mm`, plane frame, with the assumed
    /// heading.
    ///
    /// # Errors
    /// The reason, in words.
    pub(super) fn check_start(&self, tip_mm: &Vector3<f64>) -> Result<(), String> {
        self.check_start_with(&mut self.replanner(), tip_mm)
    }

    /// As [`Goal::check_start`], with a replanner that has not made a step yet.
    fn check_start_with(
        &self,
        replanner: &mut Replanner,
        tip_mm: &Vector3<f64>,
    ) -> Result<(), String> {
        let Problem { mut start, clearance_mm, curvature_per_mm, in_plane, .. } = self.problem;
        start.position_mm = *tip_mm;
        if in_plane {
            start.position_mm.x = 0.0;
        }
        let whole_per_mm = curvature_per_mm / (1.0 - self.curvature_margin);
        let seen = shown(tip_mm);
        replanner.check_start(start, tip_mm, whole_per_mm).map_err(
            |StartRefused { reason, nearest_mm, status }| {
                let target_mm = replanner.target_mm();
                let nearest = nearest_mm.map(|at| explain_nearest(&at, &target_mm, status));
                let nearest = nearest.unwrap_or_default();
                format!(
                    "no path to the target from {seen}, where the tip is seen: {reason}{nearest}"
                )
            },
        )?;
        // The path begins in the plane, but the tip may be off the plane.
        if replanner.world().slack_mm(tip_mm, clearance_mm) < 0.0 {
            return Err(format!(
                "the tip is seen at {seen}, off the plane, and nearer to an obstacle than \
                 goal.clearance_mm, {clearance_mm}, or outside goal.workspace_mm"
            ));
        }
        Ok(())
    }
}

/// The nearest point to a target that no path reaches, and its distance from the target, in words.
fn explain_nearest(at_mm: &Vector3<f64>, target_mm: &Vector3<f64>, status: Status) -> String {
    let what = match status {
        Status::Budget => "the nearest point that was reached",
        _ => "the nearest point found",
    };
    let (at, off_mm) = (shown(at_mm), (at_mm - target_mm).norm());
    format!("; {what} is {at}, {off_mm:.1} mm from the target")
}

fn shown(at_mm: &Vector3<f64>) -> String {
    format!("[{:.1}, {:.1}, {:.1}]", at_mm.x, at_mm.y, at_mm.z)
}

/// Distances to the target and the obstacles at a step, and the path to the target.
#[derive(Debug, Clone, PartialEq)]
pub struct Approach {
    /// The target, plane frame, mm.
    pub target_mm: Vector3<f64>,
    /// Distance of the estimated tip from the target, mm.
    pub distance_mm: f64,
    /// The least distance of the estimated tip from an obstacle since the step before, mm; infinite without
    /// obstacles.
    pub clearance_mm: f64,
    /// Distance from the target at the end of the path, mm.
    pub error_mm: f64,
    /// Its standard deviation, mm: that of the position, and that of the heading over the rest of the path, in
    /// their worst directions, as if nothing more were corrected. `None` if the observer states none.
    pub error_sd_mm: Option<f64>,
    /// The path from here to where the insertion ends.
    pub path: Option<Path>,
}

/// The pursuit of a target: the replanner, and the law that follows its path.
pub struct Pursuit {
    replanner: Replanner,
    law: BendLaw,
    goal: Goal,
    /// Position of the target, plane frame, mm; it may be off the plane.
    target_mm: Vector3<f64>,
    /// The estimated tip at the last step.
    tip_before: Option<Pose>,
    /// Depth at the replanner's last step, mm.
    planned_at_mm: f64,
    /// The needle's curvature as configured, per mm.
    curvature_per_mm: f64,
    /// How far the needle may go on after a stop, mm.
    stopping_mm: f64,
}

impl Pursuit {
    /// The law is nested saturation: the configuration refuses a target with another one.
    pub fn new(goal: Goal, config: &SessionConfig) -> Self {
        let SessionConfig { needle, control, .. } = config;
        let stopping_mm = config.insertion.stopping_mm(&config.stage);
        Pursuit {
            replanner: goal.replanner().with_stopping_mm(stopping_mm),
            law: BendLaw::new(*needle, control.nested_saturation),
            target_mm: goal.problem.target_mm,
            goal,
            tip_before: None,
            planned_at_mm: 0.0,
            curvature_per_mm: needle.curvature_per_mm(),
            stopping_mm,
        }
    }

    /// Sets the position of the target, plane frame, mm.
    pub(super) fn set_target(&mut self, target_mm: Vector3<f64>) {
        self.target_mm = target_mm;
        self.goal.set_target(target_mm);
        self.replanner.set_target(self.goal.problem.target_mm);
    }

    /// Checks, before the first step, that a path may end at the target, and that a path leads there from a tip
    /// that is seen at `tip_mm`, plane frame.
    ///
    /// # Errors
    /// The reason, in words.
    pub(super) fn check_start(&mut self, tip_mm: &Vector3<f64>) -> Result<(), String> {
        self.check_on_plane()?;
        self.goal.check_start_with(&mut self.replanner, tip_mm)
    }

    /// Checks that a path in the plane may end at the target.
    fn check_on_plane(&self) -> Result<(), String> {
        let Problem { target_mm, tolerance_mm, .. } = self.goal.problem;
        let off_mm = (self.target_mm - target_mm).norm();
        if off_mm > tolerance_mm {
            return Err(format!(
                "the target is {off_mm:.1} mm off the plane (limit goal.tolerance_mm, {tolerance_mm})"
            ));
        }
        Ok(())
    }

    /// Checks that the target has not moved to where no path may end.
    fn check_target(&self) -> Result<(), String> {
        self.check_on_plane()?;
        let Problem { target_mm, tolerance_mm, clearance_mm, .. } = self.goal.problem;
        let world = &self.goal.world;
        let slack_mm = world.slack_upper_bound_mm(&target_mm, clearance_mm) + tolerance_mm;
        if slack_mm < 0.0 {
            return Err(format!(
                "the target has moved {:.1} mm too far: out of goal.workspace_mm, or into the clearance \
                 of an obstacle",
                -slack_mm
            ));
        }
        Ok(())
    }

    /// The approach at the end of the insertion, without a path.
    pub(super) fn end(&mut self, estimate: &Estimate) -> Approach {
        let (target_mm, tip) = (self.target_mm, estimate.x_pb);
        let distance_mm = (tip.translation - target_mm).norm();
        let before = self.tip_before.replace(tip).unwrap_or(tip);
        let clearance_mm = self.goal.world.distance_on_way_mm(&before, &tip);
        let error_sd_mm = estimate.worst_sd().map(|(position_sd_mm, _)| position_sd_mm);
        let error_mm = distance_mm;
        Approach { target_mm, distance_mm, clearance_mm, error_mm, error_sd_mm, path: None }
    }

    /// The approach at a step that stops the run. Its clearance covers the braking distance as well.
    pub(super) fn stopped(&mut self, estimate: &Estimate) -> Approach {
        let end = self.end(estimate);
        let ahead = Pose { translation: Vector3::z() * self.stopping_mm, ..Pose::identity() };
        let after = estimate.x_pb * ahead;
        let straight_mm = self.goal.world.distance_on_way_mm(&estimate.x_pb, &after);
        // While it stops, the needle may bend to any side.
        let aside_mm = 0.5 * self.curvature_per_mm * self.stopping_mm * self.stopping_mm;
        Approach { clearance_mm: end.clearance_mm.min(straight_mm - aside_mm), ..end }
    }

    /// Plans from `estimate` at `depth_mm` on. The command is `None` once the tip has arrived.
    ///
    /// # Errors
    /// If the run must be stopped, the command is the reason, in words.
    pub fn step(
        &mut self,
        estimate: &Estimate,
        depth_mm: f64,
        step_mm: f64,
    ) -> (Approach, Result<Option<Command>, String>) {
        let Some((position_sd_mm, heading_sd_rad)) = estimate.worst_sd() else {
            let unknown = "goal: the observer does not state how well it knows the tip";
            return (self.stopped(estimate), Err(unknown.to_owned()));
        };
        let heading = estimate.x_pb.rotation * Vector3::z();
        let nominal_per_mm = self.curvature_per_mm;
        let curvature_per_mm =
            estimate.belief.map_or(nominal_per_mm, |belief| belief.curvature_per_mm);
        let known = plan::TipEstimate {
            tip: Tip { position_mm: estimate.x_pb.translation, heading },
            // An estimate above the configured curvature may be chance.
            curvature_per_mm: curvature_per_mm.clamp(0.1 * nominal_per_mm, nominal_per_mm),
            position_sd_mm,
            heading_sd_rad,
        };
        let inserted_mm = depth_mm - self.planned_at_mm;
        self.planned_at_mm = depth_mm;
        if let Err(error) = self.check_target() {
            return (self.stopped(estimate), Err(format!("goal: {error}")));
        }
        match self.replanner.step(&known, inserted_mm, step_mm) {
            Step::Steer(steer) => {
                let end = self.end(estimate);
                let bend = Bend {
                    toward: steer.bend,
                    curvature_per_mm: steer.curvature_per_mm,
                    remaining_mm: steer.remaining_mm,
                    may_turn: self.replanner.may_turn(&known, self.law.turn_mm()),
                    in_plane: self.goal.problem.in_plane,
                };
                let command = self.law.command(estimate, &bend, step_mm);
                let path = self.replanner.path().cloned();
                let left_mm = path.as_ref().map_or(0.0, Path::length_mm);
                let swing_sd_mm = heading_sd_rad * left_mm;
                let error_sd_mm = Some((position_sd_mm.powi(2) + swing_sd_mm.powi(2)).sqrt());
                let approach = Approach { error_mm: steer.error_mm, error_sd_mm, path, ..end };
                (approach, command.map(Some).map_err(|error| format!("control: {error}")))
            }
            Step::Arrived { .. } => (self.end(estimate), Ok(None)),
            Step::Stop(why) => (self.stopped(estimate), Err(format!("goal: {why}"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::plan::{Mask, Obstacle};

    fn goal(sets: &[&str]) -> Goal {
        let always = ["goal.kind=\"target\"", "goal.position_mm=[0.0, 0.0, 120.0]"];
        let sets: Vec<String> = [&always, sets].concat().into_iter().map(str::to_owned).collect();
        let config = Config::from_sources(&[], &sets).unwrap();
        config.session().unwrap().goal.unwrap()
    }

    /// The hint is for a target that more curvature might reach. What a spent budget found is not all there is.
    #[test]
    fn a_refusal_says_what_can_help() {
        let refusal = |sets: &[&str]| {
            let target = ["goal.kind=\"target\"", "goal.position_mm=[0.0, 0.0, 120.0]"];
            let ball =
                "goal.obstacle=[{ shape=\"sphere\", centre_mm=[0.0, 1.0, 60.0], radius_mm=5.0 }]";
            let sets = [&target, &[ball][..], sets].concat();
            let sets: Vec<String> = sets.into_iter().map(str::to_owned).collect();
            let config = Config::from_sources(&[], &sets).unwrap();
            config.session().expect_err("no path").to_string()
        };
        let [can_help, reachable] = ["see goal.curvature_margin", "the nearest point found is"];
        let said = refusal(&["goal.position_mm=[0.0, 60.0, 70.0]"]);
        assert!(said.contains(can_help) && said.contains(reachable), "{said}");
        let said = refusal(&["goal.position_mm=[0.0, 60.0, 70.0]", "goal.curvature_margin=0"]);
        assert!(!said.contains(can_help), "{said}");
        let said = refusal(&["goal.expansions_max=2"]);
        assert!(said.contains("; the nearest point that was reached is"), "{said}");
        assert!(!said.contains(can_help) && !said.contains(reachable), "{said}");
        let tight =
            "goal.obstacle=[{ shape=\"sphere\", centre_mm=[0.0, 0.0, 60.0], radius_mm=10.0 }]";
        let said = refusal(&[tight, "goal.position_mm=[0.0, 20.0, 120.0]"]);
        assert!(said.contains("set goal.reserve_mm = 0") && said.contains(can_help), "{said}");
        let said = refusal(&["goal.workspace_mm.max=[50.0, 75.0, 120.1]"]);
        assert!(said.contains("0.10 mm from a wall") && said.contains("by up to 0."), "{said}");
        for set in [
            "goal.position_mm=[0.0, 1.0, 62.0]",
            "goal.position_mm=[0.0, 0.0, 200.0]",
            "emulator.start.y_mm=90",
            "goal.reserve_mm=40",
            // Too far for any needle.
            "insertion.depth_mm=100",
        ] {
            let said = refusal(&[set]);
            assert!(!said.contains(can_help), "{said}");
        }
    }

    /// The plan before a run does not know the measured start.
    #[test]
    fn a_tip_that_is_seen_at_an_obstacle_is_refused() {
        let ball =
            "goal.obstacle=[{ shape=\"sphere\", centre_mm=[0.0, 15.0, 5.0], radius_mm=8.0 }]";
        let goal = goal(&[ball]);
        assert_eq!(goal.check_start(&Vector3::new(0.5, -0.4, -0.9)), Ok(()), "as planned");
        let why = goal.check_start(&Vector3::new(0.0, 6.0, 4.0)).unwrap_err();
        assert!(
            why.contains("[0.0, 6.0, 4.0], where the tip is seen: the start is 1.1 mm from"),
            "{why}"
        );
        assert_eq!(goal.check_start(&Vector3::new(3.0, -1.0, 4.0)), Ok(()));
        let why = goal.check_start(&Vector3::new(0.0, 70.0, 60.0)).unwrap_err();
        assert!(why.contains("the target is out of reach"), "{why}");
    }

    /// The known path does not continue from there, and one expansion finds no other.
    #[test]
    fn a_tip_that_is_seen_where_the_budget_finds_no_path_is_refused() {
        let ball =
            "goal.obstacle=[{ shape=\"sphere\", centre_mm=[0.0, 0.0, 60.0], radius_mm=4.0 }]";
        let goal = |budget| goal(&[ball, &format!("goal.step_expansions_max={budget}")]);
        let tip_mm = Vector3::new(0.0, 6.0, 20.0);
        assert_eq!(goal(2000).check_start(&tip_mm), Ok(()));
        let why = goal(1).check_start(&tip_mm).unwrap_err();
        assert!(why.contains("goal.step_expansions_max, 1, was spent"), "{why}");
    }

    /// The start lies on the face z = 0 of the workspace. The tip may start a little outside, also off the plane.
    #[test]
    fn a_tip_that_starts_far_outside_the_workspace_is_refused() {
        let goal = goal(&[]);
        for tip_mm in [[0.5, -0.4, -1.9], [5.0, 5.0, -1.9]] {
            assert_eq!(goal.check_start(&tip_mm.into()), Ok(()));
        }
        let why = goal.check_start(&Vector3::new(0.0, 5.0, -3.1)).unwrap_err();
        assert!(why.contains("outside goal.workspace_mm"), "{why}");
    }

    /// The distance from a mask jumps between voxels, so a path may end near a target that has no slack itself.
    #[test]
    fn a_target_near_a_mask_has_not_moved() {
        let mut goal = goal(&[]);
        // One voxel is occupied. The target lies in the next one, 5.9 mm from the centre of the occupied one.
        let origin_mm = Vector3::new(-8.0, -10.1, 112.0);
        let occupied: Vec<bool> = (0..125).map(|voxel| voxel == 2 + 4 * 5 + 2 * 25).collect();
        let grid = Pose { translation: origin_mm, ..Pose::identity() };
        let mask = Mask::new([5; 3], Vector3::repeat(4.0), &occupied, &grid).unwrap();
        goal.world.obstacles.push(Obstacle::Mask(mask));
        let slack_mm = goal.world.slack_mm(&goal.problem.target_mm, 2.0);
        assert!(slack_mm + goal.problem.tolerance_mm < 0.0, "{slack_mm}");
        let config = Config::from_sources(&[], &[]).unwrap().session().unwrap();
        assert_eq!(Pursuit::new(goal, &config).check_target(), Ok(()));
    }

    #[test]
    fn the_depth_limits_the_length_of_the_path() {
        let goal = goal(&["insertion.depth_mm=130"]);
        assert!((goal.path.length_mm() - 120.0).abs() < 1e-6);
        assert_eq!(goal.problem.length_max_mm, 130.0);
        assert_eq!(goal.problem.expansions_max, 2000);
    }
}
