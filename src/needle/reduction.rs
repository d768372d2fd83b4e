//! The task-induced reduction: a pose in the plane frame split into what the plane task sees
//! (x, pitch, roll) and what it does not (y, z, yaw), and put together again (paper Section 4).

use super::Needle;
use crate::geometry::{FixedAngles, Pose};
use crate::math;
use nalgebra::Vector3;
use thiserror::Error;

/// Why the reduced rates were refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ReductionError {
    /// At pitch ±90° roll and yaw are one angle and their rates are unbounded.
    #[error(
        "pitch is {:.3} deg: the paper's coordinates end at 90 deg, where yaw and roll cannot be told apart",
        .pitch_rad.to_degrees()
    )]
    PitchAtLimit {
        /// The pitch, rad.
        pitch_rad: f64,
    },
}

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

/// Rates per mm of insertion of both halves (paper Eq. 3 and 4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReducedRate {
    /// x′ = sin β.
    pub x: f64,
    /// β′ = κ sin γ, rad/mm.
    pub pitch_rad_per_mm: f64,
    /// γ′ = ω − κ cos γ tan β, rad/mm.
    pub roll_rad_per_mm: f64,
    /// y′ = −sin α cos β.
    pub y: f64,
    /// z′ = cos α cos β.
    pub z: f64,
    /// α′ = κ cos γ / cos β, rad/mm.
    pub yaw_rad_per_mm: f64,
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
        Pose {
            rotation: angles.to_rotation(),
            translation: Vector3::new(self.x_mm, fibre.y_mm, fibre.z_mm),
        }
    }

    /// Rates at rotation rate `omega_rad_per_mm` (paper Eq. 3 and 4, v = 1).
    ///
    /// # Errors
    /// [`ReductionError::PitchAtLimit`] where cos β < 1e-6.
    pub fn rates(
        &self,
        fibre: &Fibre,
        needle: &Needle,
        omega_rad_per_mm: f64,
    ) -> Result<ReducedRate, ReductionError> {
        let (sin_b, cos_b) = math::sin_cos(self.pitch_rad);
        if cos_b < 1e-6 {
            return Err(ReductionError::PitchAtLimit { pitch_rad: self.pitch_rad });
        }
        let (sin_g, cos_g) = math::sin_cos(self.roll_rad);
        let (sin_a, cos_a) = math::sin_cos(fibre.yaw_rad);
        let k = needle.curvature_per_mm();
        Ok(ReducedRate {
            x: sin_b,
            pitch_rad_per_mm: k * sin_g,
            roll_rad_per_mm: omega_rad_per_mm - k * cos_g * sin_b / cos_b,
            y: -sin_a * cos_b,
            z: cos_a * cos_b,
            yaw_rad_per_mm: k * cos_g / cos_b,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::needle::Increment;
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

        /// Eq. 3 and 4 are the derivative of the exact step of Eq. 1.
        #[test]
        fn rates_are_the_derivative_of_the_step(yaw in -3.0..3.0f64, pitch in -1.2..1.2f64, roll in -3.0..3.0f64, omega in -0.5..0.5f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let (reduced, fibre) = (Reduced { x_mm: 3.0, pitch_rad: pitch, roll_rad: roll }, Fibre { y_mm: 1.0, z_mm: 2.0, yaw_rad: yaw });
            let rate = reduced.rates(&fibre, &needle, omega).unwrap();
            let h = 1e-4;
            let (r, f) = Reduced::split(&needle.step(&reduced.join(&fibre), Increment::new(h, omega * h).unwrap()));
            let close = |after: f64, before: f64, rate: f64| ((after - before) / h - rate).abs() < 1e-4;
            prop_assert!(close(r.x_mm, reduced.x_mm, rate.x));
            prop_assert!(close(r.pitch_rad, pitch, rate.pitch_rad_per_mm));
            prop_assert!(close(r.roll_rad, roll, rate.roll_rad_per_mm));
            prop_assert!(close(f.y_mm, fibre.y_mm, rate.y));
            prop_assert!(close(f.z_mm, fibre.z_mm, rate.z));
            prop_assert!(close(f.yaw_rad, yaw, rate.yaw_rad_per_mm));
        }

        /// The reduced half of the motion does not depend on the fibre (the symmetry of the task).
        #[test]
        fn the_plane_task_does_not_see_the_fibre(yaw in -3.0..3.0f64, y in -50.0..50.0f64, z in -50.0..50.0f64, pitch in -1.2..1.2f64, roll in -3.0..3.0f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let reduced = Reduced { x_mm: 3.0, pitch_rad: pitch, roll_rad: roll };
            let i = Increment::new(1.0, 0.1).unwrap();
            let (a, _) = Reduced::split(&needle.step(&reduced.join(&Fibre::default()), i));
            let (b, _) = Reduced::split(&needle.step(&reduced.join(&Fibre { y_mm: y, z_mm: z, yaw_rad: yaw }), i));
            prop_assert!((a.x_mm - b.x_mm).abs() < 1e-11 && (a.pitch_rad - b.pitch_rad).abs() < 1e-12 && (a.roll_rad - b.roll_rad).abs() < 1e-11);
        }
    }

    #[test]
    fn at_pitch_ninety_the_rates_are_refused_by_name() {
        let needle = Needle::new(0.01).unwrap();
        let at = Reduced { pitch_rad: std::f64::consts::FRAC_PI_2, ..Reduced::default() };
        let refused = at.rates(&Fibre::default(), &needle, 0.0).unwrap_err();
        assert!(refused.to_string().starts_with("pitch is 90.000 deg"), "{refused}");
    }
}
