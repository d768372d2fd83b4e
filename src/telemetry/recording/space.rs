//! The 3-D views: the desired plane with its lines and axes; the tips, their trails, the measured points and the
//! ellipsoid.
//!
//! Each step logs one segment of a trail and one measured point. The layout shows all of them up to the
//! cursor, so no step logs the earlier ones again.

use super::goal::{log_approach, log_goal};
use super::palette::{
    ESTIMATE, ESTIMATE_BOUND, MEASURED, NEUTRAL, PLANE_LINES, PLANE_SHEET, TRUTH,
};
use super::{Logged, layout};
use crate::emulator::Truth;
use crate::geometry::Pose;
use crate::observer::Estimate;
use crate::session::StepRecord;
use crate::telemetry::Scene;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rerun::{
    Arrows3D, Color, Ellipsoids3D, FillMode, LineStrips3D, Mesh3D, Points3D, Quaternion, Radius,
    RecordingStream, Transform3D, ViewCoordinates,
};
use std::f64::consts::PI;

/// The entity of the desired plane P. Everything about the needle is logged in its frame.
pub(super) const PLANE: &str = "bench/plane";
/// The entities that are shown with their whole history up to the cursor.
pub(super) const TRAILS: [&str; 3] =
    ["bench/plane/path/estimate", "bench/plane/path/true", MEASURED_PATH];
const MEASURED_PATH: &str = "bench/plane/path/measured";
const ELLIPSOID_PATH: &str = "bench/plane/tip/covariance";
/// Length of the arrows at a tip, mm.
const ARROW_MM: f32 = 12.0;
/// 95 % quantile of the χ² distribution with three degrees of freedom.
const CHI_SQUARE_95: f64 = 7.815;

/// The rectangle of the plane that an insertion can reach, with a margin, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sheet {
    pub(super) y_mm: [f64; 2],
    pub(super) z_mm: [f64; 2],
}

