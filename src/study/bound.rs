//! The information bound: the covariance of the best possible estimate.

use crate::geometry::{FixedAngles, Pose, Twist};
use crate::needle::{Increment, Needle, Play, Torsion, TorsionConfig};
use crate::observer::standard_deviations;
use nalgebra::{Matrix3, Matrix4, Matrix6, Matrix6x4, Rotation3, Vector3, Vector4, Vector6};

/// Step of the numerical derivative with respect to a parameter, rad or rad/mm.
const DERIVATIVE_STEP: f64 = 1e-6;

/// The prior before an insertion, as variances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Variance of the tip's position in each coordinate, mm².
    pub position_mm2: f64,
    /// Variances of yaw, pitch and roll, rad².
    pub angles_rad2: Vector3<f64>,
    /// Variances of curvature, per mm², and of torsion: half-width, rad², its growth, (rad/mm)²,
    /// and offset, rad². A known parameter has variance 0.
    pub parameters: Vector4<f64>,
}

/// The covariance of an efficient estimate along the true path: the Gaussian information bound.
///
/// The left-invariant error ε, `g = ĝ Exp(ε)`, propagates as `ε⁺ = Ad(Exp(−ξ Δℓ)) ε + J δp` with
/// the unknown parameters p, and a measured position is `R ε_v` plus noise (Barrau & Bonnabel,
/// invariant EKF). Both are linear to first order in ε, so the recursion of the covariance along
/// the true path is the bound for Gaussian noise of that variance. For uniform noise of the same
/// variance it is the covariance of the best linear estimate.
#[derive(Debug, Clone)]
pub struct InformationBound {
    /// Covariance of ε.
    pose: Matrix6<f64>,
    /// Covariance of ε with the parameters.
    cross: Matrix6x4<f64>,
    /// Covariance of the parameters.
    parameters: Matrix4<f64>,
    /// Variance of each coordinate of a measured position, mm².
    measurement_mm2: f64,
    needle: Needle,
    torsion: TorsionSensitivity,
    last: Pose,
    last_base: (f64, f64),
}

impl InformationBound {
    /// A bound for this needle and shaft, from the pose `start` (`X_PB`).
    pub fn new(
        prior: &Prior,
        measurement_mm2: f64,
        start: Pose,
        needle: Needle,
        torsion: Torsion,
    ) -> Self {
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
            needle,
            torsion: TorsionSensitivity::new(torsion),
            last: start,
            last_base: (0.0, 0.0),
        }
    }

    /// Propagates the bound to the true tip `x_pb`, with the base at this depth, mm, and rotation,
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
            j.set_column(0, &sensitivity(&xi, &self.needle.twist_by_curvature(inserted_mm)));
            let roll = sensitivity(&xi, &Twist { v: Vector3::zeros(), w: Vector3::z() });
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

    /// Updates the bound with the mean of this many measured positions.
    pub fn measure(&mut self, positions: u32) {
        let mean_mm2 = self.measurement_mm2 / f64::from(positions);
        let of_position = self.pose.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * mean_mm2;
        let Some(inverse) = of_position.try_inverse() else { return };
        let gain = self.pose.fixed_columns::<3>(0) * inverse;
        let gain_parameters = self.cross.fixed_rows::<3>(0).transpose() * inverse;
        let pose = self.pose - gain * self.pose.fixed_rows::<3>(0);
        let cross = self.cross - gain * self.cross.fixed_rows::<3>(0);
        self.parameters -= gain_parameters * self.cross.fixed_rows::<3>(0);
        self.pose = (pose + pose.transpose()) * 0.5;
        self.cross = cross;
    }

    /// The bound as standard deviations: x, y, z in mm; yaw, pitch and roll in rad.
    pub fn standard_deviations(&self) -> [f64; 6] {
        standard_deviations(&self.last, &self.pose)
    }
}

/// The derivatives of the tip's rotation, in the tip frame, with respect to yaw, pitch and roll:
/// `(Ry Rz)ᵀ e_x, Rzᵀ e_y, e_z` for `R = Rx Ry Rz`.
fn turn_by_angles(rotation: &Rotation3<f64>) -> Matrix3<f64> {
    let FixedAngles { pitch, roll, .. } = FixedAngles::from_rotation(rotation);
    let about_z = FixedAngles { roll, ..FixedAngles::default() }.to_rotation().inverse();
    let about_y = FixedAngles { pitch, ..FixedAngles::default() }.to_rotation().inverse();
    let yaw = about_z * (about_y * Vector3::x());
    Matrix3::from_columns(&[yaw, about_z * Vector3::y(), Vector3::z()])
}

