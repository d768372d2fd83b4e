//! Poses in the configuration: mm and degrees.

use crate::geometry::{FixedAngles, Pose};
use crate::keys::{Rule, section, within};
use nalgebra::Vector3;

/// No displacement and no rotation, as a default.
pub(super) const IDENTITY: &str =
    "{ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }";
pub(super) const POSITION: Rule = within(-10_000.0, 10_000.0);
/// Pitch of a needle's tip, short of ±90°, where yaw and roll are the same rotation.
pub(super) const TIP_PITCH: Rule = within(-85.0, 85.0);

section! {
    /// A pose: position, then fixed-axis angles, `R = Rx(yaw) Ry(pitch) Rz(roll)`.
    #[derive(Copy, Default)]
    pub struct PoseConfig {
        /// Position, mm.
        x_mm: f64 [POSITION];
        /// Position, mm.
        y_mm: f64 [POSITION];
        /// Position, mm.
        z_mm: f64 [POSITION];
        /// Orientation.
        angles: FixedAngles, flat;
    }
}

impl PoseConfig {
    /// The pose in mm and rad.
    pub fn to_pose(&self) -> Pose {
        let PoseConfig { x_mm, y_mm, z_mm, angles } = *self;
        Pose { rotation: angles.to_rotation(), translation: Vector3::new(x_mm, y_mm, z_mm) }
    }
}
