//! The goal in the 3-D views: the target, the obstacles, the planned path, and what the tip still reaches.

use super::Logged;
use super::palette::{COMMANDED, GOOD, LIMIT, MEASURED, OUT_OF_REACH};
use super::space::{PLANE, point, quaternion};
use crate::geometry::Pose;
use crate::observer::Estimate;
use crate::plan::{Mask, Obstacle, Problem, Reach, Tip, World, reach_around};
use crate::session::Approach;
use nalgebra::{Rotation3, Vector3};
use rerun::{
    Boxes3D, Cylinders3D, Ellipsoids3D, FillMode, LineStrips3D, Points3D, RecordingStream,
    Transform3D,
};
use std::collections::BTreeMap;
use std::f64::consts::PI;

/// The entity of the target's tolerance.
const TARGET_PATH: &str = "bench/plane/goal/target";
/// Distance between the points of the planned path, mm.
const PLANNED_STEP_MM: f64 = 2.0;
/// Smallest side of the cubes into which a mask is divided for display, mm: each shows one occupied voxel.
const MASK_STEP_MM: f64 = 3.0;
/// Largest number of voxels shown per mask.
const MASK_POINTS_MAX: usize = 50_000;

/// Logs the target with its tolerance, and the obstacles.
pub(super) fn log_goal(stream: &RecordingStream, world: &World, problem: &Problem) -> Logged {
    let ball = |centre_mm: &Vector3<f64>, radius_mm: f64, colour| {
        Ellipsoids3D::from_centers_and_half_sizes([point(centre_mm)], [[radius_mm as f32; 3]])
            .with_colors([colour])
            .with_fill_mode(FillMode::DenseWireframe)
    };
    let target = ball(&problem.target_mm, problem.tolerance_mm, GOOD);
    stream.log_static(TARGET_PATH, &target)?;
    for (i, obstacle) in world.obstacles.iter().enumerate() {
        let path = format!("{PLANE}/goal/obstacle_{i}");
        match obstacle {
            Obstacle::Sphere { centre_mm, radius_mm } => {
                stream.log_static(path, &ball(centre_mm, *radius_mm, LIMIT))?;
            }
            Obstacle::Cylinder { from_mm, to_mm, radius_mm } => {
                let axis = to_mm - from_mm;
                let turn = Rotation3::rotation_between(&Vector3::z(), &axis);
                let turn =
                    turn.unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), PI));
                let cylinder =
                    Cylinders3D::from_lengths_and_radii([axis.norm() as f32], [*radius_mm as f32])
                        .with_centers([point(&((from_mm + to_mm) * 0.5))])
                        .with_quaternions([quaternion(&turn)])
                        .with_colors([LIMIT])
                        .with_fill_mode(FillMode::DenseWireframe);
                stream.log_static(path, &cylinder)?;
            }
            Obstacle::Box { min_mm, max_mm } => {
                let [centre, half] = [(min_mm + max_mm) * 0.5, (max_mm - min_mm) * 0.5];
                let block = Boxes3D::from_centers_and_half_sizes([point(&centre)], [point(&half)])
                    .with_colors([LIMIT]);
                stream.log_static(path, &block)?;
            }
            Obstacle::Mask(mask) => {
                let (points_mm, side_mm) = mask_points(mask, MASK_STEP_MM);
                let points = Points3D::new(points_mm.iter().map(point))
                    .with_colors([LIMIT])
                    .with_radii([side_mm as f32 / 6.0]);
                stream.log_static(path, &points)?;
            }
        }
    }
    Ok(())
}

/// Divides `mask` into cubes of `side_mm`. Returns the centre of one occupied voxel per cube, and the side of the
/// cubes, mm, which is doubled until at most [`MASK_POINTS_MAX`] cubes have an occupied voxel.
fn mask_points(mask: &Mask, side_mm: f64) -> (Vec<Vector3<f64>>, f64) {
    let (mut points_mm, mut last) = (BTreeMap::new(), None);
    for point_mm in mask.occupied_mm() {
        let cube = [0, 1, 2].map(|axis| (point_mm[axis] / side_mm).floor() as i64);
        // Most often the next voxel is in the same cube.
        if last.replace(cube) != Some(cube) {
            points_mm.entry(cube).or_insert(point_mm);
        }
        if points_mm.len() > MASK_POINTS_MAX {
            return mask_points(mask, 2.0 * side_mm);
        }
    }
    (points_mm.into_values().collect(), side_mm)
}