/// The motion of the end of `Exp(ξ)`, in its own frame, per change of ξ by `change`: the right Jacobian of SE(3) times
/// `change`, by a finite difference.
fn sensitivity(xi: &Twist, change: &Twist) -> Vector6<f64> {
    let perturbed =
        Twist { v: xi.v + change.v * DERIVATIVE_STEP, w: xi.w + change.w * DERIVATIVE_STEP };
    (Pose::exp(xi).inverse() * Pose::exp(&perturbed)).log().to_vector() / DERIVATIVE_STEP
}

/// How the lag of a play depends on its parameters, along one path of the base.
#[derive(Debug, Clone)]
struct TorsionSensitivity {
    nominal: (Torsion, Play),
    /// The torsions with half-width, growth or offset changed, each with its change; `None` if a change is allowed in
    /// neither direction.
    perturbed: [Option<(Torsion, Play, f64)>; 3],
    last: [f64; 3],
}

impl TorsionSensitivity {
    fn new(torsion: Torsion) -> Self {
        let config = torsion.config();
        let perturbed = |change: fn(&mut TorsionConfig, f64)| {
            [DERIVATIVE_STEP, -DERIVATIVE_STEP].into_iter().find_map(|step| {
                let mut moved = config;
                change(&mut moved, step);
                Some((Torsion::new(moved).ok()?, Play::default(), step))
            })
        };
        TorsionSensitivity {
            nominal: (torsion, Play::default()),
            perturbed: [
                perturbed(|config, step| config.half_width_rad += step),
                perturbed(|config, step| config.half_width_rad_per_mm += step),
                perturbed(|config, step| config.offset_rad += step),
            ],
            last: [0.0; 3],
        }
    }

    /// The change, over `base`, of the lag's derivative with respect to each parameter.
    fn advance(&mut self, base: Increment) -> [f64; 3] {
        let follow = |torsion: &Torsion, play: &mut Play| {
            play.advance(torsion, base).for_each(drop);
            play.lag_rad()
        };
        let (torsion, play) = &mut self.nominal;
        let lag_rad = follow(torsion, play);
        let mut changes = [0.0; 3];
        for ((perturbed, last), change) in
            self.perturbed.iter_mut().zip(&mut self.last).zip(&mut changes)
        {
            if let Some((torsion, play, step)) = perturbed {
                let derivative = (follow(torsion, play) - lag_rad) / *step;
                *change = derivative - *last;
                *last = derivative;
            }
        }
        changes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    fn needle() -> Needle {
        Needle::new(1.0 / 122.0).unwrap()
    }

    fn prior(parameters: Vector4<f64>) -> Prior {
        let angles_rad2 = Vector3::new(0.03, 0.02, PI * PI / 3.0);
        Prior { position_mm2: 1e6, angles_rad2, parameters }
    }

    /// A bound along 60 mm of a turning needle that starts at `start`.
    fn along(start: Pose, parameters: Vector4<f64>) -> InformationBound {
        let mut bound = InformationBound::new(
            &prior(parameters),
            1.0 / 3.0,
            start,
            needle(),
            Torsion::default(),
        );
        let (mut tip, mut turned_rad) = (start, 0.0);
        for step in 0..60 {
            bound.measure(1);
            let turn = 0.1 * f64::from(step).sin();
            tip = needle().step(&tip, Increment::new(1.0, turn).unwrap());
            turned_rad += turn;
            bound.advance(&tip, f64::from(step) + 1.0, turned_rad);
        }
        bound
    }

    /// The variance is that of the mean of the positions.
    #[test]
    fn positions_at_standstill_average() {
        let mut bound = InformationBound::new(
            &prior(Vector4::zeros()),
            0.25,
            Pose::identity(),
            needle(),
            Torsion::default(),
        );
        (0..10).for_each(|_| bound.measure(1));
        for sd_mm in &bound.standard_deviations()[..3] {
            assert!((sd_mm * sd_mm - 0.025).abs() < 1e-8, "{sd_mm}");
        }
    }

    /// Along a straight line the heading is the slope of a regression through n positions 1 mm
    /// apart, with variance `12 σ² / (n (n² − 1))`. The end of the line has the variance `σ² (4 n −
    /// 2) / (n (n + 1))`.
    #[test]
    fn the_bound_of_a_straight_needle_is_that_of_a_regression() {
        let straight = Needle::new(0.0).unwrap();
        let unknown = Prior { angles_rad2: Vector3::repeat(1e4), ..prior(Vector4::zeros()) };
        let start = Pose::identity();
        let mut bound = InformationBound::new(&unknown, 0.25, start, needle(), Torsion::default());
        let (mut tip, n) = (start, 50.0);
        bound.measure(1);
        for step in 1..50 {
            tip = straight.step(&tip, Increment::new(1.0, 0.0).unwrap());
            bound.advance(&tip, f64::from(step), 0.0);
            bound.measure(1);
        }
        let [x_mm, _, z_mm, _, pitch_rad, _] = bound.standard_deviations();
        assert!((pitch_rad.powi(2) / (12.0 * 0.25 / (n * (n * n - 1.0))) - 1.0).abs() < 1e-3);
        assert!((x_mm.powi(2) / (0.25 * (4.0 * n - 2.0) / (n * (n + 1.0))) - 1.0).abs() < 1e-3);
        assert!((z_mm.powi(2) / (0.25 / n) - 1.0).abs() < 1e-3, "averaged along the path");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]

        /// The bound of ε is the same in every frame.
        #[test]
        fn the_bound_is_left_invariant(v in prop::array::uniform3(-20.0..20.0f64), roll in -3.0..3.0f64) {
            let moved = Pose {
                rotation: FixedAngles { roll, ..FixedAngles::default() }.to_rotation(),
                translation: Vector3::from(v),
            };
            // The position prior is equal in every direction; of the angles only roll is uncertain.
            let start = Pose::identity();
            let unknown = Prior { angles_rad2: Vector3::repeat(0.1), ..prior(Vector4::zeros()) };
            let new = |start| InformationBound::new(&unknown, 0.3, start, needle(), Torsion::default());
            let (mut here, mut there) = (new(start), new(moved * start));
            let needle = Needle::new(0.01).unwrap();
            let mut tip = start;
            for step in 1..30 {
                tip = needle.step(&tip, Increment::new(1.0, 0.05).unwrap());
                here.advance(&tip, f64::from(step), 0.0);
                there.advance(&(moved * tip), f64::from(step), 0.0);
                here.measure(1);
                there.measure(1);
            }
            prop_assert!((here.pose - there.pose).norm() < 1e-9 * here.pose.norm());
        }
    }

