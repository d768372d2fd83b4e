//! Poses and angles as they are written: mm and degrees.

use nalgebra::{Rotation3, Vector3};

use super::schema::{Rule, section, within};
use crate::geometry::{FixedAngles, Pose};

pub(super) const POSITION: Rule = within(-10_000.0, 10_000.0);
pub(super) const TURN: Rule = within(-360.0, 360.0);
/// Of a needle's tip. Short of where yaw and roll become one.
pub(super) const TIP_PITCH: Rule = within(-85.0, 85.0);
const PITCH: Rule = within(-90.0, 90.0);

section! {
    /// A pose: position, then fixed-axis angles, `R = Rx(yaw) Ry(pitch) Rz(roll)`.
    #[derive(Copy)]
    pub struct PoseConfig {
        /// Position, mm.
        x_mm: f64 [POSITION];
        /// Position, mm.
        y_mm: f64 [POSITION];
        /// Position, mm.
        z_mm: f64 [POSITION];
        /// α, degrees.
        yaw_deg: f64 [TURN];
        /// β, degrees.
        pitch_deg: f64 [PITCH];
        /// γ, degrees.
        roll_deg: f64 [TURN];
    }
}

section! {
    /// Fixed-axis angles.
    #[derive(Copy)]
    pub struct AnglesConfig {
        /// α, degrees.
        yaw_deg: f64 [TURN];
        /// β, degrees.
        pitch_deg: f64 [PITCH];
        /// γ, degrees.
        roll_deg: f64 [TURN];
    }
}

impl PoseConfig {
    /// As `pose` is written.
    pub fn of(pose: &Pose) -> Self {
        let AnglesConfig { yaw_deg, pitch_deg, roll_deg } = AnglesConfig::of(&pose.rotation);
        let [x_mm, y_mm, z_mm] = pose.translation.into();
        PoseConfig { x_mm, y_mm, z_mm, yaw_deg, pitch_deg, roll_deg }
    }

    /// The pose in mm and rad.
    pub fn to_pose(&self) -> Pose {
        let PoseConfig { x_mm, y_mm, z_mm, yaw_deg, pitch_deg, roll_deg } = *self;
        let angles = AnglesConfig { yaw_deg, pitch_deg, roll_deg }.to_fixed_angles();
        Pose { rotation: angles.to_rotation(), translation: Vector3::new(x_mm, y_mm, z_mm) }
    }
}

impl AnglesConfig {
    /// As `rotation` is written.
    pub fn of(rotation: &Rotation3<f64>) -> Self {
        let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(rotation);
        let [yaw_deg, pitch_deg, roll_deg] = [yaw, pitch, roll].map(f64::to_degrees);
        AnglesConfig { yaw_deg, pitch_deg, roll_deg }
    }

    /// The angles in rad.
    pub fn to_fixed_angles(&self) -> FixedAngles {
        FixedAngles {
            yaw: self.yaw_deg.to_radians(),
            pitch: self.pitch_deg.to_radians(),
            roll: self.roll_deg.to_radians(),
        }
    }
}
