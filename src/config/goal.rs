//! `[goal]`: where the needle is steered: into the plane, or to a target around obstacles.

use super::reader::{Reader, contradictions};
use super::tracker::FILE;
use super::{Config, ConfigError, TrackerSource};
use crate::control::ControlKind;
use crate::geometry::{POSITION, Pose};
use crate::keys::{Rule, choice, join, not_blank, over, section, within};
use crate::plan::{CLEARANCE_MIN_MM, Obstacle, Problem, Tip, Workspace, World};
use crate::session::{Goal, TargetTool};
use crate::text::clipped;
use crate::tracker::gate::are_cut_alike;
use crate::tracker::openigtlink::DEVICE_NAME_LEN;
use crate::tracker::{Gate, Registration};
use nalgebra::Vector3;
use std::path::Path;
use std::time::Duration;

section! {
    /// `[goal]`: where the needle is steered. All places are in the plane frame.
    pub struct GoalConfig {
        /// Where the needle is steered: into the plane or to a target.
        kind: GoalKind = "plane";
        /// The target, mm. With `in_plane` its x is 0.
        position_mm: Option<Vector3<f64>> [POSITION];
        /// The name of the target's own tool on the tracker's stream; then `position_mm` is where the target
        /// is expected.
        tool: Option<String> [not_blank("the name of a tool")];
        /// How far from `position_mm` that tool may be, mm.
        tool_range_mm: f64 [over(0.0, 1000.0)] = 10.0;
        /// The target is the mean of that tool's positions over this long. One that moves is seen half of it
        /// too late, and `target_error_est_mm` does not contain that.
        tool_average as "tool_average_s": Duration [within(0.01, 60.0)] = 1.0;
        /// How far from the target a path may end, mm.
        tolerance_mm: f64 [over(0.0, 100.0)] = 1.0;
        /// The path stays in the plane x = 0, where the control law keeps the needle.
        in_plane: bool = true;
        /// How near the path may come to an obstacle, mm. With obstacles at least 0.1.
        clearance_mm: f64 [within(0.0, 100.0)] = 2.0;
        /// Additional clearance of the path with which a run begins, mm. With less, the tracker's noise or a
        /// turn of the needle may leave no path.
        reserve_mm: f64 [within(0.0, 100.0)] = 0.5;
        /// Only with a target: the box that the tip must not leave, without a clearance to its walls, mm.
        workspace_mm: Workspace =>
            "{ min = [-50.0, -75.0, 0.0], max = [50.0, 75.0, 150.0] }";
        /// The share of the needle's curvature that a plan leaves unused, as a reserve for what the model does
        /// not know. If it is not given, it is 0.15 with obstacles and 0 without.
        curvature_margin: Option<f64> [within(0.0, 0.9)];
        /// How many steps of the search a plan may take.
        expansions_max: u32 [within(1.0, 1e8)] = 2000000;
        /// How many steps of the search each step of a run may take, all searches together.
        step_expansions_max: u32 [within(1.0, 1e8)] = 2000;
        /// An obstacle that the path avoids; repeat the table for each.
        obstacle: Vec<ObstacleConfig> [Rule::Fields("shape and its measures")] = [];
    }
}

const CRC32: Rule = within(0.0, u32::MAX as f64);

section! {
    /// `[[goal.obstacle]]`: a shape, with the keys of that shape.
    pub struct ObstacleConfig {
        /// Its shape.
        shape: ObstacleShape;
        /// Centre of a sphere, mm.
        centre_mm: Option<Vector3<f64>> [POSITION];
        /// Radius of a sphere or a cylinder, mm.
        radius_mm: Option<f64> [over(0.0, 10_000.0)];
        /// Middle of one flat end of a cylinder, mm.
        from_mm: Option<Vector3<f64>> [POSITION];
        /// Middle of its other end, mm.
        to_mm: Option<Vector3<f64>> [POSITION];
        /// Corner of a box with the smallest coordinates, mm.
        min_mm: Option<Vector3<f64>> [POSITION];
        /// Corner of a box with the largest coordinates, mm.
        max_mm: Option<Vector3<f64>> [POSITION];
        /// Mask: a NIfTI image, `.nii` or `.nii.gz`; a voxel that is not 0 is part of the obstacle.
        /// The path is relative to the configuration's folder.
        file: Option<String> [FILE];
        /// CRC-32 of the mask's file: a file with another CRC is refused. A run records it.
        crc32: Option<u32> [CRC32];
        /// Pose of the mask's voxels. Voxel (i, j, k) has its centre at i, j, k times the spacing
        /// in the image's header; the header's own origin is not used.
        pose: Option<Pose>;
    }
}

choice! {
    /// Where the needle is steered.
    pub enum GoalKind {
        /// The plane: the tip comes into it and stays.
        Plane = "plane",
        /// A target, around obstacles; needs control.kind = "nested-saturation".
        Target = "target",
    }
}