    /// A parameter with variance 0 does not raise it.
    #[test]
    fn unknown_parameters_raise_the_bound() {
        let start = Pose::identity();
        let known = along(start, Vector4::zeros()).standard_deviations();
        let curvature = along(start, Vector4::new(1e-6, 0.0, 0.0, 0.0)).standard_deviations();
        let torsion = along(start, Vector4::new(0.0, 0.1, 1e-4, 0.1)).standard_deviations();
        let barely = along(start, Vector4::new(1e-20, 0.0, 0.0, 0.0)).standard_deviations();
        for i in 0..6 {
            assert!(
                curvature[i] >= known[i] * (1.0 - 1e-9) && torsion[i] >= known[i] * (1.0 - 1e-9)
            );
            assert!((barely[i] / known[i] - 1.0).abs() < 1e-6);
        }
        assert!(curvature[1] > 1.01 * known[1], "curvature shows in y: {curvature:?} {known:?}");
        assert!(torsion[5] > 5.0 * known[5], "torsion shows in the roll: {torsion:?} {known:?}");
    }

    /// The reference is a step with a little more curvature.
    #[test]
    fn sensitivities_are_derivatives_of_the_step() {
        let increment = Increment::new(1.0, 0.3).unwrap();
        let xi = Needle::new(0.01).unwrap().twist(increment);
        let column = sensitivity(&xi, &Needle::new(0.01).unwrap().twist_by_curvature(1.0));
        let step = |k: f64| Needle::new(k).unwrap().step(&Pose::identity(), increment);
        let moved = (step(0.01).inverse() * step(0.01 + 1e-5)).log().to_vector() / 1e-5;
        assert!((column - moved).norm() < 1e-4, "{column} {moved}");
    }

    #[test]
    fn the_lag_depends_on_the_band_at_its_edges_only() {
        let config = TorsionConfig { half_width_rad: 0.2, ..TorsionConfig::default() };
        let mut sensitivity = TorsionSensitivity::new(Torsion::new(config).unwrap());
        let base = |turn| Increment::new(1.0, turn).unwrap();
        assert_eq!(sensitivity.advance(base(0.1)), [0.0; 3]);
        // The lag is at the lower edge, c − w₀ − w₁ ℓ, with ℓ = 2 mm.
        let [width, growth, offset] = sensitivity.advance(base(0.5));
        assert!(
            (width + 1.0).abs() < 1e-6
                && (growth + 2.0).abs() < 1e-6
                && (offset - 1.0).abs() < 1e-6
        );
    }
}
