//! Fits the bend of the path from the recorded roll of the tip and its recorded positions.
//!
//! A left-invariant extended Kalman filter follows each insertion. It uses the recorded roll
//! increments but not the recorded heading, because a sensor wobbles on its needle more than the
//! path bends. In addition to the pose it estimates the bend `K = (w_x, w_y)` and the slip `S =
//! (v_x, v_y)` per mm in the shaft frame A, `ξ = (S_x, S_y, 1; K_x, K_y, ω)`. The information of
//! all insertions is summed, and the nearest bicycle model is fitted to it: `S = a (K_y, −K_x)`.

use super::insertion::RecordedInsertion;
use super::{Part, jackknife_covariance, needle_error};
use crate::geometry::{Pose, Twist};
use crate::math;
use nalgebra::{Matrix3, Matrix4, Rotation3, SMatrix, SVector, Vector2, Vector3, Vector4, Vector6};

/// Standard deviations of the prior: first position, mm; heading and roll, rad; bend, rad/mm; slip.
const POSITION_SD_MM: f64 = 0.1;
const HEADING_SD_RAD: f64 = 0.1;
const ROLL_SD_RAD: f64 = 1e-3;
const BEND_SD_RAD_PER_MM: f64 = 0.02;
const SLIP_SD: f64 = 0.2;
/// Largest standard error of the bend's axis about the shaft's, deg. Three insertions of a real needle have up to 3,
/// positions with two axes exchanged or one mirrored have over 15.
const AXIS_SD_MAX_DEG: f64 = 10.0;
/// Passes over all insertions, each linearised about the result of the last one.
const PASSES: usize = 3;
const ITERATIONS: usize = 50;

const STATES: usize = 10;
type Covariance = SMatrix<f64, STATES, STATES>;

/// Noise of the tracker and the tissue; see the observer's keys of the same names.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathNoise {
    /// Depth between two positions that are used, mm; 0 uses every one.
    pub spacing_mm: f64,
    /// Standard deviation of a measured position, mm.
    pub position_sd_mm: f64,
    /// Random walk of the position across the axis, mm per √mm.
    pub position_noise_mm: f64,
    /// Random walk of the position along the axis, mm per √mm.
    pub axial_noise_mm: f64,
    /// Random walk of the heading, rad per √mm.
    pub heading_noise_rad: f64,
}

/// A bend with its standard errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BendFit {
    /// Curvature κ, per mm.
    pub curvature_per_mm: f64,
    /// Its standard error.
    pub curvature_sd_per_mm: f64,
    /// How far the tip is ahead of the point on the shaft that moves along its own axis, a, mm.
    pub tip_ahead_mm: f64,
    /// Its standard error.
    pub tip_ahead_sd_mm: f64,
    /// The bend's axis in the sensor frame: the tip's x axis at roll zero.
    pub bend_axis: Vector3<f64>,
    /// Standard error of its angle about the shaft's axis, rad.
    pub bend_axis_sd_rad: f64,
}

/// One insertion's information on `θ = (K_x, K_y, S_x, S_y)`: the information matrix `Y` and the information
/// vector `Y θ`.
struct Information {
    matrix: Matrix4<f64>,
    vector: Vector4<f64>,
}

fn no_bend() -> String {
    needle_error(
        "the positions show no clear bend of the path; hold the base still over some mm from time \
         to time, or insert deeper",
    )
}

fn prior() -> Covariance {
    let (p, h, k, s) = (POSITION_SD_MM, HEADING_SD_RAD, BEND_SD_RAD_PER_MM, SLIP_SD);
    let sd = SVector::<f64, STATES>::from([p, p, p, h, h, ROLL_SD_RAD, k, k, s, s]);
    Covariance::from_diagonal(&sd.component_mul(&sd))
}

/// Runs the filter over one insertion, with bend and slip starting at `start`.
fn run_filter(
    insertion: &RecordedInsertion,
    start: &Vector4<f64>,
    noise: &PathNoise,
) -> Option<Information> {
    let (mut pose, mut bend) = (Pose::identity(), *start);
    let mut p = prior();
    let (mut deeper_mm, mut turn_rad) = (0.0, 0.0);
    for step in &insertion.steps {
        deeper_mm += step.base.insertion_mm();
        turn_rad += step.tip_turn_rad;
        if deeper_mm <= 0.0 || deeper_mm < noise.spacing_mm {
            continue;
        }
        let xi = Vector6::new(bend[2], bend[3], 1.0, bend[0], bend[1], 0.0) * deeper_mm
            + Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, turn_rad);
        let exp = |part: f64| Pose::exp(&Twist::from_vector(&(xi * part)));
        // The motion of the end with the twist, in the end's frame: the right Jacobian, by
        // Simpson's rule over the step.
        let (half, whole) = (exp(-0.5).adjoint(), exp(-1.0).adjoint());
        let jacobian = (SMatrix::<f64, 6, 6>::identity() + half * 4.0 + whole) / 6.0;
        let mut f = Covariance::identity();
        f.fixed_view_mut::<6, 6>(0, 0).copy_from(&whole);
        for (column, row) in [3, 4, 0, 1].into_iter().enumerate() {
            let derivative = jacobian.column(row) * deeper_mm;
            f.fixed_view_mut::<6, 1>(0, 6 + column).copy_from(&derivative);
        }
        pose = (pose * exp(1.0)).renormalized();
        p = f * p * f.transpose();
        let walks = [noise.position_noise_mm, noise.heading_noise_rad];
        for (walk, states) in walks.into_iter().zip([[0, 1], [3, 4]]) {
            for state in states {
                p[(state, state)] += walk.powi(2) * deeper_mm;
            }
        }
        p[(2, 2)] += noise.axial_noise_mm.powi(2) * deeper_mm;
        (deeper_mm, turn_rad) = (0.0, 0.0);

        let innovation = pose.inverse().transform(&step.position_mm);
        let s: Matrix3<f64> =
            p.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * noise.position_sd_mm.powi(2);
        let cross = p.fixed_columns::<3>(0).into_owned();
        let gain = cross * s.try_inverse()?;
        let delta = gain * innovation;
        p -= gain * cross.transpose();
        // Over hundreds of rows rounding would make it asymmetric, and then indefinite.
        p = (p + p.transpose()) * 0.5;
        let error = Twist::from_vector(&delta.fixed_rows::<6>(0).into_owned());
        pose = (pose * Pose::exp(&error)).renormalized();
        bend += delta.fixed_rows::<4>(6);
    }
    let before = prior().fixed_view::<4, 4>(6, 6).try_inverse()?;
    let after = p.fixed_view::<4, 4>(6, 6).try_inverse()?;
    Some(Information { matrix: after - before, vector: after * bend - before * start })
}