choice! {
    /// The shape of an obstacle.
    pub enum ObstacleShape {
        /// A ball.
        Sphere = "sphere",
        /// A cylinder with flat ends.
        Cylinder = "cylinder",
        /// A box along the axes.
        Box = "box",
        /// Voxels of an image.
        Mask = "mask",
    }
}

impl ObstacleShape {
    /// The keys that an obstacle of this shape has.
    fn keys(self) -> &'static [&'static str] {
        match self {
            ObstacleShape::Sphere => &["centre_mm", "radius_mm"],
            ObstacleShape::Cylinder => &["from_mm", "to_mm", "radius_mm"],
            ObstacleShape::Box => &["min_mm", "max_mm"],
            ObstacleShape::Mask => &["file", "crc32", "pose"],
        }
    }
}

/// Reads the mask in a file, which must have this CRC-32 if one is given, and places it by a pose. The error
/// says in words what went wrong.
pub type ReadMask<'a> = &'a dyn Fn(&str, Option<u32>, &Pose) -> Result<Obstacle, String>;

impl ObstacleConfig {
    /// Builds the obstacle; it must have all keys that its shape needs.
    ///
    /// # Errors
    /// The mask cannot be read.
    fn to_obstacle(&self, read_mask: ReadMask<'_>) -> Result<Obstacle, String> {
        let [centre_mm, from_mm, to_mm, min_mm, max_mm] =
            [self.centre_mm, self.from_mm, self.to_mm, self.min_mm, self.max_mm]
                .map(Option::unwrap_or_default);
        let radius_mm = self.radius_mm.unwrap_or_default();
        let file = self.file.as_deref().unwrap_or_default();
        match self.shape {
            ObstacleShape::Sphere => Ok(Obstacle::Sphere { centre_mm, radius_mm }),
            ObstacleShape::Cylinder => Ok(Obstacle::Cylinder { from_mm, to_mm, radius_mm }),
            ObstacleShape::Box => Ok(Obstacle::Box { min_mm, max_mm }),
            ObstacleShape::Mask => {
                read_mask(file, self.crc32, &self.pose.unwrap_or(Pose::identity()))
            }
        }
    }
}

/// True if each coordinate of `min_mm` is under that of `max_mm`.
pub(super) fn is_box(min_mm: &Vector3<f64>, max_mm: &Vector3<f64>) -> bool {
    min_mm.zip_map(max_mm, |min, max| min < max).iter().all(|is_less| *is_less)
}

impl GoalConfig {
    /// The share of the needle's curvature that a plan leaves unused. A path around obstacles that needs the
    /// full curvature cannot be corrected: without a margin 6% of the runs fail (docs/targets.md).
    pub(crate) fn curvature_margin(&self) -> f64 {
        let default = if self.obstacle.is_empty() { 0.0 } else { 0.15 };
        self.curvature_margin.unwrap_or(default)
    }
}

impl Config {
    /// The target of a run, with the path planned to it; `None` if the needle is steered into the plane.
    ///
    /// # Errors
    /// Those of [`Config::to_plan`]. The inner error says why there is no path.
    pub fn to_goal(
        &self,
        read_mask: ReadMask<'_>,
    ) -> Result<Result<Option<Goal>, String>, ConfigError> {
        if self.goal.kind == GoalKind::Plane {
            return Ok(Ok(None));
        }
        let (world, problem) = self.to_plan(read_mask)?;
        let GoalConfig { reserve_mm, step_expansions_max, .. } = self.goal;
        let curvature_margin = self.goal.curvature_margin();
        let tool = self.target_tool(problem.target_mm)?;
        if let Err(why) = self.check_wall(&world, &problem) {
            return Ok(Err(why));
        }
        let goal = Goal::new(world, problem, reserve_mm, curvature_margin, step_expansions_max);
        Ok(goal.map(|goal| Some(Goal { tool, ..goal })))
    }

    /// Checks that the target is further from a wall of the workspace than the needle's stopping distance.
    ///
    /// # Errors
    /// The target is nearer; the text gives both distances.
    pub fn check_wall(&self, world: &World, problem: &Problem) -> Result<(), String> {
        let wall_mm = world.workspace.depth_mm(&problem.target_mm);
        let stopping_mm = self.insertion.stopping_mm(&self.stage);
        match (0.0..stopping_mm).contains(&wall_mm) {
            true => Err(format!(
                "goal: the target is {wall_mm:.2} mm from a wall of goal.workspace_mm, and a needle that is stopped \
                 goes on by up to {stopping_mm:.2} mm; widen goal.workspace_mm, or insert slower"
            )),
            false => Ok(()),
        }
    }

