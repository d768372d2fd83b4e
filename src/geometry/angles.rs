//! The paper's fixed-axis angles.

use super::Pose;
use crate::keys::{Field, Key, Kind, Rule, section, within};
use crate::math;
use nalgebra::{Rotation3, Vector3};
use toml::Value;

/// A full turn in either direction.
pub(crate) const TURN: Rule = within(-360.0, 360.0);
const PITCH: Rule = within(-90.0, 90.0);
/// A coordinate of a position, mm.
pub(crate) const POSITION: Rule = within(-10_000.0, 10_000.0);

section! {
    /// Fixed-axis angles of the tip, `R = Rx(yaw) Ry(pitch) Rz(roll)`, rad.
    ///
    /// In the plane frame P, yaw α turns in the y–z plane, pitch β tilts out of it, and roll γ is the
    /// roll of the bevel. The angles are unique for |pitch| < π/2. At ±π/2 yaw and roll are the same
    /// rotation, and all of it is counted as yaw.
    #[derive(Copy, Default)]
    pub struct FixedAngles {
        /// α.
        yaw as "yaw_deg": f64 [TURN];
        /// β.
        pitch as "pitch_deg": f64 [PITCH];
        /// γ.
        roll as "roll_deg": f64 [TURN];
    }
}

impl FixedAngles {
    /// Below this cos(pitch) double precision cannot separate yaw from roll.
    const GIMBAL_LOCK: f64 = 1e-12;

    /// The rotation `Rx(yaw) Ry(pitch) Rz(roll)`.
    pub fn to_rotation(self) -> Rotation3<f64> {
        Rotation3::from_axis_angle(&Vector3::x_axis(), self.yaw)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), self.pitch)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), self.roll)
    }

    /// The angles of `rotation`: yaw and roll in [−π, π], pitch in [−π/2, π/2]. Finite if `rotation` is.
    pub fn from_rotation(rotation: &Rotation3<f64>) -> Self {
        let r = rotation.matrix();
        let cos_pitch = math::hypot(r[(0, 0)], r[(0, 1)]);
        let pitch = math::atan2(r[(0, 2)], cos_pitch);
        if cos_pitch < Self::GIMBAL_LOCK {
            return FixedAngles { yaw: math::atan2(r[(2, 1)], r[(1, 1)]), pitch, roll: 0.0 };
        }
        FixedAngles {
            yaw: math::atan2(-r[(1, 2)], r[(2, 2)]),
            pitch,
            roll: math::atan2(-r[(0, 1)], r[(0, 0)]),
        }
    }
}

/// In the configuration a pose is a position, and [`FixedAngles`] beside it.
impl Field for Pose {
    const KIND: Kind = Kind::Table(
        const {
            &[
                Key::new::<f64>("x_mm", "Position, mm.").rule(POSITION),
                Key::new::<f64>("y_mm", "Position, mm.").rule(POSITION),
                Key::new::<f64>("z_mm", "Position, mm.").rule(POSITION),
                Key::new::<FixedAngles>("angles", "Orientation.").flat(),
            ]
        },
    );
    fn take(table: Option<&Value>) -> Self {
        let mm = |key: &str| f64::take(table.and_then(|table| table.get(key)));
        let translation = Vector3::new(mm("x_mm"), mm("y_mm"), mm("z_mm"));
        Pose { rotation: FixedAngles::take(table).to_rotation(), translation }
    }
}

/// x, y, z in mm and yaw, pitch, roll in rad.
pub fn coordinates(pose: &Pose) -> [f64; 6] {
    let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(&pose.rotation);
    let p = &pose.translation;
    [p.x, p.y, p.z, yaw, pitch, roll]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::FRAC_PI_2;

    proptest! {
        #[test]
        fn angles_round_trip(yaw in -3.1..3.1f64, pitch in -1.57..1.57f64, roll in -3.1..3.1f64) {
            let angles = FixedAngles { yaw, pitch, roll };
            let back = FixedAngles::from_rotation(&angles.to_rotation());
            let tolerance = 1e-15 / pitch.cos() + 1e-12;
            prop_assert!((back.yaw - yaw).abs() < tolerance);
            prop_assert!((back.pitch - pitch).abs() < 1e-12);
            prop_assert!((back.roll - roll).abs() < tolerance);
        }

        #[test]
        fn at_gimbal_lock_the_rotation_is_kept(yaw in -3.0..3.0f64, up in any::<bool>(), roll in -3.0..3.0f64) {
            let pitch = if up { FRAC_PI_2 } else { -FRAC_PI_2 };
            let rotation = FixedAngles { yaw, pitch, roll }.to_rotation();
            let back = FixedAngles::from_rotation(&rotation).to_rotation();
            prop_assert!((back.matrix() - rotation.matrix()).norm() < 1e-9);
        }
    }
}