/// (K_x, K_y, S_x, S_y) of the bicycle (K_x, K_y, a), and the Jacobian.
fn bicycle(p: &Vector3<f64>) -> (Vector4<f64>, SMatrix<f64, 4, 3>) {
    let (kx, ky, a) = (p.x, p.y, p.z);
    let jacobian = SMatrix::<f64, 4, 3>::from_rows(&[
        [1.0, 0.0, 0.0].into(),
        [0.0, 1.0, 0.0].into(),
        [0.0, a, ky].into(),
        [-a, 0.0, -kx].into(),
    ]);
    (Vector4::new(kx, ky, a * ky, -a * kx), jacobian)
}

impl BendFit {
    /// The bicycle that fits the insertions best; `r_sa` is the shaft frame in the sensor's.
    pub(super) fn of(
        insertions: &[RecordedInsertion],
        r_sa: &Rotation3<f64>,
        noise: &PathNoise,
    ) -> Result<Self, String> {
        let (mut bend, mut information) = (Vector4::zeros(), Vec::new());
        let (mut matrix, mut vector) = (Matrix4::zeros(), Vector4::zeros());
        for _ in 0..PASSES {
            let run = |insertion| run_filter(insertion, &bend, noise);
            information =
                insertions.iter().map(run).collect::<Option<Vec<_>>>().ok_or_else(no_bend)?;
            matrix = information.iter().map(|part| part.matrix).sum();
            vector = information.iter().map(|part| part.vector).sum();
            bend = matrix.try_inverse().ok_or_else(no_bend)? * vector;
        }
        let mut p = Vector3::new(bend[0], bend[1], 0.0);
        for _ in 0..ITERATIONS {
            let (model, jacobian) = bicycle(&p);
            let hessian = jacobian.transpose() * matrix * jacobian;
            let gradient = jacobian.transpose() * (vector - matrix * model);
            p += hessian.try_inverse().ok_or_else(no_bend)? * gradient;
        }
        let (model, jacobian) = bicycle(&p);
        let parts = information.iter().map(|part| Part {
            hessian: jacobian.transpose() * part.matrix * jacobian,
            gradient: jacobian.transpose() * (part.vector - part.matrix * model),
        });
        let covariance = jackknife_covariance(&parts.collect::<Vec<_>>()).ok_or_else(no_bend)?;
        let curvature_per_mm = math::hypot(p.x, p.y);
        let along = Vector2::new(p.x, p.y) / curvature_per_mm;
        let across = Vector2::new(-along.y, along.x);
        let sd = |direction: Vector2<f64>| {
            let of_bend = covariance.fixed_view::<2, 2>(0, 0);
            direction.dot(&(of_bend * direction)).max(0.0).sqrt()
        };
        let fit = BendFit {
            curvature_per_mm,
            curvature_sd_per_mm: sd(along),
            tip_ahead_mm: p.z,
            tip_ahead_sd_mm: covariance[(2, 2)].max(0.0).sqrt(),
            bend_axis: r_sa * Vector3::new(along.x, along.y, 0.0),
            bend_axis_sd_rad: sd(across) / curvature_per_mm,
        };
        // A bend that may be zero has no axis.
        let is_clear = fit.curvature_per_mm > 3.0 * fit.curvature_sd_per_mm;
        let axis_sd_deg = fit.bend_axis_sd_rad.to_degrees();
        match is_clear {
            false => Err(no_bend()),
            true if axis_sd_deg > AXIS_SD_MAX_DEG => Err(needle_error(format!(
                "the bend's axis has a standard error of {axis_sd_deg:.0} deg (limit {AXIS_SD_MAX_DEG:.0}): are \
                 positions and orientations in one frame, and is no axis mirrored or exchanged with another? \
                 Else record more or deeper insertions"
            ))),
            true => Ok(fit),
        }
    }
}
