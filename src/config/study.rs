//! `[study]`: the ranges from which the trials of a study are drawn.

use super::emulator::TIP_PITCH;
use super::{Config, ConfigError, EmulatorConfig, GoalKind};
use crate::emulator::split_mix64;
use crate::geometry::{POSITION, Pose, TURN};
use crate::keys::{Field, Words, find, over, section, within};
use crate::math;
use crate::needle::{HALF_WIDTH, HALF_WIDTH_PER_MM, OFFSET};
use crate::plan::Workspace;
use crate::study::Prior;
use nalgebra::{Vector3, Vector4};
use std::f64::consts::TAU;
use toml::{Table, Value};

/// First counter of the random draws of a trial, away from the counters of its noise.
const DRAWS: u64 = 0x5354_5544_5900_0000;
/// First counter of the draws of targets and obstacles; an obstacle is drawn until it has room.
const GOAL_DRAWS: u64 = DRAWS + 0x1000_0000;
/// First counter of the draws of a target's motion.
const DRIFT_DRAWS: u64 = DRAWS + 0x2000_0000;
/// Counter of the draw of the growth of a shaft's creep.
const GROWTH_DRAW: u64 = DRAWS + 0x3000_0000;
/// An obstacle is drawn at most this often.
const TRIES_MAX: u32 = 1000;
/// Variance, mm², of an unknown start position: observers measure it.
const POSITION_UNKNOWN_MM2: f64 = 1e6;

section! {
    /// `[study]`: each key is a lowest and a highest value, between which a value is drawn uniformly. Without
    /// a key the value of `[emulator]` holds.
    pub struct StudyConfig {
        /// Start of the tip, plane frame, mm.
        x_mm: Option<[f64; 2]> [POSITION] = [-8.0, 8.0];
        /// As `x_mm`.
        y_mm: Option<[f64; 2]> [POSITION] = [0.0, 0.0];
        /// As `x_mm`.
        z_mm: Option<[f64; 2]> [POSITION] = [0.0, 0.0];
        /// Start of the tip, plane frame, degrees.
        yaw_deg: Option<[f64; 2]> [TURN] = [-17.0, 17.0];
        /// As `yaw_deg`.
        pitch_deg: Option<[f64; 2]> [TIP_PITCH] = [-11.5, 11.5];
        /// As `yaw_deg`.
        roll_deg: Option<[f64; 2]> [TURN] = [-180.0, 180.0];
        /// Error of the emulated needle's curvature, relative to `[emulator]`.
        curvature_error: Option<[f64; 2]> [within(-0.9, 9.0)] = [0.0, 0.0];
        /// Half-width of the band of the emulated needle's torsion, degrees.
        torsion_half_width_deg: Option<[f64; 2]> [HALF_WIDTH];
        /// Growth with depth of the half-width of the band of the emulated needle's torsion, degrees per mm.
        torsion_half_width_deg_per_mm: Option<[f64; 2]> [HALF_WIDTH_PER_MM];
        /// Offset of the band of the emulated needle's torsion, degrees.
        torsion_offset_deg: Option<[f64; 2]> [OFFSET];
        /// Creep length of the emulated needle's shaft and its growth with depth, each relative to `[emulator]`.
        creep_error: Option<[f64; 2]> [within(-0.9, 9.0)];
        /// With `goal.kind = "target"`: depth of the target, mm.
        target_depth_mm: Option<[f64; 2]> [over(0.0, 1000.0)];
        /// Distance of the target from the axis, as a share of what one arc of the needle reaches at that depth
        /// within the workspace; to either side in the plane, in any direction in space.
        target_share: Option<[f64; 2]> [within(0.0, 1.0)] = [0.0, 0.9];
        /// With `goal.tool`: how far the target moves, in any direction that the goal allows, until the needle
        /// reaches the depth at which the target was drawn, mm.
        target_move_mm: Option<[f64; 2]> [within(0.0, 100.0)];
        /// Number of spheres drawn between start and target, in addition to `goal.obstacle`. With
        /// `goal.in_plane` their centres are in the plane. None is nearer to start or target than
        /// `goal.clearance_mm`.
        obstacles: Option<u32> [within(0.0, 100.0)] = 0;
        /// Radius of those spheres, mm.
        obstacle_radius_mm: Option<[f64; 2]> [over(0.0, 1000.0)] = [5.0, 20.0];
    }
}

/// Largest distance of the centres of drawn obstacles from the straight line to the target, mm, along x and y each.
const ASIDE_MM: f64 = 30.0;
/// Least distance of start and target from drawn obstacles, in addition to the clearance, mm.
const ROOM_MM: f64 = 1.0;

/// A point as a value of the configuration.
fn toml_point(point: &Vector3<f64>) -> Value {
    Value::from(point.iter().copied().collect::<Vec<_>>())
}

