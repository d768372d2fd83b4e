//! The moving part of the 3-D views: the tips, their trails, the measured points and the ellipsoid.
//!
//! Each step logs one segment of a trail and one measured point. The layout shows all of them up to the
//! cursor, so no step logs the earlier ones again.

use super::Logged;
use super::palette::{
    COMMANDED, ESTIMATE, ESTIMATE_BOUND, GOOD, LIMIT, MEASURED, OUT_OF_REACH, TRUTH,
};
use super::scene::{PLANE, point, quaternion, transform};
use crate::emulator::Truth;
use crate::geometry::Pose;
use crate::observer::Estimate;
use crate::plan::{Problem, Reach, Tip as PlanTip, World, reach_around};
use crate::session::StepRecord;
use crate::telemetry::Scene;
use nalgebra::{Matrix3, Rotation3, Vector3};
use rerun::{
    Arrows3D, Color, Ellipsoids3D, FillMode, LineStrips3D, Points3D, Radius, RecordingStream,
};

/// Length of the arrows at a tip, mm.
const ARROW_MM: f32 = 12.0;
/// 95 % quantile of the χ² distribution with three degrees of freedom.
const CHI_SQUARE_95: f64 = 7.815;

/// The entities that are shown with their whole history up to the cursor.
pub(super) const TRAILS: [&str; 3] =
    ["bench/plane/path/estimate", "bench/plane/path/true", MEASURED_PATH];
const MEASURED_PATH: &str = "bench/plane/path/measured";
/// Distance between the points of the planned path, mm.
const PLANNED_STEP_MM: f64 = 2.0;
const ELLIPSOID_PATH: &str = "bench/plane/tip/covariance";

/// The moving part of the 3-D views.
pub(super) struct Space {
    estimate: Tip,
    truth: Tip,
    goal: Option<(World, Problem)>,
}

impl Space {
    /// Logs the colours and sizes once.
    pub(super) fn open(stream: &RecordingStream, scene: &Scene) -> Logged<Self> {
        let space = Space {
            estimate: Tip::new("estimate", ESTIMATE),
            truth: Tip::new("true", TRUTH),
            goal: scene.goal.clone(),
        };
        space.estimate.log_style(stream)?;
        if scene.truth {
            space.truth.log_style(stream)?;
        }
        let points = Points3D::update_fields()
            .with_colors([MEASURED])
            .with_radii([Radius::new_ui_points(1.3)]);
        stream.log_static(MEASURED_PATH, &points)?;
        let ellipsoid = Ellipsoids3D::update_fields()
            .with_colors([ESTIMATE_BOUND])
            .with_fill_mode(FillMode::DenseWireframe)
            .with_line_radii([Radius::new_ui_points(0.75)]);
        stream.log_static(ELLIPSOID_PATH, &ellipsoid)?;
        Ok(space)
    }

    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        step: &StepRecord,
        truth: Option<&Truth>,
    ) -> Logged {
        if let Some(estimate) = &step.decision.estimate {
            self.estimate.log(stream, &estimate.x_pb)?;
            log_ellipsoid(stream, estimate)?;
        }
        if let Some(approach) = &step.decision.approach {
            if let Some(path) = &approach.path {
                // From the present tip to the target; only the newest is shown.
                let points: Vec<_> = path.points_mm(PLANNED_STEP_MM).iter().map(point).collect();
                let strip = LineStrips3D::new([points]).with_colors([COMMANDED]);
                stream.log("bench/plane/planned", &strip)?;
            }
            // The target may move.
            let seen = Points3D::new([point(&approach.target_mm)])
                .with_colors([MEASURED])
                .with_radii([0.5]);
            stream.log("bench/plane/goal/target_seen", &seen)?;
            self.log_reach(stream, step, &approach.target_mm)?;
        }
        if let Some(truth) = truth {
            self.truth.log(stream, truth.x_pb())?;
        }
        match &step.tip_meas_mm {
            Some(tip_meas_mm) if tip_meas_mm.iter().all(|c| c.is_finite()) => {
                stream.log(MEASURED_PATH, &Points3D::new([point(tip_meas_mm)]))
            }
            _ => Ok(()),
        }
    }

    /// Logs points around the target, coloured by whether one arc from the estimated tip reaches them: green if
    /// clear, red if obstructed, blue if out of reach.
    fn log_reach(
        &self,
        stream: &RecordingStream,
        step: &StepRecord,
        target_mm: &Vector3<f64>,
    ) -> Logged {
        let x_pb = step.decision.estimate.map(|estimate| estimate.x_pb).filter(Pose::is_finite);
        let Some(((world, problem), x_pb)) = self.goal.as_ref().zip(x_pb) else { return Ok(()) };
        let Pose { rotation, translation } = x_pb;
        let tip = PlanTip { position_mm: translation, heading: rotation * Vector3::z() };
        let problem = Problem { target_mm: *target_mm, ..problem.clone() };
        let points = reach_around(world, &problem, &tip);
        let colours = points.iter().map(|(_, reach)| match reach {
            Reach::Clear => GOOD,
            Reach::Obstructed => LIMIT,
            Reach::OutOfReach => OUT_OF_REACH,
        });
        let colours: Vec<Color> = colours.collect();
        let points = points.iter().map(|(point_mm, _)| point(point_mm));
        let points = Points3D::new(points).with_colors(colours).with_radii([0.4]);
        stream.log("bench/plane/goal/reach", &points)
    }
}

