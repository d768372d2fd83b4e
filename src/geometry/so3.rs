//! Rotations: the exponential map of SO(3), its inverse and its left Jacobian. Names and conventions are
//! those of Solà et al., A micro Lie theory for state estimation in robotics (arXiv 1812.01537).

use crate::math;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Below this angle, rad, a series replaces the closed forms, which lose digits to cancellation. The first omitted
/// term is under 1e-16 there.
const SERIES_ANGLE_RAD: f64 = 1e-2;

/// The skew-symmetric matrix with `hat(w) u = w × u`.
pub fn hat(w: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -w.z, w.y, w.z, 0.0, -w.x, -w.y, w.x, 0.0)
}

/// `sin θ / θ`, `(1 − cos θ) / θ²` and `(θ − sin θ) / θ³`, finite at any θ. The first two are accurate to rounding. The
/// third has a relative error of up to 5e-12 just above [`SERIES_ANGLE_RAD`]; times θ² that is under 1e-16.
fn coefficients(theta: f64) -> (f64, f64, f64) {
    let t2 = theta * theta;
    if theta < SERIES_ANGLE_RAD {
        (
            1.0 - t2 / 6.0 * (1.0 - t2 / 20.0 * (1.0 - t2 / 42.0)),
            0.5 * (1.0 - t2 / 12.0 * (1.0 - t2 / 30.0 * (1.0 - t2 / 56.0))),
            (1.0 - t2 / 20.0 * (1.0 - t2 / 42.0 * (1.0 - t2 / 72.0))) / 6.0,
        )
    } else {
        let half = math::sin(0.5 * theta) / (0.5 * theta);
        let sin = math::sin(theta);
        (sin / theta, 0.5 * half * half, (theta - sin) / (t2 * theta))
    }
}

/// The rotation by `|w|` about `w`: Rodrigues' formula, `I + a ŵ + b ŵ²` with the first two coefficients.
pub fn exp(w: &Vector3<f64>) -> Rotation3<f64> {
    exp_and_left_jacobian(w).0
}

/// [`exp`] and the left Jacobian `J_l`, which share their coefficients: `Exp(w + d) ≈ Exp(J_l(w) d) Exp(w)`. `J_l` is
/// also the translation part of SE(3)'s exponential.
pub(super) fn exp_and_left_jacobian(w: &Vector3<f64>) -> (Rotation3<f64>, Matrix3<f64>) {
    let (a, b, c) = coefficients(w.norm());
    let w_hat = hat(w);
    let (one, square) = (Matrix3::identity(), w_hat * w_hat);
    let rotation = Rotation3::from_matrix_unchecked(one + w_hat * a + square * b);
    (rotation, one + w_hat * b + square * c)
}

/// The rotation vector of `rotation`, of length 0 to π.
///
/// Computed through the quaternion, which is accurate both near 0 and near π.
pub fn log(rotation: &Rotation3<f64>) -> Vector3<f64> {
    let q = UnitQuaternion::from_rotation_matrix(rotation);
    let (w, v) = if q.w < 0.0 { (-q.w, -q.imag()) } else { (q.w, q.imag()) };
    let norm = v.norm();
    if norm < 1e-9 { v * 2.0 } else { v * (2.0 * math::atan2(norm, w) / norm) }
}

/// The quaternion of `rotation`. Its length is 1 to rounding even if `rotation` has drifted off
/// SO(3). Values that are not finite stay so.
pub fn quaternion(rotation: &Rotation3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_normalize(UnitQuaternion::from_rotation_matrix(rotation).into_inner())
}

/// The inverse of the left Jacobian of SO(3), for |w| < 2π.
pub fn left_jacobian_inverse(w: &Vector3<f64>) -> Matrix3<f64> {
    let theta = w.norm();
    let w_hat = hat(w);
    let t2 = theta * theta;
    let c = if theta < SERIES_ANGLE_RAD {
        (1.0 + t2 / 60.0 * (1.0 + t2 / 42.0)) / 12.0
    } else {
        let half = 0.5 * theta;
        (1.0 - half * math::cos(half) / math::sin(half)) / t2
    };
    Matrix3::identity() - w_hat * 0.5 + w_hat * w_hat * c
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    fn vector(max: f64) -> impl Strategy<Value = Vector3<f64>> {
        (-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64, 0.0..max).prop_map(|(x, y, z, n)| {
            let v = Vector3::new(x, y, z);
            if v.norm() < 1e-3 { Vector3::new(n, 0.0, 0.0) } else { v.normalize() * n }
        })
    }

    proptest! {
        #[test]
        fn log_inverts_exp(w in vector(PI - 1e-6)) {
            prop_assert!((log(&exp(&w)) - w).norm() < 1e-9);
        }

        #[test]
        fn log_inverts_exp_for_tiny_rotations(w in vector(1e-7)) {
            prop_assert!((log(&exp(&w)) - w).norm() < 1e-15);
        }

        #[test]
        fn exp_is_a_rotation(w in vector(20.0)) {
            let r = exp(&w);
            prop_assert!((r.matrix() * r.matrix().transpose() - Matrix3::identity()).norm() < 1e-13);
            prop_assert!((r.matrix().determinant() - 1.0).abs() < 1e-13);
        }

        #[test]
        fn left_jacobian_times_its_inverse_is_one(w in vector(6.0)) {
            let product = exp_and_left_jacobian(&w).1 * left_jacobian_inverse(&w);
            prop_assert!((product - Matrix3::identity()).norm() < 1e-10);
        }

        #[test]
        fn left_jacobian_is_the_derivative_of_exp(w in vector(3.0), d in vector(1.0)) {
            let h = 1e-6;
            let difference = log(&(exp(&(w + d * h)) * exp(&(w - d * h)).inverse())) / (2.0 * h);
            let jacobian = exp_and_left_jacobian(&w).1;
            prop_assert!((difference - jacobian * d).norm() < 1e-8);
        }
    }

    #[test]
    fn series_and_closed_form_agree_where_they_meet() {
        let below = coefficients(SERIES_ANGLE_RAD * (1.0 - 1e-12));
        let above = coefficients(SERIES_ANGLE_RAD * (1.0 + 1e-12));
        assert!((below.0 - above.0).abs() < 1e-15);
        assert!((below.1 - above.1).abs() < 1e-15);
        assert!((below.2 - above.2).abs() < 1e-11);
    }
}
