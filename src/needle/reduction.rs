//! The task-induced reduction (paper Section 4): splits a pose in the plane frame into the coordinates
//! that matter for the plane (x, pitch, roll) and the others (y, z, yaw), and joins them again.

use crate::geometry::{FixedAngles, Pose};
use nalgebra::Vector3;

/// The reduced state r = (x, β, γ) (paper Eq. 3), in the plane frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reduced {
    /// Distance from the plane, mm.
    pub x_mm: f64,
    /// Pitch β out of the plane, rad.
    pub pitch_rad: f64,
    /// Roll γ of the bevel, rad.
    pub roll_rad: f64,
}

/// The fibre state h = (y, z, α) (paper Eq. 4), in the plane frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Fibre {
    /// Position in the plane, mm.
    pub y_mm: f64,
    /// Position in the plane, mm.
    pub z_mm: f64,
    /// Yaw α in the plane, rad.
    pub yaw_rad: f64,
}

impl Reduced {
    /// Splits the tip pose `x_pb` (tip B in plane frame P).
    pub fn split(x_pb: &Pose) -> (Reduced, Fibre) {
        let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(&x_pb.rotation);
        let p = x_pb.translation;
        (
            Reduced { x_mm: p.x, pitch_rad: pitch, roll_rad: roll },
            Fibre { y_mm: p.y, z_mm: p.z, yaw_rad: yaw },
        )
    }

    /// The pose `X_PB` with this reduced state over the fibre point `fibre`: the inverse of
    /// [`Reduced::split`] for |pitch| < π/2.
    pub fn join(&self, fibre: &Fibre) -> Pose {
        let angles = FixedAngles { yaw: fibre.yaw_rad, pitch: self.pitch_rad, roll: self.roll_rad };
        let translation = Vector3::new(self.x_mm, fibre.y_mm, fibre.z_mm);
        Pose { rotation: angles.to_rotation(), translation }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::needle::{Increment, Needle};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn split_and_join_are_inverse(p in prop::array::uniform3(-50.0..50.0f64), yaw in -3.1..3.1f64, pitch in -1.5..1.5f64, roll in -3.1..3.1f64) {
            let pose = Pose { rotation: FixedAngles { yaw, pitch, roll }.to_rotation(), translation: Vector3::from(p) };
            let (reduced, fibre) = Reduced::split(&pose);
            let back = reduced.join(&fibre);
            prop_assert!((back.translation - pose.translation).norm() < 1e-12);
            prop_assert!((back.rotation.matrix() - pose.rotation.matrix()).norm() < 1e-12);
        }

        /// Eq. 3 and 4 (v = 1) are the derivative of the exact step of Eq. 1.
        #[test]
        fn rates_are_the_derivative_of_the_step(yaw in -3.0..3.0f64, pitch in -1.2..1.2f64, roll in -3.0..3.0f64, omega in -0.5..0.5f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let (reduced, fibre) = (Reduced { x_mm: 3.0, pitch_rad: pitch, roll_rad: roll }, Fibre { y_mm: 1.0, z_mm: 2.0, yaw_rad: yaw });
            let k = needle.curvature_per_mm();
            let h = 1e-4;
            let (r, f) = Reduced::split(&needle.step(&reduced.join(&fibre), Increment::new(h, omega * h).unwrap()));
            let close = |after: f64, before: f64, rate: f64| ((after - before) / h - rate).abs() < 1e-4;
            prop_assert!(close(r.x_mm, reduced.x_mm, pitch.sin()));
            prop_assert!(close(r.pitch_rad, pitch, k * roll.sin()));
            prop_assert!(close(r.roll_rad, roll, omega - k * roll.cos() * pitch.tan()));
            prop_assert!(close(f.y_mm, fibre.y_mm, -yaw.sin() * pitch.cos()));
            prop_assert!(close(f.z_mm, fibre.z_mm, yaw.cos() * pitch.cos()));
            prop_assert!(close(f.yaw_rad, yaw, k * roll.cos() / pitch.cos()));
        }

        /// This is the symmetry of the plane task.
        #[test]
        fn the_reduced_motion_does_not_depend_on_the_fibre(yaw in -3.0..3.0f64, y in -50.0..50.0f64, z in -50.0..50.0f64, pitch in -1.2..1.2f64, roll in -3.0..3.0f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let reduced = Reduced { x_mm: 3.0, pitch_rad: pitch, roll_rad: roll };
            let i = Increment::new(1.0, 0.1).unwrap();
            let (a, _) = Reduced::split(&needle.step(&reduced.join(&Fibre::default()), i));
            let (b, _) = Reduced::split(&needle.step(&reduced.join(&Fibre { y_mm: y, z_mm: z, yaw_rad: yaw }), i));
            prop_assert!((a.x_mm - b.x_mm).abs() < 1e-11 && (a.pitch_rad - b.pitch_rad).abs() < 1e-12 && (a.roll_rad - b.roll_rad).abs() < 1e-11);
        }
    }
}
