//! The information bound: what the best possible estimate could know.

use crate::geometry::{FixedAngles, Pose, Twist};
use crate::needle::{Increment, Play, Torsion, TorsionConfig};
use nalgebra::{Matrix3, Matrix4, Matrix6, Matrix6x4, Rotation3, Vector3, Vector4, Vector6};

/// By how much a parameter is moved, rad or rad/mm, to see what it does.
const NUDGE: f64 = 1e-6;

/// What is not known before an insertion, as variances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Of the tip's position in each coordinate, mm².
    pub position_mm2: f64,
    /// Of yaw, pitch and roll, rad².
    pub angles_rad2: Vector3<f64>,
    /// Of curvature, per mm², and of torsion: half-width, rad², its growth, (rad/mm)², and offset,
    /// rad². 0 where it is known.
    pub parameters: Vector4<f64>,
}

/// The covariance of an efficient estimate along the true path: the Gaussian information bound.
///
/// The left-invariant error ε, `g = ĝ Exp(ε)`, moves as `ε⁺ = Ad(Exp(−ξ Δℓ)) ε + J δp` with the
/// unknown parameters p, and a position is `R ε_v` and noise (Barrau & Bonnabel, invariant EKF).
/// Both are linear up to what ε does to itself, so the recursion of the covariance along the true
/// path is the bound for Gaussian noise of that variance; of uniform noise of the same variance it
/// is that of the best linear estimate.
#[derive(Debug, Clone)]
pub struct InformationBound {
    /// Of ε.
    pose: Matrix6<f64>,
    /// Of ε with the parameters.
    cross: Matrix6x4<f64>,
    /// Of the parameters.
    parameters: Matrix4<f64>,
    /// Variance of each coordinate of a measured position, mm².
    measurement_mm2: f64,
    torsion: TorsionSensitivity,
    last: Pose,
    last_base: (f64, f64),
}

impl InformationBound {
    /// A bound for a needle of this torsion that begins at `start` (`X_PB`).
    pub fn new(prior: &Prior, measurement_mm2: f64, start: Pose, torsion: Torsion) -> Self {
        let turn = turn_by_angles(&start.rotation);
        let mut pose = Matrix6::zeros();
        pose.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(prior.position_mm2);
        let turned = turn * Matrix3::from_diagonal(&prior.angles_rad2) * turn.transpose();
        pose.fixed_view_mut::<3, 3>(3, 3).copy_from(&turned);
        InformationBound {
            pose,
            cross: Matrix6x4::zeros(),
            parameters: Matrix4::from_diagonal(&prior.parameters),
            measurement_mm2,
            torsion: TorsionSensitivity::new(torsion),
            last: start,
            last_base: (0.0, 0.0),
        }
    }

    /// Carries the bound on to the true tip `x_pb`, with the base at this depth, mm, and rotation,
    /// rad.
    pub fn advance(&mut self, x_pb: &Pose, insertion_mm: f64, rotation_rad: f64) {
        let moved = self.last.inverse() * *x_pb;
        let f = moved.inverse().adjoint();
        if self.parameters.iter().any(|variance| *variance != 0.0) {
            let xi = moved.log();
            let inserted_mm = (insertion_mm - self.last_base.0).max(0.0);
            let base = Increment::new(inserted_mm, rotation_rad - self.last_base.1);
            let lags = base.map(|base| self.torsion.advance(base)).unwrap_or_default();
            let mut j = Matrix6x4::zeros();
            j.set_column(0, &(sensitivity(&xi, Vector3::x()) * inserted_mm));
            let roll = sensitivity(&xi, Vector3::z());
            for (parameter, lag) in lags.iter().enumerate() {
                j.set_column(parameter + 1, &(roll * *lag));
            }
            let mixed = f * self.cross * j.transpose();
            self.pose = f * self.pose * f.transpose()
                + mixed
                + mixed.transpose()
                + j * self.parameters * j.transpose();
            self.cross = f * self.cross + j * self.parameters;
        } else {
            self.pose = f * self.pose * f.transpose();
        }
        self.last = *x_pb;
        self.last_base = (insertion_mm, rotation_rad);
    }