/// Logs the planned path, the target, which may move, and points around the target, coloured by whether one
/// arc from the estimated tip at `insertion_meas_mm` reaches them: green if clear, red if obstructed, blue if out of
/// reach.
pub(super) fn log_approach(
    stream: &RecordingStream,
    goal: Option<&(World, Problem)>,
    approach: &Approach,
    estimate: Option<&Estimate>,
    insertion_meas_mm: f64,
) -> Logged {
    // From the present tip to the target; only the newest is shown, and nothing without a path.
    let points_mm = approach.path.iter().map(|path| path.points_mm(PLANNED_STEP_MM));
    let points = points_mm.map(|path| path.iter().map(point).collect::<Vec<_>>());
    let strips = LineStrips3D::new(points).with_colors([COMMANDED]);
    stream.log("bench/plane/planned", &strips)?;
    let target_mm = approach.target_mm;
    let seen = Points3D::new([point(&target_mm)]).with_colors([MEASURED]).with_radii([0.5]);
    stream.log("bench/plane/goal/target_seen", &seen)?;
    let Some((world, problem)) = goal else { return Ok(()) };
    // The tolerance moves with the target.
    let moved =
        Transform3D::update_fields().with_translation(point(&(target_mm - problem.target_mm)));
    stream.log(TARGET_PATH, &moved)?;
    let Some(estimate) = estimate else { return Ok(()) };
    let Pose { rotation, translation } = estimate.x_pb;
    let tip = Tip { position_mm: translation, heading: rotation * Vector3::z() };
    let length_max_mm = problem.length_max_mm - insertion_meas_mm;
    let curvature_per_mm =
        estimate.belief.map_or(problem.curvature_per_mm, |belief| belief.curvature_per_mm);
    let left = Problem { target_mm, length_max_mm, curvature_per_mm, ..problem.clone() };
    let points = reach_around(world, &left, &tip);
    let colours = points.iter().map(|(_, reach)| match reach {
        Reach::Clear => GOOD,
        Reach::Obstructed => LIMIT,
        Reach::OutOfReach => OUT_OF_REACH,
    });
    let points = Points3D::new(points.iter().map(|(point_mm, _)| point(point_mm)))
        .with_colors(colours)
        .with_radii([0.4]);
    stream.log("bench/plane/goal/reach", &points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use rerun::RecordingStreamBuilder;
    use rerun::log::{Chunk, LogMsg};

    fn mask(size: [usize; 3], spacing_mm: f64) -> Mask {
        let occupied = vec![true; size.iter().product()];
        let x_pg = Pose { translation: Vector3::new(-3.0, 1.0, 7.0), ..Pose::identity() };
        Mask::new(size, Vector3::repeat(spacing_mm), &occupied, &x_pg).unwrap()
    }

    /// With `goal.tool` the target may move.
    #[test]
    fn the_tolerance_moves_with_the_target() {
        let sets = ["goal.kind=target", "goal.position_mm=[0, 0, 90]"].map(str::to_owned);
        let read_no_mask = |_: &str, _: Option<u32>, _: &Pose| Err(String::new());
        let goal = Config::from_sources(&[], &sets).unwrap().to_plan(&read_no_mask).unwrap();
        let (stream, storage) = RecordingStreamBuilder::new("test").memory().unwrap();
        log_goal(&stream, &goal.0, &goal.1).unwrap();
        let target_mm = Vector3::new(0.0, 3.0, 92.0);
        let approach = Approach {
            target_mm,
            distance_mm: 92.0,
            clearance_mm: 9.0,
            error_mm: 0.0,
            error_sd_mm: None,
            path: None,
        };
        log_approach(&stream, Some(&goal), &approach, None, 0.0).unwrap();
        stream.flush_blocking().unwrap();
        let mut moved_mm = Vec::new();
        for message in storage.take() {
            let LogMsg::ArrowMsg(_, rows) = message else { continue };
            let chunk = Chunk::from_arrow_msg(&rows).unwrap();
            if chunk.entity_path().to_string() == format!("/{TARGET_PATH}") {
                let translation = Transform3D::descriptor_translation().component;
                moved_mm.extend(chunk.iter_slices::<[f32; 3]>(translation).flatten().copied());
            }
        }
        assert_eq!(moved_mm, [[0.0, 3.0, 2.0]]);
    }

    /// Thinner than the distance between two points, and wherever it lies.
    #[test]
    fn a_sheet_of_one_voxel_is_shown() {
        let mask = mask([40, 1, 60], 0.5);
        let (points_mm, side_mm) = mask_points(&mask, MASK_STEP_MM);
        assert_eq!(side_mm, MASK_STEP_MM);
        assert!(points_mm.iter().all(|point_mm| mask.distance_mm(point_mm) < 0.0));
        let is_shown = |voxel_mm: Vector3<f64>| {
            points_mm.iter().any(|point_mm| (point_mm - voxel_mm).amax() < side_mm)
        };
        assert!(mask.occupied_mm().all(is_shown));
    }

    #[test]
    fn a_large_mask_is_shown_by_a_bounded_number_of_points() {
        let (points_mm, side_mm) = mask_points(&mask([60, 60, 60], 10.0), MASK_STEP_MM);
        assert_eq!(side_mm, 24.0);
        assert!((MASK_POINTS_MAX / 10..=MASK_POINTS_MAX).contains(&points_mm.len()));
    }
}
