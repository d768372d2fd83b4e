//! Rigid motions: poses, twists, and the exponential map between them.

use super::so3;
use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3, Vector6};
use std::ops::Mul;

/// A twist (v; w): translational part first, in mm, then rotational, in rad.
///
/// As a rate it is per mm of insertion; as an increment it is plain mm and rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Twist {
    /// Translational part.
    pub v: Vector3<f64>,
    /// Rotational part.
    pub w: Vector3<f64>,
}

impl Twist {
    /// The twist as one vector (v; w).
    pub fn to_vector(&self) -> Vector6<f64> {
        Vector6::new(self.v.x, self.v.y, self.v.z, self.w.x, self.w.y, self.w.z)
    }

    /// The twist of a vector (v; w).
    pub fn from_vector(xi: &Vector6<f64>) -> Self {
        Twist { v: xi.fixed_rows::<3>(0).into(), w: xi.fixed_rows::<3>(3).into() }
    }
}

/// A rigid motion g = (R, p) of SE(3): the pose of one frame in another, p in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Orientation R.
    pub rotation: Rotation3<f64>,
    /// Position p, mm.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// The identity.
    pub fn identity() -> Self {
        Pose { rotation: Rotation3::identity(), translation: Vector3::zeros() }
    }

    /// The motion reached by following the constant body twist `xi` for one unit.
    pub fn exp(xi: &Twist) -> Self {
        let (rotation, jacobian) = so3::exp_and_left_jacobian(&xi.w);
        Pose { rotation, translation: jacobian * xi.v }
    }

    /// The twist with `exp(log(g)) = g`, rotation part of length 0 to π.
    pub fn log(&self) -> Twist {
        let w = so3::log(&self.rotation);
        Twist { v: so3::left_jacobian_inverse(&w) * self.translation, w }
    }

    /// The inverse motion: `X_BW` for `X_WB`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Pose { rotation, translation: -(rotation * self.translation) }
    }

    /// The point `p` of the inner frame, in the outer frame, mm.
    pub fn transform(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * p + self.translation
    }

    /// Ad_g with `g Exp(ξ) = Exp(Ad_g ξ) g`, in the order (v; w).
    pub fn adjoint(&self) -> Matrix6<f64> {
        let r: &Matrix3<f64> = self.rotation.matrix();
        let mut ad = Matrix6::zeros();
        ad.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
        ad.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
        ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&(so3::hat(&self.translation) * r));
        ad
    }

    /// The same pose with its rotation projected back onto SO(3) through a unit quaternion. This
    /// removes rounding drift after many products. Values that are not finite stay so.
    pub fn renormalized(self) -> Self {
        Pose { rotation: so3::quaternion(&self.rotation).to_rotation_matrix(), ..self }
    }

    /// True if every number is finite.
    pub fn is_finite(&self) -> bool {
        self.translation.iter().chain(self.rotation.matrix().iter()).all(|v| v.is_finite())
    }
}

impl Mul for Pose {
    type Output = Pose;
    /// `X_AB * X_BC = X_AC`.
    fn mul(self, inner: Pose) -> Pose {
        Pose {
            rotation: self.rotation * inner.rotation,
            translation: self.rotation * inner.translation + self.translation,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn twist(v_mm: f64, w_rad: f64) -> impl Strategy<Value = Twist> {
        prop::array::uniform6(-1.0..1.0f64).prop_map(move |a| Twist {
            v: Vector3::new(a[0], a[1], a[2]) * v_mm,
            w: Vector3::new(a[3], a[4], a[5]) * w_rad,
        })
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        (a.translation - b.translation).norm() + (a.rotation.matrix() - b.rotation.matrix()).norm()
    }

    // One suite of laws: at random poses, near the identity, and at the identity.
    proptest! {
        #[test]
        fn log_inverts_exp(xi in twist(100.0, 1.7)) {
            prop_assert!((Pose::exp(&xi).log().to_vector() - xi.to_vector()).norm() < 1e-9);
        }

        #[test]
        fn log_inverts_exp_near_identity(xi in twist(1e-8, 1e-8)) {
            prop_assert!((Pose::exp(&xi).log().to_vector() - xi.to_vector()).norm() < 1e-15);
        }

        #[test]
        fn inverse_and_associativity(a in twist(50.0, 3.0), b in twist(50.0, 3.0), c in twist(50.0, 3.0)) {
            let (a, b, c) = (Pose::exp(&a), Pose::exp(&b), Pose::exp(&c));
            prop_assert!(distance(&(a * a.inverse()), &Pose::identity()) < 1e-12);
            prop_assert!(distance(&((a * b) * c), &(a * (b * c))) < 1e-11);
        }

        #[test]
        fn adjoint_moves_a_twist_across(g in twist(50.0, 3.0), xi in twist(1.0, 0.5)) {
            let g = Pose::exp(&g);
            let moved = Twist::from_vector(&(g.adjoint() * xi.to_vector()));
            prop_assert!(distance(&(g * Pose::exp(&xi)), &(Pose::exp(&moved) * g)) < 1e-10);
        }

        #[test]
        fn one_parameter_subgroup(xi in twist(10.0, 1.0), s in -2.0..2.0f64, t in -2.0..2.0f64) {
            let at = |k: f64| Pose::exp(&Twist { v: xi.v * k, w: xi.w * k });
            prop_assert!(distance(&(at(s) * at(t)), &at(s + t)) < 1e-12);
        }
    }

    #[test]
    fn renormalization_brings_a_rotation_back_and_always_ends() {
        let rotation = so3::exp(&Vector3::new(0.3, -2.0, 1.0));
        let drifted = Rotation3::from_matrix_unchecked(rotation.matrix() * (1.0 + 1e-9));
        let pose = Pose { rotation: drifted, translation: Vector3::zeros() }.renormalized();
        let r = pose.rotation.matrix();
        assert!((r.transpose() * r - Matrix3::identity()).norm() < 1e-14);
        assert!((r - rotation.matrix()).norm() < 1e-8);
        let nan = Rotation3::from_matrix_unchecked(Matrix3::from_element(f64::NAN));
        assert!(!Pose { rotation: nan, ..pose }.renormalized().is_finite());
    }

    #[test]
    fn exp_of_zero_is_the_identity() {
        let zero = Twist { v: Vector3::zeros(), w: Vector3::zeros() };
        assert_eq!(Pose::exp(&zero), Pose::identity());
        assert_eq!(Pose::identity().log(), zero);
    }
}