/// A uniform random number in [0, 1) for the trial with this `seed`; `number` is the counter of the draw.
fn fraction(seed: u64, number: u64) -> f64 {
    (split_mix64(seed, number) >> 11) as f64 / (1u64 << 53) as f64
}

impl Config {
    /// The configuration of the trial with this seed: the emulated tip's start, the needle and its
    /// torsion drawn from `[study]`, and the seed of the noise.
    ///
    /// # Errors
    /// [`ConfigError`] if `[study]` leaves no room for an obstacle, or may draw a value that its key does not
    /// allow.
    pub fn drawn(&self, seed: u64) -> Result<Config, ConfigError> {
        self.check_relative_errors()?;
        let mut toml = self.toml.clone();
        let emulator = &mut toml["emulator"];
        // Each range has its own counter, so adding a range at the end does not change the draws of the others.
        for (number, key) in (DRAWS..).zip(StudyConfig::KEYS) {
            if key.name.starts_with("target") || key.name.starts_with("obstacle") {
                continue;
            }
            let Some([low, high]) = self.range(key.name) else { continue };
            let draw = |number| low + (high - low) * fraction(seed, number);
            let drawn = draw(number);
            match key.name {
                "curvature_error" => {
                    let curvature_per_mm = self.emulator.arc.curvature_per_mm() * (1.0 + drawn);
                    if let Some(emulator) = emulator.as_table_mut() {
                        emulator.remove("radius_mm");
                        emulator.insert("curvature_per_mm".to_owned(), curvature_per_mm.into());
                    }
                }
                "creep_error" => {
                    let torsion = self.emulator.torsion;
                    emulator["torsion"]["creep_mm"] = (torsion.creep_mm * (1.0 + drawn)).into();
                    let growth = torsion.creep_mm_per_mm * (1.0 + draw(GROWTH_DRAW));
                    emulator["torsion"]["creep_mm_per_mm"] = growth.into();
                }
                name => match name.strip_prefix("torsion_") {
                    Some(name) => emulator["torsion"][name] = drawn.into(),
                    None => emulator["start"][name] = drawn.into(),
                },
            }
        }
        emulator["seed"] = i64::try_from(seed).unwrap_or(i64::MAX).into();
        if self.goal.kind == GoalKind::Target {
            let start = Pose::take(toml["emulator"].get("start"));
            let target_mm = self.draw_goal(seed, &start, &mut toml["goal"])?;
            if let Some([low, high]) = self.study.target_move_mm {
                let drawn = |number| fraction(seed, DRIFT_DRAWS + number);
                let move_mm = low + (high - low) * drawn(0);
                let (sin, cos) = math::sin_cos(TAU * drawn(1));
                let along = if self.goal.in_plane { 0.0 } else { 2.0 * drawn(2) - 1.0 };
                let across = (1.0 - along * along).sqrt();
                let direction = Vector3::new(along, across * sin, across * cos);
                let drift_mm_per_mm = direction * (move_mm / target_mm.norm());
                toml["emulator"]["target_drift_mm_per_mm"] = toml_point(&drift_mm_per_mm);
            }
        }
        Ok(Config::of(toml))
    }

    /// Checks that no relative error takes a value out of the range of its key: the record of such a run could
    /// not be read. The reader of configurations does not check this, since the configuration of a trial contains
    /// both the error and the value drawn with it.
    fn check_relative_errors(&self) -> Result<(), String> {
        let torsion = self.emulator.torsion;
        for (error, name, emulated) in [
            ("curvature_error", "curvature_per_mm", self.emulator.arc.curvature_per_mm()),
            ("creep_error", "torsion.creep_mm", torsion.creep_mm),
            ("creep_error", "torsion.creep_mm_per_mm", torsion.creep_mm_per_mm),
        ] {
            let key = find(EmulatorConfig::KEYS, name);
            let (Some([low, high]), Some(key)) = (self.range(error), key) else { continue };
            let range = key.kind.range(&key.rule);
            for drawn in [low, high].map(|error| emulated * (1.0 + error)) {
                if range.is_some_and(|range| !range.contains(drawn)) {
                    return Err(format!(
                        "study.{error} = [{low}, {high}] may draw emulator.{name} = {drawn}, allowed: {}",
                        Words::of_key(&key).allowed
                    ));
                }
            }
        }
        Ok(())
    }

