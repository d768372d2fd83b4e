//! The fixed part of the 3-D view: the desired plane with its lines and axes, the target and the obstacles.

use super::{Logged, palette};
use crate::geometry::Pose;
use crate::plan::{Obstacle, Problem, Workspace, World};
use crate::telemetry::Scene;
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rerun::{
    Arrows3D, Boxes3D, Cylinders3D, Ellipsoids3D, FillMode, LineStrips3D, Mesh3D, Points3D,
    Quaternion, RecordingStream, Transform3D, ViewCoordinates,
};
use std::f64::consts::{FRAC_PI_2, PI};

/// The entity of the desired plane P. Everything about the needle is logged in its frame.
pub(super) const PLANE: &str = "bench/plane";

/// The rectangle of the plane that an insertion can reach, with a margin, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reach {
    pub(super) y_mm: [f64; 2],
    pub(super) z_mm: [f64; 2],
}

impl Reach {
    const MARGIN_MM: f64 = 10.0;
    /// Least and greatest extent of the plane to one side, without the margin, mm.
    const SIDE_MM: [f64; 2] = [20.0, 1000.0];
    /// A needle further away than this is not shown, mm.
    const PLACE_MM_MAX: f64 = 10_000.0;
    /// At most about this many depths have a label.
    const LABELS_MAX: f64 = 6.0;

    /// The rectangle around the two arcs that the needle cuts when it is not turned, one to each side.
    pub(super) fn of(scene: &Scene) -> Self {
        let length_mm = scene.insertion_mm.clamp(Self::SIDE_MM[0], Self::SIDE_MM[1]);
        let curvature_per_mm = scene.curvature_per_mm.max(1e-9);
        let angle = curvature_per_mm * length_mm;
        let side_mm = (1.0 - angle.min(PI).cos()) / curvature_per_mm;
        let side_mm = side_mm.clamp(Self::SIDE_MM[0], length_mm) + Self::MARGIN_MM;
        // A needle that the stage turns stays near the axis and goes further ahead than the arcs.
        let ahead_mm = angle.min(FRAC_PI_2).sin() / curvature_per_mm;
        let ahead_mm = ahead_mm.max(length_mm) + Self::MARGIN_MM;
        Reach { y_mm: [-side_mm, side_mm], z_mm: [-Self::MARGIN_MM, ahead_mm] }
    }

    /// This rectangle, moved to a needle that starts at `start_mm`. `None` if the needle starts near the origin,
    /// or if its position cannot be right (NaN, or over 10 m away).
    pub(super) fn moved_to(&self, start_mm: &Vector3<f64>) -> Option<Self> {
        let (y_mm, z_mm) = (start_mm.y, start_mm.z);
        let is_inside = y_mm.abs() <= 0.5 * self.y_mm[1] && z_mm.abs() <= Self::MARGIN_MM;
        let is_place = [y_mm, z_mm].iter().all(|mm| mm.abs() <= Self::PLACE_MM_MAX);
        (is_place && !is_inside).then(|| Reach {
            y_mm: self.y_mm.map(|edge| edge + y_mm),
            z_mm: self.z_mm.map(|edge| edge + z_mm),
        })
    }

    /// The middle, across and along the insertion.
    pub(super) fn middle_mm(&self) -> [f64; 2] {
        [self.y_mm, self.z_mm].map(|[from, to]| 0.5 * (from + to))
    }

    /// Distance between two labelled depths, mm, so that any length has only a few labels.
    fn tick_mm(&self) -> f64 {
        let length_mm = self.z_mm[1] - self.z_mm[0] - 2.0 * Self::MARGIN_MM;
        let ticks_mm = [10.0, 20.0, 50.0, 100.0];
        let tick_mm = ticks_mm.into_iter().find(|tick_mm| length_mm / tick_mm <= Self::LABELS_MAX);
        tick_mm.unwrap_or(200.0)
    }
}