    /// The tool that marks the target, if one is configured.
    fn target_tool(&self, expected_mm: Vector3<f64>) -> Result<Option<TargetTool>, ConfigError> {
        let Some(tool) = self.goal.tool.clone() else { return Ok(None) };
        let gate = self.tracker.to_gate()?;
        // The tip offset belongs to the needle's sensor, not to the target's.
        let registration = Registration::new(*gate.registration.x_wt());
        let GoalConfig { tool_range_mm: range_mm, tool_average: average, .. } = self.goal;
        let gate = Gate { tool, registration, ..gate };
        Ok(Some(TargetTool { gate, expected_mm, range_mm, average }))
    }

    /// The configuration as a run records it: with the curvature margin and, for each mask, the CRC-32, if `crc32`
    /// can compute it. The path of a mask, which is relative to the folder of the configuration `file`, gets that
    /// folder in front.
    pub fn recorded_beside(&self, file: &Path, crc32: impl Fn(&Path) -> Option<u32>) -> Config {
        let mut toml = self.toml.clone();
        if let (GoalKind::Target, Some(goal)) = (self.goal.kind, toml["goal"].as_table_mut()) {
            goal.insert("curvature_margin".to_owned(), self.goal.curvature_margin().into());
        }
        let obstacles = toml["goal"]["obstacle"].as_array_mut();
        for obstacle in obstacles.into_iter().flatten() {
            let Some(obstacle) = obstacle.as_table_mut() else { continue };
            let Some(mask) = obstacle.get_mut("file") else { continue };
            let path = file.with_file_name(mask.as_str().unwrap_or_default());
            *mask = path.to_string_lossy().into_owned().into();
            if let Some(crc32) = crc32(&path).filter(|_| !obstacle.contains_key("crc32")) {
                obstacle.insert("crc32".to_owned(), i64::from(crc32).into());
            }
        }
        Config::of(toml)
    }

    /// The obstacles and the planning problem. The path starts at `emulator.start` if the tracker is emulated,
    /// else at the origin of the plane frame, with the angles of `observer.start`. With `in_plane` it starts
    /// at x = 0 and without pitch.
    ///
    /// # Errors
    /// There is no target, or a mask cannot be read.
    pub fn to_plan(&self, read_mask: ReadMask<'_>) -> Result<(World, Problem), ConfigError> {
        let goal = &self.goal;
        let target_mm = goal.position_mm.filter(|_| goal.kind == GoalKind::Target);
        let no_target = "goal.kind is \"plane\": a plan needs goal.kind = \"target\"";
        let target_mm = target_mm.ok_or_else(|| no_target.to_owned())?;
        let obstacles = goal.obstacle.iter().enumerate().map(|(i, obstacle)| {
            let made = obstacle.to_obstacle(read_mask);
            made.map_err(|error| format!("goal.obstacle[{i}].file: {error}"))
        });
        let obstacles = obstacles.collect::<Result<_, _>>()?;
        let world = World { obstacles, workspace: goal.workspace_mm };
        let mut angles = self.observer.start;
        let mut position_mm = match self.tip_source() {
            TrackerSource::Emulated => self.emulator.start.translation,
            _ => Vector3::zeros(),
        };
        if goal.in_plane {
            (position_mm.x, angles.pitch) = (0.0, 0.0);
        }
        let start = Tip { position_mm, heading: angles.to_rotation() * Vector3::z() };
        let length_max_mm = self.number("stage.insertion.max_mm");
        let problem = Problem {
            start,
            target_mm,
            tolerance_mm: goal.tolerance_mm,
            curvature_per_mm: self.needle.arc.curvature_per_mm() * (1.0 - goal.curvature_margin()),
            clearance_mm: goal.clearance_mm,
            // `f64::min` ignores NaN.
            length_max_mm: length_max_mm.min(self.insertion.depth_mm),
            in_plane: goal.in_plane,
            expansions_max: goal.expansions_max,
        };
        Ok((world, problem))
    }
}

/// A message shows at most this many characters of a tool's name.
const NAME_SHOWN_MAX: usize = 30;