    /// Takes in one measured position.
    pub fn measure(&mut self) {
        let of_position =
            self.pose.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * self.measurement_mm2;
        let Some(inverse) = of_position.try_inverse() else { return };
        let gain = self.pose.fixed_columns::<3>(0) * inverse;
        let gain_parameters = self.cross.fixed_rows::<3>(0).transpose() * inverse;
        let pose = self.pose - gain * self.pose.fixed_rows::<3>(0);
        let cross = self.cross - gain * self.cross.fixed_rows::<3>(0);
        self.parameters -= gain_parameters * self.cross.fixed_rows::<3>(0);
        self.pose = (pose + pose.transpose()) * 0.5;
        self.cross = cross;
    }

    /// The variances of x, y, z, mm², and of yaw, pitch and roll, deg², here; `None` at pitch ±90°.
    pub fn variances(&self) -> Option<[f64; 6]> {
        let r = self.last.rotation.matrix();
        let position = r * self.pose.fixed_view::<3, 3>(0, 0) * r.transpose();
        let to_angles = turn_by_angles(&self.last.rotation).try_inverse()?;
        let angles = to_angles * self.pose.fixed_view::<3, 3>(3, 3) * to_angles.transpose();
        let deg2 = 1f64.to_degrees().powi(2);
        let [a, b, c] = [0, 1, 2].map(|i| angles[(i, i)] * deg2);
        Some([position[(0, 0)], position[(1, 1)], position[(2, 2)], a, b, c])
    }
}

/// What small changes of (yaw, pitch, roll) turn the tip by, in its own frame:
/// `(Ry Rz)ᵀ e_x, Rzᵀ e_y, e_z` of `R = Rx Ry Rz`.
fn turn_by_angles(rotation: &Rotation3<f64>) -> Matrix3<f64> {
    let FixedAngles { pitch, roll, .. } = FixedAngles::from_rotation(rotation);
    let about_z = FixedAngles { roll, ..FixedAngles::default() }.to_rotation().inverse();
    let about_y = FixedAngles { pitch, ..FixedAngles::default() }.to_rotation().inverse();
    let yaw = about_z * (about_y * Vector3::x());
    Matrix3::from_columns(&[yaw, about_z * Vector3::y(), Vector3::z()])
}

/// How the end of `Exp(ξ)` moves, in its own frame, as ξ turns more about `axis`: a column of the
/// right Jacobian of SE(3).
fn sensitivity(xi: &Twist, axis: Vector3<f64>) -> Vector6<f64> {
    let nudged = Twist { v: xi.v, w: xi.w + axis * NUDGE };
    (Pose::exp(xi).inverse() * Pose::exp(&nudged)).log().to_vector() / NUDGE
}

/// How the lag of a play depends on its parameters, along one path of the base.
#[derive(Debug, Clone)]
struct TorsionSensitivity {
    nominal: (Torsion, Play),
    /// With half-width, growth and offset moved, and by how much; `None` where neither way is
    /// allowed.
    nudged: [Option<(Torsion, Play, f64)>; 3],
    last: [f64; 3],
}

impl TorsionSensitivity {
    fn new(torsion: Torsion) -> Self {
        let config = torsion.config();
        let nudged = |change: fn(&mut TorsionConfig, f64)| {
            [NUDGE, -NUDGE].into_iter().find_map(|nudge| {
                let mut moved = config;
                change(&mut moved, nudge);
                Some((Torsion::new(moved).ok()?, Play::default(), nudge))
            })
        };
        TorsionSensitivity {
            nominal: (torsion, Play::default()),
            nudged: [
                nudged(|config, nudge| config.half_width_rad += nudge),
                nudged(|config, nudge| config.half_width_rad_per_mm += nudge),
                nudged(|config, nudge| config.offset_rad += nudge),
            ],
            last: [0.0; 3],
        }
    }

    /// By how much the derivative of the lag by each parameter changes over `base`.
    fn advance(&mut self, base: Increment) -> [f64; 3] {
        let follow = |torsion: &Torsion, play: &mut Play| {
            play.advance(torsion, base).for_each(drop);
            play.lag_rad()
        };
        let (torsion, play) = &mut self.nominal;
        let lag_rad = follow(torsion, play);
        let mut changes = [0.0; 3];
        for ((nudged, last), change) in self.nudged.iter_mut().zip(&mut self.last).zip(&mut changes)
        {
            if let Some((torsion, play, nudge)) = nudged {
                let derivative = (follow(torsion, play) - lag_rad) / *nudge;
                *change = derivative - *last;
                *last = derivative;
            }
        }
        changes
    }
}