/// Logs the plane, its labelled axes, and the goal.
pub(super) fn log(stream: &RecordingStream, scene: &Scene) -> Logged {
    // x, the distance from the plane, is up; the needle goes away from the eye.
    stream.log_static(PLANE, &ViewCoordinates::UBR())?;
    stream.log_static(PLANE, &transform(&scene.x_wp))?;
    log_sheet(stream, &Reach::of(scene))?;
    stream.log_static(
        format!("{PLANE}/axes"),
        &Arrows3D::from_vectors([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]])
            .with_colors([palette::NEUTRAL])
            .with_radii([0.4])
            .with_labels(["x", "y", "z"]),
    )?;
    scene.goal.as_ref().map_or(Ok(()), |(world, problem)| log_goal(stream, world, problem))
}

/// Logs the part of the plane within `reach`: a translucent sheet, a line every 10 mm, and depths.
pub(super) fn log_sheet(stream: &RecordingStream, reach: &Reach) -> Logged {
    let ([left, right], [near, far]) = (reach.y_mm, reach.z_mm);
    let corner = |y: f64, z: f64| [0.0, y as f32, z as f32];
    let sheet = [corner(left, near), corner(right, near), corner(right, far), corner(left, far)];
    stream.log_static(
        format!("{PLANE}/target/sheet"),
        &Mesh3D::new(sheet)
            .with_triangle_indices([[0, 1, 2], [0, 2, 3]])
            .with_vertex_normals([[1.0, 0.0, 0.0]; 4])
            .with_albedo_factor(palette::PLANE.0),
    )?;
    let every_ten = |[from, to]: [f64; 2]| {
        ((from / 10.0).ceil() as i64..=(to / 10.0).floor() as i64).map(|n| n as f64 * 10.0)
    };
    let across = every_ten(reach.z_mm).map(|z| [corner(left, z), corner(right, z)]);
    let along = every_ten(reach.y_mm).map(|y| [corner(y, near), corner(y, far)]);
    stream.log_static(
        format!("{PLANE}/target/lines_10_mm"),
        &LineStrips3D::new(across.chain(along))
            .with_colors([palette::PLANE_LINES])
            .with_radii([rerun::Radius::new_ui_points(0.5)]),
    )?;
    let (start_mm, tick_mm) = (near + Reach::MARGIN_MM, reach.tick_mm());
    let is_labelled = |z: &f64| *z > start_mm && z % tick_mm == 0.0;
    let depths_mm: Vec<f64> = every_ten(reach.z_mm).filter(is_labelled).collect();
    let middle_mm = reach.middle_mm()[0];
    stream.log_static(
        format!("{PLANE}/target/depths"),
        &Points3D::new(depths_mm.iter().map(|&z| corner(middle_mm, z)))
            .with_colors([palette::NEUTRAL])
            .with_radii([0.7])
            .with_labels(depths_mm.iter().map(|z| format!("{z} mm"))),
    )
}

/// Distance between two points at which a mask is drawn, mm.
const MASK_STEP_MM: f64 = 3.0;

/// Logs the target with its tolerance, and the obstacles.
fn log_goal(stream: &RecordingStream, world: &World, problem: &Problem) -> Logged {
    let ball = |centre_mm: &Vector3<f64>, radius_mm: f64, colour| {
        Ellipsoids3D::from_centers_and_half_sizes([point(centre_mm)], [[radius_mm as f32; 3]])
            .with_colors([colour])
            .with_fill_mode(FillMode::DenseWireframe)
    };
    let target = ball(&problem.target_mm, problem.tolerance_mm, palette::GOOD);
    stream.log_static(format!("{PLANE}/goal/target"), &target)?;
    for (i, obstacle) in world.obstacles.iter().enumerate() {
        let path = format!("{PLANE}/goal/obstacle_{i}");
        match obstacle {
            Obstacle::Sphere { centre_mm, radius_mm } => {
                stream.log_static(path, &ball(centre_mm, *radius_mm, palette::LIMIT))?;
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
                        .with_colors([palette::LIMIT])
                        .with_fill_mode(FillMode::DenseWireframe);
                stream.log_static(path, &cylinder)?;
            }
            Obstacle::Box { min_mm, max_mm } => {
                let [centre, half] = [(min_mm + max_mm) * 0.5, (max_mm - min_mm) * 0.5];
                let block = Boxes3D::from_centers_and_half_sizes([point(&centre)], [point(&half)])
                    .with_colors([palette::LIMIT]);
                stream.log_static(path, &block)?;
            }
            Obstacle::Mask(mask) => {
                let Workspace { min_mm, max_mm, .. } = world.workspace;
                let counts = (max_mm - min_mm).map(|mm| (mm / MASK_STEP_MM) as u32);
                let along = |i: u32| (0..=counts[i as usize]).map(f64::from);
                let nodes = along(0).flat_map(|x| {
                    along(1).flat_map(move |y| along(2).map(move |z| Vector3::new(x, y, z)))
                });
                let places = nodes.map(|node| min_mm + node * MASK_STEP_MM);
                let inside = places.filter(|place| mask.distance_mm(place) < 0.0);
                let points = Points3D::new(inside.map(|place| point(&place)))
                    .with_colors([palette::LIMIT])
                    .with_radii([0.5]);
                stream.log_static(path, &points)?;
            }
        }
    }
    Ok(())
}