/// Reports contradictions in `[goal]`.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    let goal = &config.goal;
    let is_target = goal.kind == GoalKind::Target;
    let is_drawn = config.study.obstacles.is_some_and(|obstacles| obstacles > 0);
    contradictions! { reader;
        ["goal.position_mm", "goal.kind"] if is_target && goal.position_mm.is_none() =>
            "goal.kind is \"target\", and goal.position_mm is not given: say where it is";
    }
    for key in [
        "goal.position_mm",
        "goal.tool",
        "goal.obstacle",
        "goal.workspace_mm",
        "study.target_depth_mm",
        "study.obstacles",
    ] {
        contradictions! { reader;
            [key, "goal.kind"] if !is_target && config.is_changed(key) =>
                "{key} has no effect, since goal.kind is \"plane\": set goal.kind = \"target\"";
        }
    }
    let clearance_mm = goal.clearance_mm;
    let has_obstacles = is_drawn || !goal.obstacle.is_empty();
    let registration_sd_mm = config.observer.invariant.registration_sd_mm;
    let is_too_near = has_obstacles && clearance_mm < CLEARANCE_MIN_MM;
    let is_in_doubt =
        has_obstacles && registration_sd_mm > 0.0 && 2.0 * registration_sd_mm >= clearance_mm;
    let has_one_tool = config.tip_source() == TrackerSource::Csv;
    let law = config.control.kind;
    let observer = config.observer.kind;
    let states_sd = config.observer.steering().start_sd().is_some();
    let Workspace { min_mm: min, max_mm: max, .. } = goal.workspace_mm;
    let has_size = is_box(&min, &max);
    let has_plane = min.x <= 0.0 && max.x >= 0.0;
    let aside_mm = goal.position_mm.map_or(0.0, |target_mm| target_mm.x);
    let tools = [goal.tool.as_deref().unwrap_or_default(), &config.tracker.tool];
    let may_be_cut = config.tip_source() != TrackerSource::Ndjson;
    let are_alike = may_be_cut && tools[0] != tools[1] && are_cut_alike(tools[0], tools[1]);
    let [target, tip] = tools.map(|tool| clipped(tool, NAME_SHOWN_MAX));
    contradictions! { reader;
        ["goal.clearance_mm", "goal.obstacle", "study.obstacles"] if is_too_near =>
            "goal.clearance_mm is {clearance_mm}, allowed with obstacles: at least {CLEARANCE_MIN_MM}; with \
             less a path may lead through a thin obstacle";
        ["goal.tool", "tracker.tool"] if goal.tool.as_ref() == Some(&config.tracker.tool) =>
            "goal.tool is tracker.tool, the needle's tip: name the target's own tool";
        ["goal.tool", "tracker.tool"] if are_alike =>
            "goal.tool \"{target}\" and tracker.tool \"{tip}\" have the same first {DEVICE_NAME_LEN} bytes, where \
             OpenIGTLink version 1 cuts a name; rename one";
        ["goal.tool", "tracker.source"] if goal.tool.is_some() && has_one_tool =>
            "goal.tool needs a stream of two tools, and tracker.source = \"csv\" has one";
        ["control.kind", "goal.kind"] if is_target && law != ControlKind::NestedSaturation =>
            "control.kind is \"{law}\", allowed with goal.kind = \"target\": \"nested-saturation\"";
        ["observer.kind", "observer.coupled.gains", "goal.kind"] if is_target && !states_sd =>
            "goal.kind = \"target\" needs an observer that states how well it knows the tip: \"invariant\", or \
             \"coupled\" with observer.coupled.gains = \"fading\"; observer.kind is \"{observer}\"";
        ["goal.clearance_mm", "tracker.registration"] if is_target && is_in_doubt =>
            "goal.clearance_mm is {clearance_mm}, allowed with obstacles: over {:.2}, twice the sd_mm of \
             tracker.registration: the tip may be in an obstacle that seems that far away", 2.0 * registration_sd_mm;
        ["goal.workspace_mm"] if !has_size =>
            "goal.workspace_mm: each coordinate of max must be over that of min";
        ["goal.workspace_mm", "goal.in_plane"] if has_size && goal.in_plane && !has_plane =>
            "goal.workspace_mm does not contain the plane x = 0, to which goal.in_plane keeps the path";
        ["goal.position_mm", "goal.in_plane"] if is_target && goal.in_plane && aside_mm != 0.0 =>
            "goal.position_mm is {aside_mm} mm off the plane, allowed with goal.in_plane: 0; steer in space \
             with goal.in_plane = false";
    }
    for (i, obstacle) in goal.obstacle.iter().enumerate() {
        let (table, shape) = (format!("goal.obstacle[{i}]"), obstacle.shape);
        let is_missing = |key: &&&str| **key != "crc32" && !reader.is_present(&join(&table, key));
        let size = obstacle.min_mm.zip(obstacle.max_mm);
        let wrong = match (shape.keys().iter().find(is_missing), shape) {
            (Some(&key), _) => Some((key, format!("a {shape} needs {key}"))),
            (None, ObstacleShape::Cylinder) if obstacle.from_mm == obstacle.to_mm => {
                Some(("to_mm", "to_mm equals from_mm: a cylinder needs a length".to_owned()))
            }
            (None, ObstacleShape::Box) if size.is_some_and(|(min, max)| !is_box(&min, &max)) => {
                let message = "each coordinate of max_mm must be over that of min_mm";
                Some(("max_mm", message.to_owned()))
            }
            _ => None,
        };
        let others = &ObstacleConfig::KEYS[1..];
        reader.check_own_keys(&table, &format!("a {shape}"), others, shape.keys(), wrong);
    }
}