    /// Draws target and obstacles of the trial with this seed, which begins at `start`. Returns the target in the
    /// plane frame, mm.
    fn draw_goal(&self, seed: u64, start: &Pose, goal: &mut Value) -> Result<Vector3<f64>, String> {
        let study = &self.study;
        let mut number = GOAL_DRAWS;
        let mut draw = |low: f64, high: f64| {
            number += 1;
            low + (high - low) * fraction(seed, number)
        };
        let Workspace { min_mm: min, max_mm: max, .. } = self.goal.workspace_mm;
        let mut target_mm = self.goal.position_mm.unwrap_or_default();
        if let Some([low, high]) = study.target_depth_mm {
            let depth_mm = draw(low, high);
            let [low, high] = study.target_share.unwrap_or_default();
            let (share, turn) = (draw(low, high), draw(0.0, TAU));
            let aside = match self.goal.in_plane {
                true => Vector3::new(0.0, math::cos(turn).signum(), 0.0),
                false => Vector3::new(math::sin(turn), math::cos(turn), 0.0),
            };
            let radius_mm = self.needle.arc.curvature_per_mm().recip();
            let arc_mm = match depth_mm < radius_mm {
                true => radius_mm - (radius_mm * radius_mm - depth_mm * depth_mm).sqrt(),
                false => radius_mm,
            };
            let room_mm = |axis: usize| {
                let wall_mm = if aside[axis] < 0.0 { -min[axis] } else { max[axis] };
                wall_mm / aside[axis].abs()
            };
            let reach_mm = arc_mm.min(room_mm(0)).min(room_mm(1));
            target_mm = aside * (share * reach_mm) + Vector3::z() * depth_mm;
            goal["position_mm"] = toml_point(&target_mm);
        }
        let [low, high] = study.obstacle_radius_mm.unwrap_or_default();
        let obstacles = study.obstacles.unwrap_or_default();
        // With `in_plane` the path begins in the plane.
        let mut start_mm = start.translation;
        if self.goal.in_plane {
            start_mm.x = 0.0;
        }
        let mut drawn = goal["obstacle"].as_array().cloned().unwrap_or_default();
        for obstacle in 1..=obstacles {
            let mut tries = (0..TRIES_MAX).map(|_| {
                let radius_mm = draw(low, high);
                let mut centre_mm = start_mm + (target_mm - start_mm) * draw(0.0, 1.0);
                let aside = [draw(-ASIDE_MM, ASIDE_MM), draw(-ASIDE_MM, ASIDE_MM)];
                centre_mm += Vector3::new(aside[0], aside[1], 0.0);
                if self.goal.in_plane {
                    centre_mm.x = 0.0;
                }
                (centre_mm, radius_mm)
            });
            let has_room = |(centre_mm, radius_mm): &(Vector3<f64>, f64)| {
                let room_mm = radius_mm + self.goal.clearance_mm + ROOM_MM;
                [start_mm, target_mm].iter().all(|end_mm| (centre_mm - end_mm).norm() >= room_mm)
            };
            let (centre_mm, radius_mm) = tries.find(has_room).ok_or_else(|| {
                format!(
                    "study.obstacle_radius_mm = [{low}, {high}]: of {TRIES_MAX} spheres drawn for obstacle \
                     {obstacle} of study.obstacles, each came within goal.clearance_mm and {ROOM_MM} mm of \
                     start or target; draw smaller ones"
                )
            })?;
            let shape = ("shape".to_owned(), Value::from("sphere"));
            let centre = ("centre_mm".to_owned(), toml_point(&centre_mm));
            let radius = ("radius_mm".to_owned(), Value::from(radius_mm));
            drawn.push(Value::Table(Table::from_iter([shape, centre, radius])));
        }
        goal["obstacle"] = Value::Array(drawn);
        Ok(target_mm)
    }

    /// The range at this `key` of `[study]`, in the key's unit; `None` if it is not given.
    pub(super) fn range(&self, key: &str) -> Option<[f64; 2]> {
        let range = self.value_at(&format!("study.{key}"));
        range.filter(|range| range.is_array()).map(|range| Field::take(Some(range)))
    }

    /// The prior uncertainty of a trial, for the information bound: the spread of what the study draws, or
    /// the standard deviations configured for the steering observer, whichever is larger. The bound depends
    /// on it, since no estimate can be better than its prior allows.
    pub fn prior(&self) -> Prior {
        let study = &self.study;
        let variance =
            |range: Option<[f64; 2]>| range.map_or(0.0, |[low, high]| (high - low).powi(2) / 12.0);
        let deg2 = |range| variance(range) * 1f64.to_radians().powi(2);
        let curvature_per_mm = self.emulator.arc.curvature_per_mm();
        let (start_sd, curvature_sd) = self.observer.steering().start_sd().unwrap_or_default();
        let configured_rad2 =
            Vector3::new(start_sd.yaw, start_sd.pitch, start_sd.roll).map(|sd| sd * sd);
        let angles_rad2 =
            Vector3::new(deg2(study.yaw_deg), deg2(study.pitch_deg), deg2(study.roll_deg));
        Prior {
            position_mm2: POSITION_UNKNOWN_MM2,
            angles_rad2: angles_rad2.sup(&configured_rad2),
            parameters: Vector4::new(
                variance(study.curvature_error).max(curvature_sd.powi(2))
                    * curvature_per_mm.powi(2),
                deg2(study.torsion_half_width_deg),
                deg2(study.torsion_half_width_deg_per_mm),
                deg2(study.torsion_offset_deg),
            ),
        }
    }
}