/// `pose` as rerun takes it.
pub(super) fn transform(pose: &Pose) -> Transform3D {
    Transform3D::update_fields()
        .with_translation(point(&pose.translation))
        .with_quaternion(quaternion(&pose.rotation))
}

/// A point, mm, as rerun takes it.
pub(super) fn point(mm: &Vector3<f64>) -> [f32; 3] {
    mm.cast::<f32>().into()
}

/// `rotation` as rerun takes it.
pub(super) fn quaternion(rotation: &Rotation3<f64>) -> Quaternion {
    let q = UnitQuaternion::from_rotation_matrix(rotation).into_inner().cast::<f32>();
    Quaternion::from_xyzw([q.i, q.j, q.k, q.w])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests;

    #[test]
    fn the_plane_moves_to_a_needle_that_starts_outside_it() {
        let reach = Reach::of(&Scene { insertion_mm: 150.0, ..tests::scene() });
        let moved = |x: f64, y: f64, z: f64| reach.moved_to(&Vector3::new(x, y, z));
        assert_eq!(moved(30.0, 5.0, -9.0), None, "the start is inside");
        let far = moved(0.0, -80.0, 400.0).expect("moved");
        assert_eq!(far.z_mm, [390.0, reach.z_mm[1] + 400.0]);
        assert_eq!(far.middle_mm()[0], -80.0);
        assert_eq!([moved(0.0, f64::NAN, 0.0), moved(0.0, 0.0, 1e300)], [None, None]);
    }

    #[test]
    fn every_insertion_depth_has_a_few_labels() {
        let tick_mm =
            |insertion_mm: f64| Reach::of(&Scene { insertion_mm, ..tests::scene() }).tick_mm();
        assert_eq!(
            [20.0, 50.0, 100.0, 250.0, 1000.0].map(tick_mm),
            [10.0, 10.0, 20.0, 50.0, 200.0]
        );
    }

    #[test]
    fn the_plane_holds_both_arcs() {
        let scene = |insertion_mm, curvature_per_mm| Scene {
            insertion_mm,
            curvature_per_mm,
            ..tests::scene()
        };
        let reach = Reach::of(&scene(150.0, 1.0 / 122.0));
        let side_mm = 122.0 * (1.0 - (150.0f64 / 122.0).cos()) + 10.0;
        assert!((reach.y_mm[1] - side_mm).abs() < 1e-9 && reach.y_mm[0] == -reach.y_mm[1]);
        assert_eq!(reach.z_mm, [-10.0, 160.0]);
        for hostile in [scene(0.0, 0.0), scene(1e300, 1e300), scene(-5.0, -1.0)] {
            let reach = Reach::of(&hostile);
            assert!(reach.y_mm[1] >= 20.0 && reach.y_mm[1] <= 1010.0, "{reach:?}");
            assert!(reach.z_mm[1] >= 20.0 && reach.z_mm[1] <= 1010.0, "{reach:?}");
        }
    }
}