impl Sheet {
    const MARGIN_MM: f64 = 10.0;
    /// Least and greatest extent of the plane to one side, without the margin, mm.
    const SIDE_MM: [f64; 2] = [20.0, 1000.0];
    /// The sheet does not follow a needle that starts further away than this, mm.
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
        let ahead_mm = length_mm + Self::MARGIN_MM;
        Sheet { y_mm: [-side_mm, side_mm], z_mm: [-Self::MARGIN_MM, ahead_mm] }
    }

    /// This rectangle, moved to a needle that starts at `start_mm`. `None` if the needle starts near the origin,
    /// or if its position cannot be right (NaN, or over 10 m away).
    fn moved_to(&self, start_mm: &Vector3<f64>) -> Option<Self> {
        let (y_mm, z_mm) = (start_mm.y, start_mm.z);
        let is_inside = y_mm.abs() <= 0.5 * self.y_mm[1] && z_mm.abs() <= Self::MARGIN_MM;
        let is_place = [y_mm, z_mm].iter().all(|mm| mm.abs() <= Self::PLACE_MM_MAX);
        (is_place && !is_inside).then(|| Sheet {
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

    /// Logs the sheet, translucent, with a line every 10 mm and depths.
    fn log(&self, stream: &RecordingStream) -> Logged {
        let ([left, right], [near, far]) = (self.y_mm, self.z_mm);
        let corner = |y: f64, z: f64| [0.0, y as f32, z as f32];
        let sheet =
            [corner(left, near), corner(right, near), corner(right, far), corner(left, far)];
        stream.log_static(
            format!("{PLANE}/target/sheet"),
            &Mesh3D::new(sheet)
                .with_triangle_indices([[0, 1, 2], [0, 2, 3]])
                .with_vertex_normals([[1.0, 0.0, 0.0]; 4])
                .with_albedo_factor(PLANE_SHEET.0),
        )?;
        let every_ten = |[from, to]: [f64; 2]| {
            ((from / 10.0).ceil() as i64..=(to / 10.0).floor() as i64).map(|n| n as f64 * 10.0)
        };
        let across = every_ten(self.z_mm).map(|z| [corner(left, z), corner(right, z)]);
        let along = every_ten(self.y_mm).map(|y| [corner(y, near), corner(y, far)]);
        stream.log_static(
            format!("{PLANE}/target/lines_10_mm"),
            &LineStrips3D::new(across.chain(along))
                .with_colors([PLANE_LINES])
                .with_radii([Radius::new_ui_points(0.5)]),
        )?;
        let (start_mm, tick_mm) = (near + Self::MARGIN_MM, self.tick_mm());
        let is_labelled = |z: &f64| *z > start_mm && z % tick_mm == 0.0;
        let depths_mm: Vec<f64> = every_ten(self.z_mm).filter(is_labelled).collect();
        let middle_mm = self.middle_mm()[0];
        stream.log_static(
            format!("{PLANE}/target/depths"),
            &Points3D::new(depths_mm.iter().map(|&z| corner(middle_mm, z)))
                .with_colors([NEUTRAL])
                .with_radii([0.7])
                .with_labels(depths_mm.iter().map(|z| format!("{z} mm"))),
        )
    }
}

/// The 3-D views of a run.
pub(super) struct Space {
    scene: Scene,
    /// Whether the sheet and the view are where the needle starts.
    is_placed: bool,
    estimate: Tip,
    truth: Tip,
}

impl Space {
    /// Logs the layout, the plane, its labelled axes and the goal, and the colours and sizes of what moves.
    pub(super) fn open(stream: &RecordingStream, scene: &Scene) -> Logged<Self> {
        let sheet = Sheet::of(scene);
        layout::send(stream, scene, &sheet)?;
        sheet.log(stream)?;
        // x, the distance from the plane, is up; the needle goes away from the eye.
        stream.log_static(PLANE, &ViewCoordinates::UBR())?;
        stream.log_static(PLANE, &transform(&scene.x_wp))?;
        let axes = Arrows3D::from_vectors([[20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]])
            .with_colors([NEUTRAL])
            .with_radii([0.4])
            .with_labels(["x", "y", "z"]);
        stream.log_static(format!("{PLANE}/axes"), &axes)?;
        if let Some((world, problem)) = &scene.goal {
            log_goal(stream, world, problem)?;
        }
        let [estimate, truth] = ["estimate", "true"].map(Tip::new);
        estimate.log_style(stream, ESTIMATE)?;
        if scene.truth {
            truth.log_style(stream, TRUTH)?;
        }
        let measured = Points3D::update_fields()
            .with_colors([MEASURED])
            .with_radii([Radius::new_ui_points(1.3)]);
        stream.log_static(MEASURED_PATH, &measured)?;
        let ellipsoid = Ellipsoids3D::update_fields()
            .with_colors([ESTIMATE_BOUND])
            .with_fill_mode(FillMode::DenseWireframe)
            .with_line_radii([Radius::new_ui_points(0.75)]);
        stream.log_static(ELLIPSOID_PATH, &ellipsoid)?;
        Ok(Space { scene: scene.clone(), is_placed: false, estimate, truth })
    }

    /// Logs what has moved by `step`.
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        step: &StepRecord,
        truth: Option<&Truth>,
    ) -> Logged {
        let measured_mm = step.tip_meas_mm.filter(|p| p.iter().all(|c| c.is_finite()));
        let estimate = step.decision.estimate.filter(|estimate| estimate.x_pb.is_finite());
        if let Some(start_mm) = measured_mm.or(estimate.map(|e| e.x_pb.translation)) {
            self.place(stream, &start_mm)?;
        }
        if let Some(estimate) = &estimate {
            self.estimate.log(stream, &estimate.x_pb)?;
            log_ellipsoid(stream, estimate)?;
        }
        if let Some(approach) = &step.decision.approach {
            let (goal, depth_mm) = (self.scene.goal.as_ref(), step.insertion_meas_mm);
            log_approach(stream, goal, approach, estimate.as_ref(), depth_mm)?;
        }
        if let Some(truth) = truth.map(|truth| &truth.x_pb).filter(|x_pb| x_pb.is_finite()) {
            self.truth.log(stream, truth)?;
        }
        let Some(measured_mm) = measured_mm else { return Ok(()) };
        stream.log(MEASURED_PATH, &Points3D::new([point(&measured_mm)]))
    }

    /// Moves the plane and the view to the needle, if it starts outside of them.
    fn place(&mut self, stream: &RecordingStream, start_mm: &Vector3<f64>) -> Logged {
        if std::mem::replace(&mut self.is_placed, true) {
            return Ok(());
        }
        let Some(sheet) = Sheet::of(&self.scene).moved_to(start_mm) else { return Ok(()) };
        layout::send(stream, &self.scene, &sheet)?;
        sheet.log(stream)
    }
}

/// A tip and its trail. The tip is drawn as two arrows: along its axis, and in the direction in which it bends.
struct Tip {
    tip_path: String,
    trail_path: String,
    /// The present end of the trail.
    last_point_mm: Option<[f32; 3]>,
}

impl Tip {
    fn new(provenance: &str) -> Self {
        let [tip_path, trail_path] =
            ["tip", "path"].map(|part| format!("{PLANE}/{part}/{provenance}"));
        Tip { tip_path, trail_path, last_point_mm: None }
    }

    fn log(&mut self, stream: &RecordingStream, x_pb: &Pose) -> Logged {
        stream.log(self.tip_path.as_str(), &transform(x_pb))?;
        let tip = point(&x_pb.translation);
        let segment = [self.last_point_mm.replace(tip).unwrap_or(tip), tip];
        stream.log(self.trail_path.as_str(), &LineStrips3D::new([segment]))
    }

    /// The bevel bends the tip towards −y of its own frame (paper Eq. 1: `p'' = −κ R e₂`).
    fn log_style(&self, stream: &RecordingStream, colour: Color) -> Logged {
        let arrows = [[0.0, 0.0, ARROW_MM], [0.0, -0.7 * ARROW_MM, 0.0]];
        let arrows = Arrows3D::from_vectors(arrows)
            .with_colors([colour])
            .with_radii([Radius::new_ui_points(1.5)])
            .with_labels(["", "bevel"])
            .with_show_labels(false);
        stream.log_static(self.tip_path.as_str(), &arrows)?;
        let style = LineStrips3D::update_fields()
            .with_colors([colour])
            .with_radii([Radius::new_ui_points(1.2)]);
        stream.log_static(self.trail_path.as_str(), &style)
    }
}

/// Logs the 95 % ellipsoid of the estimated position, if the estimate has a covariance.
fn log_ellipsoid(stream: &RecordingStream, estimate: &Estimate) -> Logged {
    let covariance_mm2 = estimate.position_covariance_mm2();
    let known = covariance_mm2.filter(|mm2| mm2.iter().all(|c| c.is_finite()));
    let Some(covariance_mm2) = known else { return Ok(()) };
    let (half_sizes_mm, rotation) = principal(&covariance_mm2);
    let (centre, half_sizes) = (point(&estimate.x_pb.translation), point(&half_sizes_mm));
    let ellipsoid = Ellipsoids3D::from_centers_and_half_sizes([centre], [half_sizes])
        .with_quaternions([quaternion(&rotation)]);
    stream.log(ELLIPSOID_PATH, &ellipsoid)
}

/// Semi-axes, mm, and orientation of the 95 % ellipsoid of this covariance, mm².
fn principal(covariance_mm2: &Matrix3<f64>) -> (Vector3<f64>, Rotation3<f64>) {
    let eigen = covariance_mm2.symmetric_eigen();
    let half_sizes_mm = eigen.eigenvalues.map(|l| (CHI_SQUARE_95 * l.max(0.0)).sqrt());
    let mut axes = eigen.eigenvectors;
    // The sign of an eigenvector is arbitrary: make the three a rotation.
    if axes.determinant() < 0.0 {
        axes.column_mut(2).neg_mut();
    }
    (half_sizes_mm, Rotation3::from_matrix_unchecked(axes))
}

/// `pose` as rerun's type.
pub(super) fn transform(pose: &Pose) -> Transform3D {
    Transform3D::update_fields()
        .with_translation(point(&pose.translation))
        .with_quaternion(quaternion(&pose.rotation))
}

/// A point, mm, as rerun's type.
pub(super) fn point(mm: &Vector3<f64>) -> [f32; 3] {
    mm.cast::<f32>().into()
}

/// `rotation` as rerun's type.
pub(super) fn quaternion(rotation: &Rotation3<f64>) -> Quaternion {
    let q = UnitQuaternion::from_rotation_matrix(rotation).into_inner().cast::<f32>();
    Quaternion::from_xyzw([q.i, q.j, q.k, q.w])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests;

    #[test]
    fn the_ellipsoid_has_the_covariances_axes() {
        let turn = Rotation3::from_euler_angles(0.3, -0.8, 2.0);
        let sd_mm = Vector3::new(0.2, 1.0, 3.0);
        let spread = Matrix3::from_diagonal(&sd_mm.component_mul(&sd_mm));
        let covariance_mm2 = turn * spread * turn.inverse();
        let (half_sizes_mm, rotation) = principal(&covariance_mm2);
        assert!((rotation.matrix().determinant() - 1.0).abs() < 1e-9);
        let back = rotation
            * Matrix3::from_diagonal(&half_sizes_mm.component_mul(&half_sizes_mm))
            * rotation.inverse();
        assert!((back / CHI_SQUARE_95 - covariance_mm2).norm() < 1e-9);
    }

    #[test]
    fn the_plane_moves_to_a_needle_that_starts_outside_it() {
        let sheet = Sheet::of(&Scene { insertion_mm: 150.0, ..tests::scene() });
        let moved = |x: f64, y: f64, z: f64| sheet.moved_to(&Vector3::new(x, y, z));
        assert_eq!(moved(30.0, 5.0, -9.0), None, "the start is inside");
        let far = moved(0.0, -80.0, 400.0).expect("moved");
        assert_eq!(far.z_mm, [390.0, sheet.z_mm[1] + 400.0]);
        assert_eq!(far.middle_mm()[0], -80.0);
        assert_eq!([moved(0.0, f64::NAN, 0.0), moved(0.0, 0.0, 1e300)], [None, None]);
    }

    #[test]
    fn every_insertion_depth_has_a_few_labels() {
        let tick_mm =
            |insertion_mm: f64| Sheet::of(&Scene { insertion_mm, ..tests::scene() }).tick_mm();
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
        let sheet = Sheet::of(&scene(150.0, 1.0 / 122.0));
        let side_mm = 122.0 * (1.0 - (150.0f64 / 122.0).cos()) + 10.0;
        assert!((sheet.y_mm[1] - side_mm).abs() < 1e-9 && sheet.y_mm[0] == -sheet.y_mm[1]);
        assert_eq!(sheet.z_mm, [-10.0, 160.0]);
        for hostile in [scene(0.0, 0.0), scene(1e300, 1e300), scene(-5.0, -1.0)] {
            let sheet = Sheet::of(&hostile);
            assert!(sheet.y_mm[1] >= 20.0 && sheet.y_mm[1] <= 1010.0, "{sheet:?}");
            assert!(sheet.z_mm[1] >= 20.0 && sheet.z_mm[1] <= 1010.0, "{sheet:?}");
        }
    }
}
