//! Converts orientations as senders write them to rotations, or refuses them.

use crate::geometry::so3;
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion};

/// How far `RᵀR` may be from the identity (Frobenius norm). Single precision leaves 1e-6, matrices
/// written as text with four digits 1e-4.
const ROTATION_TOLERANCE: f64 = 1e-3;

const POLISHING_STEPS: usize = 3;

/// A quaternion of one of these lengths is normalised. The length has no meaning, and the reference
/// library's own examples and fixtures send one of 0.88.
const QUATERNION_NORM: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// A quaternion whose squared length is this near to 1 is kept as it is, so that a recorded one
/// reads back to the same bits.
const UNIT_TOLERANCE: f64 = 1e-12;

/// An orientation as it was sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Orientation {
    /// No orientation was sent.
    Absent,
    /// The orientation that was sent is not a rotation.
    NotARotation,
    /// A rotation.
    Rotation(UnitQuaternion<f64>),
}

impl Orientation {
    /// The rotation nearest to `matrix`, if `matrix` is a rotation within [`ROTATION_TOLERANCE`].
    pub(super) fn of_matrix(matrix: &Matrix3<f64>) -> Self {
        let residual = (matrix.transpose() * matrix - Matrix3::identity()).norm();
        // Written so that NaN is refused.
        let is_rotation = residual <= ROTATION_TOLERANCE && matrix.determinant() > 0.0;
        if !is_rotation {
            return Orientation::NotARotation;
        }
        // Newton and Schulz's iteration to the nearest rotation (Higham, *Functions of Matrices*,
        // Eq. 8.20) squares the residual: 1e-3, 1e-6, 1e-12, rounding. The number of steps is fixed,
        // so that no peer can make it long.
        let polished = (0..POLISHING_STEPS)
            .fold(*matrix, |r, _| r * (3.0 * Matrix3::identity() - r.transpose() * r) * 0.5);
        Orientation::Rotation(so3::quaternion(&Rotation3::from_matrix_unchecked(polished)))
    }

    /// The rotation of a quaternion w, x, y, z, if its length is within [`QUATERNION_NORM`].
    pub(super) fn of_quaternion([w, x, y, z]: [f64; 4]) -> Self {
        let quaternion = Quaternion::new(w, x, y, z);
        if !QUATERNION_NORM.contains(&quaternion.norm()) {
            return Orientation::NotARotation;
        }
        let is_unit = (quaternion.norm_squared() - 1.0).abs() <= UNIT_TOLERANCE;
        Orientation::Rotation(match is_unit {
            true => UnitQuaternion::new_unchecked(quaternion),
            false => UnitQuaternion::new_normalize(quaternion),
        })
    }

    /// The rotation of a unit quaternion from its x, y, z; its w is not negative.
    pub(super) fn of_imaginary([x, y, z]: [f64; 3]) -> Self {
        // By rounding, a half turn may be slightly longer than 1.
        let w_squared = 1.0 - x * x - y * y - z * z;
        if w_squared < -ROTATION_TOLERANCE {
            return Orientation::NotARotation;
        }
        Self::of_quaternion([w_squared.max(0.0).sqrt(), x, y, z])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    fn quaternion(orientation: Orientation) -> UnitQuaternion<f64> {
        match orientation {
            Orientation::Rotation(quaternion) => quaternion,
            other => panic!("{other:?}"),
        }
    }

    fn rotation(orientation: Orientation) -> Rotation3<f64> {
        quaternion(orientation).to_rotation_matrix()
    }

    #[test]
    fn an_exact_identity_stays_exact() {
        let identity = rotation(Orientation::of_matrix(&Matrix3::identity()));
        assert_eq!(identity, Rotation3::identity());
    }

    proptest! {
        /// An orientation is recorded as a quaternion.
        #[test]
        fn a_recorded_quaternion_is_read_bit_for_bit(
            wxyz in prop::array::uniform4(-1.0..1.0f64),
            angles in prop::array::uniform3(-3.0..3.0f64),
        ) {
            let [roll, pitch, yaw] = angles;
            let matrix = Rotation3::from_euler_angles(roll, pitch, yaw);
            let sent = [Orientation::of_quaternion(wxyz), Orientation::of_matrix(matrix.matrix())];
            for sent in sent.into_iter().filter(|sent| *sent != Orientation::NotARotation) {
                let q = quaternion(sent);
                prop_assert_eq!(Orientation::of_quaternion([q.w, q.i, q.j, q.k]), sent);
            }
        }

        /// The reference is nalgebra's singular value decomposition: U Vᵀ.
        #[test]
        fn a_rounded_matrix_gives_the_nearest_rotation(
            angles in prop::array::uniform3(-3.0..3.0f64),
            noise in prop::array::uniform9(-1e-4..1e-4f64),
        ) {
            let [roll, pitch, yaw] = angles;
            let exact = Rotation3::from_euler_angles(roll, pitch, yaw);
            let sent = exact.matrix() + Matrix3::from_column_slice(&noise);
            let taken = rotation(Orientation::of_matrix(&sent));
            let svd = sent.svd(true, true);
            let nearest = svd.u.expect("asked for") * svd.v_t.expect("asked for");
            prop_assert!((taken.matrix() - nearest).norm() < 1e-12);
            prop_assert!((taken.matrix().determinant() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_two_forms_of_a_quaternion_agree() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let full = rotation(Orientation::of_quaternion([half, half, 0.0, 0.0]));
        let imaginary = rotation(Orientation::of_imaginary([half, 0.0, 0.0]));
        assert!((full * Vector3::y() - Vector3::z()).norm() < 1e-15);
        assert!((full.matrix() - imaginary.matrix()).norm() < 1e-15);
        let half_turn = rotation(Orientation::of_imaginary([1.000_000_1, 0.0, 0.0]));
        assert!((half_turn * Vector3::z() + Vector3::z()).norm() < 1e-6);
    }

    #[test]
    fn a_quaternion_of_another_length_is_normalised() {
        let unit = rotation(Orientation::of_quaternion([0.5; 4]));
        let short = rotation(Orientation::of_quaternion([0.3; 4]));
        assert!((unit.matrix() - short.matrix()).norm() < 1e-12);
    }

    #[test]
    fn matrices_and_quaternions_that_are_not_rotations_are_marked() {
        let reflection = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        let matrices = [
            Matrix3::zeros(),
            reflection,
            2.0 * Matrix3::identity(),
            Matrix3::from_element(f64::NAN),
        ];
        for matrix in matrices {
            assert_eq!(Orientation::of_matrix(&matrix), Orientation::NotARotation);
        }
        for wxyz in [[0.0; 4], [1.1; 4], [f64::NAN; 4], [f64::INFINITY, 0.0, 0.0, 0.0]] {
            assert_eq!(Orientation::of_quaternion(wxyz), Orientation::NotARotation);
        }
        for xyz in [[1.1, 0.0, 0.0], [f64::NAN; 3]] {
            assert_eq!(Orientation::of_imaginary(xyz), Orientation::NotARotation);
        }
    }
}