/// A tip and its trail. The tip is drawn as two arrows: along its axis, and in the direction in which it bends.
struct Tip {
    tip_path: String,
    trail_path: String,
    colour: Color,
    /// The present end of the trail.
    last_point_mm: Option<[f32; 3]>,
}

impl Tip {
    fn new(provenance: &str, colour: Color) -> Self {
        Tip {
            tip_path: format!("{PLANE}/tip/{provenance}"),
            trail_path: format!("{PLANE}/path/{provenance}"),
            colour,
            last_point_mm: None,
        }
    }

    fn log(&mut self, stream: &RecordingStream, x_pb: &Pose) -> Logged {
        if !x_pb.is_finite() {
            return Ok(());
        }
        stream.log(self.tip_path.as_str(), &transform(x_pb))?;
        let tip = point(&x_pb.translation);
        let segment = [self.last_point_mm.replace(tip).unwrap_or(tip), tip];
        stream.log(self.trail_path.as_str(), &LineStrips3D::new([segment]))
    }

    /// The bevel bends the tip towards −y of its own frame (paper Eq. 1: `p'' = −κ R e₂`).
    fn log_style(&self, stream: &RecordingStream) -> Logged {
        let arrows = [Vector3::z(), -Vector3::y() * 0.7]
            .map(|direction: Vector3<f32>| <[f32; 3]>::from(direction * ARROW_MM));
        let arrows = Arrows3D::from_vectors(arrows)
            .with_colors([self.colour])
            .with_radii([Radius::new_ui_points(1.5)])
            .with_labels(["", "bevel"])
            .with_show_labels(false);
        stream.log_static(self.tip_path.as_str(), &arrows)?;
        let style = LineStrips3D::update_fields()
            .with_colors([self.colour])
            .with_radii([Radius::new_ui_points(1.2)]);
        stream.log_static(self.trail_path.as_str(), &style)
    }
}

/// Logs the 95 % ellipsoid of the estimated position, if the estimate has a covariance.
fn log_ellipsoid(stream: &RecordingStream, estimate: &Estimate) -> Logged {
    let covariance_mm2 = estimate.position_covariance_mm2().filter(|covariance_mm2| {
        estimate.x_pb.is_finite() && covariance_mm2.iter().all(|c| c.is_finite())
    });
    let Some(covariance_mm2) = covariance_mm2 else { return Ok(()) };
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
    // Eigenvectors have no sign: make them a rotation.
    if axes.determinant() < 0.0 {
        axes.column_mut(2).neg_mut();
    }
    (half_sizes_mm, Rotation3::from_matrix_unchecked(axes))
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
